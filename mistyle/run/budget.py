"""How much memory a job will need, stage by stage, from counts alone; and whether it keeps the budget it was given.

A stage's peak is what the program itself takes, plus bytes a texel of all texture sets, a pixel of all views together,
a pixel of a step's crops, a surface sample, a face, a texel of the textures as they are drawn, and a pixel of the
turntable's frames. Those of PLAIN were solved from the peaks that `run.json` notes for every stage (`peaks_gb`) of five
jobs: `draft_spot`, `views_64` and `atlas_4096` of `python -m benchmarks.memory --stages`, and the draft on spot with an
atlas of 3072², four views and 20,000 samples, and of 2048². Those of TILED come from stages run alone at 1024² and
2048², the report's from 2048² and 4096². They hold on the processor, with two threads and the embedded filter bank:
VGG-19 and the stylizers that need models count their own (run/generative.py).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from mistyle.core import memory
from mistyle.core.errors import UsageError
from mistyle.core.maps import coarser
from mistyle.run.settings import Settings
from mistyle.stages.recover_settings import joint_steps


class Need(NamedTuple):
    """A stage's peak: GB of the program, then bytes a texel, view pixel, crop pixel, surface sample, face, texel of the
    textures as the views draw them (kept by the renderer) and as the report's close-ups do, pixel of the turntable's
    frames, texel times picture where texels are solved one by one, and pixel of the largest picture, as the fit looks
    at it and as it was taken."""

    program: float
    texel: float = 0
    view: float = 0
    crop: float = 0
    sample: float = 0
    face: float = 0
    viewed: float = 0
    drawn: float = 0
    frame: float = 0
    look: float = 0
    picture: float = 0
    photograph: float = 0


# With every array in memory.
PLAIN = {
    "mesh": Need(0.38, face=5000),
    "texels": Need(0.38, texel=71),
    "views": Need(0.46, texel=67, viewed=64, view=46.5),
    "surface": Need(0.49, texel=67, viewed=68, view=45.5, sample=1200),
    "bake": Need(0.59, texel=102, viewed=82, view=58.5),
    "stylized": Need(0.53, texel=95, viewed=64, view=63.5),
    "fit": Need(0.75, texel=184, viewed=51, view=107, crop=2000),
    "masks": Need(0.77, texel=158, viewed=56, view=107),
    "repair": Need(0.69, texel=200, viewed=55, view=121.5, crop=2000),
    "asset": Need(0.75, texel=225, viewed=60, view=114),
    "report": Need(0.71, texel=163, viewed=60, view=114, drawn=72, frame=24),
}
# With large arrays in files: what has to be in memory all the same.
TILED = {
    "mesh": Need(0.39, face=5000),
    "texels": Need(0.42, texel=30),
    "views": Need(0.60, texel=10, view=4),
    "surface": Need(0.60, texel=10, view=4, sample=1200),
    "bake": Need(0.95, texel=20, view=4),
    "stylized": Need(0.65, texel=10, view=4),
    "fit": Need(0.75, texel=30, view=4, crop=2000),
    "masks": Need(0.70, texel=35, view=4),
    "repair": Need(0.75, texel=35, view=4, crop=2000),
    "asset": Need(0.70, texel=30, view=4),
    "report": Need(0.65, texel=5, view=4, drawn=78, frame=24),
}
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
KEEPING = ("recover", "measure", "asset", "scene", "report")
# Shares of a picture that show the object, of the atlas that is covered, and of that what one picture sees.
SHOWN, COVERED, SEEN = 0.3, 0.55, 0.35
SAMPLE = 32  # bytes that are kept of a sample of a picture
# Pages come in during a call into the renderer, faster than they are let go: a budget must be that much larger.
MARGIN = 1.03


class Counts(NamedTuple):
    """What the memory of a job hangs on, by the names of Need."""

    texel: int
    view: int
    crop: int = 0
    sample: int = 0
    face: int = 0
    viewed: int = 0
    drawn: int = 0
    frame: int = 0
    look: int = 0
    picture: int = 0
    photograph: int = 0


def view_pixels(settings: Settings) -> int:
    """Pixels of all views together; of a rig made for the mesh, which is not known yet, or of a file: of 16 at most."""
    rig = settings.rig
    views = {"paper": 16, "turntable": rig.views, "nbv": min(16, rig.most_views)}.get(rig.kind, 16)
    return views * rig.resolution**2


def counts(settings: Settings, faces: int = 0, sets: int = 1) -> Counts:
    """The counts of `stylize` for a mesh of so many faces and texture sets."""
    crop = 0 if settings.fit.refine == "off" else settings.fit.crops * settings.fit.crop_size**2
    return Counts(
        sets * settings.atlas.size**2,
        view_pixels(settings),
        crop,
        settings.surface.samples,
        faces,
        sets * as_drawn(settings.atlas.size, settings.rig.resolution),
        *shown(settings, sets),
    )


def shown(settings: Any, sets: int) -> tuple[int, int]:
    """Texels of the textures as the report's close-ups draw them, and pixels of the turntable's frames."""
    turn = settings.report
    return sets * as_drawn(settings.atlas.size, 2 * turn.resolution), turn.frames * turn.resolution**2


def as_drawn(size: int, pixels: int) -> int:
    """Texels of a texture of `size` a side that are drawn in pictures of so many pixels a side."""
    return (size // coarser(size, pixels)) ** 2


def peaks(needs: Mapping[str, Need], count: Counts) -> dict[str, float]:
    """GB of every stage."""
    return {
        stage: need.program + sum(getattr(need, each) * getattr(count, each) for each in Counts._fields) / 1e9
        for stage, need in needs.items()
    }


def memory_gb(settings: Settings, faces: int = 0, sets: int = 1) -> float:
    """Peak memory of `stylize`, GB, with every array in memory, or, where its budget asks for that, in files: then what
    is in memory is let go near the budget, and the peak lies below it."""
    count = counts(settings, faces, sets)
    whole, least = (max(peaks(needs, count).values()) for needs in (PLAIN, TILED))
    if settings.memory and whole > settings.memory:
        whole = max(least, settings.memory)
    return round(whole, 2)


def material_counts(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1) -> Counts:
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
        picture=max(looked, default=0), photograph=max(pixels, default=0),
    )  # fmt: skip


def looked_at(settings: Any, pixels: Sequence[int]) -> list[int]:
    """Pixels that are left of pictures of so many after blocks of them were averaged (stages/recover_check.py).

    By the setting; else for an object that fills SHOWN of each picture, with COVERED of its atlas, SEEN by one, turned
    away from the camera such that half of its area is left.
    """
    texels, average = 0.5 * COVERED * SEEN * settings.atlas.size**2, settings.references.average
    return [n // max(1, average or int((SHOWN * n / texels) ** 0.5 / 2)) ** 2 for n in pixels]


def material_gb(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1) -> float:
    """Peak memory of a fit to pictures of so many pixels each, GB."""
    count = material_counts(settings, pixels, faces, sets)
    found = peaks(MATERIAL, count)
    samples = max(settings.recover.subsamples, joint_steps(settings.recover) and settings.recover.joint_subsamples)
    held = min(settings.recover.memory, SAMPLE * count.view * samples / 1e9)
    held += between_gb(settings, pixels)
    found |= {stage: found[stage] + held for stage in KEEPING}
    return round(max(found.values()), 2)


def between_gb(settings: Any, pixels: Sequence[int]) -> float:
    """GB of the light between surfaces that is kept of every picture: three floats a pixel of the estimate."""
    from mistyle.render.indirect import MOST

    if settings.recover.solver == "pictures" or not settings.recover.bounces:
        return 0.0
    return 12 * sum(min(n, MOST**2) for n in looked_at(settings, pixels)) / 1e9


def tiles(settings: Settings, faces: int = 0, sets: int = 1) -> bool:
    """Whether the job's large arrays must lie in files for its budget. UsageError where even that is not enough."""
    if not settings.memory:
        return False
    count = counts(settings, faces, sets)
    if max(peaks(PLAIN, count).values()) <= settings.memory:
        return False
    if not memory.possible():
        raise UsageError(
            f"--memory {settings.memory:g}G: the job needs {memory_gb(_free(settings), faces, sets)} GB, and less only "
            "on Linux, where its large arrays can lie in files; give it more, or leave --memory out"
        )
    needed = {stage: MARGIN * gb for stage, gb in peaks(TILED, count).items()}
    worst = max(needed, key=lambda stage: needed[stage])
    if needed[worst] <= settings.memory:
        return True

    def least(smaller: Settings) -> float:
        return MARGIN * max(peaks(TILED, counts(smaller, faces, sets)).values())

    raise UsageError(
        f"--memory {settings.memory:g}G: the job needs {needed[worst]:.2f} GB in its stage '{worst}', even with its "
        f"large arrays in files; give it --memory {rounded_up(needed[worst])}G or more, or {_smaller(settings, least)}"
    )


