"""How much light stays in an albedo baked from lit views: `python -m benchmarks.unlight [--quick] [--json FILE]`

The demo's mesh is painted by the embedded stylizer, once with each style; Mitsuba then draws the painting under the
light of the paper's views, as diffusion would paint lit objects. These views are baked as they are, and with the known
shading divided out. What is compared with is the painting itself, which knows no light. Figures, by style: `light`, the
root mean square of log(albedo / painting) over the texels that were seen, mean taken off, before and after; `share`,
how much of the shading was found; the same of views that show no light (`.none`), in which nothing is to be found.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.common import DATA, ROOT, arguments, finish
from benchmarks.relief_start import silent, views_of
from mistyle.core.asset import Picture
from mistyle.core.image import luminance
from mistyle.core.view import View
from mistyle.io.read import read_picture
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs import start
from mistyle.stylization.mvst.sweep import PaintedView
from mistyle.stylization.pipeline import painting, sweep
from mistyle.stylization.pipeline import start as stylize_start
from mistyle.stylization.settings import Settings

SCENES = ROOT / "scenes"


def left(baked: Any, truth: Any, seen: np.ndarray) -> float:
    """Root mean square of the log of what the albedo is brighter than the painting, its mean taken off."""
    pair = [np.log(np.maximum(luminance(maps.albedo)[seen], 1e-3)) for maps in (baked, truth)]
    return float(np.std(pair[0] - pair[1]))


def measured(asset: Any, style: Picture, settings: Settings, shown: str) -> tuple[float, float, float]:
    """`light` before and after, and the share taken, of views that are `lit` or show none."""
    from mistyle.render.mitsuba.draw import draw_views

    atlas = stylize_start.lay_out(asset, settings, silent)
    truth = painting.painted(asset, painting.paint_layers(asset, style, atlas, settings, silent), atlas, settings)
    views = views_of(asset, truth, settings.rig.resolution)
    if shown == "lit":
        matt = [replace(m, roughness=np.ones_like(m.roughness)) for m in truth]
        views = draw_views(asset.mesh, matt, [v.camera for v in views], spp=settings.draw.samples())
    painted = [as_painted(view) for view in views]
    found = [sweep.bake(asset, views, painted, atlas, settings, silent, lit) for lit in (False, True)]
    seen = atlas.texels[0].covered & (found[0].seen[0] > 0)
    before, after = (left(one.maps[0], truth[0], seen) for one in found)
    return before, after, found[1].taken or 0.0


def as_painted(view: View) -> PaintedView:
    return PaintedView(view.rgb, view.mask & (view.coverage > 0.99), view.mask, 0.0, 1.0)


def main() -> None:
    chosen = arguments(__doc__ or "")
    samples, resolution, size = (20_000, 192, 256) if chosen.quick else (80_000, 512, 1024)
    settings = Settings.model_validate(
        {"surface": {"samples": samples}, "atlas": {"size": size}, "rig": {"resolution": resolution}}
    )
    start.start_engines(settings)
    asset = read_mesh(SCENES / "demo.obj")
    styles = {"demo": SCENES / "demo_style.png"}
    if not chosen.quick:
        styles |= {name: DATA / "styles" / f"{name}.jpg" for name in ("great_wave", "starry_night", "the_scream")}
    figures: dict[str, float] = {}
    for name, path in styles.items():
        style = read_picture(path)
        for shown in ("lit", "none"):
            before, after, share = measured(asset, style, settings, shown)
            figures |= {f"{name}.{shown}.before": before, f"{name}.{shown}.after": after}
            figures[f"{name}.{shown}.share"] = share
    finish(figures, chosen.json)


if __name__ == "__main__":
    main()
