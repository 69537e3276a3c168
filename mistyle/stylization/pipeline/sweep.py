"""Stages of a view-by-view stylizer: sweep over the views, bake them, write the stylized views."""

import shutil
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mistyle.core.asset import Asset, Picture
from mistyle.core.errors import UsageError
from mistyle.core.view import View
from mistyle.jobs.progress import Report
from mistyle.jobs.stages import Run
from mistyle.stylization.mvst.sweep import Masker, PaintedView, Stylizer, Swept, ViewPainter, ViewStore, finished, sweep
from mistyle.stylization.records import Atlas, Baked
from mistyle.stylization.settings import Settings

VIEW_STORE = "sweep"  # the folder in work/ that holds the views of an unfinished sweep


def swept_stages(
    run: Run, asset: Asset, style: Picture, atlas: Atlas, views: Sequence[View]
) -> tuple[Baked, list[View]]:
    """The stages 'surface', 'bake' and 'stylized' of a stylizer that paints view by view (paper 4.1.3 and 4.1.4)."""
    from mistyle.io.cameras.views import read_views, write_views
    from mistyle.stylization.pipeline.generative import fit_settings
    from mistyle.stylization.pipeline.painting import paint_files

    s = run.job.settings
    inputs = [style.rgb, style.alpha, s.stylizer, s.surface, s.paint, paint_files(s.paint), s.sweep, s.seed]
    if s.stylizer == "diffusion":
        from mistyle.stylization.pipeline.generative import sweep_key

        inputs = [sweep_key(run, style, views), s.paint, s.sweep, s.seed]
    painted = run.record("surface", ["texels", "views"], inputs, lambda r: swept(run, asset, style, atlas, views, r))
    shutil.rmtree(run.hidden.root / VIEW_STORE, ignore_errors=True)
    stylized = [finished(view, one) for view, one in zip(views, painted, strict=True)]
    chosen = fit_settings(s)
    lit = chosen.painted == "with-light" and chosen.unlight > 0
    light = [chosen.unlight, s.draw] if lit else []
    baked = run.record(
        "bake", ["surface"], [s.bake, *light], lambda r: bake(asset, stylized, painted, atlas, s, r, lit)
    )
    if baked.taken is not None:
        run.progress.note(unlight_note(baked.taken))
    shown = run.stage("stylized", ["bake"], [], lambda folder, r: write_views(folder, stylized, (), progress=r))
    return baked, read_views(shown)


def refuse_unsupported(settings: Settings) -> None:
    """UsageError for settings that only the embedded stylizer supports; refuses a missing segmenter."""
    paint = settings.paint
    named = {"paint.slots": paint.slots, "paint.height": paint.height, "paint.gloss": paint.gloss}
    unsupported = [name for name, value in named.items() if value]
    if unsupported:
        raise UsageError(
            f"{', '.join(unsupported)}: --stylizer {settings.stylizer} paints views and does not support that;"
            " leave it out, or use --stylizer embedded"
        )
    masker_of(settings)


def stylizer_of(asset: Asset, style: Picture, atlas: Atlas, settings: Settings, report: Report) -> Stylizer:
    """The weight-free stylizer of views, ready to paint."""
    from mistyle.stylization.surface.layers import content, masked_style, painted_direction, scaled
    from mistyle.stylization.surface.painter import stylizer

    surface = scaled(settings.surface, asset, settings.paint.stroke_size)
    lightness = content(atlas.texels, atlas.start) if surface.keep_content > 0 else None
    direction = painted_direction(settings.paint.direction_map, asset.mesh, atlas.texels)
    picture = masked_style(style, settings.paint.style_mask)
    return stylizer(asset.mesh, picture, surface, settings.seed, report, content=lightness, direction=direction)


def masker_of(settings: Settings) -> Masker | None:
    """The segmenter that the settings name; None for the rendered masks."""
    from mistyle.stylization.mvst.masks import segmenter
    from mistyle.stylization.pipeline.generative import named

    path = named(settings, settings.sweep.segmenter)
    return None if path is None else segmenter(path)


