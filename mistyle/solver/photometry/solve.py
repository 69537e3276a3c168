"""Photometry of pictures from points of the mesh that several of them show.

Two estimates of exposures, balances and vignetting, both linear in the logarithm (`least_squares.py`):

1. Levels. A point's log radiance is the same in all pictures under the same light, but for reflections. These are
   radiance that depends on the reflected direction alone (spherical harmonics of third order, times Schlick's Fresnel
   term); what else they do is an outlier.
2. Contrasts. The standard deviation of radiance within a patch of the surface scales with the exposure, and additive
   light (lens flare, haze) does not change it. Patches count whose pattern is that of the other pictures.

The veil is then a polynomial in each picture: the difference from the points' radiance at the exposures of 2. It is
kept where it lowers the robust difference between pictures to LOWER of that of 1, and to BESIDE of what 1 leaves with
its reflections; otherwise 1 is the result. Nothing is corrected where 1 does not lower the difference to LOWER of what
reflections alone leave.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from mistyle.atlas.texels import rasterise
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, evenly_lit, shrunk_to
from mistyle.core.light import Directional, Lights, Point
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.photometry.ignored import ignored_cells
from mistyle.solver.photometry.least_squares import LinearFit, one_hot, solve
from mistyle.solver.photometry.record import (
    VEIL_TERMS,
    Photometry,
    coordinates,
    fall_terms,
    reach_of,
    unchanged,
    veil_terms,
)
from mistyle.solver.texels.observations import ObservationOptions, TexelObservations, collect_observations, points_of

SIDE = 336  # pixels along the longer side of the small pictures
ATLAS = 320  # texels a side of the atlas whose texels are the points, all sets together
OBSERVATIONS = 200_000  # most observations; points are left out evenly
LEVELS = 40_000  # most observations of the estimate from levels
PATCH, REGION = 0.12, 0.5  # sides of patches and of regions in working units: the mesh has radius 1
FACING = 0.4  # least cosine of the angle of view: sheen grows at grazing angles
DARK, BRIGHT = 0.01, 0.9  # linear values: weight 1/2 below, none above, where JPEGs are nearly saturated
PATTERN, SAMPLES = 0.8, 12  # least correlation of a patch with the other pictures, and its least number of points
PATCHES = 8  # of each picture, for the estimate by contrasts
CONTRAST_STEPS = 4
BESIDE = 1.5  # a castle with flare has 1.1, a glossy avocado without any 2.3
LOWER = 0.9
HARMONICS = 16  # spherical harmonics up to the third order
SHEEN = 8  # terms of `_sheen`
REFLECTIONS = 3  # solves for levels, each with the reflections over the radiance of the last
DARKEST = 0.2  # of the median radiance: darker points count as so bright where radiance is a divisor
AGREE = 0.02  # log: pictures whose numbers are all smaller are left as they are
FALL_RIDGE = (1e-4, 1e-3, 1e-3)  # relative precision of the vignetting's coefficients around 0
EXIF = 0.2  # standard deviation of an exposure around EXIF's, log: cameras develop each picture in their own way


@dataclass(frozen=True)
class PointSamples:
    """o observations of points. A point is a texel under one light, `patch` a small piece of the surface and `region` a
    large one; `x` is the position in the picture (`record.coordinates`), `away` the direction to the camera, `mirrored`
    its reflection and `slant` 1 - cosine of its angle with the normal. `lights` counts the different lights."""

    rgb: Float[np.ndarray, "o 3"]
    picture: Int[np.ndarray, " o"]
    point: Int[np.ndarray, " o"]
    patch: Int[np.ndarray, " o"]
    region: Int[np.ndarray, " o"]
    slant: Float[np.ndarray, " o"]
    away: Float[np.ndarray, "o 3"]
    mirrored: Float[np.ndarray, "o 3"]
    x: Float[np.ndarray, "o 2"]
    pictures: int
    lights: int


@dataclass(frozen=True)
class Response:
    """Log gain per picture and channel, and the vignetting; `covariance` of all of them in that order."""

    gain: Float[np.ndarray, "n 3"]
    vignetting: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "m m"]


def solve_photometry(
    traced: Tracer,
    captures: Captures,
    *,
    full: bool = True,
    exif: Sequence[float] = (),
    seed: int = 0,
    progress: Callable[[float], None] = lambda done: None,
) -> Photometry:
    """The photometry of `captures`, whose lights decide which pictures show the same radiance.

    `full` adds balances, vignetting and the veil to the exposures. `exif` holds a log exposure per picture, NaN where
    unknown; () uses none. Pictures that share no points with others keep their exposure, with a note.
    """
    samples = collect_points(traced, captures, seed, lambda done: progress(0.7 * done))
    alone = [c.name for k, c in enumerate(captures.cameras) if (samples.picture == k).sum() < PATCHES * SAMPLES]
    if len(captures) - len(alone) < 2:
        return unchanged(captures, ("Photometry: no two pictures share enough points under the same light.",))
    notes = [f"Photometry: {', '.join(alone)} shares too few points with other pictures."] if alone else []
    levels, (before, reflected, after) = _levels(samples, full)
    agree = after > LOWER * reflected
    chosen, veil = levels, np.zeros((len(captures), VEIL_TERMS, 3))
    progress(0.85)
    if full and not agree and (contrasts := _contrasts(samples, levels)) is not None:
        lifted = _veil(_thinned(samples, LEVELS), contrasts)
        spread = _residuals(samples, contrasts, lifted)[1]
        # Reflections are additive light too; a gloss that they explain is not a veil.
        if spread < min(BESIDE * after, LOWER * _residuals(samples, levels, veil)[1]):
            chosen, veil, after = contrasts, lifted, spread
    chosen = _with_exif(chosen, np.asarray(exif, float)) if len(exif) else chosen
    names, shapes = tuple(c.name for c in captures.cameras), tuple(c.size for c in captures.cameras)
    if agree:
        chosen = replace(chosen, gain=0 * chosen.gain, vignetting=np.zeros(3))
    residual, scale = _residuals(samples, chosen, veil)
    ignored = ignored_cells(residual, scale, samples.picture, _share(samples, captures), shapes)
    return _gauged(Photometry(
        names, chosen.gain.mean(axis=1), chosen.gain, chosen.vignetting, reach_of(samples.x), veil, (before, after),
        ignored, not agree, tuple(notes),
    ))  # fmt: skip


def _share(samples: PointSamples, captures: Captures) -> Float[np.ndarray, "o 2"]:
    """Positions of observations in their pictures, 0..1."""
    centre = np.array([np.asarray(c.centre) / c.size[::-1] for c in captures.cameras])
    scale = np.array([np.hypot(*c.size) / 2 / np.asarray(c.size[::-1]) for c in captures.cameras])
    return centre[samples.picture] + samples.x * scale[samples.picture]


def collect_points(
    traced: Tracer, captures: Captures, seed: int = 0, progress: Callable[[float], None] = lambda done: None
) -> PointSamples:
    """Observations of the mesh's points in small pictures; silhouettes, saturated pixels and shadows of known lights
    are left out."""
    mesh, lights = traced.mesh, captures.lights
    small = shrunk_to(captures if all(lights) else evenly_lit(captures), SIDE)
    texels = [rasterise(mesh, part, max(16, int(ATLAS / len(mesh.parts) ** 0.5))) for part in range(len(mesh.parts))]
    options = ObservationOptions(FACING, skies=False, move=0)
    observed = collect_observations(traced, texels, small, None, options, progress)
    x = positions(observed, small.cameras)
    position, normal, _ = points_of(texels)
    away = np.stack([camera.position for camera in small.cameras])[observed.observations.picture]
    texel = np.repeat(np.arange(len(position)), observed.seen)
    away = away - position[texel]
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    cosine = (away * normal[texel]).sum(axis=1)
    mirrored = 2 * cosine[:, None] * normal[texel] - away
    pieces = [_pieces(position, normal, side)[texel] for side in (PATCH, REGION)]
    return _chosen(observed, (x, 1 - cosine, away, mirrored, *pieces), _alike(lights), seed)


def positions(observed: TexelObservations, cameras: Sequence[Camera]) -> Float[np.ndarray, "o 2"]:
    """The observations' positions in their pictures, see `record.coordinates`."""
    x = np.zeros((len(observed.observations.rgb), 2))
    for camera, at in zip(cameras, observed.per_image, strict=True):
        row, column = np.divmod(at.pixel, camera.size[1])
        x[at.rows] = coordinates(camera, np.stack([column + at.x + 0.5, row + at.y + 0.5], axis=-1))
    return x


