"""Paths: of mistyle's own files, and of files behind links."""

import errno
import os
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def scenes() -> Path:
    """The folder `scenes/`: beside the package in a clone, inside it (`_scenes`) in an installed wheel."""
    beside = PACKAGE.parent / "scenes"
    return beside if beside.is_dir() else PACKAGE / "_scenes"


def real_path(path: Path) -> Path:
    """The absolute path without links; it need not exist.

    OSError (ELOOP) where links lead to themselves: `Path.resolve` raises a RuntimeError, from Python 3.13 nothing.
    """
    real = os.path.realpath(path)
    try:
        os.stat(real)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise
    return Path(real)
