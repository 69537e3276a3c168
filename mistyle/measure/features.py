"""Picture → feature maps: an embedded filter bank that needs no weights, or VGG-19 from the user's file.

A feature extractor is a function: pictures (n, c, h, w), sRGB-encoded 0..1, c = 1 (grey) or 3, to a list of maps
(n, k, h', w'), finest first. The filter bank accepts both; VGG repeats a grey channel three times. All of them are
differentiable and stateless.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from jaxtyping import Float

from mistyle.core.errors import InputRefused
from mistyle.process.weights import tensors

Features = Callable[[torch.Tensor], list[torch.Tensor]]

LEVELS = 4
ORIENTATIONS = 4
# Below this response (in sRGB units per unit of contrast) the rectifier passes both signs, so that a picture
# without detail still has a gradient towards detail of either polarity.
SOFTNESS = 0.02
# Blue, orange and green-magenta contrasts in addition to luma: fixed opponent axes, rows sum to 0.
OPPONENT = ((0.299, 0.587, 0.114), (0.5, 0.5, -1.0), (0.5, -1.0, 0.5))
# The square roots of the mean energy of the six filters on pictures with a 1/f spectrum, so that odd, even and
# low-pass maps weigh about the same.
ODD_SCALE, EVEN_SCALE, LOW_SCALE = 2.0, 3.0, 0.5

# torchvision's `vgg19().features`: convolutions and pools by index; the map of conv n is taken after its ReLU.
TORCHVISION_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34)
TORCHVISION_POOLS = (4, 9, 18, 27)
TORCHVISION_TAPS = (0, 5, 10, 19, 28)
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# The normalised VGG-19 of Li et al. (WCT): layer 0 takes RGB 0..1 to its own input space; reflection padding.
NORMALISED_CONVOLUTIONS = (2, 5, 9, 12, 16, 19, 22, 25, 29, 32, 35, 38, 42)
NORMALISED_POOLS_BEFORE = (9, 16, 29, 42)
NORMALISED_TAPS = (2, 9, 16, 29, 42)


def load_features(path: Path | None, levels: int = 5) -> Features:
    """The filter bank (None) or VGG-19 from `path`: .safetensors, .npz or .pth (process/weights.py).

    Accepted: torchvision's layer order (`features.N.weight` or `N.weight`, N = 0, 2, 5, …), truncated anywhere after
    relu1_1; the normalised VGG of Li et al. (`0.weight` 1x1, then 2, 5, 9, 12, 16, …). Other files are refused. The
    first `levels` of relu1_1, relu2_1, … relu5_1 are computed, as far as the file has them.
    """
    if path is None:
        return filter_bank
    weights = _read_weights(path)
    first = weights.get("0.weight")
    if first is None or first.ndim != 4 or first.shape[1] != 3:
        raise InputRefused(
            f"{path}: no layer '0.weight' or 'features.0.weight' with 3 input channels; expected VGG-19 in "
            "torchvision's layer order or the normalised VGG-19 of Li et al. Leave the setting empty for the embedded "
            "filter bank."
        )
    if first.shape[2:] == (1, 1):
        plan = _plan(weights, NORMALISED_CONVOLUTIONS, NORMALISED_TAPS[:levels], NORMALISED_POOLS_BEFORE, path)
        return partial(_normalised_vgg, weights["0.weight"], weights["0.bias"], plan)
    pools_before = [next(n for n in TORCHVISION_CONVOLUTIONS if n > pool) for pool in TORCHVISION_POOLS]
    plan = _plan(weights, TORCHVISION_CONVOLUTIONS, TORCHVISION_TAPS[:levels], pools_before, path)
    return partial(_torchvision_vgg, plan)


def filter_bank(image: Float[torch.Tensor, "n c h w"]) -> list[torch.Tensor]:
    """Steerable derivative filters at LEVELS scales, a factor of two apart; no weights, no training.

    Per scale: first and second derivatives of a Gaussian at four orientations (8 maps), their rounded magnitudes (8),
    and their energy multiplied with the next coarser scale's (4 maps: joint occurrence of strokes or edges and their
    coarser course). The low-pass colour (1 or 3 maps) follows and, in colour and except for the finest scale, the
    gradients of the two opponent channels (4). Luma is used for the oriented maps. The finest scale has the picture's
    own size.

    Derivative x and magnitude |x|, both over sqrt(2), are the two polarities (|x| + x) / 2 and (|x| - x) / 2 rotated by
    45 degrees: squared distances and Gram matrices' distances are those of the rectified maps, at half the cost.
    """
    planes = _opponent(image)
    kernels, (rectified, crossed, correlation) = _kernels(image.device, image.dtype), _functions()
    responses, low, chroma = [], [], []
    for level in range(LEVELS):
        if level:
            planes = _half(planes)
        responses.append(correlation.apply(_pad(planes[:, :1], 3), kernels * math.sqrt(0.5)))
        low.append(LOW_SCALE * planes)
        chroma.append([_chroma_gradients(planes, kernels)] if level and planes.shape[1] == 3 else [])
    sizes, energy = zip(*(rectified.apply(response) for response in responses), strict=True)
    maps = []
    for level, response in enumerate(responses):
        parts = [response, sizes[level]]
        if level + 1 < LEVELS:
            coarser = functional.interpolate(energy[level + 1], size=response.shape[2:], mode="bilinear")
            parts.append(crossed.apply(energy[level], coarser))
        maps.append(torch.cat([*parts, low[level], *chroma[level]], dim=1))
    return maps


@cache
def _functions() -> tuple[Any, Any, Any]:
    """The bank's two nonlinearities and its correlation, with faster gradients than torch's own."""

    class Rectified(torch.autograd.Function):
        """x (n, 8, h, w) over sqrt(2) -> rounded magnitude s = sqrt(x² + SOFTNESS² / 2), and the energy of the odd and
        the even filter of each orientation, e = sqrt(2 (s_odd² + s_even²)), (n, 4, h, w)."""

        @staticmethod
        def forward(ctx: Any, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            squares = (x * x).add_(SOFTNESS**2 / 2)
            energy = (squares[:, :ORIENTATIONS] + squares[:, ORIENTATIONS:]).mul_(2).sqrt_()
            size = squares.sqrt_()
            ctx.save_for_backward(x, size, energy)
            return size, energy

        @staticmethod
        def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
            x, size, energy = ctx.saved_tensors
            result = grads[0] / size
            shared = (grads[1] / energy).mul_(2)
            result.view(-1, 2, *shared.shape[1:]).add_(shared[:, None])
            return result.mul_(x)

    class Crossed(torch.autograd.Function):
        """sqrt(a b) of positive maps."""

        @staticmethod
        def forward(ctx: Any, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            both = (a * b).sqrt_()
            ctx.save_for_backward(a, b, both)
            return both

        @staticmethod
        def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            a, b, both = ctx.saved_tensors
            half = (grads[0] * both).mul_(0.5)
            return half / a, half / b

    class Correlation(torch.autograd.Function):
        """Correlation of one channel with square kernels (k, 1, d, d). Its gradient is a correlation with rotated
        kernels; torch's own for so few channels takes up to five times as long."""

        @staticmethod
        def forward(ctx: Any, x: torch.Tensor, kernels: torch.Tensor) -> torch.Tensor:
            ctx.kernels = kernels
            return functional.conv2d(x, kernels)

        @staticmethod
        def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
            turned = ctx.kernels.flip(2, 3).transpose(0, 1).contiguous()
            return functional.conv2d(grads[0], turned, padding=ctx.kernels.shape[2] - 1), None

    return Rectified, Crossed, Correlation


