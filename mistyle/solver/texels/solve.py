"""The texels' stage of a recovery: observations, solver, rounds and indirect light, at a feasible resolution."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import by_camera
from mistyle.core.image import resize
from mistyle.core.light import has_soft
from mistyle.core.maps import Maps
from mistyle.core.stage_progress import StageProgress
from mistyle.render.deferred.material_table import METALLIC, SOLVED, MaterialTable
from mistyle.solver import prior as recover_prior
from mistyle.solver.context import DirectCaptures, FitContext, Radiance
from mistyle.solver.settings import all_rounds, estimates
from mistyle.solver.table import PRIOR_MEAN, Atlas, Values, linked, scatter, scatter_to_atlas
from mistyle.solver.texels import rounds as recover_solve
from mistyle.solver.texels.levenberg_marquardt import Options, Problem, Solution
from mistyle.solver.texels.observations import (
    ObservationOptions,
    TexelObservations,
    collect_observations,
    sample_image,
    with_extra_std,
)

if TYPE_CHECKING:
    from mistyle.render.deferred.renderer import MaterialRenderer

SOFT_COST = 64  # approximate run time of a texel under a sky, relative to one light
INDIRECT_STD = 0.5  # standard deviation of an estimate of indirect light, relative to it


@dataclass(frozen=True)
class TexelEstimate:
    """The per-texel solver's result at the atlas's resolution; not `solved`: only the start.

    std            standard deviations under observations and priors
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


