"""Progress of a part of a longer job."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class StageProgress:
    """Called with the progress of a part, 0..1; reports the progress of the whole, in low..high."""

    report: Callable[[float], None] = lambda done: None
    low: float = 0.0
    high: float = 1.0

    def __call__(self, done: float) -> None:
        self.report(self.low + (self.high - self.low) * done)

    def part(self, low: float, high: float) -> "StageProgress":
        """The part of this one that lies in low..high, 0..1."""
        return StageProgress(self, low, high)
