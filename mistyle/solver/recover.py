"""Recovering materials: albedo, normal, roughness and metallic from pictures of known cameras under known light.

1. `texels/solve.py` solves each texel alone by Levenberg-Marquardt. It renders nothing: cameras and lights are known.
   Twenty such steps reach a result that hundreds of gradient steps on pictures do not.
2. `pictures/descend.py` minimises the loss of whole pictures by Adam, through `render/deferred/renderer.py`, which
   models pixels and interpolation exactly.
3. `joint/gauss_newton.py` ends with a joint Gauss-Newton over all texels and pictures, under delta lights only.

Smoothness priors (`solver/smoothing.py`) act before, between and after the passes of Adam. All stages fit to direct
light: indirect light is estimated with the current maps and subtracted from the pictures (`bounces`). Lights and
cameras are fixed. A common factor of light and albedo is not identifiable: albedo is as accurate as the lights' units.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.capture import Captures
from mistyle.core.light import has_soft
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, surface_of
from mistyle.core.stage_progress import StageProgress
from mistyle.process import memory, stopping
from mistyle.render.deferred.image_samples import tangents_of
from mistyle.render.deferred.material_table import (
    ALBEDO,
    METALLIC,
    ROUGHNESS,
    SOLVED,
    TILT,
    MaterialTable,
    pack,
    unpack,
)
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.render.mitsuba.device import give_back
from mistyle.render.mitsuba.draw import tracer
from mistyle.solver.context import DirectCaptures, FitContext
from mistyle.solver.deviation import class_std
from mistyle.solver.joint.gauss_newton import TOO_LARGE, JointSetup, joint_pass, joint_setup
from mistyle.solver.journal import Checkpoints, Journal, TimeOver
from mistyle.solver.pass_state import PassState, arrays_of, state_from
from mistyle.solver.pictures.descend import picture_pass, settled
from mistyle.solver.pictures.polish import PolishSettings, polish
from mistyle.solver.schedule import Pass, Size, runnable, schedule, shares, size_from
from mistyle.solver.settings import RecoverSettings, descent_steps, joint_steps
from mistyle.solver.smoothing import map_smoothing
from mistyle.solver.table import Values, atlas_of, linked
from mistyle.solver.texels.detail import Detail
from mistyle.solver.texels.solve import (
    TexelEstimate,
    TexelLevel,
    estimate_of,
    first_solution,
    level_factor,
    solution_after_rounds,
    texel_level,
)
from mistyle.solver.validate import validate_captures
from mistyle.solver.visible import visible_shares

__all__ = ["Checkpoints", "Limits", "Reached", "RecoverSettings", "Recovered", "recover"]

PATIENCE = 3.0  # seconds that a stop request waits for a point where the state is consistent

# Standard deviations at which a texel's confidence is a half: normal (sine), roughness, albedo, metallic.
HALF_SURE = {"normal": 0.05, "roughness": 0.1, "albedo": 0.05, "metallic": 0.2}
CHANNELS = {
    "albedo": ALBEDO,
    "normal": TILT,
    "roughness": slice(ROUGHNESS, ROUGHNESS + 1),
    "metallic": slice(METALLIC, METALLIC + 1),
}
NO_CHECKPOINTS = Checkpoints()


@dataclass(frozen=True)
class Recovered:
    """The fitted maps and their uncertainty, per texture set.

    maps        `known` is True where at least one picture observed the texel in the light
    confidence  0..1: 1 / (1 + mean of (standard deviation / HALF_SURE)²) for what a texel's own observations leave
                open; 1 is certain, 0 unobserved
    spread      standard deviations of albedo, normal (of the tilt: radians), roughness and metallic, see `deviation.py`
    seen        number of pictures that observed the texel in the light
    views       number of different cameras that did
    trace       values per round and step, by name
    residuals   per picture by its name: root mean square of reference - render, relative to the reference's; none
                where `Limits` leave them out
    notes       sentences for the report
    passes      number of passes, and how many were `planned`
    indirect    whether estimated indirect light was subtracted from the pictures: the maps do not contain it
    """

    maps: tuple[Maps, ...]
    confidence: tuple[Float[np.ndarray, "_ _"], ...]
    spread: tuple[dict[str, Float[np.ndarray, "h w"]], ...]
    seen: tuple[Int[np.ndarray, "h w"], ...]
    views: tuple[Int[np.ndarray, "h w"], ...]
    trace: dict[str, list[float]]
    residuals: dict[str, float]
    notes: tuple[str, ...]
    passes: int = 0
    planned: int = 0
    indirect: bool = False


@dataclass(frozen=True)
class Reached:
    """A recovery after some of its `planned` passes, for whoever watches it."""

    done: int
    planned: int
    work: "_Work"
    state: PassState

    def maps(self, smooth: bool = True) -> tuple[Maps, ...]:
        """The maps so far; those of passes on whole pictures are not smoothed, and none without `smooth`, to be
        quick."""
        estimate = self.work.estimate(self.state, smooth)
        table = estimate.table if self.state.table is None else self.state.table
        return _maps(self.work.context, estimate, self.work.detailed(self.state, table) if smooth else table)

    def finished(self) -> tuple[Maps, ...]:
        """The maps of a recovery with as many passes: slower than `maps`."""
        table, estimate, _ = self.work.result(self.state)
        return _maps(self.work.context, estimate, table)


@dataclass(frozen=True)
class Limits:
    """When a recovery ends: after so many `passes`, 0 for all, or with the first pass that would exceed `deadline`, a
    value of `time.monotonic`. `watch` is called after each pass, `resumed` with the share that a checkpoint holds.
    Without `judged` the pictures' residuals are left out, for whoever measures the maps himself."""

    passes: int = 0
    deadline: float = float("inf")
    watch: Callable[[Reached], None] = lambda reached: None
    resumed: Callable[[float], None] = lambda share: None
    judged: bool = True


