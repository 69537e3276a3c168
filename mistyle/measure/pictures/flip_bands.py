"""FLIP of large pictures: in bands of rows, which bounds its memory, partly in a second process.

FLIP's filters reach a fraction of a degree, so a band with its margin gives the same map as the whole picture. The
package holds Python's lock, hence a process and not a thread. That process is `python -m
mistyle.measure.pictures.flip_bands FOLDER`: it reads the pictures and the order there, and writes its rows of the maps.
"""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float

from mistyle.process.cores import cores

BAND = 384  # rows
SHARE = 0.6  # the second process's share of the rows while the first has other work
LARGE = 400_000  # pixels times exposures; below, a second process costs more than it saves
Exposures = tuple[float, float, int] | None


def flip_map(
    reference: Float[np.ndarray, "h w 3"], test: Float[np.ndarray, "h w 3"], ppd: float, exposures: Exposures = None
) -> Float[np.ndarray, "h w"]:
    """FLIP's error of every pixel, 0..1: of sRGB-encoded pictures (clipped to 0..1), or with `exposures` (first, last,
    number) of linear ones (HDR-FLIP; negative values count as 0)."""
    return flip_maps({"flip": FlipPair(reference, test, exposures)}, ppd)["flip"]


@dataclass(frozen=True)
class FlipPair:
    """Two pictures for `flip_maps`: sRGB-encoded, or linear with exposures."""

    reference: Float[np.ndarray, "h w 3"]
    test: Float[np.ndarray, "h w 3"]
    exposures: Exposures = None


def flip_maps(
    pairs: Mapping[str, FlipPair], ppd: float, meanwhile: Callable[[], None] | None = None
) -> dict[str, Float[np.ndarray, "h w"]]:
    """`flip_map` of several pairs of one size. For large pairs a second process computes the lower rows, while this one
    runs `meanwhile` and then computes the upper rows."""
    height, width = next(iter(pairs.values())).reference.shape[:2]
    work = sum(height * width * (p.exposures[2] if p.exposures else 1) for p in pairs.values())
    if work < LARGE or cores() < 2 or height < 64:
        if meanwhile is not None:
            meanwhile()
        return {k: rows_of(p.reference, p.test, ppd, p.exposures, 0, height) for k, p in pairs.items()}
    cut = height // 2 if meanwhile is None else round(height * (1 - SHARE))
    with TemporaryDirectory() as folder:
        helper = _start(Path(folder), pairs, ppd, cut)
        try:
            if meanwhile is not None:
                meanwhile()
            tops = {k: rows_of(p.reference, p.test, ppd, p.exposures, 0, cut) for k, p in pairs.items()}
            output = helper.communicate()[1]
        finally:
            if helper.poll() is None:
                helper.kill()
                helper.wait()
        if helper.returncode != 0:
            raise RuntimeError(f"FLIP's second process ended with {helper.returncode}: {output.decode()[-500:]}")
        return {
            k: np.concatenate([top, np.load(Path(folder, f"map{n}.npy"), allow_pickle=False)])
            for n, (k, top) in enumerate(tops.items())
        }


def _start(folder: Path, pairs: Mapping[str, FlipPair], ppd: float, cut: int) -> subprocess.Popen:
    """The second process, with the rows from `cut` on."""
    low = max(0, cut - reach(ppd))
    order = []
    for n, pair in enumerate(pairs.values()):
        for name, picture in (("reference", pair.reference), ("test", pair.test)):
            np.save(folder / f"{name}{n}.npy", np.ascontiguousarray(picture[low:], np.float32))
        order.append({"exposures": pair.exposures, "start": cut - low, "stop": len(pair.reference) - low})
    (folder / "order.json").write_text(json.dumps({"ppd": ppd, "pairs": order}))
    command = [sys.executable, "-m", "mistyle.measure.pictures.flip_bands", str(folder)]
    paths = os.pathsep.join(p for p in sys.path if p)
    return subprocess.Popen(command, env=os.environ | {"PYTHONPATH": paths}, stderr=subprocess.PIPE)


def reach(ppd: float) -> int:
    """Margin in pixels, larger than the reach of FLIP's contrast filter (three deviations of its widest Gaussian) and
    edge filter."""
    contrast = 3 * math.sqrt(0.04 / (2 * math.pi**2)) * ppd
    edges = 3 * 0.5 * 0.082 * ppd
    return math.ceil(contrast) + math.ceil(edges) + 4


def rows_of(
    reference: Float[np.ndarray, "h w 3"],
    test: Float[np.ndarray, "h w 3"],
    ppd: float,
    exposures: Exposures,
    start: int,
    stop: int,
) -> Float[np.ndarray, "n w"]:
    """Rows start:stop of the map, band by band."""
    result = np.empty((stop - start, reference.shape[1]), np.float32)
    margin = reach(ppd)
    for first in range(start, stop, BAND):
        last = min(first + BAND, stop)
        low, high = max(0, first - margin), min(len(reference), last + margin)
        result[first - start : last - start] = _band(reference[low:high], test[low:high], ppd, exposures)[
            first - low : last - low
        ]
    return result


def _band(reference, test, ppd: float, exposures: Exposures) -> Float[np.ndarray, "h w"]:
    import flip_evaluator

    a, b = (np.ascontiguousarray(np.maximum(picture, 0), np.float32) for picture in (reference, test))
    if exposures is None:
        a, b = np.minimum(a, 1), np.minimum(b, 1)
        chosen: dict[str, float | int] = {"ppd": ppd}
    else:
        first, last, count = exposures
        chosen = {"ppd": ppd, "startExposure": first, "stopExposure": last, "numExposures": count}
    kind = "LDR" if exposures is None else "HDR"
    results = flip_evaluator.evaluate(a, b, kind, applyMagma=False, computeMeanError=False, parameters=chosen)
    return np.asarray(results[0], np.float32)[..., 0]


def main(folder: Path) -> None:
    order = json.loads((folder / "order.json").read_text())
    for n, pair in enumerate(order["pairs"]):
        a, b = (np.load(folder / f"{name}{n}.npy", mmap_mode="r", allow_pickle=False) for name in ("reference", "test"))
        exposures = tuple(pair["exposures"]) if pair["exposures"] else None
        np.save(folder / f"map{n}.npy", rows_of(a, b, order["ppd"], exposures, pair["start"], pair["stop"]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
