"""Progress of a job on stderr: bars with the remaining time on a terminal, plain lines elsewhere."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import accumulate

from mistyle.process import memory

Report = Callable[[float], None]
EVERY = 15.0  # seconds between lines


class Progress:
    """Names the running stage, measures its time and its peak memory.

    `seconds` and `peaks` (GB) hold the finished stages, `notes` the user's warnings about the result.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.began = time.perf_counter()
        self.seconds: dict[str, float] = {}
        self.peaks: dict[str, float] = {}
        self.reused: list[str] = []
        self.notes: list[str] = []

    def note(self, *texts: str) -> None:
        """Add notes about omissions, guesses, repairs and unknown data, each once, for `tell_notes`."""
        self.notes += [text for text in dict.fromkeys(texts) if text not in self.notes]

    def tell_notes(self) -> None:
        """Print the notes, a line each. A verb does this at its end, after the last progress line."""
        for text in self.notes:
            self.say(f"note      {' '.join(text.split())}")

    def say(self, text: str) -> None:
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def stage(self, name: str, what: str) -> "Iterator[StageReport]":
        """Run a stage: yields a callback for the completed share, 0..1."""
        start = time.perf_counter()
        with memory.watched() as most:
            if sys.stderr.isatty() and not self.quiet:
                with _bar(what) as report:
                    yield report
            else:
                self.say(f"{what} ...")
                with _signs_of_life(what, self.say) as say:
                    yield _lines(what, say)
            self.peaks[name] = most() / 1e9
        self.seconds[name] = time.perf_counter() - start
        self.say(f"{what}: {self.seconds[name]:.1f} s")

    def skip(self, name: str, what: str) -> None:
        """Report that a stage is reused from an earlier run."""
        self.reused.append(name)
        self.seconds[name] = 0.0
        self.say(f"{what}: reused from an earlier run")


def grouped(notes: Iterable[tuple[str, str]]) -> list[str]:
    """Notes (name, sentence) with each sentence once, behind the first three names that it holds for."""
    names: dict[str, list[str]] = {}
    for name, text in notes:
        names.setdefault(text, []).append(name)
    return [
        f"{', '.join(who[:3])}{f' and {len(who) - 3} more' * (len(who) > 3)}: {text}" for text, who in names.items()
    ]


def parts(report: Report, seconds: Sequence[float]) -> list[Report]:
    """Reports of a stage's consecutive parts, which are planned to take so many seconds."""
    ends = list(accumulate(seconds))

    def part(end: float, took: float) -> Report:
        return lambda done: report((end - (1 - done) * took) / ends[-1])

    return [part(end, took) for end, took in zip(ends, seconds, strict=True)]


class Remaining:
    """Estimates the whole seconds left from completed shares: the time of the share done so far, carried on.

    Shares are proportional to planned seconds where a stage knows them. An estimate exceeds the previous one by
    GROWTH at most, so that one slow step does not make the end seem far. LEAST is the least number of whole seconds
    that can grow so.
    """

    GROWTH, LEAST = 1.25, 4

    def __init__(self) -> None:
        self._begin, self._last, self._end = (time.perf_counter(), 0.0), float("inf"), float("inf")

    def begin_at(self, done: float) -> None:
        """An earlier run did this share; it does not count as fast work."""
        self._begin = time.perf_counter(), done

    def end_in(self, seconds: float) -> None:
        """A time limit ends the stage in so many seconds."""
        self._end = time.perf_counter() + seconds

    def __call__(self, done: float) -> float | None:
        """Seconds left, None without an estimate."""
        start, first = self._begin
        if not first < done < 1:
            return None
        left = max(round((time.perf_counter() - start) / (done - first) * (1 - done)), self.LEAST)
        self._last = min(left, self.GROWTH * self._last) // 1
        return min(self._last, max(self._end - time.perf_counter(), 0.0))


class StageReport:
    """Receives the completed share of a stage, 0..1, and shows it through `show(share, seconds left)`."""

    def __init__(self, show: Callable[[float, Callable[[], float | None]], None]) -> None:
        self._show, self._remaining = show, Remaining()

    def __call__(self, done: float) -> None:
        self._show(done, lambda: self._remaining(done))

    def begin_at(self, done: float) -> None:
        """A resumed stage begins with this share."""
        self._remaining.begin_at(done)
        self(done)

    def end_in(self, seconds: float) -> None:
        """A time limit ends the stage in so many seconds."""
        self._remaining.end_in(seconds)


@contextmanager
def _bar(what: str) -> Iterator[StageReport]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = [
        TextColumn("{task.description:<42}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    ]
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task, shown = bars.add_task(what, total=1.0, left=""), [0.0]

        def show(done: float, left: Callable[[], float | None]) -> None:
            now = time.perf_counter()
            if now - shown[0] >= 1:
                shown[0], seconds = now, left()
                text = "" if seconds is None else f"{int(seconds // 60)}:{int(seconds % 60):02d} left"
                bars.update(task, left=text)
            bars.update(task, completed=min(max(done, 0.0), 1.0))

        yield StageReport(show)


@contextmanager
def _signs_of_life(what: str, say: Callable[[str], None], every: float = EVERY + 3) -> Iterator[Callable[[str], None]]:
    """Yields `say`; a line with the seconds so far follows wherever nothing was said for `every` seconds."""
    began, ended = time.perf_counter(), threading.Event()
    last = [began]

    def spoken(text: str) -> None:
        last[0] = time.perf_counter()
        say(text)

    def watch() -> None:
        while not ended.wait(every / 10):
            if time.perf_counter() - last[0] >= every:
                spoken(f"  {what}: {time.perf_counter() - began:.0f} s so far")

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield spoken
    finally:
        ended.set()
        thread.join()


def _lines(what: str, say: Callable[[str], None], every: float = EVERY) -> StageReport:
    """A progress line every `every` seconds: logs of a farm stay short."""
    last = [time.perf_counter()]

    def show(done: float, left: Callable[[], float | None]) -> None:
        now = time.perf_counter()
        if now - last[0] >= every and 0 < done < 1:
            last[0], seconds = now, left()
            say(f"  {what}: {100 * done:.0f} %" + ("" if seconds is None else f", about {seconds:.0f} s left"))

    return StageReport(show)