NO_LIMITS = Limits()


def recover(
    mesh: Mesh,
    texels: Sequence[Texels],
    captures: Captures,
    settings: RecoverSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
    *,
    start: Sequence[Maps] | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    limits: Limits = NO_LIMITS,
) -> Recovered:
    """Fit one set of maps per texture set to `captures`; equal input, settings, seed, passes and threads give equal
    bytes.

    `start` maps initialise the solver and keep their metallic unless it is fitted. `checkpoints` save the state from
    which a later call ends with the same bytes. Unusable pictures are skipped with a note. Raises InputRefused if all
    are, and Stopped, after a checkpoint, on a stop request.
    """
    notes: list[str] = []
    soft, wanted = has_soft(captures.lights), joint_steps(settings)
    settings = runnable(settings, soft, sum(t.covered.size for t in texels))
    if wanted and not soft and not settings.joint:
        notes.append(TOO_LARGE.format(settings.memory))
    usable, traced = validate_captures(mesh, captures, notes), tracer(mesh)
    # The steps on whole pictures have no neighbours.
    grid = atlas_of(texels) if settings.solver == "pictures" else linked(mesh, texels)
    tangents = tangents_of(mesh, settings.frame)
    context = FitContext(traced, tangents, texels, grid, usable, settings, seed, notes)
    journal = Journal(checkpoints, settings.checkpoint, limits.deadline)

    def report(done: float) -> None:
        progress(done)
        journal.poll()

    with stopping.at_checkpoints(PATIENCE):
        work = _Work(context, start, journal, StageProgress(report))
        state, planned = work.run(limits)
        table, estimate, stated = work.result(state)
        residuals = work.residuals(state, table) if limits.judged else {}
    del work
    give_back()
    progress(1.0)
    done = {"passes": state.done, "planned": planned, "indirect": bool(state.direct.indirect)}
    return replace(_recovered(context, (table, estimate, stated), residuals), **done)


