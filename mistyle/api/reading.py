"""Meshes, cameras, lights and pictures from files into records."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures
from mistyle.core.light import Lights
from mistyle.core.view import View


def read_mesh(
    path: str | PathLike,
    *,
    uv: Literal["keep", "new", "auto"] = "auto",
    up: Literal["y", "z"] = "y",
    size: int = 2048,
    max_faces: int = 5_000_000,
) -> Asset:
    """A mesh file as an asset: `asset.mesh` in working space, `asset.materials`, and `asset.source.notes`.

    Reads OBJ, PLY, STL, OFF, GLB, glTF and USD. The mesh is moved and scaled: Y up, bounding sphere of radius 1 about
    the origin; `asset.source.work_from_user` (4, 4) is that motion. The order of vertices and faces stays.

    uv         "auto" unwraps materials without usable UVs; "keep" refuses those; "new" unwraps every material
    up         "z" turns a mesh that was modelled with Z up
    size       texels along a side of the atlas that a new unwrapping is meant for
    max_faces  larger meshes are refused

    Raises InputRefused for files that cannot be used. Animations are not read.
    """
    from mistyle.io.read_mesh import read_mesh as read

    return read(Path(path), uv=uv, up=up, size=size, max_faces=max_faces)


def read_cameras(path: str | PathLike, size: tuple[int, int] = (1024, 1024)) -> list[Camera]:
    """The pinhole cameras of a camera.json or transforms.json, in working units.

    `size` (height, width) in pixels holds where a transforms.json does not say. Raises InputRefused for lens
    distortion, unequal focal lengths and matrices that are not rigid motions.
    """
    from mistyle.io.cameras.camera_files import read_cameras as read

    return read(Path(path), size)


def read_lights(path: str | PathLike) -> Lights:
    """The common lights of a lights.json (or of the one in a folder): linear Rec.709, in the cameras' world.

    Lists of single views are not looked at; `read_captures` reads those. Raises InputRefused.
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
    """Photographs or renders with known cameras and lights: what `recover` fits to.

    path        a folder with a camera.json, a transforms.json or a COLMAP model; cameras and headers are read now,
                pixels when they are asked for
    asset       the mesh that the pictures show: cameras in its file's own units are moved into working space. Without
                it they stay in the space of the file
    lights      a lights.json; None: the one beside the cameras
    masks       a folder with a picture of the same name for each view; bright pixels count
    exposure    factor or stops by view, or a JSON file of them; radiance is divided by it
    pictures    the folder of the pictures, where they are elsewhere
    saturation  encoded value 0..1 from which a channel counts as saturated

    `captures.load(k)` gives linear Rec.709 radiance (h, w, 3) and which pixels count (h, w). Cameras that stand in an
    unrelated space are not aligned here: `mistyle.fit(..., references={"align": True})` does that. Raises
    InputRefused.
    """
    from mistyle.geometry.similarity import moved
    from mistyle.io.cameras.captures import camera_space
    from mistyle.io.cameras.captures import read_captures as read

    def place(given: str | PathLike | None) -> Path | None:
        return None if given is None else Path(given)

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

    `view.rgb` is linear Rec.709 and premultiplied. Edited PNGs take the place of the EXRs beside them. Raises
    InputRefused.
    """
    from mistyle.io.cameras.views import read_views as read

    return read(Path(folder))


def read_picture(path: str | PathLike) -> Float[np.ndarray, "h w 3"]:
    """The colours of an EXR, HDR, PNG, JPEG, WebP or TIFF: linear Rec.709, premultiplied, float32, row 0 at the top.

    Of an EXR with several layers it is the beauty layer. Raises InputRefused where there is none.
    """
    from mistyle.io.read import read_frame
    from mistyle.io.sandbox.bounds import refuse

    frame = read_frame(Path(path))
    layer = next((layer for layer in frame.layers if layer.kind == "colour"), None)
    if layer is None:
        there = ", ".join(layer.name for layer in frame.layers)
        raise refuse(Path(path), f"layers {there}", "a layer of colours (R, G, B)", "Write the colours as R, G, B")
    return layer.values()
