"""What the material recovery benchmark leaves behind: a table, JSON, and pictures side by side."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common import lettered, machine
from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import Maps
from mistyle.io.images.write import write_png

Columns = Mapping[str, Mapping[str, float]]  # method -> figure -> value

# Figure, heading, digits; in the order of the table.
TABLE = (
    ("normal_mean_deg", "normal", 3),
    ("normal_median_deg", "median", 3),
    ("normal_p95_deg", "p95", 2),
    ("roughness_mse", "rough MSE", 6),
    ("roughness_median", "median", 4),
    ("metallic_mse", "metal MSE", 5),
    ("albedo_psnr", "albedo dB", 2),
    ("albedo_psnr_aligned", "aligned", 2),
    ("relight_psnr_h", "PSNR-H", 2),
    ("relight_psnr_l", "PSNR-L", 2),
    ("relight_ssim", "SSIM", 4),
    ("relight_flip", "FLIP", 4),
    ("seconds", "seconds", 1),
)
# On the strong maps, 16 even views x 3 lights one at a time, 512²: bound and whether it is an upper one.
STRONG_TARGETS = {
    "normal_mean_deg": (0.5, True),
    "roughness_mse": (4e-3, True),
    "albedo_psnr": (37.0, False),
    "relight_psnr_l": (40.0, False),
}
# On the assets' own maps: the share of the best constant's error that may be left.
SHARE_OF_CONSTANT = 0.2
GAIN = 3.0
CAPTION = 20  # rows of a sheet that name a picture


def table(row: str, methods: Columns) -> str:
    """One line a method, ours first."""
    width = max(len(m) for m in methods)
    lines = [row, " " * (width + 2) + " ".join(f"{head:>10}" for _, head, _ in TABLE)]
    for method, values in methods.items():
        cells = (f"{values[key]:>10.{digits}f}" if key in values else " " * 10 for key, _, digits in TABLE)
        lines.append(f"  {method:<{width}}" + " ".join(cells))
    return "\n".join(lines)


def verdicts(methods: Columns, strong: bool) -> list[str]:
    """A sentence for every target of a row."""
    mine, constant = methods["ours"], methods["constant"]
    result = []
    if strong:
        for key, (bound, upper) in STRONG_TARGETS.items():
            result.append(_verdict(key, mine[key], bound, upper))
            if f"confident_{key}" in mine:
                result.append(_verdict(f"confident_{key}", mine[f"confident_{key}"], bound, upper))
    else:
        for key in ("normal_mean_deg", "roughness_mse"):
            if constant[key] < 1e-12:
                result.append(f"  {key}: the truth is constant, there is nothing to beat")
                continue
            result.append(_verdict(f"{key} / constant's", mine[key] / constant[key], SHARE_OF_CONSTANT, True))
        # Of the decibels' difference, since the constant's own error may be zero.
        squares = 10 ** ((constant["albedo_psnr"] - mine["albedo_psnr"]) / 10)
        result.append(_verdict("albedo squared error / constant's", squares, SHARE_OF_CONSTANT, True))
    if "gain_over_naive_db" in mine:
        result.append(_verdict("gain_over_naive_db", mine["gain_over_naive_db"], GAIN, False))
    return result


def _verdict(name: str, value: float, bound: float, upper: bool) -> str:
    met = value <= bound if upper else value >= bound
    return f"  {name} {value:.4g}, target {'<=' if upper else '>='} {bound:g}: {'met' if met else 'MISSED'}"


def write(
    figures: Mapping[str, float], baselines: Mapping[str, float], notes: Sequence[str], file: Path | None
) -> None:
    """{"figures", "baselines", "notes", "machine"} to a file ('-': to stdout). Infinities and NaN become null."""
    if file is None:
        return

    def plain(values: Mapping[str, float]) -> dict[str, float | None]:
        return {k: round(float(v), 6) if np.isfinite(v) else None for k, v in values.items()}

    result = {"figures": plain(figures), "baselines": plain(baselines), "notes": list(notes), "machine": machine()}
    text = json.dumps(result, indent=2, allow_nan=False) + "\n"
    if str(file) == "-":
        print(text, end="")
    else:
        file.write_text(text, encoding="utf-8")


def map_sheet(path: Path, rows: Mapping[str, Maps], confidence: np.ndarray | None, covered: np.ndarray) -> None:
    """One row a method: albedo, normal, roughness, metallic; ours with its confidence (share of the brightest)."""
    lines = []
    for k, (name, m) in enumerate(rows.items()):
        tiles = {"albedo": srgb_from_linear(m.albedo), "normal": m.normal * 0.5 + 0.5}
        tiles |= {"roughness": _grey(m.roughness), "metallic": _grey(m.metallic)}
        if confidence is not None and k == 1:
            top = float(np.percentile(confidence[covered], 95))
            tiles["confidence"] = _grey(np.clip(confidence / max(top, 1e-12), 0, 1))
        elif confidence is not None:
            tiles[""] = np.zeros_like(m.albedo)
        framed = [_framed(t * covered[..., None], f"{name}: {what}" if what else "") for what, t in tiles.items()]
        lines.append(np.concatenate(framed, axis=1))
    write_png(path, np.concatenate(lines, axis=0))


def relit_sheet(path: Path, pictures: Mapping[str, Sequence[np.ndarray]]) -> None:
    """One column a method, one row a light, sRGB."""
    columns = [
        np.concatenate([_framed(srgb_from_linear(p[..., :3]), name) for p in shown], axis=0)
        for name, shown in pictures.items()
    ]
    write_png(path, np.concatenate(columns, axis=1))


def _grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[..., None], 3, axis=2)


def _framed(tile: np.ndarray, caption: str) -> np.ndarray:
    """At most 512 pixels a side, with a grey line around and a caption over it."""
    step = max(1, tile.shape[0] // 512)
    small = np.asarray(tile[::step, ::step], np.float32)
    above = _grey(lettered(caption, (CAPTION, small.shape[1])))
    return np.pad(np.concatenate([above, small]), ((1, 1), (1, 1), (0, 0)), constant_values=0.3)
