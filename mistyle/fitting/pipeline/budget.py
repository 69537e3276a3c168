"""How much memory a fit to pictures needs, stage by stage, and what of the pictures it keeps within its budget."""

from collections.abc import Sequence
from typing import Any

from mistyle.core.errors import UsageError
from mistyle.jobs.memory_budget import Counts, Need, allowed, peaks, rounded_up, shown, smaller_setting, with_setting
from mistyle.solver.settings import joint_steps

# A fit to pictures, without what is kept of the pictures' samples, up to `recover.memory`; the system does not get all
# of that back after the stage. Read off `fit_512` and `fit_200`, the report off `fit_256`, what hangs on large pictures
# off `large` of `python -m benchmarks.photographs`.
MATERIAL = {
    "mesh": Need(0.38, face=5000),
    "texels": Need(0.39, texel=71),
    "pictures": Need(0.53, texel=71, photograph=97),
    "recover": Need(0.71, texel=900, look=9.6, picture=620),
    "measure": Need(0.73, texel=300, look=6, picture=620),
    "asset": Need(0.76, texel=200, look=6, picture=570),
    "scene": Need(0.76, texel=200, look=6, picture=570),
    "report": Need(0.74, texel=200, drawn=70, frame=24, look=6, picture=570),
}
MATERIAL = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in MATERIAL.items()}
KEEPING = ("recover", "measure", "asset", "scene", "report")
# Shares of a picture that show the object, of the atlas that is covered, and of that what one picture sees.
SHOWN, COVERED, SEEN = 0.3, 0.55, 0.35
SAMPLE = 32  # bytes that are kept of a sample of a picture
# The settings whose half saves memory.
FITTED = ("atlas.size", "recover.subsamples")


def material_counts(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of a fit to pictures of so many pixels each."""
    drawn, frame = shown(settings, sets)
    texel = solved = sets * settings.atlas.size**2
    # Only covered texels are solved: half of them at least, as a rule.
    while solved > 2 * settings.recover.solver_texels:
        solved //= 4
    looks = 0 if settings.recover.solver == "pictures" else solved * len(pixels)
    looked = looked_at(settings, pixels)
    return Counts(
        texel, sum(looked), face=faces, drawn=drawn, frame=frame, look=looks,
        picture=max(looked, default=0), photograph=max(pixels, default=0), own=own,
    )  # fmt: skip


def looked_at(settings: Any, pixels: Sequence[int]) -> list[int]:
    """Pixels that are left of pictures of so many after blocks of them were averaged (solver/validate.py).

    By the setting; else for an object that fills SHOWN of each picture, with COVERED of its atlas, SEEN by one, turned
    away from the camera such that half of its area is left.
    """
    texels, average = 0.5 * COVERED * SEEN * settings.atlas.size**2, settings.references.average
    return [n // max(1, average or int((SHOWN * n / texels) ** 0.5 / 2)) ** 2 for n in pixels]


def material_gb(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> float:
    """Peak memory of a fit to pictures of so many pixels each, GB."""
    count = material_counts(settings, pixels, faces, sets, own)
    found = peaks(MATERIAL, count)
    samples = max(settings.recover.subsamples, joint_steps(settings.recover) and settings.recover.joint_subsamples)
    held = min(settings.recover.memory, SAMPLE * count.view * samples / 1e9)
    held += between_gb(settings, pixels)
    found |= {stage: found[stage] + held for stage in KEEPING}
    return round(max(found.values()), 2)


def between_gb(settings: Any, pixels: Sequence[int]) -> float:
    """GB of the light between surfaces that is kept of every picture: three floats a pixel of the estimate."""
    from mistyle.solver.indirect import MOST

    if settings.recover.solver == "pictures" or not settings.recover.bounces:
        return 0.0
    return 12 * sum(min(n, MOST**2) for n in looked_at(settings, pixels)) / 1e9


def check_material(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1, own: int = 0) -> Any:
    """The settings of a fit to pictures with `recover.memory` cut to what `--memory` leaves; UsageError for none.

    A fit leaves out steps for which `recover.memory` is too small. So a budget that nobody gave cuts nothing: a fit
    that is too large for the machine is refused.
    """
    budget = allowed(settings)

    def least(chosen: Any) -> float:
        return material_gb(with_setting(chosen, "recover.memory", 1e-9), pixels, faces, sets, own)

    needed, left = least(settings), float(settings.recover.memory)
    if budget.given:
        left = budget.gb - max(peaks(MATERIAL, material_counts(settings, pixels, faces, sets, own)).values())
        left -= between_gb(settings, pixels)
    elif (whole := material_gb(settings, pixels, faces, sets, own)) > budget.gb >= needed:
        raise UsageError(
            f"{budget.who}: the fit needs {whole:.2f} GB; give it --memory {rounded_up(needed)}G or more, with which "
            f"it keeps fewer of the pictures' samples, or {smaller_setting(settings, least, FITTED)}"
        )
    if needed > budget.gb or left <= 0:
        raise UsageError(
            f"{budget.who}: the fit needs {needed:.2f} GB even if it keeps nothing of the pictures' "
            f"samples; give it --memory {rounded_up(needed)}G or more, or {smaller_setting(settings, least, FITTED)}"
        )
    return with_setting(settings, "recover.memory", min(settings.recover.memory, left)) if budget.given else settings
