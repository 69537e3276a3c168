"""Reader of a fit's references: photographs or renders with known cameras.

A folder with our `camera.json` (io/cameras/camera_files.py), a NeRF/Blender `transforms.json` with its pictures, a
COLMAP model with its `images`, Meshroom's `cameras.sfm` (io/cameras/sfm.py), Metashape's XML of cameras
(io/cameras/metashape.py), or RealityScan's CSV or XMP files (io/cameras/realityscan.py). EXR pictures are linear and,
where they have an A channel, premultiplied by it; cameras' RAW files are developed linearly (io/images/raw.py); all
others are sRGB-encoded with straight alpha, 8 or 16 bits. Every picture becomes linear Rec.709 radiance seen by a
pinhole camera with square pixels: encoded values go through the exact sRGB curve, lens distortion and unequal focal
lengths are removed by resampling.

A camera describes either stored pixels or upright ones (EXIF orientation, see io/cameras/camera_files.py):
`CapturedPicture.pixels`, for both the picture and the mask of a view.

Valid pixels are finite, not saturated (an encoded channel at its maximum), wholly inside the alpha and inside the
user's mask. A partly covered pixel shows the background too. Background removers write mattes that stay just below 1
inside the object: there the median takes the place of 1 (`least_alpha`).

The exposures' file is `{"ev": {picture: stops, ...}}` (the picture is 2^stops times as bright as the radiance),
`{"factor": {picture: factor, ...}}`, or the names and stops alone.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.asset import RAW, Pixels
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded
from mistyle.core.errors import InputRefused
from mistyle.core.light import Lights, lights_of_views
from mistyle.geometry.lens import Lens, pinhole, resample
from mistyle.io.cameras.camera_files import PIXELS, SPACE, CameraFrame, ViewEntry, read_entries, read_frames
from mistyle.io.cameras.colmap import find_model
from mistyle.io.cameras.foreign import foreign_files, foreign_kind
from mistyle.io.cameras.picture_files import (
    ADD,
    COPY,
    HAND_IN,
    by_spelling,
    check_different,
    find,
    find_by_end,
    images_folder,
    mask_of_view,
    named_mask,
    picture_folder,
)
from mistyle.io.cameras.realityscan_files import columns_of, in_pixels, is_sidecar, sidecars
from mistyle.io.cameras.sfm import is_sfm, read_sfm
from mistyle.io.cameras.views import picture_of_view
from mistyle.io.images.quantisation import fractions, linear_rows
from mistyle.io.read import (
    read_colmap,
    read_exr,
    read_json,
    read_metashape,
    read_picture,
    read_radiance,
    read_raw,
    read_realityscan,
    read_size,
    read_stored_pixels,
    read_stored_size,
)
from mistyle.io.sandbox.bounds import inside, read_bytes, refuse

EXPECTED = (
    "a folder with camera.json, transforms.json, a COLMAP model (sparse/0), Meshroom's cameras.sfm, Metashape's XML or "
    "RealityScan's CSV or XMP files, or one of these files"
)
Kind = Literal["camera.json", "transforms", "colmap", "sfm", "metashape", "realityscan"]
KEPT = 2  # pictures held decoded
TRANSFORMS = ("transforms.json", "transforms_train.json")
OPAQUE = (".jpg", ".jpeg", *RAW)  # have no alpha, so they need not be decoded for it
WHOLE = 0.999  # least alpha of a valid pixel of a rendered picture
# A matte whose median inside the object is from MATTE to WHOLE; a valid pixel's alpha is at most BELOW under it.
MATTE, BELOW = 0.95, 0.02


@dataclass(frozen=True)
class CapturedPicture:
    """One picture on disk.

    camera       the pinhole camera that it is resampled to
    lens         the lens of the photograph
    pixels       the pixels of picture and mask that these two describe (io/cameras/camera_files.py)
    named        the picture's name in the camera file; empty for our own
    factor       the exposure factor of its radiance
    alpha_of     an EXR whose A is the alpha of a picture without its own
    orientation  the EXIF orientations 1..8 of picture and mask (1: none)
    """

    camera: Camera
    lens: Lens
    picture: Path
    pixels: Pixels
    named: str = ""
    mask: Path | None = None
    factor: float = 1.0
    alpha_of: Path | None = None
    orientation: tuple[int, int] = (1, 1)


def read_captures(
    path: Path,
    *,
    lights: Path | Literal["unknown"] | None = None,
    masks: Path | None = None,
    exposure: Path | Mapping[str, float] | None = None,
    pictures: Path | None = None,
    saturation: float = 1.0,
    coverage: float = WHOLE,
) -> Captures:
    """The references of a fit, in the space of `camera_space`; headers are read now, pixels one picture at a time.

    path        a folder or file as described above
    lights      a lights.json (core/light.py) for these views; None takes the one beside the cameras; "unknown" gives
                every view an empty list
    masks       a folder with a picture per view, by the view's name or its picture's: brighter than half is valid
    exposure    a file as described above, or stops by view
    pictures    the folder of the pictures, where it is elsewhere; missing folders of a camera file's picture names are
                dropped
    saturation  encoded value 0..1 at which a channel counts as saturated (JPEGs often stay below 1)
    coverage    least alpha 0..1 of a valid pixel, less for mattes (`least_alpha`); its colour is unpremultiplied

    Refused: cameras without pictures (of a transforms.json, unless they are few), pictures or masks of another size
    than their camera, views without lights, masks or exposures for some views only. `check_pixels` checks the values.
    """
    shots = read_shots(path, masks=masks, exposure=exposure, pictures=pictures)
    rig = tuple(() for _ in shots) if lights == "unknown" else _lights(home_of(path), lights, _spelled(shots))

    @lru_cache(maxsize=KEPT)
    def load(k: int) -> Loaded:
        rgb, counts = load_shot(shots[k], saturation, coverage)
        for array in (rgb, counts):
            array.setflags(write=False)  # shared with later callers
        return rgb, counts

    return Captures(tuple(shot.camera for shot in shots), rig, load)


def read_shots(
    path: Path,
    *,
    masks: Path | None = None,
    exposure: Path | Mapping[str, float] | None = None,
    pictures: Path | None = None,
) -> tuple[CapturedPicture, ...]:
    """The pictures of a folder with cameras, masks and exposures; sizes are checked, see `read_captures`."""
    kind, file = source_of(Path(path))
    elsewhere = None if pictures is None else picture_folder(Path(pictures))
    if kind == "camera.json":
        shots = [_own(file, camera, entry, elsewhere) for camera, entry in read_entries(file)]
    else:
        folder = _pictures_folder(kind, Path(path), file) if elsewhere is None else elsewhere

        def found(name: str) -> Path | None:
            return find(folder, name, file) if elsewhere is None else find_by_end(folder, name)

        def place(name: str) -> Path:
            picture = found(name)
            if picture is None:
                fix = f"{ADD}. {HAND_IN}" if elsewhere is None else ADD
                raise refuse(folder, f"no picture {name!r}", "one for every camera", fix)
            return picture

        def size(name: str) -> tuple[int, int]:
            return read_size(place(name), "stored")

        readers = {"colmap": read_colmap, "sfm": read_sfm, "metashape": read_metashape, "realityscan": read_realityscan}
        frames = readers[kind](file) if kind in readers else read_frames(file, size)
        if kind == "realityscan":
            frames = [in_pixels(frame, size(frame.picture)) for frame in frames]
        if kind == "transforms":
            frames = _with_pictures(frames, found)
        # The user's masks replace those that frames name.
        homes = [file.parent] if elsewhere is None else [elsewhere, file.parent]
        named = [None if f.mask is None or masks is not None else named_mask(homes, f.mask, file) for f in frames]
        shots = [_shot(frame, place(frame.picture), mask) for frame, mask in zip(frames, named, strict=True)]
    check_different({shot.camera.name: shot.picture for shot in shots}, elsewhere or home_of(Path(path)))
    factors = _factors(exposure, _spelled(shots))
    result = []
    for shot, factor in zip(shots, factors, strict=True):
        mask = shot.mask if masks is None else mask_of_view(Path(masks), shot.camera.name, shot.picture)
        tags = _checked(shot.picture, shot), 1 if mask is None else _checked(mask, shot)
        result.append(replace(shot, mask=mask, factor=factor, orientation=tags))
    return tuple(result)


def _with_pictures(frames: list[CameraFrame], found: Callable[[str], Path | None]) -> list[CameraFrame]:
    """The frames of a transforms.json whose pictures exist, as its other readers take them, if they are most;
    else all."""
    there = [frame for frame in frames if found(frame.picture) is not None]
    return there if 2 * len(there) > len(frames) else frames


def camera_space(path: Path) -> Literal["working", "own"]:
    """ "working": the cameras are in the working space, around the mesh in its bounding sphere of radius 1
    (camera.json, and a transforms.json of ours). "own": they are in the mesh's own units, or in a space that alignment
    must find."""
    kind, file = source_of(Path(path))
    ours = kind == "camera.json" or (kind == "transforms" and read_json(file).get("space") == SPACE)
    return "working" if ours else "own"


def load_shot(shot: CapturedPicture, saturation: float = 1.0, coverage: float = WHOLE) -> Loaded:
    """Linear radiance in the shot's pinhole camera, 0 at invalid pixels, and the mask of valid pixels."""
    rgb, alpha, usable = _decoded(shot, saturation)
    if alpha is not None:
        usable = usable & (alpha >= least_alpha(inner_alpha(alpha), coverage))
        if shot.picture.suffix.lower() == ".exr":
            rgb = rgb / np.maximum(alpha, 1e-6)[..., None]
    if shot.mask is not None:
        usable = usable & _inside(shot.mask, shot.pixels)
    rgb = rgb if shot.factor == 1 else rgb / np.float32(shot.factor)
    rgb = np.where(usable[..., None], rgb, np.float32(0)).astype(np.float32, copy=False)
    return resample(shot.lens, rgb, usable)


