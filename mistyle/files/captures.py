"""Photographs or renders with known cameras, as others keep them, read as the references of a fit.

A folder with our `camera.json` (files/cameras.py), a NeRF/Blender `transforms.json` with its pictures, or a COLMAP
model with its `images`. EXR pictures are linear and, where they have an A channel, premultiplied by it; all others are
sRGB-encoded with straight alpha, 8 or 16 bits. Every picture becomes linear Rec.709 radiance seen by a pinhole camera
with square pixels: encoded values go through the exact sRGB curve, a lens's distortion and unequal focal lengths are
resampled away.

Which pixels count: finite, not saturated (an encoded channel at its maximum), wholly inside the alpha (a pixel that the
object covers in part shows the background too) and inside the user's mask.

The exposures' file is `{"ev": {picture: stops, ...}}` (the picture is 2^stops times as bright as the radiance),
`{"factor": {picture: factor, ...}}`, or the names and stops alone.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded
from mistyle.core.distortion import Lens, pinhole, resample
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.core.light import Lights, lights_of_views
from mistyle.files.bounds import beside, refuse
from mistyle.files.cameras import ENDINGS, SPACE, Frame, read_entries, read_frames, stem
from mistyle.files.colmap import SparsePoints, find_model
from mistyle.files.read import (
    read_colmap,
    read_colmap_points,
    read_exr,
    read_json,
    read_picture,
    read_radiance,
    read_size,
)
from mistyle.files.views import standing_picture

EXPECTED = "a folder with camera.json, transforms.json or a COLMAP model (sparse/0), or one of these files"
KEPT = 2  # pictures held decoded
TRANSFORMS = ("transforms.json", "transforms_train.json")


@dataclass(frozen=True)
class Shot:
    """One picture on disk: the pinhole camera that it is resampled to, its lens, its files, and what its radiance was
    multiplied by. `alpha_of` is an EXR whose A is the alpha of a picture that has none of its own."""

    camera: Camera
    lens: Lens
    picture: Path
    mask: Path | None = None
    factor: float = 1.0
    alpha_of: Path | None = None


def read_captures(
    path: Path,
    *,
    lights: Path | Literal["unknown"] | None = None,
    masks: Path | None = None,
    exposure: Path | Mapping[str, float] | None = None,
    pictures: Path | None = None,
    saturation: float = 1.0,
    coverage: float = 0.999,
) -> Captures:
    """The references of a fit, in the space of `camera_space`; headers are read now, pixels one picture at a time.

    path        a folder or file as the module says
    lights      a lights.json (core/light.py) for these views; None takes the one beside the cameras; "unknown" gives
                every view an empty list
    masks       a folder with a picture per view, by the view's name or its picture's: what is brighter than half counts
    exposure    a file as the module says, or stops by view
    pictures    the folder of a COLMAP model's or a transforms.json's pictures, where they are elsewhere
    saturation  encoded value 0..1 from which a channel is taken as saturated (JPEGs often stop short of 1)
    coverage    least alpha 0..1 of a pixel that counts; its colour is freed of the premultiplication

    Refused: cameras without pictures, pictures or masks of another size than their camera, views without lights,
    masks or exposures for some views only. What the pixels themselves say is `check_pixels`'s business.
    """
    shots = read_shots(path, masks=masks, exposure=exposure, pictures=pictures)
    names = [shot.camera.name for shot in shots]
    rig = tuple(() for _ in names) if lights == "unknown" else _lights(_home(path), lights, names)

    @lru_cache(maxsize=KEPT)
    def load(k: int) -> Loaded:
        rgb, counts = load_shot(shots[k], saturation, coverage)
        for array in (rgb, counts):
            array.setflags(write=False)  # shared with whoever asks next
        return rgb, counts

    return Captures(tuple(shot.camera for shot in shots), rig, load)


def read_shots(
    path: Path,
    *,
    masks: Path | None = None,
    exposure: Path | Mapping[str, float] | None = None,
    pictures: Path | None = None,
) -> tuple[Shot, ...]:
    """The pictures of a folder with cameras, masks and exposures; sizes are checked, see `read_captures`."""
    kind, file = _source(Path(path))
    if kind == "camera.json":
        shots = [_own(file, camera, entry) for camera, entry in read_entries(file)]
    elif kind == "colmap":
        folder = _images(Path(path), file, pictures)
        shots = [_shot(frame, folder) for frame in read_colmap(file)]
    else:
        folder = Path(pictures) if pictures is not None else file.parent
        frames = read_frames(file, lambda name: read_size(_find(folder, name)))
        shots = [_shot(frame, folder) for frame in frames]
    factors = _factors(exposure, [shot.camera.name for shot in shots])
    result = []
    for shot, factor in zip(shots, factors, strict=True):
        mask = shot.mask if masks is None else _mask(Path(masks), shot)
        result.append(Shot(shot.camera, shot.lens, shot.picture, mask, factor, shot.alpha_of))
        for picture in (shot.picture, mask):
            _check_size(picture, shot)
    return tuple(result)


def camera_space(path: Path) -> Literal["working", "own"]:
    """Whether the cameras stand about the mesh in its bounding sphere of radius 1 (camera.json, and a transforms.json
    of ours), or in a space of their maker's: the mesh's own units, or one that alignment must find."""
    kind, file = _source(Path(path))
    ours = kind == "camera.json" or (kind == "transforms" and read_json(file).get("space") == SPACE)
    return "working" if ours else "own"


def sparse_points(path: Path) -> SparsePoints | None:
    """The points of a COLMAP model, in the cameras' space; None for other references."""
    kind, file = _source(Path(path))
    return read_colmap_points(file) if kind == "colmap" else None