def _opponent(image: torch.Tensor) -> torch.Tensor:
    if image.shape[1] == 1:
        return image
    matrix = torch.tensor(OPPONENT, dtype=image.dtype, device=image.device)
    return functional.conv2d(image, matrix[:, :, None, None])


def _kernels(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """(8, 1, 7, 7): first, then second derivatives of a Gaussian (sigma 1 pixel) along 0, 45, 90, 135 degrees."""
    at = torch.arange(-3, 4, dtype=torch.float64)
    y, x = torch.meshgrid(at, at, indexing="ij")
    gauss = torch.exp(-(x**2 + y**2) / 2) / (2 * math.pi)
    slopes, curvatures = [], []
    for k in range(ORIENTATIONS):
        angle = math.pi * k / ORIENTATIONS
        along = math.cos(angle) * x + math.sin(angle) * y
        # Correlation with along·G measures the slope; with (1 - along²)·G the curvature, bright ridges positive.
        slopes.append(ODD_SCALE * along * gauss)
        even = (1 - along**2) * gauss
        curvatures.append(EVEN_SCALE * (even - gauss * even.sum() / gauss.sum()))
    return torch.stack(slopes + curvatures)[:, None].to(device, dtype)


def _chroma_gradients(planes: torch.Tensor, kernels: torch.Tensor) -> torch.Tensor:
    """Slopes along x and y of the two opponent channels, (n, 4, h, w)."""
    both = planes[:, 1:].flatten(0, 1)[:, None]
    slopes = _functions()[2].apply(_pad(both, 3), kernels[[0, 2]])
    return slopes.reshape(len(planes), 4, *planes.shape[2:])


def _pad(x: torch.Tensor, by: int) -> torch.Tensor:
    return functional.pad(x, (by, by, by, by), mode="replicate")


def _half(x: torch.Tensor) -> torch.Tensor:
    """Binomial blur (1 4 6 4 1) and every second pixel."""
    row = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=x.dtype, device=x.device) / 16
    channels = x.shape[1]
    x = functional.conv2d(_pad(x, 2), row.view(1, 1, 1, 5).expand(channels, 1, 1, 5), stride=(1, 2), groups=channels)
    return functional.conv2d(x, row.view(1, 1, 5, 1).expand(channels, 1, 5, 1), stride=(2, 1), groups=channels)


