"""Adam on whole pictures: one picture a step, in an order that is shuffled anew for each epoch.

The steps form passes. Smoothing (`solver/smoothing.py`) follows each pass, and an estimate of indirect light precedes
the last ones. Smoothing draws texels that few pictures show, or hardly light, towards their surroundings. The next pass
corrects them by the pictures.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.maps import place_of
from mistyle.core.rows import evenly
from mistyle.core.stage_progress import StageProgress
from mistyle.render.deferred.material_table import COLUMNS, SOLVED, TILT, MaterialTable
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.solver.context import FitContext
from mistyle.solver.journal import Journal
from mistyle.solver.pass_state import PassState
from mistyle.solver.pictures.adam import AdamOptions, Descent, table_on_device
from mistyle.solver.prior import NOTHING
from mistyle.solver.schedule import JUDGES, Pass
from mistyle.solver.settings import RecoverSettings, passes
from mistyle.solver.smoothing import map_smoothing
from mistyle.solver.table import Atlas, fill
from mistyle.solver.texels.solve import TexelEstimate, journalled_light

SEEDS = 7907  # seed offset between two estimates; exceeds the number of rounds
# Factors of the rate by channel after the per-texel solver: albedo is nearly right already, and longer steps would
# follow the pictures' noise, ...
SOLVED_RATES = (0.15, 0.15, 0.15, 0.5, 0.5, 1, 0.5, 0)
# ... and by texel: its standard deviation relative to the median, within these bounds. Roughness takes no long steps:
# with few observations albedo and roughness are interchangeable.
SHORTEST, LONGEST = 0.3, np.array([3, 3, 3, 3, 3, 1, 3], np.float32)
# Standard deviations after a pass, as multiples of the median: whole pictures show parts of texels that the solver did
# not observe, so the least certain texels are known better than the solver estimated.
LEFT = np.array([6, 6, 6, 7, 7, 5, np.inf], np.float32)
# By channel without the per-texel solver: soft light constrains albedo best, normals less, roughness least.
UNSOLVED_RATES = (2, 2, 2, 0.2, 0.2, 0.6, 0.6, 0)
DAMPING = 0.3


def picture_pass(
    context: FitContext,
    renderer: MaterialRenderer,
    state: PassState,
    one: Pass,
    journal: Journal,
    progress: StageProgress,
) -> PassState:
    """The state after a pass on whole pictures. `renderer` has the references of `state.direct`; those of an estimate
    of indirect light before the pass replace them."""
    estimate, direct = state.estimate, state.direct
    assert estimate is not None
    base = smoothed(context, state) if one.begin else estimate.table
    if one.samples:
        sampling = one.samples, context.seed + SEEDS * (_number(context, one) + 1)
        for k, light, _ in journalled_light(context, renderer, base, sampling, journal, progress.part(0, 0.4)):
            direct = direct.with_indirect(k, light)
            renderer.retarget(direct.direct_only(), direct.pixel_confidence, [k])
    part = progress.part(0.4, 1) if one.samples else progress
    table = _descend(context, renderer, estimate, (base, one), part, journal)
    return replace(state, table=table, direct=direct)


def settled(context: FitContext, renderer: MaterialRenderer, state: PassState) -> PassState:
    """The state after the last pass on whole pictures, smoothed; the texels' estimate, with a note, if the loss did not
    fall."""
    estimate = state.estimate
    assert estimate is not None and state.table is not None
    before, after = (total_loss(renderer, each, context.settings) for each in (estimate.table, state.table))
    context.trace["pictures.whole"] = [before, after]
    if not after < before:
        context.notes.append(
            f"The steps on whole pictures were undone: the loss changed from {before:.3g} to {after:.3g}."
        )
        return replace(state, table=estimate.table, settled=True)
    return replace(state, table=smoothed(context, state), settled=True)


def smoothed(context: FitContext, state: PassState) -> MaterialTable:
    """The table of a state between passes on whole pictures, smoothed where the texels were solved."""
    estimate, settings = state.estimate, context.settings
    assert estimate is not None and state.table is not None
    if not (estimate.solved and settings.smooth):
        return state.table
    std = _unconstrained_std(estimate)
    return map_smoothing(state.table, std, context.atlas, settings.roughness_floor, settings.metallic)


def _number(context: FitContext, one: Pass) -> int:
    """The number of a pass among those on whole pictures."""
    ends = np.cumsum([steps for steps, _ in passes(context.settings, len(context.captures))])
    return int(np.searchsorted(ends, one.begin, side="right"))


def _descend(
    context: FitContext,
    renderer: MaterialRenderer,
    estimate: TexelEstimate,
    run: tuple[MaterialTable, Pass],
    progress: Callable[[float], None],
    journal: Journal,
) -> MaterialTable:
    """The steps of a pass from the table of `run`; the rate falls to zero along a cosine."""
    settings, count, (base, one), resume = (
        context.settings,
        len(context.captures),
        run,
        journal.earlier.pop("adam", None),
    )
    descent = _descent(context, estimate)
    table, first, pending, own = table_on_device(base), one.begin, [], []
    if resume is not None:
        first, table, own = int(resume["iteration"]), table_on_device(resume["table"]), resume["losses"].tolist()
        descent.restore(resume)

    def state() -> dict[str, np.ndarray]:
        flush()
        reached = {"iteration": np.array(done), "losses": np.array(own)}
        return descent.state() | reached | {"table": np.array(table).reshape(-1, COLUMNS)}

    def flush() -> None:
        own.extend(float(np.array(value)[0]) for value in pending)
        pending.clear()

    done, end = first, one.begin + one.steps
    for k in range(first, end):
        picture = int(np.random.default_rng([context.seed, k // count]).permutation(count)[k % count])
        loss, gradient = renderer.step(table, [picture], settings.loss)
        rate = settings.rate * 0.5 * (1 + np.cos(np.pi * (k - one.begin) / one.steps))
        table = descent.step(table, gradient.array, rate, picture)
        pending.append(loss)
        done = k + 1
        if done % count == 0 or done == end:
            flush()
            progress((done - one.begin) / one.steps)
        if done < end:
            journal.poll("adam", state)
    context.trace.setdefault("pictures.loss", []).extend(own)
    _note_stopped(context, descent.stopped())
    return np.array(table).reshape(-1, COLUMNS)


def _descent(context: FitContext, estimate: TexelEstimate) -> Descent:
    settings, solved = context.settings, estimate.solved
    rates = [1.0, 1, 1, 1, 1, 1, 1 if settings.metallic else 0, 0]
    rates = [rate * share for rate, share in zip(rates, SOLVED_RATES if solved else UNSOLVED_RATES, strict=True)]
    options = AdamOptions(settings.levels, settings.roughness_floor, damping=0.0 if solved else DAMPING)
    return Descent(
        context.atlas.sizes, rates, options, shares=_rate_factors(estimate, context.atlas) if solved else None
    )


def _unconstrained_std(estimate: TexelEstimate) -> Float[np.ndarray, "a 7"]:
    """Standard deviations after a pass: those of `estimate`, which approach LEFT times the median."""
    std = estimate.unconstrained
    return (std / np.sqrt(1 + (std / (LEFT * _median_std(estimate))) ** 2)).astype(np.float32)


def _rate_factors(estimate: TexelEstimate, atlas: Atlas) -> MaterialTable:
    """Factors of Adam's rate. Adam's steps ignore how well an unknown is observed, so well-known texels take shorter
    steps, and a tilt that its neighbours decided would drift. Uncovered texels, seen by pixels at island borders, take
    the rate of the nearest covered one, so that these pixels still have an effect."""
    factors = np.ones((len(estimate.data_weight), COLUMNS), np.float32)
    if _observed(estimate).any():
        factors[:, SOLVED] = np.clip(estimate.unconstrained / _median_std(estimate), SHORTEST, LONGEST)
    factors[:, TILT] *= np.sqrt(estimate.data_weight)[:, None]
    return fill(factors, atlas)


def _observed(estimate: TexelEstimate) -> Bool[np.ndarray, " a"]:
    return np.asarray((estimate.seen > 0) & (estimate.unconstrained < NOTHING).all(axis=1))


def _median_std(estimate: TexelEstimate) -> Float[np.ndarray, "7"]:
    """The median standard deviation of observed texels."""
    known = _observed(estimate)
    usual = np.median(estimate.unconstrained[known], axis=0) if known.any() else np.full(7, NOTHING, np.float32)
    return np.maximum(usual, 1e-9)


def _note_stopped(context: FitContext, stopped: list[tuple[int, str, int]]) -> None:
    """Note the texels that were frozen because their gradient was not finite."""
    for texel, name, picture in stopped[:3]:
        part, row, column = place_of(texel, context.atlas.sizes)
        label = context.traced.mesh.parts[part]
        context.notes.append(
            f"The gradient of map '{name}' at texel (row {row}, column {column}) of set '{label}' is not finite in"
            f" picture '{context.captures.cameras[picture].name}': the texel keeps its last good value."
        )
    if len(stopped) > 3:
        context.notes.append(f"{len(stopped) - 3} more texels had such gradients.")


def total_loss(renderer: MaterialRenderer, table: MaterialTable, settings: RecoverSettings) -> float:
    """Mean loss over the pictures, or over JUDGES of them, evenly spaced."""
    uploaded, chosen = renderer.upload(table), evenly(len(renderer.captures), JUDGES)
    return float(np.mean([np.array(renderer.step(uploaded, [k], settings.loss)[0])[0] for k in chosen]))
