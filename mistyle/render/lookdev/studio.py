"""Noise-free pictures of an asset under the studio's environment: image-based lighting in one kernel.

The light is prefiltered once (`prefiltered`): the irradiance of every normal, and for each of ROUGHNESS the radiance
that a GGX lobe about a direction receives. The radiance of a pixel sample is

    albedo (1 - metallic) · o · E(b) / pi  +  (F0 A + B) · s · L(r, roughness)

Here b is the sample's mean unoccluded direction (its bent normal), tilted by the normal map, and o the share of open
sky (`occlusion.open_sky`). A and B are the split-sum fit of B. Karis ("Physically based shading on mobile", 2014), s
is Lagarde's specular occlusion. The environment turns with the camera, as in scenes/studio.xml.

Every ray is traced once and shades all looks (the asset with one set of maps or another). Mesh, ray tracing structure,
occlusion and light are uploaded once for any number of pictures. Maps are packed into 8 bytes a texel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt32

from mistyle.core.camera import Camera
from mistyle.core.drjit_arrays import aligned
from mistyle.core.light import Environment, environment_directions, environment_radiance, turn_about_y
from mistyle.core.maps import Maps
from mistyle.geometry.tangents import corner_tangents
from mistyle.process import memory
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred.image_samples import window
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import Tracer

# Perceptual roughness of the prefiltered maps. The first is the light itself; the last equals irradiance / pi, since
# the lobe about the normal is the cosine. Rows of all maps (with twice as many columns), and of those from COARSE on
# during filtering.
ROUGHNESS = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0)
ROWS, COARSE, COARSE_ROWS = 64, 2, 32
GOLDEN = (5**0.5 - 1) / 2
SPECULAR = 0.04  # F0 of a dielectric of index 1.5


@dataclass(frozen=True)
class StudioSky:
    """Open sky over each texture set, on grids of `size`² texels: the mean open direction (world, unit) and the share
    of the hemisphere that is open, cosine-weighted, 0..1; row 0 is v = 1."""

    size: int
    open: Float[np.ndarray, "p size size 4"]


def prefiltered(radiance: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "k rows columns 4"]:
    """Radiance by direction under the lobe of each of ROUGHNESS, from a latitude-longitude map (w = 2 h); the layout is
    that of `environment_directions`, the fourth channel is spare."""
    device.use()
    fine, coarse = _resized(radiance, ROWS), _resized(radiance, COARSE_ROWS)
    maps = [fine, *(_filtered(fine, r**2) for r in ROUGHNESS[1:COARSE])]
    maps += [_resized(_filtered(coarse, r**2), ROWS) for r in ROUGHNESS[COARSE:]]
    return np.concatenate([np.stack(maps), np.zeros((len(maps), ROWS, 2 * ROWS, 1))], axis=-1).astype(np.float32)


def _resized(radiance: Float[np.ndarray, "h w 3"], rows: int) -> Float[np.ndarray, "rows w2 3"]:
    """The map at this number of rows; with fewer rows, each is the mean over its source rows."""
    fine = max(1, 2 * len(radiance) // rows)
    light = Environment(radiance)
    # Rows lie at both poles, so with an odd refinement the coarse rows' centres are rows of the fine grid.
    fine += 1 - fine % 2
    grid = environment_directions((rows - 1) * fine + 1, 2 * rows * fine)
    samples = environment_radiance(light, grid)
    samples = np.concatenate([samples[: fine // 2][::-1], samples, samples[len(samples) - fine // 2 :][::-1]])
    return samples.reshape(rows, fine, 2 * rows, fine, 3).mean(axis=(1, 3)).astype(np.float32)


def _filtered(radiance: Float[np.ndarray, "h w 3"], alpha: float) -> Float[np.ndarray, "h w 3"]:
    """The map of mean radiance under a GGX lobe of `alpha` that is seen along its axis."""
    height, width = radiance.shape[:2]
    # Rows lie at both poles: those cover half a band.
    edge = np.clip((np.arange(height + 1) - 0.5) / (height - 1), 0, 1) * np.pi
    angle = np.repeat((np.cos(edge[:-1]) - np.cos(edge[1:]))[:, None] * 2 * np.pi / width, width, axis=1)
    sources = np.concatenate([environment_directions(height, width), angle[..., None], radiance], axis=-1)
    source = mi.Float(aligned(np.concatenate([sources.reshape(-1, 7), np.zeros((height * width, 1))], axis=1).ravel()))
    towards = mi.Vector3f(aligned(environment_directions(height, width).reshape(-1, 3).T))
    n = height * width
    a2 = dr.opaque(mi.Float, alpha**2)
    count = dr.opaque(mi.UInt32, height * width)

    def body(k: Any, total: Any, weight: Any) -> tuple[Any, ...]:
        row = dr.gather(mi.ArrayXf, source, k, shape=(8, n))
        c = dr.maximum(dr.fma(row[0], towards.x, dr.fma(row[1], towards.y, row[2] * towards.z)), 0)
        half2 = 0.5 * (1 + c)  # cos² of the angle to the half vector
        w = row[3] * c * dr.square(dr.rcp(dr.fma(half2, a2 - 1, 1)))
        return k + 1, dr.fma(mi.Color3f(row[4], row[5], row[6]), w, total), weight + w

    state = (dr.zeros(mi.UInt32, n), dr.zeros(mi.Color3f, n), dr.zeros(mi.Float, n))
    _, total, weight = dr.while_loop(state, lambda k, *_: k < count, body)
    return np.array(total / dr.maximum(weight, 1e-9)).T.reshape(height, width, 3)


def packed(maps: Maps) -> UInt32[np.ndarray, "n 2"]:
    """A set's material in 8 bytes a texel, row by row: sqrt(albedo) in 11, 11 and 10 bits; the normal's x and y in 11
    bits each, roughness in 6, metallic in 4."""
    result = np.empty((maps.roughness.size, 2), np.uint32)
    height, width = maps.roughness.shape
    band = max(1, (1 << 18) // width)
    for top in range(0, height, band):
        rows = slice(top, top + band)
        albedo = np.sqrt(np.clip(maps.albedo[rows], 0, 1)).reshape(-1, 3) * np.array([2047, 2047, 1023], np.float32)
        r, g, b = np.rint(albedo).astype(np.uint32).T
        normal = maps.normal[rows].reshape(-1, 3)
        tilt = normal[:, :2] / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        x, y = np.rint((np.clip(tilt, -1, 1) + 1) * np.float32(1023)).astype(np.uint32).T
        rough = np.rint(np.clip(maps.roughness[rows].ravel(), 0, 1) * 63).astype(np.uint32)
        metal = np.rint(np.clip(maps.metallic[rows].ravel(), 0, 1) * 15).astype(np.uint32)
        out = result[top * width : top * width + len(r)]
        out[:, 0] = r | (g << 11) | (b << 22)
        out[:, 1] = x | (y << 11) | (rough << 22) | (metal << 28)
    return result


class Studio:
    """An asset for rendering; a class because mesh, light and materials are uploaded once for all pictures."""

    def __init__(self, traced: Tracer, light: np.ndarray, sky: StudioSky, looks: Sequence[Sequence[Maps]]) -> None:
        """`light` is `prefiltered`; `looks` are one `Maps` per texture set each; sets of a look may differ in size."""
        device.use()
        self._traced, self._mesh = traced, traced.mesh
        self._light = mi.Float(aligned(light.ravel()))
        self._sky, self._sky_size = mi.Float(aligned(sky.open.ravel())), sky.size
        self._part = mi.UInt32(aligned(self._mesh.part, np.uint32))
        self._tangents = mi.Float(aligned(corner_tangents(self._mesh).ravel()))
        self._looks = [self._uploaded(look) for look in looks]

    def _uploaded(self, look: Sequence[Maps]) -> tuple[Any, ...]:
        """Texels, and for each set its offset, rows and columns."""
        sizes = [m.roughness.shape for m in look]
        first = np.cumsum([0, *(h * w for h, w in sizes)])
        texels = np.empty((int(first[-1]), 2), np.uint32)
        for start, maps in zip(first, look, strict=False):
            texels[start : start + maps.roughness.size] = packed(maps)
        columns = np.stack([first[:-1], *np.array(sizes).T]).astype(np.uint32)
        return mi.UInt32(aligned(texels.ravel(), np.uint32)), *(mi.UInt32(aligned(c, np.uint32)) for c in columns)

    def pictures(
        self, cameras: Sequence[Camera], looks: Sequence[int], spp: int = 8
    ) -> Iterator[list[Float[np.ndarray, "h w 4"]]]:
        """For each camera a picture of each of the chosen looks: linear rgb, premultiplied, and coverage; the
        background is empty. `spp` rays a pixel lie on a lattice of rank 1, the same in every pixel."""
        chosen = [self._looks[k] for k in looks]
        for camera in cameras:
            yield self._drawn(camera, chosen, spp)

    def _drawn(self, camera: Camera, looks: Sequence[tuple[Any, ...]], spp: int) -> list[Float[np.ndarray, "h w 4"]]:
        down, across = window(self._mesh, camera)
        height, width = down.stop - down.start, across.stop - across.start
        result = [np.zeros((*camera.size, 4), np.float32) for _ in looks]
        if height * width == 0:
            return result
        heading = np.degrees(np.arctan2(camera.position[0], camera.position[2]))
        numbers = [
            *camera.position,
            *camera.world_from_cam[:3, :3].ravel(),
            *turn_about_y(float(heading)).T.ravel(),
            camera.centre[0] - across.start,
            camera.centre[1] - down.start,
            camera.focal,
        ]
        # Opaque: a literal would compile one kernel per camera.
        value = [dr.opaque(mi.Float, float(v)) for v in numbers]
        n, columns = height * width, dr.opaque(mi.UInt32, width)
        rays, step = dr.opaque(mi.UInt32, spp), dr.opaque(mi.Float, 1 / spp)
        index = dr.arange(mi.UInt32, n)
        px, py = mi.Float(index % columns), mi.Float(index // columns)

        def body(k: Any, *totals: Any) -> tuple[Any, ...]:
            across, down = (mi.Float(k) + 0.5) * step, (mi.Float(k) + 0.5) * GOLDEN
            x = (px + across - value[21]) / value[23]
            y = (py + down - dr.floor(down) - value[22]) / value[23]
            away = dr.normalize(_turned(value[3:12], mi.Vector3f(x, y, 1)))
            colours = self._shaded(mi.Ray3f(mi.Point3f(*value[:3]), away), value[12:21], looks)
            return k + 1, *(total + colour for total, colour in zip(totals, colours, strict=True))

        state = (mi.UInt32(0), *(dr.zeros(mi.Vector4f, n) for _ in looks))
        _, *totals = dr.while_loop(state, lambda k, *_: k < rays, body)
        for picture, total in zip(result, totals, strict=True):
            picture[down, across] = np.array(total).T.reshape(height, width, 4) / np.float32(spp)
        return [memory.copied(picture) for picture in result] if memory.tight() else result

    def _shaded(self, ray: Any, turn: Sequence[Any], looks: Sequence[tuple[Any, ...]]) -> list[Any]:
        """(r, g, b, 1) of the ray's hit, by look; zero without a hit."""
        first = self._traced.scene.ray_intersect_preliminary(ray, coherent=True)
        point = first.compute_surface_interaction(ray, mi.RayFlags.All)
        valid = point.is_valid()
        frame = deferred.tangent_frame(point, first.prim_uv, self._tangents)
        side = dr.mulsign(mi.Float(1), -dr.dot(ray.d, frame.n))
        part = dr.gather(mi.UInt32, self._part, point.prim_index, valid)
        uv = point.uv - dr.floor(point.uv)
        sky = self._open(part, uv, valid)
        bent, share = dr.normalize(mi.Vector3f(sky.x, sky.y, sky.z)), sky.w
        bent = dr.select(side < 0, bent - 2 * dr.dot(bent, frame.n) * frame.n, bent)
        result = []
        for look in looks:
            albedo, tilt, roughness, metallic = _material(look, part, uv, valid)
            # Two-sided as in Mitsuba: on the back, the frame's normal is flipped and its tangents are not.
            tilted = frame.s * tilt.x + frame.t * tilt.y + frame.n * (side * tilt.z)
            tilted = dr.normalize(tilted)
            facing = dr.dot(tilted, -ray.d)
            # A mapped normal that faces away is shaded at a grazing angle.
            tilted = dr.normalize(tilted - dr.minimum(facing - 1e-2, 0) * -ray.d)
            cosine = dr.clip(dr.dot(tilted, -ray.d), 1e-2, 1)
            towards = dr.normalize(bent + tilted - side * frame.n)
            mirrored = ray.d + 2 * cosine * tilted
            soft = self._fetched((mi.UInt32(len(ROUGHNESS) - 1),), _turned(turn, towards))[0] * share
            glossy = self._glossy(roughness, _turned(turn, dr.normalize(mirrored)))
            hidden = dr.power(cosine + share, dr.exp2(-16 * roughness - 1))
            glossy *= dr.clip(hidden - 1 + share, 0, 1)
            f0 = dr.lerp(mi.Color3f(SPECULAR), albedo, metallic)
            a, b = _split_sum(roughness, cosine)
            colour = albedo * (1 - metallic) * soft + (f0 * a + b) * glossy
            result.append(dr.select(valid, mi.Vector4f(colour.x, colour.y, colour.z, 1), 0))
        return result

    def _open(self, part: Any, uv: Any, valid: Any) -> Any:
        """Open sky (x, y, z, share) at a texture position, bilinear."""
        size = self._sky_size
        columns = mi.UInt32(size)
        start = part * (size * size)
        return _bilinear(mi.Vector4f, self._sky, _Page(start, columns, columns), uv, valid)

    def _fetched(self, levels: Sequence[Any], towards: Any) -> list[Any]:
        """The light of the maps numbered `levels` from a unit direction (studio axes)."""
        down = dr.acos(dr.clip(towards.y, -1, 1)) * (dr.inv_pi * (ROWS - 1))
        right = dr.atan2(towards.x, -towards.z) * (dr.inv_two_pi * 2 * ROWS) + (2 * ROWS - 0.5)
        top, left = dr.minimum(dr.floor(down), ROWS - 2), dr.floor(right)
        x, y = right - left, down - top
        row, column = mi.UInt32(top) * (2 * ROWS), mi.UInt32(left)
        columns = [(column + beside) & (2 * ROWS - 1) for beside in (0, 1)]

        def at(one: Any) -> Any:
            first = one * (2 * ROWS * ROWS) + row
            pixels = [
                [dr.gather(mi.Vector4f, self._light, first + below * 2 * ROWS + c) for c in columns] for below in (0, 1)
            ]
            upper, lower = (dr.lerp(pair[0], pair[1], x) for pair in pixels)
            colour = dr.lerp(upper, lower, y)
            return mi.Color3f(colour.x, colour.y, colour.z)

        return [at(one) for one in levels]

    def _glossy(self, roughness: Any, towards: Any) -> Any:
        """Prefiltered radiance, linear between the two nearest of ROUGHNESS."""
        place = mi.Float(0)
        for low, high in pairwise(ROUGHNESS):
            place += dr.clip((roughness - low) / (high - low), 0, 1)
        level = dr.minimum(dr.floor(place), len(ROUGHNESS) - 2)
        below, above = self._fetched((mi.UInt32(level), mi.UInt32(level) + 1), towards)
        return dr.lerp(below, above, place - level)


