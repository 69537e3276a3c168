"""The only reader of meshes and images: everything a user or a stranger hands in passes through here, bounded.

What cannot be used is refused (core/errors.py InputRefused) with the file, what was found, what was expected and the
fix. Nothing is fetched from a network, nothing outside a mesh's own folder is opened but pictures in the folder
`textures` beside it, and nothing is repaired in silence: what was changed on the way in is in `Source.notes` and
`Picture.notes`.

Files are opened and decoded in the reader process (files/reader_process.py), which has limits on memory and time and
cannot write; here only the numbers that it found are put together. A Mitsuba scene of the user's (`--scene`) is not
read here: it can name any file and plugin and is trusted like code.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, Picture, Pixels
from mistyle.files.bounds import refuse
from mistyle.files.layers import LayeredPicture, frame_of
from mistyle.files.pictures import picture_of
from mistyle.files.raw import Extent, Raw, spelled
from mistyle.files.reader_process import ask

__all__ = [
    "MESHES",
    "LayeredPicture",
    "Picture",
    "load_gltf",
    "read_colmap",
    "read_colmap_points",
    "read_exr",
    "read_extent",
    "read_frame",
    "read_gltf_alpha",
    "read_hdr",
    "read_json",
    "read_mesh",
    "read_npy",
    "read_picture",
    "read_radiance",
    "read_references",
    "read_size",
    "read_stored_size",
    "read_toml",
    "read_usd_files",
    "read_yaml",
    "shrink_picture",
]

MESHES = {
    ".obj": "mistyle.files.obj_read:read_obj",
    ".ply": "mistyle.files.ply_read:read_ply",
    ".stl": "mistyle.files.mesh_formats:read_stl",
    ".off": "mistyle.files.mesh_formats:read_off",
    ".glb": "mistyle.files.gltf_read:read_gltf",
    ".gltf": "mistyle.files.gltf_read:read_gltf",
    ".usd": "mistyle.files.usd_read:read_usd",
    ".usda": "mistyle.files.usd_read:read_usd",
    ".usdc": "mistyle.files.usd_read:read_usd",
    ".usdz": "mistyle.files.usd_read:read_usd",
}
"""Who reads a mesh file, by its ending: "module:function" of (path: Path, max_faces: int) -> what files/raw.py has.

The function runs in the reader process, which imports its module then: it refuses with InputRefused, opens other files
only through files/bounds.py (`read_bytes`, `beside`), checks indices and positions (files/polygons.py), and leaves its
textures to `RawMaterial.load`, which is called there for every tile. A new format is one more line here.
"""


def read_mesh(
    path: Path,
    *,
    uv: Literal["keep", "new", "auto"] = "auto",
    up: Literal["y", "z"] = "y",
    max_faces: int = 5_000_000,
    size: int = 2048,
    lit: bool = False,
    progress: Callable[[float], None] = lambda done: None,
) -> Asset:
    """A mesh file as an asset: vertex and face order as in the file, bounding sphere of radius 1, Y up.

    uv        "auto" keeps authored UVs where they can be painted and unwraps the materials that have none or unusable
              ones; "keep" refuses those; "new" unwraps every material
    up        "z" turns a mesh modelled with Z up
    max_faces refuses larger meshes (and more than three times as many vertices)
    size      the atlas size that a new unwrapping's padding is meant for
    lit       writing a glTF result takes KHR_materials_unlit from its painted materials
    progress  hears a share of 1; reading takes the first tenth, unwrapping most of the rest

    OBJ, PLY, STL, OFF, GLB, glTF and USD, each without merging or reordering vertices (STL, which repeats them, is
    joined and says so). Polygons become triangles in place. Missing normals are computed within creases of 50 degrees
    (glTF: flat, as it demands). One part per material and UDIM tile. Texture transforms, wrap modes and vertex colours
    are resolved: the maps repeat at the mesh's UVs, the albedo has the colours in it. Morph targets
    stand at the file's own weights, a skinned mesh in the pose of its joints. Not read: animations, Draco and meshopt
    compression without a plain copy (refused).
    """
    from mistyle.files.prepare import prepare

    path = Path(path)
    asset = prepare(_raw(path, max_faces), path, uv, up, size, progress)
    return replace(asset, source=replace(asset.source, lit=lit)) if lit else asset


def _raw(path: Path, max_faces: int) -> Raw:
    """What the file says, checked."""
    kind = path.suffix.lower()
    if kind not in MESHES:
        found = f"a file ending in '{kind}'" if kind else "a file without an ending"
        raise refuse(path, found, f"one of {' '.join(MESHES)}", "Export the mesh as .glb or .obj")
    from mistyle.files.polygons import check_indices

    raw = spelled(ask("mesh", path, MESHES[kind], max_faces))
    check_indices(raw.faces, len(raw.positions), path, "vertex")
    return raw


def read_extent(
    path: Path, *, uv: Literal["keep", "new", "auto"] = "auto", max_faces: int = 5_000_000, size: int = 2048
) -> Extent:
    """How large the asset of `read_mesh` will be: its faces, texture sets and own maps; nothing is unwrapped."""
    from mistyle.files.prepare import extent

    path = Path(path)
    return extent(_raw(path, max_faces), path, uv, size)


def read_usd_files(path: Path) -> list[Path]:
    """The files that a USD file stands on: its layers, packages and textures, as far as they are in its folder."""
    return [Path(file) for file in ask("usd_files", Path(path))]


def load_gltf(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    """The JSON and the buffers of a .glb or .gltf file, checked: see files/gltf_check.py."""
    tree, buffers = ask("gltf", Path(path))
    return tree, buffers


def read_gltf_alpha(path: Path, image: int) -> Float[np.ndarray, "h w"] | None:
    """The alpha (0..1, row 0 at the top) of a glTF file's image of that number; None where it has none or is opaque."""
    return ask("gltf_alpha", Path(path), image)


