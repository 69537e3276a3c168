"""Joint Gauss-Newton over all texels and pictures with the smoothness prior: the last part of a recovery.

Where few pictures show a texel, albedo, roughness and tilt are nearly interchangeable, and gradient descent follows
that valley slowly. Gauss-Newton steps follow it at once. Around the current maps x a pixel is

    I_p(x + d) = I_p(x) + D_p sum_t b_pt d_t

Here b are the bilinear weights, averaged over the pixel's lit samples. D is the pixel's derivative by a change that all
its texels share, by automatic differentiation (`render/deferred/kernels.slopes`). (D treats the samples of a pixel as
equal. The pictures are exact, so the fixed point is exact up to that approximation.) R are the references. P are the
priors of `solver/smoothing.py`, with variances estimated in the same way. Each step solves

    (B' D' W D B + P) d = B' D' W (R - I(x)) - P x

by conjugate gradients (Nocedal and Wright, Numerical Optimization, 2006, sections 10.3 and 5.1) with a block-diagonal
preconditioner. W are Cauchy weights (Huber, Robust Statistics, 1981, section 7.8) of residuals r of standard deviation
s, 1 / (s² (1 + (r / (CAUCHY_SCALE s))²)): some pixels at edges of shadows and outlines are outliers. R excludes the
estimated indirect light. The change of that light with the texels that reflect it to the camera is in D and in I
(`joint/pixels.py`), so texels without direct light count too. Metallic stays fixed. Soft light is excluded because its
pictures are slow to render.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.stage_progress import StageProgress
from mistyle.render.deferred.material_table import ALBEDO, JOINT, ROUGHNESS, SOLVED, TILT, MaterialTable
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.solver.context import DirectCaptures, FitContext
from mistyle.solver.joint.algebra import LinearisedImage, Unknowns, diagonal_blocks, normal_matvec, pcg, rhs
from mistyle.solver.joint.pixels import (
    ImageFootprint,
    UnknownTexels,
    image_footprints,
    indirect_delta,
    indirect_jacobian,
    unknown_frames,
)
from mistyle.solver.journal import Journal
from mistyle.solver.pass_state import PassState
from mistyle.solver.prior import MARGIN, NOTHING
from mistyle.solver.schedule import Pass
from mistyle.solver.smoothing import LEAST, prior_precision_matrix
from mistyle.solver.table import Atlas, with_seam_weights
from mistyle.solver.texels.observations import observation_std
from mistyle.solver.texels.solve import estimate_indirect

# Scale of the residuals' standard deviation relative to `noise` and `relative`: LOOSE times the median's estimate,
# since there are about as many unknowns as pixels and most pixels overfit; FIT at least.
LOOSE, FIT = 1.4, 0.1
CAUCHY_SCALE = 1.4  # scale of the Cauchy loss, in standard deviations
EDGE = 0.1  # standard deviation of partly lit pixels, relative to the radiance of their lit samples
BETWEEN = 0.15  # relative standard deviation of indirect light
FREE = 0.5  # standard deviation of unobserved unknowns
ALIKE = 0.03  # standard deviation between an uncovered texel, seen at chart borders, and the nearest covered one
LONGEST = np.array([0.2, 0.2, 0.2, 0.15, 0.15, 0.15], np.float32)  # largest change of an unknown in one step
STEEPEST = 0.98  # largest length of a tilt
TOO_LARGE = (
    "The joint steps were skipped: they need more than the {:g} GB of recover.memory. Raise it, or use fewer or "
    "smaller pictures or a smaller atlas."
)
SEED = 104_729  # offset of these seeds from those of other stages


@dataclass(frozen=True)
class ResidualStd:
    """Standard deviations of one picture's residuals per pixel, and the pixels' weights, 0..1."""

    std: Float[np.ndarray, " p"]
    counts: Float[np.ndarray, " p"]


@dataclass(frozen=True)
class JointProblem:
    """State that all steps after one estimate of indirect light share.

    footprints  of every picture
    reflected   derivatives of indirect light per picture, see `indirect_jacobian`
    """

    context: FitContext
    renderer: MaterialRenderer
    footprints: Sequence[ImageFootprint]
    unknown: UnknownTexels
    direct: DirectCaptures
    reflected: Sequence[Float[np.ndarray, "_ 3 3"]]

    def images(self, table: MaterialTable) -> list[Float[np.ndarray, "_ 3"]]:
        """The footprints' pixels of all rendered pictures."""
        uploaded = self.renderer.upload(table)
        return [self.renderer.image(uploaded, k).reshape(-1, 3)[p.index] for k, p in enumerate(self.footprints)]

    def images_and_slopes(
        self, table: MaterialTable
    ) -> tuple[list[Float[np.ndarray, "_ 3"]], list[Float[np.ndarray, "_ 3 4"]]]:
        """`images`, and their derivatives by a change that a pixel's texels share (`LinearisedImage`)."""
        uploaded, images, slopes = self.renderer.upload(table), [], []
        for k, pixels in enumerate(self.footprints):
            image, slope = self.renderer.image_and_slopes(uploaded, k)
            images.append(image.reshape(-1, 3)[pixels.index])
            slopes.append(slope.reshape(-1, 3, 4)[pixels.index])
        return images, slopes

    def references(self) -> list[Float[np.ndarray, "_ 3"]]:
        """The footprints' pixels of the references, without indirect light."""
        return [self.direct.load(k)[0].reshape(-1, 3)[p.index] for k, p in enumerate(self.footprints)]


