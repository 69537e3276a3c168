"""Evaluation of a fit phase: does it improve the renders? A statistics loss can destroy good strokes.

Windows of a few target views are rendered with the maps before and after the phase, under its own lights. Three metrics
compare them with the stylized views. `detail` is the correlation of band-pass lightness (strokes); `style` the patch
and Gram distance. `views` is the difference of a surface point between two neighbouring cameras under the same light.
It is relative to the contrast of the picture's own detail, since a bolder picture differs more. No metric may get worse
by more than TOLERANCE. A phase that exceeds HOPELESS times the tolerance at a check is stopped.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.atlas.texels import BAND_TEXELS
from mistyle.core.camera import Camera, px_from_world, world_from_px, zoom
from mistyle.core.image import luminance, srgb_from_linear
from mistyle.core.light import Directional, Lights, direction_in_world
from mistyle.core.maps import Maps, rows_of
from mistyle.core.view import View
from mistyle.measure import metrics
from mistyle.measure.overlap import Overlap, overlap
from mistyle.process import memory
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import torch_bridge
from mistyle.render.deferred.torch_bridge import CHANNELS, Shader

VIEWS = 6
WINDOW = 256
# (share of the value, absolute) by which a metric may get worse. A relief adds its own shading and highlights to the
# strokes: a good one costs up to 0.04 of `detail` and, on a bold flat style, 0.07 of `views`; noise and lost strokes
# cost more. The rest covers the variation between seeds of the crops.
TOLERANCE = {"detail": (0.0, 0.06), "style": (0.05, 0.0), "views": (0.05, 0.1)}
HOPELESS = 2.0
CHECKS = (0.25, 0.5)  # shares of a phase's steps after which it is checked
FEWEST = 10  # steps before the first check, which takes as long as one or two steps
HIGHER_IS_BETTER = {"detail": True, "style": False, "views": False}


@dataclass(frozen=True)
class EvaluationSet:
    """Evaluation windows, each with the window of a neighbouring view of the same surface.

    Values independent of the maps are computed once. These are traced `surfaces` of the windows and their neighbours,
    `shared` surface points of each pair, and statistics of all targets (`style`). `details` is the band-pass lightness
    of each target within its mask.
    """

    traced: Any
    views: tuple[View, ...]
    surfaces: tuple[tuple[Any, ...], ...]
    shared: tuple[Overlap, ...]
    masks: tuple[Bool[np.ndarray, "h w"], ...]
    details: tuple[Float[np.ndarray, "h w"], ...]
    style: Any
    shaders: dict[bool, Any]


def build_evaluation(traced: Any, tangents: Float[np.ndarray, "f 3 4"], targets: Sequence[View]) -> EvaluationSet:
    """Windows of up to VIEWS evenly chosen targets, around the centre of their foreground; WINDOW pixels at most."""
    count = min(VIEWS, len(targets))
    size = min(WINDOW, *(min(view.camera.size) for view in targets))
    views, neighbours = [], []
    for k in (j * len(targets) // count for j in range(count)):
        if not targets[k].mask.any():
            continue
        rows, columns = np.nonzero(targets[k].mask)
        middle = np.argmin((rows - np.median(rows)) ** 2 + (columns - np.median(columns)) ** 2)
        px = np.array([[columns[middle] + 0.5, rows[middle] + 0.5]])
        point = world_from_px(
            targets[k].camera, px, targets[k].depth[rows[middle], columns[middle]][None].astype(float)
        )
        neighbour = _nearest(targets, k)
        views.append(_window(targets[k], px[0], size))
        neighbours.append(_window(targets[neighbour], px_from_world(targets[neighbour].camera, point)[0][0], size))
    pairs = list(zip(views, neighbours, strict=True))
    surfaces = [tuple(deferred.trace(traced, [each.camera], tangents) for each in pair) for pair in pairs]
    masks = [view.mask & (view.coverage > 0.999) & np.isfinite(view.rgb).all(axis=-1) for view in views]
    pictures = [srgb_from_linear(np.nan_to_num(view.rgb)) for view in views]
    return EvaluationSet(
        traced,
        tuple(views),
        tuple(surfaces),
        tuple(overlap(*pair) for pair in pairs),
        tuple(masks),
        tuple(metrics.detail(*each) for each in zip(pictures, masks, strict=True)),
        metrics.StyleReference(masks, pictures, masks),
        {gloss: Shader((size, size), gloss=gloss) for gloss in (True, False)},
    )


def evaluate(where: EvaluationSet, maps: Sequence[Maps], lights: Lights, *, gloss: bool = True) -> dict[str, float]:
    """The metrics detail, style and views of `maps` under `lights`, with or without dielectric reflection."""
    lit = any(isinstance(light, Directional) for light in lights)
    table = _tables(maps)
    encoded, errors = [], []
    for view, surfaces, shared in zip(where.views, where.surfaces, where.shared, strict=True):
        # Both windows use the lights of the first camera, or their shading would differ.
        fixed = _fixed(lights, view.camera)
        first, second = (_draw(where, table, surface, fixed, gloss) for surface in surfaces)
        rendered, target = srgb_from_linear(first), srgb_from_linear(second)
        contrast = float(np.abs(metrics.detail(rendered, view.mask))[view.mask].mean())
        errors.append(metrics.warp_error(shared, rendered, target) / max(contrast, 1e-3))
        encoded.append(srgb_from_linear(_exposed(first, view)) if lit else rendered)
    compared = zip(encoded, where.details, where.masks, strict=True)
    details = [
        metrics.band_correlation(metrics.detail(rendered, mask), target, mask) for rendered, target, mask in compared
    ]
    usable = [error for error in errors if np.isfinite(error)]
    return {
        "detail": float(np.mean([d for d in details if np.isfinite(d)] or [0.0])),
        "style": where.style.distance(encoded),
        "views": float(np.mean(usable or [0.0])),
    }


def checks(iterations: int) -> tuple[int, ...]:
    """Numbers of steps after which a phase is checked."""
    steps = (round(share * iterations) for share in CHECKS)
    return tuple(step for step in steps if FEWEST <= step < iterations)


def regressed(before: dict[str, float], after: dict[str, float], times: float = 1.0) -> list[str]:
    """The metrics that got worse by more than `times` their tolerance."""
    result = []
    for name, (share, absolute) in TOLERANCE.items():
        loss = before[name] - after[name] if HIGHER_IS_BETTER[name] else after[name] - before[name]
        if loss > times * (share * abs(before[name]) + absolute):
            result.append(name)
    return result


def undone_where() -> str:
    """Report sentence on when a phase is undone, with the tolerances."""
    parts = []
    for name, (share, absolute) in TOLERANCE.items():
        by = " and ".join(text for text in (f"{share:.0%}" * (share > 0), f"{absolute:g}" * (absolute > 0)) if text)
        parts.append(f"{name} {'falls' if HIGHER_IS_BETTER[name] else 'grows'} by more than {by}")
    return f"A phase is undone where {', '.join(parts[:-1])} or {parts[-1]}."


def _nearest(targets: Sequence[View], k: int) -> int:
    """The other view with the smallest camera angle to view k; k itself if it is the only view."""
    directions = np.stack([view.camera.position / np.linalg.norm(view.camera.position) for view in targets])
    closeness = directions @ directions[k]
    closeness[k] = -2
    return int(np.argmax(closeness)) if len(targets) > 1 else k


def _window(view: View, centre: Float[np.ndarray, "2"], size: int) -> View:
    """The square window of `size` pixels around `centre`, moved inside the view."""
    height, width = view.camera.size
    x = int(np.clip(round(float(centre[0]) - size / 2), 0, width - size))
    y = int(np.clip(round(float(centre[1]) - size / 2), 0, height - size))
    names = ("rgb", "depth", "normal", "uv", "part", "mask", "coverage")
    fields = {name: np.ascontiguousarray(getattr(view, name)[y : y + size, x : x + size]) for name in names}
    return replace(view, camera=zoom(view.camera, x, y, size, (size, size)), **fields)


def _tables(maps: Sequence[Maps]) -> tuple[list[tuple[int, int]], Float[np.ndarray, "t 8"]]:

    sizes = [m.roughness.shape for m in maps]
    parts = rows_of(sizes)
    table = memory.empty((parts[-1].stop, sum(CHANNELS.values())))
    for m, rows in zip(maps, parts, strict=True):
        flat, own = [getattr(m, name).reshape(-1, count) for name, count in CHANNELS.items()], table[rows]
        for low in range(0, m.roughness.size, BAND_TEXELS):
            high = min(low + BAND_TEXELS, m.roughness.size)
            np.concatenate([part[low:high] for part in flat], axis=1, out=own[low:high])
    return sizes, table


def _draw(where: EvaluationSet, table: tuple, surface: Any, lights: Lights, gloss: bool) -> Float[np.ndarray, "h w 3"]:
    import torch

    sizes, values = table
    pixels = torch.from_numpy(torch_bridge.bilinear(values, torch_bridge.taps(surface, sizes)))
    lit = deferred.light(where.traced, surface, lights, shadows=False)
    return where.shaders[gloss](lit, pixels).numpy()


def _exposed(picture: Float[np.ndarray, "h w 3"], view: View) -> Float[np.ndarray, "h w 3"]:
    """Scale to the mean luminance of the target: exposure does not depend on the maps."""
    mean = float(luminance(picture)[view.mask].mean())
    return picture * np.float32(float(luminance(np.nan_to_num(view.rgb))[view.mask].mean()) / max(mean, 1e-6))


def _fixed(lights: Lights, camera: Camera) -> Lights:
    return tuple(
        replace(light, direction=tuple(direction_in_world(light, camera).tolist()), frame="world")
        if isinstance(light, Directional)
        else light
        for light in lights
    )