def _read_weights(path: Path) -> dict[str, torch.Tensor]:
    if not path.is_file():
        raise InputRefused(f"{path}: no such file of feature weights.")
    named = {key.removeprefix("features."): value for key, value in tensors(path).items()}
    return {key: value.float() for key, value in named.items()}


def _plan(weights: dict[str, torch.Tensor], convolutions, taps, pools_before, path: Path) -> list[tuple]:
    """(weight, bias, pool first, tap) per layer present, in order; shapes are checked against each other."""
    plan, channels = [], None
    last_tap = max((n for n in taps if f"{n}.weight" in weights), default=None)
    if last_tap is None:
        raise InputRefused(f"{path}: has none of the layers {', '.join(map(str, taps))} of VGG-19.")
    for n in convolutions:
        if n > last_tap:
            break
        weight, bias = weights.get(f"{n}.weight"), weights.get(f"{n}.bias")
        if weight is None or bias is None or weight.shape[2:] != (3, 3) or (channels and weight.shape[1] != channels):
            shape = "nothing" if weight is None else tuple(weight.shape)
            raise InputRefused(f"{path}: layer {n} is {shape}; expected a 3x3 convolution of {channels or 3} channels.")
        channels = weight.shape[0]
        plan.append((weight.contiguous(memory_format=torch.channels_last), bias, n in pools_before, n in taps))
    return plan


def _torchvision_vgg(plan: list[tuple], image: torch.Tensor) -> list[torch.Tensor]:
    image = _three(image)
    mean = torch.tensor(IMAGENET_MEAN, dtype=image.dtype, device=image.device).view(1, 3, 1, 1)
    std = torch.tensor(IMAGENET_STD, dtype=image.dtype, device=image.device).view(1, 3, 1, 1)
    return _run((image - mean) / std, plan, lambda x: functional.pad(x, (1, 1, 1, 1)))


def _normalised_vgg(
    weight: torch.Tensor, bias: torch.Tensor, plan: list[tuple], image: torch.Tensor
) -> list[torch.Tensor]:
    entered = functional.conv2d(_three(image), weight.to(image), bias.to(image))
    return _run(entered, plan, lambda x: functional.pad(x, (1, 1, 1, 1), mode="reflect"))


def _run(x: torch.Tensor, plan: list[tuple], pad: Callable[[torch.Tensor], torch.Tensor]) -> list[torch.Tensor]:
    x = x.contiguous(memory_format=torch.channels_last)
    maps = []
    for weight, bias, pool, tap in plan:
        if pool:
            x = functional.max_pool2d(x, 2)
        x = functional.conv2d(pad(x), weight.to(x), bias.to(x)).relu_()
        if tap:
            maps.append(x)
    return maps


def _three(image: torch.Tensor) -> torch.Tensor:
    return image.expand(-1, 3, -1, -1) if image.shape[1] == 1 else image
