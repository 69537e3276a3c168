"""Readers of meshes, cameras, lights and pictures, which return records."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset, UpAxis
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures
from mistyle.core.light import Lights
from mistyle.core.view import View


def read_mesh(
    path: str | PathLike,
    *,
    uv: Literal["keep", "new", "auto"] = "auto",
    up: UpAxis = "y",
    size: int = 2048,
    max_faces: int = 5_000_000,
) -> Asset:
    """A mesh file as an asset: `asset.mesh` in working space, `asset.materials`, and `asset.source.notes`.

    Reads OBJ, PLY, STL, OFF, GLB, glTF and USD. The mesh is moved and scaled: Y up, bounding sphere of radius 1 about
    the origin; `asset.source.work_from_user` (4, 4) is that transform. The order of vertices and faces stays.

    uv         "auto" unwraps materials without usable UVs; "keep" refuses those; "new" unwraps every material
    up         the axis of the file that points up; other than "y", the mesh is rotated
    size       texels a side of the atlas of a new unwrapping
    max_faces  larger meshes are refused

    Raises InputRefused for unusable files. Animations are not read.
    """
    from mistyle.io.read_mesh import read_mesh as read

    return read(Path(path), uv=uv, up=up, size=size, max_faces=max_faces)


def read_cameras(path: str | PathLike, size: tuple[int, int] = (1024, 1024)) -> list[Camera]:
    """The pinhole cameras of a camera.json or transforms.json, in working units.

    `size` (height, width) in pixels is the default of a transforms.json without one. Raises InputRefused for lens
    distortion, unequal focal lengths and matrices that are not rigid transforms.
    """
    from mistyle.io.cameras.camera_files import read_cameras as read

    return read(Path(path), size)


def read_lights(path: str | PathLike) -> Lights:
    """The common lights of a lights.json (or of the one in a folder): linear Rec.709, in the cameras' world.

    Lists of single views are ignored; `read_captures` reads those. Raises InputRefused.
    """
    from mistyle.io.cameras.views import read_lights as read

    return read(Path(path))


def read_captures(
    path: str | PathLike,
    asset: Asset | None = None,
    *,
    lights: str | PathLike | None = None,
    masks: str | PathLike | None = None,
    exposure: str | PathLike | Mapping[str, float] | None = None,
    pictures: str | PathLike | None = None,
    saturation: float = 1.0,
) -> Captures:
    """Photographs or renders with known cameras and lights: the references of `recover`.

    path        a folder with a camera.json, a transforms.json or a COLMAP model; cameras and headers are read now,
                pixels on demand
    asset       the mesh in the pictures: cameras in its file's own units are converted to working space. Without it
                they stay in the space of the file
    lights      a lights.json; None: the one beside the cameras
    masks       a folder with a picture of the same name for each view; bright pixels are valid
    exposure    factor or stops by view, or a JSON file of them; radiance is divided by it
    pictures    the folder of the pictures, if it is another one
    saturation  least encoded value of a saturated channel, 0..1

    `captures.load(k)` gives linear Rec.709 radiance (h, w, 3) and the mask of valid pixels (h, w). Cameras in an
    unrelated space are not aligned: `mistyle.fit(..., references={"align": True})` aligns them. Raises InputRefused.
    """
    from mistyle.geometry.similarity import moved
    from mistyle.io.cameras.captures import camera_space
    from mistyle.io.cameras.captures import read_captures as read

    def place(path: str | PathLike | None) -> Path | None:
        return None if path is None else Path(path)

    factors = exposure if exposure is None or isinstance(exposure, Mapping) else Path(exposure)
    captures = read(
        Path(path),
        lights=place(lights),
        masks=place(masks),
        exposure=factors,
        pictures=place(pictures),
        saturation=saturation,
    )
    own = asset is not None and camera_space(Path(path)) == "own"
    return moved(captures, asset.source.work_from_user) if own and asset is not None else captures


def read_views(folder: str | PathLike) -> list[View]:
    """The views of a folder with a camera.json and a picture for each, as `mistyle render` writes it.

    `view.rgb` is linear Rec.709 and premultiplied. Edited PNGs replace the EXRs of the same name. Raises InputRefused.
    """
    from mistyle.io.cameras.views import read_views as read

    return read(Path(folder))


def read_picture(path: str | PathLike) -> Float[np.ndarray, "h w 3"]:
    """The colours of an EXR, HDR, PNG, JPEG, WebP or TIFF: linear Rec.709, premultiplied, float32, row 0 at the top.

    An EXR with several layers gives its beauty layer. Raises InputRefused without a colour layer.
    """
    from mistyle.io.read import read_frame
    from mistyle.io.sandbox.bounds import refuse

    frame = read_frame(Path(path))
    layer = next((layer for layer in frame.layers if layer.kind == "colour"), None)
    if layer is None:
        present = ", ".join(layer.name for layer in frame.layers)
        raise refuse(Path(path), f"layers {present}", "a layer of colours (R, G, B)", "Write the colours as R, G, B")
    return layer.values()
