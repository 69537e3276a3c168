"""Painting the surface: guided patch synthesis, coarse to fine, on a hierarchy of surface samples.

After Image Analogies (Hertzmann et al. 2001), surface texture synthesis (Turk 2001, Wei and Levoy 2001) and the
energy of StyLit (Fiser et al. 2016). A sample s has a 5x5 patch of neighbours in its tangent plane and takes the
place p (page, x, y) of the painting with the least

    |D_p - D_s|^2 + detail w(s) (band_p - relief std(band) d_s)^2 + variety use(p) / wanted use(p)
        + stroke_coherence * sum over 4 neighbours of seam [1 if on another page, else min(jump^2, 4) / 4]

(down to a fifth at creases and ridges, where a stroke may end; about neighbours at which a copied piece has got too
large, staying near costs instead: surface/pieces.py), where D joins 16 principal components of the patch (Lab / 100,
over 5), the large-area colour (weights 1, 0.6, 0.6 times `palette`, five times that for paintings of two tones) and the
stroke direction (`orientation`); d_s is the detail guide, w(s) = min(|d_s|, 1.5)^1.5, jump the distance in pixels from
where the neighbour's picture would go on, and seam (0.3 to 1) how different the neighbour's picture, gone on with, and
p look there: after the seam cost of graph-cut textures (Kwatra et al. 2003).

The search is deterministic: all places are tried for all samples on the coarse levels; on every level a sample tries
to go on with its neighbours' pictures (coherent search, Ashikhmin 2001) and a fixed set of steps about its own place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.mesh import Mesh
from mistyle.surface import kernels, style
from mistyle.surface.chosen import settled
from mistyle.surface.creases import CREASE
from mistyle.surface.glaze import glaze
from mistyle.surface.guides import Content, Guide, Occlusion, guides
from mistyle.surface.linefield import Course, directions, line_field
from mistyle.surface.lookup import Solution, solution
from mistyle.surface.pieces import labels, too_far
from mistyle.surface.samples import Level, nearest, sample_normals, spread, with_tables
from mistyle.surface.settings import PlainSettings, ResolvedSettings, SurfaceSettings

__all__ = ["SurfaceSettings", "hierarchy", "solve", "synthesise"]

LINE_POINTS = 7_500
FULL_SIZE = 512  # long side of the painting on the finest level at 250,000 samples and stroke_scale 1
LEAST_SIZE = 16  # and the least on the coarsest level
LEAST_SAMPLES = 48  # on the coarsest level
ROUNDS = (10, 8, 6, 6, 6)  # searches and votes from the coarsest level on; further levels take the last
FINE_ROUNDS = 4  # on levels beyond the fifth
SWEEPS = 3  # passes of the coherent search in each round
ALL_PAIRS = 1.2e9  # sample-pixel pairs up to which all are tried, summed over the rounds of a level
CHUNK_PAIRS = 8_000_000
LOOSE = 0.8  # share of the price of leaving a stroke that is not due where the detail guide is at its strongest
INITIAL_JITTER = 0.004
CHROMA = 0.6
TWO_TONES = 5.0  # how many times as much the large-area colour of a painting without middle tones counts
LEAST_WANTED = 0.1
LEAST_AROUND = 4.0  # pixels about the end of a piece that count as the same piece
TYPICAL_LOAD = 0.35  # mean urgency of detail at which its weight is the setting's
UNREACHABLE = 1e3  # descriptor of pixels that must not be used: farther than anything else


@dataclass(frozen=True)
class Choice:
    """Which place of the book each sample takes; x, y in pixels of that page (index coordinates)."""

    page: Int[np.ndarray, " n"]
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Pins:
    """Colours (Lab / 100) that samples have already: where `known`, they stand in the place of the vote's."""

    known: Bool[np.ndarray, " n"]
    colour: Float[np.ndarray, "n 3"]


