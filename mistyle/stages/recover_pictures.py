"""The pictures' part of a recovery: Adam on whole pictures, one a step, in an order that is shuffled anew each time.

It goes in passes. After each neighbours have a word (`recover_smooth.py`), and before the last ones the light between
surfaces is estimated with the better maps: both draw the texels that few pictures show, or hardly light, towards what
is known around them, and the next pass asks the pictures again.
"""

import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core import stopping
from mistyle.core.maps import place_of
from mistyle.stages.recover_prior import NOTHING
from mistyle.stages.recover_settings import RecoverSettings, passes
from mistyle.stages.recover_smooth import smoothed
from mistyle.stages.recover_table import Atlas, fill
from mistyle.stages.recover_texels import Found, Work, take_off_indirect

JUDGES = 48  # pictures that say whether the steps helped
SEEDS = 7907  # between the seeds of two estimates: more than there are rounds
# Multiples of the rate by channel where the texels were solved before: their albedo is nearly right already, and longer
# steps would follow the pictures' noise, ...
SOLVED = (0.15, 0.15, 0.15, 0.5, 0.5, 1, 0.5, 0)
# ... and by texel, the noise of what is known of it as a multiple of the usual one, within these bounds. Roughness
# takes no long steps: where little speaks for one, albedo can stand for it.
SHORTEST, LONGEST = 0.3, np.array([3, 3, 3, 3, 3, 1, 3], np.float32)
# What is left open after a pass, as multiples of what is usual: whole pictures show parts of texels of which the solver
# had no observation, so what it knew least of is known better then than it promised.
LEFT = np.array([6, 6, 6, 7, 7, 5, np.inf], np.float32)
# By channel where they were not: soft light says little of normals, less of roughness, most of albedo.
UNSOLVED = (2, 2, 2, 0.2, 0.2, 0.6, 0.6, 0)
DAMPING = 0.3

Table = Float[np.ndarray, "a 8"]


def improved(
    work: Work,
    shade,
    found: Found,
    indirect: dict[int, np.ndarray],
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
    save: Callable[[dict[str, np.ndarray]], None] | None,
    resume: dict[str, np.ndarray] | None,
) -> Table:
    """What all passes make of `found`, or where that explains the pictures no better `found` itself, with a note.

    `resume` is one of the states that `save` got; the estimate of its pass is made again, from the same maps.
    """
    settings = work.settings
    parts = passes(settings, len(work.captures)) if found.solved else [(settings.iterations, 0)]
    reached, noise = 0 if resume is None else int(resume["iteration"]), _left(found)

    def settled(table: Table) -> Table:
        if not (found.solved and settings.smooth):
            return table
        return smoothed(table, noise, work.where, settings.roughness_floor, settings.metallic)

    def between(low: float, high: float) -> Callable[[float], None]:
        return lambda done: progress((low + (high - low) * done) / settings.iterations)

    table, first = found.table, 0
    for number, (steps, samples) in enumerate(parts):
        last = first + steps
        if reached < last:
            going_on = resume if reached > first else None
            base = going_on["base"] if going_on is not None else settled(table) if first else table
            halfway = first
            if samples:
                halfway += steps / 2
                looked = between(first, halfway)
                take_off_indirect(work, shade, base, indirect, samples, seed + SEEDS * (number + 1), looked)
            with stopping.at_checkpoints():
                heard = between(halfway, last)
                table = _descend(work, shade, found, base, first, steps, seed, trace, heard, save, going_on)
        first = last
    before, after = (total_loss(shade, each, settings) for each in (found.table, table))
    trace["pictures.whole"] = [before, after]
    if not after < before:
        work.notes.append(f"The steps on whole pictures were undone: the loss went from {before:.3g} to {after:.3g}.")
        return found.table
    return settled(table)


