"""One camera's loss and its derivatives by the parameters of a live Mitsuba scene.

The picture I is rendered with many samples and no gradient. The derivative of the loss by the pixels is backpropagated
through the scene with few samples (`render_backward`). The two renders use independent random numbers, so
E[dL/dI · dI'] = dL/df · df for the expected picture f wherever dL/dI is linear in I. The gradients of squared losses
therefore have no bias from render noise at any number of samples; that of the logarithmic loss has. The relative loss
divides by the reference around a pixel, without the pixel itself: a weight that depended on the reference's own noise
would prefer darker pictures.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.drjit_arrays import aligned
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import srgb_from_linear
from mistyle.render.live import walk as scene_walk
from mistyle.render.live.parameters import Parameter
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi

# (picture, reference) -> number; both Mitsuba tensors (h, w, 3), linear
Loss = Callable[[Any, Any], Any]


# Relative loss: sides of the window around a pixel and of the hole in it (a film's filter mixes neighbours), in pixels,
# and the share of the median radiance below which differences count as absolute.
AROUND, HOLE, DARK = 7, 3, 0.1


@dataclass(frozen=True)
class ReferenceView:
    """A camera and its reference: tensors (h, w, 3) of the reference, of valid values, and of the relative loss's
    weights."""

    sensor: Any
    reference: Any
    counts: Any
    weights: Any
    share: float  # of valid pixels


def log_srgb_l1(picture: Any, reference: Any) -> Any:
    """Mean |s(picture) - s(reference)| with s(x) = sRGB(log(x + 1)) (Munkberg et al. 2022, equation 7).

    Highlights weigh as much as their surroundings.
    """
    return dr.mean(dr.abs(_log_srgb(picture) - _log_srgb(reference)), axis=None)


def l2(picture: Any, reference: Any) -> Any:
    """Mean squared difference of linear radiance."""
    return dr.mean(dr.square(picture - reference), axis=None)


def relative(weights: Any) -> Loss:
    """Mean weights · (picture - reference)², with the weights of `relative_weights` as a tensor."""
    return lambda picture, reference: dr.mean(weights * dr.square(picture - reference), axis=None)


def relative_weights(
    reference: Float[np.ndarray, "h w 3"], used: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """1 / (m + ε): m is the mean square of the reference's valid values around a pixel, without its own and its
    neighbours' (AROUND, HOLE); ε is the square of DARK times the median of its positive values.

    The noise of renders is proportional to radiance, so every pixel's weight follows its precision.
    """
    square = np.where(used[..., None], np.square(reference, dtype=np.float64), 0)
    count = used[..., None].astype(np.float64)
    total, number = (sums_around(x, AROUND) - sums_around(x, HOLE) for x in (square, count))
    mean = np.where(number > 0, total / np.maximum(number, 1), square.sum(axis=(0, 1)) / count.sum())
    positive = reference[used][reference[used] > 0]
    return (1 / (np.maximum(mean, 0) + (DARK * float(np.median(positive))) ** 2)).astype(np.float32)


def sums_around(values: Float[np.ndarray, "h w c"], side: int) -> Float[np.ndarray, "h w c"]:
    """Sums over a square window around every pixel; zero outside."""
    for axis in (0, 1):
        edge = [(0, 0)] * 3
        edge[axis] = (side // 2 + 1, side // 2)
        running = np.cumsum(np.pad(values, edge), axis=axis)
        low, high = np.arange(values.shape[axis]), np.arange(values.shape[axis]) + side
        values = running.take(high, axis=axis) - running.take(low, axis=axis)
    return values


LOSSES: dict[str, Loss] = {"log_srgb_l1": log_srgb_l1, "l2": l2}
NAMES = ("relative", *LOSSES)
# Their gradients are linear in the picture, so render noise causes no bias.
SQUARED = ("relative", "l2")


def loss_of(loss: str | Loss, view: ReferenceView) -> Loss:
    """The function of a named loss for one camera. Raises UsageError for an unknown name."""
    if not isinstance(loss, str):
        return loss
    if loss not in NAMES:
        raise UsageError(f"the loss '{loss}' is not known; expected {', '.join(NAMES)}, or a function.")
    return relative(view.weights) if loss == "relative" else LOSSES[loss]


def _log_srgb(linear: Any) -> Any:
    x = dr.log(dr.maximum(linear, 0) + 1)
    root = dr.power(dr.maximum(x, 0.0031308), 1 / 2.4)
    return dr.select(x <= 0.0031308, 12.92 * x, 1.055 * root - 0.055)


def ad_integrator(scene: Any, requested: Any = None) -> tuple[Any, tuple[str, ...]]:
    """An integrator with gradients, and notes: `requested` (a plugin's name, a dictionary or an integrator), else the
    scene's own if it has gradients, else `prb` (`prbvolpath` in a scene with media) with the depth of the scene's own.
    """
    if isinstance(requested, mi.Integrator):
        return requested, ()
    if requested is not None:
        try:
            integrator = mi.load_dict({"type": requested} if isinstance(requested, str) else dict(requested))
        except RuntimeError as error:
            raise UsageError(
                f"the integrator '{requested}' cannot be made; expected for example 'prb'. {error}"
            ) from error
        if not isinstance(integrator, mi.Integrator):
            raise UsageError(f"'{requested}' is not an integrator; expected for example 'prb'.")
        return integrator, ()
    own = scene.integrator()
    if own is None:
        return mi.load_dict({"type": "prb"}), ("The scene has no integrator; prb replaces it.",)
    # `aov` and `moment` wrap other integrators; the first one's picture comes first.
    inner = own
    while held := [x for _, x in scene_walk.children(inner)[inner] if isinstance(x, mi.Integrator)]:
        inner = held[0]
    if isinstance(inner, mi.ad.integrators.common.ADIntegrator) or inner.class_name() == "DirectIntegrator":
        return inner, () if inner is own else (f"The picture is that of {inner.class_name()} in {own.class_name()}.",)
    depth = re.search(r"max_depth = (\d+)", str(inner))
    plugin = "prbvolpath" if "vol" in inner.class_name().lower() else "prb"
    replacement: dict[str, Any] = {"type": plugin, "hide_emitters": bool(getattr(inner, "hide_emitters", False))}
    if depth:
        # Unlimited depth is stored as 2^32 - 1.
        replacement["max_depth"] = int(depth[1]) if int(depth[1]) < 2**31 else -1
    note = f"{own.class_name()} has no gradients; {plugin} replaces it"
    return mi.load_dict(replacement), (f"{note} with max_depth {replacement.get('max_depth', 6)}.",)


def sight(sensor: Any, reference: np.ndarray, mask: np.ndarray | None, name: str) -> ReferenceView:
    """Check one reference picture against its camera. Raises InputRefused, calling the camera `name`."""
    film: Any = sensor.film()
    columns, rows = (int(n) for n in film.crop_size())
    if reference.ndim != 3 or reference.shape[2] != 3:
        raise InputRefused(f"the reference of {name} has the shape {reference.shape}; expected (rows, columns, 3).")
    if reference.shape[:2] != (rows, columns):
        raise InputRefused(
            f"the reference of {name} has {reference.shape[1]} x {reference.shape[0]} pixels, its film {columns} x "
            f"{rows}. Render it at the film's size, or set the film's width and height to the picture's."
        )
    used = np.ones((rows, columns), bool) if mask is None else mask
    if used.shape != (rows, columns):
        raise InputRefused(f"the mask of {name} has the shape {used.shape}; expected {(rows, columns)}.")
    if not used.any():
        raise InputRefused(f"the mask of {name} leaves no pixel. Leave this camera out, or check the mask.")
    bad = int((~np.isfinite(reference[used])).any(axis=-1).sum())
    if bad:
        raise InputRefused(
            f"the reference of {name} has {bad} pixels that are NaN or infinite. Mask them, or render it again."
        )
    if not (reference[used] > 0).any():
        raise InputRefused(f"the reference of {name} is black everywhere. Check the picture and the scene's lights.")
    if (reference[used] >= 1).all() and np.ptp(reference[used]) == 0:
        raise InputRefused(f"the reference of {name} is saturated everywhere. Use a shorter exposure, or EXR pictures.")
    if film.base_channels_count() < 3:
        raise InputRefused(f'the film of {name} has one channel; expected <string name="pixel_format" value="rgb"/>.')
    clean = np.where(used[..., None], reference, 0)
    return ReferenceView(
        sensor=sensor,
        reference=mi.TensorXf(aligned(clean)),
        counts=mi.TensorXb(aligned(np.broadcast_to(used[..., None], clean.shape), bool)),
        weights=mi.TensorXf(aligned(relative_weights(clean, used))),
        share=float(used.mean()),
    )


def seeds(*numbers: int) -> tuple[int, int]:
    """Seeds of a picture and of its gradient, always different and determined by the numbers."""
    first, second = (int(n) for n in np.random.SeedSequence(numbers).generate_state(2))
    return first, second if second != first else first ^ 1


def picture(scene: Any, integrator: Any, sensor: Any, spp: int, seed: int) -> Any:
    """The linear picture, a tensor without gradient; memory is bounded by 64 samples a pixel."""
    times, each = scenery.passes(spp)
    total: Any = 0
    with dr.suspend_grad():
        for k in range(times):
            number = dr.opaque(mi.UInt32, (seed + k * 0x9E3779B1) % 2**32)
            image = mi.render(scene, sensor=sensor, integrator=integrator, spp=each, seed=number)
            total = image if times == 1 else total + image / times
        dr.eval(total)
    return total


def compare(shown: Any, view: ReferenceView, loss: Loss) -> tuple[float, Any, int]:
    """The loss over the valid pixels, its gradient by the picture, and the number of non-finite values.

    Pixels that are masked, NaN or infinite are set to the reference's, so they have no gradient.
    """
    moving = mi.TensorXf(dr.detach(shown))
    dr.enable_grad(moving)
    three = moving[..., :3]
    finite = dr.isfinite(dr.detach(three))
    value = loss(dr.select(view.counts & finite, three, view.reference), view.reference)
    dr.backward(value)
    gradient = dr.grad(moving)
    gradient = dr.select(dr.isfinite(gradient), gradient, 0)
    broken = int(np.asarray(dr.count(~finite, axis=None)).ravel()[0])
    return float(np.asarray(value).ravel()[0]) / view.share, gradient, broken


@dataclass(frozen=True)
class LiveScene:
    """A scene with chosen parameters, its `mi.traverse` result, and the integrator that renders it."""

    scene: Any
    table: Any
    chosen: Sequence[Parameter]
    integrator: Any


def gradients(
    live: LiveScene,
    values: Mapping[str, np.ndarray],
    view: ReferenceView,
    loss: Loss,
    spp: tuple[int, int],
    seeds: tuple[int, int],
) -> tuple[float, dict[str, np.ndarray], int]:
    """Loss of one camera, dL/dvalue of every chosen parameter by key, and the number of non-finite values in the
    picture.

    The values are written into the scene first. `spp` and `seeds`: of the picture, then of the gradient.
    """
    scene, table, chosen, integrator = live.scene, live.table, live.chosen, live.integrator
    # New variables each time: a backward pass frees the graph of the previous one.
    moving = put(table, chosen, values, grad=True)
    shown = picture(scene, integrator, view.sensor, spp[0], seeds[0])
    value, pixels, broken = compare(shown, view, loss)
    # The gradient of a mean underflows in 16-bit textures; it is scaled here and back below.
    scale = float(np.prod(pixels.shape[:2]))
    integrator.render_backward(
        scene, table, pixels * scale, view.sensor, seed=dr.opaque(mi.UInt32, seeds[1]), spp=spp[1]
    )
    result = {p.key: array(dr.grad(moving[p.key]), p) / np.float32(scale * view.share) for p in chosen}
    return value, result, broken


def derivative(
    live: LiveScene,
    values: Mapping[str, np.ndarray],
    direction: Mapping[str, np.ndarray],
    sensor: Any,
    spp: int,
    seed: int,
) -> Float[np.ndarray, "h w 3"]:
    """The picture's derivative along one direction of the parameters, an unbiased estimate in forward mode.

    Non-finite values are zero.
    """
    table = live.table
    along = mi.Float(0)
    dr.enable_grad(along)
    for p in live.chosen:
        kind = type(table[p.key])
        # All directions are arrays, so that every column runs the same kernel.
        table[p.key] = typed(kind, values[p.key]) + typed(kind, direction[p.key]) * along
    table.update()
    dr.forward(along, dr.ADFlag.ClearEdges)
    image = live.integrator.render_forward(live.scene, table, sensor, seed=dr.opaque(mi.UInt32, seed), spp=spp)
    result = np.array(image, dtype=np.float32)[..., :3]
    return np.where(np.isfinite(result), result, np.float32(0))


def regularized(
    table: Any, chosen: Sequence[Parameter], values: Mapping[str, np.ndarray], penalties: Sequence[Any]
) -> tuple[float, dict[str, np.ndarray]]:
    """The sum of the regularizers and its gradient by key."""
    moving = {p.key: typed(type(table[p.key]), values[p.key]) for p in chosen}
    dr.enable_grad(moving)
    total: Any = sum(penalty(moving) for penalty in penalties)
    dr.backward(total)
    gradient = {p.key: array(dr.grad(moving[p.key]), p) for p in chosen}
    return float(np.asarray(total).ravel()[0]), gradient


def psnr(shown: Any, view: ReferenceView) -> float:
    """PSNR in dB of clipped sRGB over the valid pixels; infinite for equal pictures."""
    counts = np.array(view.counts)
    images = [srgb_from_linear(np.clip(np.nan_to_num(np.array(x)[..., :3]), 0, 1)) for x in (shown, view.reference)]
    error = float(np.square(images[0] - images[1], dtype=np.float64)[counts].mean())
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def put(
    table: Any, chosen: Sequence[Parameter], values: Mapping[str, np.ndarray], grad: bool = False
) -> dict[str, Any]:
    """Set parameters of the scene, with gradients enabled by `grad`. Returns the values as set."""
    result = {}
    for parameter in chosen:
        result[parameter.key] = typed(type(table[parameter.key]), values[parameter.key])
        if grad:
            dr.enable_grad(result[parameter.key])
        table[parameter.key] = result[parameter.key]
    table.update()
    return result


def array(value: Any, parameter: Parameter) -> np.ndarray:
    """A Mitsuba value as float32 of the parameter's shape."""
    return np.array(value, dtype=np.float32).reshape(parameter.shape)


def typed(kind: Any, values: np.ndarray) -> Any:
    """The inverse of `array`; never a literal, which would compile a kernel for each value."""
    if dr.is_tensor_v(kind):
        return kind(mi.TensorXf(aligned(values)))
    if dr.depth_v(kind) > 1:
        return kind(*[mi.Float(aligned(np.full(1, v))) for v in values])
    return kind(mi.Float(aligned(values)))