def inner_alpha(alpha: Float[np.ndarray, "h w"]) -> float:
    """The median alpha inside the object, where it is at least half; 1 where it is nowhere."""
    inside = alpha[alpha >= 0.5]
    return float(np.median(inside)) if inside.size else 1.0


def least_alpha(inner: float, coverage: float = WHOLE) -> float:
    """The least alpha of a valid pixel: `coverage`, or BELOW the median `inner` of a matte that never reaches it."""
    return inner - BELOW if MATTE <= inner < coverage else coverage


def silhouette(shot: CapturedPicture, seen: Callable[[float], None] = lambda inner: None) -> Bool[np.ndarray, "h w"]:
    """The object's mask in the pinhole camera, from the user's mask, else from the picture's alpha (at least half);
    `seen` is given the alpha's median (`inner_alpha`).

    Refused: a picture without either.
    """
    outline = outline_of(shot, seen)
    if outline is None:
        fix = "Hand in masks (a folder with a picture of the same name per view)"
        raise refuse(shot.picture, "neither an alpha channel nor a mask", "to know where the object is", fix)
    return outline


def outline_of(
    shot: CapturedPicture, seen: Callable[[float], None] = lambda inner: None
) -> Bool[np.ndarray, "h w"] | None:
    """As `silhouette`; None for a picture that has neither alpha nor mask."""
    if shot.mask is not None:
        covered = _inside(shot.mask, shot.pixels)
    else:
        alpha = _alpha(shot)
        if alpha is None:
            return None
        covered = alpha >= 0.5
        seen(inner_alpha(alpha))
    everywhere = np.ones_like(covered)
    return resample(shot.lens, covered[..., None].astype(np.float32), everywhere)[0][..., 0] >= 0.5