def solve_level(
    context: FitContext, renderer: "MaterialRenderer", start: Sequence[Maps] | None, progress: StageProgress
) -> tuple[TexelEstimate, DirectCaptures]:
    """`solve_texels` on the finest level with at most `solver_texels` texels, upsampled to the atlas.

    `renderer` renders tables of the atlas.
    """
    by, settings, sizes = 1, context.settings, context.atlas.sizes
    sides = [side for size in sizes for side in size]
    most = settings.solver_texels / (SOFT_COST if has_soft(context.captures.lights) else 1)
    while sum(int(c.sum()) for c in context.atlas.covered) / by**2 > most:
        if any(side % (2 * by) or side // (2 * by) < 8 for side in sides):
            break
        by *= 2
    if by == 1 or settings.solver == "pictures":
        return solve_texels(context, renderer, start, progress)
    mesh = context.traced.mesh
    texels = [rasterise(mesh, p, size[0] // by) for p, size in enumerate(sizes)]
    coarse = replace(context, texels=texels, atlas=linked(mesh, texels))
    if start is not None:
        start = [_shrunk(maps, size) for maps, size in zip(start, coarse.atlas.sizes, strict=True)]
    estimate, direct = solve_texels(coarse, coarse.renderer(), start, progress)
    context.notes.append(f"The per-texel solver ran on a level {by} times coarser than the atlas.")
    return _upsampled(estimate, coarse.atlas, by), direct


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


def _shrunk(maps: Maps, size: tuple[int, int]) -> Maps:
    fields = {name: resize(getattr(maps, name), size) for name in ("albedo", "normal", "roughness", "metallic")}
    return Maps(known=np.zeros(size, bool), **fields)


def solve_texels(
    context: FitContext, renderer: "MaterialRenderer", start: Sequence[Maps] | None, progress: StageProgress
) -> tuple[TexelEstimate, DirectCaptures]:
    """The per-texel solver and its rounds, and the captures with the last estimate of their indirect light.

    The solver restarts with each estimate: indirect light can shift roughness and metallic into a local minimum, where
    they would stay otherwise.
    """
    from mistyle.render.deferred.material_table import pack

    settings, atlas = context.settings, context.atlas
    options = ObservationOptions(settings.facing, settings.noise, settings.relative, settings.solver != "pictures")
    observed = collect_observations(
        context.traced, context.texels, context.captures, context.tangents, options, progress.part(0, 0.3)
    )
    mean = np.tile(np.array(PRIOR_MEAN, np.float32), (len(observed.texel), 1))
    first = mean.copy() if start is None else pack(start)[observed.texel, SOLVED].copy()
    mean[:, METALLIC] = first[:, METALLIC]
    std, direct = (
        np.tile(np.array(recover_prior.PRIOR_SPREAD, np.float32), (len(mean), 1)),
        DirectCaptures(context.captures),
    )
    if settings.solver == "pictures" or not len(observed.observations.rgb):
        if settings.solver != "pictures":
            context.notes.append("No texel was observed in the light: the per-texel solver was skipped.")
        nothing = np.full(mean.shape, recover_prior.NOTHING, np.float32)
        return _on_atlas(observed, atlas, (first, std, np.ones(len(mean), np.float32), nothing), False), direct
    problem = Problem(
        observed.points, observed.rig, observed.observations,
        Options(settings.model, settings.metallic, floor=settings.roughness_floor),
    )  # fmt: skip

    def solved_anew(done: Callable[[float], None]) -> Solution:
        return recover_solve.first_solve(problem, (first, mean), observed, atlas, settings, done)

    solution, observed, direct = _rounds(context, renderer, problem, solved_anew, observed, progress)
    bad = ~np.isfinite(solution.values).all(axis=1, keepdims=True)
    if bad.any():
        context.notes.append(f"{int(bad.sum())} texels were not finite after the per-texel solver and were reset.")
    values = np.where(bad, mean, solution.values)
    std = np.where(bad, std, solution.spread * recover_prior.inflation(solution, observed))
    weight = recover_prior.data_weight(solution, observed)
    unconstrained = recover_prior.observation_std(solution, observed, atlas)
    return _on_atlas(observed, atlas, (values, std, weight, unconstrained), True), direct


def _rounds(
    context: FitContext,
    renderer: "MaterialRenderer",
    problem: Problem,
    solved_anew: Callable[[Callable[[float], None]], Solution],
    observed: TexelObservations,
    progress: StageProgress,
) -> tuple[Solution, TexelObservations, DirectCaptures]:
    """The solution after all rounds, and observations and captures after the last estimate of indirect light.

    `solved_anew` solves from the start, first and after each estimate.
    """
    settings, atlas, pictures = context.settings, context.atlas, len(context.captures)
    weight, samples = observed.observations.weight, estimates(settings, pictures)[0]
    direct = DirectCaptures(context.captures)
    total, solution = all_rounds(settings, pictures), solved_anew(progress.part(0.3, 0.5))
    for number in range(total):
        part = progress.part(0.5 + 0.5 * number / total, 0.5 + 0.5 * (number + 1) / total)
        table = scatter_to_atlas(solution.values, observed, atlas)
        if 0 < number <= settings.rounds * len(samples) and number % settings.rounds == 0:
            sampling = samples[number // settings.rounds - 1], context.seed + number
            for k, light, _ in estimate_indirect(context, renderer, table, sampling, part.part(0, 0.4)):
                direct = direct.with_indirect(k, light)
            observed = _observed_direct(observed, weight, direct)
            problem.reweight(observed.observations.weight)
            problem.retarget(observed.observations.rgb)
            solution = solved_anew(part.part(0.4, 0.8))
            table = scatter_to_atlas(solution.values, observed, atlas)
        residuals = RoundResiduals(direct, renderer, renderer.upload(table), [])
        solution = recover_solve.another_round(problem, observed, atlas, solution, residuals, settings, number)
        context.trace.setdefault("texels.rms", []).append(float(np.sqrt(np.mean(residuals.squares))))
        part(1.0)
    return solution, observed, direct


@dataclass(frozen=True)
class RoundResiduals:
    """A function of k: reference minus render of picture k, 0 at invalid pixels; `squares` gets its mean square."""

    direct: DirectCaptures
    renderer: "MaterialRenderer"
    table: Any
    squares: list[float]

    def __call__(self, k: int) -> Float[np.ndarray, "h w 3"]:
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
        scatter(observed.seen, observed, atlas, 0),
        scatter(observed.views, observed, atlas, 0),
        solved,
    )


def estimate_indirect(
    context: FitContext,
    renderer: "MaterialRenderer",
    table: MaterialTable,
    sampling: tuple[int, int],
    progress: Callable[[float], None],
    vectors: bool = False,
) -> Iterator[tuple[int, Radiance, Float[np.ndarray, "h w 9"] | None]]:
    """Each picture's number, its indirect light under the maps of `table`, and with `vectors` its vector irradiance
    (`Indirect.pictures_and_vectors`); camera by camera. `sampling`: samples a pixel and seed."""
    from mistyle.render.deferred.material_table import unpack
    from mistyle.solver.indirect import Indirect, in_proportion

    settings, captures, done, (samples, seed) = context.settings, context.captures, 0, sampling
    uploaded, maps = renderer.upload(table), unpack(table, context.atlas.sizes)
    scene = Indirect(context.traced.mesh, maps, model=settings.model, frame=settings.frame)
    for group in by_camera(captures.cameras):
        many = [captures.lights[k] for k in group]
        request = captures.cameras[group[0]], many, samples, seed + len(captures) * group[0]
        lights: list[tuple[np.ndarray, Any]]
        lights = (
            scene.pictures_and_vectors(*request) if vectors else [(light, None) for light in scene.pictures(*request)]
        )
        for k, (light, vector) in zip(group, lights, strict=True):
            rgb, mask = captures.load(k)
            counts = (mask & np.isfinite(rgb).all(axis=-1))[..., None]
            yield k, in_proportion(light, renderer.image(uploaded, k) * counts, np.where(counts, rgb, 0)), vector
        done += len(group)
        progress(done / len(captures))


def _observed_direct(
    observed: TexelObservations, weight: Float[np.ndarray, " o"], direct: DirectCaptures
) -> TexelObservations:
    """The observations without indirect light.

    `weight` are weights of the original pictures; the uncertainty of indirect light reduces them.
    """
    rgb, weight = observed.observations.rgb.copy(), weight.copy()
    for k, samples in enumerate(observed.per_image):
        if not len(samples.rows):
            continue
        rgb[samples.rows] = sample_image(np.nan_to_num(direct.load(k)[0]), samples)
        if k in direct.indirect:
            taken = sample_image(direct.enlarged(k), samples).max(axis=1)
            weight[samples.rows] = with_extra_std(weight[samples.rows], INDIRECT_STD * taken)
    return replace(observed, observations=replace(observed.observations, rgb=rgb, weight=weight))