@dataclass(frozen=True)
class JointSetup:
    """Geometry that all joint passes share: see `JointProblem`; `axes` are the unknown texels' frames."""

    renderer: MaterialRenderer
    footprints: Sequence[ImageFootprint]
    unknown: UnknownTexels
    axes: Float[np.ndarray, "t 9"]


def joint_setup(context: FitContext, renderer: MaterialRenderer) -> JointSetup | None:
    """The footprints; None, with a note, where they exceed the memory.

    `renderer` holds no samples; they get the part of `settings.memory` that the steps' arrays leave.
    """
    footprints = image_footprints(context, renderer)
    if footprints is None:
        context.notes.append(TOO_LARGE.format(context.settings.memory))
        return None
    pictures, unknown, memory = footprints
    return JointSetup(renderer.with_memory(memory), pictures, unknown, unknown_frames(context, unknown))


def joint_pass(
    context: FitContext, setup: JointSetup, state: PassState, one: Pass, journal: Journal, progress: StageProgress
) -> PassState:
    """`settings.joint` steps from the state's table after a new estimate of indirect light.

    Steps that worsen the fit are undone, and no joint pass follows.
    """
    table, direct, pictures = state.table, state.direct, setup.footprints
    assert table is not None
    reflected = [np.zeros((len(p.index), 3, 3), np.float32) for p in pictures]
    if one.samples:
        sampling = one.samples, context.seed + (one.begin + 1) * SEED
        known = journal.named("light.")
        # Parts of an interrupted run come first; their cameras are skipped below.
        for name in known:
            k, arrays = int(name.split(".")[1]), journal.part(name, dict)
            direct, reflected[k] = direct.with_indirect(k, arrays["light"]), arrays["reflected"]
        skip = {int(name.split(".")[1]) for name in known}
        for k, light, vectors in estimate_indirect(
            context, setup.renderer, table, sampling, progress.part(0, 0.5), vectors=True, skip=skip
        ):
            assert vectors is not None
            size = context.captures.cameras[k].size
            reflected[k] = indirect_jacobian(pictures[k], light, vectors, size, table[setup.unknown.rows], setup.axes)
            direct = direct.with_indirect(k, light)
            arrays = {"light": light, "reflected": reflected[k]}
            journal.part(f"light.{k}", lambda arrays=arrays: arrays)
    problem = JointProblem(context, setup.renderer, pictures, setup.unknown, direct, reflected)
    moved = _steps(problem, table, journal, progress.part(0.5, 1))
    return replace(state, direct=direct, table=table if moved is None else moved, over=moved is None)