def read_exr(path: Path) -> dict[str, Float[np.ndarray, "h w"]]:
    """The channels of an OpenEXR file by full name ("R", "normal.X"), float32, display window, row 0 at the top.

    The header is checked before anything is decoded: windows, number of channels, texels. Of a file with several parts
    all are read, their names before the channels'. Deep files and subsampled channels are refused.
    """
    return {name: np.asarray(plane, np.float32) for name, plane in ask("exr", Path(path)).items()}


def read_frame(path: Path) -> LayeredPicture:
    """A picture to compare: the layers of an .exr (of all its parts, whatever their windows) by name, or the one layer
    of an .hdr, PNG, JPEG, WebP or TIFF; linear Rec.709, premultiplied, NaN and infinities kept.

    Checked like `read_exr` and `read_picture`: header first, bounded. Two layers of one name are refused.
    """
    path = Path(path)
    return ask("frame", path) if path.suffix.lower() in (".exr", ".hdr") else frame_of(read_picture(path))


def read_hdr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """A Radiance .hdr file: linear Rec.709 radiance, float32, row 0 at the top."""
    return ask("hdr", Path(path))


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file of at most 64 MiB, nested at most 128 deep, without NaN or Infinity."""
    return ask("json", Path(path))


def shrink_picture(path: Path, data: bytes, longest: int, quality: int) -> tuple[bytes, str]:
    """The picture in `data`, embedded in the file at `path`, as a JPEG (PNG with transparency) of at most `longest`
    pixels on a side: its bytes and MIME type."""
    return ask("shrink", Path(path), data, longest, quality)


def read_references(path: Path) -> list[Path]:
    """The files beside an .obj or .gltf file that it names and that exist, resolved and in order; see
    files/references.py."""
    return ask("references", Path(path))


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file of at most 4 MiB; dates and times, which no setting has, are refused."""
    return ask("toml", Path(path))


def read_yaml(path: Path) -> Any:
    """The numbers, texts, lists and tables of a YAML file of at most 4 MiB; objects and dates are refused."""
    return ask("yaml", Path(path))


def read_npy(path: Path) -> np.ndarray:
    """The array of numbers in an .npy file; files of objects and damaged ones are refused."""
    return ask("npy", Path(path))


def read_picture(path: Path, pixels: Pixels = "upright") -> Picture:
    """A style or any other picture file as sRGB-encoded float32 0..1; see files/pictures.py."""
    return picture_of(Path(path), ask("picture", Path(path), pixels))


def read_radiance(path: Path) -> Float[np.ndarray, "h w 3"]:
    """An environment map: linear Rec.709 radiance >= 0 of an .exr (its R, G, B) or .hdr, row 0 at the top."""
    return ask("radiance", Path(path))


def read_size(path: Path, pixels: Pixels = "upright") -> tuple[int, int]:
    """Height and width of a picture (EXIF orientation applied unless "stored") or an .exr (display window), from its
    header alone."""
    height, width, orientation = read_stored_size(path)
    return (width, height) if pixels == "upright" and orientation > 4 else (height, width)


def read_stored_size(path: Path) -> tuple[int, int, int]:
    """Height and width of the pixels that a picture file stores, and its EXIF orientation 1..8 (1: none)."""
    height, width, orientation = ask("size", Path(path))
    return height, width, orientation


def read_colmap(folder: Path) -> list[Any]:
    """The registered images of a COLMAP model as files/cameras.py Frames; see files/colmap.py `read_model`."""
    return ask("colmap_model", Path(folder))


def read_colmap_points(folder: Path) -> Any:
    """The points of a COLMAP model (files/colmap.py SparsePoints), or None where it has no points3D file."""
    return ask("colmap_points", Path(folder))
