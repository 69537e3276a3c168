"""Did a phase of the fit make the pictures better? A statistics loss can undo good strokes, so each phase is judged.

A few of the target views are rendered with the maps before and after the phase, under its own lights, and compared
with the stylized views in three figures: `detail` (correlation of band-pass lightness: are the strokes still there),
`style` (patch and Gram distance) and `views` (a surface point seen from two neighbouring cameras, under the same
light). None of them may get worse by more than TOLERANCE.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera, resized
from mistyle.core.image import luminance, resize, srgb_from_linear
from mistyle.core.light import Directional, Lights, direction_in_world
from mistyle.core.maps import Maps
from mistyle.core.view import View

VIEWS = 4
RESOLUTION = 384
# What the figures move by when nothing but the crops' seed changes; a smaller change for the worse is no verdict.
TOLERANCE = {"detail": 0.02, "style": 0.03, "views": 0.05}
HIGHER_IS_BETTER = {"detail": True, "style": False, "views": False}


@dataclass(frozen=True)
class Bench:
    """Views to judge by, small; `pairs` names for each the neighbour it is compared with."""

    traced: Any
    tangents: Float[np.ndarray, "f 3 4"]
    views: tuple[View, ...]
    pairs: tuple[tuple[int, int], ...]
    shader: Any


def bench(traced: Any, tangents: Float[np.ndarray, "f 3 4"], targets: Sequence[View]) -> Bench:
    """Up to VIEWS evenly chosen targets and the camera nearest to each, at no more than RESOLUTION pixels."""
    from mistyle.render.seam import Shader

    count = min(VIEWS, len(targets))
    chosen = [round(k * len(targets) / count) for k in range(count)]
    chosen = [min(k, len(targets) - 1) for k in chosen]
    neighbours = [_nearest(targets, k) for k in chosen]
    used = sorted(set(chosen) | set(neighbours))
    views = tuple(_small(targets[k]) for k in used)
    pairs = tuple((used.index(a), used.index(b)) for a, b in zip(chosen, neighbours, strict=True))
    return Bench(traced, tangents, views, pairs, Shader(views[0].camera.size))


def figures(where: Bench, maps: Sequence[Maps], lights: Lights) -> dict[str, float]:
    """detail, style and views of `maps` under `lights` (see the module)."""
    from mistyle.measure import metrics

    lit = any(isinstance(light, Directional) for light in lights)
    pictures = [_draw(where, maps, view.camera, lights) for view in where.views]
    if lit:
        pictures = [_exposed(picture, view) for picture, view in zip(pictures, where.views, strict=True)]
    encoded = [srgb_from_linear(picture) for picture in pictures]
    targets = [srgb_from_linear(view.rgb) for view in where.views]
    masks = [view.mask & (view.coverage > 0.999) for view in where.views]
    details = [metrics.detail_correlation(*each) for each in zip(encoded, targets, masks, strict=True)]
    errors = []
    for a, b in where.pairs:
        # The neighbour is drawn again under the lights of the first, or their shading would differ.
        fixed = _fixed(lights, where.views[a].camera)
        first, second = (_draw(where, maps, where.views[k].camera, fixed) for k in (a, b))
        errors.append(
            metrics.warp_error(where.views[a], where.views[b], srgb_from_linear(first), srgb_from_linear(second))
        )
    return {
        "detail": float(np.nanmean(details)),
        "style": metrics.style_distance(encoded, masks, targets, masks),
        "views": float(np.nanmean(errors)) if errors else 0.0,
    }


def worse(before: dict[str, float], after: dict[str, float]) -> list[str]:
    """The figures that got worse by more than their tolerance (detail: absolute; the others: share)."""
    result = []
    for name, allowed in TOLERANCE.items():
        if HIGHER_IS_BETTER[name]:
            good = after[name] >= before[name] - allowed
        else:
            good = after[name] <= before[name] * (1 + allowed)
        if not good:
            result.append(name)
    return result


def _nearest(targets: Sequence[View], k: int) -> int:
    """The other view whose camera stands at the smallest angle to view k's; the view itself if it is the only one."""
    directions = np.stack([view.camera.position / np.linalg.norm(view.camera.position) for view in targets])
    closeness = directions @ directions[k]
    closeness[k] = -2
    return int(np.argmax(closeness)) if len(targets) > 1 else k


def _small(view: View) -> View:
    """The view at no more than RESOLUTION pixels; geometry is taken from its centre pixels, colour averaged."""
    step = max(int(np.ceil(view.camera.size[0] / RESOLUTION)), 1)
    height, width = view.camera.size
    if step == 1 or height % step or width % step:
        return view
    camera, at = resized(view.camera, (height // step, width // step)), np.s_[step // 2 :: step, step // 2 :: step]
    size = camera.size
    fields = {name: np.ascontiguousarray(getattr(view, name)[at]) for name in ("depth", "normal", "uv", "part", "mask")}
    return replace(view, camera=camera, rgb=resize(view.rgb, size), coverage=resize(view.coverage, size), **fields)


def _draw(where: Bench, maps: Sequence[Maps], camera: Camera, lights: Lights) -> Float[np.ndarray, "h w 3"]:
    import torch

    from mistyle.render import deferred, seam

    surface = deferred.trace(where.traced, [camera], where.tangents)
    taps = seam.taps(surface, [m.roughness.shape for m in maps])
    tables = {
        name: np.concatenate([getattr(m, name).reshape(-1, channels) for m in maps])
        for name, channels in seam.CHANNELS.items()
    }
    pixels = {name: torch.from_numpy(seam.bilinear(table, taps)) for name, table in tables.items()}
    lit = deferred.light(where.traced, surface, lights, shadows=False)
    return where.shader(lit, pixels).numpy()


def _exposed(picture: Float[np.ndarray, "h w 3"], view: View) -> Float[np.ndarray, "h w 3"]:
    """Scaled to the mean luminance of the target: its exposure is no fault of the maps."""
    mean = float(luminance(picture)[view.mask].mean())
    return picture * np.float32(float(luminance(view.rgb)[view.mask].mean()) / max(mean, 1e-6))


def _fixed(lights: Lights, camera: Camera) -> Lights:
    return tuple(
        replace(light, direction=tuple(direction_in_world(light, camera).tolist()), frame="world")
        if isinstance(light, Directional)
        else light
        for light in lights
    )
