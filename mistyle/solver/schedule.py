"""The passes of a recovery: numbered units of work, each of which improves the maps, and the seconds that each takes.

A recovery may end after any pass; the passes before it do not depend on where it ends. Plan, progress and time limits
share the seconds. They are of two quiet cores of an EPYC, from CPU seconds of the castle's photographs and from
`benchmarks/fit_speed/texels.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from mistyle.solver.settings import (
    LARGE,
    RecoverSettings,
    all_rounds,
    descent_steps,
    estimates,
    joint_estimates,
    joint_steps,
    measured_subsamples,
    passes,
)

Kind = Literal["solve", "rounds", "pictures", "joint", "polish"]
STARTS, RESTARTED, CONTINUED = 3, 42, 6  # starts of a solve; steps of a round with restarts, and of one without
SOFT_COST = 16  # approximate run time of a texel under a sky, relative to one light
SKY_CELLS = 128
MEASURED_PATHS = 16  # samples a pixel of the indirect light in the pictures that measure a fit
MOST = 512  # pixels along the longer side of an estimate of indirect light
# The object's share of a picture, the covered share of the atlas, and the share of that which one picture sees.
SHOWN, COVERED, SEEN = 0.3, 0.55, 0.35
FILLED = 0.6  # the object's share of a picture without alpha or mask, and the share of its surface there
OBSERVED = 2**26  # most observations of the per-texel solver, of texels of which one picture sees SEEN
# Texels of a set that are smoothed at once. Joint steps need JOINT_TEXEL bytes of `recover.memory` for each further
# texel of the atlas, and JOINT_PIXEL or more for each pixel of the object.
WHOLE, JOINT_TEXEL, JOINT_PIXEL = 2**22, 750, 240
JUDGES = 48  # pictures whose loss accepts or rejects the steps on whole pictures
RESTARTS = 3  # rounds in which texels also start from their neighbours' values
CLASS_ROUNDS = 2  # rounds after each solve from the start in which metal and dielectric are both tried

# Seconds of two cores, per unit named; those of soft light are of one of its cells.
PER_OBSERVATION, PER_CELL = 9e-9, 3.3e-9  # a texel in a picture, in one step of the per-texel solver
PER_OBSERVED = 4e-7  # a texel in a picture in a round, without the solver's steps
PER_SEEN, PER_OPEN = 4.5e-7, 8e-7  # a pixel where texels are observed, and a texel and a cell, once
PER_PICTURE, PER_SOFT_PICTURE = 5e-4, 0.008  # a picture, rendered
PER_TRACED, PER_SOFT_TRACED = 0.01, 0.1  # a picture's kernels, recorded at its first rendering
PER_LOADED = 7e-8  # a pixel of a picture, loaded and compared
PER_SAMPLE, PER_SAMPLE_CELL = 4.5e-9, 1.5e-9  # a sample of a pixel, rendered
PER_COLLECTED = 2e-7  # a sample of a pixel, collected once
CACHED = 77  # bytes of a cached sample
PER_STEP, PER_STEP_TEXEL, GRADIENT = 1.2e-3, 5e-8, 3.5  # a step of Adam, a covered texel in it, and its sample's factor
PER_VISIBILITY = 1.3e-8  # a sample and a cell, once
PER_PATH, PER_SOFT_PATH, PER_MISS = 1.3e-7, 3e-7, 5e-9  # a path of indirect light from the object, and from beside it
SHARED = 0.7  # of a path's seconds, what pictures of one camera share
PER_LIGHT_PICTURE, PER_LIGHT, PER_VECTOR = 0.01, 7e-7, 1.7e-6  # a picture and a pixel of such an estimate, smoothed
PER_SMOOTHED = 1.1e-5  # a covered texel in one smoothing pass
# In a joint step: renderings of all pictures, a pixel of the object, and a texel. Its setup: a sample.
JOINT_RENDERINGS, PER_JOINT, PER_JOINT_TEXEL, PER_JOINT_SAMPLE = 6, 4.4e-6, 1.8e-5, 1.9e-7
PER_DETAIL = 4e-6  # a covered texel in a picture, for the albedo's detail


@dataclass(frozen=True)
class Pass:
    """One pass. `begin`, `steps`: rounds, steps of Adam, joint steps, or steps of the polish; `samples`: of a pixel in
    the estimate of indirect light before it, 0 for none; `anew`: whether the texels are solved from the start."""

    kind: Kind
    begin: int = 0
    steps: int = 0
    samples: int = 0
    anew: bool = False


class Visible(NamedTuple):
    """Means over the pictures: the share of their pixels that shows the object in the light, the share of its surface
    that a picture observes, the share of pixels that shows the object at all, and the number of cameras over that of
    pictures; see `visible.py`."""

    shown: float = SHOWN
    seen: float = SEEN
    whole: float = SHOWN
    cameras: float = 1.0


TYPICAL = Visible()


@dataclass(frozen=True)
class Size:
    """Counts that the seconds are proportional to.

    texels        covered texels of the atlas; `solved`: those of the per-texel solver's level
    observations  of the solved texels in all pictures
    pixels        of all pictures; `coarse`: of those of the per-texel solver; `shown`: of the object, in all pictures
    samples       rendered samples of all pictures; `rough`: those in rounds of the per-texel solver
    paths         pixels of all estimates of indirect light; `whole`: the share that shows the object
    cameras       over pictures: those of one camera share their paths
    cells         of soft light, 0 without
    """

    pictures: int
    texels: float
    solved: float
    observations: float
    pixels: float
    coarse: float
    samples: float
    rough: float
    paths: float
    whole: float
    cameras: float
    cells: int

    @property
    def shown(self) -> float:
        return self.whole * self.pixels


def schedule(settings: RecoverSettings, pictures: int, solved: bool) -> list[Pass]:
    """All passes in order; `solved` is False where the per-texel solver is left out or has no observation."""
    descends, result = descent_steps(settings) > 0, []
    if solved:
        among, rounds = estimates(settings, pictures)[0], settings.rounds
        result.append(Pass("solve", anew=True))
        for k, begin in enumerate(range(0, all_rounds(settings, pictures), max(rounds, 1))):
            samples = among[k - 1] if 0 < k <= len(among) else 0
            result.append(Pass("rounds", begin, rounds, samples, samples > 0))
    if descends:
        begin = 0
        for steps, samples in passes(settings, pictures) if solved else [(settings.iterations, 0)]:
            result.append(Pass("pictures", begin, steps, samples))
            begin += steps
        if solved and settings.joint:
            again = joint_estimates(settings) or (0,)
            result += [Pass("joint", k, settings.joint, samples) for k, samples in enumerate(again)]
    return [*result, *([Pass("polish", 0, settings.polish)] if settings.polish else [])]


def rounds_since(one: Pass, number: int, settings: RecoverSettings) -> int:
    """Rounds of pass `one` before round `number`: with metallic those since the last solve from the start."""
    return number - one.begin if settings.metallic and one.anew else number


def size_from(
    settings: RecoverSettings, pixels: Sequence[int], covered: float, soft: bool, visible: Visible = TYPICAL
) -> Size:
    """Counts of a fit to pictures of so many pixels and an atlas with `covered` texels."""
    by = solver_level(settings, covered, len(pixels), soft)
    solved = covered / by**2
    subsamples = settings.soft_subsamples if soft else settings.subsamples
    area = visible.shown * sum(pixels)
    coarse = sum(n / by**2 if n > LARGE else n for n in pixels)
    return Size(
        len(pixels),
        covered,
        solved,
        visible.seen * solved * len(pixels),
        sum(pixels),
        coarse,
        area * subsamples,
        visible.shown * coarse * (1 if soft and by > 1 else subsamples),
        sum(min(n, MOST**2) for n in pixels),
        visible.whole,
        visible.cameras,
        SKY_CELLS if soft else 0,
    )


def solver_level(settings: RecoverSettings, covered: float, pictures: int, soft: bool) -> int:
    """How many times coarser than the atlas the per-texel solver's level is: it has at most `solver_texels` texels, and
    OBSERVED observations."""
    most = settings.solver_texels / (SOFT_COST if soft else 1)
    most, by = min(most, OBSERVED / (SEEN * max(pictures, 1))), 1
    while settings.solver != "pictures" and covered / by**2 > most:
        by *= 2
    return by


def joint_bytes(texels: float, pixels: float = 0) -> float:
    """Bytes of `recover.memory` that joint steps need at least, for an atlas of so many texels and so many pixels of
    the object. The budget of a fit holds what the first WHOLE texels need."""
    return JOINT_TEXEL * max(0.0, texels - WHOLE) + JOINT_PIXEL * pixels


def runnable(settings: RecoverSettings, soft: bool, texels: float, pixels: float = 0) -> RecoverSettings:
    """The settings that a fit to an atlas of so many texels runs with. Under soft light it has no joint steps, which
    would be slow, and at most `soft_bounces`; else joint steps where they are planned and `memory` suffices.

    The plan estimates the object's `pixels`; a fit decides again when it knows them (`joint/pixels.py`).
    """
    if soft:
        return settings.model_copy(update={"joint": 0, "bounces": min(settings.bounces, settings.soft_bounces)})
    fits = joint_bytes(texels, pixels) <= 1e9 * settings.memory
    return settings.model_copy(update={"joint": joint_steps(settings) if fits else 0})


def observing_seconds(size: Size) -> float:
    """Seconds before the first pass."""
    loaded = size.pixels * PER_LOADED * (2 if size.coarse < size.pixels else 1)
    return 1 + loaded + size.coarse * PER_SEEN + size.solved * size.cells * PER_OPEN


def _first_rendering(settings: RecoverSettings, one: Pass, size: Size) -> float:
    """Seconds of collecting the samples that a pass is the first to render, and of recording the kernels."""
    if one.begin or one.kind not in ("rounds", "pictures"):
        return 0.0
    if one.kind == "pictures" and size.rough == size.samples and settings.solver != "pictures":
        return 0.0
    samples = size.rough if one.kind == "rounds" else size.samples
    return size.pictures * (PER_SOFT_TRACED if size.cells else PER_TRACED) + samples * _per_sample(settings, size)


def picture_seconds(settings: RecoverSettings, pixels: Sequence[int], soft: bool, shown: float) -> float:
    """Seconds of rendering every picture once, to measure the fit."""
    per = PER_COLLECTED + (settings.soft_measured * (PER_SAMPLE_CELL + PER_VISIBILITY) if soft else 0)
    traced = len(pixels) * (PER_SOFT_TRACED if soft else PER_TRACED)
    samples = sum(n * measured_subsamples(settings, soft, n) for n in pixels)
    if settings.bounces:
        estimated = sum(min(n, MOST**2) for n in pixels)
        each = MEASURED_PATHS * _path_seconds(shown, soft) + PER_LIGHT
        traced += len(pixels) * PER_LIGHT_PICTURE + estimated * each
    return traced + sum(pixels) * PER_LOADED + shown * samples * per


def finishing_seconds(settings: RecoverSettings, size: Size, descended: bool = True) -> float:
    """Seconds after the last pass: smoothing and detail, and the loss before and after where the steps on whole
    pictures are over."""
    detail = settings.detail * size.pictures * size.texels * (PER_DETAIL if size.cells else PER_DETAIL / 4)
    judged = min(1.0, JUDGES / size.pictures) if descended and descent_steps(settings) else 0
    smoothing = settings.smooth * size.texels * PER_SMOOTHED
    rendered = GRADIENT * _rendering(settings, size) + _collecting(settings, size, size.samples)
    return 2 * judged * rendered + smoothing + detail


def _per_sample(settings: RecoverSettings, size: Size) -> float:
    """Seconds of collecting a sample."""
    return PER_COLLECTED + settings.soft_cells * PER_VISIBILITY * (size.cells > 0)


def _per_rendered(settings: RecoverSettings, size: Size) -> float:
    """Seconds of rendering a collected sample."""
    return PER_SAMPLE_CELL * (settings.soft_cells + 16) if size.cells else PER_SAMPLE


def _rendering(settings: RecoverSettings, size: Size) -> float:
    """Seconds of rendering every picture from collected samples."""
    each = size.pictures * (PER_SOFT_PICTURE if size.cells else PER_PICTURE)
    return each + size.samples * _per_rendered(settings, size)


def _collecting(settings: RecoverSettings, size: Size, samples: float) -> float:
    """Seconds of collecting once more, among so many samples, those that `recover.memory` does not hold."""
    kept = min(1.0, 1e9 * settings.memory / (CACHED * max(samples, 1)))
    return (1 - kept) * samples * _per_sample(settings, size)


def seconds(settings: RecoverSettings, one: Pass, size: Size) -> float:
    """Approximate seconds of a pass."""
    total = _indirect(one.samples, size, vectors=one.kind == "joint") + _first_rendering(settings, one, size)
    if one.kind in ("solve", "rounds"):
        total += _solving(settings, one, size)
    elif one.kind == "pictures":
        rendered = GRADIENT * size.samples * _per_rendered(settings, size) + _collecting(settings, size, size.samples)
        step = PER_STEP + size.texels * PER_STEP_TEXEL + rendered / size.pictures
        if size.cells:
            step += PER_SOFT_PICTURE
        total += one.steps * step + settings.smooth * size.texels * PER_SMOOTHED
    elif one.kind == "joint":
        total += _joint(settings, one, size)
    elif one.kind == "polish":
        total += one.steps * size.samples / size.pictures * 20 * PER_PATH
    return total


def _path_seconds(share: float, soft: bool) -> float:
    """Seconds of a path of indirect light; the object fills a `share` of the pixels."""
    return share * (PER_SOFT_PATH if soft else PER_PATH) + PER_MISS


def _indirect(samples: int, size: Size, vectors: bool) -> float:
    """Seconds of an estimate of indirect light with so many samples a pixel, and of subtracting it."""
    if not samples:
        return 0.0
    path = _path_seconds(size.whole, size.cells > 0)
    path *= SHARED * size.cameras + 1 - SHARED
    smoothed = PER_LIGHT + PER_VECTOR * vectors
    return size.pictures * PER_LIGHT_PICTURE + size.paths * (samples * path + smoothed) + size.pixels * PER_LOADED


def _solving(settings: RecoverSettings, one: Pass, size: Size) -> float:
    """Seconds of the per-texel solver in a pass: its steps, and the renderings between them."""
    step = size.observations * (PER_CELL * size.cells if size.cells else PER_OBSERVATION)
    coarse = replace(size, pixels=size.coarse, samples=size.rough)
    metals = 2 if settings.metallic else 1
    total = STARTS * metals * (settings.solver_iterations + 1) * step if one.anew else 0.0
    if one.kind == "solve":
        return total
    render = _rendering(settings, coarse) + _collecting(settings, size, size.rough) + size.coarse * PER_LOADED
    most = CLASS_ROUNDS if settings.metallic else RESTARTS
    restarts = max(0, min(most - rounds_since(one, one.begin, settings), one.steps))
    steps = restarts * metals * RESTARTED + (one.steps - restarts) * CONTINUED
    return total + one.steps * (render + size.observations * PER_OBSERVED) + steps * step


def _joint(settings: RecoverSettings, one: Pass, size: Size) -> float:
    """Seconds of a joint pass without its estimate of indirect light."""
    fine = replace(size, samples=size.samples * settings.joint_subsamples / settings.subsamples)
    step = size.shown * PER_JOINT + size.texels * (PER_JOINT_TEXEL + 3 * settings.smooth * PER_SMOOTHED)
    rendering = _rendering(settings, fine) + _collecting(settings, fine, fine.samples)
    total = one.steps * (JOINT_RENDERINGS * rendering + step)
    if not one.begin:
        setup = fine.samples + size.shown * settings.joint_subsamples
        total += setup * PER_JOINT_SAMPLE + fine.samples * PER_COLLECTED
    return total


def whole_seconds(settings: RecoverSettings, size: Size, count: int | None = None) -> float:
    """Seconds of a recovery, of its first `count` passes where given."""
    ordered = schedule(settings, size.pictures, settings.solver != "pictures")[:count]
    total = observing_seconds(size) + finishing_seconds(settings, size, any(one.kind == "pictures" for one in ordered))
    return total + sum(seconds(settings, one, size) for one in ordered)


def shares(settings: RecoverSettings, ordered: Sequence[Pass], size: Size) -> list[float]:
    """Cumulative shares of the whole time: before the first pass, and after each."""
    each = [observing_seconds(size), *(seconds(settings, one, size) for one in ordered)]
    total, done, result = sum(each), 0.0, []
    for one in each:
        done += one
        result.append(done / total)
    return result
