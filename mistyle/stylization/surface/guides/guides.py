"""Guides of the synthesis at every surface point: tone, colour, and light and dark detail.

They derive from the shape alone, independent of the view: fields that follow its parts, creases and ridges. `form`
weights light from above and openness (ambient occlusion). Values are mapped to the painting's own range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mistyle.stylization.surface.guides.creases import LEAST_RELIEF, bounded, cavity_of, creases
from mistyle.stylization.surface.guides.linefield import KEY
from mistyle.stylization.surface.guides.places import light, place_fields, without
from mistyle.stylization.surface.samples import Level, SurfacePoints, carry, drop, smooth, workers
from mistyle.stylization.surface.settings import ResolvedSettings

Occlusion = Callable[[np.ndarray, np.ndarray], np.ndarray]
Content = Callable[[np.ndarray, np.ndarray], np.ndarray]  # positions, normals -> lightness 0..1 of the asset's texture
ROTATIONS = 30
LIGHTNESS_LEAD = 2.5  # spread of lightness, in spreads of chroma, during colour transport
FIELD_POINTS = 6_000  # largest number of samples for the place fields
MIDDLE, SPREAD = 0.5, 0.22  # mean and standard deviation of the place fields' tone
HOLLOW = 0.8  # tone subtracted at a full hollow, and, times CONVEX, added at a full ridge: parts end at their creases
CALM = 0.65  # share of the palette's spread of lightness, where the shape alone sets the tone
LEAST_DETAIL = 0.05  # least difference of tone between two smoothings at full detail
CONVEX = 0.4  # weight of a ridge or bulge against a hollow
LEAST_CONTENT = 0.02  # standard deviation of a texture's lightness at full weight
HIDDEN = 0.05  # share of open sky below which a point counts as invisible
STANDING = -0.85  # height of the normal below which a point counts as the underside


@dataclass(frozen=True)
class Guide:
    """Guides of one level: `colour` Lab/100 (large areas), `detail` -1.6 (dark) .. 1.6 (light), `directed` 0..1."""

    colour: Float[np.ndarray, "n 3"]
    detail: Float[np.ndarray, " n"]
    directed: Float[np.ndarray, " n"]


def level_guides(
    levels: Sequence[Level],
    palette: Float[np.ndarray, "m 3"],
    occlusion: Occlusion,
    settings: ResolvedSettings,
    rng: np.random.Generator,
    content: Content | None = None,
) -> list[Guide]:
    """Guides of all levels, coarse to fine. `palette` is Lab/100 of the blurred painting, a few thousand colours.

    `content` is the lightness of the surface's own texture; `settings.keep_content` is its share in tone and detail,
    `settings.form` that of sky light and openness, `settings.modelling` that of all hollows and bumps.
    """
    middle = max(len(levels) - 2, 0)
    base = levels[middle].points
    openness = smooth(levels[middle], occlusion(base.positions, base.normals).astype(np.float32), 1)
    fields = places(levels, base, openness)
    lit, cavity = tones(levels, openness, settings.bake_light)
    tone = [
        carry(base, MIDDLE + SPREAD * fields[:, 0], level.points) - HOLLOW * hollow
        for level, hollow in zip(levels, cavity, strict=True)
    ]
    details = mixed(creases(levels), detail(levels, tone, cavity), settings.modelling)
    if settings.form > 0:
        tone = mixed(tone, lit, settings.form)
        details = mixed(details, detail(levels, lit, cavity), settings.form)
    content_share = 0.0
    if content is not None and settings.keep_content > 0:
        lightness = [content(level.points.positions, level.points.normals).astype(np.float32) for level in levels]
        content_share = settings.keep_content * min(float(lightness[-1].std()) / LEAST_CONTENT, 1.0)
        # The texture keeps its contrast; its lightness is shifted to the tone's mean.
        own = [each + np.float32(tone[-1].mean() - lightness[-1].mean()) for each in lightness]
        details = mixed(details, detail(levels, own, [0 * each for each in own]), content_share)
        tone = mixed(tone, own, content_share)
    shown = (openness > HIDDEN) & (base.normals[:, 1] > STANDING)
    colour = colour_field(tone[middle], fields, shown, palette, rng)
    typical, spread = palette[:, 0].mean(), CALM + (1 - CALM) * max(settings.form, content_share)
    colour[:, 0] = typical + spread * (colour[:, 0] - typical)
    return [
        Guide(carry(base, colour, level.points), own, level.directed)
        for level, own in zip(levels, details, strict=True)
    ]


def mixed(
    first: Sequence[Float[np.ndarray, " _"]], second: Sequence[Float[np.ndarray, " _"]], share: float
) -> list[Float[np.ndarray, " _"]]:
    """Per level, the blend of both with the given share of the second."""
    return [(1 - share) * a + share * b for a, b in zip(first, second, strict=True)]


def places(levels: Sequence[Level], base: SurfacePoints, openness: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """`place_fields` at the points of `base`, computed on the finest level with at most FIELD_POINTS samples.

    The first, for lightness, increases upwards on average: heads and lids are light, legs and feet dark, and dark
    strokes draw features.
    """
    small = next((level for level in reversed(levels) if len(level.directed) <= FIELD_POINTS), levels[0])
    fields = carry(small.points, place_fields(small, drop(base, openness, small.points)), base)
    rest = without(fields, light(base.normals, openness))
    rest[:, 0] *= -1 if rest[:, 0] @ base.positions[:, 1] < 0 else 1
    return (rest / np.maximum(rest.std(axis=0), 1e-9)).astype(np.float32)


def tones(
    levels: Sequence[Level], openness: Float[np.ndarray, " m"], bake_light: float
) -> tuple[list[Float[np.ndarray, " _"]], list[Float[np.ndarray, " _"]]]:
    """Tone (about 0..1) and cavity (-1..1, positive in hollows) of every level.

    `openness` (ambient occlusion, 1 = open) and the cavity are from the second finest level, where they are smooth;
    each level has its own normals.
    """
    middle = levels[max(len(levels) - 2, 0)]
    coarse = levels[max(len(levels) - 3, 0)]
    fine_cavity = smooth(middle, cavity_of(middle), 1)
    broad_cavity = carry(coarse.points, smooth(coarse, cavity_of(coarse), 1), middle.points)
    hollow = (bounded(fine_cavity, 95, LEAST_RELIEF, 1) + bounded(broad_cavity, 95, LEAST_RELIEF, 1)) / 2
    # Round shapes are convex nearly everywhere: with full weight, their flat places would look like hollows.
    hollow = np.where(hollow < 0, CONVEX * hollow, hollow)
    tone, cavity = [], []
    for level in levels:
        own = level is middle
        level_openness = openness if own else carry(middle.points, openness, level.points)
        level_hollow = hollow if own else carry(middle.points, hollow, level.points)
        normals = level.points.normals
        sky = 0.5 + 0.5 * normals[:, 1]
        shade = 0.35 + 0.65 * level_openness
        key = (0.75 * (0.5 + 0.5 * normals @ KEY.astype(np.float32)) ** 1.2 + 0.25 * sky) * shade - 0.16 * level_hollow
        top = sky * shade - 0.2 * level_hollow
        tone.append((bake_light * key + (1 - bake_light) * top).astype(np.float32))
        cavity.append(level_hollow.astype(np.float32))
    return tone, cavity


def detail(
    levels: Sequence[Level], tone: Sequence[Float[np.ndarray, " _"]], cavity: Sequence[Float[np.ndarray, " _"]]
) -> list[Float[np.ndarray, " _"]]:
    """Exaggerated tone of small forms: two bands between smoothings of tone and cavity, -1.6..1.6, for every level."""
    fine, middle, coarse = levels[-1], levels[max(len(levels) - 2, 0)], levels[max(len(levels) - 3, 0)]
    sharp = smooth(fine, tone[-1] - 0.25 * cavity[-1], 1)
    medium = smooth(middle, drop(fine.points, smooth(fine, sharp, 2), middle.points), 2)
    broad = smooth(coarse, drop(middle.points, smooth(middle, medium, 2), coarse.points), 2)
    medium_here = carry(middle.points, medium, fine.points)
    broad_here = carry(coarse.points, broad, fine.points)
    small = bounded(sharp - medium_here, 92, LEAST_DETAIL, 1.5)
    large = bounded(medium_here - broad_here, 92, LEAST_DETAIL, 1.5)
    finest = np.clip(0.6 * small + 0.8 * large, -1.6, 1.6).astype(np.float32)
    softened = smooth(fine, finest, 1)
    return [drop(fine.points, softened, level.points) for level in levels[:-1]] + [finest]


def normal_scores(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Values replaced by the standard normal quantiles of their ranks."""
    from scipy.special import ndtri

    return at_quantiles(values, ndtri((np.arange(len(values)) + 0.5) / len(values)))


