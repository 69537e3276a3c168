"""Seconds of the passes of a fit to pictures and of the stages after them, for the plan and for `--minutes`."""

from collections.abc import Sequence
from typing import Any

from mistyle.core.maps import Texels
from mistyle.jobs.plan import PER_TEXEL
from mistyle.jobs.settings import thread_count
from mistyle.solver.schedule import COVERED, finishing_seconds, joint_bytes, picture_seconds, size_from, whole_seconds
from mistyle.solver.settings import RecoverSettings, joint_steps, under_soft_light

FIRST_PICTURES = 8  # most pictures of the first asset: large ones are slow to read
PER_SCENE_TEXEL = 1.5e-6  # a texel written as EXR
PER_REPORT_RAY = 3e-7  # a sample of the report's pictures


def recover_seconds(settings: Any, pixels: Sequence[int], covered: float, soft: bool, shown: float) -> float:
    """Seconds of the passes within `--passes`, and of what precedes and follows them."""
    chosen: RecoverSettings = settings.recover
    fits = joint_bytes(covered / COVERED, shown * sum(pixels)) < 1e9 * chosen.memory
    joint = joint_steps(chosen) if fits else 0
    chosen = under_soft_light(chosen) if soft else chosen.model_copy(update={"joint": joint})
    return whole_seconds(chosen, size_from(chosen, pixels, covered, soft, shown), settings.passes or None)


def closing_stages(settings: Any, pixels: Sequence[int], texels: float, soft: bool, shown: float) -> dict[str, float]:
    """Seconds of the stages after "recover"."""
    report, drawn = settings.report, {"none": 0.0, "page": 0.3, "full": 1.0}[settings.report.detail]
    return {
        "measure": 1 + picture_seconds(settings.recover, pixels, soft, shown),
        "asset": 1 + 4 * texels * PER_TEXEL,
        "scene": 0.5 + texels * PER_SCENE_TEXEL,
        "report": drawn * (2 + report.frames * report.resolution**2 * report.spp * PER_REPORT_RAY),
    }


def closing_seconds(settings: Any, pixels: Sequence[int], texels: Sequence[Texels], soft: bool, shown: float) -> float:
    """Seconds between the last pass and the end of a job, on its own threads."""
    count = sum(t.covered.size for t in texels)
    covered = sum(int(t.covered.sum()) for t in texels)
    finishing = finishing_seconds(settings.recover, size_from(settings.recover, pixels, covered, soft, shown))
    total = finishing + sum(closing_stages(settings, pixels, count, soft, shown).values())
    return total * 2 / thread_count(settings)
