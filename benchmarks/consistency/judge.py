"""The columns of `benchmarks.consistency`, and the picture of all rows side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import lettered
from benchmarks.consistency import metrics as consistency
from benchmarks.consistency.peer import save
from benchmarks.consistency.rows import texture
from benchmarks.consistency.scene import LPIPS, VGG, Scene, blank_maps, encoded
from mistyle.measure import metrics
from mistyle.measure.features import load_features
from mistyle.measure.lpips import load_lpips

SHOWN = (0, 1, 4, 2)  # views on the contact sheet
TILE = 384


def judged(
    scene: Scene,
    pictures: Sequence[np.ndarray],
    albedo: list[np.ndarray] | None,
    blind: Sequence[np.ndarray] | None,
) -> dict[str, float]:
    """All columns of a row but its time and memory; figures that mean nothing for the row are left out.

    warp_rmse_*       RMSE (sRGB 0..1) of what two views see of one place; short: 30 to 45 degrees apart, long: to 90
    trip_rmse_*       the share of carrying over alone in it: pictures against themselves, carried over and back
    lpips_*           LPIPS-squeeze of the same
    patch_swd         sliced Wasserstein distance of 5 x 5 Lab patches at three scales to the painting, views pooled
    gram_vgg          relative distance of VGG-19's Gram matrices at relu1_1, relu2_1, relu3_1, pooled over views
    style_distance    patch_swd + 10 gram_vgg
    detail_corr       correlation of the middle band of lightness with the detail guide
    clay_corr         correlation of detail with the bare mesh under the paper's lights
    edge_recall_over_chance  share of the guide's edges that the picture has too, less what chance gives
    seam_raw          step of the baked texture across chart borders in the views, over that beside them
    seam_floor        the same of pictures that know no charts: borders lie in creases, where the form makes steps
    seam_ratio        seam_raw / seam_floor: 1 where the atlas adds nothing
    view_seam_ratio   step where the view that painted the texels changes, in the atlas; for rows that bake views
    covered           share of the texels that a view painted
    """
    views, masks = list(scene.views), [view.mask for view in scene.views]
    figures = warps(views, pictures) | likeness(scene, pictures, masks)
    shapes = [np.repeat(0.5 + 0.25 * d[..., None], 3, axis=-1) for d in scene.detail]
    figures["detail_corr"] = consistency.guide_correlation(pictures, scene.detail, masks)
    figures["clay_corr"] = mean(map(consistency.detail_correlation, pictures, scene.clay, masks))
    figures["edge_recall_over_chance"] = mean(map(consistency.edge_recall, pictures, shapes, masks))
    figures["covered"] = 1.0
    if albedo is None:
        albedo, label, figures["covered"] = texture(scene, list(pictures))
        found = zip(albedo, label, scene.texels, strict=True)
        figures["view_seam_ratio"] = mean(consistency.border_ratio(a, v, t.island) for a, v, t in found)
    figures["seam_raw"] = seams(scene, albedo)
    figures["seam_floor"] = mean(map(consistency.seam_ratio, views, blind or pictures))
    figures["seam_ratio"] = figures["seam_raw"] / figures["seam_floor"]
    return {k: v for k, v in figures.items() if np.isfinite(v)}


def warps(views: Sequence, pictures: Sequence[np.ndarray]) -> dict[str, float]:
    """Warp errors at both ranges."""
    lpips, figures = load_lpips(*LPIPS), {}
    for name, degrees in (("short", consistency.SHORT), ("long", consistency.LONG)):
        chosen = consistency.pairs(views, degrees)
        figures[f"warp_rmse_{name}"] = consistency.warp_rmse(views, pictures, chosen)
        figures[f"trip_rmse_{name}"] = consistency.round_trip_rmse(views, pictures, chosen)
        figures[f"lpips_{name}"] = consistency.warp_lpips(views, pictures, chosen, lpips)
    return figures


def likeness(scene: Scene, pictures: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> dict[str, float]:
    """Style distances to the painting, over the part of each picture that shows the mesh."""
    boxes = [np.s_[slice(*span(m.max(axis=1))), slice(*span(m.max(axis=0)))] for m in masks]
    cut, inside = (
        [p[b] for p, b in zip(pictures, boxes, strict=True)],
        [m[b] for m, b in zip(masks, boxes, strict=True)],
    )
    return style_figures(cut, inside, [scene.painting], [scene.opaque])


def style_figures(pictures, masks, style, style_masks) -> dict[str, float]:
    """patch_swd, gram_vgg, and their sum."""
    patch, features = metrics.PatchReference(masks, style, style_masks).distance(pictures), load_features(VGG)
    mine, theirs = metrics.pooled_gram(pictures, masks, features), metrics.pooled_gram(style, style_masks, features)
    gram = metrics.gram_distance(mine, theirs)
    return {"patch_swd": patch, "gram_vgg": gram, "style_distance": patch + 10 * gram}


def halves(scene: Scene) -> dict[str, float]:
    """The floor of style distance: the left half of the painting against its right half."""
    middle = scene.painting.shape[1] // 2
    left, right = np.s_[:, :middle], np.s_[:, middle:]
    parts = [[a[side]] for side in (left, right) for a in (scene.painting, scene.opaque)]
    return style_figures(*parts)


def seams(scene: Scene, albedo: list[np.ndarray]) -> float:
    """`seam_ratio` of the texture drawn in every view, mean over the views that show a seam."""
    from mistyle.atlas.texels import pad
    from mistyle.stylization.pipeline.painting import unlit_views

    padded = [pad(a, t, scene.settings.atlas.padding) for a, t in zip(albedo, scene.texels, strict=True)]
    drawn = unlit_views(scene.asset, blank_maps(scene, padded), scene.views, lambda done: None)
    return mean(consistency.seam_ratio(view, encoded(view)) for view in drawn)


def mean(values) -> float:
    """Mean of the finite ones; NaN where there is none."""
    finite = [v for v in values if np.isfinite(v)]
    return float(np.mean(finite)) if finite else float("nan")


def span(used: np.ndarray) -> tuple[int, int]:
    """First and last-but-one index of what is used."""
    places = np.flatnonzero(used)
    return (int(places[0]), int(places[-1]) + 1) if len(places) else (0, len(used))


def sheet(path: Path, scene: Scene, rows: Mapping[str, Sequence[np.ndarray]]) -> None:
    """Every row at four views, the painting and the bare mesh above."""
    clay = [tile(scene.clay[k]) for k in SHOWN]
    painting = tile(scene.painting)
    lines = [np.concatenate([painting, *clay[1:]], axis=1)]
    for name, pictures in rows.items():
        line = np.concatenate([tile(pictures[k]) for k in SHOWN], axis=1)
        label = lettered(name, (34, TILE))
        line[: label.shape[0], :TILE] = np.maximum(line[: label.shape[0], :TILE], label[..., None])
        lines.append(line)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(path, np.concatenate(lines))


def tile(picture: np.ndarray) -> np.ndarray:
    """A square of TILE pixels with the whole picture in it."""
    height, width = picture.shape[:2]
    scale = TILE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    result = np.zeros((TILE, TILE, 3), np.float32)
    top, left = (TILE - size[1]) // 2, (TILE - size[0]) // 2
    result[top : top + size[1], left : left + size[0]] = small
    return result