def at_quantiles(values: Float[np.ndarray, " n"], of: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
    """Values replaced, in rank order, by the quantiles of another set (ties by position)."""
    share = (np.arange(len(values)) + 0.5) / len(values)
    result = np.empty(len(values))
    result[np.argsort(values, kind="stable")] = np.interp(share, (np.arange(len(of)) + 0.5) / len(of), np.sort(of))
    return result


def colour_field(
    tone: Float[np.ndarray, " n"],
    fields: Float[np.ndarray, "n 3"],
    shown: Bool[np.ndarray, " n"],
    palette: Float[np.ndarray, "m 3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 3"]:
    """A smooth colour (Lab/100) at every point; over the `shown` points the palette keeps its proportions.

    Optimal transport by iterated one-dimensional transport along rotated axes (Pitie, Kokaram and Dahyot 2007), from
    (tone, second and third of `fields`) to the palette. Light points get light colours; neighbours on the surface get
    neighbours in the palette. Hidden points (the inside or underside of a pot) take no share; each gets the colour of
    the most similar shown point.
    """
    from scipy.spatial import KDTree

    seen = np.flatnonzero(shown) if shown.any() else np.arange(len(tone))
    mean, spread = palette.mean(axis=0), palette.std(axis=0)
    place = np.stack(
        [
            at_quantiles(tone[seen], palette[:, 0]),
            normal_scores(fields[seen, 1]) * spread[1] + mean[1],
            normal_scores(fields[seen, 2]) * spread[2] + mean[2],
        ],
        axis=1,
    )
    scale = np.array([np.clip(LIGHTNESS_LEAD * spread[1:].mean() / max(spread[0], 1e-6), 0.25, 4.0), 1.0, 1.0])
    colours = transport(place * scale, palette * scale, rng) / scale
    features = np.stack([tone / SPREAD, fields[:, 1], fields[:, 2]], axis=1)
    alike = KDTree(features[seen]).query(features, workers=workers())[1]
    return colours[alike].astype(np.float32)


def transport(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"], rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """The source transported to the target's distribution; ends on the unrotated axes, exact in each of them."""
    for step in range(ROTATIONS + 1):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0] if step < ROTATIONS else np.eye(3)
        turned, aim = source @ rotation, target @ rotation
        for axis in range(3):
            turned[:, axis] = at_quantiles(turned[:, axis], aim[:, axis])
        source = turned @ rotation.T
    return source
