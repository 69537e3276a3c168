"""What several test files share."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NO_DATA = "no real data at MISTYLE_DATA"


def data(path: str) -> Path:
    """A file or folder of the real data: below MISTYLE_DATA, else below ../shared/data beside the repository.

    The data is not in the repository (other people's licences): the calling test is skipped where it is absent.
    """
    found = Path(os.environ.get("MISTYLE_DATA") or ROOT.parent / "shared" / "data") / path
    if not found.exists():
        pytest.skip(f"{NO_DATA}: {path}")
    return found
