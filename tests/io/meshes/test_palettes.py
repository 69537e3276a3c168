"""Textures of few texels: what reading makes of palettes (every face shows one texel) and of small tiled pictures."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.core.image import linear_from_srgb
from mistyle.geometry.retexture import fetch
from mistyle.io.read_mesh import read_extent, read_mesh

SIDE = 20  # faces along each side of the sheet


def sheet(folder: Path, colours: np.ndarray, uv_of: object) -> Path:
    """A sheet of SIDE² quads in an OBJ with a texture of 4 x 4 texels; `uv_of(i, j)` are the corners' UVs."""
    Image.fromarray(colours).save(folder / "palette.png")
    (folder / "a.mtl").write_text("newmtl m\nmap_Kd palette.png\n")
    lines = ["mtllib a.mtl", "usemtl m"]
    lines += [f"v {i} {j} {0.3 * np.sin(i) * np.sin(j)}" for j in range(SIDE + 1) for i in range(SIDE + 1)]
    for j in range(SIDE):
        for i in range(SIDE):
            lines += [f"vt {u} {v}" for u, v in uv_of(i, j)]  # type: ignore[operator]
            first, row = j * (SIDE + 1) + i + 1, 4 * (j * SIDE + i) + 1
            corners = [first, first + 1, first + SIDE + 2, first + SIDE + 1]
            lines.append("f " + " ".join(f"{v}/{row + k}" for k, v in enumerate(corners)))
    path = folder / "a.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def palette() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (4, 4, 3), dtype=np.uint8)


def test_every_face_of_a_palette_keeps_its_colour(tmp_path: Path) -> None:
    colours = palette()
    texel = np.random.default_rng(4).integers(0, 4, (SIDE, SIDE, 2))

    def corner_uvs(i: int, j: int) -> list[tuple[float, float]]:
        row, column = texel[j, i]
        return [((column + 0.5) / 4, 1 - (row + 0.5) / 4)] * 4

    asset = read_mesh(sheet(tmp_path, colours, corner_uvs), size=512)
    albedo = asset.materials[0].albedo
    assert albedo is not None
    seen = fetch(albedo, asset.mesh.corner_uvs.mean(axis=1).astype(np.float64))
    right = np.array([colours[tuple(texel[j, i])] for j in range(SIDE) for i in range(SIDE)])
    right = np.repeat(linear_from_srgb(right / np.float32(255)), 2, axis=0)
    assert np.abs(seen - right).max() < 0.01


def test_a_tiled_picture_keeps_its_texels(tmp_path: Path) -> None:
    colours = palette()
    path = sheet(tmp_path, colours, lambda i, j: [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)])
    asset = read_mesh(path, size=512)
    albedo = asset.materials[0].albedo
    # 20 x 20 copies of 4 x 4 texels do not fit into the picture's own four.
    assert albedo is not None and len(albedo) >= 4 * SIDE


@pytest.mark.parametrize("plain", [True, False])
def test_the_extent_foretells_the_size(plain: bool, tmp_path: Path) -> None:
    colours = np.full((4, 4, 3), 90, np.uint8) if plain else palette()
    path = sheet(tmp_path, colours, lambda i, j: [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)])
    asset, said = read_mesh(path, size=512), read_extent(path, size=512)
    albedo = asset.materials[0].albedo
    assert albedo is not None
    assert said.own == albedo.nbytes
    # One colour needs no more texels than it came with.
    assert (len(albedo) == 4) == plain