def _alike(lights: Sequence[Lights]) -> Int[np.ndarray, " n"]:
    """A number per picture, equal where the light of the world is the same; a light fixed to the camera never is."""
    known: list[Lights] = []
    result = []
    for k, rig in enumerate(lights):
        fixed = not any(isinstance(light, Directional | Point) and light.frame == "camera" for light in rig)
        if not fixed or rig not in known:
            known.append(rig if fixed else ())
            result.append(len(lights) + k if not fixed else len(known) - 1)
        else:
            result.append(known.index(rig))
    return np.unique(np.array(result), return_inverse=True)[1]


def _pieces(position: Float[np.ndarray, "t 3"], normal: Float[np.ndarray, "t 3"], side: float) -> np.ndarray:
    """A number per texel: cubes of this side, split by the dominant axis of the normal."""
    axis = np.abs(normal).argmax(axis=1)
    facing = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    cell = np.concatenate([np.floor(position / side).astype(np.int64), facing[:, None]], axis=1)
    return np.unique(cell, axis=0, return_inverse=True)[1].ravel()


def _chosen(observed: TexelObservations, values: tuple[np.ndarray, ...], light: np.ndarray, seed: int) -> PointSamples:
    """Samples of points that at least two pictures show in the same light, at most about OBSERVATIONS.

    `values` per observation: x, slant, direction to the camera and its reflection, patch and region.
    """
    seen, (x, slant, away, mirrored, patch, region) = observed.observations, values
    texel, lights = np.repeat(np.arange(len(observed.texel)), observed.seen), int(light.max()) + 1
    point = texel * lights + light[seen.picture]
    usable = (seen.rgb.max(axis=1) < BRIGHT) & (seen.rgb.min(axis=1) > 0)
    count = np.bincount(point[usable], minlength=len(observed.texel) * lights)
    share = OBSERVATIONS / max(int(count[count > 1].sum()), 1)
    kept = np.random.default_rng(seed).random(len(observed.texel)) < share
    rows = np.flatnonzero(usable & (count[point] > 1) & kept[texel])
    own, picture = light[seen.picture[rows]], seen.picture[rows].astype(np.int64)

    def numbers(of: np.ndarray) -> np.ndarray:
        # A point, a patch and a region belong to one light.
        return np.unique(of[rows] * lights + own, return_inverse=True)[1]

    return PointSamples(
        rgb=seen.rgb[rows].astype(float),
        picture=picture,
        point=numbers(texel),
        patch=numbers(patch),
        region=numbers(region),
        slant=slant[rows],
        away=away[rows],
        mirrored=mirrored[rows],
        x=x[rows],
        pictures=len(light),
        lights=lights,
    )


