"""Embedded matrix and curve colour profiles (ICC.1:2022) in floats, for 16-bit pictures.

Pillow's colour management supports 8 bits only. Profiles with tables (A2B0) are not read here.
"""

import struct
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.core.image import srgb_from_linear

# Linear sRGB of XYZ under D50, the profiles' white: the inverse of sRGB's own colorants (IEC 61966-2-1, adapted).
SRGB_FROM_D50 = np.linalg.inv(
    np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
)
ROWS = 2**18  # pixels converted at a time


class Unusable(ValueError):
    """A profile that is damaged, or of another kind."""


@dataclass(frozen=True)
class Profile:
    """Curves from encoded to linear (one for grey, three for RGB), and XYZ under D50 of linear values (columns)."""

    curves: tuple[Float[np.ndarray, " n"] | tuple[float, ...], ...]
    colorants: Float[np.ndarray, "3 3"] | None


def read_profile(data: bytes) -> Profile:
    """The profile in an ICC file. Raises Unusable."""
    try:
        space, pcs, count = data[16:20], data[20:24], struct.unpack_from(">I", data, 128)[0]
        table = [struct.unpack_from(">4sII", data, 132 + 12 * k) for k in range(min(count, 200))]
        tags = {name: data[start : start + size] for name, start, size in table}
        if b"A2B0" in tags or pcs != b"XYZ ":
            raise Unusable("it has tables instead of a matrix")
        if space == b"GRAY":
            return Profile((_curve(tags[b"kTRC"]),), None)
        if space != b"RGB ":
            raise Unusable(f"it is for {space.decode('ascii', 'replace').strip()} pixels")
        columns = [np.array(struct.unpack_from(">3i", tags[name], 8)) / 65536 for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        return Profile(tuple(_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC")), np.stack(columns, axis=1))
    except (struct.error, KeyError) as error:
        raise Unusable(f"it is damaged ({error})") from error


def _curve(tag: bytes) -> Float[np.ndarray, " n"] | tuple[float, ...]:
    """A table of values over 0..1, or the parameters g a b c d e f of a parametric curve (10.18)."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if count == 1:
            return (struct.unpack_from(">H", tag, 12)[0] / 256, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if len(tag) < 12 + 2 * count:
            raise Unusable("a curve is cut off")
        return np.frombuffer(tag, ">u2", count, 12).astype(np.float32) / np.float32(65535)
    if tag[:4] != b"para":
        raise Unusable("a curve of an unknown kind")
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind > 4:
        raise Unusable("a curve of an unknown kind")
    parameters = [x / 65536 for x in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", tag, 12)]
    g, a, b, c, d, e, f = (
        (*parameters, 1.0, 0.0)[:3] + (0.0,) * 4 if kind == 0 else (*parameters, *[0.0] * (7 - len(parameters)))
    )
    if kind in (1, 2):  # constant below -b/a: 0, or c
        low = c if kind == 2 else 0.0
        return (g, a, b, 0.0, -b / a if a else 0.0, low, low)
    return g, a, b, c, d, e, f


def _linear(values: Float[np.ndarray, " n"], curve: Float[np.ndarray, " n"] | tuple[float, ...]) -> np.ndarray:
    if isinstance(curve, np.ndarray):
        return np.interp(values, np.linspace(0, 1, len(curve)), curve)
    g, a, b, c, d, e, f = curve
    return np.where(values >= d, np.maximum(a * values + b, 0) ** g + e, c * values + f)


def to_srgb(pixels: Shaped[np.ndarray, "h w 3"], profile: Profile, grey: bool) -> Shaped[np.ndarray, "h w 3"]:
    """Integer pixels in the profile's colours as sRGB of the same type; colours outside sRGB are clipped. Raises
    Unusable where `grey` does not match the profile."""
    if grey != (profile.colorants is None):
        raise Unusable("it is for pixels of another kind")
    top = np.iinfo(pixels.dtype).max
    result = np.empty_like(pixels)
    step = max(1, ROWS // pixels.shape[1])
    for row in range(0, len(pixels), step):
        values = pixels[row : row + step].astype(np.float64) / top
        linear = np.stack([_linear(values[..., k], profile.curves[k % len(profile.curves)]) for k in range(3)], axis=-1)
        if profile.colorants is not None:
            linear = linear @ (SRGB_FROM_D50 @ profile.colorants).T
        encoded = srgb_from_linear(np.clip(linear, 0, 1).astype(np.float32))
        result[row : row + step] = np.rint(encoded * top).astype(pixels.dtype)
    return result
