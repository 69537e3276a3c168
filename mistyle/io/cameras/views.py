"""Folders of views: writer, and reader of our own, edited and foreign folders.

`<name>.exr` holds the reference data, float32, linear Rec.709, row 0 at the top:

    R G B               linear, premultiplied by A
    A                   coverage, 0..1
    depth.Z             metric z in the camera at the pixel's centre, infinite off the mesh
    normal.X .Y .Z      world space, unit
    uv.U uv.V           v up
    part.index          texture set, -1 off the mesh

`<name>.png` is the same picture for viewing and painting: sRGB, 8 bit, straight alpha (the coverage). `camera.json` and
`transforms.json` hold the cameras (io/cameras/camera_files.py), `lights.json` the lights (core/light.py). With
`paper_files` also `<name>_depth.png` (foreground-normalised, near white, background black) and `<name>_canny.png`
(thresholds 100/200).
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera, resized
from mistyle.core.errors import InputRefused
from mistyle.core.image import canny, linear_from_srgb, srgb_from_linear
from mistyle.core.light import Lights, from_json, to_json
from mistyle.core.paths import real_path
from mistyle.core.view import View
from mistyle.io.cameras.camera_files import (
    PIXELS,
    SPACE,
    ViewEntry,
    camera_entry,
    read_cameras,
    read_entries,
    transforms,
)
from mistyle.io.cameras.picture_files import COPY
from mistyle.io.images.write import encode_png, write_exr, write_png
from mistyle.io.read import read_exr, read_json, read_picture, read_radiance
from mistyle.io.sandbox.bounds import inside, refuse
from mistyle.io.store.atomic import atomic_write, sha256_file
from mistyle.process import memory

__all__ = ["read_cameras", "read_lights", "read_views", "write_views"]

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
GEOMETRY = ("depth.Z", "normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "part.index")


def write_views(
    folder: Path,
    views: Sequence[View],
    lights: Lights,
    *,
    paper_files: bool = False,
    progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Write views, their cameras and the lights into `folder` (made if needed); names come from the cameras.

    Raises ValueError where two cameras share a name.
    """
    names = [view.camera.name for view in views]
    if len(set(names)) < len(names):
        raise ValueError(f"views need different names; found {', '.join(sorted(names))}")
    entries = []
    for k, view in enumerate(views):
        entries.append(_write_view(folder, view, paper_files))
        progress((k + 1) / len(views))
    _write_json(folder / "camera.json", {"version": 1, "space": SPACE, "views": entries})
    _write_json(folder / "transforms.json", transforms([v.camera for v in views], [f"./{name}.png" for name in names]))
    _write_json(folder / "lights.json", to_json(lights))


def file_names(names: Sequence[str], paper_files: bool) -> list[str]:
    """The files that `write_views` writes for views of these names."""
    endings = [".exr", ".png", *(["_depth.png", "_canny.png"] if paper_files else [])]
    return ["camera.json", "transforms.json", "lights.json", *(f"{name}{e}" for name in names for e in endings)]


def _write_view(folder: Path, view: View, paper_files: bool) -> dict[str, Any]:
    name = view.camera.name
    write_exr(folder / f"{name}.exr", channels(view))
    png = encode_png(straight_srgb(view))
    atomic_write(folder / f"{name}.png", png)
    if paper_files:
        write_png(folder / f"{name}_depth.png", paper_depth(view.depth))
        write_png(folder / f"{name}_canny.png", canny(srgb_from_linear(view.rgb)).astype(np.float32))
    files = {"exr": f"{name}.exr", "png": f"{name}.png", "png_sha256": hashlib.sha256(png).hexdigest()}
    return {**camera_entry(view.camera, view.depth), **files}


