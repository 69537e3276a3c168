"""Rows of a table: distinct ones, evenly chosen ones, unit ones, and sums and medians of groups; distinct integers."""

import numpy as np
from jaxtyping import Float, Int, Shaped


def corner_rows(index: Int[np.ndarray, " n"], *values: Float[np.ndarray, "n _"]) -> Int[np.ndarray, "n k"]:
    """Rows for `distinct`: equal where the index and the values (as float32) are equal."""
    # Adding 0 turns -0.0 into 0.0, which compare equal but differ in bytes.
    bits = [(np.ascontiguousarray(v, np.float32) + np.float32(0)).view(np.int32) for v in values]
    return np.concatenate([index[:, None].astype(np.int32), *bits], axis=1)


def distinct(rows: Shaped[np.ndarray, "n k"]) -> tuple[Int[np.ndarray, " d"], Int[np.ndarray, " n"]]:
    """Index of the first row of every kind, in ascending order of the rows, and the kind of each row.

    These are the indices and the inverse of `np.unique(rows, axis=0)`, which compares whole rows; sorting by one
    column after the other is several times as fast. NaN equals nothing.
    """
    order = np.lexsort(rows.T[::-1])
    begins = np.ones(len(rows), bool)
    begins[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    inverse = np.empty(len(rows), np.int64)
    inverse[order] = np.cumsum(begins) - 1
    return order[begins], inverse


def distinct_integers(values: Int[np.ndarray, "*n"]) -> Int[np.ndarray, " d"]:
    """The distinct values in ascending order, as from `np.unique(values)`.

    NumPy 2.3 and later hash them there, which takes 4.9 s for some millions of integers; sorting takes 0.3 s. With
    return_index, return_inverse or return_counts `np.unique` still sorts.
    """
    ordered = np.sort(values, axis=None)
    first = np.ones(len(ordered), bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return ordered[first]


def evenly(count: int, most: int) -> list[int]:
    """At most `most` of the rows 0..count - 1, evenly chosen, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def unit(rows: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n k"]:
    """The rows at length one; zero stays zero."""
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    return rows / np.where(length > 0, length, 1)


def sums(group: Int[np.ndarray, " n"], rows: Float[np.ndarray, "n k"], count: int) -> Shaped[np.ndarray, "g k"]:
    """The sum of the rows of each group 0..count - 1; integers where there is none."""
    return np.stack([np.bincount(group, column, count) for column in rows.T], axis=1)


def weighted_median(values: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> float:
    """The lower weighted median of all values, of which there is one at least."""
    return float(weighted_medians(np.zeros(len(values), np.int64), values, weight)[1][0])


def weighted_medians(
    group: Int[np.ndarray, " n"], values: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """The groups that occur, ascending, and their lower weighted medians: the smallest value up to which a group's
    values have half of its weight."""
    order = np.lexsort((values, group))
    group, values = group[order], values[order]
    total = np.cumsum(weight[order], dtype=np.float64)
    ends = np.flatnonzero(np.append(group[1:] != group[:-1], True)) if len(group) else np.zeros(0, np.int64)
    before = np.concatenate([[0.0], total[ends[:-1]]]) if len(ends) else np.zeros(0)
    middle = np.searchsorted(total, before + 0.5 * (total[ends] - before))
    return group[ends], values[np.minimum(middle, ends)]
