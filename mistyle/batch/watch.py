"""Progress of a batch: a live table on a terminal, a line per shard elsewhere."""

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mistyle.batch.engines import Ended, Watch, last_lines
from mistyle.batch.plan import BatchPlan

ROWS = 30  # of the live table


@contextmanager
def watching(plan: BatchPlan, todo: Sequence[int], reused: int, live: bool) -> Iterator[Watch]:
    """The engines' callback for starts and ends of shards; with `live`, a table of all shards is shown."""
    state: dict[int, tuple[float, Ended | None]] = {}
    lock = threading.Lock()

    def report(index: int, ended: Ended | None) -> None:
        with lock:
            begun = state[index][0] if index in state else time.monotonic()
            state[index] = (begun, ended)
            done = sum(e is not None for _, e in state.values())
        if not live:
            status = "begun" if ended is None else "done" if ended.code == 0 else f"exit {ended.code}"
            count = f"{done + reused}/{len(todo) + reused}"
            print(f"[{count}] {plan.jobs[index].name}: {status}", file=sys.stderr, flush=True)

    if not live:
        yield report
        return
    from rich.console import Console
    from rich.live import Live

    class ProgressTable:
        """The table, built at every refresh."""

        def __rich__(self) -> Any:
            with lock:
                return _table(plan, todo, dict(state), reused)

    with Live(ProgressTable(), console=Console(stderr=True), refresh_per_second=2):
        yield report


def _table(plan: BatchPlan, todo: Sequence[int], state: dict[int, tuple[float, Ended | None]], reused: int) -> Any:
    from rich.markup import escape
    from rich.table import Table

    done = sum(e is not None for _, e in state.values())
    running = len(state) - done
    title = f"{done + reused} of {len(todo) + reused} done, {running} running"
    table = Table("job", "state", "seconds", "last line", title=title, expand=True)
    # Running shards first, then the latest finished ones.
    ordered = sorted(state, key=lambda k: (state[k][1] is not None, -state[k][0]))[:ROWS]
    for index in ordered:
        begun, ended = state[index]
        if ended is None:
            line = last_lines(plan, index, 1)[-100:]
            table.add_row(plan.jobs[index].name, "running", f"{time.monotonic() - begun:.0f}", escape(line))
        else:
            colour = "green" if ended.code == 0 else "red"
            status = "done" if ended.code == 0 else f"exit {ended.code}"
            line = "" if ended.code == 0 else last_lines(plan, index, 1)[-100:]
            table.add_row(plan.jobs[index].name, f"[{colour}]{status}[/]", "", escape(line))
    return table
