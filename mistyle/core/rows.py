"""Distinct rows of a table."""

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