def channels(view: View) -> dict[str, np.ndarray]:
    """The EXR's channels of a view."""
    planes = {**dict(zip("RGB", np.moveaxis(view.rgb, -1, 0), strict=True)), "A": view.coverage, "depth.Z": view.depth}
    planes |= {f"normal.{axis}": view.normal[..., k] for k, axis in enumerate("XYZ")}
    planes |= {"uv.U": view.uv[..., 0], "uv.V": view.uv[..., 1], "part.index": view.part.astype(np.float32)}
    return planes


def straight_srgb(view: View) -> Float[np.ndarray, "h w 4"]:
    """sRGB-encoded straight colour and coverage, for painting programs."""
    colour = view.rgb / np.maximum(view.coverage, 1e-6)[..., None]
    return np.concatenate([srgb_from_linear(colour), view.coverage[..., None]], axis=-1).astype(np.float32)


def paper_depth(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Paper 4.1.1: depth over the foreground's range, nearest 1, farthest 0, background 0; constant depth gives 1.

    In 8 bits it suits only the conditioning of a network: its steps move points by pixels between views.
    """
    seen = np.isfinite(depth)
    if not seen.any():
        return np.zeros_like(depth)
    near, far = depth[seen].min(), depth[seen].max()
    span = far - near if far > near else 1.0
    return np.where(seen, 1 - (np.where(seen, depth, near) - near) / span, 0.0).astype(np.float32)


def read_lights(path: Path) -> Lights:
    """A `lights.json`, or the one in a folder of views."""
    path = Path(path)
    file = path / "lights.json" if path.is_dir() else path
    return from_json(read_json(file), str(file), lambda name: read_radiance(inside(file.parent, name, file, COPY)))


def is_lit(folder: Path) -> bool:
    """Whether a folder of views has a `lights.json` that lists at least one light; a file that is none says nothing."""
    file = Path(folder) / "lights.json"
    try:
        data = read_json(file) if file.is_file() else {}
    except InputRefused:
        return False
    return isinstance(data, dict) and bool(data.get("lights") or data.get("views"))


def read_views(folder: Path) -> list[View]:
    """The views of a folder with a `camera.json` (or `transforms.json`) and a picture per view, in the file's order.

    A view's colours come from `<name>.exr`. A `<name>.png` (or .jpg, .webp, .tif) that was edited or added since we
    wrote the folder (camera.json has the PNG's sha256) takes precedence. A foreign folder needs one picture per view.
    Alpha is the mask. Where an EXR has the geometry layers, depth, normal, uv and part are read. Else they must be
    traced from the mesh: depth is infinite, normal and uv are zero, part is -1, and the mask is the alpha's (full
    without one). A picture of another size but the same aspect ratio moves the camera to that size; the EXR's geometry
    is then not used.
    """
    folder = Path(folder)
    cameras = _entries(folder)
    return [memory.away(_read_view(folder, camera, entry)) for camera, entry in cameras]


def view_cameras(folder: Path) -> list[Camera]:
    """The cameras of the views that `read_views` would read."""
    return [camera for camera, _ in _entries(folder)]


def _entries(folder: Path) -> list[tuple[Camera, ViewEntry | None]]:
    if (folder / "camera.json").is_file():
        return list(read_entries(folder / "camera.json"))
    if (folder / "transforms.json").is_file():
        return [(camera, None) for camera in read_cameras(folder / "transforms.json")]
    fix = "`mistyle render MESH -o DIR` writes such a folder"
    raise refuse(folder, "neither camera.json nor transforms.json", "a folder of views with their cameras", fix)


def _read_view(folder: Path, camera: Camera, entry: ViewEntry | None) -> View:
    exr = folder / f"{camera.name}.exr"
    if entry is not None and entry.exr is not None:
        exr = inside(folder, entry.exr, folder / "camera.json", COPY)
    planes = read_exr(exr) if exr.is_file() else {}
    if planes and not {"R", "G", "B"} <= set(planes):
        raise refuse(exr, f"channels {', '.join(sorted(planes))[:200]}", "R, G and B", "Write the colours as R, G, B")
    picture = picture_of_view(folder, camera, entry, exr if planes else None)
    if picture is None:
        return _view(camera, _stack(planes, "R", "G", "B"), planes.get("A"), planes, exr)
    # Without an entry the camera is of a transforms.json, which describes stored pixels (io/cameras/camera_files.py).
    decoded = read_picture(picture, PIXELS if entry is not None else "stored")
    linear = linear_from_srgb(decoded.rgb)
    shape = decoded.rgb.shape[:2]
    if shape != camera.size:
        planes = {}
    alpha = decoded.alpha if decoded.alpha is not None else planes.get("A")
    return _view(camera, linear if alpha is None else linear * alpha[..., None], alpha, planes, picture)


def picture_of_view(
    folder: Path, camera: Camera, entry: ViewEntry | None, exr: Path | None, fix: str = COPY
) -> Path | None:
    """The picture that replaces the view's EXR, or None. `fix` is the advice where the entry names a picture outside
    the folder."""
    existing = [path for ending in PICTURES if (path := folder / f"{camera.name}{ending}").is_file()]
    if entry is not None and entry.png is not None:
        named = inside(folder, entry.png, folder / "camera.json", fix)
        if named.is_file() and named not in [real_path(path) for path in existing]:
            existing.append(named)
    written = entry.png_sha256 if entry is not None else None
    edited = [path for path in existing if path.suffix != ".png" or sha256_file(path) != written]
    if exr is not None and written is None:
        return None
    candidates = edited or ([] if exr is not None else existing)
    if len(candidates) > 1:
        names = ", ".join(path.name for path in candidates)
        raise refuse(folder, f"{names} for the view '{camera.name}'", "one picture per view", "Keep one of them")
    if not candidates and exr is None:
        found = f"no picture for the view '{camera.name}'"
        raise refuse(folder, found, f"{camera.name}.exr, .png or .jpg", "Add it, or take the view out of camera.json")
    return candidates[0] if candidates else None


def _view(
    camera: Camera,
    rgb: Float[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"] | None,
    planes: Mapping[str, np.ndarray],
    path: Path,
) -> View:
    height, width = rgb.shape[:2]
    if (height, width) != camera.size:
        if height * camera.size[1] != width * camera.size[0]:
            expected = f"{camera.size[1]} x {camera.size[0]} by camera.json, or that aspect ratio"
            raise refuse(path, f"{width} x {height} pixels", expected, "Do not crop or stretch the picture")
        camera = resized(camera, (height, width))
    if not np.isfinite(rgb).all():
        raise refuse(path, "NaN or infinity in the colours", "finite colours", "Render or paint it again")
    coverage = np.ones((height, width), np.float32) if alpha is None else np.clip(alpha, 0, 1).astype(np.float32)
    if set(GEOMETRY) <= set(planes):
        depth = planes["depth.Z"]
        mask: Bool[np.ndarray, "h w"] = np.isfinite(depth)
        if alpha is not None and alpha is not planes.get("A"):
            mask = mask & (coverage > 0.5)
        part = np.where(mask, planes["part.index"], -1).astype(np.int32)
        normal, uv = _stack(planes, "normal.X", "normal.Y", "normal.Z"), _stack(planes, "uv.U", "uv.V")
        return View(camera, rgb.astype(np.float32), depth, normal, uv, part, mask, coverage)
    return View(
        camera=camera,
        rgb=rgb.astype(np.float32),
        depth=np.full((height, width), np.inf, np.float32),
        normal=np.zeros((height, width, 3), np.float32),
        uv=np.zeros((height, width, 2), np.float32),
        part=np.full((height, width), -1, np.int32),
        mask=coverage > 0.5,
        coverage=coverage,
    )


def _stack(planes: Mapping[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([planes[name] for name in names], axis=-1)


def _write_json(path: Path, data: Any) -> None:
    atomic_write(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())
