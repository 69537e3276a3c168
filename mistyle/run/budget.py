"""How much memory a job will need, stage by stage, from counts alone; and whether it keeps the budget it was given.

A stage's peak is what the program itself takes, plus bytes a texel of all texture sets, a pixel of all views together,
a pixel of a step's crops, a surface sample, a face, a texel of the textures as they are drawn, and a pixel of the
turntable's frames. Those of PLAIN were solved from the peaks that `run.json` notes for every stage (`peaks_gb`) of five
jobs: `draft_spot`, `views_64` and `atlas_4096` of `python -m benchmarks.memory --stages`, and the draft on spot with an
atlas of 3072², four views and 20,000 samples, and of 2048². What only one texture set takes at a time (`one`) comes
from a job with 20 sets of 512². Those of TILED come from stages run alone at 1024² and 2048², the report's from 2048²
and 4096²; they count all sets alike. They hold on the processor, with two threads and the embedded filter bank: VGG-19
and the stylizers that need models count their own (run/generative.py). The stage `finish` was read off one draft of
spot (two crops of 256²), and its program counts the features of a painting of the largest size.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from mistyle.core import memory
from mistyle.core.asset import Asset
from mistyle.core.errors import UsageError
from mistyle.core.maps import coarser
from mistyle.run.settings import Settings
from mistyle.stages.recover_settings import joint_steps


class Need(NamedTuple):
    """A stage's peak: GB of the program, then bytes a texel, view pixel, crop pixel, surface sample, face, texel of the
    textures as the views draw them (kept by the renderer) and as the report's close-ups do, pixel of the turntable's
    frames, texel times picture where texels are solved one by one, pixel of the largest picture, as the fit looks at it
    and as it was taken, and sample of a pass of it; byte of the file's own maps; texel whose PNG file is kept;
    texel of one texture set, for what only one set takes at a time; and pixel of a step's crops of the finish."""

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
    lane: float = 0
    own: float = 0
    packed: float = 0
    one: float = 0
    vgg: float = 0


# With every array in memory.
PLAIN = {
    "mesh": Need(0.38, face=5000),
    "texels": Need(0.38, texel=71),
    "views": Need(0.46, texel=39, one=28, viewed=64, view=46.5),
    "surface": Need(0.49, texel=31, one=36, viewed=68, view=45.5, sample=1200),
    "bake": Need(0.59, texel=20, one=82, viewed=82, view=58.5),
    "finish": Need(1.75, texel=100, one=98, vgg=4200),
    "stylized": Need(0.53, texel=56, one=39, viewed=64, view=63.5),
    "fit": Need(0.75, texel=86, one=98, viewed=51, view=107, crop=2000),
    "masks": Need(0.77, texel=49, one=109, viewed=56, view=107),
    "repair": Need(0.69, texel=40, one=160, viewed=55, view=121.5, crop=2000),
    "asset": Need(0.75, texel=53, one=172, viewed=60, view=114),
    "report": Need(0.71, texel=39, one=124, viewed=60, view=114, drawn=72, frame=24),
}
PLAIN = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in PLAIN.items()}
# With large arrays in files: what has to be in memory all the same.
TILED = {
    "mesh": Need(0.39, face=5000),
    "texels": Need(0.42, texel=30),
    "views": Need(0.60, texel=10, view=4),
    "surface": Need(0.60, texel=10, view=4, sample=1200),
    "bake": Need(0.95, texel=20, view=4),
    "finish": Need(1.75, texel=100, vgg=4200),
    "stylized": Need(0.65, texel=10, view=4),
    "fit": Need(0.75, texel=30, view=4, crop=2000),
    "masks": Need(0.70, texel=35, view=4),
    "repair": Need(0.75, texel=35, view=4, crop=2000),
    "asset": Need(0.70, texel=30, view=4),
    "report": Need(0.65, texel=5, view=4, drawn=78, frame=24),
}
TILED = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in TILED.items()}
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
# Of `render` and `bake`, which have one texture set at a time or none: from runs with one material and with twenty,
# with and without textures, at atlases of 512² to 2048² and views of 128² to 1024².
RENDER = {
    "mesh": Need(0.38, face=5000, own=2),
    "views": Need(0.44, view=46.5, lane=25, own=3),
}
RENDER_TILED = {
    "mesh": Need(0.38, face=5000, own=2),
    "views": Need(0.45, view=6, lane=25, own=3),
}
BAKE = {
    "mesh": Need(0.38, face=5000, own=2),
    "asset": Need(0.50, texel=150, view=58.5, own=1, packed=12),
}
BAKE_TILED = {
    "mesh": Need(0.38, face=5000, own=2),
    "asset": Need(0.60, texel=60, view=10, own=1, packed=12),
}
MATERIAL = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in MATERIAL.items()}
KEEPING = ("recover", "measure", "asset", "scene", "report")
# Shares of a picture that show the object, of the atlas that is covered, and of that what one picture sees.
SHOWN, COVERED, SEEN = 0.3, 0.55, 0.35
SAMPLE = 32  # bytes that are kept of a sample of a picture
# Pages come in during a call into the renderer, faster than they are let go: a budget must be that much larger.
MARGIN = 1.03


