"""Direct copy from the reader process's memory to the job's (Linux): one copy; a pipe needs two and many writes.

`process_vm_readv` reads the memory of a process that this one may trace, as a parent may its child under Yama's usual
setting. Without this permission the pipe transfers all arrays. A copy cannot change after its check, unlike a page
shared between the two processes.
"""

import ctypes
import os
from functools import cache
from typing import Any

from mistyle.process.cores import in_pieces

SIGN = b"mistyle reader  "
LENT = 1 << 18  # bytes: larger arrays are lent, smaller ones are sent
MAX_THREADS = 4


class Span(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


@cache
def _call() -> Any:
    try:
        call = ctypes.CDLL(None, use_errno=True).process_vm_readv
    except (OSError, AttributeError, TypeError):  # not Linux
        return None
    span = ctypes.POINTER(Span)
    call.argtypes = [ctypes.c_int, span, ctypes.c_ulong, span, ctypes.c_ulong, ctypes.c_ulong]
    call.restype = ctypes.c_ssize_t
    return call


def can_read(process: int, address: int) -> bool:
    """Whether that process's memory can be read: whether SIGN is at the address."""
    buffer = bytearray(len(SIGN))
    try:
        copy_from(process, address, memoryview(buffer))
    except OSError:
        return False
    return bytes(buffer) == SIGN


def copy_from(process: int, address: int, into: memoryview) -> None:
    """Fill `into` with the bytes at `address` of that process, on several threads if they are many. Raises OSError
    where this is not permitted or the bytes do not exist."""
    in_pieces(into, lambda at, piece: _copy(process, address + at, piece), MAX_THREADS)


def _copy(process: int, address: int, into: memoryview) -> None:
    call = _call()
    if call is None:
        raise OSError("this system does not read another process's memory")
    base, done = ctypes.addressof(ctypes.c_char.from_buffer(into)), 0
    while done < len(into):
        remaining = len(into) - done
        count = call(process, Span(base + done, remaining), 1, Span(address + done, remaining), 1, 0)
        if count <= 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        done += count