def check_pixels(captures: Captures, progress: Callable[[float], None] = lambda done: None) -> tuple[str, ...]:
    """Sentences about uninformative pictures, each by name; decodes every picture once.

    InputRefused when all pictures are uninformative: black, or without a valid pixel.
    """
    notes: list[str] = []
    black = empty = 0
    for k, camera in enumerate(captures.cameras):
        rgb, counts = captures.load(k)
        if not counts.any():
            empty += 1
            notes.append(f"{camera.name}: no valid pixel; all are saturated, masked out or miss the object.")
        elif not rgb[counts].any():
            black += 1
            notes.append(f"{camera.name}: all valid pixels are black.")
        progress((k + 1) / len(captures))
    if len(captures) and black + empty == len(captures):
        raise InputRefused(
            f"the references: found {black} pictures that are black and {empty} without a valid pixel, of "
            f"{len(captures)}; expected pictures of the object. Check exposure, masks and the light."
        )
    if len(captures) < 3:
        notes.append(f"{len(captures)} views: fewer than 3 do not determine normal, roughness and albedo together.")
    return tuple(notes)


def source_of(path: Path) -> tuple[Kind, Path]:
    """The kind of references at `path`, and the file with the cameras; the folder of a COLMAP model or of XMP files."""
    if path.is_dir():
        camera_files = [path / name for name in ("camera.json", *TRANSFORMS) if (path / name).is_file()]
        camera_files += sorted(path.glob("*.sfm"))
        model = find_model(path)
        if model is None:  # it has points beside the cameras
            camera_files += tables_in(path)
        if not camera_files and model is not None:
            return "colmap", model
        if not camera_files and sidecars(path):
            return "realityscan", path
        foreign = [] if camera_files else foreign_files(path)[:1]
        if not camera_files and not foreign:
            fix = "Hand in the folder with the cameras; COLMAP, Meshroom or RealityScan find them from the pictures"
            raise refuse(path, "none of these in the folder", EXPECTED, fix)
        path = (camera_files or foreign)[0]
    elif not path.is_file():
        raise refuse(path, "nothing", EXPECTED, "Check the path")
    kind = _kind_of(path)
    if kind is not None:
        return kind, path if kind != "realityscan" or path.suffix.lower() == ".csv" else path.parent
    foreign = foreign_kind(path)
    if foreign is not None:
        raise refuse(path, foreign[0], EXPECTED, foreign[1])
    if path.suffix.lower() not in (".json", ".sfm"):
        raise refuse(path, f"a file ending in '{path.suffix}'", EXPECTED, "Hand in the folder with the cameras")
    tree = read_json(path)
    if not {"frames", "views"} & set(tree):
        raise refuse(path, f"an object of {', '.join(sorted(tree))[:100] or 'nothing'}", EXPECTED, "Check the file")
    return ("sfm" if is_sfm(tree) else "transforms" if "frames" in tree else "camera.json"), path


