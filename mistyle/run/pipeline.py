"""The main job from top to bottom, in the order of the paper's section 4.

Each stage is kept in the run folder under a key made of its inputs, its settings and the keys of what it stands on,
so that a killed run goes on from the last finished stage and a changed setting redoes only what depends on it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset, Picture
from mistyle.core.camera import Camera, rig
from mistyle.core.image import linear_from_srgb
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.core.view import View
from mistyle.run.generative import check as check_generative
from mistyle.run.generative import inpainter_inputs, texture_inpainter
from mistyle.run.inputs import input_files
from mistyle.run.progress import Progress, Report
from mistyle.run.settings import ReadSettings, Settings, thread_count
from mistyle.run.stages import Job, Run
from mistyle.stages.coat import Coats
from mistyle.surface.guides import Content
from mistyle.surface.lookup import Solution
from mistyle.surface.settings import CoatSettings


@dataclass(frozen=True)
class Atlas:
    """Per texture set: where each texel lies and the material that the asset brought along."""

    texels: tuple[Texels, ...]
    start: tuple[Maps, ...]


@dataclass(frozen=True)
class Baked:
    """Per texture set: the maps with the painted albedo, and by how many views each texel is seen.

    `begin` are the same maps with the painting's relief, where the fit starts at them (else empty).
    """

    maps: tuple[Maps, ...]
    seen: tuple[np.ndarray, ...]
    begin: tuple[Maps, ...] = ()


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
    check_generative(job.settings, progress.say)
    if job.settings.stylizer != "embedded":
        from mistyle.run.sweep import refuse_what_is_not_kept

        refuse_what_is_not_kept(job.settings)
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
    baked, stylized = painted_stages(run, asset, style, atlas, views)
    fitted = run.record("fit", ["bake", "stylized"], [s.fit, seed], lambda r: fit(asset, atlas, baked, stylized, s, r))
    repaired = run.record(
        "repair",
        ["fit"],
        [s.repair, seed, *inpainter_inputs(s, style)],
        lambda r: repair(asset, style, atlas, baked, views, fitted, s, r),
    )
    folder = run.stage(
        "asset", ["repair"], [run.job.name], lambda f, r: write_asset(f, run.job, asset, atlas, repaired.maps, r)
    )
    return Made(run.job, style, asset, atlas, views, baked, stylized, fitted, repaired, folder)


def painted_stages(
    run: Run, asset: Asset, style: Picture, atlas: Atlas, views: Sequence[View]
) -> tuple[Baked, list[View]]:
    """From the style to the painted texture and its views: the stages 'surface', 'bake' and 'stylized'."""
    s, seed = run.job.settings, run.job.settings.seed
    if s.stylizer != "embedded":
        from mistyle.run.sweep import swept_stages

        return swept_stages(run, asset, style, atlas, views)
    coats = run.record(
        "surface",
        ["texels"],
        [style.rgb, style.alpha, s.surface, s.coat, coat_files(s.coat), seed],
        lambda r: coat(asset, style, atlas, s, r),
    )
    baked = run.record(
        "bake", ["views", "surface"], [s.bake, s.fit.refine, s.coat], lambda r: bake(asset, coats, atlas, views, s, r)
    )
    stylized = stylized_stage(run, asset, baked, views)
    return baked, stylized


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


def cameras_of(settings: Settings, mesh: Mesh, say: Callable[[str], None]) -> list[Camera]:
    """The rig in visiting order, from the settings, from a file, or made for the mesh (then it says what it sees)."""
    if settings.rig.kind == "nbv":
        from mistyle.stages.rigs import next_best_views

        planned = next_best_views(mesh, settings.rig)
        say(planned.sentence())
        return list(planned.cameras)
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
    folder = run.stage("views", ["texels"], inputs, lambda f, r: draw(f, asset, atlas.start, s, r, run.progress.say))
    return read_views(folder)


def draw(
    folder: Path, asset: Asset, maps: Sequence[Maps], settings: Settings, report: Report, say: Callable[[str], None]
) -> None:
    """Render the views and write them with their cameras and lights."""
    from mistyle.core.light import lights
    from mistyle.files.views import write_views
    from mistyle.render.draw import draw_views

    template = settings.draw.scene or "paper_views"
    cameras = cameras_of(settings, asset.mesh, say)
    views = draw_views(asset.mesh, maps, cameras, template, settings.draw.spp, settings.seed, report)
    # What lit these very views, so that they can be fitted to.
    write_views(folder, views, lights(str(template)), paper_files=settings.draw.paper_files)


def coat_files(chosen: CoatSettings) -> list[Path]:
    """The files that a coat names: their contents count, not their names."""
    named = [chosen.style_mask, chosen.protect]
    for slot in chosen.slots:
        name, _, picture = slot.rpartition("=")
        named += [Path(name), Path(picture)]
    return [path for path in named if path is not None and path.is_file()]


def paint(asset: Asset, style: Picture, settings: Settings, report: Report, content: Content | None = None) -> Solution:
    """The surface painted once with one picture; `content` is the lightness of a texture that it has already."""
    from mistyle.backends.embedded import solve_surface

    return solve_surface(asset.mesh, style, settings.surface, settings.seed, progress=report, content=content)


def coat(asset: Asset, style: Picture, atlas: Atlas, settings: Settings, report: Report) -> Coats:
    """The embedded stylizer: the whole surface painted once with every picture that has a place on it."""
    from mistyle.files.read import read_picture
    from mistyle.stages.coat import content, masked_style, scaled, slot_masks

    surface = scaled(settings.surface, asset, settings.coat.stroke_size)
    settings = settings.model_copy(update={"surface": surface})
    paths, masks = slot_masks(asset, atlas.texels, settings.coat.slots)
    pictures = [masked_style(style, settings.coat.style_mask), *(read_picture(path) for path in paths)]
    choice = [np.zeros(texels.covered.shape, np.int32) for texels in atlas.texels]
    for number, chosen in enumerate(masks, start=1):
        for texels_of, mask in zip(choice, chosen, strict=True):
            texels_of[mask] = number
    found = content(atlas.texels, atlas.start) if surface.keep_content > 0 else None
    solutions = []
    for k, picture in enumerate(pictures):

        def part_done(done: float, k: int = k) -> None:
            report((k + done) / len(pictures))

        solutions.append(paint(asset, picture, settings, part_done, found))
    return Coats(tuple(solutions), tuple(choice))


def texel_side(asset: Asset, part: int, texels: Texels) -> float:
    """The mean side of a texel on the surface, working units: what the painting is averaged over."""
    area = face_areas(asset.mesh)[asset.mesh.part == part].sum()
    return float(np.sqrt(area / max(int(texels.covered.sum()), 1)))


def bake(asset: Asset, coats: Coats, atlas: Atlas, views: Sequence[View], settings: Settings, report: Report) -> Baked:
    """Section 4.1.4 for a painted surface: texels look the painting up directly; the views say who sees what."""
    from mistyle.stages.backproject import backproject

    maps, seen = painted(asset, coats, atlas, settings), []
    with_relief = raised(asset, coats, atlas, settings, maps)
    for part, texels in enumerate(atlas.texels):
        seen.append(backproject(views, texels, settings.bake, mesh=asset.mesh).seen)
        report((part + 1) / len(atlas.texels))
    if settings.fit.refine == "off":
        return Baked(tuple(with_relief), tuple(seen))
    return Baked(tuple(maps), tuple(seen), tuple(with_relief))


# Slope of the painting's relief, and share of its gloss: in maps that nothing refines, and where the fit begins.
HEIGHT = 0.15
FINAL_GLOSS, FIRST_GLOSS = 1.0, 0.5


def painted(asset: Asset, coats: Coats | Solution, atlas: Atlas, settings: Settings) -> list[Maps]:
    """The start maps with the painting's colours in place of the albedo, looked up for every covered texel.

    A single solution paints everything.
    """
    from mistyle.backends.embedded import surface_colour
    from mistyle.stages.coat import painted_mask, protected
    from mistyle.stages.texels import pad

    maps = []
    for part, (texels, start) in enumerate(zip(atlas.texels, atlas.start, strict=True)):
        side, albedo = texel_side(asset, part, texels), np.zeros_like(start.albedo)
        for solution, at in whose(coats, part, texels):
            place = texels.position[at], texels.normal[at]
            albedo[at] = linear_from_srgb(surface_colour(solution, *place, footprint=side))
        coated = replace(start, albedo=pad(albedo, texels, settings.atlas.padding), known=texels.covered)
        if settings.coat.protect is not None:
            coated = protected(coated, start, painted_mask(settings.coat.protect, texels))
        maps.append(coated)
    return maps


def raised(asset: Asset, coats: Coats | Solution, atlas: Atlas, settings: Settings, maps: Sequence[Maps]) -> list[Maps]:
    """Painted maps with the painting's relief laid upon their normals, and its gloss upon their roughness."""
    from mistyle.backends.embedded import surface_relief
    from mistyle.stages.coat import first_maps, painted_mask, protected

    full = FINAL_GLOSS if settings.fit.refine == "off" else FIRST_GLOSS
    height = HEIGHT if settings.coat.height is None else settings.coat.height
    gloss = full if settings.coat.gloss is None else settings.coat.gloss
    if height == gloss == 0:
        return list(maps)
    result = []
    for part, (texels, flat) in enumerate(zip(atlas.texels, maps, strict=True)):
        side, gradient = texel_side(asset, part, texels), np.zeros_like(flat.albedo)
        dull = np.zeros_like(flat.roughness)
        for solution, at in whose(coats, part, texels):
            gradient[at], dull[at] = surface_relief(solution, texels.position[at], texels.normal[at], footprint=side)
        covered = texels.covered
        made = first_maps(asset, flat, texels, gradient[covered], dull[covered], height, gloss)
        if settings.coat.protect is not None:
            made = protected(made, flat, painted_mask(settings.coat.protect, texels))
        result.append(made)
    return result


