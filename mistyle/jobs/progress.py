"""What a person sees while a job runs, on stderr: bars with the time left on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from mistyle.process import memory

Report = Callable[[float], None]


class Progress:
    """Names the stage that runs, times it and watches its memory.

    `seconds` and `peaks` (GB) hold the finished stages, `notes` what the user has to know about the result.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.began = time.perf_counter()
        self.seconds: dict[str, float] = {}
        self.peaks: dict[str, float] = {}
        self.reused: list[str] = []
        self.notes: list[str] = []

    def note(self, *texts: str) -> None:
        """Keep sentences about what was left out, guessed, repaired or not understood, each once, for `tell_notes`."""
        self.notes += [text for text in dict.fromkeys(texts) if text not in self.notes]

    def tell_notes(self) -> None:
        """Print the notes, a line each. A verb does this at its end, after the last progress line."""
        for text in self.notes:
            self.say(f"note      {' '.join(text.split())}")

    def say(self, text: str) -> None:
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def stage(self, name: str, what: str) -> Iterator[Report]:
        """Runs a stage: yields the function that takes the share done, 0..1."""
        start = time.perf_counter()
        with memory.watched() as most:
            if sys.stderr.isatty() and not self.quiet:
                with _bar(what) as report:
                    yield report
            else:
                self.say(f"{what} ...")
                yield _lines(what, self.say)
            self.peaks[name] = most() / 1e9
        self.seconds[name] = time.perf_counter() - start
        self.say(f"{what}: {self.seconds[name]:.1f} s")

    def skip(self, name: str, what: str) -> None:
        """Says that a stage is taken over from an earlier run."""
        self.reused.append(name)
        self.seconds[name] = 0.0
        self.say(f"{what}: done before, taken over")


def grouped(notes: Iterable[tuple[str, str]]) -> list[str]:
    """Sentences about many things (name, sentence), each once, with the first names that it holds for."""
    names: dict[str, list[str]] = {}
    for name, text in notes:
        names.setdefault(text, []).append(name)
    return [
        f"{', '.join(who[:3])}{f' and {len(who) - 3} more' * (len(who) > 3)}: {text}" for text, who in names.items()
    ]


@contextmanager
def _bar(what: str) -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = [
        TextColumn("{task.description:<42}"),
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(compact=True),
    ]
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(what, total=1.0)
        yield lambda done: bars.update(task, completed=min(max(done, 0.0), 1.0))


def _lines(what: str, say: Callable[[str], None], every: float = 20.0) -> Report:
    """A line when a stage is still running after every so many seconds: logs of a farm stay short."""
    start = last = time.perf_counter()

    def report(done: float) -> None:
        nonlocal last
        now = time.perf_counter()
        if now - last >= every and 0 < done < 1:
            last = now
            say(f"  {what}: {100 * done:.0f} %, about {(now - start) / done * (1 - done):.0f} s left")

    return report
