"""The texels' stage of a recovery: observations, solver, rounds and indirect light, at a feasible resolution."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import by_camera
from mistyle.core.image import resize
from mistyle.core.light import has_soft
from mistyle.core.maps import Maps
from mistyle.core.stage_progress import StageProgress
from mistyle.render.deferred.material_table import METALLIC, SOLVED, MaterialTable, pack, unpack
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.solver import prior as recover_prior
from mistyle.solver.context import DirectCaptures, FitContext, Radiance
from mistyle.solver.deviation import open_std
from mistyle.solver.indirect import Indirect, in_proportion
from mistyle.solver.journal import Journal
from mistyle.solver.schedule import Pass, rounds_since, solver_level
from mistyle.solver.table import PRIOR_MEAN, Atlas, Values, linked, scatter, scatter_to_atlas
from mistyle.solver.texels import rounds as recover_solve
from mistyle.solver.texels.level_pictures import level_captures
from mistyle.solver.texels.levenberg_marquardt import Options, Problem, Solution
from mistyle.solver.texels.observations import (
    ObservationOptions,
    TexelObservations,
    collect_observations,
    sample_image,
    with_extra_std,
)

INDIRECT_STD = 0.5  # standard deviation of an estimate of indirect light, relative to it


@dataclass(frozen=True)
class TexelEstimate:
    """The per-texel solver's result at the atlas's resolution; not `solved`: only the start.

    std            standard deviations that a texel's own observations leave (`deviation.open_std`)
    data_weight    the data's share in a texel's tilt against its neighbours', 0..1
    unconstrained  standard deviations under the observations alone, `prior.NOTHING` without any
    seen, views    number of pictures and of cameras that observed each texel in the light
    """

    table: Float[np.ndarray, "a 8"]
    std: Float[np.ndarray, "a 7"]
    data_weight: Float[np.ndarray, " a"]
    unconstrained: Float[np.ndarray, "a 7"]
    seen: Int[np.ndarray, " a"]
    views: Int[np.ndarray, " a"]
    solved: bool


@dataclass(frozen=True)
class TexelLevel:
    """The per-texel problem on the finest level with at most `solver_texels` texels.

    context   of the level, whose rows and columns are `by` times fewer than the atlas's
    observed  with the pictures' own radiance and weights
    start     start values and prior means
    problem   None where the solver is left out, or has no observation
    """

    context: FitContext
    renderer: MaterialRenderer
    by: int
    observed: TexelObservations
    start: tuple[Values, Values]
    problem: Problem | None


def texel_level(
    context: FitContext,
    renderer: Callable[[], MaterialRenderer],
    start: Sequence[Maps] | None,
    progress: Callable[[float], None],
) -> TexelLevel:
    """The level with its observations; `renderer` gives that of the atlas."""
    by, sizes, soft = level_factor(context), context.atlas.sizes, has_soft(context.captures.lights)
    if by == 1:
        return _level(context, renderer(), 1, start, progress)
    mesh = context.traced.mesh
    texels = [rasterise(mesh, p, size[0] // by) for p, size in enumerate(sizes)]
    averaged, left = level_captures(texels, context.captures, 1e9 * context.settings.memory)
    coarse = replace(
        context, texels=texels, atlas=linked(mesh, texels), captures=averaged, cameras=context.captures.cameras
    )
    if start is not None:
        start = [shrunk_maps(maps, size) for maps, size in zip(start, coarse.atlas.sizes, strict=True)]
    finer = (
        "Finer albedo comes from the pictures over the fitted shading (recover.detail)."
        if context.settings.detail
        else "Finer detail comes from the passes on whole pictures alone."
    )
    note = f"The per-texel solver ran on a level {by} times coarser than the atlas (recover.solver_texels). {finer}"
    context.notes.extend([note] * (note not in context.notes))
    # Its texels are larger than pixels, and samples under soft light are slow.
    return _level(coarse, coarse.renderer(1 if soft else None, left), by, start, progress)


def level_factor(context: FitContext) -> int:
    """The ratio of the atlas's side to that of the level."""
    covered = sum(int(c.sum()) for c in context.atlas.covered)
    by = solver_level(context.settings, covered, len(context.captures), has_soft(context.captures.lights))
    while by > 1 and any(side % by or side // by < 8 for size in context.atlas.sizes for side in size):
        by //= 2
    return by


def _level(
    context: FitContext,
    renderer: MaterialRenderer,
    by: int,
    start: Sequence[Maps] | None,
    progress: Callable[[float], None],
) -> TexelLevel:
    settings = context.settings
    options = ObservationOptions(settings.facing, settings.noise, settings.relative, settings.solver != "pictures")
    observed = collect_observations(
        context.traced, context.texels, context.captures, context.tangents, options, progress
    )
    mean = np.tile(np.array(PRIOR_MEAN, np.float32), (len(observed.texel), 1))
    first = mean.copy() if start is None else pack(start)[observed.texel, SOLVED].copy()
    mean[:, METALLIC] = first[:, METALLIC]
    problem = None
    if settings.solver != "pictures" and len(observed.observations.rgb):
        chosen = Options(settings.model, settings.metallic, floor=settings.roughness_floor)
        problem = Problem(observed.points, observed.rig, observed.observations, chosen)
    elif settings.solver != "pictures":
        note = "No texel was observed in the light: the per-texel solver was skipped."
        context.notes.extend([note] * (note not in context.notes))
    return TexelLevel(context, renderer, by, observed, (first, mean), problem)


def first_solution(level: TexelLevel, journal: Journal, progress: Callable[[float], None]) -> Solution:
    """The texels solved from the start."""
    problem = level.problem
    assert problem is not None

    def solve() -> dict[str, np.ndarray]:
        keep = kept_in(journal, "solve")
        arguments = problem, level.start, level.observed, level.context.atlas, level.context.settings, progress
        return dict(vars(recover_solve.first_solve(*arguments, keep)))

    return Solution(**journal.part("solve", solve))


def solution_after_rounds(
    level: TexelLevel,
    start: tuple[Solution, DirectCaptures],
    one: Pass,
    journal: Journal,
    progress: StageProgress,
) -> tuple[Solution, DirectCaptures]:
    """The solution after a pass of rounds from `start`, and the captures with its estimate of indirect light, if any.

    The solver restarts with each estimate: indirect light can shift roughness and metallic into a local minimum, where
    they would stay otherwise.
    """
    (solution, whole), context, problem, atlas = start, level.context, level.problem, level.context.atlas
    assert problem is not None
    direct = replace(whole, captures=context.captures)
    if one.samples:
        table = scatter_to_atlas(solution.values, level.observed, atlas)
        sampling = one.samples, context.seed + one.begin
        for k, light, _ in journalled_light(context, level.renderer, table, sampling, journal, progress.part(0, 0.4)):
            direct = direct.with_indirect(k, light)
    observed = observed_direct(level.observed, direct) if direct.indirect else level.observed
    if one.samples:
        problem.reweight(observed.observations.weight)
        problem.retarget(observed.observations.rgb)
        solution = first_solution(level, journal, progress.part(0.4, 0.7))
    rms = context.trace.setdefault("texels.rms", [])
    for number in range(one.begin, one.begin + one.steps):
        name = f"round{number}"

        def solve(solution=solution, number=number, name=name) -> dict[str, np.ndarray]:
            table = scatter_to_atlas(solution.values, level.observed, atlas)
            residuals = RoundResiduals(direct, level.renderer, level.renderer.upload(table), [], journal)
            current = recover_solve.SolverRound(rounds_since(one, number, context.settings), kept_in(journal, name))
            solved = recover_solve.another_round(
                problem, observed, atlas, solution, residuals, context.settings, current
            )
            return vars(solved) | {"rms": np.array(np.sqrt(np.mean(residuals.squares)))}

        arrays = dict(journal.part(name, solve))
        rms.append(float(arrays.pop("rms")))
        solution = Solution(**arrays)
        progress(0.7 + 0.3 * (number + 1 - one.begin) / one.steps)
    return solution, replace(whole, indirect=direct.indirect)


def estimate_of(level: TexelLevel, solution: Solution | None, context: FitContext) -> TexelEstimate:
    """The solver's result at the resolution of `context`; that of the start without a solution."""
    observed, atlas, (first, mean) = level.observed, level.context.atlas, level.start
    std = np.tile(np.array(recover_prior.PRIOR_SPREAD, np.float32), (len(mean), 1))
    if solution is None:
        nothing = np.full(mean.shape, recover_prior.NOTHING, np.float32)
        estimate = _on_atlas(observed, atlas, (first, std, np.ones(len(mean), np.float32), nothing), False)
    else:
        bad = ~np.isfinite(solution.values).all(axis=1, keepdims=True)
        if bad.any():
            note = f"{int(bad.sum())} texels were not finite after the per-texel solver and were reset."
            context.notes.extend([note] * (note not in context.notes))
        values = np.where(bad, mean, solution.values)
        assert level.problem is not None
        std = np.where(bad, std, open_std(level.problem, solution, observed, atlas, context.settings.joint > 0))
        weight = recover_prior.data_weight(solution, observed)
        unconstrained = recover_prior.observation_std(solution, observed, atlas)
        estimate = _on_atlas(observed, atlas, (values, std, weight, unconstrained), True)
    return estimate if level.by == 1 else _upsampled(estimate, atlas, level.by)


def kept_in(journal: Journal, prefix: str) -> recover_solve.Keep:
    """Solutions as parts of the journal, named under `prefix`."""

    def keep(name: str, solve: Callable[[], Solution]) -> Solution:
        return Solution(**journal.part(f"{prefix}.{name}", lambda: dict(vars(solve()))))

    return keep


def _upsampled(estimate: TexelEstimate, atlas: Atlas, by: int) -> TexelEstimate:
    """The estimate of `atlas`, upsampled to one with `by` times as many rows and columns."""
    e = estimate
    table, std, data_weight, unconstrained, seen, views = (
        np.concatenate(
            [
                _enlarged(values[part].reshape(*size, -1), by).reshape(size[0] * size[1] * by * by, -1)
                for part, size in zip(atlas.parts, atlas.sizes, strict=True)
            ]
        )
        for values in (e.table, e.std, e.data_weight, e.unconstrained, e.seen, e.views)
    )
    return TexelEstimate(
        table.astype(np.float32), std, data_weight[:, 0], unconstrained, seen[:, 0], views[:, 0], e.solved
    )


def _enlarged(values: np.ndarray, by: int) -> np.ndarray:
    """Upsampled values: floats are interpolated, counts are repeated."""
    if values.dtype.kind == "f":
        return resize(values, (values.shape[0] * by, values.shape[1] * by))
    return np.repeat(np.repeat(values, by, axis=0), by, axis=1)


def shrunk_maps(maps: Maps, size: tuple[int, int]) -> Maps:
    """The maps at another size, nothing known."""
    fields = {name: resize(getattr(maps, name), size) for name in ("albedo", "normal", "roughness", "metallic")}
    return Maps(known=np.zeros(size, bool), **fields)


@dataclass(frozen=True)
class RoundResiduals:
    """A function of k: reference minus render of picture k, 0 at invalid pixels; `squares` gets its mean square."""

    direct: DirectCaptures
    renderer: MaterialRenderer
    table: Any
    squares: list[float]
    journal: Journal

    def __call__(self, k: int) -> Float[np.ndarray, "h w 3"]:
        self.journal.poll()
        rgb, mask = self.direct.load(k)
        residual = np.nan_to_num(rgb) - self.renderer.image(self.table, k)
        residual = np.where(mask[..., None], residual, 0).astype(np.float32)
        self.squares.append(float((residual**2).mean()))
        return residual


def _on_atlas(
    observed: TexelObservations, atlas: Atlas, of_texels: tuple[Values, Values, np.ndarray, Values], solved: bool
) -> TexelEstimate:
    """The estimate (values, std, data_weight, unconstrained) `of_texels`, scattered to the whole atlas."""
    values, std, data_weight, unconstrained = of_texels
    return TexelEstimate(
        scatter_to_atlas(values, observed, atlas),
        scatter(std, observed, atlas, np.array(recover_prior.PRIOR_SPREAD, np.float32)),
        scatter(data_weight, observed, atlas, 1),
        scatter(unconstrained, observed, atlas, recover_prior.NOTHING),
        scatter(observed.seen.astype(np.int32), observed, atlas, 0),
        scatter(observed.views.astype(np.int32), observed, atlas, 0),
        solved,
    )


def estimate_indirect(
    context: FitContext,
    renderer: MaterialRenderer,
    table: MaterialTable,
    sampling: tuple[int, int],
    progress: Callable[[float], None],
    vectors: bool = False,
    skip: Collection[int] = (),
) -> Iterator[tuple[int, Radiance, Float[np.ndarray, "h w 9"] | None]]:
    """Each picture's number, its indirect light under the maps of `table`, and with `vectors` its vector irradiance
    (`Indirect.pictures`); camera by camera, without cameras whose pictures are all in `skip`. `sampling`:
    samples a pixel and seed."""
    settings, captures, done, (samples, seed) = context.settings, context.captures, 0, sampling
    uploaded, maps = renderer.upload(table), unpack(table, context.atlas.sizes)
    scene = Indirect(context.traced.mesh, maps, model=settings.model, frame=settings.frame)
    for group in by_camera(captures.cameras):
        done += len(group)
        if all(k in skip for k in group):
            continue
        many = [captures.lights[k] for k in group]
        request = (context.cameras or captures.cameras)[group[0]], many, samples, seed + len(captures) * group[0]
        for k, (light, vector) in zip(group, scene.pictures(*request, vectors=vectors), strict=True):
            rgb, mask = captures.load(k)
            counts = (mask & np.isfinite(rgb).all(axis=-1))[..., None]
            yield k, in_proportion(light, renderer.image(uploaded, k) * counts, np.where(counts, rgb, 0)), vector
        progress(done / len(captures))


def journalled_light(
    context: FitContext,
    renderer: MaterialRenderer,
    table: MaterialTable,
    sampling: tuple[int, int],
    journal: Journal,
    progress: Callable[[float], None],
) -> Iterator[tuple[int, Radiance, None]]:
    """`estimate_indirect`, each picture's light a part of the journal."""
    known = journal.named("light.")
    done: dict[str, Any] = {"skip": {int(name.split(".")[1]) for name in known}} if known else {}
    for name in known:
        yield int(name.split(".")[1]), journal.part(name, dict)["light"], None
    for k, light, _ in estimate_indirect(context, renderer, table, sampling, progress, **done):
        yield k, journal.part(f"light.{k}", lambda light=light: {"light": light})["light"], None


def observed_direct(observed: TexelObservations, direct: DirectCaptures) -> TexelObservations:
    """The observations without indirect light, whose uncertainty reduces their weights."""
    rgb, weight = observed.observations.rgb.copy(), observed.observations.weight.copy()
    for k, samples in enumerate(observed.per_image):
        if not len(samples.rows):
            continue
        rgb[samples.rows] = sample_image(np.nan_to_num(direct.load(k)[0]), samples)
        if k in direct.indirect:
            taken = sample_image(direct.enlarged(k), samples).max(axis=1)
            weight[samples.rows] = with_extra_std(weight[samples.rows], INDIRECT_STD * taken)
    return replace(observed, observations=replace(observed.observations, rgb=rgb, weight=weight))