def _descend(
    work: Work,
    shade,
    found: Found,
    base: Table,
    begin: int,
    steps: int,
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
    save: Callable[[dict[str, np.ndarray]], None] | None,
    resume: dict[str, np.ndarray] | None,
) -> Table:
    """One pass from `base`: steps `begin` : begin + steps of all; the rate falls to zero along a cosine."""
    from mistyle.render.descent import Descent, table_on_device

    settings, count = work.settings, len(work.captures)
    rates = [1.0, 1, 1, 1, 1, 1, 1 if settings.metallic else 0, 0]
    rates = [rate * share for rate, share in zip(rates, SOLVED if found.solved else UNSOLVED, strict=True)]
    descent = Descent(
        work.where.sizes, rates, levels=settings.levels, floor=settings.roughness_floor,
        damping=0.0 if found.solved else DAMPING, shares=_shares(found, work.where) if found.solved else None,
    )  # fmt: skip
    table, first, lost, losses = table_on_device(base), begin, [], trace.setdefault("pictures.loss", [])
    if resume is not None:
        first, table = int(resume["iteration"]), table_on_device(resume["table"])
        losses.extend(resume["losses"].tolist())
        descent.restore(resume)
    saved, end = time.monotonic(), begin + steps
    for k in range(first, end):
        picture = int(np.random.default_rng([seed, k // count]).permutation(count)[k % count])
        shade.table = table
        loss, gradient = shade.step([picture], settings.loss)
        rate = settings.rate * 0.5 * (1 + np.cos(np.pi * (k - begin) / steps))
        table = descent.step(table, gradient.array, rate, picture)
        lost.append(loss)
        if (k + 1) % count == 0 or k + 1 == end:
            losses.extend(float(np.array(value)[0]) for value in lost)
            lost.clear()
            progress((k + 1 - begin) / steps)
            due = stopping.asked() or time.monotonic() - saved > settings.checkpoint
            if save is not None and due and k + 1 < end:
                state = descent.state() | {"iteration": np.array(k + 1), "losses": np.array(losses), "base": base}
                save(state | {"table": np.array(table).reshape(-1, 8)})
                saved = time.monotonic()
                stopping.check()
    _note_stopped(work, descent.stopped())
    return np.array(table).reshape(-1, 8)


def _left(found: Found) -> Float[np.ndarray, "a 7"]:
    """Standard deviations of what a pass leaves open: `found.noise`, which approaches LEFT times the usual."""
    return (found.noise / np.sqrt(1 + (found.noise / (LEFT * _usual(found))) ** 2)).astype(np.float32)


def _shares(found: Found, where: Atlas) -> Table:
    """Multiples of Adam's rate. A step has the same length however little speaks for it, so texels that are known well
    take shorter ones; and a tilt that its neighbours decided would wander off. Uncovered texels, which pixels at the
    borders of islands see, go at the pace of the nearest covered one, or what pixels tell would be lost to them."""
    shares = np.ones((len(found.decided), 8), np.float32)
    if _known(found).any():
        shares[:, :7] = np.clip(found.noise / _usual(found), SHORTEST, LONGEST)
    shares[:, 3:5] *= np.sqrt(found.decided)[:, None]
    return fill(shares, where)


def _known(found: Found) -> Bool[np.ndarray, " a"]:
    return np.asarray((found.seen > 0) & (found.noise < NOTHING).all(axis=1))


def _usual(found: Found) -> Float[np.ndarray, "7"]:
    """The median noise of texels that something is known of."""
    known = _known(found)
    usual = np.median(found.noise[known], axis=0) if known.any() else np.full(7, NOTHING, np.float32)
    return np.maximum(usual, 1e-9)


def _note_stopped(work: Work, stopped: list[tuple[int, str, int]]) -> None:
    """Say which texels stood still because their gradient was not a number."""
    for texel, name, picture in stopped[:3]:
        part, row, column = place_of(texel, work.where.sizes)
        label = work.traced.mesh.parts[part]
        work.notes.append(
            f"The gradient of map '{name}' at texel (row {row}, column {column}) of set '{label}' is not a number in"
            f" picture '{work.captures.cameras[picture].name}': the texel keeps its last good value."
        )
    if len(stopped) > 3:
        work.notes.append(f"The same held for {len(stopped) - 3} more texels.")


def total_loss(shade, table: Float[np.ndarray, "a 8"], settings: RecoverSettings) -> float:
    """Mean loss over the pictures, or over JUDGES of them, evenly chosen."""
    shade.table = table
    last = len(shade.captures) - 1
    chosen = np.unique(np.linspace(0, last, min(JUDGES, last + 1)).round().astype(int)).tolist()
    return float(np.mean([np.array(shade.step([k], settings.loss)[0])[0] for k in chosen]))
