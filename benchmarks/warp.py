"""How long it takes to carry finished views into others: one into another, and every earlier one into each of the rig.

The object is five spheres that hide parts of one another, drawn in closed form. `warp_ms_1024` is the mean over the 15
warps of the first view into the others at 1024² (lifting not counted; `lift_ms_1024` is that, once a view);
`all_pairs_seconds` is the whole of the sweep's warping: 16 lifts and the 120 warps of every view into all later ones,
composited.
"""

import time

import numpy as np

from benchmarks.bake import SPHERES, draw
from benchmarks.common import arguments, finish, peak_gb, timed
from mistyle.core.camera import pixel_centres, rig, world_from_px
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.stylization.mvst.settings import WarpSettings
from mistyle.stylization.mvst.warp import composite, lift, splat


def with_normals(view: View) -> View:
    """The normals of the spheres, which the warp looks at."""
    from dataclasses import replace

    normal = np.zeros((*view.camera.size, 3), np.float32)
    points = world_from_px(view.camera, pixel_centres(view.camera.size)[view.mask], view.depth[view.mask].astype(float))
    away = points[:, None] - SPHERES[None, :, :3]
    distance = np.linalg.norm(away, axis=2)
    own = np.abs(distance - SPHERES[:, 3]).argmin(axis=1)
    rows = np.arange(len(points))
    normal[view.mask] = away[rows, own] / distance[rows, own, None]
    return replace(view, normal=normal)


def all_pairs(views: list[View], settings: WarpSettings) -> float:
    """Every view's prior from all before it; returns the mean share of the foreground that is known."""
    lifted, shares = [], []
    for view in views:
        if lifted:
            prior = composite(lifted, view, settings)
            shares.append(float(prior.known[view.mask].mean()))
        lifted.append(lift(view, settings))
    return float(np.mean(shares))


def main(argv: list[str] | None = None) -> None:
    options = arguments(__doc__ or "", argv)
    size = 256 if options.quick else 1024
    settings = WarpSettings()
    views = [with_normals(draw(camera)) for camera in rig(RigSettings(resolution=size))]
    figures: dict[str, float] = {"foreground_share": float(np.mean([v.mask.mean() for v in views]))}
    start = time.perf_counter()
    source = lift(views[0], settings)
    figures[f"lift_ms_{size}"] = 1e3 * (time.perf_counter() - start)
    start = time.perf_counter()
    for view in views[1:]:
        splat(source, view, settings)
    figures[f"warp_ms_{size}"] = 1e3 * (time.perf_counter() - start) / (len(views) - 1)
    figures["known_share"] = timed(figures, "all_pairs_seconds", lambda: all_pairs(views, settings))
    figures["peak_gb"] = peak_gb()
    finish(figures, options.json)


if __name__ == "__main__":
    main()