def solve(
    mesh: Mesh,
    picture_rgb: Float[np.ndarray, "h w 3"],
    settings: SurfaceSettings | ResolvedSettings,
    seed: int,
    occlusion: Occlusion,
    progress: Callable[[float], None] = lambda done: None,
    *,
    alpha: Float[np.ndarray, "h w"] | None = None,
    content: Content | None = None,
    course: Course | None = None,
    device: str = "llvm",
) -> Solution:
    """Paint `mesh` in the style of `picture_rgb` (encoded sRGB, 0..1), of whose transparent parts nothing is used.

    `occlusion(positions, normals)` gives the share of open sky at points of the surface, 0..1; `course` where strokes
    shall run. The answer holds for any point of the surface (`lookup.colour`) at the painting's own resolution. 250,000
    samples take about 20 CPU seconds and 0.9 GB. Raises InputRefused for a mesh without area and for an unusable
    picture. It copies pieces of the painting: recognisable objects in it (a star, an eye) may appear on the surface.
    """
    dj = kernels.module(device)
    settings = settled(picture_rgb, alpha, settings)
    begun = lambda done: progress(0.25 * done)  # noqa: E731
    painting, levels, wanted = prepared(mesh, picture_rgb, settings, seed, occlusion, begun, alpha, content, course, dj)
    progress(0.35)
    choice, book = synthesise(levels, wanted, painting, settings, seed, dj, lambda done: progress(0.35 + 0.65 * done))
    laid = glaze(levels, wanted[-1], book.lab[pixels(book, choice), 0], book, settings)
    piece = labels(levels[-1], book, choice.page, choice.x, choice.y)
    kinds = {"borders": settings.borders, "look_up": settings.look_up}
    return solution(levels[-1], choice.page, choice.x, choice.y, book.size, painting.rgb, laid, piece, **kinds)


def prepared(
    mesh: Mesh,
    picture_rgb: Float[np.ndarray, "h w 3"],
    settings: ResolvedSettings,
    seed: int,
    occlusion: Occlusion,
    progress: Callable[[float], None],
    alpha: Float[np.ndarray, "h w"] | None,
    content: Content | None,
    course: Course | None,
    dj: ModuleType,
) -> tuple[style.Painting, list[Level], list[Guide]]:
    """What the search begins from: the painting, the samples coarse to fine, and what each of them asks for."""
    painting = style.prepare(picture_rgb, settings.crop, alpha)
    levels = hierarchy(mesh, settings, seed, dj, progress, course)
    rng = np.random.default_rng([seed, 2])
    palette = style.palette(painting, settings.liveliness, rng, settings.palette_mix)
    wanted = guides(levels, palette, occlusion, settings, rng, content)
    return painting, levels, wanted


def level_count(settings: ResolvedSettings) -> int:
    """Levels for these samples and strokes: one more per doubling of the painting's size in samples, so that the
    coarsest level sees the same share of it; fewer where its painting or its samples would be too few."""
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
    course: Course | None = None,
) -> list[Level]:
    """Samples, frames along the strokes and neighbour tables, coarse to fine, four times as many each level."""
    normals = sample_normals(mesh)
    rng = np.random.default_rng([seed, 1])
    field = line_field(spread(mesh, normals, LINE_POINTS, rng, dj), settings.direction, course)
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
    levels: Sequence[Level],
    wanted: Sequence[Guide],
    painting: style.Painting,
    settings: ResolvedSettings,
    seed: int,
    dj: ModuleType,
    progress: Callable[[float], None] = lambda done: None,
    *,
    pins: Sequence[Pins] | None = None,
) -> tuple[Choice, style.Pages]:
    """The place each sample of the finest level takes, and the pages it refers to; `pins`, one per level, hold colours
    that the painting shall go on from."""
    rng = np.random.default_rng([seed, 3])
    work = np.cumsum([0.02 + 4.0 ** (k - len(levels) + 1) for k in range(len(levels))])
    choice, book = None, None
    for index, (level, guide) in enumerate(zip(levels, wanted, strict=True)):
        finer = style.pages(
            painting, finest_size(settings) / 2 ** (len(levels) - 1 - index), settings.liveliness, settings.palette_mix
        )
        start = None
        if choice is not None and book is not None:
            start = refined(levels[index - 1], level, choice, book, finer)
        pin = pins[index] if pins is not None else None
        rounds = ROUNDS[index] if index < len(ROUNDS) else FINE_ROUNDS
        choice, book = paint_level(level, guide, finer, start, rounds, settings, rng, dj, pin), finer
        progress(float(work[index] / work[-1]))
    assert choice is not None and book is not None
    return choice, book


