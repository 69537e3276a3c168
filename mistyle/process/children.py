"""Child processes end with their parent; each child calls this at its start."""

import contextlib
import os
import sys
import threading
import time

PARENT = "MISTYLE_PARENT"  # PID of the process that waits for this one


def end_with_parent(pid: int | None = None) -> None:
    """End at once when the parent process ends, however it ends, or when it has ended already.

    `pid` is the parent's PID. It closes the gap between the start and this call. On Linux the kernel sends SIGKILL;
    elsewhere a thread polls twice a second.
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
    """`end_with_parent` where the parent's environment sets $MISTYLE_PARENT."""
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
