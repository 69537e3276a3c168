"""Checkpoints of long fits: a folder that is replaced as a whole, named after everything that the fit depends on."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.io.store.atomic import atomic_folder, intact, seal
from mistyle.io.store.records import load_record, save_record


def place(out: Path, key: str) -> Path:
    """The folder of the checkpoint of the fit with this key."""
    return out / "work" / f"checkpoint-{key[:16]}"


def save(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Replace the checkpoint atomically; a process that dies meanwhile leaves the older one."""

    def write(new: Path) -> None:
        save_record(new / "record", arrays)
        seal(new, stage="checkpoint", key=folder.name)

    atomic_folder(folder, write)


def load(folder: Path, say: Callable[[str], None] = lambda text: None) -> dict[str, np.ndarray] | None:
    """The checkpoint, or None if it is missing or its hashes differ; `say` reports a damaged one."""
    if not folder.is_dir():
        return None
    try:
        if intact(folder) is not None:
            return load_record(folder / "record")
    except InputRefused:
        pass
    say(f"{folder}: this checkpoint is damaged; the fit starts again")
    return None


def clear(out: Path) -> None:
    """Remove the checkpoints of a run folder, those of other settings too: their fits have ended."""
    for folder in (out / "work").glob("checkpoint-*"):
        shutil.rmtree(folder, ignore_errors=True)
