"""The main job from top to bottom, in the order of the paper's section 4.

Each stage is kept in the run folder under a key made of its inputs, its settings and the keys of what it stands on,
so that a killed run goes on from the last finished stage and a changed setting redoes only what depends on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset, Picture
from mistyle.core.camera import Camera, resized, rig
from mistyle.core.image import linear_from_srgb
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import face_areas
from mistyle.core.view import View
from mistyle.run.inputs import input_files
from mistyle.run.progress import Progress, Report
from mistyle.run.settings import ReadSettings, Settings, thread_count
from mistyle.run.stages import Job, Run


@dataclass(frozen=True)
class Atlas:
    """Per texture set: where each texel lies and the material that the asset brought along."""

    texels: tuple[Texels, ...]
    start: tuple[Maps, ...]


@dataclass(frozen=True)
class Baked:
    """Per texture set: the maps with the painted albedo, and by how many views each texel is seen."""

    maps: tuple[Maps, ...]
    seen: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Repaired:
    """Per texture set: the final maps and which texels were repaired."""

    maps: tuple[Maps, ...]
    mask: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Made:
    """Everything a job made, as the report wants it."""

    job: Job
    style: Picture
    asset: Asset
    atlas: Atlas
    views: Sequence[View]
    baked: Baked
    stylized: Sequence[View]
    fit: Any
    repaired: Repaired
    folder: Path


def start_engines(settings: Any) -> str:
    """Choose the Mitsuba variant and set the thread counts of Dr.Jit, torch and OpenCV; returns the variant.

    `settings` is the root record of any kind of job: its `threads` and `variant` count.
    """
    import cv2
    import torch

    from mistyle.render import device

    threads = thread_count(settings)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    return device.use(None if settings.variant == "auto" else settings.variant, threads)


def stylize(job: Job, progress: Progress) -> dict[str, Any]:
    """Mesh + one style picture -> the same mesh with stylized maps (the whole of section 4).

    Returns the paths of what was written and the figures of `run.json`. Raises a MistyleError for everything that a
    user can mend; what was finished before stays and is taken over by the next run.
    """
    from mistyle.files.read import read_picture
    from mistyle.run.summary import write_summary

    files = input_files(job.mesh)
    style = read_picture(job.style)
    with Run(job, progress) as run:
        start_engines(job.settings)
        made = _stages(run, files, style)
        from mistyle.run.pages import job_report

        run.stage(
            "report",
            ["asset"],
            [job.settings.report, job.name],
            lambda folder, r: job_report(folder, made, progress, r),
        )
        return write_summary(made, run)


def _stages(run: Run, files: Sequence[Path], style: Picture) -> Made:
    s, seed = run.job.settings, run.job.settings.seed
    asset = run.record(
        "mesh", [], [list(files), s.read, s.atlas.size], lambda r: read(run.job.mesh, s.read, s.atlas.size, r)
    )
    atlas = run.record("texels", ["mesh"], [s.atlas, s.fit.metallic], lambda r: lay_out(asset, s, r))
    views = views_stage(run, asset, atlas)
    solution = run.record(
        "surface", ["mesh"], [style.rgb, style.alpha, s.surface, seed], lambda r: paint(asset, style, s, r)
    )
    baked = run.record(
        "bake", ["texels", "views", "surface"], [s.bake], lambda r: bake(asset, solution, atlas, views, s, r)
    )
    stylized = stylized_stage(run, asset, baked, views)
    fitted = run.record("fit", ["bake", "stylized"], [s.fit, seed], lambda r: fit(asset, atlas, baked, stylized, s, r))
    repaired = run.record(
        "repair", ["fit"], [s.repair, seed], lambda r: repair(asset, atlas, baked, views, solution, fitted, s, r)
    )
    folder = run.stage(
        "asset", ["repair"], [run.job.name], lambda f, r: write_asset(f, run.job, asset, atlas, repaired.maps, r)
    )
    return Made(run.job, style, asset, atlas, views, baked, stylized, fitted, repaired, folder)


def read(path: Path, chosen: ReadSettings, size: int, report: Report) -> Asset:
    """The mesh, normalised and with UVs usable for an atlas of `size`."""
    from mistyle.files.read import read_mesh

    return read_mesh(path, uv=chosen.uv, up=chosen.up, max_faces=chosen.max_faces, size=size, progress=report)


def lay_out(asset: Asset, settings: Settings, report: Report) -> Atlas:
    """Rasterise every texture set and lay the asset's own material into it."""
    from mistyle.stages.texels import rasterise, start_maps

    texels, start = [], []
    for part in range(len(asset.mesh.parts)):
        texels.append(rasterise(asset.mesh, part, settings.atlas.size))
        metallic = "zero" if settings.fit.metallic == "zero" else "keep"
        start.append(start_maps(asset.materials[part], texels[-1], settings.atlas.size, metallic))
        report((part + 1) / len(asset.mesh.parts))
    return Atlas(tuple(texels), tuple(start))