def _free(settings: Settings) -> Settings:
    return settings.model_copy(update={"memory": 0})


def check_material(settings: Any, pixels: Sequence[int], faces: int = 0, sets: int = 1) -> Any:
    """The settings of a fit to pictures with `recover.memory` cut to what its budget leaves; UsageError for none."""
    if not settings.memory:
        return settings

    def least(chosen: Any) -> float:
        return material_gb(with_setting(chosen, "recover.memory", 1e-9), pixels, faces, sets)

    left = settings.memory - max(peaks(MATERIAL, material_counts(settings, pixels, faces, sets)).values())
    left -= between_gb(settings, pixels)
    if least(settings) > settings.memory or left <= 0:
        needed = least(settings)
        raise UsageError(
            f"--memory {settings.memory:g}G: the fit needs {needed:.2f} GB even if it keeps nothing of the pictures' "
            f"samples; give it --memory {rounded_up(needed)}G or more, or {_smaller(settings, least)}"
        )
    return with_setting(settings, "recover.memory", min(settings.recover.memory, left))


def rounded_up(gb: float) -> float:
    """To the next tenth of a GB."""
    return int(gb * 10 + 0.999) / 10


def _smaller(settings: Any, least: Callable[[Any], float]) -> str:
    """The one setting of which half saves most, and what is needed then."""
    halves = {"atlas.size": 16, "surface.samples": 1000, "fit.crop_size": 32, "recover.subsamples": 1}
    there = {key: low for key, low in halves.items() if hasattr(settings, key.split(".")[0])}
    tried = {
        key: (half := max(_value(settings, key) // 2, low), least(with_setting(settings, key, half)))
        for key, low in there.items()
    }
    best = min(tried, key=lambda key: tried[key][1])
    return f"--set {best}={tried[best][0]}, which needs {rounded_up(tried[best][1])} GB"


def _value(settings: Any, key: str) -> int:
    group, name = key.split(".")
    return getattr(getattr(settings, group), name)


def with_setting(settings: Any, key: str, value: float) -> Any:
    """The settings with one, named group.name, changed."""
    group, name = key.split(".")
    return settings.model_copy(update={group: getattr(settings, group).model_copy(update={name: value})})


@contextmanager
def kept(settings: Settings, work: Path) -> Iterator[Callable[[int, int], None]]:
    """Inside, the job keeps the budget of its settings; refused beforehand where it cannot. Yields a function that
    looks again, given the faces and texture sets of the mesh, once they are known."""
    with ExitStack() as stack:

        def look(faces: int, sets: int) -> None:
            if tiles(settings, faces, sets) and not memory.tight():
                stack.enter_context(memory.within(settings.memory * 1e9, work))

        look(0, 1)
        yield look
