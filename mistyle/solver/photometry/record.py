"""The photometry of a set of pictures, and its removal.

Picture i shows radiance L at pixel x in channel c as

    y = exp(exposure_i + balance_ic + fall(r)) · (L + veil_ic(x)),    fall(r) = a₁ r² + a₂ r⁴ + a₃ r⁶.

x is the position from the principal point in half diagonals of the picture, and r = |x|, at most the radius `reach`
that observations reach. The veil (lens flare, haze) is a polynomial of second degree. Gauge: exposures have mean 0, and
so have the balances of each picture and each channel.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, pixel_centres
from mistyle.core.capture import Captures, Loaded

VEIL_TERMS = 6
EVERYWHERE = 4.0  # a reach beyond all pictures
CORNERS = 0.95  # radius from which on observations reach the corners
FEW, SHARE = 24, 1000  # observations beyond the reach: so many, or one in so many


@dataclass(frozen=True)
class Gains:
    """Log gain per picture and channel, and the vignetting's coefficients, which hold up to the radius `reach`."""

    gain: Float[np.ndarray, "n 3"]
    vignetting: Float[np.ndarray, "3"]
    reach: float = EVERYWHERE

    @property
    def edge(self) -> tuple[float, float]:
        """The largest radius with a known fall-off, at most the corner's 1, and the log transmission there."""
        radius = min(self.reach, 1.0)
        return radius, float(fall_terms(np.array([radius, 0.0])) @ self.vignetting)

    def moved(self, change: Float[np.ndarray, " m"]) -> "Gains":
        """The gains after a change of all of them, row by row, and of the vignetting."""
        n = len(self.gain)
        return Gains(self.gain + change[: 3 * n].reshape(n, 3), self.vignetting + change[3 * n :], self.reach)


@dataclass(frozen=True)
class Photometry:
    """n pictures, in the order of their captures; logarithms are natural.

    names       the pictures' names
    exposure    log exposure, mean 0
    balance     log gain of each channel relative to the picture's exposure
    vignetting  a₁, a₂, a₃ of all pictures, up to the radius `reach`
    veil        coefficients of 1, x, y, x², xy, y² per channel, in units of the corrected radiance
    spread      robust relative difference of a point between pictures: as photographed, and corrected
    ignored     cells of each picture (a grid over it) whose points other pictures show otherwise; none where empty
    applied     False where the pictures agree already, so that nothing is corrected
    notes       sentences for the report
    """

    names: tuple[str, ...]
    exposure: Float[np.ndarray, " n"]
    balance: Float[np.ndarray, "n 3"]
    vignetting: Float[np.ndarray, "3"]
    reach: float
    veil: Float[np.ndarray, "n 6 3"]
    spread: tuple[float, float]
    ignored: tuple[Bool[np.ndarray, "_ _"], ...]
    applied: bool
    notes: tuple[str, ...]

    @property
    def gains(self) -> Gains:
        return Gains(self.exposure[:, None] + self.balance, self.vignetting, self.reach)


def corrected(captures: Captures, found: Photometry) -> Captures:
    """The captures as one camera without vignetting and veil would have taken them; negative radiance becomes 0.
    Pixels of ignored cells become invalid."""
    row = {name: k for k, name in enumerate(found.names)}

    def load(k: int) -> Loaded:
        rgb, valid = captures.load(k)
        camera = captures.cameras[k]
        number = row[camera.name]
        if found.applied:
            gain, veil = response(found, number, coordinates(camera, pixel_centres(camera.size)))
            rgb = np.maximum(rgb / gain - veil, 0).astype(np.float32)
            rgb.setflags(write=False)
        if found.ignored[number].any():
            valid = valid & ~at_size(found.ignored[number], camera.size)
            valid.setflags(write=False)
        return rgb, valid

    return Captures(captures.cameras, captures.lights, load)


