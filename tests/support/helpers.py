"""What several test files share."""

import os
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
NO_DATA = "no real data at MISTYLE_DATA"


def fixed_surface(**changes: Any) -> Any:
    """Settings of the surface with every choice made, none of them by a painting."""
    from mistyle.stylization.surface.exemplar.chosen import resolved
    from mistyle.stylization.surface.settings import SurfaceSettings

    fixed = {
        "levels": 5,
        "detail": 4.0,
        "palette": 0.2,
        "stroke_coherence": 0.03,
        "modelling": 0.0,
        "crop": 0.0,
        "omit": (),
    }
    return resolved(SurfaceSettings(**(fixed | {"look_up": "bilinear", "borders": "blend"} | changes)), None)


def data(path: str) -> Path:
    """A file or folder of the real data: below MISTYLE_DATA, else below ../shared/data beside the repository.

    The data is not in the repository (other people's licences): the calling test is skipped where it is absent.
    """
    found = Path(os.environ.get("MISTYLE_DATA") or ROOT.parent / "shared" / "data") / path
    if not found.exists():
        pytest.skip(f"{NO_DATA}: {path}")
    return found
