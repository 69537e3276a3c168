"""Inputs of external renderers (subject, view, exchange files), and the processes that run them."""

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.camera import OPENGL_FROM_OPENCV, Camera
from mistyle.core.errors import EnvironmentMissing, MistyleError
from mistyle.core.image import resize
from mistyle.core.light import Lights
from mistyle.core.maps import Maps
from mistyle.render.lookdev import scenes as lookdev
from mistyle.render.lookdev.scenes import material_maps
from mistyle.render.mitsuba.scene_folder import write_scene

TIMEOUT = 6 * 3600.0


@dataclass(frozen=True)
class RenderView:
    """One picture to render: a camera and a light of a mesh, or a sensor of a scene file."""

    name: str
    camera: Camera | None = None
    lights: Lights = ()
    sensor: int = 0


@dataclass(frozen=True)
class Subject:
    """The mesh or scene to render. `folder` is for files that renderers need; `asset` is None for a scene file."""

    path: Path
    folder: Path
    asset: Any = None
    export: bool = False
    threads: int = 0


def exported(subject: Subject, shot: RenderView) -> Path:
    """The shot as a Mitsuba scene file that any Mitsuba renders, with Mitsuba's own material."""
    folder = subject.folder / f"scene_{shot.name}"
    if not (folder / "scene.xml").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        if shot.camera is None:
            raise ValueError("a mesh needs a camera")
        maps = [material_maps(m) for m in subject.asset.materials]
        path = write_scene(folder, "scene", subject.asset.mesh, maps, [shot.camera], shot.lights)
        # The environment lights the asset but stays invisible, as everywhere in a comparison.
        text = path.read_text(encoding="utf-8")
        mark = '<integer name="max_depth" value="6" />'
        path.write_text(text.replace(mark, mark + '<boolean name="hide_emitters" value="true"/>'), encoding="utf-8")
    return folder / "scene.xml"


def as_glb(subject: Subject) -> Path:
    """The file itself if it is glTF; any other mesh is written as GLB."""
    if subject.path.suffix.lower() in (".glb", ".gltf"):
        return subject.path
    path = subject.folder / "asset.glb"
    if not path.is_file():
        write_asset_glb(path, subject.asset)
    return path


def write_asset_glb(path: Path, asset: Any) -> None:
    """Write an asset with its own material by our exporters: a glTF is patched, any other format written anew."""
    from mistyle.io.gltf.write import patch_glb, write_glb

    maps = [_of_one_size(material_maps(m)) for m in asset.materials]
    occlusion = [np.ones(m.roughness.shape, np.float32) for m in maps]
    write = patch_glb if asset.source.kind in ("glb", "gltf") else write_glb
    write(path, asset, maps, occlusion, name=asset.name)


def _of_one_size(maps: Maps) -> Maps:
    """All maps at the largest map's size: a glTF texture holds roughness and metalness together."""
    planes = {name: getattr(maps, name) for name in ("albedo", "normal", "roughness", "metallic")}
    size = max((p.shape[:2] for p in planes.values()), key=lambda s: s[0] * s[1])
    even = {name: resize(p, size, "repeat") for name, p in planes.items()}
    normal = even["normal"] / np.linalg.norm(even["normal"], axis=-1, keepdims=True)
    return Maps(**(even | {"normal": normal.astype(np.float32)}), known=np.ones(size, bool))


def user_camera(asset: Any, camera: Camera) -> tuple[np.ndarray, float]:
    """The camera in the file's own world (OpenGL axes), and the length of a working unit there."""
    user_from_work = np.linalg.inv(asset.source.work_from_user)
    scale = float(np.cbrt(np.linalg.det(user_from_work[:3, :3])))
    matrix = user_from_work @ camera.world_from_cam @ OPENGL_FROM_OPENCV
    matrix[:3, :3] /= scale
    return matrix, scale


def scene_for(subject: Subject, shot: RenderView, spp: int, seed: int) -> Path:
    """The file for {scene} in a command: the scene file, or for a mesh a JSON that names mesh, camera, lights and an
    equal Mitsuba scene file."""
    if subject.asset is None or shot.camera is None:
        return subject.path.resolve()
    from mistyle.io.images.write import write_exr

    xml = exported(subject, shot)
    sky = xml.with_name("blender_environment.exr")
    if not sky.is_file():
        radiance = lookdev.blender_environment(shot.lights)
        write_exr(sky, dict(zip("RGB", np.moveaxis(radiance, -1, 0), strict=True)))
    matrix, _ = user_camera(subject.asset, shot.camera)
    text = {
        "mesh": str(subject.path.resolve()),
        "mitsuba": str(xml.resolve()),
        "size": list(shot.camera.size[::-1]),
        "fov_x": shot.camera.fov,
        "camera": matrix.tolist(),
        "axes": "OpenGL: x right, y up, z backward; the mesh file's own world",
        "suns": lookdev.suns(shot.lights, shot.camera),
        "environment": str(sky.resolve()),
        "environment_axes": "equirectangular as Blender reads it, after the glTF importer's turn to Z up",
        "depth": lookdev.DEPTH,
        "spp": spp,
        "seed": seed,
    }
    path = xml.with_name(f"job_{spp}_{seed}.json")
    path.write_text(json.dumps(text, indent=1))
    return path.resolve()


def run_job(program: Sequence[str], path: Path, job: Mapping[str, Any], name: str) -> dict[str, Any]:
    path.write_text(json.dumps(job))
    finished([*program, str(path)], name)
    done = Path(f"{path}.done")
    if not done.is_file():
        raise MistyleError(f"{name}: the renderer exited without a result")
    return json.loads(done.read_text())


def finished(words: Sequence[str], name: str) -> None:
    # Variables of this process's environment would mislead another environment's Python.
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    try:
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", env=clean, timeout=TIMEOUT)
    except OSError as error:
        raise EnvironmentMissing(f"{name}: {words[0]} cannot be run ({error.strerror}); check the path") from error
    except subprocess.TimeoutExpired as error:
        raise MistyleError(f"{name}: no result within {TIMEOUT / 3600:.0f} hours") from error
    if done.returncode != 0:
        output = (done.stderr.strip() or done.stdout.strip())[-1500:]
        raise MistyleError(f"{name}: {Path(words[0]).name} ended with {done.returncode}:\n{output}")