def _steps(
    problem: JointProblem, table: MaterialTable, journal: Journal, progress: Callable[[float], None]
) -> MaterialTable | None:
    """All steps after one estimate; None, with a note, if they worsen the fit."""
    settings, unknown = problem.context.settings, problem.unknown
    errors = _residual_stds(problem)
    references = problem.references()
    images = problem.images(table)
    scale = max(FIT, LOOSE * _robust_std(_differences(references, images), errors))
    errors = [ResidualStd(e.std * np.float32(scale), e.counts) for e in errors]
    costs, x = [_cost(_differences(references, images), errors)], table
    for k in range(settings.joint):

        def step(x=x, k=k) -> dict[str, np.ndarray]:
            images, slopes = problem.images_and_slopes(x)
            linearised = _linearised(problem, slopes, _residuals(problem, references, images, x - table), errors)
            progress((k + 0.5) / settings.joint)
            change = _step(x, linearised, unknown, problem.context.atlas)
            new = _updated(x, unknown, change, settings.roughness_floor)
            cost = _cost(_residuals(problem, references, problem.images(new), new - table), errors)
            return {"table": new, "cost": np.array(cost)}

        arrays = journal.part(f"joint{k}", step)
        x = arrays["table"]
        costs.append(float(arrays["cost"]))
        progress((k + 1) / settings.joint)
    problem.context.trace.setdefault("joint.cost", []).extend(costs)
    if not costs[-1] < costs[0]:
        problem.context.notes.append(
            f"The joint steps were undone: the cost changed from {costs[0]:.3g} to {costs[-1]:.3g}."
        )
        return None
    return x


def _residuals(
    problem: JointProblem, references: Sequence[np.ndarray], images: Sequence[np.ndarray], moved: MaterialTable
) -> list[Float[np.ndarray, "_ 3"]]:
    """References less images of maps that have `moved`. The indirect light was subtracted for the maps of its
    estimate, so its change counts too."""
    rows, differences = moved[problem.unknown.rows], _differences(references, images)
    if not moved.any():
        return differences
    changed = [indirect_delta(p, m, rows) for p, m in zip(problem.footprints, problem.reflected, strict=True)]
    return [r - c for r, c in zip(differences, changed, strict=True)]


def _linearised(
    problem: JointProblem,
    slopes: Sequence[np.ndarray],
    residuals: Sequence[np.ndarray],
    errors: Sequence[ResidualStd],
) -> list[LinearisedImage]:
    """The pictures linearised where their `slopes` were computed; the derivatives of indirect light are added to
    these, in place."""
    for slope, more in zip(slopes, problem.reflected, strict=True):
        slope[:, :, :3] += more
    return [
        LinearisedImage(p.fetch, d, _weights(r, d, e), np.nan_to_num(r))
        for p, d, r, e in zip(problem.footprints, slopes, residuals, errors, strict=True)
    ]


def _residual_stds(problem: JointProblem) -> list[ResidualStd]:
    direct, pictures, settings = problem.direct, problem.footprints, problem.context.settings
    levels, counts = [], []
    for k, pixels in enumerate(pictures):
        rgb, mask = direct.load(k)
        rgb = rgb.reshape(-1, 3)[pixels.index]
        counts.append((mask.ravel()[pixels.index] & np.isfinite(rgb).all(axis=1)).astype(np.float32))
        levels.append(np.maximum(np.nan_to_num(rgb).max(axis=1, initial=0), 0))
    stds = np.split(
        observation_std(np.concatenate(levels), settings.noise, settings.relative),
        np.cumsum([len(a) for a in levels])[:-1],
    )
    result = []
    for k, (pixels, level, std, count) in enumerate(zip(pictures, levels, stds, counts, strict=True)):
        variance = std**2
        edge = (pixels.lit > 0) & (pixels.lit < 0.999)
        variance += np.where(edge, EDGE * level / np.maximum(pixels.lit, 1e-6), 0) ** 2
        if k in direct.indirect:
            light = direct.enlarged(k).reshape(-1, 3)[pixels.index]
            variance += (BETWEEN * light.max(axis=1)) ** 2
        result.append(ResidualStd(np.sqrt(variance).astype(np.float32), count))
    return result


def _differences(references: Sequence[np.ndarray], images: Sequence[np.ndarray]) -> list[Float[np.ndarray, "_ 3"]]:
    return [r - i for r, i in zip(references, images, strict=True)]


def _robust_std(residuals: Sequence[np.ndarray], errors: Sequence[ResidualStd]) -> float:
    """Ratio of residuals to their standard deviations, from the median under a normal distribution."""
    every = np.concatenate(
        [(np.abs(w) / e.std[:, None])[e.counts > 0].ravel() for w, e in zip(residuals, errors, strict=True)]
    )
    return float(np.median(every)) / 0.6745 if len(every) else 1.0