def _pictures_folder(kind: str, path: Path, file: Path) -> Path:
    """The folder of the pictures of references at `path`, whose cameras are in `file`."""
    if kind == "colmap":
        return images_folder(path, file)
    below = file.parent / "images"
    if kind == "realityscan" and file.is_dir():  # XMP files lie beside the pictures
        return file
    return below if kind in ("metashape", "realityscan") and below.is_dir() else file.parent


def tables_in(folder: Path) -> list[Path]:
    """The XML and CSV files of a folder that hold the cameras of all pictures."""
    files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in (".xml", ".csv") and file.is_file()]
    return [file for file in files if _kind_of(file) is not None]


def _kind_of(path: Path) -> Literal["metashape", "realityscan"] | None:
    """The kind of cameras in a file whose ending alone does not say it."""
    ending = path.suffix.lower()
    if ending == ".xml":
        head = read_bytes(path, count=4096)
        return "metashape" if b"<document" in head and b"<chunk" in head else None
    known = bool(columns_of(path)) if ending == ".csv" else ending == ".xmp" and is_sidecar(path)
    return "realityscan" if known else None


def home_of(path: Path) -> Path:
    return Path(path) if Path(path).is_dir() else Path(path).parent


def _own(file: Path, camera: Camera, entry: ViewEntry, elsewhere: Path | None) -> CapturedPicture:
    """A view of our camera.json: its EXR, or an edited or added picture (the rule of io/cameras/views.py)."""
    folder = file.parent
    if elsewhere is not None:
        folder = elsewhere
        files = {
            key: name and PurePosixPath(name.replace("\\", "/")).name for key, name in entry if key in ("exr", "png")
        }
        entry = entry.model_copy(update=files)
    exr = folder / f"{camera.name}.exr" if entry.exr is None else inside(folder, entry.exr, file, HAND_IN)
    picture = picture_of_view(folder, camera, entry, exr if exr.is_file() else None, HAND_IN)
    lens = Lens((camera.focal, camera.focal), camera.centre, camera.size)
    alpha_of = exr if picture is not None and exr.is_file() else None
    return CapturedPicture(camera, lens, picture or exr, PIXELS, alpha_of=alpha_of)


