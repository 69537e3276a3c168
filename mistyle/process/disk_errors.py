"""Errors of disks and files as messages: disk full, not writable, removed while in use, missing."""

import contextlib
import errno
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mistyle.core.errors import InputRefused, MistyleError, UsageError
from mistyle.core.paths import PACKAGE

FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
NOT_TO_BE_WRITTEN = (errno.EROFS, errno.EACCES, errno.EPERM)
BROKEN = tuple(
    getattr(errno, name) for name in ("EIO", "ENXIO", "ENODEV", "ESTALE", "EREMOTEIO") if hasattr(errno, name)
)
PROBE = 1 << 20
NOTHING = "no partial file remains"


@contextlib.contextmanager
def translated(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Turn disk errors while writing `path` into a MistyleError; other errors pass through.

    `temporary` is the file or folder that is written meanwhile. Some writers hide the system's error (a library's
    RuntimeError, an OSError without errno). A probe file written beside the target then finds the cause.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        sentence = _sentence(error, path, temporary)
        if sentence is None:
            raise
        raise sentence from error


def _sentence(error: Exception, path: Path, temporary: Path | None) -> MistyleError | None:
    code = error.errno if isinstance(error, OSError) else None
    named = _named(error)
    inside = named is None or any(_within(named, place) for place in (path.parent, temporary) if place is not None)
    if temporary is not None and _gone(temporary, code, named):
        return MistyleError(
            f"{_shown(temporary.parent)}: this folder was removed while it was being written to. "
            "Run the same command again to start anew"
        )
    if code is None:
        code = _probed(temporary if temporary is not None and temporary.is_dir() else path.parent, temporary)
    if code is None:
        return None
    path = _shown(path)
    if code in FULL:
        return MistyleError(
            f"{path}: the disk is full ({os.strerror(code)}); {NOTHING}. "
            "Free some space, or choose an output folder on another disk, and run the same command again"
        )
    if code == errno.EFBIG:
        return MistyleError(
            f"{path}: a file exceeded the allowed size ({os.strerror(code)}); {NOTHING}. "
            "Raise the limit (ulimit -f), or choose an output folder on another disk, and run the same command again"
        )
    if code in BROKEN and inside:
        return MistyleError(
            f"{path}: the disk, or the connection to it, failed ({os.strerror(code)}). "
            "Check the disk, and run the same command again"
        )
    if code == errno.EROFS or (code in NOT_TO_BE_WRITTEN and inside):
        return UsageError(
            f"{path}: cannot be written ({os.strerror(code)}); {NOTHING}. "
            "Choose another output folder, or get permission to write there"
        )
    if code in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR) and inside:
        return UsageError(
            f"{path}: cannot be put in place ({os.strerror(code)}): a file or another run is in the way. "
            "Choose another output folder"
        )
    return None


def _gone(temporary: Path, code: int | None, named: Path | None) -> bool:
    """Whether the temporary file or its folder was removed."""
    return not temporary.parent.is_dir() or (
        code == errno.ENOENT and named is not None and _within(named, temporary) and not temporary.exists()
    )


def _shown(path: Path) -> Path:
    """The path under its final name."""
    return Path(*(re.sub(r"^\.(.+)\.tmp-.+-\d+-\d+(\.\w+)?$", r"\1", part) for part in path.parts))


def _probed(folder: Path, temporary: Path | None) -> int | None:
    """The errno of writing another megabyte to the folder; EFBIG where a file has the largest allowed size."""
    limit = _largest_file()
    if limit is not None and temporary is not None and temporary.exists():
        every = temporary.rglob("*") if temporary.is_dir() else [temporary]
        if any(p.stat().st_size >= limit for p in every if p.is_file()):
            return errno.EFBIG
    probe = folder / f".probe.tmp-{os.getpid()}"
    try:
        with open(probe, "wb", buffering=0) as file:
            remaining = PROBE if limit is None else min(PROBE, limit)
            while remaining > 0:
                remaining -= file.write(b"\0" * remaining) or 0
            os.fsync(file.fileno())
    except OSError as error:
        return error.errno
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)
    return None


def _largest_file() -> int | None:
    """The file size limit (RLIMIT_FSIZE) in bytes; None without one."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def _named(error: Exception) -> Path | None:
    name = getattr(error, "filename", None)
    return Path(os.fsdecode(name)) if isinstance(name, (str, bytes)) else None


def _within(path: Path, folder: Path) -> bool:
    return Path(os.path.abspath(path)).is_relative_to(os.path.abspath(folder))


def unexpected(error: OSError) -> MistyleError | None:
    """The message for a file error outside `translated`, for example a vanished input.

    None for errors that only a defect of mistyle explains.
    """
    named = _named(error)
    if error.errno in FULL:
        where = "" if named is None else f"{named}: "
        return MistyleError(f"{where}the disk is full ({os.strerror(error.errno or 0)}); free some space and run again")
    if error.errno is None and re.fullmatch(r"\d+ requested and \d+ written", str(error)):  # NumPy's message
        return MistyleError(
            f"a file could not be written to its end ({error}): the disk is full, or files may not grow so large. The "
            f"folder for temporary files counts too ({tempfile.gettempdir()}; TMPDIR names another); run again"
        )
    if named is None or _within(named, PACKAGE):
        return None
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return InputRefused(
            f"{named}: found nothing; it was removed or renamed while the job ran, or never existed. "
            "Put it back, and run the same command again"
        )
    if error.errno in (errno.ELOOP, errno.ENAMETOOLONG):
        return InputRefused(f"{named}: names no file or folder ({os.strerror(error.errno)}); choose another path")
    if error.errno in NOT_TO_BE_WRITTEN:
        return InputRefused(f"{named}: cannot be opened ({error.strerror}); get permission to read it")
    if error.errno in BROKEN:
        return MistyleError(f"{named}: the disk, or the connection to it, failed ({error.strerror}); run again")
    return None
