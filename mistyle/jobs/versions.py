"""Versions of mistyle and its packages, and peak memory: for `run.json`, `compare.json` and the reports."""

import platform
from importlib.metadata import PackageNotFoundError, version

from mistyle import __version__
from mistyle.process import memory

PACKAGES = (
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "scipy",
    "trimesh",
    "xatlas",
    "OpenEXR",
    "opencv-contrib-python-headless",
    "pillow",
)


def peak_gb() -> float:
    """Peak resident memory of this process or of its largest child, GB."""
    return memory.highest() / 1e9


def versions() -> dict[str, str]:
    """Versions of mistyle, Python, the system and PACKAGES; "missing" for a package that is not installed."""
    table = {"mistyle": __version__, "python": platform.python_version(), "system": platform.platform()}
    for name in PACKAGES:
        try:
            table[name] = version(name)
        except PackageNotFoundError:
            table[name] = "missing"
    return table