class _Work:
    """Runs the passes; a class, since renderers and problems are built when a pass first needs them, and freed."""

    def __init__(
        self, context: FitContext, start: Sequence[Maps] | None, journal: Journal, progress: StageProgress
    ) -> None:
        self.context, self.start, self.journal, self.progress = context, start, journal, progress
        self._level: TexelLevel | None = None
        self._renderer: MaterialRenderer | None = None
        self._joint: JointSetup | None = None
        self._detail: Detail | None = None
        self._targets: DirectCaptures | None = None
        self._estimates: tuple[PassState, TexelEstimate] | None = None

    def run(self, limits: Limits) -> tuple[PassState, int]:
        """The state after the last pass within the limits, and the number of planned passes."""
        context, journal = self.context, self.journal
        settings, pictures = context.settings, len(context.captures)
        state, solved = PassState(DirectCaptures(context.captures)), settings.solver != "pictures"
        planned, size = schedule(settings, pictures, solved), size_of(context)
        done = shares(settings, planned[: limits.passes or None], size)
        if journal.resumed is not None:
            state = self._resumed(limits.passes or len(planned)) or state
        if state.done:
            limits.resumed(done[state.done])
        if solved and not state.done:
            solved = self.level(self.progress.part(0, done[0])).problem is not None
        elif state.estimate is not None:
            solved = state.estimate.solved
        planned = schedule(settings, pictures, solved)
        done = shares(settings, planned[: limits.passes or None], size)
        for k in range(state.done, min(limits.passes or len(planned), len(planned))):
            kinds = [one.kind for one in planned[k : k + 2]]
            state = self._prepared(state, planned[k])
            try:
                journal.begin(arrays_of(state, context), k)
                state = self._after(state, planned[k], self.progress.part(done[k], done[k + 1]))
                if kinds[0] == "pictures" and kinds[1:] != ["pictures"]:
                    state = settled(context, self.renderer(state), state)
            except TimeOver:
                journal.save()
                return state_from(journal.state, context), len(planned)
            state = replace(state, done=k + 1)
            give_back()
            limits.watch(Reached(k + 1, len(planned), self, state))
        if state.done < len(planned):
            # A later call with wider limits continues here.
            journal.begin(arrays_of(state, context), 0)
            journal.save()
        return state, len(planned)

    def result(self, state: PassState) -> tuple[MaterialTable, TexelEstimate, Values]:
        """The final table of a state, smoothed and with its detail, the texels' estimate, and the table's standard
        deviations."""
        table, estimate = self.smoothed(state)
        return self.detailed(state, table), estimate, _stated(self.context, estimate, table)

    def residuals(self, state: PassState, table: MaterialTable) -> dict[str, float]:
        """The relative residual of every picture, by its name."""
        renderer, direct = self.renderer(state), state.direct
        uploaded = renderer.upload(table)
        return {
            camera.name: _residual(direct, renderer.image_and_coverage(uploaded, k), k)
            for k, camera in enumerate(direct.captures.cameras)
        }

    def detailed(self, state: PassState, table: MaterialTable) -> MaterialTable:
        """The table with the albedo's detail, where the texels were solved on a coarser level."""
        settings = self.context.settings
        if not settings.detail or settings.solver == "pictures" or level_factor(self.context) == 1:
            return table
        self._detail = self._detail or Detail(self.context)
        return self._detail(table, state.direct)

    def smoothed(self, state: PassState) -> tuple[MaterialTable, TexelEstimate]:
        """The final table of a state, smoothed, and the texels' estimate."""
        estimate, settings = self.estimate(state), self.context.settings
        if state.table is None:
            return estimate.table, estimate
        if not state.settled and settings.solver != "texels":
            state = settled(self.context, self.renderer(state), state)
        assert state.table is not None
        return state.table, estimate

    def estimate(self, state: PassState, smooth: bool = True) -> TexelEstimate:
        """The texels' estimate of a state."""
        if state.estimate is not None:
            return state.estimate
        if self._estimates is None or self._estimates[0] is not state:
            context, settings = self.context, self.context.settings
            estimate = estimate_of(self.level(), state.solution, context)
            if not smooth:
                return estimate
            if estimate.solved and settings.smooth:
                arguments = context.atlas, settings.roughness_floor, settings.metallic
                table = map_smoothing(estimate.table, estimate.unconstrained, *arguments)
                estimate = replace(estimate, table=table)
            self._estimates = state, estimate
        return self._estimates[1]

    def level(self, progress: Callable[[float], None] = lambda done: None) -> TexelLevel:
        """The per-texel problem."""
        if self._level is None:
            self._level = texel_level(self.context, lambda: self.renderer(None), self.start, progress)
        return self._level

    def renderer(self, state: PassState | None) -> MaterialRenderer:
        """The renderer of the whole atlas, with the references of a state."""
        if self._renderer is None:
            self._renderer = self.context.renderer(gradients=descent_steps(self.context.settings) > 0)
            self._targets = None
        if state is not None and state.direct is not self._targets:
            self._renderer.retarget(state.direct.direct_only(), state.direct.pixel_confidence)
            self._targets = state.direct
        return self._renderer

    def _resumed(self, passes: int) -> PassState | None:
        """The state of the checkpoint, unless it is beyond the last pass."""
        assert self.journal.resumed is not None
        state = state_from(self.journal.resumed, self.context)
        if state.done <= passes:
            return state
        self.journal.earlier = {}
        return None

    def _prepared(self, state: PassState, one: Pass) -> PassState:
        """The state in which a pass begins: with the texels' estimate once they are solved."""
        if one.kind in ("solve", "rounds") or state.estimate is not None:
            return state
        # The estimate of `state` stays in memory: a stop request during the pass writes its maps.
        prepared = replace(state, estimate=memory.away(self.estimate(state)), solution=None)
        self._level = None
        give_back()
        return prepared

    def _after(self, state: PassState, one: Pass, progress: StageProgress) -> PassState:
        """The state after a pass."""
        context, journal = self.context, self.journal
        if one.kind == "solve":
            return replace(state, solution=first_solution(self.level(), journal, progress))
        if one.kind == "rounds":
            assert state.solution is not None
            start = state.solution, state.direct
            solution, direct = solution_after_rounds(self.level(), start, one, journal, progress)
            return replace(state, solution=solution, direct=direct)
        if one.kind == "pictures":
            state = picture_pass(context, self.renderer(state), state, one, journal, progress)
            self._targets = state.direct
            return state
        if one.kind == "joint":
            return state if state.over else self._joint_pass(state, one, progress)
        table = self.smoothed(state)[0]
        return replace(state, table=polished(context, table, progress), settled=True)

    def _joint_pass(self, state: PassState, one: Pass, progress: StageProgress) -> PassState:
        if self._joint is None:
            # This renderer has finer pictures; the samples of the other one are freed first.
            self._renderer = None
            renderer = self.context.renderer(subsamples=self.context.settings.joint_subsamples, memory=0)
            self._joint = joint_setup(self.context, renderer)
            self._renderer, self._targets = renderer, None
        if self._joint is None:
            return replace(state, over=True)
        return joint_pass(self.context, self._joint, state, one, self.journal, progress)


