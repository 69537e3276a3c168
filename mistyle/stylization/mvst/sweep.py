"""Multiview-consistent sweep over any stylizer that paints one view at a time (paper 4.1.3).

Views are painted one after another. The first is the anchor. Every later view has a prior, the finished views warped
into it (`stylization/mvst/warp.py`), and its colours are matched to the anchor's.
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
from mistyle.io.store.atomic import atomic_write, digest
from mistyle.stylization.mvst.lift import PURE, Lifted, lift
from mistyle.stylization.mvst.outline import follow
from mistyle.stylization.mvst.settings import SweepSettings
from mistyle.stylization.mvst.warp import composite

Stylizer = Callable[[View, Prior | None, np.random.Generator], np.ndarray]
Masker = Callable[[View], np.ndarray]
STILL_EROSION = 2  # pixels (at 1024 across), for a stylizer that keeps outlines
FEATHER = 8.0  # pixels beside the prior over which the histogram match ramps up


@dataclass(frozen=True)
class PaintedView:
    """One finished view.

    rgb     linear Rec.709, not multiplied by coverage
    mask    foreground pixels that may be warped into other views
    seen    the foreground before erosion: the segmenter's, or the rendered one
    known   share of the foreground known from earlier views
    drift   intersection over union of the segmenter's mask and the rendered one (1 without a segmenter)
    """

    rgb: Float[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    seen: Bool[np.ndarray, "h w"]
    known: float
    drift: float


@dataclass(frozen=True)
class Swept:
    """The finished views in input order; `order` is the painting order."""

    views: tuple[View, ...]
    painted: tuple[PaintedView, ...]
    order: tuple[int, ...]


@dataclass(frozen=True)
class ViewPainter:
    """A stylizer of views with its masker.

    stylizer        (view, prior, rng) -> rgb, linear; the prior is None for the first view. The view has the rendered
                    colours and geometry; colours off the mesh are not used
    masker          foreground mask of a stylized view; None: the rendered coverage
    keeps_outlines  the stylizer cannot move silhouettes: erosion beside them is small, and depth is not registered to
                    them (`stylization/mvst/outline.py`)
    """

    stylizer: Stylizer
    masker: Masker | None = None
    keeps_outlines: bool = False


@dataclass(frozen=True)
class ViewStore:
    """A folder of finished views, and the key of their inputs besides settings, seed and rig."""

    folder: Path
    key: str


def sweep(
    views: Sequence[View],
    painter: ViewPainter,
    settings: SweepSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
    store: ViewStore | None = None,
) -> Swept:
    """Paint every view with the earlier views as its prior.

    With a store, a killed sweep resumes at its unfinished view and gives the same pictures.

    Raises ValueError where the stylizer's output has the wrong shape or is not finite on the mesh.
    """
    if not views:
        raise ValueError("there are no views to paint; pass at least one")
    order = visiting([view.camera for view in views], settings.order)
    chosen, masked = settings.warp, painter.masker is not None
    follows = masked and (not painter.keeps_outlines if (f := settings.follow_outline) is None else f)
    if chosen.erosion is None and painter.keeps_outlines:
        chosen = chosen.model_copy(update={"erosion": STILL_EROSION})
    key = "" if store is None else digest([store.key, settings, seed, order, painter.keeps_outlines, follows, masked])
    done: dict[int, PaintedView] = {}
    lifted: list[Lifted] = []
    for turn, k in enumerate(order):
        file = None if store is None else store.folder / f"view_{k:03d}.npz"
        own = None if file is None else read_view(file, key)
        if own is None:
            prior = composite(lifted, views[k], chosen) if lifted else None
            anchor = (views[order[0]], done[order[0]]) if done else None
            rng = np.random.default_rng([seed, k])
            own = paint_view(views[k], prior, anchor, painter, settings, rng, follows)
            if file is not None:
                write_view(file, key, own)
        done[k] = own
        shown = drawn(views[k], own) if follows else finished(views[k], own)
        lifted.append(lift(shown, chosen, own.mask))
        progress((turn + 1) / len(order))
    painted = tuple(done[k] for k in range(len(views)))
    return Swept(tuple(finished(v, p) for v, p in zip(views, painted, strict=True)), painted, tuple(order))


def visiting(cameras: Sequence[Camera], kind: str) -> list[int]:
    """Indices in the order of painting. The paper's order keeps the rig's for cameras without azimuth and elevation.

    The angular order starts from the paper's first view.
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
    anchor: tuple[View, PaintedView] | None,
    painter: ViewPainter,
    settings: SweepSettings,
    rng: np.random.Generator,
    follows: bool = False,
) -> PaintedView:
    """One view: stylize it, segment its foreground, match its colours to the anchor's.

    Pixels off the mesh are kept only if depth follows the outline and the segmenter marks them as foreground.
    """
    rgb = np.asarray(painter.stylizer(view, prior, rng))
    if rgb.shape != view.rgb.shape or not np.isfinite(rgb[view.mask]).all():
        raise ValueError(
            f"view '{view.camera.name}': the stylizer returned shape {rgb.shape}, or values that are not"
            f" finite; expected finite colours of shape {view.rgb.shape}"
        )
    seen, drift = view.mask, 1.0
    if painter.masker is not None:
        seen = painter.masker(replace(view, rgb=np.nan_to_num(rgb).astype(np.float32)))
        drift = overlap(seen, view.mask)
    shown = seen | view.mask if follows else view.mask
    rgb = np.where(shown[..., None] & np.isfinite(rgb), rgb, 0).astype(np.float32)
    whole = seen if follows else seen & view.mask & (view.coverage > PURE)
    mask = erode(whole, settings.mask_erosion)
    known = np.zeros(view.mask.shape, bool) if prior is None else prior.known
    if anchor is not None and settings.histogram > 0:
        rgb = towards(rgb, mask, known, anchor[1], settings.histogram)
    share = float(known[view.mask].mean()) if view.mask.any() else 0.0
    return PaintedView(rgb, mask, seen, share, drift)