def whose(coats: Coats | Solution, part: int, texels: Texels) -> list[tuple[Solution, np.ndarray]]:
    """Each solution with the covered texels of a set that it paints."""
    if isinstance(coats, Solution):
        return [(coats, texels.covered)]
    return [(one, texels.covered & (coats.choice[part] == k)) for k, one in enumerate(coats.solutions)]


def stylized_stage(run: Run, asset: Asset, baked: Baked, views: Sequence[View]) -> list[View]:
    """The stylized views, drawn from the painted texture so that all agree by construction."""
    from mistyle.files.views import read_views, write_views

    def write(folder: Path, report: Report) -> None:
        drawn = unlit_views(asset, baked.maps, views, report)
        write_views(folder, drawn, (), paper_files=False)

    return read_views(run.stage("stylized", ["bake", "views"], [], write))


def unlit_views(asset: Asset, maps: Sequence[Maps], views: Sequence[View], report: Report, fine: int = 2) -> list[View]:
    """Each view with its rgb replaced by the albedo seen there, `fine` x `fine` samples a pixel, premultiplied."""
    from mistyle.render.unlit import unlit

    drawn = unlit(asset.mesh, maps, [view.camera for view in views], fine, report)
    return [replace(view, rgb=rgb, coverage=share) for view, (rgb, share) in zip(views, drawn, strict=True)]