def load_shot(shot: Shot, saturation: float = 1.0, coverage: float = 0.999) -> Loaded:
    """Linear radiance as the shot's pinhole camera sees it, and which pixels count; 0 where one does not."""
    rgb, alpha, usable = _decoded(shot, saturation)
    if alpha is not None:
        usable = usable & (alpha >= coverage)
        if shot.picture.suffix.lower() == ".exr":
            rgb = rgb / np.maximum(alpha, 1e-6)[..., None]
    if shot.mask is not None:
        usable = usable & _inside(shot.mask)
    rgb = np.where(usable[..., None], rgb / np.float32(shot.factor), 0).astype(np.float32)
    return resample(shot.lens, rgb, usable)


def silhouette(shot: Shot) -> Bool[np.ndarray, "h w"]:
    """Where the object is, by the user's mask, else by the picture's alpha (at least half), in the pinhole camera.

    Refused: a picture without either.
    """
    if shot.mask is not None:
        inside = _inside(shot.mask)
    else:
        alpha = _decoded(shot, 1.0)[1]
        if alpha is None:
            fix = "Hand in masks (a folder with a picture of the same name per view)"
            raise refuse(shot.picture, "neither an alpha channel nor a mask", "to know where the object is", fix)
        inside = alpha >= 0.5
    everywhere = np.ones_like(inside)
    return resample(shot.lens, inside[..., None].astype(np.float32), everywhere)[0][..., 0] >= 0.5


def check_pixels(captures: Captures, progress: Callable[[float], None] = lambda done: None) -> tuple[str, ...]:
    """Sentences about pictures that say nothing, each by name; decodes every picture once.

    InputRefused when no picture says anything: all are black, or no pixel of any of them counts.
    """
    notes: list[str] = []
    black = empty = 0
    for k, camera in enumerate(captures.cameras):
        rgb, counts = captures.load(k)
        if not counts.any():
            empty += 1
            notes.append(f"{camera.name}: no pixel counts; all are saturated, masked out or see no object.")
        elif not rgb[counts].any():
            black += 1
            notes.append(f"{camera.name}: black wherever it counts.")
        progress((k + 1) / len(captures))
    if len(captures) and black + empty == len(captures):
        raise InputRefused(
            f"the references: found {black} pictures that are black and {empty} without a pixel that counts, of "
            f"{len(captures)}; expected pictures of the object. Check exposure, masks and the light."
        )
    if len(captures) < 3:
        notes.append(f"{len(captures)} views: fewer than 3 do not determine normal, roughness and albedo together.")
    return tuple(notes)


def _source(path: Path) -> tuple[Literal["camera.json", "transforms", "colmap"], Path]:
    """What kind of references `path` is, and the file (COLMAP: the model's folder) that holds the cameras."""
    if path.is_dir():
        named = [path / name for name in ("camera.json", *TRANSFORMS) if (path / name).is_file()]
        model = find_model(path)
        if not named and model is not None:
            return "colmap", model
        if not named:
            raise refuse(path, "neither of these in the folder", EXPECTED, "Hand in the folder with the cameras")
        path = named[0]
    elif not path.is_file():
        raise refuse(path, "nothing", EXPECTED, "Check the path")
    if path.suffix.lower() != ".json":
        raise refuse(path, f"a file ending in '{path.suffix}'", EXPECTED, "Hand in the folder with the cameras")
    return ("transforms" if "frames" in read_json(path) else "camera.json"), path


def _home(path: Path) -> Path:
    return Path(path) if Path(path).is_dir() else Path(path).parent


def _own(file: Path, camera: Camera, entry) -> Shot:
    """A view of our camera.json: its EXR, or the picture that was edited or added (as files/views.py has it)."""
    exr = beside(file, entry.exr) if entry.exr is not None else file.parent / f"{camera.name}.exr"
    picture = standing_picture(file.parent, camera, entry, exr if exr.is_file() else None)
    lens = Lens((camera.focal, camera.focal), camera.centre, camera.size)
    return Shot(camera, lens, picture or exr, alpha_of=exr if picture is not None and exr.is_file() else None)


def _shot(frame: Frame, folder: Path) -> Shot:
    focal, centre, size = pinhole(frame.lens)
    camera = Camera(frame.world_from_cam, focal, centre, size, frame.name)
    mask = None if frame.mask is None else _find(folder, frame.mask)
    return Shot(camera, frame.lens, _find(folder, frame.picture), mask)


