"""How well the embedded filter bank tells styles apart: its distances between paintings against those of VGG-19."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def pictures(folder: Path, size: int) -> Any:
    """(n, 3, size, size): both halves of every style picture, as it is and turned by a quarter."""
    import torch
    from PIL import Image

    found = []
    for file in sorted(folder.glob("*.[jp][pn]g")):
        rgba = Image.open(file).convert("RGBA")
        flat = Image.new("RGBA", rgba.size, "white")
        flat.alpha_composite(rgba)
        rgb, (width, height) = flat.convert("RGB"), rgba.size
        wide = width >= height
        boxes = [(0, 0, width // 2, height), (width - width // 2, 0, width, height)]
        boxes = boxes if wide else [(0, 0, width, height // 2), (0, height - height // 2, width, height)]
        for half in (rgb.crop(box) for box in boxes):
            scale = size / min(half.size)
            half = half.resize([max(size, round(side * scale)) for side in half.size], Image.Resampling.LANCZOS)
            x, y = ((side - size) // 2 for side in half.size)
            square = half.crop((x, y, x + size, y + size))
            found += [np.asarray(each, np.float32) / 255 for each in (square, square.rotate(90))]
    return torch.from_numpy(np.stack(found).transpose(0, 3, 1, 2).copy())


def ranking(folder: Path, weights: Path, size: int) -> dict[str, float]:
    """The filter bank's style distances against VGG's, over all pairs and all triplets of the pictures in `folder`."""
    from scipy.stats import spearmanr

    from mistyle.measure.features import load_features

    images = pictures(folder, size)
    by_bank, by_vgg = (_distances(load_features(path), images) for path in (None, weights))
    figures: dict[str, float] = {"ranking.pictures": len(images)}
    upper = np.triu_indices(len(images), 1)
    for statistic in by_bank:
        ours, theirs = by_bank[statistic], by_vgg[statistic]
        figures[f"ranking.{statistic}.spearman"] = float(np.asarray(spearmanr(ours[upper], theirs[upper]))[0])
        alike = [
            _same_order(np.delete(a, k), np.delete(b, k)) for k, (a, b) in enumerate(zip(ours, theirs, strict=True))
        ]
        figures[f"ranking.{statistic}.triplets"] = float(np.mean(alike))
    return figures


def _distances(features: Callable, images: Any) -> dict[str, np.ndarray]:
    """Matrices of style distances, symmetric: Gram matrices, or mean and deviation of every map, over their energy."""
    import torch

    from mistyle.measure import losses

    with torch.no_grad():
        mask = torch.ones(1, 1, *images.shape[2:])
        maps = [features(image[None]) for image in images]
        grams = [[losses.gram(level, mask)[0] for level in levels] for levels in maps]
        moments = [[torch.stack([m[0].mean((1, 2)), m[0].std((1, 2))]) for m in levels] for levels in maps]
    result = {name: np.zeros((len(images), len(images))) for name in ("gram", "mean_std")}
    for i in range(len(images)):
        for j in range(i):
            for level, (a, b) in enumerate(zip(grams[i], grams[j], strict=True)):
                energy = float(a.diagonal().mean() + b.diagonal().mean()) / 2
                result["gram"][i, j] += float(((a - b) / energy).square().mean())
                result["mean_std"][i, j] += float((moments[i][level] - moments[j][level]).square().mean()) / energy
    return {name: matrix + matrix.T for name, matrix in result.items()}


def _same_order(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the pairs that two lists of distances order alike."""
    upper = np.triu_indices(len(a), 1)
    signs = [np.sign(x[:, None] - x[None])[upper] for x in (a, b)]
    return float((signs[0] == signs[1]).mean())
