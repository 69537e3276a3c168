"""The stage cache of a run folder: each stage is stored under a digest of everything that it depends on."""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from mistyle.core.errors import UsageError
from mistyle.core.paths import PACKAGE
from mistyle.io.store import atomic, output
from mistyle.io.store.atomic import digest
from mistyle.io.store.keeper import Keeper
from mistyle.io.store.records import load_record, save_record
from mistyle.jobs import edits
from mistyle.jobs.progress import Progress, StageReport
from mistyle.jobs.settings import thread_count
from mistyle.process import memory, stopping

NOTHING: Mapping[str, Any] = MappingProxyType({})
# These lie in the run folder itself, for people; the others in work/.
VISIBLE = ("views", "stylized", "masks", "asset", "scene", "report", "preview")


@runtime_checkable
class StagedJob(Protocol):
    """The part of any job that a run reads: its folder, and the settings that its keys and stages depend on."""

    @property
    def out(self) -> Path: ...

    @property
    def settings(self) -> Any: ...

    @property
    def redo_from(self) -> str | None: ...

    @property
    def overwrite(self) -> bool: ...


JobT = TypeVar("JobT", bound=StagedJob)


@cache
def program() -> str:
    """A hash of mistyle itself: all of its files that could change a result, read once per process."""
    files = sorted(p for p in PACKAGE.rglob("*") if p.suffix in (".py", ".j2", ".css", ".js"))
    return digest({str(p.relative_to(PACKAGE)): p.read_bytes() for p in files})


def claim_run(job: StagedJob, stages: Iterable[str], inputs: Sequence[Path]) -> None:
    """UsageError where a run of `stages` would overwrite an input, or a file in the job's folder that is not ours."""
    deliver, folders = job.settings.deliver, [name for name in VISIBLE if name in stages]
    targets = [f"delivered/{target}" for target in deliver.chosen_targets] if deliver.wanted else []
    output.claim(job.out, ["run.json"], [*folders, "work", *targets], inputs, aside=True, overwrite=job.overwrite)


