"""How soon our fit is as good as the usual loop ends up: seconds to the loop's final relighting PSNR.

Both see the pictures of `material_recovery.py`'s strong-map row. The loop runs for its time and is relit; ours runs
with ever more effort (EFFORTS), each time from scratch, until a run's relighting reaches the loop's. The ratio is that
whole run's seconds over the loop's; it is infinite where no effort reaches it.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery.metrics import mean_errors, relight_errors
from benchmarks.material_recovery.ours import ours
from benchmarks.material_recovery.rivals import naive, write_job
from benchmarks.material_recovery.truth import truth
from mistyle.core.maps import Maps
from mistyle.render.mitsuba.scene import Frame

# From the quickest to the defaults.
EFFORTS: tuple[dict[str, Any], ...] = (
    {"solver": "texels", "rounds": 0, "solver_iterations": 4, "smooth": False, "subsamples": 4},
    {"solver": "texels", "rounds": 0, "solver_iterations": 4},
    {"solver": "texels", "rounds": 0},
    {"solver": "texels", "rounds": 1},
    {"solver": "texels"},
    {},
)


@dataclass(frozen=True)
class TimeToQuality:
    """What `time_to_quality` found: the ratio, both sides' seconds and mean relighting PSNR-L, and the effort taken."""

    ratio: float
    naive_seconds: float
    naive_psnr_l: float
    our_seconds: float
    our_psnr_l: float
    effort: dict[str, Any]


def time_to_quality(
    file: Path,
    hdri: Path,
    *,
    seconds: float,
    resolution: int = 256,
    views: int = 16,
    spp: int = 64,
    frame: Frame = "mikkt",
    uv: str = "auto",
    cache: Path | None = None,
) -> TimeToQuality:
    """Run the loop for `seconds` on a mesh with strong maps, then ours until it is as good; see the module.

    `hdri` is the environment of the studio light. Runs of ours before the one that suffices do not count: they stand
    for choosing the effort.
    """
    cameras = drawing.fibonacci(views, resolution)
    known = truth(file, file.stem.lower(), cameras[0], "new" if uv == "new" else "auto", strong=True)
    shots = drawing.one_at_a_time(cameras)
    pictures = drawing.render(known.mesh, known.maps, shots, frame=frame, spp=spp, cache=cache)
    unseen = [shot for shots in drawing.unseen(hdri, resolution, 1).values() for shot in shots]

    def relit(maps: Any, own: Frame) -> list[np.ndarray]:
        return drawing.render(known.mesh, maps, unseen, frame=own, spp=max(8, spp // 4), seed=1, cache=cache)

    reference = relit(known.maps, frame)

    def quality(maps: list[Maps] | tuple[Maps, ...], own: Frame) -> float:
        errors = [
            relight_errors(a[..., :3], b[..., :3], a[..., 3] > 0.5)
            for a, b in zip(reference, relit(maps, own), strict=True)
        ]
        return mean_errors(errors).psnr_l

    with TemporaryDirectory() as folder:
        write_job(Path(folder), known, shots, pictures)
        maps = naive(Path(folder), known, seconds, "naive").maps
    wanted = quality(maps, "mitsuba")
    best = TimeToQuality(float("inf"), seconds, wanted, float("inf"), float("-inf"), {})
    for effort in EFFORTS:
        fitted = ours(known, shots, pictures, frame, **effort)
        reached = quality(fitted.maps, frame)
        if reached >= wanted:
            return TimeToQuality(fitted.seconds / seconds, seconds, wanted, fitted.seconds, reached, effort)
        best = TimeToQuality(float("inf"), seconds, wanted, fitted.seconds, reached, effort)
    return best


def figures(found: TimeToQuality) -> dict[str, float]:
    """For a benchmark's table: `time_to_quality_ratio` and what it is made of."""
    values = asdict(found)
    return {"time_to_quality_ratio": values.pop("ratio")} | {
        f"time_to_quality.{k}": v for k, v in values.items() if not isinstance(v, dict)
    }
