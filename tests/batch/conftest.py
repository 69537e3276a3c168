"""Inputs of the tests of batches."""

from pathlib import Path

import numpy as np
import pytest
from batch_parts import CUBE
from PIL import Image


@pytest.fixture
def props(tmp_path) -> Path:
    """A folder with two meshes and two pictures."""
    folder = tmp_path / "props"
    (folder / "meshes").mkdir(parents=True)
    (folder / "styles").mkdir()
    for name in ("cube", "box"):
        (folder / "meshes" / f"{name}.obj").write_text(CUBE)
    rng = np.random.default_rng(0)
    for k, name in enumerate(("wave", "ink")):
        pixels = (rng.random((12, 16, 3)) * 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
        Image.fromarray(pixels).save(folder / "styles" / f"{name}.{('png', 'jpg')[k]}")
    return folder
