"""The only reader of meshes and images: everything a user or a stranger hands in passes through here, bounded.

What cannot be used is refused (core/errors.py InputRefused) with the file, what was found, what was expected and the
fix. Nothing is fetched from a network, nothing outside a mesh's own folder is opened, and nothing is repaired in
silence: what was changed on the way in is in `Source.notes` and `Picture.notes`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, Picture
from mistyle.files.bounds import refuse
from mistyle.files.gltf_check import load_gltf, read_json
from mistyle.files.layers import Frame
from mistyle.files.pictures import read_picture

__all__ = [
    "Frame",
    "Picture",
    "load_gltf",
    "read_exr",
    "read_frame",
    "read_hdr",
    "read_json",
    "read_mesh",
    "read_npy",
    "read_picture",
    "read_radiance",
    "read_size",
]

MESHES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")


def read_mesh(
    path: Path,
    *,
    uv: Literal["keep", "new", "auto"] = "auto",
    up: Literal["y", "z"] = "y",
    max_faces: int = 5_000_000,
    size: int = 2048,
    progress: Callable[[float], None] = lambda done: None,
) -> Asset:
    """A mesh file as an asset: vertex and face order as in the file, bounding sphere of radius 1, Y up.

    uv        "auto" keeps authored UVs where they can be painted and unwraps the materials that have none or unusable
              ones; "keep" refuses those; "new" unwraps every material
    up        "z" turns a mesh modelled with Z up
    max_faces refuses larger meshes (and more than three times as many vertices)
    size      the atlas size that a new unwrapping's padding is meant for
    progress  hears a share of 1; reading takes the first tenth, unwrapping most of the rest

    OBJ, PLY, STL, OFF, GLB and glTF, each without merging or reordering vertices (STL, which repeats them, is joined
    and says so). Polygons become triangles in place. Missing normals are computed within creases of 50 degrees (glTF:
    flat, as it demands). One part per material and UDIM tile. Not read: vertex colours, morph targets (the base shape
    is), animations (a skinned mesh comes in its bind pose), Draco and meshopt compression (refused).
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in MESHES:
        found = f"a file ending in '{kind}'" if kind else "a file without an ending"
        raise refuse(path, found, f"one of {' '.join(MESHES)}", "Export the mesh as .glb or .obj")
    if kind in (".glb", ".gltf"):
        from mistyle.files.gltf_read import read_gltf as reader
    elif kind == ".obj":
        from mistyle.files.obj_read import read_obj as reader
    else:
        from mistyle.files import mesh_formats

        reader = {".ply": mesh_formats.read_ply, ".stl": mesh_formats.read_stl, ".off": mesh_formats.read_off}[kind]
    from mistyle.files.prepare import prepare

    raw = reader(path, max_faces)
    if len(raw.faces) == 0:
        raise refuse(path, "no triangles", "at least one", "Export the mesh with its faces")
    return prepare(raw, path, uv, up, size, progress)


def read_exr(path: Path) -> dict[str, Float[np.ndarray, "h w"]]:
    """The channels of an OpenEXR file by full name ("R", "normal.X"), float32, display window, row 0 at the top.

    The header is checked before anything is decoded: windows, number of channels, texels. Of a file with several parts
    all are read, their names before the channels'. Deep files and subsampled channels are refused.
    """
    from mistyle.files.hdr import read_exr as read

    return read(Path(path))


def read_frame(path: Path) -> Frame:
    """A picture to compare: the layers of an .exr (of all its parts, whatever their windows) by name, or the one layer
    of an .hdr, PNG, JPEG, WebP or TIFF; linear Rec.709, premultiplied, NaN and infinities kept.

    Checked like `read_exr` and `read_picture`: header first, bounded. Two layers of one name are refused.
    """
    from mistyle.files.layers import read_frame as read

    return read(Path(path))


def read_hdr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """A Radiance .hdr file: linear Rec.709 radiance, float32, row 0 at the top."""
    from mistyle.files.hdr import read_hdr as read

    return read(Path(path))


def read_npy(path: Path) -> np.ndarray:
    """The array of numbers in an .npy file; files of objects and damaged ones are refused."""
    import io

    from mistyle.files.bounds import read_bytes

    path = Path(path)
    data = read_bytes(path)
    try:
        found = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, OSError, EOFError, KeyError, TypeError, MemoryError, OverflowError) as error:
        raise refuse(path, f"no array ({str(error)[:100]})", "an .npy file of numbers", "Write it again") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiub":
        raise refuse(path, f"{getattr(found, 'dtype', type(found).__name__)}", "an array of numbers", "Write it again")
    return found


def read_radiance(path: Path) -> Float[np.ndarray, "h w 3"]:
    """An environment map: linear Rec.709 radiance >= 0 of an .exr (its R, G, B) or .hdr, row 0 at the top."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".exr", ".hdr"):
        raise refuse(path, f"a file ending in '{kind}'", "an .exr or .hdr environment map", "Convert it to one of them")
    if kind == ".hdr":
        return read_hdr(path)
    planes = read_exr(path)
    if not {"R", "G", "B"} <= set(planes):
        raise refuse(path, f"channels {', '.join(sorted(planes))[:200]}", "R, G and B", "Write the colours as R, G, B")
    radiance = np.stack([planes[c] for c in "RGB"], axis=-1)
    if not np.isfinite(radiance).all() or radiance.min() < 0:
        raise refuse(path, "radiance that is negative, NaN or infinite", "finite radiance >= 0", "Write it again")
    return radiance


def read_size(path: Path) -> tuple[int, int]:
    """Height and width of a picture (EXIF orientation applied) or an .exr (display window), from its header alone."""
    path = Path(path)
    if not path.is_file():
        raise refuse(path, "nothing", "a picture", "Check the path")
    if path.suffix.lower() == ".exr":
        from mistyle.files.hdr import size_of_exr as size_of
    else:
        from mistyle.files.pictures import size_of_picture as size_of
    return size_of(path)