def swept(
    run: Run, asset: Asset, style: Picture, atlas: Atlas, views: Sequence[View], report: Report
) -> tuple[PaintedView, ...]:
    """Paint the views one after another; work/ keeps finished views until the sweep ends."""
    s = run.job.settings
    network = s.stylizer == "diffusion"
    if network:
        from mistyle.stylization.pipeline.generative import release, view_stylizer

        paint = view_stylizer(run, style, views, lambda done: report(0.1 * done))
    else:
        paint = stylizer_of(asset, style, atlas, s, lambda done: report(0.1 * done))
    painter = ViewPainter(paint, masker_of(s), keeps_outlines=not network)
    store = ViewStore(run.hidden.root / VIEW_STORE, run.keys["surface"])
    result = sweep(views, painter, s.sweep, s.seed, lambda done: report(0.1 + 0.9 * done), store)
    run.progress.say(sentence(result))
    del paint, painter
    if network:
        release(s)
    return result.painted


def sentence(result: Swept) -> str:
    """Summary of a sweep: mean known share, and the least overlap of the segmenter's masks."""
    later = [result.painted[k].known for k in result.order[1:]]
    share = float(np.mean(later)) if later else 0.0
    text = f"each later view was on average {100 * share:.0f} % known from the views before"
    drift = min(p.drift for p in result.painted)
    return text if drift == 1 else f"{text}; the segmenter's masks overlap the rendered ones by at least {drift:.3f}"


def bake(
    asset: Asset,
    stylized: Sequence[View],
    painted: Sequence[PaintedView],
    atlas: Atlas,
    settings: Settings,
    report: Report,
    lit: bool,
) -> Baked:
    """Section 4.1.4: every texel takes the colour of the view that faces it most.

    Unseen texels take the nearest colour of their island. `lit` views have their painted light divided out first.
    """
    from mistyle.atlas.bake import backproject, fill
    from mistyle.atlas.texels import pad
    from mistyle.stylization.mvst.unlight import gain, share, unlit
    from mistyle.stylization.surface.layers import painted_mask, protected

    views = [replace(view, mask=view.mask & one.mask) for view, one in zip(stylized, painted, strict=True)]
    taken, gains = None, []
    if lit:
        shading = bare_shape(asset, views, settings)
        taken = share(views, shading, settings.fit.unlight)
        gains = [gain(view, bare, taken) for view, bare in zip(stylized, shading, strict=True)]
        views = unlit(views, gains)
    maps, seen = [], []
    for part, (texels, start) in enumerate(zip(atlas.texels, atlas.start, strict=True)):
        projected = backproject(views, texels, settings.bake, mesh=asset.mesh)
        coated = replace(
            start, albedo=pad(fill(projected, texels), texels, settings.atlas.padding), known=projected.known
        )
        if settings.paint.protect is not None:
            coated = protected(coated, start, painted_mask(settings.paint.protect, texels))
        maps.append(coated)
        seen.append(projected.seen)
        report((part + 1) / len(atlas.texels))
    return Baked(tuple(maps), tuple(seen), (), tuple(gains), taken)


def bare_shape(asset: Asset, views: Sequence[View], settings: Settings) -> list[np.ndarray]:
    """Luminance of the white, matt mesh from every camera under the light that the views were drawn in."""
    from mistyle.core.image import luminance
    from mistyle.core.maps import flat_maps
    from mistyle.render.mitsuba.draw import draw_views

    white = [flat_maps(2, albedo=0.8, roughness=1.0) for _ in asset.mesh.parts]
    cameras = [view.camera for view in views]
    template = settings.draw.scene or "paper_views"
    drawn = draw_views(asset.mesh, white, cameras, template, settings.draw.samples(), settings.seed)
    return [luminance(view.rgb) for view in drawn]


def unlight_note(taken: float) -> str:
    """The note on the share of light that was divided out of the views."""
    if taken == 0:
        return "the stylized views show no shading of the rendered views' lights (fit.unlight)."
    return (
        f"the stylized views show {100 * taken:.0f} % of the shading under the rendered views' lights; the bake "
        "divided it out (fit.unlight)."
    )
