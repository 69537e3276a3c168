"""The verbs `render` and `bake`: single stages for people who draw or paint the views themselves."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from mistyle.run.inputs import input_files
from mistyle.run.painting import with_geometry
from mistyle.run.pipeline import write_asset
from mistyle.run.progress import Progress
from mistyle.run.settings import Settings
from mistyle.run.stages import Job
from mistyle.run.start import draw, lay_out, own_maps, read, start_engines


def render_views(mesh: Path, out: Path, settings: Settings, progress: Progress) -> list[Path]:
    """`mistyle render`: the views of section 4.1.1 for any mesh."""
    from mistyle.files.store import atomic_folder

    input_files(mesh)
    start_engines(settings)
    with progress.stage("mesh", "read the mesh") as report:
        asset = read(mesh, settings.read, settings.atlas.size, report)
    maps = own_maps(asset, settings)
    with progress.stage("views", "render the views") as report:
        atomic_folder(out, lambda folder: draw(folder, asset, maps, settings, report, progress.say))
    return sorted(out.iterdir())


def bake_views(mesh: Path, views: Path, out: Path, settings: Settings, name: str, progress: Progress) -> dict[str, Any]:
    """`mistyle bake`: anyone's pictures of known cameras projected onto the texture (section 4.1.4)."""
    from mistyle.files.store import atomic_folder
    from mistyle.files.views import read_views
    from mistyle.stages.backproject import backproject, fill

    input_files(mesh)
    start_engines(settings)
    with progress.stage("mesh", "read the mesh") as report:
        asset = read(mesh, settings.read, settings.atlas.size, report)
        atlas = lay_out(asset, settings, lambda done: None)
    seen_by = with_geometry(asset, read_views(views))
    maps = []
    with progress.stage("bake", "bake the texture") as report:
        for part, (texels, start) in enumerate(zip(atlas.texels, atlas.start, strict=True)):
            baked = backproject(seen_by, texels, settings.bake, mesh=asset.mesh)
            maps.append(replace(start, albedo=fill(baked, texels), known=baked.known))
            report((part + 1) / len(atlas.texels))
    job = Job(mesh, views, out, settings, name)
    with progress.stage("asset", "write the asset") as report:
        atomic_folder(out, lambda folder: write_asset(folder, job, asset, atlas, maps, report))
    shares = [float(m.known.sum() / max(t.covered.sum(), 1)) for m, t in zip(maps, atlas.texels, strict=True)]
    return {"asset": str(out / f"{name}.glb"), "painted": dict(zip(asset.mesh.parts, shares, strict=True))}