def _levels(samples: PointSamples, full: bool) -> tuple[Response, tuple[float, float, float]]:
    """The estimate from levels, and the spread of the pictures: as they are, by reflections alone, and corrected."""
    few = _thinned(samples, LEVELS)
    n, one = few.pictures, few.picture
    slant = sparse.csr_array(np.tile(_sheen(few), (3, 1)))
    if full:
        gains = one_hot(np.concatenate([3 * one + c for c in range(3)]), 3 * n)
        columns = [gains, np.tile(fall_terms(few.x), (3, 1)), slant]
        ridge = [[1e-5] * (3 * n), FALL_RIDGE, [1e-5] * SHEEN]
    else:
        columns, ridge = [one_hot(np.tile(one, 3), n)], [[1e-5] * n]
    fitted = _reflecting(few, columns, ridge)
    alone = _reflecting(few, [slant], [[1e-5] * SHEEN])
    y, weight = _logarithms(few.rgb)
    spreads = _values(y, weight, _channel_points(few)).scale, alone.scale, fitted.scale
    if full:
        return _unpacked(fitted, n), spreads
    covariance = np.zeros((3 * n + 3, 3 * n + 3))
    covariance[: 3 * n, : 3 * n] = np.kron(fitted.covariance[:n, :n], np.ones((3, 3)))
    return Response(np.repeat(fitted.x[:n, None], 3, axis=1), np.zeros(3), covariance), spreads


def _reflecting(samples: PointSamples, columns: Sequence[Any], ridge: Sequence[Sequence[float]]) -> LinearFit:
    """The solution for `columns`, with the reflections of a common light as further unknowns."""
    (y, weight), point = _logarithms(samples.rgb), _channel_points(samples)
    value = np.full(3 * (int(samples.point.max()) + 1), np.exp(np.median(y)))
    # Lights that shine one at a time have no reflections in common.
    for _ in range(REFLECTIONS if samples.lights == 1 else 1):
        reflections = [_reflections(samples, value)] if samples.lights == 1 else []
        matrix = sparse.csr_array(sparse.hstack([*columns, *reflections]))
        penalty = np.concatenate([*ridge, np.full(3 * HARMONICS * len(reflections), 1e-4)])
        fitted = solve(matrix, y, weight, point, np.tile(samples.region, 3), penalty)
        value = np.exp(fitted.point)
    return fitted


