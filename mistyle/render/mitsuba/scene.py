"""Mesh + maps + camera + lights → a Mitsuba scene dictionary. All plugin and parameter names of Mitsuba are here.

A template is a Mitsuba scene file with a slot for the object: a shape whose id is "object". `scene_dict` takes the
template's integrator, emitters and other shapes. It replaces the slot by one shape per texture set, each with a
`principled` BSDF and its texture parameters. The object is in the working space (bounding sphere of radius 1 about the
origin, Y up), whatever transform the slot's own shape has. The same works for a user's scene file.

Optional features of a template:
- an emitter whose id starts with "camera_" turns with the camera (its transform in the file belongs to the file's
  sensor);
- `<default name="turn" .../>`: the parameter $turn receives the camera's heading, degrees about +Y, 0 looking along -Z;
- `<default name="floor" .../>`: $floor receives the object's lowest y; shapes whose id starts with "floor" are left
  out for cameras below it and without a backdrop;
- `<default name="hdri" .../>`: $hdri receives the caller's environment map.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import MITSUBA_FROM_OPENCV, Camera
from mistyle.core.drjit_arrays import aligned, whole
from mistyle.core.errors import InputRefused
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import Mesh, weld
from mistyle.core.paths import scenes
from mistyle.geometry.tangents import corner_tangents
from mistyle.process import memory
from mistyle.render.mitsuba import device, plugins
from mistyle.render.mitsuba.device import dr, mi

TEMPLATES = ("paper_views", "phase1_directional", "phase2_ambient", "studio", "hdri")

# Reflectance models and frames of normal maps; `plugins.py` adds those that Mitsuba lacks.
Model = Literal["principled", "gltf"]
Frame = Literal["mitsuba", "mikkt"]

# `mi.traverse` names of the optimised textures, for texture set {p}; of every model and frame.
PARAMETERS = {
    "albedo": "part{p}.bsdf.brdf_0.nested_bsdf.base_color.data",
    "normal": "part{p}.bsdf.brdf_0.normalmap.data",
    "roughness": "part{p}.bsdf.brdf_0.nested_bsdf.roughness.data",
    "metallic": "part{p}.bsdf.brdf_0.nested_bsdf.metallic.data",
}

NEUTRAL_GREY = 0.5


def parameters(part: int) -> dict[str, str]:
    """The traverse names of the four maps of texture set `part`: albedo, normal (encoded 0..1), roughness, metallic."""
    return {name: pattern.format(p=part) for name, pattern in PARAMETERS.items()}


def mitsuba_mesh(
    mesh: Mesh,
    part: int | None,
    bsdf: Any = None,
    name: str = "object",
    *,
    tangents: Float[np.ndarray, "f 3 4"] | None = None,
    emitter: Any = None,
) -> Any:
    """A Mitsuba mesh of one texture set (None: of all faces), faces in the order of `Mesh.faces`.

    v is flipped only here: Mitsuba's texture row 0 is v = 0, ours is v = 1. `bsdf` and `emitter` are loaded. `tangents`
    (of all the mesh's faces, from `mikktspace`) become the attributes that `mistyle_normalmap` reads.
    """
    device.use()
    welded = weld(mesh, part)
    attributes: dict[str, Any] = {}
    if tangents is not None:
        chosen = tangents if part is None else tangents[mesh.part == part]
        welded, attributes = plugins.with_tangents(welded, chosen)
    props = mi.Properties()
    if bsdf is not None:
        props["mesh_bsdf"] = bsdf
    if emitter is not None:
        props["mesh_emitter"] = emitter
    shape = mi.Mesh(
        name, len(welded.positions), len(welded.faces), props=props, has_vertex_normals=True, has_vertex_texcoords=True
    )
    uvs = np.stack([welded.uvs[:, 0], 1 - welded.uvs[:, 1]], axis=1)
    values = mi.traverse(shape)
    # One update for all: an update that names only the positions recomputes the normals.
    values["vertex_positions"] = mi.Float(aligned(welded.positions.ravel()))
    values["vertex_normals"] = mi.Float(aligned(welded.normals.ravel()))
    values["vertex_texcoords"] = mi.Float(aligned(uvs.ravel()))
    values["faces"] = mi.UInt32(aligned(welded.faces.ravel(), np.uint32))
    values.update()
    for key, data in attributes.items():
        shape.add_attribute(key, data.shape[1], aligned(data.ravel()))
    dr.eval(values["vertex_positions"], values["vertex_normals"], values["vertex_texcoords"])
    return shape


def texture_dict(values: Float[np.ndarray, "h w c"]) -> dict:
    """A float texture without colour conversion; unlike 8-bit textures it is differentiable.

    It repeats, since `Mesh.corner_uvs` are modulo 1: an island may cross the border of the unit square.
    """
    data = mi.TensorXf(whole(values))
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def encoded(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """A normal map in texture encoding: (n + 1) / 2."""
    return encoded_into(memory.empty(normal.shape), normal)


def encoded_into(result: Float[np.ndarray, "h w 3"], normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """`encoded`, written into `result`."""
    np.multiply(normal, np.float32(0.5), out=result)
    return np.add(result, np.float32(0.5), out=result)


def bsdf_dict(
    maps: Maps, flip_invalid: bool = False, *, model: Model = "principled", frame: Frame = "mitsuba"
) -> dict[str, Any]:
    """twosided(normalmap(model)) with four textures; the normal texture holds (n + 1) / 2.

    Shadowing correction is off, as in glTF viewers. Dielectric index 1.5. A perturbed normal that faces away from the
    camera is black, with no gradient. `flip_invalid` tilts it the other way instead; this suits pictures, but not
    gradients (it depends on the view and mirrors them). `frame` "mikkt" needs a mesh with tangents. The plugins of
    `model` "gltf" and `frame` "mikkt" are registered with Mitsuba's current variant.
    """
    textures = {
        "base_color": texture_dict(maps.albedo),
        "roughness": texture_dict(maps.roughness[..., None]),
        "metallic": texture_dict(maps.metallic[..., None]),
        "specular": 0.5,
    }
    normal = {
        "normalmap": texture_dict(encoded(maps.normal)),
        "flip_invalid_normals": flip_invalid,
        "bsdf": {"type": {"principled": "principled", "gltf": plugins.GLTF}[model], **textures},
    }
    if frame == "mitsuba":
        normal = {"type": "normalmap", "use_shadowing_function": False, **normal}
    elif frame == "mikkt":
        normal = {"type": plugins.NORMALMAP, **normal}
    else:
        raise ValueError(f"frame is {frame!r}; expected 'mitsuba' or 'mikkt'")
    if model == "gltf" or frame == "mikkt":
        plugins.register()
    return {"type": "twosided", "bsdf": normal}


def object_shapes(
    mesh: Mesh,
    maps: Sequence[Maps] | None,
    flip_invalid: bool = False,
    *,
    model: Model = "principled",
    frame: Frame = "mitsuba",
) -> dict[str, Any]:
    """One loaded shape per texture set, by name; `maps` None means neutral grey. Reusable in many scenes.

    `frame` "mikkt" shades normal maps in MikkTSpace frames, as glTF viewers do.
    """
    device.use()
    chosen = list(maps) if maps is not None else [flat_maps(2, NEUTRAL_GREY)] * len(mesh.parts)
    if len(chosen) != len(mesh.parts):
        raise ValueError(
            f"{len(chosen)} maps for {len(mesh.parts)} texture sets; expected one for each ({', '.join(mesh.parts)})"
        )
    tangents, shapes = corner_tangents(mesh) if frame == "mikkt" else None, {}
    for p in range(len(mesh.parts)):
        if (mesh.part == p).any():
            bsdf = mi.load_dict(bsdf_dict(chosen[p], flip_invalid, model=model, frame=frame))
            shapes[f"part{p}"] = mitsuba_mesh(mesh, p, bsdf, f"part{p}", tangents=tangents)
    return shapes


def samples(spp: int) -> int:
    """The least valid number of samples for one `mi.render` at or above `spp`: 2, 8 or a power of four.

    With a power of two no two threads share a pixel, so sums are reproducible; the sampler rounds other numbers.
    """
    if spp < 1:
        raise ValueError(f"spp is {spp}; expected 1 or more")
    return next(n for n in (1, 2, 4, 8, *(4**k for k in range(2, 17))) if n >= spp)


def passes(spp: int) -> tuple[int, int]:
    """Number of passes and samples a pass that average to at least `spp` samples a pixel.

    Their product is a power of two; a pass has at most 64 samples, which bounds the memory of large pictures.
    """
    total = 1 << (spp - 1).bit_length()
    each = 16 if total == 32 else min(total, 64)
    return total // each, each


def sensor_dict(camera: Camera, spp: int = 8, seed: int = 0) -> dict:
    """A perspective sensor that matches `core/camera.py` exactly; box filter: pixels are independent.

    Correlated multi-jittered samples: the error of views at 16 per pixel is that of 44 independent samples. Render with
    `samples(spp)`.
    """
    height, width = camera.size
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": camera.fov,
        "near_clip": 0.01,
        "far_clip": 1e4,
        "principal_point_offset_x": 0.5 - camera.centre[0] / width,
        "principal_point_offset_y": 0.5 - camera.centre[1] / height,
        "to_world": mi.ScalarTransform4f(camera.world_from_cam @ MITSUBA_FROM_OPENCV),
        "sampler": {"type": "multijitter", "sample_count": samples(spp), "seed": seed},
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def template_path(template: str | Path) -> Path:
    """The scene file of a template's name, or the user's own file."""
    if isinstance(template, str) and template in TEMPLATES:
        return scenes() / f"{template}.xml"
    path = Path(template)
    if not path.is_file():
        raise InputRefused(f"no scene '{template}': expected one of {', '.join(TEMPLATES)} or a Mitsuba scene file.")
    return path


def follows_camera(template: str | Path) -> bool:
    """Whether a template's surroundings depend on the camera: they turn or move with it, or are left out for cameras
    from below."""
    text = template_path(template).read_text(encoding="utf-8", errors="replace")
    return bool(re.search(r'<default\s+name="turn"|id="(camera_|floor)|<include', text))


def read_template(template: str | Path, *, hdri: Float[np.ndarray, "eh ew 3"] | None = None, **values: float) -> Any:
    """Load a template; `hdri` and `values` (turn, floor) are passed on only if the file declares them as `<default>`.

    The file itself is trusted: Mitsuba opens all files that it names. `hdri` is linear radiance, latitude-longitude, +Y
    up. Raises InputRefused if the file is not a readable scene, has no shape "object", or does not accept an `hdri`.
    """
    device.use()
    path = template_path(template)
    declared = set(re.findall(r'<default\s+name="(\w+)"', path.read_text(encoding="utf-8", errors="replace")))
    defines: dict[str, Any] = {name: repr(float(value)) for name, value in values.items() if name in declared}
    if hdri is not None and "hdri" not in declared:
        raise InputRefused(f'{path}: accepts no environment map; it needs <default name="hdri" value="..."/>.')
    with TemporaryDirectory() as folder:
        try:
            with device.file_threads():
                if hdri is not None:
                    defines["hdri"] = str(Path(folder, "hdri.exr"))
                    mi.Bitmap(np.ascontiguousarray(hdri, np.float32)).write(defines["hdri"])
                # Merging meshes, an optimisation of the loader, would lose their ids.
                scene = mi.load_file(str(path), optimize=False, **defines)
        except RuntimeError as error:
            raise InputRefused(f"{path}: Mitsuba cannot load this scene. {error}") from error
    if not isinstance(scene, mi.Scene) or all(shape.id() != "object" for shape in scene.shapes()):
        ids = ", ".join(shape.id() for shape in scene.shapes()) if isinstance(scene, mi.Scene) else "not a scene"
        raise InputRefused(
            f'{path}: needs a shape with id="object", the slot for the mesh; found {ids or "no shapes"}.'
        )
    return scene


@dataclass(frozen=True)
class Staging:
    """Surroundings of the object, and sampling.

    template  a name of `scenes/` or a file: lights, floor and integrator; `hdri` replaces the map of its environment
    spp       samples a pixel, with random seed `seed`
    backdrop  whether the floor is visible
    """

    template: str | Path = "studio"
    spp: int = 64
    seed: int = 0
    hdri: Float[np.ndarray, "eh ew 3"] | None = None
    backdrop: bool = True


STUDIO = Staging()


def scene_dict(
    mesh: Mesh,
    maps: Sequence[Maps] | None,
    camera: Camera | None,
    staging: Staging,
    shapes: dict[str, Any] | None = None,
) -> dict:
    """The scene as a dictionary for `mi.load_dict`, with a sensor if a camera is given.

    `maps` None: neutral grey. `shapes` (of `object_shapes`) avoids building the object again; mesh and maps are then
    ignored, except for the floor's height. Emitters with ids "camera_…" are placed for `camera` (without one they keep
    the file's transform).
    """
    device.use()
    floor = float(mesh.positions[:, 1].min()) if len(mesh.positions) else -1.0
    heading = _heading(camera) if camera is not None else 0.0
    loaded = read_template(staging.template, hdri=staging.hdri, turn=heading, floor=floor)
    result: dict[str, Any] = {"type": "scene", "integrator": loaded.integrator()}
    below = camera is not None and camera.position[1] < floor
    for k, shape in enumerate(loaded.shapes()):
        if shape.id() == "object" or (shape.id().startswith("floor") and (below or not staging.backdrop)):
            continue
        result[_key(shape.id(), f"shape{k}")] = shape
    for k, emitter in enumerate(loaded.emitters()):
        # An emitter of a shape is loaded with the shape.
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            result[_key(emitter.id(), f"emitter{k}")] = emitter
    if camera is not None:
        sensors = loaded.sensors()
        for key, to_world in camera_emitters(result, sensors[0] if sensors else None, camera).items():
            values = mi.traverse(result[key])
            values["to_world"] = to_world
            values.update()
        result["sensor"] = sensor_dict(camera, staging.spp, staging.seed)
    result.update(shapes if shapes is not None else object_shapes(mesh, maps))
    return result


def camera_emitters(emitters: dict[str, Any], sensor: Any, camera: Camera) -> dict[str, Any]:
    """Transforms of the emitters "camera_…" for `camera`: moved rigidly from the file's sensor."""
    result: dict[str, Any] = {}
    if sensor is None:
        return result
    old = _matrix(sensor)
    moved = camera.world_from_cam @ MITSUBA_FROM_OPENCV @ np.linalg.inv(old)
    for key, emitter in emitters.items():
        if key.startswith("camera_"):
            result[key] = mi.AffineTransform4f(mi.Matrix4f(moved @ _matrix(emitter)))
    return result


def _matrix(plugin: Any) -> Float[np.ndarray, "4 4"]:
    return np.asarray(mi.traverse(plugin)["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def _heading(camera: Camera) -> float:
    """Degrees about +Y from a camera on the +Z axis; for vertical views the up vector decides."""
    x, z = camera.position[0], camera.position[2]
    if np.hypot(x, z) < 1e-6:
        x, z = camera.world_from_cam[0, 1], camera.world_from_cam[2, 1]
    return float(np.degrees(np.arctan2(x, z)))


def _key(name: str, otherwise: str) -> str:
    """A usable dictionary key: Mitsuba's automatic ids start with an underscore."""
    return name if re.fullmatch(r"[A-Za-z]\w*", name) else otherwise
