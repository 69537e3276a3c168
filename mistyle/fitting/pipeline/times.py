"""Seconds of the passes of a fit to pictures and of the stages after them, for the plan and for `--minutes`."""

from collections.abc import Sequence
from typing import Any

from mistyle.core.maps import Texels
from mistyle.geometry.lens import is_pinhole
from mistyle.jobs.plan import PER_BENT_PIXEL, PER_READ_PIXEL, PER_TEXEL, machine_scale
from mistyle.solver.schedule import Visible, finishing_seconds, picture_seconds, runnable, size_from, whole_seconds

FIRST_PICTURES = 8  # most pictures of the first asset: large ones are slow to read
PER_REPORT_RAY = 7e-8  # a sample of the report's pictures
REPORTED, PER_SHOWN_PIXEL = 8, 4e-7  # pictures that the report shows beside their prediction, and a pixel of these

LIGHT_SECONDS = 15.0  # of an unknown light
EXPLAINED, PER_EXPLAINED = 3, 0.3  # of exposures that are solved with a material, and of a picture of these


def reading_seconds(shots: Sequence[Any], sizes: Sequence[int]) -> float:
    """Seconds of reading every `CapturedPicture` once, and of making it straight."""
    bent = sum(n for n, shot in zip(sizes, shots, strict=True) if not is_pinhole(shot.lens))
    return sum(sizes) * PER_READ_PIXEL + bent * PER_BENT_PIXEL


def explaining_seconds(count: int, read: float, unknown: bool) -> tuple[float, float, float, float]:
    """Seconds of the parts of explaining the exposures of `count` pictures, all of which take `read` seconds to be
    read: reading some of them for an unknown light, the light, reading all, and the material."""
    from mistyle.fitting.light.unknown_light import PICTURES

    return (
        unknown * min(1, PICTURES / count) * read,
        unknown * LIGHT_SECONDS,
        read,
        EXPLAINED + PER_EXPLAINED * count,
    )


def running(settings: Any, soft: bool, texels: float, pixels: float = 0) -> Any:
    """The settings of a job, with `recover` as it will run: see `runnable`."""
    return settings.model_copy(update={"recover": runnable(settings.recover, soft, texels, pixels)})


def recover_seconds(settings: Any, pixels: Sequence[int], covered: float, soft: bool, visible: Visible) -> float:
    """Seconds of the passes of `running` settings within `--passes`, and of what precedes and follows them."""
    size = size_from(settings.recover, pixels, covered, soft, visible)
    return whole_seconds(settings.recover, size, settings.passes or None)


def closing_stages(
    settings: Any, pixels: Sequence[int], texels: float, soft: bool, visible: Visible
) -> dict[str, float]:
    """Seconds of the stages after "recover"."""
    report, drawn = settings.report, {"none": 0.0, "page": 0.3, "full": 1.0}[settings.report.detail]
    rays, largest = report.frames * report.resolution**2 * report.spp, max(pixels, default=0)
    return {
        "measure": 0.2 + picture_seconds(settings.recover, pixels, soft, visible.shown),
        "asset": 0.05 + 0.8 * texels * PER_TEXEL,
        "scene": 0.05 + texels * PER_TEXEL,
        "report": drawn * (1.2 + rays * PER_REPORT_RAY + 2 * texels * PER_TEXEL) + REPORTED * largest * PER_SHOWN_PIXEL,
    }


def closing_seconds(
    settings: Any, pixels: Sequence[int], texels: Sequence[Texels], soft: bool, visible: Visible
) -> float:
    """Seconds between the last pass and the end of a job, on its own threads."""
    count = sum(t.covered.size for t in texels)
    covered = sum(int(t.covered.sum()) for t in texels)
    finishing = finishing_seconds(settings.recover, size_from(settings.recover, pixels, covered, soft, visible))
    total = finishing + sum(closing_stages(settings, pixels, count, soft, visible).values())
    return total * machine_scale(settings)