def _cost(residuals: Sequence[np.ndarray], errors: Sequence[ResidualStd]) -> float:
    """Cauchy loss, the mean over the channels of all valid pixels."""
    total, count = 0.0, 0.0
    for w, e in zip(residuals, errors, strict=True):
        units = np.nan_to_num(w / (CAUCHY_SCALE * e.std[:, None]))
        total += float((np.log1p(units**2).sum(axis=1) * e.counts).sum(dtype=np.float64))
        count += 3 * float(e.counts.sum())
    return CAUCHY_SCALE**2 * total / max(count, 1)


def _weights(residuals: np.ndarray, derivative: np.ndarray, errors: ResidualStd) -> Float[np.ndarray, "p 3"]:
    units = residuals / (CAUCHY_SCALE * errors.std[:, None])
    weight = (errors.counts / errors.std**2)[:, None] / (1 + units**2)
    sound = np.isfinite(weight) & np.isfinite(derivative).all(axis=2)
    derivative[~sound] = 0
    return np.where(sound, weight, 0).astype(np.float32)


def _step(table: MaterialTable, images: Sequence[LinearisedImage], unknown: UnknownTexels, atlas: Atlas) -> Unknowns:
    """The solution d of the module's linear system."""
    rows = unknown.rows
    # In place and one after the other: these arrays are most of the steps' memory per texel.
    blocks, of = diagonal_blocks(images, len(rows)), np.arange(6)
    blocks[:, of, of] += 1 / FREE**2
    own = np.einsum("tii->ti", np.linalg.inv(blocks)).copy()
    std = np.full((len(table), 7), NOTHING, np.float32)
    std[rows, JOINT] = np.where(unknown.seen[:, None], np.sqrt(MARGIN * np.maximum(own, 1e-12)), NOTHING)
    priors, x = _prior_matrices(table, std, rows, atlas), table[rows, JOINT]
    right = rhs(images, len(rows)) - _product(priors, x)
    diagonal = np.stack([prior.diagonal() for prior in priors], axis=1)
    blocks[:, of, of] += np.maximum(diagonal, 1e-6) - 1 / FREE**2
    inverse = np.linalg.inv(blocks)
    del blocks

    def applied(v: Unknowns) -> Unknowns:
        return normal_matvec(images, v) + _product(priors, v)

    return pcg(applied, right, inverse)


def _prior_matrices(
    table: MaterialTable, std: Float[np.ndarray, "a 7"], rows: Int[np.ndarray, " t"], atlas: Atlas
) -> list[Any]:
    """P of each unknown: the priors of covered texels; uncovered texels are tied to the nearest covered one."""
    from scipy.sparse import csr_array

    number = np.full(len(table), -1, np.int64)
    number[rows] = np.arange(len(rows))
    pairs = []
    for part, covered, closest in zip(atlas.parts, atlas.covered, atlas.closest, strict=True):
        empty = np.flatnonzero(~covered.ravel())
        pairs.append(np.stack([empty, closest[empty]], axis=1) + part.start)
    both = number[np.concatenate(pairs)]
    both = both[(both >= 0).all(axis=1)]
    ends = np.arange(0, both.size + 1, 2)
    apart = csr_array(
        (np.tile([1, -1], len(both)).astype(np.float32) / ALIKE, both.ravel(), ends), (len(both), len(rows))
    )
    tied = apart.T @ apart
    atlas = with_seam_weights(atlas, table[:, SOLVED], std)
    return [(prior_precision_matrix(table, std, atlas, c)[rows][:, rows] + tied).tocsr() for c in LEAST]


def _product(priors: Sequence[Any], v: Unknowns) -> Unknowns:
    return np.stack([prior @ v[:, c] for c, prior in enumerate(priors)], axis=1)


def _updated(table: MaterialTable, unknown: UnknownTexels, change: Unknowns, floor: float) -> MaterialTable:
    """The table after a step, clipped to LONGEST and to the channels' bounds; no step where it is not finite."""
    result, change = table.copy(), np.where(np.isfinite(change).all(axis=1, keepdims=True), change, 0)
    values = result[unknown.rows, JOINT] + np.clip(change, -LONGEST, LONGEST)
    values[:, ALBEDO] = np.clip(values[:, ALBEDO], 0, 1)
    values[:, ROUGHNESS] = np.clip(values[:, ROUGHNESS], floor, 1)
    length = np.linalg.norm(values[:, TILT], axis=1, keepdims=True)
    values[:, TILT] *= np.minimum(1, STEEPEST / np.maximum(length, 1e-9))
    result[unknown.rows, JOINT] = values
    return result
