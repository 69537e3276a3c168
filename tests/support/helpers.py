"""What several test files share."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
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


def point_cloud(file: Path, points: np.ndarray) -> None:
    """A PLY as nerfstudio writes it: vertices with colours, no faces."""
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uint8 {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    file.write_text(header + "".join(f"{x:8f} {y:8f} {z:8f} 1 2 3\n" for x, y, z in points))


def assert_same(records: Sequence[Any], others: Sequence[Any]) -> None:
    """Records of arrays and numbers field by field, a NaN equal to itself; their own == cannot compare arrays."""
    np.testing.assert_equal([vars(record) for record in records], [vars(other) for other in others])


def from_front(
    model: str, wi: Any, wo: Any, albedo: Any, roughness: Any, metallic: Any, *, specular: float = 0.5
) -> Any:
    """f cos(theta_o) of a reflectance model of the deferred renderer, one sided, without a normal map."""
    from mistyle.render.deferred.bsdf import MODELS, upright
    from mistyle.render.mitsuba.device import dr

    angles = upright(wi, wo)
    linear, constant = MODELS[model](angles, roughness, metallic, specular)
    return dr.fma(albedo, dr.select(angles.valid, linear, 0), dr.select(angles.valid, constant, 0))


def recordings(shader: Any) -> int:
    """How often the frozen functions of a renderer, or of a fit's bridge, were recorded."""
    return sum(function.n_recordings for function in shader._frozen.values())
