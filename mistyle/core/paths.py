"""Paths of mistyle's own files."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def scenes() -> Path:
    """The folder `scenes/`: beside the package in a clone, inside it (`_scenes`) in an installed wheel."""
    beside = PACKAGE.parent / "scenes"
    return beside if beside.is_dir() else PACKAGE / "_scenes"
