"""An environment map for pictures whose light nobody measured, found together with a first, coarse material.

In turn: for fixed materials a picture is linear in the light, so radiances of the cells of a latitude-longitude grid
are solved for by non-negative least squares with a smoothness term; for a fixed light the materials are fitted
(`stages/recover.py`), on a coarse atlas and small pictures. Two things cannot be told from the pictures and are set by
convention: the albedo's scale (its brightest twentieth over what was seen begins at luminance BRIGHT) and the light's
colour (its mean over the sphere is neutral); so albedo and light are right up to one factor per channel.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, resized
from mistyle.core.capture import Captures, in_memory
from mistyle.core.image import luminance
from mistyle.core.light import Environment, environment_directions
from mistyle.core.maps import Maps, Texels, flat_maps
from mistyle.core.mesh import Mesh
from mistyle.stages.recover import recover
from mistyle.stages.recover_settings import RecoverSettings
from mistyle.stages.texels import rasterise

ROWS = 12  # of the grid of cells, which is twice as wide; glossy surfaces resolve little more from pictures
SIDE = 64  # pixels along the longer side of the small pictures
ATLAS = 96  # texels along the coarse atlas's side
ROUNDS = 4
STEPS = 160  # of the coarse material fit in each round
SMOOTH = 0.02  # weight of the grid's differences, relative to the data
BRIGHT = 0.8


@dataclass(frozen=True)
class FoundLight:
    """The light, the relative residual of the small pictures after each round, and the coarse materials."""

    light: Environment
    residuals: tuple[float, ...]
    maps: tuple[Maps, ...]


def find_light(
    mesh: Mesh,
    captures: Captures,
    settings: RecoverSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
) -> FoundLight:
    """One environment, fixed to the world, for all pictures; `captures.lights` are not looked at.

    Needs views from around the object; a diffuse object shows the light only blurred. Direct light and shadows are
    modelled, light between surfaces is not.
    """
    from mistyle.render.draw import tracer
    from mistyle.render.hits import tangents_of
    from mistyle.render.shade import pack
    from mistyle.render.transport import transport

    small = [_small(captures, k) for k in range(len(captures))]
    texels = [rasterise(mesh, part, ATLAS) for part in range(len(mesh.parts))]
    maps: Sequence[Maps] = [flat_maps(ATLAS, 0.5, roughness=0.6) for _ in texels]
    traced, tangents = tracer(mesh), tangents_of(mesh, settings.frame)
    directions, angles = _grid()
    sizes = [where.covered.shape for where in texels]
    coarse = settings.model_copy(
        update={"solver": "pictures", "iterations": STEPS, "subsamples": 1, "bounces": 0, "rate": 0.01}
    )
    light, residuals = Environment(np.ones((ROWS, 2 * ROWS, 3), np.float32)), []
    for number in range(ROUNDS):
        table = pack(maps)
        systems = _Systems(len(directions))
        for camera, rgb, mask in small:
            shares = transport(traced, camera, tangents, table, sizes, directions.reshape(-1, 3), settings.model)
            systems.add(shares * angles.reshape(-1, 1), rgb.reshape(-1, 3), mask.ravel())
        light = Environment(systems.solve().astype(np.float32))
        light, maps = _scaled(light, angles, maps, texels)
        lit = in_memory(
            [camera for camera, _, _ in small],
            [(light,)] * len(small),
            [rgb for _, rgb, _ in small],
            [mask for _, _, mask in small],
        )
        found = recover(mesh, texels, lit, coarse, seed + number, start=maps)
        light, maps = _scaled(light, angles, found.maps, texels)
        residuals.append(float(np.mean(list(found.residuals.values()))))
        progress((number + 1) / ROUNDS)
    return FoundLight(light, tuple(residuals), tuple(maps))


def _small(captures: Captures, k: int) -> tuple[Camera, Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Picture k shrunk to SIDE pixels by means over the pixels that count; a pixel counts where nearly all do."""
    rgb, mask = captures.load(k)
    height, width = mask.shape
    times = max(1, -(-max(height, width) // SIDE))
    high, wide = height // times, width // times
    cells = (high, times, wide, times)
    inside = mask[: high * times, : wide * times]
    weight = inside.reshape(cells).sum(axis=(1, 3)).astype(np.float32)
    values = np.where(inside[..., None], rgb[: high * times, : wide * times], 0)
    total = values.reshape(*cells, 3).sum(axis=(1, 3))
    # What does not fill a cell at the right and lower border is cut off; the camera's centre stays where it is.
    whole = replace(captures.cameras[k], size=(high * times, wide * times))
    counts = weight > 0.9 * times * times
    return resized(whole, (high, wide)), (total / np.maximum(weight, 1)[..., None]).astype(np.float32), counts


def _grid() -> tuple[Float[np.ndarray, "d 3"], Float[np.ndarray, "h w"]]:
    """Directions of the cells and the solid angle of each (rows of an environment map, the poles among them)."""
    directions = environment_directions(ROWS, 2 * ROWS)
    theta = np.arange(ROWS) / (ROWS - 1) * np.pi
    edges = np.clip(np.stack([theta - np.pi / (ROWS - 1) / 2, theta + np.pi / (ROWS - 1) / 2]), 0, np.pi)
    bands = (np.cos(edges[0]) - np.cos(edges[1])) * np.pi / ROWS
    return directions.reshape(-1, 3), np.repeat(bands[:, None], 2 * ROWS, axis=1)


class _Systems:
    """Normal equations of the light, one per channel, added up picture by picture."""

    def __init__(self, unknowns: int) -> None:
        self.left, self.right = np.zeros((3, unknowns, unknowns)), np.zeros((3, unknowns))

    def add(
        self, shares: Float[np.ndarray, "n d 3"], rgb: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, " n"]
    ) -> None:
        # Relative errors count: a highlight must not outweigh all else.
        weight = mask / (luminance(rgb) + 0.1 * max(float(luminance(rgb)[mask].mean()) if mask.any() else 1.0, 1e-6))
        for c in range(3):
            rows = shares[:, :, c] * weight[:, None]
            self.left[c] += rows.T.astype(np.float64) @ rows
            self.right[c] += rows.T @ (rgb[:, c] * weight)

    def solve(self) -> Float[np.ndarray, "h w 3"]:
        from scipy.optimize import nnls

        smooth = _roughness()
        result = np.zeros((len(smooth), 3))
        for c in range(3):
            scale = np.trace(self.left[c]) / max(np.trace(smooth), 1e-12)
            full = self.left[c] + (SMOOTH * scale) * smooth + 1e-9 * scale * np.eye(len(smooth))
            factor = np.linalg.cholesky(full)
            result[:, c] = nnls(factor.T, np.linalg.solve(factor, self.right[c]))[0]
        return result.reshape(ROWS, 2 * ROWS, 3)


def _roughness() -> Float[np.ndarray, "d d"]:
    """Sum of squared differences of neighbouring cells, round the sphere."""
    number = np.arange(ROWS * 2 * ROWS).reshape(ROWS, 2 * ROWS)
    pairs = [(number, np.roll(number, 1, axis=1)), (number[1:], number[:-1])]
    result = np.zeros((number.size, number.size))
    for a, b in pairs:
        a, b = a.ravel(), b.ravel()
        for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            np.add.at(result, (i, j), sign)
    return result


def _scaled(
    light: Environment, angles: np.ndarray, maps: Sequence[Maps], texels: Sequence[Texels]
) -> tuple[Environment, list[Maps]]:
    """The conventions: neutral mean light, albedo's brightest twentieth from BRIGHT on; the product stays."""
    mean = (light.radiance * angles[..., None]).sum(axis=(0, 1)) / angles.sum()
    colour = mean / max(float(luminance(mean[None])[0]), 1e-9)
    seen = np.concatenate([m.albedo[t.covered & m.known] for m, t in zip(maps, texels, strict=True)])
    seen = seen if len(seen) else np.concatenate([m.albedo[t.covered] for m, t in zip(maps, texels, strict=True)])
    bright = float(np.quantile(luminance(seen * colour), 0.95))
    factor = (colour * BRIGHT / max(bright, 1e-6)).astype(np.float32)
    scaled = [replace(m, albedo=np.clip(m.albedo * factor, 0, 1).astype(np.float32)) for m in maps]
    return replace(light, radiance=(light.radiance / factor).astype(np.float32)), scaled