def _images(path: Path, model: Path, pictures: Path | None) -> Path:
    """The folder of a COLMAP model's pictures."""
    places = [Path(pictures)] if pictures is not None else [p / "images" for p in (path, *path.resolve().parents[:2])]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        raise refuse(model, "no folder 'images' beside the model", "the pictures' folder", "Copy the pictures there")
    return found


def _find(folder: Path, name: str) -> Path:
    """The picture that a camera file names, with or without its ending; in the folder or below."""
    exact = beside(folder / "cameras", name)
    if exact.is_file():
        return exact
    there = _with_endings(exact.parent, [exact.name])
    if not there:
        found, fix = f"no picture {name!r}", "Add it, or take the view out of the camera file"
        raise refuse(folder, found, "one for every camera", fix)
    return there[0]


def _with_endings(folder: Path, names: Iterable[str]) -> list[Path]:
    endings = [e for ending in ENDINGS for e in (ending, ending.upper())]
    return [file for name in dict.fromkeys(names) for e in endings if (file := folder / f"{name}{e}").is_file()]


def _mask(folder: Path, shot: Shot) -> Path:
    name, picture = shot.camera.name, shot.picture.name
    names = [name, picture, stem(picture)]
    there = _with_endings(folder, names) or _with_endings(folder / shot.picture.parent.name, names)
    if not there:
        found = f"no mask for the view '{name}'"
        raise refuse(folder, found, f"{name}.png or {picture}.png", "Add it; white where the picture counts")
    return there[0]


def _check_size(picture: Path | None, shot: Shot) -> None:
    if picture is None:
        return
    height, width = read_size(picture)
    if (height, width) != shot.lens.size:
        expected = f"{shot.lens.size[1]} x {shot.lens.size[0]}, as its camera says (view '{shot.camera.name}')"
        fix = "Hand in the pictures that the cameras were made for, neither scaled nor cropped"
        raise refuse(picture, f"{width} x {height} pixels", expected, fix)


def _lights(home: Path, file: Path | None, names: list[str]) -> tuple[Lights, ...]:
    found = Path(file) if file is not None else home / "lights.json"
    if not found.is_file():
        fix = (
            'Write one, such as {"lights": [{"type": "environment", "file": "studio.hdr"}]} or {"views": {"'
            f'{names[0]}": [{{"type": "directional", "direction": [0, 1, 0], "irradiance": [3, 3, 3]}}], ...}}}}'
        )
        raise refuse(found, "no file", "what light each picture was taken in", fix)
    maps: dict[str, np.ndarray] = {}

    def load(name: str) -> Float[np.ndarray, "h w 3"]:
        if name not in maps:
            maps[name] = read_radiance(beside(found, name))
        return maps[name]

    return lights_of_views(read_json(found), names, str(found), load)


def _factors(exposure: Path | Mapping[str, float] | None, names: list[str]) -> list[float]:
    """What each picture's radiance was multiplied by."""
    if exposure is None:
        return [1.0] * len(names)
    where = exposure if isinstance(exposure, Path | str) else "exposure"
    tree: Mapping[str, Any] = read_json(Path(where)) if isinstance(exposure, Path | str) else exposure
    table = tree.get("factor", tree.get("ev", tree))
    if not isinstance(table, Mapping):
        raise refuse(where, f"a {type(table).__name__}", "an object: picture -> number", "Correct the file")
    factors = []
    for name in names:
        value = table.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise refuse(where, f"{value!r} for the view '{name}'", "a number for every view", "Add it")
        factor = float(value) if "factor" in tree else 2.0**value if abs(value) < 100 else 0.0
        if factor <= 0:
            raise refuse(where, f"{value!r} for the view '{name}'", "a factor > 0, or stops below 100", "Correct it")
        factors.append(factor)
    return factors


def _decoded(
    shot: Shot, saturation: float
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None, Bool[np.ndarray, "h w"]]:
    """Linear colours (still premultiplied in an EXR), alpha, and where they are finite and not saturated."""
    if shot.picture.suffix.lower() == ".exr":
        planes = read_exr(shot.picture)
        if not {"R", "G", "B"} <= set(planes):
            found = f"channels {', '.join(sorted(planes))[:200]}"
            raise refuse(shot.picture, found, "R, G and B", "Write the colours as R, G, B")
        rgb = np.stack([planes[c] for c in "RGB"], axis=-1)
        return rgb, planes.get("A"), np.asarray(np.isfinite(rgb).all(axis=-1))
    picture = read_picture(shot.picture)
    alpha = picture.alpha
    if alpha is None and shot.alpha_of is not None:
        alpha = read_exr(shot.alpha_of).get("A")
    return linear_from_srgb(picture.rgb), alpha, np.asarray((picture.rgb < saturation).all(axis=-1))


def _inside(mask: Path) -> Bool[np.ndarray, "h w"]:
    if mask.suffix.lower() == ".exr":
        planes = read_exr(mask)
        return next((planes[c] for c in ("A", "Y", "R") if c in planes), np.zeros(read_size(mask), np.float32)) > 0.5
    picture = read_picture(mask)
    bright = picture.rgb.mean(axis=-1) > 0.5
    return bright if picture.alpha is None else bright & (picture.alpha > 0.5)
