"""Painted objects whose relief, roughness and albedo are known, and their pictures, for `benchmarks.two_phase`.

The embedded painter paints the mesh: its colours are the true albedo. The true relief is a height of paint. Half of its
variance follows the painting's lightness, as the painter itself guesses; half are bristle marks that no colour shows
(plane waves of BRISTLES texel sides in space). Its root mean square slope is given. The true roughness is wet paint and
dry paint in patches that no colour shows either. Lit views come from Mitsuba's `path`, unlit views show the albedo.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.material_recovery.metrics import texel_areas
from benchmarks.material_recovery.pictures import Shot, render
from mistyle.atlas.bake import backproject, fill
from mistyle.atlas.settings import BakeSettings
from mistyle.atlas.texels import pad
from mistyle.core.asset import Asset, Picture
from mistyle.core.camera import Camera, rig
from mistyle.core.image import nearest_fill
from mistyle.core.light import SOFT, Environment, Lights, bake_environment
from mistyle.core.maps import Maps, Texels
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.geometry.tangents import corner_tangents
from mistyle.stylization.pipeline import painting
from mistyle.stylization.records import Atlas
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface.layers import PaintRelief, TexelBand, lay_relief

WET, DRY = 0.25, 0.7  # roughness of wet and of dry paint
BRISTLES, PATCHES = (12.0, 32.0), (24.0, 64.0)  # wave lengths of the bristle marks and of the patches, texel sides
WAVES = 64
PADDING = 8  # texels


@dataclass(frozen=True)
class Painted:
    """A painted object. Per texture set: `truth`, the maps to be found; `flat`, the painted albedo without relief;
    `painter`, the same with the relief and gloss that the painter guesses; `areas` of the texels."""

    asset: Asset
    atlas: Atlas
    truth: tuple[Maps, ...]
    flat: tuple[Maps, ...]
    painter: tuple[Maps, ...]
    areas: tuple[Float[np.ndarray, "h w"], ...]


def silent(done: float) -> None:
    """Progress that nobody hears."""


def painted(asset: Asset, style: Picture, atlas: Atlas, settings: Settings, slope: float, seed: int) -> Painted:
    """The object painted with `style`; `slope` is the true relief's root mean square slope."""
    from mistyle.stylization.surface.lookup import relief

    layers = painting.paint_layers(asset, style, atlas, settings, silent)
    flat, painter = painting.raised(asset, layers, atlas, settings)
    truth = []
    for part, (texels, maps) in enumerate(zip(atlas.texels, flat, strict=True)):
        side = painting.texel_side(asset, part, texels)
        place = texels.position[texels.covered], texels.normal[texels.covered]
        guessed = relief(layers.solutions[0], *place, footprint=side)[0]
        truth.append(true_maps(asset, texels, maps, guessed, side, slope, np.random.default_rng([seed, part])))
    areas = tuple(texel_areas(asset.mesh, texels) for texels in atlas.texels)
    return Painted(asset, atlas, tuple(truth), tuple(flat), tuple(painter), areas)


def true_maps(
    asset: Asset,
    texels: Texels,
    flat: Maps,
    guessed: Float[np.ndarray, "t 3"],
    side: float,
    slope: float,
    rng: np.random.Generator,
) -> Maps:
    """`flat` with the known relief and roughness. `guessed` is the painting's own gradient of each covered texel (along
    the surface, any scale), `side` the mean side of a texel in working units."""
    at = texels.covered
    points, normals = texels.position[at], texels.normal[at]
    marks = _gradient(points, side, BRISTLES, rng)
    marks -= (marks * normals).sum(axis=1, keepdims=True) * normals
    gradient = _unit_slope(_unit_slope(guessed) + _unit_slope(marks))
    roughness = WET + (DRY - WET) / (1 + np.exp(-4 * _field(points, side, PATCHES, rng)))
    made = replace(flat, normal=flat.normal.copy(), roughness=np.zeros_like(flat.roughness))
    tangents = corner_tangents(asset.mesh)
    band, relief = TexelBand(texels, slice(0, len(at)), at), PaintRelief(gradient, roughness)
    lay_relief(made, band, relief, slope, 1.0, asset.mesh, tangents)
    return replace(made, **{name: nearest_fill(getattr(made, name), at) for name in ("albedo", "normal", "roughness")})