def _turned(matrix: Sequence[Any], vector: Any) -> Any:
    """A 3 x 3 matrix, row by row, times a vector."""
    rows = [matrix[3 * r] * vector.x + matrix[3 * r + 1] * vector.y + matrix[3 * r + 2] * vector.z for r in range(3)]
    return mi.Vector3f(*rows)


def _material(look: tuple[Any, ...], part: Any, uv: Any, valid: Any) -> tuple[Any, Any, Any, Any]:
    """Albedo, tangent-space normal (not unit), roughness and metallic at a texture position, bilinear."""
    texels, starts, rows, columns = look
    start, height, width = (dr.gather(mi.UInt32, a, part, valid) for a in (starts, rows, columns))

    def unpacked(word: Any) -> Any:
        r, g, b = word.x & 2047, (word.x >> 11) & 2047, word.x >> 22
        x, y = mi.Float(word.y & 2047) / 1023 - 1, mi.Float((word.y >> 11) & 2047) / 1023 - 1
        z = dr.sqrt(dr.maximum(1 - dr.fma(x, x, y * y), 0))
        rough, metal = mi.Float((word.y >> 22) & 63) / 63, mi.Float(word.y >> 28) / 15
        light = [dr.square(mi.Float(c) / most) for c, most in ((r, 2047), (g, 2047), (b, 1023))]
        return mi.ArrayXf(*light, x, y, z, rough, metal)

    values = _bilinear(mi.Vector2u, texels, _Page(start, height, width), uv, valid, unpacked)
    return (
        mi.Color3f(values[0], values[1], values[2]),
        mi.Vector3f(values[3], values[4], values[5]),
        values[6],
        values[7],
    )


