"""The `stylize` job, stage by stage, in the order of the paper's section 4.

The run folder caches each stage under a key of its inputs, its settings and its predecessors' keys. A killed run
resumes after the last finished stage; a changed setting reruns only the dependent stages.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset, Picture
from mistyle.core.maps import Heights, Maps, Texels
from mistyle.core.view import View
from mistyle.deliver import asset_files
from mistyle.io.images.textures import part_stems
from mistyle.jobs.edits import UNEDITED, Edited, asset_stage, read_mask, tell_edits, write_mask
from mistyle.jobs.inputs import input_files
from mistyle.jobs.memory_budget import Look, kept, size_of
from mistyle.jobs.progress import Progress, Report
from mistyle.jobs.stages import Run, claim_run
from mistyle.jobs.start import mesh_stage, start_engines
from mistyle.measure.baked_light import BakedLight
from mistyle.stylization.displace.height import check_height
from mistyle.stylization.displace.stage import Reshaped, check_displace, displace_stage, height_stage
from mistyle.stylization.optimise.light_left import light_left
from mistyle.stylization.pipeline.budget import PLAIN, STYLED, TILED, counts
from mistyle.stylization.pipeline.finishing import FinishRecord, check_finish, finish_stage
from mistyle.stylization.pipeline.first_asset import write_first
from mistyle.stylization.pipeline.generative import check as check_generative
from mistyle.stylization.pipeline.generative import (
    fit_settings,
    inpainter_inputs,
    lights_of_views,
    opaque,
    release,
    solves_lit,
    texture_inpainter,
)
from mistyle.stylization.pipeline.job import EVERY_STAGE, REFINING, STAGES, Job
from mistyle.stylization.pipeline.painting import (
    bake,
    check_paint,
    paint_files,
    relief_slope,
    stylized_stage,
    surface_stage,
    unlit_views,
)
from mistyle.stylization.pipeline.start import draw, texels_stage
from mistyle.stylization.records import Atlas, Baked, Repaired
from mistyle.stylization.report.style_reading import StyleLook, style_looks
from mistyle.stylization.settings import Settings


@dataclass(frozen=True)
class StylizedJob:
    """All results of a job, for the report."""

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
    looks: tuple[StyleLook, ...]
    light: BakedLight | None
    finishing: FinishRecord | None = None
    reshaped: Reshaped | None = None


def stylize(job: Job, progress: Progress) -> dict[str, Any]:
    """Mesh + one style picture -> the same mesh with stylized maps (the whole of section 4).

    Returns the written paths and the figures of `run.json`. Raises a MistyleError for every error that a user can
    fix; finished stages stay, and the next run reuses them.
    """
    from mistyle.deliver.colour import read_style
    from mistyle.deliver.export import check, deliver
    from mistyle.jobs.run_record import old_report
    from mistyle.stylization.report.summary import write_summary

    files = input_files(job.mesh)
    claim_run(job, STAGES, inputs_of(job))
    check(job.settings)
    style = read_style(job.style, job.settings.colour)
    check_paint(job.settings.paint)
    check_generative(job.settings, progress.say)
    check_finish(job.settings)
    check_height(job.settings, relief_slope(job.settings))
    if job.settings.stylizer != "embedded":
        from mistyle.stylization.pipeline.sweep import refuse_unsupported

        refuse_unsupported(job.settings)
    with (
        Run(job, progress, EVERY_STAGE) as run,
        kept(job.settings, run.hidden.root, counts, PLAIN, TILED, STYLED) as look_again,
    ):
        start_engines(job.settings)
        result = _stages(run, files, style, look_again)
        progress.note(*result.asset.source.notes, *style.notes, *result.fit.notes, *old_report(job))
        if job.settings.report.detail != "none":
            report_stage(run, result, progress)
        return deliver(job, progress) | write_summary(result, run)


def report_stage(run: Run, result: StylizedJob, progress: Progress) -> None:
    """The stage "report": the page and its pictures."""
    from mistyle.stylization.report.page import job_report

    inputs = [run.job.settings.report, run.job.name]
    run.stage("report", ["asset"], inputs, lambda folder, r: job_report(folder, result, progress, r))


def inputs_of(job: Job) -> list[Path]:
    """All user files and folders that the job reads."""
    s = job.settings
    return [*input_files(job.mesh), job.style, *paint_files(s.paint), *filter(None, (s.rig.file, s.draw.scene))]


def _stages(run: Run, files: Sequence[Path], style: Picture, look_again: Look) -> StylizedJob:
    s = run.job.settings
    asset = mesh_stage(run, files)
    check_displace(run, asset)
    look_again(*size_of(asset))
    atlas = texels_stage(run, asset)
    views = views_stage(run, asset, atlas)
    looks = style_looks(style, run.job.style.name, s, run.progress)
    baked, stylized, finishing = painted_stages(run, asset, style, atlas, views, looks)
    painted, reshaped = ["bake", "stylized"], None
    heights = height_stage(run, asset, atlas)
    if s.displace.most > 0:
        reshaped = displace_stage(run, asset, atlas, baked, stylized)
        asset, atlas, stylized = reshaped.asset, reshaped.atlas, reshaped.stylized
        painted.append("displace")
    if "stylized" in run.edited:
        baked, stylized = retouched_stage(run, asset, atlas, baked, stylized, painted)
        painted = ["retouch"]
    if s.keeps_painting:
        run.skip(REFINING, painted)
        fitted = fit(asset, style, atlas, baked, stylized, s, lambda done: None)
        repaired = Repaired(fitted.maps, tuple(np.zeros(texels.covered.shape, bool) for texels in atlas.texels))
    else:
        fitted, repaired = refined_stages(run, asset, style, atlas, views, baked, stylized, painted)

    def write(folder: Path, edited: Edited, report: Report) -> None:
        sets = zip(atlas.texels, repaired.maps, strict=True)
        write_asset(folder, run.job, asset, sets, report, edited, heights)

    after = ["repair"] if heights is None else ["repair", "height"]
    folder, edited = asset_stage(run, after, write, {"painted": run.keys["bake"]})
    maps = edited(part_stems(run.job.name, asset.mesh.parts), repaired.maps)[0]
    repaired = replace(repaired, maps=tuple(maps))
    tell_edits(run)
    light = light_left(asset.mesh, atlas.texels, repaired.maps, s.seed)
    return StylizedJob(
        run.job, style, asset, atlas, views, baked, stylized, fitted, repaired, folder, looks, light, finishing,
        reshaped,
    )  # fmt: skip


def refined_stages(
    run: Run,
    asset: Asset,
    style: Picture,
    atlas: Atlas,
    views: Sequence[View],
    baked: Baked,
    stylized: Sequence[View],
    painted: Sequence[str],
) -> tuple[Any, Repaired]:
    """The stages "fit", "masks" and "repair"."""
    s, seed = run.job.settings, run.job.settings.seed
    look = [style.rgb] if s.fit.tv_from == "style" else []
    fitted = run.record(
        "fit",
        painted,
        [fit_settings(s), s.draw.scene, seed, *look],
        lambda r: fit(asset, style, atlas, baked, stylized, s, r),
    )
    masks = masks_stage(run, asset, atlas, baked, fitted)
    repaired = run.record(
        "repair",
        ["masks"],
        [s.repair, seed, *inpainter_inputs(s, style)],
        lambda r: repair(asset, style, atlas, baked, views, fitted, masks, s, r),
    )
    return fitted, repaired


def retouched_stage(
    run: Run, asset: Asset, atlas: Atlas, baked: Baked, stylized: Sequence[View], after: Sequence[str]
) -> tuple[Baked, Sequence[View]]:
    """The stage "retouch": user edits of the stylized views, baked into the texture and the other views."""
    from mistyle.stylization.pipeline.retouch import retouch

    s, edited, folder = run.job.settings, run.edited["stylized"], run.visible.root / "stylized"
    retouched = run.record(
        "retouch",
        after,
        [s.bake],
        lambda r: retouch(asset, atlas, baked, stylized, edited, folder, s, r),
    )
    return retouched.baked, retouched.views


def masks_stage(run: Run, asset: Asset, atlas: Atlas, baked: Baked, fitted: Any) -> list[np.ndarray]:
    """Masks of the texels to repaint (section 4.3), as pictures in `masks/` that a user may edit."""
    from mistyle.stylization.inpaint.repair import struggle_mask

    s = run.job.settings
    stems = part_stems(run.job.name, asset.mesh.parts)

    def write(folder: Path, report: Report) -> None:
        for part, (stem, texels) in enumerate(zip(stems, atlas.texels, strict=True)):
            looks, agreed = (fitted.struggle[part], fitted.touched[part]), fitted.agreed[part]
            write_mask(folder / f"{stem}.png", struggle_mask(*looks, baked.seen[part], texels, s.repair, agreed))

    folder = run.stage("masks", ["fit"], [s.repair, run.job.name], write)
    return [read_mask(folder / f"{m}.png", t.covered) & t.covered for m, t in zip(stems, atlas.texels, strict=True)]


def painted_stages(
    run: Run, asset: Asset, style: Picture, atlas: Atlas, views: Sequence[View], looks: Sequence[StyleLook]
) -> tuple[Baked, list[View], FinishRecord | None]:
    """The stages 'surface', 'bake', 'finish' (if enabled) and 'stylized': the painted texture and its views."""
    s = run.job.settings
    if s.stylizer != "embedded":
        from mistyle.stylization.pipeline.sweep import swept_stages

        swept = swept_stages(run, asset, style, atlas, views)
        write_first(run, asset, atlas, swept[0])
        return *swept, None
    layers = surface_stage(run, asset, style, atlas, [look.reading for look in looks])
    baked = run.record(
        "bake", ["views", "surface"], [s.bake, s.refined, s.paint], lambda r: bake(asset, layers, atlas, views, s, r)
    )
    if not s.keeps_painting or s.finish.method != "off":
        write_first(run, asset, atlas, baked)
    if s.finish.method == "off":
        return baked, stylized_stage(run, asset, baked, views, "bake"), None
    baked, finishing = finish_stage(run, asset, layers, atlas, baked)
    return baked, stylized_stage(run, asset, baked, views, "finish"), finishing


def views_stage(run: Run, asset: Asset, atlas: Atlas) -> list[View]:
    """Section 4.1.1: the views of the mesh with its own material, rendered or cached."""
    from mistyle.io.cameras.views import read_views

    s = run.job.settings
    inputs = [s.rig, s.rig.file, s.draw, s.draw.scene, s.seed]
    # The embedded stylizer paints the surface: it reads only the views' depth, normals and masks.
    read = s.stylizer != "embedded"

    def write(folder: Path, report: Report) -> None:
        draw(folder, asset, atlas.start, s, report, run.progress.note, read)

    return read_views(run.stage("views", ["texels"], [*inputs, read], write))


def fit(
    asset: Asset,
    style: Picture,
    atlas: Atlas,
    baked: Baked,
    stylized: Sequence[View],
    settings: Settings,
    report: Report,
) -> Any:
    """Section 4.2: normal and roughness, then albedo; views under known light are solved for first."""
    from mistyle.stylization.mvst.unlight import unlit
    from mistyle.stylization.optimise.lit_views import lit_phases
    from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase

    chosen, seed = fit_settings(settings), settings.seed
    where, look = atlas.texels, opaque(style) if settings.fit.tv_from == "style" else None
    solving = solves_lit(chosen)
    lit = lights_of_views(settings) if solving else None
    if lit is not None:
        return lit_phases(asset.mesh, baked.maps, stylized, where, lit, chosen, seed, report, style=look)
    plain = unlit(stylized, baked.gains) if baked.gains else None
    fitted = two_phase(
        asset.mesh,
        FitStart(baked.maps, begin=baked.begin),
        FitTargets(stylized, style=look, unlit=plain),
        where,
        chosen,
        seed,
        report,
    )
    unknown = f"{settings.draw.scene}: the fit does not know this scene's light, so the lit views are not solved for."
    return replace(fitted, notes=(*fitted.notes, unknown)) if solving else fitted


def repair(
    asset: Asset,
    style: Picture,
    atlas: Atlas,
    baked: Baked,
    views: Sequence[View],
    fitted: Any,
    masks: Sequence[np.ndarray],
    settings: Settings,
    report: Report,
) -> Repaired:
    """Section 4.3: repaint the masked texels (struggling or unseen) from the painting or by Paint3D; blend at edges."""
    from mistyle.stylization.inpaint.fill import from_paint
    from mistyle.stylization.inpaint.repair import repair as repair_part
    from mistyle.stylization.surface.layers import painted_mask, protected

    network = texture_inpainter(settings, asset, style) if settings.inpainter == "paint3d" else None
    maps = []
    for part, (texels, mask) in enumerate(zip(atlas.texels, masks, strict=True)):
        rng = np.random.default_rng([settings.seed, part])
        again = network or from_paint(baked.maps[part].albedo)
        maps.append(repair_part(fitted.maps[part], mask, texels, again, settings.repair, rng))
        report(0.3 * (part + 1) / len(atlas.texels))
    if network is not None:
        del network, again
        release(settings)
        # The weight-free inpainter needs no such step: phase 1 has already fitted normal and roughness to the painting.
        maps = settle_relief(asset, atlas, maps, masks, views, settings, lambda done: report(0.3 + 0.7 * done))
    if settings.paint.protect is not None:
        own = [painted_mask(settings.paint.protect, texels) for texels in atlas.texels]
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
    from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase

    steps = round(settings.fit.iterations1 * SETTLING)
    if settings.refined == "off" or steps == 0 or not any(mask.any() for mask in masks):
        return list(maps)
    short = fit_settings(settings).model_copy(
        update={"painted": "without-light", "refine": "normal-roughness", "iterations1": steps}
    )
    targets = unlit_views(asset, maps, views, lambda done: None)
    settled = two_phase(
        asset.mesh,
        FitStart(maps, only=masks),
        FitTargets(targets),
        atlas.texels,
        short,
        seed=settings.seed + 1,
        progress=report,
    )
    return list(settled.maps)


def write_asset(
    folder: Path,
    job: Job,
    asset: Asset,
    sets: Iterable[tuple[Texels, Maps]],
    report: Report,
    edited: Edited = UNEDITED,
    heights: Heights | None = None,
) -> None:
    """Write the delivered files, set after set; `edited` holds textures that a user painted over."""
    provenance = {"mesh": job.mesh.name, "style": job.style.name, "seed": job.settings.seed}
    asset_files.write(folder, job, asset, sets, provenance, report, edited, heights=heights)
