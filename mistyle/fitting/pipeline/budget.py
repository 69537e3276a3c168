"""Memory model of a fit to pictures, stage by stage, and the cache of picture samples within the budget."""

from collections.abc import Sequence
from typing import Any

from mistyle.core.errors import UsageError
from mistyle.jobs.memory_budget import Counts, Need, allowed, peaks, rounded_up, shown, smaller_setting, with_setting
from mistyle.process import memory
from mistyle.solver.schedule import COVERED, SEEN, SHOWN, solver_level
from mistyle.solver.settings import DETAILED, LARGE, joint_steps

# A fit to pictures without the cache of their samples. That takes up to `recover.memory`, which the system does not
# regain completely after the stage. Measured by `fit_512` and `fit_200` of `python -m benchmarks.photographs`, the
# report by `fit_256`, the terms of large pictures by `large`.
MATERIAL = {
    "mesh": Need(0.38, face=5000),
    "texels": Need(0.39, texel=71),
    "pictures": Need(0.53, texel=71, photograph=97),
    "recover": Need(0.71, texel=640, look=9.6, picture=250, view=370),
    "measure": Need(0.73, texel=300, picture=330),
    "asset": Need(0.76, texel=200, picture=60),
    "scene": Need(0.76, texel=225, picture=60),
    "report": Need(0.74, texel=200, drawn=70, frame=24, picture=60),
}
MATERIAL = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in MATERIAL.items()}
# Bytes of a texel that lie in files where the budget is small. Their pages stay in memory until it is needed: the
# peak of a stage then lies between its need and the budget.
IN_FILES = {"pictures": 33, "recover": 150, "measure": 74, "asset": 126, "scene": 138, "report": 94}
KEEPING = ("recover", "measure", "asset", "scene", "report")
SAMPLE = 32  # cached bytes per sample of a picture
# The settings that save memory when halved.
FITTED = ("atlas.size", "recover.subsamples")


def material_counts(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of a fit; `pixels` are those of each picture."""
    drawn, frame = shown(settings, sets)
    texel, averaged = sets * settings.atlas.size**2, averaged_pixels(settings, pixels)
    # Only covered texels are solved, usually at least half of all.
    by = solver_level(settings.recover, texel / 2, len(pixels), soft=False)
    looks = 0 if settings.recover.solver == "pictures" else texel // by**2 * len(pixels)
    if looks and settings.recover.detail:
        looks = max(looks, min(texel * len(pixels), 2 * DETAILED))
    picture = max(averaged, default=0)
    return Counts(
        texel, picture // by**2 if picture > LARGE else picture, face=faces, drawn=drawn, frame=frame, look=looks,
        picture=picture, photograph=max(pixels, default=0), own=own,
    )  # fmt: skip


def averaged_pixels(settings: Any, pixels: Sequence[int]) -> list[int]:
    """Pixels of each picture after block averaging (solver/validate.py).

    By the setting. Otherwise for an object that fills SHOWN of each picture and COVERED of its atlas, of which one
    picture sees SEEN; slant halves its projected area.
    """
    texels, average = 0.5 * COVERED * SEEN * settings.atlas.size**2, settings.references.average
    return [n // max(1, average or int((SHOWN * n / texels) ** 0.5 / 2)) ** 2 for n in pixels]


def material_gb(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> float:
    """Peak memory of a fit, GB; `pixels` are those of each picture."""
    count = material_counts(settings, pixels, faces, sets, own)
    gb_of = peaks(needs_of(settings, pixels, faces, sets, own), count)
    samples = max(settings.recover.subsamples, joint_steps(settings.recover) and settings.recover.joint_subsamples)
    cached = min(settings.recover.memory, SAMPLE * sum(averaged_pixels(settings, pixels)) * samples / 1e9)
    cached += indirect_gb(settings, pixels)
    gb_of |= {stage: gb_of[stage] + cached for stage in KEEPING}
    return round(max(gb_of.values()), 2)


def in_files(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> bool:
    """Whether texels, the texels' estimate and maps must lie in files for the fit to keep to its budget."""
    count = material_counts(settings, pixels, faces, sets, own)
    least = max(peaks(MATERIAL, count).values()) + indirect_gb(settings, pixels)
    return memory.possible() and least > allowed(settings).gb


def needs_of(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> dict[str, Need]:
    """The stages' needs, with or without arrays in files."""
    if not in_files(settings, pixels, faces, sets, own):
        return MATERIAL
    return {stage: need._replace(texel=need.texel - IN_FILES.get(stage, 0)) for stage, need in MATERIAL.items()}


def indirect_gb(settings: Any, pixels: Sequence[int]) -> float:
    """GB of the indirect light of all pictures: three floats per pixel of the estimate."""
    from mistyle.solver.indirect import MOST

    if settings.recover.solver == "pictures" or not settings.recover.bounces:
        return 0.0
    return 12 * sum(min(n, MOST**2) for n in averaged_pixels(settings, pixels)) / 1e9


def check_material(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> Any:
    """The settings of a fit with `recover.memory` reduced to the rest of `--memory`; UsageError if nothing remains.

    A fit leaves out steps for which `recover.memory` is too small. Without `--memory` nothing is reduced: a fit that is
    too large for the machine is refused.
    """
    budget, size = allowed(settings), (faces, sets, own)

    def least(chosen: Any) -> float:
        return material_gb(with_setting(chosen, "recover.memory", 1e-9), pixels, *size)

    needed, left = least(settings), float(settings.recover.memory)
    if budget.given:
        left = budget.gb - max(
            peaks(needs_of(settings, pixels, *size), material_counts(settings, pixels, *size)).values()
        )
        left -= indirect_gb(settings, pixels)
    elif (whole := material_gb(settings, pixels, faces, sets, own)) > budget.gb >= needed:
        raise UsageError(
            f"{budget.who}: the fit needs {whole:.2f} GB; give it --memory {rounded_up(needed)}G or more, with a "
            f"smaller cache of the pictures' samples, or {smaller_setting(settings, least, FITTED)}"
        )
    if needed > budget.gb or left <= 0:
        raise UsageError(
            f"{budget.who}: the fit needs {needed:.2f} GB even without a cache of the pictures' "
            f"samples; give it --memory {rounded_up(needed)}G or more, or {smaller_setting(settings, least, FITTED)}"
        )
    return with_setting(settings, "recover.memory", min(settings.recover.memory, left)) if budget.given else settings
