"""The verbs `render` and `bake`: single stages for people who draw or paint the views themselves."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from mistyle.files.output import claim, read_written, replace_files
from mistyle.run.inputs import input_files
from mistyle.run.material_outlines import tell_views
from mistyle.run.painting import with_geometry
from mistyle.run.pipeline import write_asset
from mistyle.run.progress import Progress
from mistyle.run.settings import Settings
from mistyle.run.stages import Job
from mistyle.run.start import draw, lay_out, read, start_engines


def render_views(
    mesh: Path, out: Path, settings: Settings, progress: Progress, *, overwrite: bool = False
) -> list[Path]:
    """`mistyle render`: the views of section 4.1.1 for any mesh."""
    inputs = [*input_files(mesh), *filter(None, (settings.rig.file, settings.draw.scene))]
    claim(out, files_of_views(settings), inputs=inputs, overwrite=overwrite)
    start_engines(settings)
    with progress.stage("mesh", "read the mesh") as report:
        asset = read(mesh, settings.read, settings.atlas.size, report)
        atlas = lay_out(asset, settings, lambda done: None)
    progress.note(*asset.source.notes)
    with progress.stage("views", "render the views") as report:
        replace_files(
            out, "render", lambda folder: draw(folder, asset, atlas.start, settings, report, progress.note),
            inputs=inputs, overwrite=overwrite,
        )  # fmt: skip
    return sorted(out / name for name, entry in read_written(out).files.items() if entry.by == "render")


def files_of_views(settings: Settings) -> list[str]:
    """What a folder of views will consist of; of a rig made for the mesh, of all views that it may choose from."""
    from mistyle.core.camera import rig
    from mistyle.core.rigs import candidate_cameras
    from mistyle.files.views import file_names, read_cameras

    chosen = settings.rig
    if chosen.kind == "file":
        assert chosen.file is not None
        cameras = read_cameras(chosen.file)
    else:
        cameras = candidate_cameras(chosen) if chosen.kind == "nbv" else rig(chosen)
    return file_names([camera.name for camera in cameras], settings.draw.paper_files)


def bake_views(
    mesh: Path, views: Path, out: Path, settings: Settings, name: str, progress: Progress, *, overwrite: bool = False
) -> dict[str, Any]:
    """`mistyle bake`: anyone's pictures of known cameras projected onto the texture (section 4.1.4)."""
    from mistyle.files.views import read_views
    from mistyle.stages.backproject import backproject, fill
    from mistyle.stages.export import asset_names

    inputs = [*input_files(mesh), views]
    claim(out, [f"{name}.glb", f"{name}.json"], inputs=inputs, overwrite=overwrite)
    with progress.stage("mesh", "read the mesh") as report:
        asset = read(mesh, settings.read, settings.atlas.size, report)
        claim(out, asset_names(name, asset.mesh.parts), inputs=inputs, overwrite=overwrite)
        start_engines(settings)
        atlas = lay_out(asset, settings, lambda done: None)
    progress.note(*asset.source.notes)
    pictures = read_views(views)
    tell_views(asset.mesh, pictures, progress)
    seen_by = with_geometry(asset, pictures)
    maps = []
    with progress.stage("bake", "bake the texture") as report:
        for part, (texels, start) in enumerate(zip(atlas.texels, atlas.start, strict=True)):
            baked = backproject(seen_by, texels, settings.bake, mesh=asset.mesh)
            maps.append(replace(start, albedo=fill(baked, texels), known=baked.known))
            report((part + 1) / len(atlas.texels))
    job = Job(mesh, views, out, settings, name)
    with progress.stage("asset", "write the asset") as report:
        replace_files(
            out, "bake", lambda folder: write_asset(folder, job, asset, atlas, maps, report), inputs=inputs,
            overwrite=overwrite,
        )  # fmt: skip
    shares = [float(m.known.sum() / max(t.covered.sum(), 1)) for m, t in zip(maps, atlas.texels, strict=True)]
    painted = dict(zip(asset.mesh.parts, shares, strict=True))
    return {"asset": str(out / f"{name}.glb"), "painted": painted, "notes": list(progress.notes)}
