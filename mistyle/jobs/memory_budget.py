"""Memory model of a job: the peak of each stage from counts alone, and the check against the budget.

A stage's peak is the program's own memory plus bytes per count of the job: see `Need`. The needs and counts of a verb
lie in the `budget.py` of its pipeline. They hold on the CPU, with two threads and the embedded filter bank. VGG-19 and
the stylizers that need models have models of their own (stylization/pipeline/generative.py).
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
    """A stage's peak: the program's own GB, then bytes per unit of each count."""

    program: float
    texel: float = 0
    view: float = 0  # pixel of a view
    crop: float = 0  # pixel of a crop
    sample: float = 0  # sample of the surface
    face: float = 0
    viewed: float = 0  # texel of the textures at the size of the views, which the renderer holds
    drawn: float = 0  # texel of the textures at the size of the report's close-ups
    frame: float = 0  # pixel of the turntable's frames
    look: float = 0  # texel times picture, where texels are solved one by one
    picture: float = 0  # pixel of the largest picture at the size of the fit
    photograph: float = 0  # pixel of the largest picture as it was taken
    lane: float = 0  # sample of a pass of the largest picture
    own: float = 0  # byte of the file's own maps
    packed: float = 0  # texel whose PNG file stays in memory
    one: float = 0  # texel of one texture set, for work on one set at a time
    vgg: float = 0  # pixel of the crops of a step of the finish


# A call into the renderer touches pages faster than they are released: the budget must exceed the need by this factor.
MARGIN = 1.03


# Settings that save memory when halved, and their least values.
HALVES = {"atlas.size": 16, "surface.samples": 1000, "fit.crop_size": 32, "recover.subsamples": 1}
HALVES |= {"rig.resolution": 16, "draw.spp": 1}
SHARE = 0.9  # of the machine's memory, without a budget: the system needs the rest


class Allowed(NamedTuple):
    """The GB that a job may take, and the source of the limit."""

    gb: float
    who: str
    given: bool


def allowed(settings: Any) -> Allowed:
    """The value of `--memory`, else SHARE of the machine's and its control group's memory; infinite if unknown.

    The second kind of budget refuses a job or puts its arrays into files; it changes no setting and no result.
    """
    if settings.memory:
        return Allowed(settings.memory, f"--memory {settings.memory:g}G", True)
    most = memory.limit()
    if most is None:
        return Allowed(float("inf"), "", False)
    gb = SHARE * most / 1e9
    return Allowed(gb, f"this machine has {most / 1e9:.1f} GB of memory, {gb:.1f} GB of them for a job", False)


class Counts(NamedTuple):
    """The counts that a job's memory depends on, by the names of Need."""

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
    """Texels of a texture of `size` a side, as drawn in pictures of `pixels` a side."""
    return (size // coarser(size, pixels)) ** 2


def peaks(needs: Mapping[str, Need], count: Counts) -> dict[str, float]:
    """GB of every stage; the finish counts only where the job has one."""
    return {
        stage: need.program + sum(getattr(need, each) * getattr(count, each) for each in Counts._fields) / 1e9
        for stage, need in needs.items()
        if count.vgg or not need.vgg
    }


def within_gb(settings: Any, count: Counts, plain: Mapping[str, Need], tiled: Mapping[str, Need]) -> float:
    """Peak memory, GB. Where the budget requires it, arrays lie in files: their pages are released near the budget, and
    the peak lies below it."""
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

    Raises UsageError where even files do not suffice, with the need, the limit, and the most useful of the settings
    `keys`. Without an explicit budget the stage 'mesh' is left out: io/sandbox/bounds.py bounds reading, and the need
    of that stage is the need of unwrapping.
    """
    budget = allowed(settings)
    if not budget.given:
        plain, tiled = ({k: need for k, need in needs.items() if k != "mesh"} for needs in (plain, tiled))
    whole = max(peaks(plain, count(settings)).values())
    if whole <= budget.gb:
        return False
    more = " or more" if budget.given else ", if the machine has that much"
    if not memory.possible():
        raise UsageError(
            f"{budget.who}: the job needs {whole:.2f} GB. Only Linux needs less, with large arrays in files; "
            f"give it --memory {rounded_up(whole)}G{more}"
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
    """`gb` rounded up to a tenth of a GB."""
    return int(gb * 10 + 0.999) / 10


def smaller_setting(settings: Any, least: Callable[[Any], float], keys: Sequence[str]) -> str:
    """The setting that saves most when halved, and the GB needed then."""
    available = [key for key in keys if hasattr(settings, key.split(".")[0])]
    candidates = {
        key: (half := max(_value(settings, key) // 2, HALVES[key]), least(with_setting(settings, key, half)))
        for key in available
    }
    best = min(candidates, key=lambda key: candidates[key][1])
    return f"--set {best}={candidates[best][0]}, which needs {rounded_up(candidates[best][1])} GB"


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
    """Enforce the memory budget of a job, with large arrays in files of `work` where necessary. UsageError where the
    budget cannot hold. Yields a function that checks again with the mesh's faces, texture sets and bytes of own maps.
    `count(settings, faces, sets, own)` and the needs are those of the verb."""
    with ExitStack() as stack:

        def look(faces: int, sets: int, own: int) -> None:
            tile = must_tile(settings, lambda s: count(s, faces, sets, own), plain, tiled, keys)
            if tile and not memory.tight():
                stack.enter_context(memory.within(allowed(settings).gb * 1e9, work))

        look(0, 1, 0)
        yield look


def size_of(asset: Asset) -> tuple[int, int, int]:
    """Faces, texture sets and bytes of own maps of an asset."""
    maps = (m for one in asset.materials for m in (one.albedo, one.normal, one.roughness, one.metallic))
    return len(asset.mesh.faces), len(asset.mesh.parts), sum(m.nbytes for m in maps if m is not None)
