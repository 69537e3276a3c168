"""Views that agree: the sweep over any stylizer that paints one view at a time (paper 4.1.3).

Views are painted one after another. The first is the anchor; every later one is given, as its prior, what the finished
views show of its surface (`stages/warp.py`), and its colours are drawn towards the anchor's.
"""

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, angular_order
from mistyle.core.image import (
    distance_to,
    erode,
    linear_from_srgb,
    match_histogram,
    overlap,
    srgb_from_linear,
)
from mistyle.core.view import Prior, View
from mistyle.files.store import atomic_write, digest
from mistyle.stages.lift import PURE, Lifted, lift
from mistyle.stages.outline import follow
from mistyle.stages.sweep_settings import SweepSettings
from mistyle.stages.warp import composite

Stylizer = Callable[[View, Prior | None, np.random.Generator], np.ndarray]
Masker = Callable[[View], np.ndarray]
STILL_EROSION = 2  # pixels (at 1024 across), for a stylizer that keeps outlines
FEATHER = 8.0  # pixels from the prior over which the histogram match sets in


@dataclass(frozen=True)
class Painted:
    """One finished view.

    rgb     linear Rec.709, not multiplied by coverage
    mask    which pixels are foreground and may be carried into other views
    seen    the foreground before it was eroded: the segmenter's, or the rendered one
    known   share of the foreground that earlier views had shown
    drift   intersection over union of the segmenter's mask and the rendered one (1 without a segmenter)
    """

    rgb: Float[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    seen: Bool[np.ndarray, "h w"]
    known: float
    drift: float


@dataclass(frozen=True)
class Swept:
    """The finished views in the order in which they came; `order` is that in which they were painted."""

    views: tuple[View, ...]
    painted: tuple[Painted, ...]
    order: tuple[int, ...]


def sweep(
    views: Sequence[View],
    stylizer: Stylizer,
    settings: SweepSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
    *,
    masker: Masker | None = None,
    keeps_outlines: bool = False,
    kept: Path | None = None,
    key: str = "",
) -> Swept:
    """Paint every view by `stylizer(view, prior, rng) -> rgb` (linear; prior None for the first view).

    `view` comes with the rendered colours and geometry; what the stylizer gives off the mesh is not used. `masker` is
    shown the stylized view and says what is foreground in it; the default is the rendered coverage. `keeps_outlines`
    tells that the stylizer cannot move silhouettes, so that little need be cut off beside them and depth need not
    follow them (`stages/outline.py`). With a folder `kept`
    every finished view is written there under `key` (all that the result hangs on besides `settings`, `seed` and the
    rig): a sweep that was killed goes on in the view it was in, and ends with the same pictures.

    Raises ValueError where the stylizer's answer has the wrong shape or is not finite on the mesh.
    """
    if not views:
        raise ValueError("there are no views to paint; pass at least one")
    order = visiting([view.camera for view in views], settings.order)
    chosen = settings.warp
    follows = masker is not None and (not keeps_outlines if (f := settings.follow_outline) is None else f)
    if chosen.erosion is None and keeps_outlines:
        chosen = chosen.model_copy(update={"erosion": STILL_EROSION})
    whole_key = digest([key, settings, seed, order, keeps_outlines, follows, masker is not None])
    done: dict[int, Painted] = {}
    lifted: list[Lifted] = []
    for turn, k in enumerate(order):
        file = None if kept is None else kept / f"view_{k:03d}.npz"
        found = None if file is None else read_kept(file, whole_key)
        if found is None:
            prior = composite(lifted, views[k], chosen) if lifted else None
            anchor = (views[order[0]], done[order[0]]) if done else None
            rng = np.random.default_rng([seed, k])
            found = paint_view(views[k], prior, anchor, stylizer, masker, settings, rng, follows)
            if file is not None:
                write_kept(file, whole_key, found)
        done[k] = found
        shown = drawn(views[k], found) if follows else finished(views[k], found)
        lifted.append(lift(shown, chosen, found.mask))
        progress((turn + 1) / len(order))
    painted = tuple(done[k] for k in range(len(views)))
    return Swept(tuple(finished(v, p) for v, p in zip(views, painted, strict=True)), painted, tuple(order))


def visiting(cameras: Sequence[Camera], kind: str) -> list[int]:
    """Indices in the order of painting. Cameras that have no azimuth and elevation are in the paper's order as given.

    The angular order starts from the view that the paper starts from.
    """
    named = np.array([abs(c.azimuth) + abs(c.elevation) for c in cameras])
    paper = list(range(len(cameras)))
    if kind != "given" and np.isfinite(named).all():
        paper = [int(k) for k in np.argsort(named, kind="stable")]
    if kind != "angular":
        return paper
    return [paper[k] for k in angular_order([cameras[k] for k in paper])]


def paint_view(
    view: View,
    prior: Prior | None,
    anchor: tuple[View, Painted] | None,
    stylizer: Stylizer,
    masker: Masker | None,
    settings: SweepSettings,
    rng: np.random.Generator,
    follows: bool = False,
) -> Painted:
    """One view: stylize, find its foreground, draw its colours towards the anchor's.

    What lies off the mesh is kept where depth is to follow the outline, and only where the segmenter sees foreground.
    """
    rgb = np.asarray(stylizer(view, prior, rng))
    if rgb.shape != view.rgb.shape or not np.isfinite(rgb[view.mask]).all():
        raise ValueError(
            f"view '{view.camera.name}': the stylizer gave an array of shape {rgb.shape}, or values that are not"
            f" finite; expected finite colours of shape {view.rgb.shape}"
        )
    seen, drift = view.mask, 1.0
    if masker is not None:
        seen = masker(replace(view, rgb=np.nan_to_num(rgb).astype(np.float32)))
        drift = overlap(seen, view.mask)
    shown = seen | view.mask if follows else view.mask
    rgb = np.where(shown[..., None] & np.isfinite(rgb), rgb, 0).astype(np.float32)
    whole = seen if follows else seen & view.mask & (view.coverage > PURE)
    mask = erode(whole, settings.mask_erosion)
    known = np.zeros(view.mask.shape, bool) if prior is None else prior.known
    if anchor is not None and settings.histogram > 0:
        rgb = towards(rgb, mask, known, anchor[1], settings.histogram)
    share = float(known[view.mask].mean()) if view.mask.any() else 0.0
    return Painted(rgb, mask, seen, share, drift)


def towards(
    rgb: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    anchor: Painted,
    strength: float,
) -> Float[np.ndarray, "h w 3"]:
    """Colours matched (in sRGB) to the anchor's, foreground against foreground; what came from the prior stays.

    Pinned pixels were matched when they were first painted; moving them again would pull the views apart, so the match
    sets in over a few pixels beside them.
    """
    encoded = srgb_from_linear(rgb)
    target = srgb_from_linear(anchor.rgb[anchor.mask])
    matched = encoded.copy()
    matched[mask] = match_histogram(encoded[mask], target, strength)
    weight = np.minimum(distance_to(known) / FEATHER, 1)[..., None] * mask[..., None]
    return linear_from_srgb(encoded + weight.astype(np.float32) * (matched - encoded))


def finished(view: View, painted: Painted) -> View:
    """The view with its painted colours, premultiplied by coverage as rendered ones are."""
    return replace(view, rgb=painted.rgb * view.coverage[..., None])


def drawn(view: View, painted: Painted) -> View:
    """The view as its stylizer drew it: the geometry moved to the outline of what is seen there."""
    return replace(follow(view, painted.seen), rgb=painted.rgb)


def write_kept(file: Path, key: str, painted: Painted) -> None:
    """One finished view on disk, whole or not at all."""
    numbers = np.array([painted.known, painted.drift])

    def write(path: Path) -> None:
        np.savez(path, key=np.array(key), rgb=painted.rgb, mask=painted.mask, seen=painted.seen, numbers=numbers)

    atomic_write(file, write)


def read_kept(file: Path, key: str) -> Painted | None:
    """A finished view that was kept under this key; None where there is none that can be read."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            if str(arrays["key"]) != key:
                return None
            known, drift = arrays["numbers"]
            return Painted(arrays["rgb"], arrays["mask"], arrays["seen"], float(known), float(drift))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
