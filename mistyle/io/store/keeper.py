"""The store of finished stages: a folder per stage, identified by a key, under one lock."""

import os
import re
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mistyle.core.errors import MistyleError
from mistyle.io.store import atomic, lock, output
from mistyle.io.store.atomic import DONE, LOCK
from mistyle.process import disk_errors


class Keeper:
    """Stores the folders of finished stages of one run and admits one process at a time.

    `root/<stage>/` holds a stage's files and `done.json` (its key and the sha256 of every file). The lock
    `root/.mistyle.lock` names process, host and time; it is released by `close`, at the end of a `with` block, and
    when the object or the process ends. A dead process's lock is taken over.
    """

    def __init__(
        self,
        root: Path,
        say: Callable[[str], None] = lambda text: None,
        *,
        shared: bool = False,
        overwrite: bool = False,
    ) -> None:
        """Take the lock (UsageError when another run holds it) and remove leftovers of killed runs.

        `say` receives a sentence about every folder that is set aside. In a `shared` folder other processes write
        single files without the lock: only leftovers of dead processes of this computer are removed. `overwrite` lets a
        stage's files replace files of the same names in a user's folder.
        """
        self.root, self._say, self._overwrite = Path(os.path.abspath(root)), say, overwrite
        with disk_errors.translated(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            self._owner = lock.take(self.root / LOCK)
        self._release = weakref.finalize(self, lock.release, self.root / LOCK, self._owner)
        atomic.clean_leftovers(self.root, everyones=not shared)

    def __enter__(self) -> "Keeper":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock; may be called twice."""
        self._release()

    def get(self, stage: str, key: str, editable: Callable[[str], bool] = lambda name: False) -> Path | None:
        """The folder of a stage finished under this key with every file as it was written, else None.

        A folder of another key stays; a damaged one is renamed to `<stage>.broken-N`, never deleted.
        Files that the stage did not write are ignored, and `editable` ones may have changed (jobs/edits.py). UsageError
        for a user's folder.
        """
        folder = self.root / _checked(stage)
        self._check_lock()
        if not folder.exists() or not self._claimed(stage):
            return None
        done = atomic.done(folder)
        if done is not None and done[0] != key:
            return None
        if done is not None and atomic.intact(folder, editable) is not None:
            return folder
        self._set_aside(folder)
        return None

    def put(
        self,
        stage: str,
        key: str,
        write: Callable[[Path], Any],
        edited: Mapping[str, str] | None = None,
        notes: Callable[[], Sequence[str]] = lambda: (),
        about: Mapping[str, Any] | None = None,
    ) -> Path:
        """Run `write(folder)` on a new empty folder and keep it as the stage's result under `key`.

        The new result replaces an older one only once it is complete; when `write` raises, or the disk is full
        (MistyleError), only the older one stays. A user's edits are kept: an older result with changed files is set
        aside like a broken one, and files that the stage had not written stay. `edited` (name to sha256) are changed
        files that `write` has read. The marker records them, the sentences of `notes()` after `write`, and `about`.
        UsageError where a file that the stage did not write has the name of a new one.
        """
        target = self.root / _checked(stage)
        self._check_lock()
        claimed = self._claimed(stage)

        def fill(folder: Path) -> None:
            write(folder)
            self._check_lock()
            details = {**(about or {}), "edited": dict(edited or {}), "notes": list(notes())}
            atomic.seal(folder, stage=stage, key=key, **{name: value for name, value in details.items() if value})
            output.keep_folder(self.root, stage)
            if claimed and target.exists() and any(output.files_of(target)):
                if atomic.intact(target, lambda name: name in (edited or {})) is None:
                    self._set_aside(target)

        def written(folder: Path) -> set[str]:
            done = atomic.done(folder)
            return {DONE, *done[1]} if claimed and done is not None else set()

        output.put_folder(target, fill, written, overwrite=self._overwrite)
        return target

    def _claimed(self, stage: str) -> bool:
        """Whether the stage's folder is ours; UsageError for a user's folder, or False with `overwrite`."""
        known = atomic.done(self.root / stage) is not None or output.keeps(self.root, stage)
        if not known and not self._overwrite:
            output.claim(self.root, folders=[stage])
        return known

    def notes(self, stage: str) -> list[str]:
        """The sentences in a finished stage's marker."""
        return atomic.notes_of(self.root / _checked(stage))

    def _set_aside(self, folder: Path) -> None:
        done = atomic.done(folder)
        names = {DONE, *done[1]} if done is not None else set(output.files_of(folder))
        aside = output.move_aside(folder, "broken", names)
        self._say(f"{folder}: not as it was finished (a file is missing or has changed); set aside as {aside.name}")

    def _check_lock(self) -> None:
        """Raises MistyleError where the folder was removed, or removed and taken by another run."""
        if not lock.held(self.root / LOCK, self._owner):
            raise MistyleError(
                f"{self.root}: this folder, or the lock in it, was removed while a run worked there; it stops, so that "
                "it cannot mix with another run. Run the same command again"
            )


def _checked(stage: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", stage):
        raise ValueError(f"'{stage}' is not a valid stage name; use letters, digits, '-' and '_'")
    return stage
