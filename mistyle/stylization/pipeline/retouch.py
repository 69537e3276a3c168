"""User edits of stylized views: bake changed pixels into the texture and update the other views."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from mistyle.core.asset import Asset
from mistyle.core.camera import resized
from mistyle.core.image import erode, resize, srgb_from_linear
from mistyle.core.view import View
from mistyle.jobs.progress import Report
from mistyle.stylization.pipeline.painting import unlit_views
from mistyle.stylization.records import Atlas, Baked, Retouched
from mistyle.stylization.settings import Settings

# Thresholds of a changed pixel: difference in 8-bit steps, least coverage, width of the ignored rim at the outline, and
# least size of its connected group. LOSSY is for files whose compression or resizing alters all pixels, single ones
# by more, and blends outlines with the background.
EXACT, LOSSY = (1.5, 0.05, 0, 1), (10.0, 0.99, 3, 5)


def retouch(
    asset: Asset,
    atlas: Atlas,
    baked: Baked,
    views: Sequence[View],
    edited: Mapping[str, str],
    folder: Path,
    settings: Settings,
    report: Report,
) -> Retouched:
    """Bake the changed pixels of edited views into the painted texture, and redraw the other views there.

    `views` are the current ones of `folder`, `edited` names its edited files. A texel takes the colour of the edited
    view that faces it most, if its pixel there differs from the rendered one.
    """
    from mistyle.atlas.bake import backproject
    from mistyle.atlas.texels import pad
    from mistyle.io.cameras.camera_files import read_cameras
    from mistyle.stylization.pipeline.painting import with_geometry

    sizes = [camera.size for camera in read_cameras(folder / "camera.json")]
    touched = {k: file for k, view in enumerate(views) if (file := _file(view, edited)) is not None}
    before = unlit_views(asset, baked.maps, views, lambda done: report(0.3 * done))
    traced = dict(zip(touched, with_geometry(asset, [views[k] for k in touched]), strict=True))
    brushes = []
    for k, file in touched.items():
        rendered = before[k] if file.endswith(".exr") else _as_written(folder, views[k], before[k])
        lossy = file.lower().endswith((".jpg", ".jpeg", ".webp")) or views[k].camera.size != sizes[k]
        # On a displaced mesh new surface lies where the picture had none.
        fresh = traced[k].mask & (rendered.coverage == 0)
        new = differs(views[k], rendered, *(LOSSY if lossy else EXACT)) | fresh
        brushes.append(_without_light(replace(traced[k], mask=traced[k].mask & new), baked.gains[k : k + 1]))
    painted, begun = [], []
    for part, (texels, maps) in enumerate(zip(atlas.texels, baked.maps, strict=True)):
        projected = backproject(brushes, texels, settings.bake, mesh=asset.mesh)
        albedo = np.where(projected.known[..., None], projected.albedo, maps.albedo)
        albedo = pad(albedo, texels, settings.atlas.padding)
        painted.append(replace(maps, albedo=albedo, known=maps.known | projected.known))
        begun += [replace(begin, albedo=albedo) for begin in baked.begin[part : part + 1]]
        report(0.3 + 0.4 * (part + 1) / len(atlas.texels))
    after = unlit_views(asset, painted, views, lambda done: report(0.7 + 0.3 * done))
    three = enumerate(zip(views, before, after, strict=True))
    views_after = [view if k in touched else _follow(view, old, new) for k, (view, old, new) in three]
    # The fit needs views of their original size: an edit of another size is redrawn from the texture.
    views_after = [
        view
        if view.camera.size == size
        else unlit_views(asset, painted, _plain(asset, view, size), lambda done: None)[0]
        for view, size in zip(views_after, sizes, strict=True)
    ]
    return Retouched(replace(baked, maps=tuple(painted), begin=tuple(begun)), tuple(views_after))


def _without_light(view: View, gains: Sequence[np.ndarray]) -> View:
    """An edited view without the painted light: it gets the same gains as the original view."""
    if not gains:
        return view
    return replace(view, rgb=(view.rgb * resize(gains[0], view.camera.size)[..., None]).astype(np.float32))


def _plain(asset: Asset, view: View, size: tuple[int, int]) -> list[View]:
    """A black view of the mesh from the view's camera, with geometry, at another size."""
    from mistyle.stylization.pipeline.painting import with_geometry

    black, none = np.zeros((*size, 3), np.float32), np.full(size, -1, np.int32)
    all_of_it, depth = np.ones(size, np.float32), np.full(size, np.inf, np.float32)
    camera, uv = resized(view.camera, size), np.zeros((*size, 2), np.float32)
    return with_geometry(asset, [View(camera, black, depth, black, uv, none, all_of_it > 0, all_of_it)])


def _file(view: View, edited: Mapping[str, str]) -> str | None:
    """The edited file of a view; its picture takes precedence over its EXR."""
    names = [name for name in edited if name.rpartition(".")[0] == view.camera.name]
    return next((name for name in names if not name.endswith(".exr")), names[0] if names else None)


def _as_written(folder: Path, view: View, drawn: View) -> View:
    """The view from its EXR, or `drawn` where the picture has another size."""
    from mistyle.io.read import read_exr

    planes = read_exr(folder / f"{view.camera.name}.exr")
    if planes["R"].shape != view.coverage.shape:
        return drawn
    return replace(view, rgb=np.stack([planes[c] for c in "RGB"], axis=-1), coverage=planes["A"])


def differs(
    view: View, rendered: View, steps: float, least: float, rim: int, together: int = 1
) -> Bool[np.ndarray, "h w"]:
    """Where the straight sRGB colours of two pictures of a camera differ by more than `steps` of 255.

    Both must cover a pixel by more than `least`, and it must lie at least `rim` pixels inside. 8-connected groups of
    fewer than `together` pixels are left out.
    """
    counts = np.minimum(view.coverage, rendered.coverage) > least
    first, second = (
        srgb_from_linear(np.clip(v.rgb / np.maximum(v.coverage, 1e-3)[..., None], 0, 1)) for v in (view, rendered)
    )
    changed = (np.abs(first - second).max(axis=-1) * 255 > steps) & (erode(counts, rim) if rim else counts)
    if together > 1:
        _, group, stats, _ = cv2.connectedComponentsWithStats(changed.astype(np.uint8), connectivity=8)
        changed &= stats[group, cv2.CC_STAT_AREA] >= together
    return changed


def _follow(view: View, before: View, after: View) -> View:
    """A view with the changes that other views' edits made to its visible surface."""
    new = np.abs(after.rgb - before.rgb).max(axis=-1) > 1e-4
    return replace(view, rgb=np.where(new[..., None], after.rgb, view.rgb).astype(np.float32))
