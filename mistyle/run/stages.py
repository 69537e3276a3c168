"""The stages of a run and how each is kept: under a key made of everything it depends on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from mistyle.core.errors import UsageError
from mistyle.core.paths import PACKAGE
from mistyle.files.records import load_record, save_record
from mistyle.files.store import Keeper, digest
from mistyle.run.progress import Progress, Report
from mistyle.run.settings import Settings, thread_count

STAGES = {
    "mesh": "read the mesh",
    "texels": "lay out the texture",
    "views": "render the views",
    "surface": "paint the surface",
    "bake": "bake the texture",
    "stylized": "draw the stylized views",
    "fit": "fit normal, roughness and albedo",
    "repair": "repair what the fit left open",
    "asset": "write the asset",
    "report": "write the report",
}
# Those of `mistyle fit`.
MATERIAL_STAGES = {
    "mesh": "read the mesh",
    "texels": "lay out the texture",
    "cameras": "place the cameras",
    "light": "find the light",
    "recover": "fit the material",
    "measure": "measure the fit",
    "asset": "write the asset",
    "scene": "write the Mitsuba scene",
    "report": "write the report",
}
# These stand in the run folder itself, for people; the others in work/.
VISIBLE = ("views", "stylized", "asset", "scene", "report")


@dataclass(frozen=True)
class Job:
    """What to do and where: one mesh, one style picture, one run folder."""

    mesh: Path
    style: Path
    out: Path
    settings: Settings
    name: str
    redo_from: str | None = None


@runtime_checkable
class Kept(Protocol):
    """What a run must know of any kind of job: where it works, and what its keys and stages hang on."""

    @property
    def out(self) -> Path: ...

    @property
    def settings(self) -> Any: ...

    @property
    def redo_from(self) -> str | None: ...


Work = TypeVar("Work", bound=Kept)


@cache
def program() -> str:
    """A hash of mistyle itself: all of its files that could change a result, as they were when first asked for."""
    files = sorted(p for p in PACKAGE.rglob("*") if p.suffix in (".py", ".j2", ".css", ".js"))
    return digest({str(p.relative_to(PACKAGE)): p.read_bytes() for p in files})


class Run(Generic[Work]):
    """Keeps the stages of one run folder; a class because it holds the folder's locks until it is closed."""

    def __init__(self, job: Work, progress: Progress, stages: Mapping[str, str] = STAGES) -> None:
        if job.redo_from is not None and job.redo_from not in stages:
            raise UsageError(f"--from {job.redo_from}: there is no such stage; choose one of {', '.join(stages)}")
        self.job, self.progress, self.stages = job, progress, stages
        self.redoing = False
        self.keys: dict[str, str] = {}
        # A changed program or thread count may change bytes: both belong to every key.
        self.base = digest([program(), thread_count(job.settings), job.settings.variant])
        self.visible = Keeper(job.out)
        self.hidden = Keeper(job.out / "work")

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *_: object) -> None:
        self.visible.close()
        self.hidden.close()
        for folder in (self.job.out / "work", self.job.out):
            # A job that was refused before its first stage leaves no empty folders behind.
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def stage(self, name: str, after: Sequence[str], inputs: Any, write: Callable[[Path, Report], object]) -> Path:
        """The folder of stage `name`, taken over or made; it depends on `inputs` and on the stages `after`."""
        key = self.keys[name] = digest([self.base, name, inputs, [self.keys[a] for a in after]])
        keeper = self.visible if name in VISIBLE else self.hidden
        self.redoing = self.redoing or name == self.job.redo_from
        found = None if self.redoing else keeper.get(name, key)
        if found is not None:
            self.progress.skip(name, self.stages[name])
            return found

        def fill(folder: Path) -> None:
            write(folder, report)

        with self.progress.stage(name, self.stages[name]) as report:
            return keeper.put(name, key, fill)

    def record(self, name: str, after: Sequence[str], inputs: Any, make: Callable[[Report], Any]) -> Any:
        """Like `stage`, for a stage whose result is a record."""
        made: list[Any] = []

        def write(folder: Path, report: Report) -> None:
            made.append(make(report))
            save_record(folder / "record", made[0])

        folder = self.stage(name, after, inputs, write)
        return made[0] if made else load_record(folder / "record")
