"""A folder with a Mitsuba scene of a finished asset, for users without mistyle.

    <name>.xml                    shapes, materials, up to MOST_CAMERAS sensors (`mitsuba -s 3`), the lights of one view
    <part>.ply                    one mesh per texture set, in working units
    <part>_{albedo,normal,roughness,metallic}.exr    32-bit float, as the material reads them (raw)
    environment.exr               where an environment lights the scene

`principled` is the material; `normalmap` shades in Mitsuba's own tangent frame, so normals must be converted to it
(`frames.py`).
"""

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from mistyle.core.camera import MITSUBA_FROM_OPENCV, Camera
from mistyle.core.light import (
    Ambient,
    Directional,
    Environment,
    Lights,
    Point,
    SphericalGaussian,
    bake_environment,
    direction_in_world,
    position_in_world,
)
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.core.names import STEM, safe_name
from mistyle.io.images.write import write_exr
from mistyle.render.mitsuba.scene import mitsuba_mesh

MOST_CAMERAS = 64
DATA = {"colorInteropID": "data"}


def write_scene(
    folder: Path, name: str, mesh: Mesh, maps: Sequence[Maps], cameras: Sequence[Camera], lights: Lights
) -> Path:
    """Write the scene and return the XML's path; `maps` hold normals in Mitsuba's frame (see the module).

    Lights that are fixed to the camera are placed for the first of `cameras`. Linear Rec.709 throughout.
    """
    root = Element("scene", version="3.9.0")
    SubElement(root, "default", name="spp", value="64")
    SubElement(SubElement(root, "integrator", type="path"), "integer", name="max_depth", value="6")
    for k, camera in enumerate(cameras[:MOST_CAMERAS]):
        root.append(_sensor(camera, k))
    for k, light in enumerate(lights):
        root.append(_emitter(light, cameras[0], folder, k))
    for p, part in enumerate(mesh.parts):
        if (mesh.part == p).any():
            stem = f"part{p}"
            mitsuba_mesh(mesh, p, name=stem).write_ply(str(folder / f"{stem}.ply"))
            shape = SubElement(root, "shape", type="ply", id=stem)
            # Two hyphens would end an XML comment.
            root[-1].append(ElementTree.Comment(f" {re.sub('-{2,}', '-', safe_name(part, STEM))} "))
            SubElement(shape, "string", name="filename", value=f"{stem}.ply")
            shape.append(_bsdf(folder, stem, maps[p]))
    ElementTree.indent(root, "    ")
    path = folder / f"{name}.xml"
    path.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=False) + b"\n")
    return path


def _sensor(camera: Camera, k: int) -> Element:
    height, width = camera.size
    sensor = Element("sensor", type="perspective", id=f"camera{k}")
    for key, value in {
        "fov": camera.fov,
        "principal_point_offset_x": 0.5 - camera.centre[0] / width,
        "principal_point_offset_y": 0.5 - camera.centre[1] / height,
        "near_clip": 0.01,
        "far_clip": 1e4,
    }.items():
        SubElement(sensor, "float", name=key, value=repr(float(value)))
    SubElement(sensor, "string", name="fov_axis", value="x")
    to_world = camera.world_from_cam @ MITSUBA_FROM_OPENCV
    SubElement(SubElement(sensor, "transform", name="to_world"), "matrix", value=_numbers(to_world.ravel()))
    SubElement(SubElement(sensor, "sampler", type="multijitter"), "integer", name="sample_count", value="$spp")
    film = SubElement(sensor, "film", type="hdrfilm")
    SubElement(film, "integer", name="width", value=str(width))
    SubElement(film, "integer", name="height", value=str(height))
    SubElement(film, "string", name="pixel_format", value="rgba")
    SubElement(film, "rfilter", type="box")
    return sensor


def _emitter(light, camera: Camera, folder: Path, k: int) -> Element:
    if isinstance(light, Directional):
        emitter = Element("emitter", type="directional")
        SubElement(emitter, "vector", name="direction", value=_numbers(-direction_in_world(light, camera)))
        SubElement(emitter, "rgb", name="irradiance", value=_numbers(light.irradiance))
    elif isinstance(light, Point):
        emitter = Element("emitter", type="point")
        SubElement(emitter, "point", name="position", value=_numbers(position_in_world(light, camera)))
        SubElement(emitter, "rgb", name="intensity", value=_numbers(light.intensity))
    elif isinstance(light, Ambient):
        emitter = Element("emitter", type="constant")
        SubElement(emitter, "rgb", name="radiance", value=_numbers(light.radiance))
    elif isinstance(light, Environment | SphericalGaussian):
        emitter = Element("emitter", type="envmap")
        baked = isinstance(light, SphericalGaussian)
        radiance = bake_environment([light]) if baked else light.radiance * np.float32(light.scale)
        file = f"environment{k or ''}.exr"
        write_exr(folder / file, dict(zip("RGB", np.moveaxis(radiance, -1, 0), strict=True)))
        SubElement(emitter, "string", name="filename", value=file)
        if not baked and light.turn:
            turn = SubElement(emitter, "transform", name="to_world")
            SubElement(turn, "rotate", y="1", angle=repr(float(light.turn)))
    else:
        raise ValueError(f"{type(light).__name__} cannot be written to a scene file")
    return emitter


def _bsdf(folder: Path, stem: str, maps: Maps) -> Element:
    two = Element("bsdf", type="twosided")
    bumped = SubElement(two, "bsdf", type="normalmap")
    SubElement(bumped, "boolean", name="use_shadowing_function", value="false")
    SubElement(bumped, "boolean", name="flip_invalid_normals", value="false")
    bumped.append(_texture(folder, stem, "normal", "normalmap", maps.normal * 0.5 + 0.5))
    inner = SubElement(bumped, "bsdf", type="principled")
    SubElement(inner, "float", name="specular", value="0.5")
    inner.append(_texture(folder, stem, "albedo", "base_color", maps.albedo))
    inner.append(_texture(folder, stem, "roughness", "roughness", maps.roughness))
    inner.append(_texture(folder, stem, "metallic", "metallic", maps.metallic))
    return two


def _texture(folder: Path, stem: str, kind: str, slot: str, values: np.ndarray) -> Element:
    file = f"{stem}_{kind}.exr"
    planes = {"Y": values} if values.ndim == 2 else dict(zip("RGB", np.moveaxis(values, -1, 0), strict=True))
    write_exr(folder / file, planes, attributes={} if kind == "albedo" else DATA)
    texture = Element("texture", type="bitmap", name=slot)
    SubElement(texture, "string", name="filename", value=file)
    SubElement(texture, "boolean", name="raw", value="true")
    return texture


def _numbers(values) -> str:
    return ", ".join(repr(float(v)) for v in values)
