"""How much memory a job will need, stage by stage, from counts alone; and whether it keeps the budget it was given.

A stage's peak is what the program itself takes, plus bytes of each count of the job: see `Need`. The needs and counts
of a verb stand in `pipeline/budget.py` and `pipeline/budget.py`. They hold on the processor, with two threads and the
embedded filter bank: VGG-19 and the stylizers that need models count their own (stylization/pipeline/generative.py).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from mistyle.core.asset import Asset
from mistyle.core.errors import UsageError
from mistyle.core.maps import coarser
from mistyle.process import memory


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


# Pages come in during a call into the renderer, faster than they are let go: a budget must be that much larger.
MARGIN = 1.03


# Settings whose half saves memory, and their least values.
HALVES = {"atlas.size": 16, "surface.samples": 1000, "fit.crop_size": 32, "recover.subsamples": 1}
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


def within_gb(settings: Any, count: Counts, plain: Mapping[str, Need], tiled: Mapping[str, Need]) -> float:
    """Peak memory, GB, with every array in memory, or, where the budget asks for that, in files: then what is in memory
    is let go near the budget, and the peak lies below it."""
    whole, least = (max(peaks(needs, count).values()) for needs in (plain, tiled))
    return round(min(whole, max(least, allowed(settings).gb)), 2)


def must_tile(
    settings: Any,
    count: Callable[[Any], Counts],
    plain: Mapping[str, Need],
    tiled: Mapping[str, Need],
    keys: Sequence[str],
) -> bool:
    """Whether a job's large arrays must lie in files for its budget; `count` gives its counts for any settings.

    Raises UsageError where even that is not enough, with the need, the limit, and which of the settings `keys` helps. A
    budget that nobody gave leaves out the stage 'mesh': what reading takes is bounded in io/sandbox/bounds.py, and its
    need here is that of unwrapping.
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
        f"files; give it --memory {rounded_up(needed[worst])}G{more}, or {smaller_setting(settings, least, keys)}"
    )


def rounded_up(gb: float) -> float:
    """To the next tenth of a GB."""
    return int(gb * 10 + 0.999) / 10


def smaller_setting(settings: Any, least: Callable[[Any], float], keys: Sequence[str]) -> str:
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
    settings: Any,
    work: Path,
    count: Callable[..., Counts],
    plain: Mapping[str, Need],
    tiled: Mapping[str, Need],
    keys: Sequence[str],
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