# Settings whose half saves memory, and their least values; those of a job with an atlas.
HALVES = {"atlas.size": 16, "surface.samples": 1000, "fit.crop_size": 32, "recover.subsamples": 1}
STYLED = tuple(HALVES)
DRAWN = ("rig.resolution", "draw.spp")
BAKED = ("atlas.size",)
HALVES |= {"rig.resolution": 16, "draw.spp": 1}
SHARE = 0.9  # of the machine's memory, where no budget is given: the rest is the system's


class Allowed(NamedTuple):
    """How many GB a job may take, and who says so."""

    gb: float
    who: str
    given: bool


def allowed(settings: Any) -> Allowed:
    """What `--memory` gives, else SHARE of what the machine and its control group have; no bound where nothing tells.

    The second kind of budget refuses a job or puts its arrays into files; it changes no setting and no result.
    """
    if settings.memory:
        return Allowed(settings.memory, f"--memory {settings.memory:g}G", True)
    most = memory.limit()
    if most is None:
        return Allowed(float("inf"), "", False)
    gb = SHARE * most / 1e9
    return Allowed(gb, f"there are {most / 1e9:.1f} GB of memory here, {gb:.1f} GB of them for a job", False)


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
    lane: int = 0
    own: int = 0
    packed: int = 0
    one: int = 0
    vgg: int = 0


def view_pixels(settings: Settings) -> int:
    """Pixels of all views together; of a rig made for the mesh, which is not known yet, or of a file: of 16 at most."""
    rig = settings.rig
    views = {"paper": 16, "turntable": rig.views, "nbv": min(16, rig.most_views)}.get(rig.kind, 16)
    return views * rig.resolution**2


