"""The journal of a recovery: its state before the running pass, and all finished parts of that pass.

Both lie in checkpoints. A later run repeats the pass and takes finished parts from the journal, so it ends with the
same bytes. Every progress report of a pass is a point where it may be saved, stopped, or ended by its time limit.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mistyle.process import stopping

Arrays = dict[str, np.ndarray]
SELDOM = 10  # least ratio of the seconds between two checkpoints to those of writing one, gigabytes of a large atlas


@dataclass(frozen=True)
class Checkpoints:
    """`save` receives the arrays that a later run needs as `resume`, every `settings.checkpoint` seconds and at a stop
    request."""

    save: Callable[[Arrays], None] | None = None
    resume: Arrays | None = None


class TimeOver(Exception):
    """The time limit has passed; the state before the running pass is the result."""


class Journal:
    """A class, since finished parts collect in it. `deadline` is a value of `time.monotonic`."""

    def __init__(self, checkpoints: Checkpoints, every: float, deadline: float = float("inf")) -> None:
        self.checkpoints, self.every, self.deadline = checkpoints, every, deadline
        self.saved, self.done, self.took = time.monotonic(), 0, 0.0
        self.state: Arrays = {}
        self.parts: dict[str, Arrays] = {}
        self.earlier: dict[str, Arrays] = {}
        self.resumed: Arrays | None = None
        if checkpoints.resume is not None:
            self.resumed = inside(checkpoints.resume, "state/")
            names = {name.split("/")[1] for name in checkpoints.resume if name.startswith("part/")}
            self.earlier = {name: inside(checkpoints.resume, f"part/{name}/") for name in sorted(names)}

    def begin(self, state: Arrays, done: int) -> None:
        """A pass begins in `state`, after `done` passes."""
        if self.state:
            self.earlier = {}  # belongs to an earlier pass
        self.state, self.parts, self.done = state, {}, done
        self.poll()

    def part(self, name: str, compute: Callable[[], Arrays]) -> Arrays:
        """The arrays of one part, computed or taken from the checkpoint; parts named `name`.… belong to it and end."""
        arrays = self.earlier.pop(name) if name in self.earlier else compute()
        self.parts = {own: value for own, value in self.parts.items() if not own.startswith(f"{name}.")}
        self.parts[name] = arrays
        self.poll()
        return arrays

    def named(self, prefix: str) -> list[str]:
        """The names of interrupted parts under a prefix."""
        return [name for name in self.earlier if name.startswith(prefix)]

    def poll(self, name: str = "", arrays: Callable[[], Arrays] | None = None) -> None:
        """Save if it is time or a stop was requested; then raise Stopped, or TimeOver after the first pass.

        `arrays` are a part in progress; after an interruption they are in `earlier` under `name`.
        """
        if stopping.asked() or time.monotonic() - self.saved > max(self.every, SELDOM * self.took):
            self.save({} if arrays is None else {name: arrays()})
        stopping.check()
        if self.done and time.monotonic() > self.deadline:
            raise TimeOver

    def save(self, running: dict[str, Arrays] | None = None) -> None:
        """Write the checkpoint."""
        if self.checkpoints.save is None or not self.state:
            return
        flat = {f"state/{name}": value for name, value in self.state.items()}
        # Parts of the interrupted run that were not reached again are still valid.
        for part, arrays in {**self.earlier, **self.parts, **(running or {})}.items():
            flat |= {f"part/{part}/{name}": value for name, value in arrays.items()}
        begun = time.monotonic()
        self.checkpoints.save(flat)
        self.saved = time.monotonic()
        self.took = self.saved - begun


def inside(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays whose names begin with `prefix`, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}