def blank_views(asset: Asset, cameras: Sequence[Camera]) -> list[View]:
    """What the cameras see of the mesh, without colours."""
    from mistyle.render.mitsuba.draw import gbuffer, tracer

    traced, views = tracer(asset.mesh), []
    for camera in cameras:
        hits = gbuffer(traced, camera)
        cover = hits.mask.astype(np.float32)
        black = np.zeros_like(hits.position)
        views.append(View(camera, black, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, cover))
    return views


def cameras_of(resolution: int, views: int) -> list[Camera]:
    """The paper's rig of 16, or `views` of it, evenly chosen."""
    every = rig(RigSettings(resolution=resolution))
    return [every[k * len(every) // views] for k in range(views)]


def unlit_views(scene: Painted, cameras: Sequence[Camera]) -> list[View]:
    """Views that show the true albedo and no light."""
    return painting.unlit_views(scene.asset, scene.truth, blank_views(scene.asset, cameras), silent)


def lit_views(
    scene: Painted, maps: Sequence[Maps], cameras: Sequence[Camera], lights: Lights, spp: int, cache: Path | None = None
) -> list[View]:
    """Views of `maps` under `lights` by Mitsuba's `path`, with shadows and interreflection."""
    shots = [Shot(camera, as_environment(lights)) for camera in cameras]
    pictures = render(scene.asset.mesh, maps, shots, frame="mikkt", spp=spp, cache=cache)
    views = blank_views(scene.asset, cameras)
    return [replace(v, rgb=p[..., :3].copy(), coverage=p[..., 3].copy()) for v, p in zip(views, pictures, strict=True)]


def baked(scene: Painted, views: Sequence[View]) -> list[Maps]:
    """The views in the texture as they are, flat and half rough: where a stylizer that paints views leaves the fit."""
    result = []
    for texels, begin in zip(scene.atlas.texels, scene.flat, strict=True):
        found = backproject(views, texels, BakeSettings(), mesh=scene.asset.mesh)
        flat, half = np.zeros_like(begin.normal), np.full_like(begin.roughness, 0.5)
        flat[..., 2] = 1
        result.append(Maps(pad(fill(found, texels), texels, PADDING), flat, half, np.zeros_like(half), found.known))
    return result


def as_environment(lights: Lights) -> Lights:
    """The same lights; soft ones as one environment map, which the renderer of the references takes."""
    soft = tuple(light for light in lights if isinstance(light, SOFT))
    others = tuple(light for light in lights if not isinstance(light, SOFT))
    return (
        (
            *others,
            Environment(bake_environment(soft)),
        )
        if soft
        else others
    )


def _unit_slope(gradient: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Brought to a root mean square length of 1."""
    return (gradient / max(float(np.sqrt((gradient**2).sum(axis=1).mean())), 1e-9)).astype(np.float32)


def _waves(side: float, lengths: tuple[float, float], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    direction = rng.normal(size=(WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = side * np.exp(rng.uniform(np.log(lengths[0]), np.log(lengths[1]), WAVES))
    return direction * (2 * np.pi / length)[:, None], rng.uniform(0, 2 * np.pi, WAVES)


def _field(points: np.ndarray, side: float, lengths: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """About N(0, 1) at every point."""
    waves, phase = _waves(side, lengths, rng)
    return np.sqrt(2 / WAVES) * np.cos(points @ waves.T + phase).sum(axis=1)


def _gradient(points: np.ndarray, side: float, lengths: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """The gradient in space of a field whose waves all have the same slope."""
    waves, phase = _waves(side, lengths, rng)
    unit = waves / np.linalg.norm(waves, axis=1, keepdims=True)
    return -np.sin(points @ waves.T + phase) @ unit