def refined(coarse: Level, fine: Level, choice: Choice, before: style.Pages, after: style.Pages) -> Choice:
    """Places of the finer level: those of the nearest coarse sample, moved by the exact way between the two."""
    parent = nearest(coarse.points, fine.points, 1)[1][:, 0]
    step = (fine.points.positions - coarse.points.positions[parent]) / np.float32(fine.points.spacing)
    tangent, across = coarse.tangent[parent], coarse.across[parent]
    page = choice.page[parent]
    ratio = (after.shapes / before.shapes).astype(np.float32)[page]
    y = (choice.y[parent] + 0.5) * ratio[:, 0] - 0.5 + (step * across).sum(axis=1)
    x = (choice.x[parent] + 0.5) * ratio[:, 1] - 0.5 + (step * tangent).sum(axis=1)
    turned = (tangent * fine.tangent).sum(axis=1) < 0
    height, width = after.shapes[page].astype(np.float32).T
    x, y = np.where(turned, width - 1 - x, x), np.where(turned, height - 1 - y, y)
    return within(after, np.where(turned, (page + 2) % 4, page), x, y)


def within(book: style.Pages, page: np.ndarray, x: np.ndarray, y: np.ndarray) -> Choice:
    """Places kept so far from the edges that the whole patch lies on the page."""
    height, width = book.shapes[page].T
    border = kernels.BORDER
    return Choice(
        page.astype(np.int32),
        np.clip(x, border, width - 1 - border).astype(np.float32),
        np.clip(y, border, height - 1 - border).astype(np.float32),
    )


