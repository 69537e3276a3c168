"""Requests to stop: what the signals of a person, a queue or a parent process do to a run.

SIGTERM, a closed terminal and on Windows Ctrl-Break end the run with `Stopped`, Ctrl-C with KeyboardInterrupt;
whatever was finished stays. A second Ctrl-C ends the process at once, which a run survives as any other death.
"""

import _thread
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType
from typing import Any

from mistyle.core.errors import Stopped

AGAIN = 0.05  # seconds until a request that was lost on the way is made once more


@dataclass
class _State:
    """What was asked for: the signal; whether its exception is on the way; how many loops hold it back."""

    asked: int | None = None
    raised: bool = False
    holding: int = 0
    patience: float = 0.0
    waited: bool = False


_state = _State()


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Answer signals while this runs (only in the main thread), as before afterwards; ignored ones stay ignored.

    Where a Ctrl-C ended it, the next one ends the process at once until it is over: what Python does at its end
    would answer with tracebacks.
    """
    global _state
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    answers = {n: answer for n, answer in _answers().items() if signal.getsignal(n) is not signal.SIG_IGN}
    before = {number: signal.signal(number, answer) for number, answer in answers.items()}
    hook, sys.unraisablehook = sys.unraisablehook, _lost(sys.unraisablehook)
    _state = _State()
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, answer in before.items():
            if number != signal.SIGINT or _state.asked != signal.SIGINT:
                signal.signal(number, answer)
        if _state.asked != signal.SIGINT:
            _state = _State()


def _answers() -> dict[int, Callable[[int, FrameType | None], None]]:
    names = ("SIGTERM", "SIGHUP", "SIGBREAK")
    stops = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return {signal.SIGINT: _interrupt, **dict.fromkeys(stops, _stop)}


def asked() -> bool:
    """Whether the run was asked to stop: the place for long loops to write their checkpoint and then `check()`."""
    return _state.asked is not None


def check() -> None:
    """End here if the run was asked to stop: Stopped or KeyboardInterrupt."""
    if _state.asked is None:
        return
    _state.raised = True
    if _state.asked == signal.SIGINT:
        raise KeyboardInterrupt
    raise Stopped("stopped on request; rerun to resume")


@contextlib.contextmanager
def at_checkpoints(patience: float = 10.0) -> Iterator[None]:
    """For loops that look at `asked()` themselves: a request to stop waits for them, `patience` seconds at most."""
    _state.holding, _state.patience = _state.holding + 1, patience
    try:
        yield
    finally:
        _state.holding -= 1
    check()


def _stop(number: int, frame: FrameType | None) -> None:
    if _state.raised:
        return  # on its way; what swallows it meets check() at the next stage
    _state.asked = number
    if _state.holding > 0 and not _state.waited:
        _state.waited = True
        _later(number, _state.patience)
        return
    check()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _state.asked == signal.SIGINT:
        # Nothing of Python's own end: it would wait for threads.
        os._exit(130)
    _state.asked = number
    check()


def _later(number: int, seconds: float) -> None:
    timer = threading.Timer(seconds, _thread.interrupt_main, (number,))
    timer.daemon = True
    timer.start()


def _lost(before: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A request that reached the process inside a finalizer or a callback is swallowed there: make it once more."""

    def hook(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, (KeyboardInterrupt, Stopped)) and asked():
            number, _state.asked, _state.raised = _state.asked or signal.SIGTERM, None, False
            _later(number, AGAIN)
            return
        before(unraisable)

    return hook
