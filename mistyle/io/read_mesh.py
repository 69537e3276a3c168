"""Reader of all mesh files that come from outside, and of the files that they name; bounded.

Unusable files are refused (core/errors.py InputRefused) with the file, the content found, the content expected and the
fix. Only files in a mesh's own folder are opened, pictures in the folder `textures` beside it, and files in a folder of
MISTYLE_ASSETS that holds the mesh (io/sandbox/asset_folders.py). No repair is silent: `Source.notes` lists the changes.

Files are opened and decoded in the reader process (io/sandbox/reader_process.py), as in `read.py`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, UpAxis
from mistyle.core.paths import real_path
from mistyle.io.meshes.parsed_mesh import Extent, Raw, spelled
from mistyle.io.sandbox.bounds import USD, refuse
from mistyle.io.sandbox.reader_process import ask

MESHES = {
    ".obj": "mistyle.io.meshes.obj_read:read_obj",
    ".ply": "mistyle.io.meshes.ply_read:read_ply",
    ".stl": "mistyle.io.meshes.stl_off_read:read_stl",
    ".off": "mistyle.io.meshes.stl_off_read:read_off",
    ".glb": "mistyle.io.gltf.read:read_gltf",
    ".gltf": "mistyle.io.gltf.read:read_gltf",
    ".usd": "mistyle.io.usd.read:read_usd",
    ".usda": "mistyle.io.usd.read:read_usd",
    ".usdc": "mistyle.io.usd.read:read_usd",
    ".usdz": "mistyle.io.usd.read:read_usd",
}
"""Readers of mesh files by their ending: "module:function" of (path: Path, max_faces: int) -> a record of
io/meshes/parsed_mesh.py.

The function runs in the reader process, which imports its module then: it refuses with InputRefused, opens other files
only through io/sandbox/bounds.py (`read_bytes`, `beside`), checks indices and positions (io/meshes/polygons.py), and
leaves its textures to `RawMaterial.load`, which is called there for every tile. A new format is one more line here.
"""


def read_mesh(
    path: Path,
    *,
    uv: Literal["keep", "new", "auto"] = "auto",
    up: UpAxis = "y",
    max_faces: int = 5_000_000,
    size: int = 2048,
    lit: bool = False,
    progress: Callable[[float], None] = lambda done: None,
) -> Asset:
    """A mesh file as an asset: vertex and face order as in the file, bounding sphere of radius 1, Y up.

    uv        "auto" keeps authored UVs where they can be painted and unwraps the materials with none or unusable ones;
              "keep" refuses those; "new" unwraps every material
    up        the axis of the file that points up; other than "y", the mesh is turned
    max_faces refuses larger meshes (and more than three times as many vertices)
    size      the atlas size for the padding of a new unwrapping
    lit       a glTF result drops KHR_materials_unlit from its painted materials
    progress  receives the share done, 0..1, after each material's UVs, while unwrapping and after each material's maps

    OBJ, PLY, STL, OFF, GLB, glTF and USD, each without merging or reordering vertices (STL, which repeats them, is
    welded, with a note). Polygons become triangles in place. Missing normals are computed within creases of 50 degrees
    (glTF: flat, as it demands). One part per material and UDIM tile. Texture transforms, wrap modes and vertex colours
    are resolved: the maps repeat at the mesh's UVs, the albedo has the colours in it. Morph targets
    have the file's own weights, a skinned mesh the pose of its joints. Not read: animations, Draco and meshopt
    compression without a plain copy (refused).
    """
    from mistyle.io.meshes.prepare import prepare

    path = Path(path)
    asset = prepare(_raw(path, max_faces), path, uv, up, size, progress)
    return replace(asset, source=replace(asset.source, lit=lit)) if lit else asset


def _raw(path: Path, max_faces: int) -> Raw:
    """The parsed file, checked."""
    kind = path.suffix.lower()
    if kind not in MESHES:
        found = f"a file ending in '{kind}'" if kind else "a file without an ending"
        raise refuse(path, found, f"one of {' '.join(MESHES)}", "Export the mesh as .glb or .obj")
    from mistyle.io.meshes.polygons import check_indices

    raw = spelled(ask("mesh", path, MESHES[kind], max_faces, more=partial(_others, path)))
    check_indices(raw.faces, len(raw.positions), path, "vertex")
    return raw


def _others(path: Path) -> list[Path]:
    """The other files that a mesh file names."""
    if path.suffix.lower() not in USD:
        return read_references(path)
    return [file for file in read_usd_files(path) if file != real_path(path)]


def read_extent(
    path: Path,
    *,
    uv: Literal["keep", "new", "auto"] = "auto",
    up: UpAxis = "y",
    max_faces: int = 5_000_000,
    size: int = 2048,
) -> Extent:
    """The size of `read_mesh`'s asset: its faces, texture sets and own maps; nothing is unwrapped."""
    from mistyle.io.meshes.prepare import extent

    path = Path(path)
    return extent(_raw(path, max_faces), path, uv, up, size)


def read_usd_files(path: Path) -> list[Path]:
    """The files that a USD file depends on: its layers, packages, documents and textures."""
    return [Path(file) for file in ask("usd_files", Path(path))]


def load_gltf(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    """The JSON and the buffers of a .glb or .gltf file, checked: see io/gltf/check.py."""
    tree, buffers = ask("gltf", Path(path))
    return tree, buffers


def read_gltf_alpha(path: Path, image: int) -> Float[np.ndarray, "h w"] | None:
    """The alpha (0..1, row 0 at the top) of image number `image` of a glTF file; None where it has none or is
    opaque."""
    return ask("gltf_alpha", Path(path), image)


def read_references(path: Path) -> list[Path]:
    """The files beside an .obj or .gltf file that it names and that exist, resolved and in order; see
    io/sandbox/references.py."""
    return ask("references", Path(path))