def cameras_of(settings: Settings) -> list[Camera]:
    """The rig in visiting order, from the settings or from a file."""
    if settings.rig.kind != "file":
        return rig(settings.rig)
    from mistyle.files.cameras import read_cameras

    assert settings.rig.file is not None
    return read_cameras(settings.rig.file)


def views_stage(run: Run, asset: Asset, atlas: Atlas) -> list[View]:
    """Section 4.1.1: the views of the mesh with its own material, drawn or taken over."""
    from mistyle.files.views import read_views

    s = run.job.settings
    inputs = [s.rig, s.rig.file, s.draw, s.draw.scene, s.seed]
    folder = run.stage("views", ["texels"], inputs, lambda f, r: draw(f, asset, atlas.start, s, r))
    return read_views(folder)


def draw(folder: Path, asset: Asset, maps: Sequence[Maps], settings: Settings, report: Report) -> None:
    """Render the views and write them with their cameras and lights."""
    from mistyle.core.light import lights
    from mistyle.files.views import write_views
    from mistyle.render.draw import draw_views

    template = settings.draw.scene or "paper_views"
    views = draw_views(asset.mesh, maps, cameras_of(settings), template, settings.draw.spp, settings.seed, report)
    # What lit these very views, so that they can be fitted to.
    write_views(folder, views, lights(str(template)), paper_files=settings.draw.paper_files)


def paint(asset: Asset, style: Picture, settings: Settings, report: Report) -> Any:
    """The embedded stylizer: the whole surface painted once."""
    from mistyle.backends.embedded import solve_surface

    return solve_surface(asset.mesh, style, settings.surface, settings.seed, progress=report)


def texel_side(asset: Asset, part: int, texels: Texels) -> float:
    """The mean side of a texel on the surface, working units: what the painting is averaged over."""
    area = face_areas(asset.mesh)[asset.mesh.part == part].sum()
    return float(np.sqrt(area / max(int(texels.covered.sum()), 1)))


def bake(asset: Asset, solution: Any, atlas: Atlas, views: Sequence[View], settings: Settings, report: Report) -> Baked:
    """Section 4.1.4 for a painted surface: texels look the painting up directly; the views say who sees what."""
    from mistyle.backends.embedded import surface_colour
    from mistyle.stages.backproject import backproject
    from mistyle.stages.texels import pad

    maps, seen = [], []
    for part, (texels, start) in enumerate(zip(atlas.texels, atlas.start, strict=True)):
        albedo = np.zeros_like(start.albedo)
        at = texels.covered
        albedo[at] = linear_from_srgb(
            surface_colour(solution, texels.position[at], texels.normal[at], footprint=texel_side(asset, part, texels))
        )
        albedo = pad(albedo, texels, settings.atlas.padding)
        maps.append(replace(start, albedo=albedo, known=texels.covered))
        seen.append(backproject(views, texels, settings.bake, mesh=asset.mesh).seen)
        report((part + 1) / len(atlas.texels))
    return Baked(tuple(maps), tuple(seen))


def stylized_stage(run: Run, asset: Asset, baked: Baked, views: Sequence[View]) -> list[View]:
    """The stylized views, drawn from the painted texture so that all agree by construction."""
    from mistyle.files.views import read_views, write_views

    def write(folder: Path, report: Report) -> None:
        drawn = unlit_views(asset, baked.maps, views, report)
        write_views(folder, drawn, (), paper_files=False)

    return read_views(run.stage("stylized", ["bake", "views"], [], write))


def unlit_views(asset: Asset, maps: Sequence[Maps], views: Sequence[View], report: Report, fine: int = 2) -> list[View]:
    """Each view with its rgb replaced by the albedo seen there, `fine` x `fine` samples a pixel, premultiplied."""
    from mistyle.core.image import bilinear
    from mistyle.render.draw import gbuffer, tracer

    traced = tracer(asset.mesh)
    result = []
    for k, view in enumerate(views):
        height, width = view.camera.size
        hits = gbuffer(traced, resized(view.camera, (height * fine, width * fine)))
        rgb = np.zeros((*hits.mask.shape, 3), np.float32)
        for part, chosen in enumerate(maps):
            at = hits.mask & (hits.part == part)
            uv, (rows, columns) = hits.uv[at], chosen.roughness.shape
            px = np.stack([uv[:, 0] * columns, (1 - uv[:, 1]) * rows], axis=1)
            rgb[at] = bilinear(chosen.albedo, px, "repeat")
        rgb = rgb.reshape(height, fine, width, fine, 3).mean(axis=(1, 3))
        coverage = hits.mask.reshape(height, fine, width, fine).mean(axis=(1, 3), dtype=np.float32)
        result.append(replace(view, rgb=rgb, coverage=coverage))
        report((k + 1) / len(views))
    return result


def fit(asset: Asset, atlas: Atlas, baked: Baked, stylized: Sequence[View], settings: Settings, report: Report) -> Any:
    """Section 4.2: normal and roughness, then albedo."""
    from mistyle.stages.fit import two_phase

    return two_phase(asset.mesh, baked.maps, stylized, atlas.texels, settings.fit, seed=settings.seed, progress=report)


