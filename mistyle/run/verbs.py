"""The verbs `render` and `bake`: single stages for people who draw or paint the views themselves."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mistyle.core.asset import Asset
from mistyle.core.maps import Maps, Texels
from mistyle.core.view import View
from mistyle.run.budget import (
    BAKE,
    BAKE_TILED,
    BAKED,
    DRAWN,
    RENDER,
    RENDER_TILED,
    bake_counts,
    kept,
    render_counts,
    size_of,
)
from mistyle.run.inputs import input_files
from mistyle.run.painting import with_geometry
from mistyle.run.pipeline import write_asset
from mistyle.run.plan import existing
from mistyle.run.progress import Progress
from mistyle.run.settings import Settings
from mistyle.run.stages import Job
from mistyle.run.start import draw, lay_out_one, own_maps, read, start_engines


def render_views(mesh: Path, out: Path, settings: Settings, progress: Progress) -> list[Path]:
    """`mistyle render`: the views of section 4.1.1 for any mesh."""
    from mistyle.files.store import atomic_folder

    input_files(mesh)
    with kept(settings, existing(out), render_counts, RENDER, RENDER_TILED, DRAWN) as look_again:
        start_engines(settings)
        with progress.stage("mesh", "read the mesh") as report:
            asset = read(mesh, settings.read, settings.atlas.size, report)
        look_again(*size_of(asset))
        maps = own_maps(asset, settings)
        with progress.stage("views", "render the views") as report:
            atomic_folder(out, lambda folder: draw(folder, asset, maps, settings, report, progress.say))
    return sorted(out.iterdir())


def bake_views(mesh: Path, views: Path, out: Path, settings: Settings, name: str, progress: Progress) -> dict[str, Any]:
    """`mistyle bake`: anyone's pictures of known cameras projected onto the texture (section 4.1.4)."""
    from mistyle.files.store import atomic_folder
    from mistyle.files.views import read_views, view_cameras

    input_files(mesh)
    sizes = [camera.size[0] * camera.size[1] for camera in view_cameras(views)]
    with kept(settings, existing(out), partial(bake_counts, sizes), BAKE, BAKE_TILED, BAKED) as look_again:
        start_engines(settings)
        with progress.stage("mesh", "read the mesh") as report:
            asset = read(mesh, settings.read, settings.atlas.size, report)
        look_again(*size_of(asset))
        seen_by = with_geometry(asset, read_views(views))
        shares: list[float] = []
        job = Job(mesh, views, out, settings, name)
        with progress.stage("asset", "bake and write the texture") as report:
            sets = baked_sets(asset, seen_by, settings, shares)
            atomic_folder(out, lambda folder: write_asset(folder, job, asset, sets, report))
    return {"asset": str(out / f"{name}.glb"), "painted": dict(zip(asset.mesh.parts, shares, strict=True))}


def baked_sets(
    asset: Asset, views: Sequence[View], settings: Settings, shares: list[float]
) -> Iterator[tuple[Texels, Maps]]:
    """Texture set after texture set, made when it is asked for: its texels, and its own material with what the views
    show in place of the albedo. `shares` receives how much of each set some view saw."""
    for part in range(len(asset.mesh.parts)):
        # No name here holds a set: it can go before the next one is made.
        yield baked_set(asset, part, views, settings, shares)


def baked_set(
    asset: Asset, part: int, views: Sequence[View], settings: Settings, shares: list[float]
) -> tuple[Texels, Maps]:
    """One texture set of `baked_sets`."""
    from mistyle.stages.backproject import backproject, fill

    texels, start = lay_out_one(asset, part, settings)
    baked = backproject(views, texels, settings.bake, mesh=asset.mesh)
    shares.append(float(baked.known.sum() / max(texels.covered.sum(), 1)))
    return texels, replace(start, albedo=fill(baked, texels), known=baked.known)
