"""Views that a person painted over: what is new in them is laid into the texture, and the other views follow."""

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

# Steps of 8 bits that a pixel must differ by to be new, its least coverage, the width of the outline's rim that is not
# looked at, and how many such pixels must touch: of an exact file, and of one whose compression or size alters all
# pixels, single ones by more, and mixes outlines with whatever lies behind them.
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
    """Lay what is new in the edited views into the painted texture; redraw the others where that shows in them.

    `views` are those of `folder` as they stand there now, `edited` names its edited files. A texel takes the colour of
    the edited view that faces it most, if it shows a pixel that differs from what was drawn there.
    """
    from mistyle.atlas.bake import backproject
    from mistyle.atlas.texels import pad
    from mistyle.io.cameras.camera_files import read_cameras
    from mistyle.stylization.pipeline.painting import with_geometry

    asked = [camera.size for camera in read_cameras(folder / "camera.json")]
    touched = {k: file for k, view in enumerate(views) if (file := _file(view, edited)) is not None}
    before = unlit_views(asset, baked.maps, views, lambda done: report(0.3 * done))
    traced = dict(zip(touched, with_geometry(asset, [views[k] for k in touched]), strict=True))
    brushes = []
    for k, file in touched.items():
        drawn = before[k] if file.endswith(".exr") else _as_written(folder, views[k], before[k])
        lossy = file.lower().endswith((".jpg", ".jpeg", ".webp")) or views[k].camera.size != asked[k]
        new = differs(views[k], drawn, *(LOSSY if lossy else EXACT))
        brushes.append(_without_light(replace(traced[k], mask=traced[k].mask & new), baked.gains[k : k + 1]))
    painted, begun = [], []
    for part, (texels, maps) in enumerate(zip(atlas.texels, baked.maps, strict=True)):
        found = backproject(brushes, texels, settings.bake, mesh=asset.mesh)
        albedo = np.where(found.known[..., None], found.albedo, maps.albedo)
        albedo = pad(albedo, texels, settings.atlas.padding)
        painted.append(replace(maps, albedo=albedo, known=maps.known | found.known))
        begun += [replace(begin, albedo=albedo) for begin in baked.begin[part : part + 1]]
        report(0.3 + 0.4 * (part + 1) / len(atlas.texels))
    after = unlit_views(asset, painted, views, lambda done: report(0.7 + 0.3 * done))
    three = enumerate(zip(views, before, after, strict=True))
    shown = [view if k in touched else _follow(view, old, new) for k, (view, old, new) in three]
    # The fit wants its views in one size: one that was painted larger is redrawn as it now shows in the texture.
    shown = [
        view
        if view.camera.size == size
        else unlit_views(asset, painted, _plain(asset, view, size), lambda done: None)[0]
        for view, size in zip(shown, asked, strict=True)
    ]
    return Retouched(replace(baked, maps=tuple(painted), begin=tuple(begun)), tuple(shown))


def _without_light(view: View, gains: Sequence[np.ndarray]) -> View:
    """An edited view as the texture takes it: what was taken out of the view is taken out of the edit."""
    if not gains:
        return view
    return replace(view, rgb=(view.rgb * resize(gains[0], view.camera.size)[..., None]).astype(np.float32))


def _plain(asset: Asset, view: View, size: tuple[int, int]) -> list[View]:
    """What the view's camera sees of the mesh at another size, black."""
    from mistyle.stylization.pipeline.painting import with_geometry

    black, none = np.zeros((*size, 3), np.float32), np.full(size, -1, np.int32)
    all_of_it, depth = np.ones(size, np.float32), np.full(size, np.inf, np.float32)
    camera, uv = resized(view.camera, size), np.zeros((*size, 2), np.float32)
    return with_geometry(asset, [View(camera, black, depth, black, uv, none, all_of_it > 0, all_of_it)])


def _file(view: View, edited: Mapping[str, str]) -> str | None:
    """The edited file of a view: its picture, which counts before its EXR."""
    names = [name for name in edited if name.rpartition(".")[0] == view.camera.name]
    return next((name for name in names if not name.endswith(".exr")), names[0] if names else None)


def _as_written(folder: Path, view: View, drawn: View) -> View:
    """The view as its EXR has it; as `drawn` where the picture has another size."""
    from mistyle.io.read import read_exr

    planes = read_exr(folder / f"{view.camera.name}.exr")
    if planes["R"].shape != view.coverage.shape:
        return drawn
    return replace(view, rgb=np.stack([planes[c] for c in "RGB"], axis=-1), coverage=planes["A"])


def differs(
    view: View, drawn: View, steps: float, least: float, rim: int, together: int = 1
) -> Bool[np.ndarray, "h w"]:
    """Where the straight sRGB colours of two pictures of a camera differ by more than `steps` of 255, at pixels that
    both cover by more than `least` and that lie at least `rim` pixels inside; groups of fewer than `together` of them,
    counting corners, are left out."""
    counts = np.minimum(view.coverage, drawn.coverage) > least
    one, other = (
        srgb_from_linear(np.clip(v.rgb / np.maximum(v.coverage, 1e-3)[..., None], 0, 1)) for v in (view, drawn)
    )
    found = (np.abs(one - other).max(axis=-1) * 255 > steps) & (erode(counts, rim) if rim else counts)
    if together > 1:
        _, group, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=8)
        found &= stats[group, cv2.CC_STAT_AREA] >= together
    return found


def _follow(view: View, before: View, after: View) -> View:
    """A view with what the edits of others changed of the surface that it sees."""
    new = np.abs(after.rgb - before.rgb).max(axis=-1) > 1e-4
    return replace(view, rgb=np.where(new[..., None], after.rgb, view.rgb).astype(np.float32))
