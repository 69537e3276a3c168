"""Exclusive use of a folder of deliveries: exports into it follow one another by its lock."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from mistyle.core.errors import UsageError
from mistyle.io.store.lock import release, take
from mistyle.process import disk_errors

PATIENCE = 600.0  # seconds that `hold` waits


@contextlib.contextmanager
def hold(lock: Path, say: Callable[[str], None] = lambda text: None, seconds: float = PATIENCE) -> Iterator[None]:
    """Hold a folder's lock for a block; wait up to `seconds` for its holder, which `say` names once.

    The folder is made where it is absent; if it is still empty at the end, it is removed again. Raises UsageError as
    `take` does.
    """
    absent = [place for place in (lock.parent, *lock.parent.parents) if not place.exists()]
    try:
        with disk_errors.translated(lock.parent):
            owner = _take_when_free(lock, say, seconds)
        try:
            yield
        finally:
            release(lock, owner)
    finally:
        with contextlib.suppress(OSError):
            for place in absent:
                place.rmdir()


def _take_when_free(lock: Path, say: Callable[[str], None], seconds: float) -> str:
    since, told = time.monotonic(), False
    while True:
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            return take(lock)
        except (UsageError, FileNotFoundError) as error:  # a holder that wrote nothing may have removed the folder
            if time.monotonic() - since >= seconds:
                raise
            if not told and isinstance(error, UsageError):
                say(f"waiting up to {seconds:g} s: {error}")
                told = True
        time.sleep(0.2)