def _sheen(samples: PointSamples) -> Float[np.ndarray, "o k"]:
    """Terms of diffuse reflection's dependence on the angle of view, alike on all surfaces; under light from one side
    it depends on the side of the camera too."""
    bent = samples.slant[:, None] ** [1, 2]
    return np.concatenate([bent, bent[:, :1] * samples.away, bent[:, 1:] * samples.away], axis=1)


def _channel_points(samples: PointSamples) -> Int[np.ndarray, " o3"]:
    """The number of each channel's point value, the three channels one after the other."""
    return np.concatenate([3 * samples.point + c for c in range(3)])


def _thinned(samples: PointSamples, most: int) -> PointSamples:
    """Every k-th point, for at most about that many observations."""
    step = -(-len(samples.picture) // most)
    rows = np.flatnonzero(samples.point % step == 0)
    numbers = {
        name: np.unique(getattr(samples, name)[rows], return_inverse=True)[1] for name in ("point", "patch", "region")
    }
    values = {name: getattr(samples, name)[rows] for name in ("rgb", "picture", "slant", "away", "mirrored", "x")}
    return replace(samples, **numbers, **values)


def _logarithms(rgb: Float[np.ndarray, "o 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Log radiance and weight, the three channels one after the other."""
    weight = rgb**2 / (rgb**2 + DARK**2)
    return np.log(rgb).T.ravel(), weight.T.ravel()


def _reflections(samples: PointSamples, value: Float[np.ndarray, " p"]) -> sparse.csr_array:
    """Columns of each channel's reflected radiance over the radiance `value` of the points."""
    least = DARKEST * float(np.median(value))
    fresnel = 1 + 24 * samples.slant**5  # Schlick's, relative to its value 0.04 of a facing surface
    terms = _harmonics(samples.mirrored) * fresnel[:, None] * np.median(value)
    parts = [terms / np.maximum(value[3 * samples.point + c], least)[:, None] for c in range(3)]
    return sparse.csr_array(sparse.block_diag(parts))


def _harmonics(direction: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 16"]:
    """Real spherical harmonics up to the third order, not normalised."""
    x, y, z = direction.T
    first = [np.ones_like(x), x, y, z]
    second = [x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
    third = [x * (x * x - 3 * y * y), y * (3 * x * x - y * y), z * (x * x - y * y), x * y * z]
    third += [x * (5 * z * z - 1), y * (5 * z * z - 1), z * (5 * z * z - 3)]
    return np.stack([*first, *second, *third], axis=1)


def _unpacked(fitted: LinearFit, n: int) -> Response:
    return Response(
        fitted.x[: 3 * n].reshape(n, 3), fitted.x[3 * n : 3 * n + 3], fitted.covariance[: 3 * n + 3, : 3 * n + 3]
    )


def _gain(samples: PointSamples, response: Response) -> Float[np.ndarray, "o 3"]:
    return np.exp(response.gain[samples.picture] + (fall_terms(samples.x) @ response.vignetting)[:, None])


def _contrasts(samples: PointSamples, start: Response) -> Response | None:
    """The estimate from contrasts, beginning at `start`; None where a picture has too few patches with a pattern."""
    n, response = samples.pictures, start
    pair = samples.patch * n + samples.picture
    pairs, cell = np.unique(pair, return_inverse=True)
    count = np.bincount(cell)
    picture, patch = pairs % n, pairs // n
    mean_fall = np.stack([np.bincount(cell, term) / count for term in fall_terms(samples.x).T], axis=1)
    points = np.bincount(samples.point)

    def centred(values: np.ndarray) -> np.ndarray:
        return values - (np.bincount(cell, values) / count)[cell]

    for _ in range(CONTRAST_STEPS):
        gain = _gain(samples, response)
        rows: list[tuple[np.ndarray, ...]] = []
        for c in range(3):
            own = centred(samples.rgb[:, c] / gain[:, c])
            pattern = centred((np.bincount(samples.point, own) / points)[samples.point])
            energy, common = np.bincount(cell, own**2), np.bincount(cell, pattern**2)
            alike = np.bincount(cell, own * pattern) / np.sqrt(np.maximum(energy * common, 1e-30))
            good = np.flatnonzero((count >= SAMPLES) & (alike > PATTERN) & (energy > 0) & (common > 0))
            log_gain = np.bincount(cell, np.log(gain[:, c]))[good] / count[good]
            y = 0.5 * np.log(energy[good] / common[good]) + log_gain
            worth = np.minimum(count[good], 100) * alike[good] ** 2 / (1.02 - alike[good] ** 2)
            rows.append((y, worth, 3 * patch[good] + c, 3 * picture[good] + c, good))
        y, worth, point, unknown, good = (np.concatenate(part) for part in zip(*rows, strict=True))
        if np.bincount(unknown, minlength=3 * n).min() < PATCHES:
            return None
        columns = sparse.csr_array(sparse.hstack([one_hot(unknown, 3 * n), mean_fall[good]]))
        ridge = np.concatenate([np.full(3 * n, 1e-5), FALL_RIDGE])
        _, number = np.unique(point, return_inverse=True)
        response = _unpacked(solve(columns, y, worth, number, patch[good], ridge), n)
    return response


def _veil(samples: PointSamples, response: Response) -> Float[np.ndarray, "n 6 3"]:
    """The veil of every picture at these exposures; the least veiled picture of each channel has mean 0."""
    n, terms = samples.pictures, veil_terms(samples.x)
    o = len(terms)
    start = np.arange(o + 1) * VEIL_TERMS
    column = (samples.picture[:, None] * VEIL_TERMS + np.arange(VEIL_TERMS)).ravel()
    columns = sparse.csr_array((terms.ravel(), column, start), shape=(o, n * VEIL_TERMS))
    radiance = samples.rgb / _gain(samples, response)
    result = np.zeros((n, VEIL_TERMS, 3))
    ridge = np.tile([1e-5, *[1e-3] * 5], n)
    seen = np.bincount(samples.picture, minlength=n)
    for c in range(3):
        z = radiance[:, c]
        level = np.bincount(samples.point, z) / np.bincount(samples.point)
        weight = 1 / (level[samples.point] + 0.2 * np.median(level)) ** 2
        fitted = solve(columns, z, weight / weight.mean(), samples.point, samples.patch, ridge)
        result[..., c] = fitted.x.reshape(n, VEIL_TERMS)
        shown = np.bincount(samples.picture, columns @ fitted.x, minlength=n) / np.maximum(seen, 1)
        result[:, 0, c] -= shown[seen > 0].min()
    return result


def _residuals(samples: PointSamples, response: Response, veil: np.ndarray) -> tuple[np.ndarray, float]:
    """Each corrected observation's log difference from its point's value (o 3), and their robust scale."""
    lifted = np.maximum(np.einsum("ok,okc->oc", veil_terms(samples.x), veil[samples.picture]), 0)
    radiance = np.maximum(samples.rgb / _gain(samples, response) - lifted, 1e-4)
    fitted = _values(np.log(radiance).T.ravel(), _logarithms(samples.rgb)[1], _channel_points(samples))
    return fitted.residual.reshape(3, -1).T, fitted.scale


def _values(y: np.ndarray, weight: np.ndarray, point: np.ndarray) -> LinearFit:
    """Each point's robust value, and the residuals of y."""
    return solve(sparse.csr_array((len(y), 1)), y, weight, point, np.zeros(len(y), np.int64), np.ones(1))


def _with_exif(response: Response, exif: Float[np.ndarray, " n"]) -> Response:
    """The response with EXIF's exposures as a prior of standard deviation EXIF; their common level stays free."""
    known, n = np.flatnonzero(np.isfinite(exif)), len(exif)
    if len(known) < 2:
        return response
    # Rows: a known picture's mean log gain relative to the mean of the known ones.
    rows = np.zeros((len(known), 3 * n + 3))
    for row, k in zip(rows, known, strict=True):
        row[3 * k : 3 * k + 3] = 1 / 3
    rows -= rows.mean(axis=0)
    x = np.concatenate([response.gain.ravel(), response.vignetting])
    target = exif[known] - exif[known].mean()
    gain = (
        response.covariance @ rows.T @ np.linalg.inv(rows @ response.covariance @ rows.T + EXIF**2 * np.eye(len(known)))
    )
    x = x + gain @ (target - rows @ x)
    return Response(x[: 3 * n].reshape(n, 3), x[3 * n :], response.covariance - gain @ rows @ response.covariance)


def _gauged(found: Photometry) -> Photometry:
    """The same photometry in the gauge of `record.py`; not applied where the pictures agree already."""
    gain = found.balance
    exposure = gain.mean(axis=1)
    balance = gain - exposure[:, None]
    common = balance.mean(axis=0)
    level = exposure.mean()
    # The common gain moves into the radiance, and so into the veil.
    veil = found.veil * np.exp(common + level)
    exposure, balance = exposure - level, balance - common
    fall = abs(found.gains.edge[1])
    most = max(float(np.abs(exposure).max()), float(np.abs(balance).max()), fall, float(np.abs(veil).max()))
    notes = found.notes
    applied = found.applied and most >= AGREE
    if not applied:
        notes = (*notes, "Photometry: different exposures do not explain the pictures better; nothing was corrected.")
    return replace(found, exposure=exposure, balance=balance, veil=veil, applied=applied, notes=notes)
