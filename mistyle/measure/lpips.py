"""LPIPS with the SqueezeNet 1.1 backbone (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features").

Two files of weights are needed, neither of which comes with mistyle: the backbone in torchvision's layout
(BSD-3-Clause) and the linear heads of LPIPS v0.1, `squeeze.pth` of richzhang/PerceptualSimilarity (BSD-2-Clause).
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as functional
from jaxtyping import Bool, Float

from mistyle.core.errors import InputRefused
from mistyle.measure.features import _read_weights

# Distance of two pictures (h w 3), sRGB-encoded 0..1, over a mask (h w).
Lpips = Callable[[np.ndarray, np.ndarray, np.ndarray], float]

# torchvision's `squeezenet1_1().features`: max pools, fire modules, and the layers of the taps.
POOLS = (2, 5, 8)
FIRES = (3, 4, 6, 7, 9, 10, 11, 12)
TAPS = {1: 64, 4: 128, 7: 256, 9: 384, 10: 384, 11: 512, 12: 512}  # layer -> channels
# The published scaling layer, for pictures in -1..1.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
SMALLEST = 32  # pixels: the deepest taps then have one position


def load_lpips(backbone: Path, heads: Path) -> Lpips:
    """LPIPS-squeeze v0.1 from its two files (.npz, .safetensors or .pth; process/weights.py).

    The function takes (reference, test, mask): outside the mask the test takes the reference's pixels, and each tap's
    difference is averaged over the mask at the tap's resolution; over a full mask that is the published LPIPS. NaN for
    an empty mask. Raises InputRefused for files whose layers are not those of SqueezeNet 1.1 or of the heads.
    """
    net, weights = _squeezenet(_read_weights(backbone), backbone), _heads(_read_weights(heads), heads)

    def distance(
        reference: Float[np.ndarray, "h w 3"], test: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
    ) -> float:
        if min(mask.shape) < SMALLEST:
            raise ValueError(f"found pictures of {mask.shape} pixels; LPIPS needs {SMALLEST} along each side")
        if not mask.any():
            return float("nan")
        same = np.where(mask[..., None], test, reference)
        pair = torch.from_numpy(np.stack([reference, same]).astype(np.float32)).permute(0, 3, 1, 2)
        inside = torch.from_numpy(mask.astype(np.float32))[None, None]
        with torch.no_grad():
            return float(sum(_tap(f, w, inside) for f, w in zip(taps(net, pair), weights, strict=True)))

    return distance


def taps(net: Mapping[str, torch.Tensor], pictures: Float[torch.Tensor, "n 3 h w"]) -> list[torch.Tensor]:
    """The seven maps that LPIPS compares, of sRGB-encoded pictures 0..1; `net` has the keys `N.…` of `features.N.…`."""
    shift, scale = (pictures.new_tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))
    x = (2 * pictures - 1 - shift) / scale
    x = functional.relu(functional.conv2d(x, net["0.weight"], net["0.bias"], stride=2))
    maps = [x]
    for layer in range(2, max(TAPS) + 1):
        x = functional.max_pool2d(x, 3, 2, ceil_mode=True) if layer in POOLS else _fire(net, layer, x)
        if layer in TAPS:
            maps.append(x)
    return maps


def _fire(net: Mapping[str, torch.Tensor], layer: int, x: torch.Tensor) -> torch.Tensor:
    """A squeeze layer, then parallel 1x1 and 3x3 convolutions."""

    def convolve(name: str, x: torch.Tensor, padding: int = 0) -> torch.Tensor:
        weight, bias = net[f"{layer}.{name}.weight"], net[f"{layer}.{name}.bias"]
        return functional.relu(functional.conv2d(x, weight, bias, padding=padding))

    squeezed = convolve("squeeze", x)
    return torch.cat([convolve("expand1x1", squeezed), convolve("expand3x3", squeezed, 1)], dim=1)


def _tap(features: Float[torch.Tensor, "2 k h w"], weight: Float[torch.Tensor, " k"], mask: torch.Tensor) -> float:
    """The head's weighted squared difference of features at unit length, averaged over the mask."""
    unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
    difference = ((unit[0] - unit[1]).square() * weight[:, None, None]).sum(dim=0)
    share = functional.interpolate(mask, size=difference.shape, mode="area")[0, 0]
    return float((difference * share).sum() / share.sum())


def _squeezenet(weights: Mapping[str, torch.Tensor], path: Path) -> dict[str, torch.Tensor]:
    """The convolutions up to the last tap, their shapes checked against the published network."""
    channels, expected = 64, {"0": (64, 3, 3, 3)}
    for layer in FIRES:
        # Squeeze 16, 16, 32, 32, 48, 48, 64, 64; both expansions four times as many.
        few = 16 * (1 + FIRES.index(layer) // 2)
        expected[f"{layer}.squeeze"] = (few, channels, 1, 1)
        expected[f"{layer}.expand1x1"] = (4 * few, few, 1, 1)
        expected[f"{layer}.expand3x3"] = (4 * few, few, 3, 3)
        channels = 8 * few
    for name, shape in expected.items():
        weight = weights.get(f"{name}.weight")
        if weight is None or tuple(weight.shape) != shape or f"{name}.bias" not in weights:
            actual = "nothing" if weight is None else tuple(weight.shape)
            raise InputRefused(
                f"{path}: layer 'features.{name}' is {actual}; expected {shape}: SqueezeNet 1.1's weights."
            )
    return {f"{name}.{kind}": weights[f"{name}.{kind}"] for name in expected for kind in ("weight", "bias")}


def _heads(weights: Mapping[str, torch.Tensor], path: Path) -> list[torch.Tensor]:
    """One weight per channel and tap; LPIPS keeps them non-negative."""
    heads = []
    for k, channels in enumerate(TAPS.values()):
        weight = weights.get(f"lin{k}.model.1.weight")
        if weight is None or tuple(weight.shape) != (1, channels, 1, 1):
            actual = "nothing" if weight is None else tuple(weight.shape)
            raise InputRefused(
                f"{path}: 'lin{k}.model.1.weight' is {actual}; expected (1, {channels}, 1, 1) of LPIPS-squeeze's heads."
            )
        heads.append(weight.reshape(-1))
    return heads
