"""The passes of a recovery: numbered units of work, each of which improves the maps, and the seconds that each takes.

A recovery may end after any pass; the passes before it do not depend on where it ends. Plan, progress and time limits
share the seconds. They are of two quiet cores of an EPYC, from CPU seconds of the castle's photographs and from
`benchmarks/texel_speed.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mistyle.solver.settings import (
    RecoverSettings,
    all_rounds,
    descent_steps,
    estimates,
    joint_estimates,
    measured_subsamples,
    passes,
)

Kind = Literal["solve", "rounds", "pictures", "joint", "polish"]
STARTS, RESTARTED, CONTINUED = 3, 37, 5  # starts of a solve; steps of a round with restarts, and of one without
SOFT_COST = 16  # approximate run time of a texel under a sky, relative to one light
SKY_CELLS = 128
MOST = 512  # pixels along the longer side of an estimate of indirect light
# The object's share of a picture, the covered share of the atlas, and the share of that which one picture sees.
SHOWN, COVERED, SEEN = 0.3, 0.55, 0.35
FILLED = 0.55  # the object's share of its bounding box in a picture, or of a picture without alpha or mask
OBSERVED = 2**26  # most observations of the per-texel solver, of texels of which one picture sees SEEN
LARGE = 4_000_000  # pixels of a picture from which it is averaged for a coarser level of that solver
# Texels of a set that are smoothed at once. Joint steps need JOINT_TEXEL bytes of `recover.memory` for each further
# texel of the atlas, and JOINT_PIXEL or more for each pixel of the object.
WHOLE, JOINT_TEXEL, JOINT_PIXEL = 2**22, 750, 240
JUDGES = 48  # pictures whose loss accepts or rejects the steps on whole pictures
RESTARTS = 3  # rounds in which texels also start from their neighbours' values
CLASS_ROUNDS = 2  # rounds after each solve from the start in which metal and dielectric are both tried

# Seconds of two cores, per unit named; those of soft light are of one of its cells.
PER_OBSERVATION, PER_CELL = 2.5e-8, 3.5e-9  # a texel in a picture, in one step of the per-texel solver
PER_SAMPLE, PER_SAMPLE_CELL = 2e-8, 1.5e-9  # a sample of a pixel, rendered
PER_COLLECTED = 4e-7  # a sample of a pixel, collected once
CACHED = 77  # bytes of a cached sample
GRADIENT = 2.9  # a step's cost over that of a picture
PER_VISIBILITY = 1.3e-8  # a sample and a cell, once
PER_PATH, PER_SOFT_PATH = 1.2e-7, 3e-7  # a path of indirect light
PER_SMOOTHED = 1.5e-5  # a covered texel in one smoothing pass
PER_JOINT = 3e-6  # a sample in a joint step
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


@dataclass(frozen=True)
class Size:
    """Counts that the seconds are proportional to.

    texels        covered texels of the atlas
    observations  of the solved texels in all pictures
    samples       rendered samples of all pictures; `rough`: those in rounds of the per-texel solver
    paths         pixels of all estimates of indirect light
    cells         of soft light, 0 without
    """

    pictures: int
    texels: float
    observations: float
    samples: float
    rough: float
    paths: float
    cells: int


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
    settings: RecoverSettings, pixels: Sequence[int], covered: float, soft: bool, shown: float = SHOWN
) -> Size:
    """Counts of a fit to pictures of so many pixels and an atlas with `covered` texels, for an object that fills the
    share `shown` of each picture and of which one picture sees SEEN."""
    by = solver_level(settings, covered, len(pixels), soft)
    solved = covered / by**2
    subsamples = settings.soft_subsamples if soft else settings.subsamples
    area = shown * sum(pixels)
    return Size(
        len(pixels),
        covered,
        SEEN * solved * len(pixels),
        area * subsamples,
        shown * sum(n / by**2 if n > LARGE else n for n in pixels) * (1 if soft and by > 1 else subsamples),
        sum(min(n, MOST**2) for n in pixels),
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


def collecting_seconds(settings: RecoverSettings, size: Size) -> float:
    """Seconds before the first pass: observations, and the samples of the pictures."""
    samples = size.samples + (size.rough if size.rough < size.samples else 0)
    return samples * (PER_COLLECTED + settings.soft_cells * PER_VISIBILITY * (size.cells > 0)) + 2


def picture_seconds(settings: RecoverSettings, pixels: Sequence[int], soft: bool, shown: float = SHOWN) -> float:
    """Seconds of rendering every picture once, to measure the fit."""
    cells = settings.soft_measured * (PER_SAMPLE_CELL + PER_VISIBILITY) if soft else 0
    return shown * sum(pixels) * measured_subsamples(settings, soft) * (PER_COLLECTED + cells)


def finishing_seconds(settings: RecoverSettings, size: Size) -> float:
    """Seconds after the last pass: the loss before and after, smoothing, detail, and the residual of every picture."""
    detail = settings.detail * size.pictures * size.texels * (PER_DETAIL if size.cells else PER_DETAIL / 4)
    judged = min(1.0, JUDGES / size.pictures) if descent_steps(settings) else 0
    smoothing = settings.smooth * size.texels * PER_SMOOTHED
    again = (1 + 2 * judged) * _collecting(settings, size, size.samples)
    return (1 + 2 * GRADIENT * judged) * _rendering(settings, size) + again + smoothing + detail


def _rendering(settings: RecoverSettings, size: Size) -> float:
    """Seconds of rendering every picture from collected samples."""
    return size.samples * (PER_SAMPLE_CELL * (settings.soft_cells + 16) if size.cells else PER_SAMPLE)


def _collecting(settings: RecoverSettings, size: Size, samples: float) -> float:
    """Seconds of collecting once more, among so many samples, those that `recover.memory` does not hold."""
    kept = min(1.0, 1e9 * settings.memory / (CACHED * max(samples, 1)))
    return (1 - kept) * samples * (PER_COLLECTED + settings.soft_cells * PER_VISIBILITY * (size.cells > 0))


def seconds(settings: RecoverSettings, one: Pass, size: Size) -> float:
    """Approximate seconds of a pass."""
    render, again = _rendering(settings, size), _collecting(settings, size, size.samples)
    if one.kind in ("solve", "rounds"):
        render *= size.rough / size.samples
        render += _collecting(settings, size, size.rough)
    step = size.observations * (PER_CELL * size.cells if size.cells else PER_OBSERVATION)
    smoothing = settings.smooth * size.texels * PER_SMOOTHED
    total = one.samples * size.paths * (PER_SOFT_PATH if size.cells else PER_PATH) + (render if one.samples else 0)
    metals = 2 if settings.metallic else 1
    if one.anew:
        total += STARTS * metals * settings.solver_iterations * step
    if one.kind == "rounds":
        most = CLASS_ROUNDS if settings.metallic else RESTARTS
        restarts = max(0, min(most - rounds_since(one, one.begin, settings), one.steps))
        total += one.steps * render + (restarts * metals * RESTARTED + (one.steps - restarts) * CONTINUED) * step
    elif one.kind == "pictures":
        total += one.steps * (GRADIENT * render + again) / size.pictures + smoothing
    elif one.kind == "joint":
        ratio = settings.joint_subsamples / settings.subsamples
        total += one.steps * (size.samples * ratio * PER_JOINT + 3 * smoothing)
    elif one.kind == "polish":
        total += one.steps * size.samples / size.pictures * 20 * PER_PATH
    return total


def whole_seconds(settings: RecoverSettings, size: Size, count: int | None = None) -> float:
    """Seconds of a recovery, of its first `count` passes where given."""
    ordered = schedule(settings, size.pictures, settings.solver != "pictures")[:count]
    total = collecting_seconds(settings, size) + finishing_seconds(settings, size)
    return total + sum(seconds(settings, one, size) for one in ordered)


def shares(settings: RecoverSettings, ordered: Sequence[Pass], size: Size) -> list[float]:
    """Cumulative shares of the whole time: before the first pass, and after each."""
    each = [collecting_seconds(settings, size), *(seconds(settings, one, size) for one in ordered)]
    total, done, result = sum(each), 0.0, []
    for one in each:
        done += one
        result.append(done / total)
    return result
