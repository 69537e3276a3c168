"""The folders of Stanford-ORB and TensoIR-Synthetic as references of a fit, with their ground truth.

Stanford-ORB (real photographs), as it is unpacked:

    blender_HDR|blender_LDR/<scene>/transforms_{train,test,novel}.json    camera_angle_x, frames
                                   /{train,test}/0001.exr|.png, /{train,test}_mask/0001.png
    ground_truth/<scene>/env_map/0001.exr           the light of test picture 0001, in that camera's frame
                        /surface_normal/0001.npy    in the camera's frame (OpenGL axes)
                        /z_depth/0001.npy, /pseudo_gt_albedo/0001.png|.npy
                        /mesh_blender/mesh.obj      in the space of the poses

`novel` frames are test pictures of other scenes with the same object (`scene_name`): their poses stand in this scene's
space, their pictures, masks and light in that scene's folders. Training pictures have no light of their own.

TensoIR-Synthetic (Blender renders):

    <scene>/train_000|test_000/metadata.json        imw, imh, cam_angle_x, cam_transform_mat (16 numbers, OpenGL axes)
                              /rgba_<light>.png     sRGB, straight alpha; <light> may end in a rotation (sunset_120)
                              /albedo.png           linear, /normal.png (n + 1) / 2 in the world (Z up)
    <maps>/<light>.hdr|.exr                         the middle looks along world +X, right is -Y, up is +Z

The spaces are the sets' own: `geometry/similarity.py moved` with the mesh's `Source.work_from_user` takes them to the
working space.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mistyle.core.camera import MITSUBA_FROM_OPENCV, OPENGL_FROM_OPENCV, Camera
from mistyle.core.capture import Captures
from mistyle.core.image import bilinear, linear_from_srgb
from mistyle.core.light import Environment, Lights
from mistyle.geometry.lens import Lens
from mistyle.geometry.similarity import turned
from mistyle.io.cameras.camera_files import MAX_SIDE, CameraFrame, check_rotation, read_frames
from mistyle.io.cameras.captures import CapturedPicture, load_shot
from mistyle.io.read import read_json, read_npy, read_picture, read_radiance, read_size
from mistyle.io.sandbox.bounds import inside, refuse

# Axes of an environment map (up +Y, middle +Z, right -X) in TensoIR's world.
WORLD_FROM_TENSOIR_MAP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
TENSOIR_LIGHTS = ("bridge", "city", "fireplace", "forest", "night")  # the unseen ones of the published comparison


@dataclass(frozen=True)
class Truth:
    """What a set knows about one picture; None where it does not.

    albedo  linear Rec.709 0..1; Stanford-ORB's is good up to a factor per channel
    normal  unit, in the space of the cameras, zero beside the object
    depth   metric z in the camera, infinite beside the object
    """

    mask: Bool[np.ndarray, "h w"]
    albedo: Float[np.ndarray, "h w 3"] | None = None
    normal: Float[np.ndarray, "h w 3"] | None = None
    depth: Float[np.ndarray, "h w"] | None = None


@dataclass(frozen=True)
class Dataset:
    """References in the set's own space, what is known about picture k (of full size), and the mesh's file."""

    captures: Captures
    truth: Callable[[int], Truth]
    mesh: Path | None


def read_stanford_orb(
    root: Path,
    scene: str,
    split: Literal["train", "test", "novel"] = "train",
    *,
    hdr: bool = True,
    light_of: int = 0,
) -> Dataset:
    """One split of a scene ("baking_scene001"). `root` holds blender_HDR, blender_LDR and ground_truth.

    Test and novel pictures have the environment map of their own. Training pictures have that of the test picture
    number `light_of` for all (an approximation: the photographer moved); where there is none they have no light.
    """
    root = Path(root)
    kind, ending = ("blender_HDR", ".exr") if hdr else ("blender_LDR", ".png")
    home = root / kind / scene
    file = home / f"transforms_{split}.json"
    scenes = _novel_scenes(file) if split == "novel" else None

    def place(k: int) -> tuple[Path, Path]:
        """The folders of pictures and of truth of frame k."""
        other = scene if scenes is None else scenes[k]
        return root / kind / other, root / "ground_truth" / other

    # A novel transforms.json names pictures of other folders, so that a name alone does not say whose size is asked.
    first = place(0)[0]
    frames = read_frames(file, lambda name: read_size(_inside(first, name + ending), "stored"))
    shots = [_orb_shot(frame, place(k)[0], ending) for k, frame in enumerate(frames)]
    if scenes is not None:
        shots = [
            replace(shot, camera=replace(shot.camera, name=f"{other}_{shot.picture.stem}"))
            for shot, other in zip(shots, scenes, strict=True)
        ]
    if split == "train":
        rigs = [_orb_common_light(root, kind, scene, light_of, ending)] * len(shots)
    else:
        rigs = [_orb_light(shot.camera, place(k)[1], shot.picture.stem) for k, shot in enumerate(shots)]
    mesh = root / "ground_truth" / scene / "mesh_blender" / "mesh.obj"

    def truth(k: int) -> Truth:
        return _orb_truth(shots[k], place(k)[1])

    return Dataset(_captures(shots, rigs), truth, mesh if mesh.is_file() else None)


def read_tensoir(
    folder: Path,
    split: Literal["train", "test"] = "train",
    *,
    light: str = "sunset",
    maps: Path | None = None,
) -> Dataset:
    """The pictures of a scene under one light; `maps` is the folder of environment maps (None: no lights)."""
    folder = Path(folder)
    places = sorted(place for place in folder.glob(f"{split}_*") if place.is_dir())
    if not places:
        raise refuse(folder, f"no folders {split}_000, ...", "TensoIR-Synthetic", "Hand in the folder of one scene")
    shots = [_tensoir_shot(place, light) for place in places]
    rig: Lights = () if maps is None else (_tensoir_light(Path(maps), light),)
    return Dataset(_captures(shots, [rig] * len(shots)), lambda k: _tensoir_truth(shots[k]), None)


def _captures(shots: list[CapturedPicture], rigs: list[Lights]) -> Captures:
    for shot in shots:
        for picture in (shot.picture, shot.mask):
            if picture is not None and (size := read_size(picture, shot.pixels)) != shot.lens.size:
                expected = f"{shot.lens.size[1]} x {shot.lens.size[0]}"
                raise refuse(picture, f"{size[1]} x {size[0]} pixels", expected, "Unpack the data set again")
    return Captures(tuple(shot.camera for shot in shots), tuple(rigs), lambda k: load_shot(shots[k]))


def _inside(folder: Path, name: str) -> Path:
    return inside(folder, name, folder, "Unpack the data set again")


def _novel_scenes(file: Path) -> list[str]:
    """The scene whose picture each frame of a transforms_novel.json is."""
    scenes = []
    for k, frame in enumerate(read_json(file).get("frames") or ()):
        name = frame.get("scene_name") if isinstance(frame, dict) else None
        if not isinstance(name, str) or Path(name).name != name or name in ("", ".", ".."):
            raise refuse(file, f"scene_name = {name!r} in frame {k}", "a scene's folder", "Unpack the data set again")
        scenes.append(name)
    return scenes


def _orb_shot(frame: CameraFrame, home: Path, ending: str) -> CapturedPicture:
    picture = _inside(home, frame.picture + ending)
    mask = _inside(home, f"{Path(frame.picture).parent.as_posix()}_mask/{Path(frame.picture).name}.png")
    camera = Camera(frame.world_from_cam, frame.lens.focal[0], frame.lens.centre, frame.lens.size, frame.name)
    return CapturedPicture(camera, frame.lens, picture, frame.pixels, mask=mask)


def _orb_light(camera: Camera, truth: Path, name: str) -> Lights:
    """The environment of a test picture: its map stands in the camera (middle forwards, right to the right)."""
    file = truth / "env_map" / f"{name}.exr"
    if not file.is_file():
        return ()
    world_from_map = (camera.world_from_cam @ MITSUBA_FROM_OPENCV)[:3, :3]
    return (turned(Environment(read_radiance(file), file=str(file)), world_from_map),)


def _orb_common_light(root: Path, kind: str, scene: str, number: int, ending: str) -> Lights:
    home = root / kind / scene
    file = home / "transforms_test.json"
    if not file.is_file():
        return ()
    frames = read_frames(file, lambda name: read_size(_inside(home, name + ending), "stored"))
    if not 0 <= number < len(frames):
        raise refuse(file, f"{len(frames)} test pictures", f"more than {number}", "Choose another for the light")
    shot = _orb_shot(frames[number], home, ending)
    return _orb_light(shot.camera, root / "ground_truth" / scene, shot.picture.stem)


def _orb_truth(shot: CapturedPicture, truth: Path) -> Truth:
    name, size = shot.picture.stem, shot.lens.size
    mask = read_picture(shot.mask).rgb.mean(axis=-1) > 0.5 if shot.mask is not None else np.ones(size, bool)
    normal, depth, albedo = (
        _array(truth / folder / f"{name}.npy", (*size, *rest))
        for folder, rest in (("surface_normal", (3,)), ("z_depth", ()), ("pseudo_gt_albedo", (3,)))
    )
    if normal is not None:
        world = normal @ (shot.camera.world_from_cam @ OPENGL_FROM_OPENCV)[:3, :3].T
        normal = _unit(world, mask)
    if depth is not None:
        depth = np.where(mask & (depth > 0), depth, np.inf).astype(np.float32)
    drawn = truth / "pseudo_gt_albedo" / f"{name}.png"
    if albedo is None and drawn.is_file():
        albedo = linear_from_srgb(read_picture(drawn).rgb)
    return Truth(mask, albedo, normal, depth)


def _array(file: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    if not file.is_file():
        return None
    found = read_npy(file)
    if found.size != np.prod(shape) or found.shape[:2] != shape[:2]:
        raise refuse(file, f"an array of {found.shape}", f"{shape}", "Unpack the data set again")
    return found.reshape(shape).astype(np.float32)


def _unit(normal: np.ndarray, mask: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    known = mask[..., None] & (length > 1e-3)
    return np.where(known, normal / np.maximum(length, 1e-3), 0).astype(np.float32)


class _Metadata(BaseModel):
    model_config = ConfigDict(frozen=True)

    imw: Annotated[int, Field(ge=1, le=MAX_SIDE)]
    imh: Annotated[int, Field(ge=1, le=MAX_SIDE)]
    cam_angle_x: Annotated[float, Field(gt=0, lt=np.pi, allow_inf_nan=False)]
    cam_transform_mat: Annotated[str, Field(max_length=2000)]


def _tensoir_shot(place: Path, light: str) -> CapturedPicture:
    file = place / "metadata.json"
    try:
        known = _Metadata.model_validate(read_json(file))
        numbers = np.array([float(v) for v in known.cam_transform_mat.split(",")]).reshape(4, 4)
    except (ValidationError, ValueError) as error:
        first: Any = error.errors()[0] if isinstance(error, ValidationError) else {"msg": str(error), "loc": ()}
        found = f"{first['msg']} {'.'.join(map(str, first['loc']))}"
        raise refuse(file, found, "TensoIR's metadata", "Unpack the data set again") from error
    pose = numbers @ OPENGL_FROM_OPENCV
    check_rotation(pose[:3, :3], place.name, file)
    focal = known.imw / (2 * np.tan(known.cam_angle_x / 2))
    size = (known.imh, known.imw)
    lens = Lens((float(focal), float(focal)), (known.imw / 2, known.imh / 2), size)
    camera = Camera(pose, lens.focal[0], lens.centre, size, place.name)
    return CapturedPicture(camera, lens, _inside(place, f"rgba_{light}.png"), "stored")


def _tensoir_light(maps: Path, light: str) -> Environment:
    there = [file for ending in (".hdr", ".exr") if (file := _inside(maps, light + ending)).is_file()]
    if not there:
        raise refuse(maps, f"no {light}.hdr", "the environment map of that light", "Copy TensoIR's maps there")
    radiance = read_radiance(there[0])
    return turned(Environment(_to_poles(radiance), file=str(there[0])), WORLD_FROM_TENSOIR_MAP)


def _to_poles(radiance: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """A map whose rows are bands of latitude, at the latitudes that `environment_directions` gives to rows."""
    height, width = radiance.shape[:2]
    row = np.arange(height) / (height - 1) * height
    px = np.stack(np.broadcast_arrays(np.arange(width) + 0.5, row[:, None]), axis=-1)
    return bilinear(radiance, px.reshape(-1, 2)).reshape(radiance.shape)


def _tensoir_truth(shot: CapturedPicture) -> Truth:
    place = shot.picture.parent
    shown = read_picture(shot.picture)
    alpha = shown.alpha if shown.alpha is not None else np.ones(shot.lens.size, np.float32)
    mask = alpha >= 0.5
    albedo = place / "albedo.png"
    normal = place / "normal.png"
    return Truth(
        mask,
        read_picture(albedo).rgb if albedo.is_file() else None,
        _unit(read_picture(normal).rgb * 2 - 1, mask) if normal.is_file() else None,
    )