class _Page(NamedTuple):
    """Offset of a page in a table, and its size in texels."""

    start: Any
    height: Any
    width: Any


def _bilinear(kind: Any, table: Any, page: _Page, uv: Any, valid: Any, unpacked: Any = lambda row: row) -> Any:
    """The value of a page at uv in [0, 1), v down as in Mitsuba; pages repeat."""
    start, height, width = page
    x, y = uv.x * mi.Float(width) - 0.5, uv.y * mi.Float(height) - 0.5
    left, top = dr.floor(x), dr.floor(y)

    def texel(dx: int, dy: int) -> Any:
        column = mi.UInt32(mi.Int32(left) + dx + mi.Int32(width)) % dr.maximum(width, 1)
        row = mi.UInt32(mi.Int32(top) + dy + mi.Int32(height)) % dr.maximum(height, 1)
        return unpacked(dr.gather(kind, table, start + row * width + column, valid))

    s, t = x - left, y - top
    upper = texel(0, 0) * (1 - s) + texel(1, 0) * s
    lower = texel(0, 1) * (1 - s) + texel(1, 1) * s
    return upper * (1 - t) + lower * t


def _split_sum(roughness: Any, cosine: Any) -> tuple[Any, Any]:
    """Factors A and B of F0 A + B: the share of a uniform environment that a GGX surface reflects."""
    x, y = 1 - roughness, dr.fma(roughness, -0.0275, 0.0425)
    z, w = dr.fma(roughness, -0.572, 1.04), dr.fma(roughness, 0.022, -0.04)
    share = dr.minimum(dr.square(x), dr.exp2(-9.28 * cosine)) * x + y
    return dr.fma(share, -1.04, z), dr.fma(share, 1.04, w)
