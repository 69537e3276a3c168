"""First stages of a painting job: the atlas with the asset's own maps, the cameras, and the views."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera, rig
from mistyle.core.maps import Maps, OwnMaps, Texels
from mistyle.core.mesh import Mesh
from mistyle.jobs.progress import Report
from mistyle.stylization.records import Atlas
from mistyle.stylization.settings import Settings


def texels_stage(run: Any, asset: Asset) -> Atlas:
    """The stage "texels" of a job that paints."""
    s = run.job.settings
    return run.record("texels", ["mesh"], [s.atlas, s.fit.metallic], lambda r: lay_out(asset, s, r))


def lay_out(asset: Asset, settings: Settings, report: Report) -> Atlas:
    """Rasterise every texture set and resample the asset's own material into it."""
    texels, start = [], []
    for part in range(len(asset.mesh.parts)):
        where, maps = lay_out_one(asset, part, settings)
        texels.append(where)
        start.append(maps)
        report((part + 1) / len(asset.mesh.parts))
    return Atlas(tuple(texels), tuple(start))


def lay_out_one(asset: Asset, part: int, settings: Settings) -> tuple[Texels, Maps]:
    """One texture set of `lay_out`."""
    from mistyle.atlas.texels import rasterise, start_maps

    texels = rasterise(asset.mesh, part, settings.atlas.size)
    metallic = "zero" if settings.fit.metallic == "zero" else "keep"
    return texels, start_maps(asset.materials[part], texels, settings.atlas.size, metallic)


def own_maps(asset: Asset, settings: Settings) -> list[OwnMaps]:
    """The asset's own material without an atlas: each map at its file's resolution."""
    from mistyle.render.lookdev.scenes import material_maps

    metallic = "zero" if settings.fit.metallic == "zero" else "keep"
    return [material_maps(material, metallic) for material in asset.materials]


def cameras_of(settings: Settings, mesh: Mesh, say: Callable[[str], None]) -> list[Camera]:
    """The rig in visiting order: from the settings, from a file, or by next-best-view selection (`say` gets its
    coverage)."""
    if settings.rig.kind == "nbv":
        from mistyle.render.mitsuba.rigs import next_best_views

        planned = next_best_views(mesh, settings.rig)
        say(planned.sentence())
        return list(planned.cameras)
    if settings.rig.kind != "file":
        return rig(settings.rig)
    from mistyle.io.cameras.camera_files import read_cameras

    assert settings.rig.file is not None
    return read_cameras(settings.rig.file)


def draw(
    folder: Path,
    asset: Asset,
    maps: Sequence[Maps],
    settings: Settings,
    report: Report,
    say: Callable[[str], None],
    read: bool = True,
) -> None:
    """Render the views and write them with their cameras and lights; `read`: whether a stylizer reads their colours."""
    from mistyle.core.light import lights
    from mistyle.io.cameras.views import write_views
    from mistyle.render.mitsuba.draw import draw_views

    template = settings.draw.scene or "paper_views"
    cameras = cameras_of(settings, asset.mesh, say)
    views = draw_views(asset.mesh, maps, cameras, template, settings.draw.samples(read), settings.seed, report)
    # The lights of these views, so that the fit can use them.
    write_views(folder, views, lights(str(template)), paper_files=settings.draw.paper_files)
