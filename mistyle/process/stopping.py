"""Stop requests: signals from a user, a queue or a parent process.

SIGTERM, a closed terminal and on Windows Ctrl-Break end the run with `Stopped`, Ctrl-C with KeyboardInterrupt;
finished stages stay. A second Ctrl-C ends the process at once; a run survives it as any other kill.
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

AGAIN = 0.05  # seconds until a lost request is repeated


@dataclass
class _State:
    """The request: its signal, whether its exception has been raised, and how many loops defer it."""

    asked: int | None = None
    raised: bool = False
    holding: int = 0
    patience: float = 0.0
    waited: bool = False


_state = _State()


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Handle signals inside the context (main thread only), then restore the handlers; ignored signals stay ignored.

    After a Ctrl-C, the next one ends the process at once: Python's shutdown would print tracebacks.
    """
    global _state
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {n: handler for n, handler in _answers().items() if signal.getsignal(n) is not signal.SIG_IGN}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    hook, sys.unraisablehook = sys.unraisablehook, _lost(sys.unraisablehook)
    _state = _State()
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            if number != signal.SIGINT or _state.asked != signal.SIGINT:
                signal.signal(number, handler)
        if _state.asked != signal.SIGINT:
            _state = _State()


def _answers() -> dict[int, Callable[[int, FrameType | None], None]]:
    names = ("SIGTERM", "SIGHUP", "SIGBREAK")
    stops = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return {signal.SIGINT: _interrupt, **dict.fromkeys(stops, _stop)}


def asked() -> bool:
    """Whether a stop was requested; a long loop then writes its checkpoint and calls `check()`."""
    return _state.asked is not None


def check() -> None:
    """Raise Stopped or KeyboardInterrupt if a stop was requested."""
    if _state.asked is None:
        return
    _state.raised = True
    if _state.asked == signal.SIGINT:
        raise KeyboardInterrupt
    raise Stopped("stopped on request; rerun to resume")


@contextlib.contextmanager
def at_checkpoints(patience: float = 10.0) -> Iterator[None]:
    """For loops that poll `asked()`: a stop request waits for them, `patience` seconds at most."""
    _state.holding, _state.patience = _state.holding + 1, patience
    try:
        yield
    finally:
        _state.holding -= 1
    check()


def _stop(number: int, frame: FrameType | None) -> None:
    if _state.raised:
        return  # raised already; code that swallows it meets check() at the next stage
    _state.asked = number
    if _state.holding > 0 and not _state.waited:
        _state.waited = True
        _later(number, _state.patience)
        return
    check()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _state.asked == signal.SIGINT:
        # Without Python's shutdown, which would wait for threads.
        os._exit(130)
    _state.asked = number
    check()


def _later(number: int, seconds: float) -> None:
    timer = threading.Timer(seconds, _thread.interrupt_main, (number,))
    timer.daemon = True
    timer.start()


def _lost(before: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Repeat a request whose exception a finalizer or a callback swallowed."""

    def hook(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, (KeyboardInterrupt, Stopped)) and asked():
            number, _state.asked, _state.raised = _state.asked or signal.SIGTERM, None, False
            _later(number, AGAIN)
            return
        before(unraisable)

    return hook
