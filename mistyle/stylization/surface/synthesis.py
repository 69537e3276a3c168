"""Guided patch synthesis of the surface painting, coarse to fine, on a hierarchy of surface samples.

After Image Analogies (Hertzmann et al. 2001), surface texture synthesis (Turk 2001, Wei and Levoy 2001) and the
energy of StyLit (Fiser et al. 2016). A sample s has a 5x5 patch of neighbours in its tangent plane and takes the
place p (page, x, y) of the painting with the least

    |D_p - D_s|^2 + detail w(s) (band_p - relief std(band) d_s)^2 + variety use(p) / target use(p)
        + stroke_coherence * sum over 4 neighbours of seam [1 if on another page, else min(jump^2, 4) / 4]

The coherence term falls to a fifth at creases and ridges, where a stroke may end. Around neighbours whose copied piece
is too large, nearness costs instead (stylization/surface/pieces.py). D joins 16 principal components of the patch
(Lab / 100, over 5), the large-area colour (weights 1, 0.6, 0.6 times `palette`, five times that for paintings of two
tones) and the stroke direction (`orientation`). d_s is the detail guide, w(s) = min(|d_s|, 1.5)^1.5, and jump the
distance in pixels from the neighbour's continued picture. seam (0.3 to 1) is the difference between the neighbour's
continued picture and p: after the seam cost of graph-cut textures (Kwatra et al. 2003).

The search is deterministic. Coarse levels try all places for all samples. On every level a sample tries its neighbours'
continued pictures (coherent search, Ashikhmin 2001) and a fixed set of offsets from its own place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.asset import Picture
from mistyle.core.mesh import Mesh
from mistyle.stylization.surface import kernels
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.exemplar.chosen import settled
from mistyle.stylization.surface.field import (
    NearestNeighbourField,
    exemplar_arrays,
    from_pixels,
    on_device,
    on_host,
    pixels,
    usage,
    within,
)
from mistyle.stylization.surface.guides.creases import CREASE
from mistyle.stylization.surface.guides.glaze import glaze
from mistyle.stylization.surface.guides.guides import Content, Guide, Occlusion, level_guides
from mistyle.stylization.surface.guides.linefield import DirectionConstraint, directions, line_field
from mistyle.stylization.surface.lookup import CRISP, PaintedSurface, painted_surface
from mistyle.stylization.surface.pieces import labels, on_picture, reach
from mistyle.stylization.surface.samples import Level, nearest, sample_normals, spread, with_tables
from mistyle.stylization.surface.settings import PlainSettings, ResolvedSettings, SurfaceSettings

__all__ = ["SurfaceSettings", "hierarchy", "solve", "synthesise"]

LINE_POINTS = 7_500
FULL_SIZE = 512  # long side of the painting on the finest level at 250,000 samples and stroke_scale 1
LEAST_SIZE = 16  # least long side on the coarsest level
LEAST_SAMPLES = 48  # on the coarsest level
ROUNDS = (10, 8, 6, 6, 6)  # searches and votes from the coarsest level on; further levels use the last
FINE_ROUNDS = 4  # on levels beyond the fifth
SWEEPS = 3  # passes of the coherent search in each round
ALL_PAIRS = 1.2e9  # most sample-pixel pairs for exhaustive search, summed over the rounds of a level
CHUNK_PAIRS = 8_000_000
LOOSE = 0.8  # reduction of the coherence price where the detail guide is strongest
INITIAL_JITTER = 0.004
CHROMA = 0.6
TWO_TONES = 5.0  # factor of the large-area colour's weight for a painting without middle tones
LEAST_AROUND = 4.0  # pixels around the end of a piece that count as the same piece
TYPICAL_LOAD = 0.35  # mean urgency of detail at which its weight is the setting's
UNREACHABLE = 1e3  # descriptor of forbidden pixels: farther than any other


@dataclass(frozen=True)
class SurfaceFields:
    """Fields over the surface, each a function of positions and unit normals (n, 3).

    occlusion  the share of open sky, 0..1
    content    the lightness of the asset's own texture, 0..1
    direction  the direction of strokes, and its weight
    """

    occlusion: Occlusion
    content: Content | None = None
    direction: DirectionConstraint | None = None


@dataclass(frozen=True)
class MeshGuides:
    """Input of the synthesis: samples and their guides, coarse to fine, the picture, and resolved settings."""

    levels: tuple[Level, ...]
    guides: tuple[Guide, ...]
    picture: style.StyleImage
    settings: ResolvedSettings


@dataclass(frozen=True)
class ColourConstraints:
    """Fixed colours (Lab / 100) of samples: where `known`, they replace those of the vote."""

    known: Bool[np.ndarray, " n"]
    colour: Float[np.ndarray, "n 3"]


def solve(
    mesh: Mesh,
    picture: Picture,
    fields: SurfaceFields,
    settings: SurfaceSettings | ResolvedSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
) -> PaintedSurface:
    """Paint `mesh` in the style of a picture; transparent parts of the picture are not used.

    The result can be evaluated at any point of the surface (`lookup.colour`) at the picture's own resolution. 250,000
    samples take about 20 CPU seconds and 0.9 GB. Raises InputRefused for a mesh without area and for an unusable
    picture. It copies pieces of the picture: recognisable objects in it (a star, an eye) may appear on the surface.
    """
    dj = kernels.module()
    base = mesh_guides(mesh, picture, fields, settings, seed, dj, lambda done: progress(0.25 * done))
    progress(0.35)
    field, exemplar = synthesise(base, seed, dj, lambda done: progress(0.35 + 0.65 * done))
    settings, fine = base.settings, base.levels[-1]
    return replace(
        painted_surface(fine, field, exemplar.size, base.picture.rgb),
        glaze=glaze(base.levels, base.guides[-1], exemplar.lab[pixels(exemplar, field), 0], exemplar, settings),
        piece=labels(fine, exemplar, field).astype(np.int32),
        crisp=CRISP[settings.borders],
        whole_pixels=settings.look_up == "nearest",
    )


def mesh_guides(
    mesh: Mesh,
    picture: Picture,
    fields: SurfaceFields,
    settings: SurfaceSettings | ResolvedSettings,
    seed: int,
    dj: ModuleType,
    progress: Callable[[float], None] = lambda done: None,
) -> MeshGuides:
    """Samples of the mesh and their guides; unset settings are derived from the picture."""
    resolved = settled(picture.rgb, picture.alpha, settings)
    alpha = style.without(picture.alpha, picture.rgb.shape, resolved.omit)
    prepared = style.prepare(picture.rgb, resolved.crop, alpha)
    levels = hierarchy(mesh, resolved, seed, dj, progress, fields.direction)
    rng = np.random.default_rng([seed, 2])
    palette = style.palette(prepared, resolved.liveliness, rng, resolved.palette_mix)
    guides = level_guides(levels, palette, fields.occlusion, resolved, rng, fields.content)
    return MeshGuides(tuple(levels), tuple(guides), prepared, resolved)


def level_count(settings: ResolvedSettings) -> int:
    """Number of levels: one more per doubling of the painting's size in samples, so that the coarsest level covers the
    same share of it; fewer where its painting or its number of samples would be too small."""
    size = finest_size(settings)
    count = settings.levels + round(float(np.log2(size / FULL_SIZE)))
    fewest = int(np.log2(settings.samples / LEAST_SAMPLES) / 2) + 1
    return max(2, min(count, fewest, int(np.log2(size / LEAST_SIZE)) + 1))


def finest_size(settings: PlainSettings) -> float:
    """Long side of the painting on the finest level: one pixel a sample, so strokes keep their size on the surface."""
    least, most = 32, style.LONGEST
    return float(np.clip(FULL_SIZE * np.sqrt(settings.samples / 250_000) * settings.stroke_scale, least, most))


def hierarchy(
    mesh: Mesh,
    settings: ResolvedSettings,
    seed: int,
    dj: ModuleType,
    progress: Callable[[float], None] = lambda done: None,
    direction: DirectionConstraint | None = None,
) -> list[Level]:
    """Samples, frames along the strokes and neighbour tables, coarse to fine, four times as many each level."""
    normals = sample_normals(mesh)
    rng = np.random.default_rng([seed, 1])
    field = line_field(spread(mesh, normals, LINE_POINTS, rng, dj), settings.direction, direction)
    progress(0.15)
    count = level_count(settings)
    levels = []
    for index in range(count):
        share = 4.0 ** (index - count + 1)
        points = spread(mesh, normals, max(LEAST_SAMPLES, round(settings.samples * share)), rng, dj)
        levels.append(with_tables(points, *directions(field, points), dj))
        progress(0.15 + 0.85 * share)
    return levels


def synthesise(
    base: MeshGuides,
    seed: int,
    dj: ModuleType,
    progress: Callable[[float], None] = lambda done: None,
    constraints: Sequence[ColourConstraints] | None = None,
) -> tuple[NearestNeighbourField, style.Exemplar]:
    """The field of the finest level, and its exemplar; one entry of `constraints` per level."""
    levels, settings = base.levels, base.settings
    rng = np.random.default_rng([seed, 3])
    work = np.cumsum([0.02 + 4.0 ** (k - len(levels) + 1) for k in range(len(levels))])
    field, exemplar = None, None
    for index, (level, guide) in enumerate(zip(levels, base.guides, strict=True)):
        size = finest_size(settings) / 2 ** (len(levels) - 1 - index)
        finer = style.exemplar(base.picture, size, settings.liveliness, settings.palette_mix)
        start = None
        if field is not None and exemplar is not None:
            start = refined(levels[index - 1], level, field, exemplar, finer)
        rounds = ROUNDS[index] if index < len(ROUNDS) else FINE_ROUNDS
        task = LevelTask(level, guide, finer, rounds, constraints[index] if constraints is not None else None)
        field, exemplar = paint_level(task, start, settings, rng, dj), finer
        progress(float(work[index] / work[-1]))
    assert field is not None and exemplar is not None
    return field, exemplar


def refined(
    coarse: Level, fine: Level, field: NearestNeighbourField, before: style.Exemplar, after: style.Exemplar
) -> NearestNeighbourField:
    """The finer level's initial field: places of the nearest coarse samples, moved by the exact offset between both."""
    parent = nearest(coarse.points, fine.points, 1)[1][:, 0]
    step = (fine.points.positions - coarse.points.positions[parent]) / np.float32(fine.points.spacing)
    tangent, across = coarse.tangent[parent], coarse.across[parent]
    page = field.page[parent]
    ratio = (after.shapes / before.shapes).astype(np.float32)[page]
    y = (field.y[parent] + 0.5) * ratio[:, 0] - 0.5 + (step * across).sum(axis=1)
    x = (field.x[parent] + 0.5) * ratio[:, 1] - 0.5 + (step * tangent).sum(axis=1)
    turned = (tangent * fine.tangent).sum(axis=1) < 0
    height, width = after.shapes[page].astype(np.float32).T
    x, y = np.where(turned, width - 1 - x, x), np.where(turned, height - 1 - y, y)
    return within(after, np.where(turned, (page + 2) % 4, page), x, y)


