"""The texels' part of a recovery: observations, solver, rounds and indirect light, at a level that fits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.camera import by_camera
from mistyle.core.capture import Captures
from mistyle.core.image import resize
from mistyle.core.light import has_soft
from mistyle.core.maps import Maps, Texels
from mistyle.render.indirect import enlarged
from mistyle.render.texel_lm import Options, Problem, Solution
from mistyle.stages import recover_prior, recover_solve
from mistyle.stages.recover_check import trust
from mistyle.stages.recover_observe import Gathered, fetch, less_sure
from mistyle.stages.recover_settings import RecoverSettings, all_rounds, estimates
from mistyle.stages.recover_table import PRIOR_MEAN, Atlas, linked, placed, spread_out
from mistyle.stages.texels import rasterise

SOFT_COST = 64  # times as long as under one light a texel takes under a sky, nearly
DOUBT = 0.5  # standard deviation of an estimate of indirect light, relative to it


@dataclass(frozen=True)
class Work:
    """What all parts of one fit share."""

    traced: Any
    tangents: np.ndarray | None
    texels: Sequence[Texels]
    where: Atlas
    captures: Captures
    settings: RecoverSettings
    notes: list[str]


@dataclass(frozen=True)
class Found:
    """What the texels found out by themselves, at the atlas's resolution; not `solved`: only where they start.

    `decided` is the share of a texel's tilt, 0..1, that its own pictures decide and not its neighbours; `noise` the
    standard deviations of what they tell, `recover_prior.NOTHING` where there are none.
    """

    table: Float[np.ndarray, "a 8"]
    spread: Float[np.ndarray, "a 7"]
    decided: Float[np.ndarray, " a"]
    noise: Float[np.ndarray, "a 7"]
    seen: Int[np.ndarray, " a"]
    views: Int[np.ndarray, " a"]
    solved: bool


def solve_level(work: Work, shade, start, indirect: dict[int, np.ndarray], seed: int, trace, progress) -> Found:
    """`solve_texels` on the finest level with at most `solver_texels` texels, enlarged to the atlas."""
    from mistyle.render.shade import Shade

    by, settings = 1, work.settings
    sides = [side for size in work.where.sizes for side in size]
    most = settings.solver_texels / (SOFT_COST if has_soft(work.captures.lights) else 1)
    while sum(int(c.sum()) for c in work.where.covered) / by**2 > most:
        if any(side % (2 * by) or side // (2 * by) < 8 for side in sides):
            break
        by *= 2
    if by == 1 or settings.solver == "pictures":
        return solve_texels(work, shade, start, indirect, seed, trace, progress)
    mesh = shade.traced.mesh
    texels = [rasterise(mesh, p, size[0] // by) for p, size in enumerate(work.where.sizes)]
    where = linked(mesh, texels)
    small = Shade(
        shade.traced, work.captures, where.sizes, model=settings.model, frame=settings.frame,
        subsamples=settings.subsamples, shadows=settings.shadows, memory=settings.memory * 1e9,
        weights=trust(work.captures, indirect), gradients=False,
    )  # fmt: skip
    if start is not None:
        start = [_shrunk(maps, size) for maps, size in zip(start, where.sizes, strict=True)]
    found = solve_texels(replace(work, texels=texels, where=where), small, start, indirect, seed, trace, progress)
    work.notes.append(f"Texels were solved one by one on a level {by} times coarser than the atlas.")
    large = [
        np.concatenate(
            [
                _enlarged(values[part].reshape(*size, -1), by).reshape(size[0] * size[1] * by * by, -1)
                for part, size in zip(where.parts, where.sizes, strict=True)
            ]
        )
        for values in (found.table, found.spread, found.decided, found.noise, found.seen, found.views)
    ]
    table, spread, decided, noise, seen, views = large
    return Found(table.astype(np.float32), spread, decided[:, 0], noise, seen[:, 0], views[:, 0], found.solved)


def _enlarged(values: np.ndarray, by: int) -> np.ndarray:
    """Interpolated where they are numbers, repeated where they count."""
    if values.dtype.kind == "f":
        return resize(values, (values.shape[0] * by, values.shape[1] * by))
    return np.repeat(np.repeat(values, by, axis=0), by, axis=1)


def _shrunk(maps: Maps, size: tuple[int, int]) -> Maps:
    fields = {name: resize(getattr(maps, name), size) for name in ("albedo", "normal", "roughness", "metallic")}
    return Maps(known=np.zeros(size, bool), **fields)


def solve_texels(
    work: Work,
    shade,
    start: Sequence[Maps] | None,
    indirect: dict[int, np.ndarray],
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
) -> Found:
    """The per-texel solver and its rounds, with indirect light taken off the pictures in between.

    With each estimate it begins anew: roughness and metallic that light between surfaces made look right would else
    stay where they are, minima of another cost.
    """
    from mistyle.render.shade import pack
    from mistyle.stages.recover_observe import gather

    settings, where = work.settings, work.where
    gathered = gather(
        work.traced, work.texels, work.captures, work.tangents,
        facing=settings.facing, noise=settings.noise, relative=settings.relative,
        skies=settings.solver != "pictures", progress=lambda done: progress(0.3 * done),
    )  # fmt: skip
    mean = np.tile(np.array(PRIOR_MEAN, np.float32), (len(gathered.texel), 1))
    first = mean.copy() if start is None else pack(start)[gathered.texel, :7].copy()
    mean[:, 6] = first[:, 6]
    spread = np.tile(np.array(recover_prior.PRIOR_SPREAD, np.float32), (len(mean), 1))
    if settings.solver == "pictures" or not len(gathered.observations.rgb):
        if settings.solver != "pictures":
            work.notes.append("No texel was observed in the light: texels were not solved one by one.")
        noise = np.full(mean.shape, recover_prior.NOTHING, np.float32)
        return _everywhere(gathered, where, (first, spread, np.ones(len(mean), np.float32), noise), False)
    problem = Problem(
        gathered.points, gathered.rig, gathered.observations,
        Options(settings.model, settings.metallic, floor=settings.roughness_floor),
    )  # fmt: skip

    def begun(heard: Callable[[float], None]) -> Solution:
        return recover_solve.first_solve(problem, first, mean, gathered.seen, settings, heard)

    solution, gathered = _rounds(work, shade, problem, begun, gathered, indirect, seed, trace, progress)
    bad = ~np.isfinite(solution.values).all(axis=1, keepdims=True)
    if bad.any():
        work.notes.append(f"{int(bad.sum())} texels ended as no numbers in the per-texel solver and were reset.")
    values = np.where(bad, mean, solution.values)
    spread = np.where(bad, spread, solution.spread * recover_prior.inflation(solution, gathered))
    told = recover_prior.decided(solution, gathered), recover_prior.told(solution, gathered, where)
    return _everywhere(gathered, where, (values, spread, *told), True)


def _rounds(
    work: Work,
    shade,
    problem: Problem,
    begun: Callable[[Callable[[float], None]], Solution],
    gathered: Gathered,
    indirect: dict[int, np.ndarray],
    seed: int,
    trace: dict[str, list[float]],
    progress: Callable[[float], None],
) -> tuple[Solution, Gathered]:
    """What all rounds end with, and the observations as they are after the last estimate of indirect light; `begun`
    solves from the start, at first and after each estimate."""
    settings, where, pictures = work.settings, work.where, len(work.captures)
    sure, estimated = gathered.observations.weight, estimates(settings, pictures)[0]
    total, solution = all_rounds(settings, pictures), begun(lambda done: progress(0.3 + 0.2 * done))
    for number in range(total):

        def heard(done: float, number=number) -> None:
            progress(0.5 + 0.5 * (number + done) / total)

        table = spread_out(solution.values, gathered, where)
        if 0 < number <= settings.rounds * len(estimated) and number % settings.rounds == 0:
            samples = estimated[number // settings.rounds - 1]
            take_off_indirect(work, shade, table, indirect, samples, seed + number, lambda d, f=heard: f(0.4 * d))
            gathered = direct(gathered, sure, work.captures, indirect)
            problem.reweight(gathered.observations.weight)
            problem.retarget(gathered.observations.rgb)
            solution = begun(lambda d, f=heard: f(0.4 + 0.4 * d))
            table = spread_out(solution.values, gathered, where)
        shade.table = table
        lost: list[float] = []

        def differences(k: int, lost=lost) -> np.ndarray:
            rgb, mask = work.captures.load(k)
            wrong = np.where(mask[..., None], np.nan_to_num(rgb) - shade.image(k), 0).astype(np.float32)
            lost.append(float((wrong**2).mean()))
            return wrong

        solution = recover_solve.another_round(problem, gathered, where, solution, differences, settings, number)
        trace.setdefault("texels.rms", []).append(float(np.sqrt(np.mean(lost))))
        heard(1.0)
    return solution, gathered


def _everywhere(gathered: Gathered, where: Atlas, of_texels: tuple[np.ndarray, ...], solved: bool) -> Found:
    """What is known `of_texels` (values, spread, decided, noise) for the whole atlas."""
    values, spread, decided, noise = of_texels
    return Found(
        spread_out(values, gathered, where),
        placed(spread, gathered, where, np.array(recover_prior.PRIOR_SPREAD, np.float32)),
        placed(decided, gathered, where, 1),
        placed(noise, gathered, where, recover_prior.NOTHING),
        placed(gathered.seen, gathered, where, 0),
        placed(gathered.views, gathered, where, 0),
        solved,
    )


def take_off_indirect(
    work: Work,
    shade,
    table: np.ndarray,
    indirect: dict[int, np.ndarray],
    samples: int,
    seed: int,
    progress: Callable[[float], None],
    vectors: Callable[[int, np.ndarray], None] | None = None,
) -> None:
    """Estimate the indirect light of every picture with the maps found so far; `indirect` then holds it. Leaves the
    table in `shade`. `vectors` gets each picture's vector irradiance (`Indirect.pictures_and_vectors`), when `indirect`
    has its light."""
    from mistyle.render.indirect import Indirect, in_proportion, retarget
    from mistyle.render.shade import unpack

    settings, captures, done = work.settings, work.captures, 0
    shade.table = table
    weights, maps = trust(captures, indirect), unpack(table, work.where.sizes)
    scene = Indirect(shade.traced.mesh, maps, model=settings.model, frame=settings.frame)
    for group in by_camera(captures.cameras):
        many = [captures.lights[k] for k in group]
        asked = captures.cameras[group[0]], many, samples, seed + len(captures) * group[0]
        found: list[tuple[np.ndarray, Any]]
        found = scene.pictures_and_vectors(*asked) if vectors else [(light, None) for light in scene.pictures(*asked)]
        for k, (light, vector) in zip(group, found, strict=True):
            indirect.pop(k, None)
            rgb, mask = captures.load(k)
            counts = (mask & np.isfinite(rgb).all(axis=-1))[..., None]
            indirect[k] = in_proportion(light, shade.image(k) * counts, np.where(counts, rgb, 0))
            retarget(shade, k, captures.load(k)[0], weights(k))
            if vectors:
                vectors(k, vector)
        done += len(group)
        progress(done / len(captures))


def direct(
    gathered: Gathered, sure: Float[np.ndarray, " o"], captures: Captures, indirect: dict[int, np.ndarray]
) -> Gathered:
    """The same observations without the light between surfaces that was taken off the pictures. Their weights are
    `sure`, those of pictures as they came, less by the doubt about that light."""
    rgb, weight = gathered.observations.rgb.copy(), sure.copy()
    for k, sighting in enumerate(gathered.sightings):
        if not len(sighting.rows):
            continue
        rgb[sighting.rows] = fetch(np.nan_to_num(captures.load(k)[0]), sighting)
        if k in indirect:
            taken = fetch(enlarged(indirect[k], captures.cameras[k].size), sighting).max(axis=1)
            weight[sighting.rows] = less_sure(weight[sighting.rows], DOUBT * taken)
    return replace(gathered, observations=replace(gathered.observations, rgb=rgb, weight=weight))