def size_of(context: FitContext) -> Size:
    """Counts of a recovery, for its seconds."""
    settings, cameras = context.settings, context.captures.cameras
    covered, soft = sum(int(c.sum()) for c in context.atlas.covered), has_soft(context.captures.lights)
    pixels = [camera.size[0] * camera.size[1] for camera in cameras]
    mesh = context.traced.mesh
    visible = visible_shares(surface_of(mesh.positions, mesh.faces), cameras, context.captures.lights)
    return size_from(settings, pixels, covered, soft, visible)


def polished(context: FitContext, table: MaterialTable, progress: Callable[[float], None]) -> MaterialTable:
    """Steps through `prb` from `table`, against pictures with all their light.

    A result whose loss does not fall is dropped, with a note.
    """
    s = context.settings
    chosen = PolishSettings(s.polish, s.loss, s.polish_rate, s.metallic, s.polish_depth, model=s.model, frame=s.frame)
    start = unpack(table, context.atlas.sizes)
    result = polish(context.traced.mesh, start, context.captures, chosen, context.seed, progress)
    context.trace["polish.loss"], context.trace["polish.whole"] = list(result.trace), list(result.loss)
    if not result.loss[1] < result.loss[0]:
        context.notes.append(
            f"The polish was undone: the loss changed from {result.loss[0]:.3g} to {result.loss[1]:.3g}."
        )
        return table
    return pack(result.maps)