def fit(asset: Asset, atlas: Atlas, baked: Baked, stylized: Sequence[View], settings: Settings, report: Report) -> Any:
    """Section 4.2: normal and roughness, then albedo."""
    from mistyle.stages.fit import two_phase

    begin = baked.begin or None
    return two_phase(asset.mesh, baked.maps, stylized, atlas.texels, settings.fit, settings.seed, report, begin=begin)


def repair(
    asset: Asset,
    style: Picture,
    atlas: Atlas,
    baked: Baked,
    views: Sequence[View],
    fitted: Any,
    settings: Settings,
    report: Report,
) -> Repaired:
    """Section 4.3: where the fit struggled or nothing was seen, take the painting again, or let Paint3D paint; blend
    at the edges."""
    from mistyle.backends.fill import from_paint
    from mistyle.stages.coat import painted_mask, protected
    from mistyle.stages.inpaint import repair as repair_part
    from mistyle.stages.inpaint import struggle_mask

    network = texture_inpainter(settings, asset, style) if settings.inpainter == "paint3d" else None
    maps, masks = [], []
    for part, texels in enumerate(atlas.texels):
        mask = struggle_mask(fitted.struggle[part], fitted.touched[part], baked.seen[part], texels, settings.repair)
        rng = np.random.default_rng([settings.seed, part])
        again = network or from_paint(baked.maps[part].albedo)
        maps.append(repair_part(fitted.maps[part], mask, texels, again, settings.repair, rng))
        masks.append(mask)
        report(0.3 * (part + 1) / len(atlas.texels))
    maps = settle_relief(asset, atlas, maps, masks, views, settings, lambda done: report(0.3 + 0.7 * done))
    if settings.coat.protect is not None:
        own = [painted_mask(settings.coat.protect, texels) for texels in atlas.texels]
        maps = [protected(m, start, mask) for m, start, mask in zip(maps, atlas.start, own, strict=True)]
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
        atomic_folder(out, lambda folder: draw(folder, asset, atlas.start, settings, report, progress.say))
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
