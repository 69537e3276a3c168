"""Processes that must not outlive the one that started them: called at their beginning, by themselves."""

import contextlib
import os
import sys
import threading
import time

PARENT = "MISTYLE_PARENT"  # the number of the process that waits for this one


def end_with_parent(pid: int | None = None) -> None:
    """End at once when the parent process ends, however it ends; a parent that is gone already counts.

    `pid` is the parent's number as the parent knows it, which closes the gap between the start and this call. Linux
    does it with a signal of the kernel (SIGKILL); elsewhere a thread looks twice a second.
    """
    pid = os.getppid() if pid is None else pid
    if sys.platform == "linux":
        import ctypes
        import signal

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != pid:
            os._exit(75)
        return
    threading.Thread(target=_watch, args=(pid,), daemon=True).start()


def end_with_asker() -> None:
    """`end_with_parent` where the one that started this process asks for it by $MISTYLE_PARENT."""
    with contextlib.suppress(ValueError):
        end_with_parent(int(os.environ.pop(PARENT, "none")))


def _watch(pid: int) -> None:
    if sys.platform == "win32":
        import ctypes

        # 0x100000 is SYNCHRONIZE: the handle of a process is signalled when it ends.
        kernel = ctypes.windll.kernel32
        handle = kernel.OpenProcess(0x100000, False, pid)
        if handle:
            kernel.WaitForSingleObject(handle, 0xFFFFFFFF)
        os._exit(75)
    while os.getppid() == pid:
        time.sleep(0.5)
    os._exit(75)