def _shot(frame: CameraFrame, picture: Path, mask: Path | None) -> CapturedPicture:
    focal, centre, size = pinhole(frame.lens)
    camera = Camera(frame.world_from_cam, focal, centre, size, frame.name)
    return CapturedPicture(camera, frame.lens, picture, frame.pixels, frame.picture, mask)


def _checked(picture: Path, shot: CapturedPicture) -> int:
    """The EXIF orientation of a picture or mask; InputRefused where its size is not its camera's."""
    height, width, orientation = read_stored_size(picture)
    if shot.pixels == "upright" and orientation > 4:
        height, width = width, height
    if (height, width) != shot.lens.size:
        expected = f"{shot.lens.size[1]} x {shot.lens.size[0]}, the size of its camera (view '{shot.camera.name}')"
        fix = "Hand in the pictures that the cameras were made for, neither scaled nor cropped"
        if (width, height) == shot.lens.size:
            fix = (
                "The sides are swapped, as an EXIF rotation does that was applied to some files only: the cameras "
                f"describe {shot.pixels} pixels, this file's orientation is {orientation} (1: none). {fix} nor turned"
            )
        raise refuse(picture, f"{width} x {height} pixels", expected, fix)
    return orientation


def _spelled(shots: Sequence[CapturedPicture]) -> dict[str, str]:
    """The pictures' names as the camera file spells them, by the views' names."""
    return {shot.camera.name: shot.named or shot.camera.name for shot in shots}


def _lights(home: Path, file: Path | None, spelled: Mapping[str, str]) -> tuple[Lights, ...]:
    names = list(spelled.values())
    path = Path(file) if file is not None else home / "lights.json"
    if not path.is_file():
        fix = (
            'Write one, such as {"lights": [{"type": "environment", "file": "studio.hdr"}]} or {"views": {"'
            f'{names[0]}": [{{"type": "directional", "direction": [0, 1, 0], "irradiance": [3, 3, 3]}}], ...}}}}'
        )
        raise refuse(path, "no file", "the light of each picture", fix)
    maps: dict[str, np.ndarray] = {}

    def load(name: str) -> Float[np.ndarray, "h w 3"]:
        if name not in maps:
            maps[name] = read_radiance(inside(path.parent, name, path, COPY))
        return maps[name]

    tree = read_json(path)
    if isinstance(tree.get("views"), dict):
        tree = tree | {"views": by_spelling(tree["views"], spelled, path)}
    return lights_of_views(tree, names, str(path), load)


