"""The rows of `benchmarks.consistency`: one function each, from a scene to one picture a view, timed.

A row runs in a process of its own, so that its peak of memory is its own; kernels come from Dr.Jit's cache on disk
once any run has compiled them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import peak_gb
from benchmarks.consistency.scene import Scene, encoded, load
from mistyle.core.image import linear_from_srgb, srgb_from_linear


@dataclass(frozen=True)
class Row:
    """Encoded pictures, one per view of the scene; wall seconds of all of them; linear albedos where the row paints
    the texture itself, and the same views painted without an atlas; GB held at most, where it is not what the whole
    process did."""

    pictures: list[np.ndarray]
    seconds: float
    albedo: list[np.ndarray] | None = None
    blind: list[np.ndarray] | None = None
    held_gb: float = 0.0


def surface(scene: Scene) -> Row:
    """The embedded surface stylizer: the surface is painted once and baked to the atlas, and the views are drawn."""
    from mistyle.core.maps import flat_maps
    from mistyle.stylization.pipeline.painting import painted, unlit_views
    from mistyle.stylization.records import Atlas
    from mistyle.stylization.surface.painter import solve_surface

    start, asset = time.perf_counter(), scene.asset
    solution = solve_surface(asset.mesh, scene.style, scene.settings.surface, scene.settings.seed)
    atlas = Atlas(scene.texels, tuple(flat_maps(len(t.covered)) for t in scene.texels))
    maps = painted(asset, solution, atlas, scene.settings)
    drawn = unlit_views(asset, maps, scene.views, lambda done: None)
    seconds, held = time.perf_counter() - start, peak_gb()
    blind = without_atlas(scene, solution)
    return Row([encoded(view) for view in drawn], seconds, [m.albedo for m in maps], blind, held)


def without_atlas(scene: Scene, solution: Any) -> list[np.ndarray]:
    """Views of a painted surface that asks it for the colour of every hit, as many a pixel as `unlit` has rays."""
    from mistyle.core.camera import resized
    from mistyle.render.mitsuba.draw import gbuffer, tracer
    from mistyle.render.mitsuba.unlit import FINE
    from mistyle.stylization.surface.lookup import colour

    traced, pictures = tracer(scene.asset.mesh), []
    for view in scene.views:
        height, width = view.camera.size
        hits = gbuffer(traced, resized(view.camera, (height * FINE, width * FINE)))
        rgb = np.zeros((*hits.mask.shape, 3), np.float32)
        side = scene.settings.rig.distance / view.camera.focal / FINE
        at = hits.mask
        rgb[at] = linear_from_srgb(colour(solution, hits.position[at], hits.normal[at], footprint=side))
        rgb = rgb.reshape(height, FINE, width, FINE, 3).mean(axis=(1, 3))
        share = at.reshape(height, FINE, width, FINE).mean(axis=(1, 3), dtype=np.float32)
        pictures.append(encoded(replace(view, rgb=rgb, coverage=share)))
    return pictures


def colour_field(scene: Scene) -> Row:
    """A floor: the smooth colours that the guides ask for, without a stroke."""
    return Row(list(scene.colour), 0.0)


def per_view(scene: Scene) -> Row:
    """The same synthesis on every view's own pixels, no view knowing of another."""
    start, seed = time.perf_counter(), scene.settings.seed
    paint = view_stylizer(scene)
    drawn = [
        paint(view, None, np.random.default_rng([seed, k])) * view.mask[..., None] for k, view in enumerate(scene.views)
    ]
    seconds = time.perf_counter() - start
    return Row([srgb_from_linear(rgb) * v.mask[..., None] for rgb, v in zip(drawn, scene.views, strict=True)], seconds)


def swept(scene: Scene) -> Row:
    """The same, each view from what the earlier ones show of its surface (paper 4.1.3)."""
    from mistyle.stylization.mvst.settings import SweepSettings
    from mistyle.stylization.mvst.sweep import ViewPainter, sweep

    start = time.perf_counter()
    done = sweep(
        scene.views, ViewPainter(view_stylizer(scene), keeps_outlines=True), SweepSettings(), scene.settings.seed
    )
    seconds = time.perf_counter() - start
    found = zip(done.painted, scene.views, strict=True)
    return Row([srgb_from_linear(p.rgb) * v.mask[..., None] for p, v in found], seconds)


def view_stylizer(scene: Scene):
    """The embedded stylizer view by view."""
    from mistyle.stylization.surface.painter import stylizer

    return stylizer(scene.asset.mesh, scene.style, scene.settings.surface, scene.settings.seed)


ROWS: dict[str, Callable[[Scene], Row]] = {
    "per_view": per_view,
    "sweep": swept,
    "default": surface,
    "colour_field": colour_field,
}


def run(name: str, folder: Path, work: Callable[[Scene], Row] | None = None) -> None:
    """Compute a row of the scene in `folder` and leave it there."""
    from mistyle.jobs.start import start_engines

    scene = load(folder)
    start_engines(scene.settings)
    row = (work or ROWS[name])(scene)
    arrays: dict[str, Any] = {f"picture{k}": p for k, p in enumerate(row.pictures)}
    arrays |= {f"albedo{k}": a for k, a in enumerate(row.albedo or [])}
    arrays |= {f"blind{k}": p for k, p in enumerate(row.blind or [])}
    # The views of the scene are part of what a view-by-view stylizer needs, so they count; an outside program has its
    # own.
    peak = row.held_gb or peak_gb()
    partial = folder / f".{name}.npz"
    np.savez(partial, seconds=row.seconds, peak_gb=peak, **arrays)
    partial.replace(folder / f"{name}.npz")


def texture(scene: Scene, pictures: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """The pictures baked to the atlas, as the pipeline would: linear albedos, the view that painted each texel (-1:
    none), and the share of the texels that any view painted."""
    from mistyle.atlas.bake import backproject, fill

    views = [
        # Whole coverage: rim pixels hold pure colour, they are not mixed with a background.
        replace(view, rgb=linear_from_srgb(p), coverage=view.mask.astype(np.float32))
        for view, p in zip(scene.views, pictures, strict=True)
    ]
    baked = [backproject(views, t, scene.settings.bake, mesh=scene.asset.mesh) for t in scene.texels]
    known = sum(int(b.known.sum()) for b in baked) / max(sum(int(t.covered.sum()) for t in scene.texels), 1)
    albedo = [fill(b, t) for b, t in zip(baked, scene.texels, strict=True)]
    return albedo, [b.view.astype(np.int32) for b in baked], known