def paint_level(
    level: Level,
    guide: Guide,
    pages: style.Pages,
    start: Choice | None,
    rounds: int,
    settings: ResolvedSettings,
    rng: np.random.Generator,
    dj: ModuleType,
    pins: Pins | None = None,
) -> Choice:
    """Search and vote, `rounds` times over, from `start` or (None) from what the guides alone ask for."""
    basis = style.patch_basis(pages, rng)
    guide_scale = guide_weights(settings, pages)
    described = described_pages(pages, guide_scale)
    axes, mean = kernels.floats(dj, basis.axes / 5), kernels.floats(dj, basis.mean)
    lab = kernels.floats(dj, pages.lab)
    patches = kernels.describe_pixels(dj, lab, pages.shapes, axes, mean).numpy().reshape(-1, kernels.PATCH)
    described[pages.allowed, : kernels.PATCH] = patches[pages.allowed]
    asked, band_weight = described_guide(guide, pages, settings, guide_scale)
    if start is None:
        start = by_guides(asked, band_weight, described, pages, rng)
    table = kernels.tables(dj, level.neighbours, level.turned, level.offsets)
    book = kernels.Book(
        height=kernels.floats(dj, pages.shapes[:, 0]),
        width=kernels.floats(dj, pages.shapes[:, 1]),
        start=kernels.whole(dj, pages.starts),
        colour=lab,
        descriptor=kernels.floats(dj, described),
        origin=kernels.whole(dj, pages.origin),
    )
    weight = kernels.floats(dj, band_weight)
    typical = float(described[pages.allowed, : kernels.SEEN].var(axis=0).sum())
    prices = kernels.floats(dj, np.array([settings.stroke_coherence, settings.variety, 1 / max(typical, 1e-6)]))
    place = on_device(dj, start)
    complete = min(rounds, int(ALL_PAIRS // (len(asked) * len(described))))
    for turn in range(rounds):
        colour = kernels.vote(dj, table, book, place)
        if pins is not None:
            colour = kernels.floats(dj, np.where(pins.known[:, None], pins.colour, colour.numpy().reshape(-1, 3)))
        asked[:, : kernels.PATCH] = kernels.describe(dj, table, colour, axes, mean).numpy().reshape(-1, kernels.PATCH)
        wanted = kernels.Wanted(kernels.floats(dj, asked), weight)
        also = None
        if turn < complete:
            costs = settings.variety * usage(pages, on_host(place))[pages.origin]
            also = on_device(dj, exhaustive(asked, band_weight, described, costs, pages))
        for _ in range(SWEEPS):
            here = on_host(place)
            use = kernels.floats(dj, usage(pages, here))
            # Only where all places are tried is there a way out of a piece; finer levels redraw what these decided.
            bound = settings.largest_piece < 1 and complete > 0
            ends = ends_of_pieces(level, pages, here, settings.largest_piece, dj) if bound else None
            place = kernels.search(dj, table, book, place, wanted, use, prices, also, ends)[1]
    return on_host(place)


def ends_of_pieces(level: Level, pages: style.Pages, choice: Choice, largest: float, dj: ModuleType) -> kernels.Ends:
    """Where no neighbour shall go on with the picture, since the piece is as large as it may get."""
    far = too_far(level, pages, choice.page, choice.x, choice.y, pixels(pages, choice), largest)
    height, width = pages.size
    around = max(largest * max(height, width), LEAST_AROUND)
    return kernels.Ends(kernels.floats(dj, far.astype(np.float32)), kernels.floats(dj, np.array([around])))


def guide_weights(settings: ResolvedSettings, pages: style.Pages) -> Float[np.ndarray, " 5"]:
    """Square roots of the weights of colour (L, a, b) and stroke direction (2), by which descriptors are multiplied.

    Where a painting has two tones only, its large-area colour is all that says where strokes are: it counts more.
    """
    stricter = 1 + (TWO_TONES - 1) * (1 - style.middle_tones(pages.lab[:, 0]))
    palette = settings.palette * stricter * np.array([1, CHROMA, CHROMA])
    return np.sqrt(np.concatenate([palette, [settings.orientation] * 2])).astype(np.float32)


def described_pages(pages: style.Pages, guide_scale: Float[np.ndarray, " 5"]) -> Float[np.ndarray, "m 24"]:
    """Descriptor of every pixel of the book, its patch left empty, in the layout that `kernels.search` reads."""
    out = np.zeros((len(pages.lab), kernels.WIDTH), np.float32)
    out[:, 16:19] = pages.broad * guide_scale[:3]
    out[:, 19:21] = pages.grain * guide_scale[3:]
    out[:, 21] = pages.band
    out[~pages.allowed] = UNREACHABLE
    return out


def described_guide(
    guide: Guide, pages: style.Pages, settings: ResolvedSettings, guide_scale: Float[np.ndarray, " 5"]
) -> tuple[Float[np.ndarray, "n 24"], Float[np.ndarray, " n"]]:
    """What every sample asks for, its patch left empty, and how much the band matters to it."""
    out = np.zeros((len(guide.detail), kernels.WIDTH), np.float32)
    out[:, 16:19] = guide.colour * guide_scale[:3]
    out[:, 19] = guide.directed * guide_scale[3]
    out[:, 21] = guide.detail * np.float32(settings.relief * pages.band.std())
    out[:, kernels.CLOSED] = 1 - LOOSE * np.minimum(np.abs(guide.detail) / -CREASE, 1)
    weight = urgency(guide.detail)
    # A scan that is bumpy all over would leave no stroke free: the more of it asks, the less each place may.
    load = max(float(weight.mean()), 1e-6)
    weight = weight * (settings.detail * np.clip(np.sqrt(TYPICAL_LOAD / load), 0.6, 1.6))
    return out, weight.astype(np.float32)


def urgency(detail: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """How much a detail guide matters at its own size, 0..1.84."""
    return np.minimum(np.abs(detail), 1.5) ** 1.5


def exhaustive(
    asked: Float[np.ndarray, "n 24"],
    band_weight: Float[np.ndarray, " n"],
    described: Float[np.ndarray, "m 24"],
    extra: Float[np.ndarray, " m"],
    pages: style.Pages,
    first: int = 0,
    jitter: Callable[[tuple[int, int]], np.ndarray] | None = None,
) -> Choice:
    """The pixel of least cost for every sample among all pixels, without the price of leaving a stroke.

    Squares are expanded, so that the whole table of costs is one matrix product; it is made in chunks. Entries before
    `first` of the descriptors are left out; `jitter(shape)` is added to the costs.
    """
    pixels = np.flatnonzero(pages.allowed)
    linear, band = described[pixels, first : kernels.LINEAR], described[pixels, kernels.LINEAR]
    right = np.concatenate(
        [linear, band[:, None], (band**2)[:, None], ((linear**2).sum(axis=1) + extra[pixels])[:, None]], axis=1
    ).T
    weight = band_weight[:, None]
    vector, level = asked[:, first : kernels.LINEAR], asked[:, kernels.LINEAR, None]
    left = np.concatenate([-2 * vector, -2 * weight * level, weight, np.ones_like(weight)], axis=1)
    rows = max(1, CHUNK_PAIRS // len(pixels))
    best = np.empty(len(asked), np.int64)
    for low in range(0, len(asked), rows):
        costs = left[low : low + rows] @ right
        if jitter is not None:
            costs += jitter(costs.shape)
        best[low : low + rows] = costs.argmin(axis=1)
    return places(pages, pixels[best])


def by_guides(
    asked: Float[np.ndarray, "n 24"],
    band_weight: Float[np.ndarray, " n"],
    described: Float[np.ndarray, "m 24"],
    pages: style.Pages,
    rng: np.random.Generator,
) -> Choice:
    """The first choice, from colour, direction and detail alone; near ties are broken at random."""
    nothing = np.zeros(len(described), np.float32)

    def jitter(shape: tuple[int, int]) -> np.ndarray:
        return INITIAL_JITTER * rng.random(shape, dtype=np.float32)

    return exhaustive(asked, band_weight, described, nothing, pages, kernels.PATCH, jitter)


def places(pages: style.Pages, pixel: Int[np.ndarray, " n"]) -> Choice:
    """Flat pixel indices as places."""
    page = np.searchsorted(pages.starts, pixel, side="right") - 1
    rest, width = pixel - pages.starts[page], pages.shapes[page, 1]
    return Choice(page.astype(np.int32), (rest % width).astype(np.float32), (rest // width).astype(np.float32))


def pixels(pages: style.Pages, choice: Choice) -> Int[np.ndarray, " n"]:
    """The flat index of the pixel in which each place lies; the inverse of `places`."""
    row = np.rint(choice.y).astype(np.int64)
    return pages.starts[choice.page] + row * pages.shapes[choice.page, 1] + np.rint(choice.x).astype(np.int64)


def usage(pages: style.Pages, choice: Choice) -> Float[np.ndarray, " k"]:
    """How often each pixel of the unturned picture is in use, over its 5x5 neighbourhood; 1 is as often as wanted.

    A surface smaller than the picture (wide strokes) shows a part of it: once a pixel is not too often there.
    """
    height, width = pages.size
    count = np.bincount(pages.origin[pixels(pages, choice)], minlength=height * width).reshape(height, width)
    mean = max(len(choice.page) / (height * width), 1.0)
    around = cv2.blur(count.astype(np.float32), (5, 5), borderType=cv2.BORDER_CONSTANT) / np.float32(mean)
    return around.reshape(-1) / np.maximum(pages.wanted, LEAST_WANTED)


def on_device(dj: ModuleType, choice: Choice) -> kernels.Place:
    return kernels.Place(kernels.whole(dj, choice.page), kernels.floats(dj, choice.x), kernels.floats(dj, choice.y))


def on_host(place: kernels.Place) -> Choice:
    return Choice(place.page.numpy().astype(np.int32), place.x.numpy(), place.y.numpy())