def at_size(cells: Bool[np.ndarray, "r c"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """A grid of cells over a picture, at the picture's size."""
    rows, columns = (np.arange(n) * count // n for n, count in zip(size, cells.shape, strict=True))
    return cells[rows[:, None], columns]


def response(
    found: Photometry, k: int, x: Float[np.ndarray, "*n 2"]
) -> tuple[Float[np.ndarray, "*n 3"], Float[np.ndarray, "*n 3"]]:
    """Gain and veil of picture k at the positions x."""
    fall = fall_terms(x, found.reach) @ found.vignetting
    gain = np.exp(found.exposure[k] + found.balance[k] + fall[..., None])
    return gain, np.maximum(veil_terms(x) @ found.veil[k], 0)


def coordinates(camera: Camera, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Positions of pixels from the principal point, in half diagonals of the picture."""
    height, width = camera.size
    return (px - np.asarray(camera.centre)) * (2 / np.hypot(height, width))


def reach_of(x: Float[np.ndarray, "o 2"]) -> float:
    """The radius beyond which few of the observations at `x` lie: there the polynomial is a guess."""
    r = np.sort(np.hypot(*x.T))
    reach = float(r[-min(max(FEW, len(r) // SHARE), len(r))]) if len(r) else 0.0
    return reach if reach < CORNERS else EVERYWHERE


def fall_terms(x: Float[np.ndarray, "*n 2"], reach: float = EVERYWHERE) -> Float[np.ndarray, "*n 3"]:
    """r², r⁴, r⁶; beyond `reach` those of it."""
    r2 = np.minimum((x**2).sum(axis=-1), reach**2)
    return np.stack([r2, r2**2, r2**3], axis=-1)


def veil_terms(x: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 6"]:
    """1, x, y, x², xy, y²."""
    u, v = x[..., 0], x[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def without_gains(found: Photometry) -> Photometry:
    """The photometry with nothing to correct; its ignored cells stay."""
    zeros = {name: 0 * getattr(found, name) for name in ("exposure", "balance", "vignetting", "veil")}
    return replace(found, **zeros, reach=EVERYWHERE, applied=False)


def with_gains(found: Photometry, gains: Gains, spread: tuple[float, float]) -> Photometry:
    """The photometry with further gains, in the gauge; `gains` are in the order of its names and divide the radiance,
    and so the veil."""
    total = gains.gain + found.exposure[:, None] + found.balance
    common = total.mean(axis=0)
    exposure = (total - common).mean(axis=1)
    balance = total - common - exposure[:, None]
    vignetting, veil = found.vignetting + gains.vignetting, found.veil * np.exp(common - gains.gain)[:, None]
    changed = {"exposure": exposure, "balance": balance, "vignetting": vignetting, "veil": veil}
    return replace(found, **changed, reach=min(found.reach, gains.reach), spread=spread, applied=True)


def unchanged(captures: Captures, notes: tuple[str, ...]) -> Photometry:
    """A photometry that corrects nothing, with the reasons as notes."""
    n = len(captures)
    names = tuple(camera.name for camera in captures.cameras)
    nothing = np.zeros((n, 3))
    return Photometry(
        names, np.zeros(n), nothing, np.zeros(3), EVERYWHERE, np.zeros((n, VEIL_TERMS, 3)), (0.0, 0.0),
        (np.zeros((1, 1), bool),) * n, False, notes,
    )  # fmt: skip


def as_json(found: Photometry) -> Mapping[str, object]:
    """The solved numbers for `run.json`; exposures in stops, and the transmission at the largest observed radius."""
    (radius, fall), (ev, white) = found.gains.edge, (found.exposure / np.log(2), np.exp(found.balance))
    return {
        "applied": found.applied,
        "ev": {name: round(float(v), 4) for name, v in zip(found.names, ev, strict=True)},
        "white_balance": {name: [round(float(v), 4) for v in r] for name, r in zip(found.names, white, strict=True)},
        "vignetting": [round(float(v), 5) for v in found.vignetting],
        "edge": {"radius": round(radius, 3), "transmission": round(float(np.exp(fall)), 4)},
        "veiled": [name for name, row in zip(found.names, found.veil, strict=True) if np.abs(row).max() > 0],
        "ignored": {name: round(float(each.mean()), 4) for name, each in zip(found.names, found.ignored, strict=True)},
        "spread": [round(v, 4) for v in found.spread],
    }