def _factors(exposure: Path | Mapping[str, float] | None, spelled: Mapping[str, str]) -> list[float]:
    """The exposure factor of each picture's radiance."""
    if exposure is None:
        return [1.0] * len(spelled)
    where = exposure if isinstance(exposure, Path | str) else "exposure"
    tree: Mapping[str, Any] = read_json(Path(where)) if isinstance(exposure, Path | str) else exposure
    table = tree.get("factor", tree.get("ev", tree))
    if not isinstance(table, Mapping):
        raise refuse(where, f"a {type(table).__name__}", "an object: picture -> number", "Correct the file")
    factors, table = [], by_spelling(table, spelled, where)
    for name in spelled.values():
        value = table.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise refuse(where, f"{value!r} for the view '{name}'", "a number for every view", "Add it")
        factor = float(value) if "factor" in tree else 2.0**value if abs(value) < 100 else 0.0
        if factor <= 0:
            raise refuse(where, f"{value!r} for the view '{name}'", "a factor > 0, or stops below 100", "Correct it")
        factors.append(factor)
    return factors


def _decoded(
    shot: CapturedPicture, saturation: float
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None, Bool[np.ndarray, "h w"]]:
    """Linear colours (still premultiplied in an EXR), alpha, and the mask of finite, unsaturated pixels."""
    if shot.picture.suffix.lower() == ".exr":
        planes = read_exr(shot.picture, colours=True)
        if not {"R", "G", "B"} <= set(planes):
            found = f"channels {', '.join(sorted(planes))[:200]}"
            raise refuse(shot.picture, found, "R, G and B", "Write the colours as R, G, B")
        rgb = np.stack([planes[c] for c in "RGB"], axis=-1)
        return rgb, planes.get("A"), np.asarray(np.isfinite(rgb).all(axis=-1))
    if shot.picture.suffix.lower() in RAW:
        values = read_raw(shot.picture, shot.pixels)
        usable = np.asarray((values < 65535 * min(saturation, 1)).all(axis=-1))
        return values.astype(np.float32) / 65535, _alpha(shot), usable
    rgb, alpha = read_stored_pixels(shot.picture, shot.pixels)
    if alpha is None and shot.alpha_of is not None:
        alpha = read_exr(shot.alpha_of).get("A")
    return linear_rows(rgb), alpha, _unsaturated(rgb, saturation)


def _unsaturated(encoded: np.ndarray, saturation: float) -> Bool[np.ndarray, "h w"]:
    """The pixels of which every channel, encoded in integers or 0..1, is below `saturation`."""
    least = saturation
    if encoded.dtype.kind == "u":  # the first integer that counts as saturated
        values = fractions(np.arange(np.iinfo(encoded.dtype).max + 1, dtype=encoded.dtype))
        least = int(np.searchsorted(values, np.float32(saturation)))
    below = [encoded[..., c] < least for c in range(encoded.shape[-1])]
    return np.asarray(np.logical_and.reduce(below))


def may_have_alpha(shot: CapturedPicture) -> bool:
    """Whether the picture, or an EXR that it replaces, may have an alpha, by its ending."""
    return shot.picture.suffix.lower() not in OPAQUE or shot.alpha_of is not None


def _alpha(shot: CapturedPicture) -> Float[np.ndarray, "h w"] | None:
    """The alpha of the picture, or of the EXR that it replaces."""
    if shot.picture.suffix.lower() == ".exr":
        return read_exr(shot.picture).get("A")
    if shot.picture.suffix.lower() not in OPAQUE:
        alpha = read_stored_pixels(shot.picture, shot.pixels)[1]
        if alpha is not None:
            return alpha
    return None if shot.alpha_of is None else read_exr(shot.alpha_of).get("A")


def _inside(mask: Path, pixels: Pixels) -> Bool[np.ndarray, "h w"]:
    if mask.suffix.lower() == ".exr":
        planes = read_exr(mask)
        return next((planes[c] for c in ("A", "Y", "R") if c in planes), np.zeros(read_size(mask), np.float32)) > 0.5
    picture = read_picture(mask, pixels)
    bright = picture.rgb.mean(axis=-1) > 0.5
    return bright if picture.alpha is None else bright & (picture.alpha > 0.5)