class Run(Generic[JobT]):
    """Keeps the stages of one run folder; a class because it holds the folder's locks until it is closed."""

    def __init__(self, job: JobT, progress: Progress, stages: Mapping[str, str]) -> None:
        if job.redo_from is not None and job.redo_from not in stages:
            raise UsageError(f"--from {job.redo_from}: there is no such stage; choose one of {', '.join(stages)}")
        self.job, self.progress, self.stages = job, progress, stages
        self.redoing = False
        self.keys: dict[str, str] = {}
        # Stage -> edited file -> sha256; `changed` holds the edits that no earlier run took up.
        self.edited: dict[str, dict[str, str]] = {}
        self.changed: dict[str, dict[str, str]] = {}
        self.plain: dict[str, str] = {}
        # A changed program or thread count may change bytes: both belong to every key.
        self.base = digest([program(), thread_count(job.settings), job.settings.variant])
        self.visible = Keeper(job.out, progress.note, overwrite=job.overwrite)
        try:
            output.keep_folder(job.out, "work")
            self.hidden = Keeper(job.out / "work", progress.note, overwrite=job.overwrite)
        except BaseException:
            self.visible.close()
            raise

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *_: object) -> None:
        self.visible.close()
        self.hidden.close()
        # A job that was refused before its first stage leaves no empty folders behind.
        with contextlib.suppress(OSError):  # not empty; or where a disk is mounted
            (self.job.out / "work").rmdir()
            output.forget_folder(self.job.out, "work")
            self.job.out.rmdir()

    def stage(
        self,
        name: str,
        after: Sequence[str],
        inputs: Any,
        write: Callable[[Path, StageReport], object],
        about: Mapping[str, Any] = NOTHING,
    ) -> Path:
        """The folder of stage `name`, reused or computed; it depends on `inputs` and on the stages `after`.

        `about` holds further entries of its marker."""
        stopping.check()
        key = self.keys[name] = digest([self.base, name, inputs, [self.keys[a] for a in after]])
        keeper = self.visible if name in VISIBLE else self.hidden
        self.redoing = self.redoing or name == self.job.redo_from
        reused = None if self.redoing else keeper.get(name, key, lambda file: edits.editable(name, file))
        if reused is not None:
            self.progress.skip(name, self.stages[name])
            self.progress.note(*keeper.notes(name))
            self._add_edits_to_key(keeper, name)
            return reused
        self._set_edits_aside(keeper, name)

        def fill(folder: Path) -> None:
            write(folder, report)

        before = len(self.progress.notes)
        with self.progress.stage(name, self.stages[name]) as report:
            return keeper.put(name, key, fill, notes=lambda: self.progress.notes[before:], about=about)

    def skip(self, names: Sequence[str], after: Sequence[str]) -> None:
        """Leave out stages that change nothing; later stages then depend on `after`."""
        self.redoing = self.redoing or self.job.redo_from in names
        for name in names:
            self.keys[name] = digest([self.base, name, "left out", [self.keys[a] for a in after]])

    def early(
        self, name: str, key: str, what: str, write: Callable[[Path, StageReport], object], about: Mapping[str, Any]
    ) -> None:
        """Write a preliminary result of the visible stage `name`, under a `key` of its own.

        The final result replaces it like an older one: a person's edits are set aside.
        """
        stopping.check()
        self._set_edits_aside(self.visible, name)
        with self.progress.stage(f"first {name}", what) as report:
            self.visible.put(name, key, lambda folder: write(folder, report), about=about)

    def preliminary(self, name: str, key: str, write: Callable[[Path], object], about: Mapping[str, Any]) -> None:
        """`early` within a running stage, without a progress line of its own."""
        self._set_edits_aside(self.visible, name)
        self.visible.put(name, key, write, about=about)

    def absorb(
        self, name: str, write: Callable[[Path, StageReport], object], about: Mapping[str, Any] = NOTHING
    ) -> Path:
        """Write a reused stage again with its folder's edits, which then belong to its result."""
        keeper, edited = self.visible, self.edited[name]

        def fill(folder: Path) -> None:
            write(folder, report)

        self.progress.reused.remove(name)
        with self.progress.stage(name, self.stages[name]) as report:
            return keeper.put(name, self.plain[name], fill, edited=edited, about=about)

    def _add_edits_to_key(self, keeper: Keeper, name: str) -> None:
        """Add the edits of a reused stage to its key; the keys of all later stages depend on it."""
        if name not in edits.EDITABLE:
            return
        taken_up, changed = edits.edits_of(keeper.root / name, name)
        if taken_up | changed:
            self.plain[name] = self.keys[name]
            self.edited[name], self.changed[name] = taken_up | changed, changed
            self.keys[name] = digest([self.keys[name], self.edited[name]])

    def _set_edits_aside(self, keeper: Keeper, name: str) -> None:
        """Set a folder with edited files aside before its replacement, and note that."""
        if name not in edits.EDITABLE:
            return
        taken_up, changed = edits.edits_of(keeper.root / name, name)
        if taken_up | changed:
            done = atomic.done(keeper.root / name)
            place = output.move_aside(
                keeper.root / name, "edited", {atomic.DONE, *done[1], *changed} if done else changed
            )
            files = ", ".join(sorted(taken_up | changed))
            text = f"{name}/ is written again, since its inputs have changed; your edited {files} now lies in {place}."
            self.progress.note(text)

    def record(self, name: str, after: Sequence[str], inputs: Any, make: Callable[[StageReport], Any]) -> Any:
        """Like `stage`, for a stage whose result is a record."""
        results: list[Any] = []

        def write(folder: Path, report: StageReport) -> None:
            results.append(make(report))
            save_record(folder / "record", results[0])

        folder = self.stage(name, after, inputs, write)
        # Under a memory budget even a fresh result is read back: its arrays then lie in files.
        return results[0] if results and not memory.tight() else load_record(folder / "record")