def towards(
    rgb: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    anchor: PaintedView,
    strength: float,
) -> Float[np.ndarray, "h w 3"]:
    """Colours matched (in sRGB) to the anchor's, foreground against foreground; the prior's pixels stay.

    Pinned pixels were matched when first painted; another match would make views inconsistent. So the match ramps up
    over a few pixels beside them.
    """
    encoded = srgb_from_linear(rgb)
    target = srgb_from_linear(anchor.rgb[anchor.mask])
    matched = encoded.copy()
    matched[mask] = match_histogram(encoded[mask], target, strength)
    weight = np.minimum(distance_to(known) / FEATHER, 1)[..., None] * mask[..., None]
    return linear_from_srgb(encoded + weight.astype(np.float32) * (matched - encoded))


def finished(view: View, painted: PaintedView) -> View:
    """The view with its painted colours, premultiplied by coverage like rendered ones."""
    return replace(view, rgb=painted.rgb * view.coverage[..., None])


def drawn(view: View, painted: PaintedView) -> View:
    """The painted view with its geometry warped to the painted outline."""
    return replace(follow(view, painted.seen), rgb=painted.rgb)


def write_view(file: Path, key: str, painted: PaintedView) -> None:
    """Write one finished view atomically."""
    numbers = np.array([painted.known, painted.drift])

    def write(path: Path) -> None:
        np.savez(path, key=np.array(key), rgb=painted.rgb, mask=painted.mask, seen=painted.seen, numbers=numbers)

    atomic_write(file, write)


def read_view(file: Path, key: str) -> PaintedView | None:
    """The finished view stored under this key; None if missing or unreadable."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            if str(arrays["key"]) != key:
                return None
            known, drift = arrays["numbers"]
            return PaintedView(arrays["rgb"], arrays["mask"], arrays["seen"], float(known), float(drift))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