def repair(
    asset: Asset,
    atlas: Atlas,
    baked: Baked,
    views: Sequence[View],
    solution: Any,
    fitted: Any,
    settings: Settings,
    report: Report,
) -> Repaired:
    """Section 4.3: where the fit struggled or nothing was seen, ask the surface again and blend at the edges."""
    from mistyle.backends.embedded import surface_colour
    from mistyle.backends.fill import inpainter
    from mistyle.stages.inpaint import repair as repair_part
    from mistyle.stages.inpaint import struggle_mask

    maps, masks = [], []
    for part, texels in enumerate(atlas.texels):
        side = texel_side(asset, part, texels)

        def colours(positions: np.ndarray, normals: np.ndarray, side: float = side) -> np.ndarray:
            return linear_from_srgb(surface_colour(solution, positions, normals, footprint=side))

        mask = struggle_mask(fitted.struggle[part], fitted.touched[part], baked.seen[part], texels, settings.repair)
        rng = np.random.default_rng([settings.seed, part])
        maps.append(repair_part(fitted.maps[part], mask, texels, inpainter(colours), settings.repair, rng))
        masks.append(mask)
        report(0.3 * (part + 1) / len(atlas.texels))
    maps = settle_relief(asset, atlas, maps, masks, views, settings, lambda done: report(0.3 + 0.7 * done))
    return Repaired(tuple(maps), tuple(masks))


# Share of phase 1's steps that the repaired texels get.
SETTLING = 0.2


def settle_relief(
    asset: Asset,
    atlas: Atlas,
    maps: Sequence[Maps],
    masks: Sequence[np.ndarray],
    views: Sequence[View],
    settings: Settings,
    report: Report,
) -> list[Maps]:
    """Normal and roughness of the repaired texels, by a short phase 1 against views of the repaired atlas.

    Texels outside the masks keep their bits.
    """
    from mistyle.stages.fit import two_phase

    steps = round(settings.fit.iterations1 * SETTLING)
    if settings.fit.refine == "off" or steps == 0 or not any(mask.any() for mask in masks):
        return list(maps)
    short = settings.fit.model_copy(update={"refine": "normal-roughness", "iterations1": steps})
    targets = unlit_views(asset, maps, views, lambda done: None)
    settled = two_phase(
        asset.mesh, maps, targets, atlas.texels, short, seed=settings.seed + 1, progress=report, only=masks
    )
    return list(settled.maps)


def write_asset(folder: Path, job: Job, asset: Asset, atlas: Atlas, maps: Sequence[Maps], report: Report) -> None:
    """The files that other programs open."""
    from mistyle.stages.export import write_asset as write

    occlusion = [
        ambient(asset, part, job.settings.atlas.size, job.settings.seed, report)
        for part in range(len(asset.mesh.parts))
    ]
    from mistyle.stages.texels import pad_maps

    padded = [pad_maps(m, t, job.settings.atlas.padding) for m, t in zip(maps, atlas.texels, strict=True)]
    provenance = {"mesh": job.mesh.name, "style": job.style.name, "seed": job.settings.seed}
    write(folder, job.name, asset, padded, occlusion, atlas.texels, provenance=provenance)


def ambient(asset: Asset, part: int, size: int, seed: int, report: Report) -> np.ndarray:
    """Ambient occlusion of a texture set, computed at a quarter of the atlas: it has no finer detail than the mesh."""
    from mistyle.core.image import resize
    from mistyle.render.occlusion import ambient_occlusion
    from mistyle.stages.texels import pad, rasterise

    coarse = rasterise(asset.mesh, part, max(size // 4, 64))
    values = np.ones(coarse.covered.shape, np.float32)
    at = coarse.covered
    values[at] = ambient_occlusion(asset.mesh, coarse.position[at], coarse.normal[at], seed=seed)
    report((part + 1) / len(asset.mesh.parts))
    return np.clip(resize(pad(values, coarse, 8), (size, size)), 0, 1)


def render_views(mesh: Path, out: Path, settings: Settings, progress: Progress) -> list[Path]:
    """`mistyle render`: the views of section 4.1.1 for any mesh."""
    from mistyle.files.store import atomic_folder

    input_files(mesh)
    start_engines(settings)
    with progress.stage("mesh", "read the mesh") as report:
        asset = read(mesh, settings.read, settings.atlas.size, report)
        atlas = lay_out(asset, settings, lambda done: None)
    with progress.stage("views", "render the views") as report:
        atomic_folder(out, lambda folder: draw(folder, asset, atlas.start, settings, report))
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


def with_geometry(asset: Asset, views: Sequence[View]) -> list[View]:
    """Pictures with the depth and normals of the mesh where the files brought none: the mesh itself is the truth."""
    from mistyle.render.draw import gbuffer, tracer

    traced = tracer(asset.mesh)
    result = []
    for view in views:
        hits = gbuffer(traced, view.camera)
        result.append(
            replace(view, depth=hits.depth, normal=hits.normal, uv=hits.uv, part=hits.part, mask=hits.mask & view.mask)
        )
    return result