@dataclass(frozen=True)
class LevelTask:
    """One level's search: its samples and guide, the exemplar at its size, and its number of rounds."""

    level: Level
    guide: Guide
    exemplar: style.Exemplar
    rounds: int
    constraints: ColourConstraints | None = None


def paint_level(
    task: LevelTask,
    start: NearestNeighbourField | None,
    settings: ResolvedSettings,
    rng: np.random.Generator,
    dj: ModuleType,
) -> NearestNeighbourField:
    """Alternate search and vote, from `start` or (None) from the guides' own nearest places."""
    level, exemplar = task.level, task.exemplar
    basis = style.patch_basis(exemplar, rng)
    guide_scale = guide_weights(settings, exemplar)
    described = described_exemplar(exemplar, guide_scale)
    axes, mean = kernels.floats(dj, basis.axes / 5), kernels.floats(dj, basis.mean)
    lab = kernels.floats(dj, exemplar.lab)
    patches = kernels.describe_pixels(dj, lab, exemplar.shapes, axes, mean).numpy().reshape(-1, kernels.PATCH)
    described[exemplar.allowed, : kernels.PATCH] = patches[exemplar.allowed]
    descriptors, band_weight = described_guide(task.guide, exemplar, settings, guide_scale)
    if start is None:
        start = by_guides(descriptors, band_weight, described, exemplar, rng)
    table = kernels.tables(dj, level.neighbours, level.turned, level.offsets)
    arrays = exemplar_arrays(dj, exemplar, lab, described)
    weight = kernels.floats(dj, band_weight)
    typical = float(described[exemplar.allowed, : kernels.SEEN].var(axis=0).sum())
    prices = kernels.floats(dj, np.array([settings.stroke_coherence, settings.variety, 1 / max(typical, 1e-6)]))
    field = on_device(dj, start)
    complete = min(task.rounds, int(ALL_PAIRS // (len(descriptors) * len(described))))
    for turn in range(task.rounds):
        colour = kernels.vote(dj, table, arrays, field)
        if task.constraints is not None:
            known, own = task.constraints.known[:, None], task.constraints.colour
            colour = kernels.floats(dj, np.where(known, own, colour.numpy().reshape(-1, 3)))
        descriptors[:, : kernels.PATCH] = (
            kernels.describe(dj, table, colour, axes, mean).numpy().reshape(-1, kernels.PATCH)
        )
        targets = kernels.TargetDescriptors(kernels.floats(dj, descriptors), weight)
        also = None
        if turn < complete:
            extra = settings.variety * usage(exemplar, on_host(field))[exemplar.origin]
            also = on_device(dj, exhaustive(descriptors, band_weight, described, extra, exemplar))
        for _ in range(SWEEPS):
            current = on_host(field)
            use = kernels.floats(dj, usage(exemplar, current))
            # Only exhaustive search can leave a piece; finer levels only refine the pieces of coarse ones.
            bound = settings.largest_piece < 1 and complete > 0
            limit = patch_size_limit(level, exemplar, current, settings.largest_piece, dj) if bound else None
            field = kernels.search(dj, table, arrays, field, targets, kernels.Prices(prices, use, limit), also)[1]
    return on_host(field)


def patch_size_limit(
    level: Level, exemplar: style.Exemplar, field: NearestNeighbourField, largest: float, dj: ModuleType
) -> kernels.PatchSizeLimit:
    """The samples whose piece neighbours may not extend, because it has the largest size, a share of the picture's
    long side."""
    at = on_picture(exemplar, pixels(exemplar, field))
    far = reach(labels(level, exemplar, field), at) > largest / 2
    height, width = exemplar.size
    around = max(largest * max(height, width), LEAST_AROUND)
    return kernels.PatchSizeLimit(kernels.floats(dj, far.astype(np.float32)), kernels.floats(dj, np.array([around])))


def guide_weights(settings: ResolvedSettings, exemplar: style.Exemplar) -> Float[np.ndarray, " 5"]:
    """Square roots of the weights of colour (L, a, b) and stroke direction (2), the descriptors' factors.

    In a painting of two tones only the large-area colour locates strokes, so its weight is larger.
    """
    stricter = 1 + (TWO_TONES - 1) * (1 - style.middle_tones(exemplar.lab[:, 0]))
    palette = settings.palette * stricter * np.array([1, CHROMA, CHROMA])
    return np.sqrt(np.concatenate([palette, [settings.orientation] * 2])).astype(np.float32)


def described_exemplar(exemplar: style.Exemplar, guide_scale: Float[np.ndarray, " 5"]) -> Float[np.ndarray, "m 24"]:
    """Descriptor of every exemplar pixel in the layout of `kernels.search`, with an empty patch."""
    out = np.zeros((len(exemplar.lab), kernels.WIDTH), np.float32)
    out[:, 16:19] = exemplar.broad * guide_scale[:3]
    out[:, 19:21] = exemplar.grain * guide_scale[3:]
    out[:, 21] = exemplar.band
    out[~exemplar.allowed] = UNREACHABLE
    return out


def described_guide(
    guide: Guide, exemplar: style.Exemplar, settings: ResolvedSettings, guide_scale: Float[np.ndarray, " 5"]
) -> tuple[Float[np.ndarray, "n 24"], Float[np.ndarray, " n"]]:
    """Target descriptor of every sample, with an empty patch, and the weight of its band."""
    out = np.zeros((len(guide.detail), kernels.WIDTH), np.float32)
    out[:, 16:19] = guide.colour * guide_scale[:3]
    out[:, 19] = guide.directed * guide_scale[3]
    out[:, 21] = guide.detail * np.float32(settings.relief * exemplar.band.std())
    out[:, kernels.CLOSED] = 1 - LOOSE * np.minimum(np.abs(guide.detail) / -CREASE, 1)
    weight = np.minimum(np.abs(guide.detail), 1.5) ** 1.5  # urgency, 0..1.84
    # A scan that is bumpy everywhere would constrain all strokes: the weight falls with the mean urgency.
    load = max(float(weight.mean()), 1e-6)
    weight = weight * (settings.detail * np.clip(np.sqrt(TYPICAL_LOAD / load), 0.6, 1.6))
    return out, weight.astype(np.float32)


def exhaustive(
    descriptors: Float[np.ndarray, "n 24"],
    band_weight: Float[np.ndarray, " n"],
    described: Float[np.ndarray, "m 24"],
    extra: Float[np.ndarray, " m"],
    exemplar: style.Exemplar,
    first: int = 0,
    jitter: Callable[[tuple[int, int]], np.ndarray] | None = None,
) -> NearestNeighbourField:
    """The pixel of least cost for every sample among all pixels, without the coherence price.

    Squares are expanded, so that the cost table is one matrix product, computed in chunks. Descriptor entries before
    `first` are left out; `jitter(shape)` is added to the costs.
    """
    pixels = np.flatnonzero(exemplar.allowed)
    linear, band = described[pixels, first : kernels.LINEAR], described[pixels, kernels.LINEAR]
    right = np.concatenate(
        [linear, band[:, None], (band**2)[:, None], ((linear**2).sum(axis=1) + extra[pixels])[:, None]], axis=1
    ).T
    weight = band_weight[:, None]
    vector, level = descriptors[:, first : kernels.LINEAR], descriptors[:, kernels.LINEAR, None]
    left = np.concatenate([-2 * vector, -2 * weight * level, weight, np.ones_like(weight)], axis=1)
    rows = max(1, CHUNK_PAIRS // len(pixels))
    best = np.empty(len(descriptors), np.int64)
    for low in range(0, len(descriptors), rows):
        costs = left[low : low + rows] @ right
        if jitter is not None:
            costs += jitter(costs.shape)
        best[low : low + rows] = costs.argmin(axis=1)
    return from_pixels(exemplar, pixels[best])


def by_guides(
    descriptors: Float[np.ndarray, "n 24"],
    band_weight: Float[np.ndarray, " n"],
    described: Float[np.ndarray, "m 24"],
    exemplar: style.Exemplar,
    rng: np.random.Generator,
) -> NearestNeighbourField:
    """Initial places from colour, direction and detail alone; near ties are broken at random."""
    nothing = np.zeros(len(described), np.float32)

    def jitter(shape: tuple[int, int]) -> np.ndarray:
        return INITIAL_JITTER * rng.random(shape, dtype=np.float32)

    return exhaustive(descriptors, band_weight, described, nothing, exemplar, kernels.PATCH, jitter)