def counts(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of `stylize` for a mesh of so many faces, texture sets and bytes of own maps."""
    crop = 0 if settings.refined == "off" else settings.fit.crops * settings.fit.crop_size**2
    return Counts(
        sets * settings.atlas.size**2,
        view_pixels(settings),
        crop,
        settings.surface.samples,
        faces,
        sets * as_drawn(settings.atlas.size, settings.rig.resolution),
        *shown(settings, sets),
        own=own,
        one=settings.atlas.size**2,
        vgg=0 if settings.finish.method == "off" else settings.finish.crops * settings.finish.crop_size**2,
    )


def rig_pixels(settings: Settings) -> list[int]:
    """Pixels of each view of a rig, of which the file is read where it is one."""
    if settings.rig.kind != "file" or settings.rig.file is None:
        side = settings.rig.resolution**2
        return [side] * (view_pixels(settings) // side)
    from mistyle.files.cameras import read_cameras

    return [camera.size[0] * camera.size[1] for camera in read_cameras(settings.rig.file)]


def render_counts(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of `render`, which draws from the file's own maps however many sets they are."""
    from mistyle.render.scene import passes

    pictures = rig_pixels(settings)
    lanes = max(pictures, default=0) * passes(settings.draw.samples())[1]
    return Counts(0, sum(pictures), face=faces, own=own, lane=lanes)


def bake_counts(pictures: Sequence[int], settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of `bake` from pictures of so many pixels: it has one texture set at a time, and the PNG files of all
    of them."""
    texels = settings.atlas.size**2
    return Counts(texels, sum(pictures), face=faces, own=own, packed=sets * texels)


def shown(settings: Any, sets: int) -> tuple[int, int]:
    """Texels of the textures as the report's close-ups draw them, and pixels of the turntable's frames."""
    turn = settings.report
    return sets * as_drawn(settings.atlas.size, 2 * turn.resolution), turn.frames * turn.resolution**2


def as_drawn(size: int, pixels: int) -> int:
    """Texels of a texture of `size` a side that are drawn in pictures of so many pixels a side."""
    return (size // coarser(size, pixels)) ** 2


def peaks(needs: Mapping[str, Need], count: Counts) -> dict[str, float]:
    """GB of every stage; of the finish only where there is one."""
    return {
        stage: need.program + sum(getattr(need, each) * getattr(count, each) for each in Counts._fields) / 1e9
        for stage, need in needs.items()
        if count.vgg or not need.vgg
    }


def memory_gb(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> float:
    """Peak memory of `stylize`, GB; see `within_gb`."""
    return within_gb(settings, counts(settings, faces, sets, own), PLAIN, TILED)


def within_gb(settings: Any, count: Counts, plain: Mapping[str, Need], tiled: Mapping[str, Need]) -> float:
    """Peak memory, GB, with every array in memory, or, where the budget asks for that, in files: then what is in memory
    is let go near the budget, and the peak lies below it."""
    whole, least = (max(peaks(needs, count).values()) for needs in (plain, tiled))
    return round(min(whole, max(least, allowed(settings).gb)), 2)


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
    """Pixels that are left of pictures of so many after blocks of them were averaged (stages/recover_check.py).

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
    from mistyle.render.indirect import MOST

    if settings.recover.solver == "pictures" or not settings.recover.bounces:
        return 0.0
    return 12 * sum(min(n, MOST**2) for n in looked_at(settings, pixels)) / 1e9


def tiles(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> bool:
    """Whether the large arrays of `stylize` must lie in files for its budget. UsageError where that is not enough."""
    return must_tile(settings, lambda s: counts(s, faces, sets, own), PLAIN, TILED)


def must_tile(
    settings: Any,
    count: Callable[[Any], Counts],
    plain: Mapping[str, Need],
    tiled: Mapping[str, Need],
    keys: Sequence[str] = STYLED,
) -> bool:
    """Whether a job's large arrays must lie in files for its budget; `count` gives its counts for any settings.

    Raises UsageError where even that is not enough, with the need, the limit, and which of the settings `keys` helps. A
    budget that nobody gave leaves out the stage 'mesh': what reading takes is bounded in files/bounds.py, and its need
    here is that of unwrapping.
    """
    budget = allowed(settings)
    if not budget.given:
        plain, tiled = ({k: need for k, need in needs.items() if k != "mesh"} for needs in (plain, tiled))
    whole = max(peaks(plain, count(settings)).values())
    if whole <= budget.gb:
        return False
    more = " or more" if budget.given else ", if there is as much all the same"
    if not memory.possible():
        raise UsageError(
            f"{budget.who}: the job needs {whole:.2f} GB, and less only on Linux, where its large arrays can lie in "
            f"files; give it --memory {rounded_up(whole)}G{more}"
        )
    needed = {stage: MARGIN * gb for stage, gb in peaks(tiled, count(settings)).items()}
    worst = max(needed, key=lambda stage: needed[stage])
    if needed[worst] <= budget.gb:
        return True

    def least(smaller: Any) -> float:
        return MARGIN * max(peaks(tiled, count(smaller)).values())

    raise UsageError(
        f"{budget.who}: the job needs {needed[worst]:.2f} GB in its stage '{worst}', even with its large arrays in "
        f"files; give it --memory {rounded_up(needed[worst])}G{more}, or {_smaller(settings, least, keys)}"
    )


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
            f"it keeps fewer of the pictures' samples, or {_smaller(settings, least, STYLED)}"
        )
    if needed > budget.gb or left <= 0:
        raise UsageError(
            f"{budget.who}: the fit needs {needed:.2f} GB even if it keeps nothing of the pictures' "
            f"samples; give it --memory {rounded_up(needed)}G or more, or {_smaller(settings, least, STYLED)}"
        )
    return with_setting(settings, "recover.memory", min(settings.recover.memory, left)) if budget.given else settings


def rounded_up(gb: float) -> float:
    """To the next tenth of a GB."""
    return int(gb * 10 + 0.999) / 10


def _smaller(settings: Any, least: Callable[[Any], float], keys: Sequence[str]) -> str:
    """The one setting of which half saves most, and what is needed then."""
    there = [key for key in keys if hasattr(settings, key.split(".")[0])]
    tried = {
        key: (half := max(_value(settings, key) // 2, HALVES[key]), least(with_setting(settings, key, half)))
        for key in there
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


Look = Callable[[int, int, int], None]


@contextmanager
def kept(
    settings: Settings,
    work: Path,
    count: Callable[..., Counts] = counts,
    plain: Mapping[str, Need] = PLAIN,
    tiled: Mapping[str, Need] = TILED,
    keys: Sequence[str] = STYLED,
) -> Iterator[Look]:
    """Inside, a job keeps its budget, with large arrays in files of `work` where they must; refused beforehand where it
    cannot. Yields a function that looks again, given the mesh's faces, texture sets and bytes of own maps, once they
    are known. `count(settings, faces, sets, own)` and the needs are those of the verb."""
    with ExitStack() as stack:

        def look(faces: int, sets: int, own: int) -> None:
            tile = must_tile(settings, lambda s: count(s, faces, sets, own), plain, tiled, keys)
            if tile and not memory.tight():
                stack.enter_context(memory.within(allowed(settings).gb * 1e9, work))

        look(0, 1, 0)
        yield look


def size_of(asset: Asset) -> tuple[int, int, int]:
    """Faces, texture sets and bytes of own maps of what was read."""
    maps = (m for one in asset.materials for m in (one.albedo, one.normal, one.roughness, one.metallic))
    return len(asset.mesh.faces), len(asset.mesh.parts), sum(m.nbytes for m in maps if m is not None)