def _residual(direct: DirectCaptures, drawn: tuple[np.ndarray, np.ndarray], k: int) -> float:
    """RMS of reference - render (`image_and_coverage`) of picture k, relative to the RMS of the reference."""
    (rgb, mask), (image, coverage) = direct.load(k), drawn
    inside = mask & (coverage > 0.999)
    reference = rgb[inside].astype(np.float64)
    residual = reference - image[inside]
    return float(np.sqrt((residual**2).sum() / max((reference**2).sum(), 1e-30)))


def _stated(context: FitContext, estimate: TexelEstimate, table: MaterialTable) -> Values:
    """Standard deviations of a table that follows from an estimate, see `deviation.py`."""
    settings = context.settings
    if not estimate.solved:
        return estimate.std
    stated = estimate.std.copy()
    if descent_steps(settings) > 0 and not settings.joint:
        stated = np.sqrt((estimate.std**2 + (table - estimate.table)[:, SOLVED] ** 2) / 2)
    if settings.metallic:
        sure = estimate.std[:, METALLIC]
        stated[:, METALLIC] = class_std(table[:, METALLIC], sure, estimate.seen > 0, context.atlas)
    return stated


def _recovered(
    context: FitContext, found: tuple[MaterialTable, TexelEstimate, Values], residuals: dict[str, float]
) -> Recovered:
    grid, settings, (table, estimate, stated) = context.atlas, context.settings, found
    names = [n for n in CHANNELS if n != "metallic" or settings.metallic]
    variance = {n: (estimate.std[:, CHANNELS[n]] ** 2).mean(axis=1) for n in CHANNELS}
    doubt = np.mean([variance[n] / HALF_SURE[n] ** 2 for n in names], axis=0)
    sure = np.where(estimate.seen > 0, 1 / (1 + doubt), 0).astype(np.float32)

    def grids(values: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(values[part].reshape(size) for part, size in zip(grid.parts, grid.sizes, strict=True))

    seen = grids(estimate.seen.astype(np.int32))
    spreads = {n: grids(np.sqrt((stated[:, c] ** 2).mean(axis=1))) for n, c in CHANNELS.items()}
    return Recovered(
        maps=_maps(context, estimate, table),
        confidence=grids(sure),
        spread=tuple({n: spreads[n][k] for n in CHANNELS} for k in range(len(grid.sizes))),
        seen=seen,
        views=grids(estimate.views.astype(np.int32)),
        trace=context.trace,
        residuals=residuals,
        notes=tuple(context.notes),
    )


def _maps(context: FitContext, estimate: TexelEstimate, table: MaterialTable) -> tuple[Maps, ...]:
    """A table as maps, `known` where a picture observed the texel in the light."""
    sets = zip(unpack(table, context.atlas.sizes), context.atlas.parts, strict=True)
    return tuple(replace(m, known=estimate.seen[part].reshape(m.known.shape) > 0) for m, part in sets)
