"""Renderers by name behind one call: (view, spp, seeds) -> linear pictures and their seconds.

    mitsuba:path  mitsuba:direct  mitsuba:scene   this Mitsuba with that integrator (a scene file: with its defaults);
                                                  "scene" is the scene file's own
    mitsuba@VENV:path                             the Mitsuba of another environment, by its Python
    blender:cycles                                Cycles in the Python that --blender or MISTYLE_BLENDER_PYTHON names
    NAME=command {scene} {out} …                  any other program; also {spp} {seed} {sensor}; no shell is involved

A mesh is rendered with glTF's own reflectance model. If a mitsuba@… takes part, every Mitsuba reads the same exported
scene file with Mitsuba's `principled` material instead, so that versions are compared and not materials.
"""

import os
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mistyle.core.camera import orbit
from mistyle.core.errors import EnvironmentMissing, InputRefused, MistyleError, UsageError
from mistyle.render.external.blender import BLENDER, blender_command
from mistyle.render.external.render_files import (
    RenderView,
    Subject,
    as_glb,
    exported,
    finished,
    run_job,
    scene_for,
    user_camera,
)
from mistyle.render.lookdev import scenes as lookdev
from mistyle.render.lookdev.scenes import asset_shapes, file_scene, integrator_dict, light_rig
from mistyle.render.mitsuba.scene import passes

MITSUBA_VARIANTS = ("cuda_ad_rgb", "metal_ad_rgb", "llvm_ad_rgb", "scalar_rgb")


@dataclass(frozen=True)
class Rendered:
    """Pictures (h w 3 or 4, linear, premultiplied), the seconds of each, and the renderer's version."""

    pictures: tuple[np.ndarray, ...]
    seconds: tuple[float, ...]
    version: str = ""


Draw = Callable[[Subject, RenderView, int, Sequence[int]], Rendered]


@dataclass(frozen=True)
class Renderer:
    """A renderer's display name, its kind, and its call."""

    name: str
    kind: Literal["mitsuba", "other mitsuba", "blender", "command"]
    draw: Draw


def renderer(text: str, blender: str | None = None) -> Renderer:
    """The renderer of a --with. UsageError lists the available ones, EnvironmentMissing names a missing program."""
    name, equals, command = text.partition("=")
    if equals and name.replace("_", "").replace("-", "").isalnum():
        if "{scene}" not in command or "{out}" not in command:
            raise UsageError(f"--with {text}: expected a command with {{scene}} and {{out}} in it")
        return Renderer(name, "command", lambda *a: _command(name, command, *a))
    who, colon, how = text.rpartition(":")
    if colon and who == "mitsuba" and how.isidentifier():
        return Renderer(text, "mitsuba", lambda *a: _mitsuba(how, *a))
    if colon and who.startswith("mitsuba@") and how.isidentifier():
        python = _python(Path(who.removeprefix("mitsuba@")))
        return Renderer(text, "other mitsuba", lambda *a: _worker(python, how, *a))
    if text == "blender:cycles":
        blender_python = blender or os.environ.get(BLENDER)
        if not blender_python:
            raise EnvironmentMissing(
                f"blender:cycles needs a Python in which `import bpy` works: pip install bpy into an environment of "
                f"its own and name its python with --blender or {BLENDER}"
            )
        return Renderer(text, "blender", lambda *a: _cycles(blender_python, *a))
    raise UsageError(
        f"--with {text}: expected mitsuba:path, mitsuba:direct, mitsuba:scene, mitsuba@VENV:path, blender:cycles, or "
        "NAME='command {scene} {out}'"
    )


def _python(venv: Path) -> str:
    """The Python of an environment, by the environment's folder or the program's path."""
    candidates = [venv] if venv.is_file() else [venv / "bin" / "python", venv / "Scripts" / "python.exe"]
    for path in candidates:
        if path.is_file():
            return str(path)
    raise EnvironmentMissing(f"mitsuba@{venv}: found no python; expected a virtual environment with mitsuba installed")


def subject(path: Path, folder: Path, renderers: Sequence[Renderer], threads: int = 0) -> Subject:
    """Read FILE: a scene file, a mesh, or a run folder of ours with one GLB in `asset/`.

    A scene file (.xml) is trusted like code, since Mitsuba opens all files that it names.
    """
    path = finished_asset(path) if path.is_dir() else path
    if path.suffix.lower() == ".xml":
        if not path.is_file():
            raise InputRefused(f"{path}: found nothing; expected a Mitsuba scene file. Check the path.")
        if any(r.kind == "blender" for r in renderers):
            raise UsageError(f"{path}: Cycles reads no Mitsuba scenes; pass a GLB, or omit blender:cycles")
        return Subject(path, folder, threads=threads)
    from mistyle.io.read_mesh import read_mesh

    asset = read_mesh(path, uv="auto")
    return Subject(path, folder, asset, any(r.kind == "other mitsuba" for r in renderers), threads)


def finished_asset(folder: Path) -> Path:
    """The GLB of a run folder, or of its `asset` folder."""
    files = sorted(folder.glob("*.glb")) or sorted((folder / "asset").glob("*.glb"))
    if len(files) != 1:
        raise InputRefused(f"{folder}: found {len(files)} .glb files; expected one, or one in asset/. Name the file.")
    return files[0]


def left_out(source: Subject) -> list[str]:
    """glTF features that Mitsuba's side does not render: all `features` of a scene exported for other versions, else
    the material extensions, or their textures, that the reader leaves out."""
    from mistyle.io.gltf.shading import DRAWN, READ

    if source.export:
        return features(source)
    names = {n for n in features(source) if n.startswith("KHR_") and n not in (*READ, *DRAWN)}
    for material in _gltf_materials(source):
        for n in set(material.get("extensions", {})) & set(DRAWN) - {"KHR_materials_specular"}:
            names |= {f"textures of {n}" for key in material["extensions"][n] if key.endswith("Texture")}
    return sorted(names)


def features(source: Subject) -> list[str]:
    """The glTF features of a file besides its maps: emission, transparency, material extensions."""
    names: set[str] = set()
    for material in _gltf_materials(source):
        if any(material.get("emissiveFactor", [0, 0, 0])):
            names.add("emission")
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            names.add("transparency")
        names |= {n for n in material.get("extensions", {}) if n.startswith("KHR_materials_")}
    return sorted(names)


def _gltf_materials(source: Subject) -> list[dict[str, Any]]:
    from mistyle.io.read_mesh import load_gltf

    is_gltf = source.path.suffix.lower() in (".glb", ".gltf")
    return load_gltf(source.path)[0].get("materials", []) if is_gltf else []


def shots(source: Subject, lights: Sequence[str], views: int, size: int) -> list[RenderView]:
    """Cameras around a mesh under every light, or the sensors of a scene file."""
    if source.asset is None:
        names = [s.id() for s in file_scene(source.path).sensors()]
        usable = [n if n and not n.startswith(("__", "object_")) else f"sensor{k}" for k, n in enumerate(names)]
        return [RenderView(name, sensor=k) for k, name in enumerate(usable)]
    from mistyle.io.read import read_radiance

    cameras = [orbit(35 + 360 * k / views, 15, distance=4, fov=30, size=(size, size)) for k in range(views)]
    result = []
    for name in lights:
        rig = light_rig(name, read_radiance)
        called = Path(name).stem
        result += [RenderView(f"{called}_{k}" if views > 1 else called, c, rig) for k, c in enumerate(cameras)]
    return result


def _mitsuba(integrator: str, source: Subject, shot: RenderView, spp: int, seeds: Sequence[int]) -> Rendered:
    from importlib.metadata import version

    own = _integrator(integrator, source)
    if source.asset is None or source.export:
        path = source.path if source.asset is None else exported(source, shot)
        scene, sensor = lookdev.file_scene(path), shot.sensor
    elif shot.camera is not None:
        scene = lookdev.asset_scene(_shapes(source), shot.camera, shot.lights, integrator)
        sensor, own = 0, None
    else:
        raise ValueError("a mesh needs a camera")
    pictures, seconds = [], []
    for seed in seeds:
        start = time.perf_counter()
        pictures.append(lookdev.drawn(scene, sensor, spp, seed, own))
        seconds.append(time.perf_counter() - start)
    return Rendered(tuple(pictures), tuple(seconds), f"mitsuba {version('mitsuba')}")


def _integrator(name: str, source: Subject) -> dict[str, Any] | None:
    """For a scene file the plugin with its defaults (None: its own); for a mesh one with hidden emitters."""
    if name == "scene":
        return None
    return {"type": name} if source.asset is None else integrator_dict(name)


# The current asset and its shapes: loading textures takes longer than many renders.
_SHAPES: list[tuple[Any, Any]] = []


def _shapes(source: Subject) -> Any:
    if not _SHAPES or _SHAPES[0][0] is not source.asset:
        _SHAPES[:] = [(source.asset, asset_shapes(source.asset))]
    return _SHAPES[0][1]


def _worker(
    python: str, integrator: str, source: Subject, shot: RenderView, spp: int, seeds: Sequence[int]
) -> Rendered:
    from mistyle.io.read import read_npy

    path = source.path if source.asset is None else exported(source, shot)
    times, each = passes(spp)
    folder = source.folder / f"worker_{abs(hash((python, integrator, shot.name, spp))):x}"
    folder.mkdir(parents=True, exist_ok=True)
    outs = [folder / f"{seed}.npy" for seed in seeds]
    job = {
        "scene": str(path.resolve()),
        "sensor": shot.sensor,
        "integrator": _integrator(integrator, source),
        "variants": list(MITSUBA_VARIANTS),
        "shots": [{"out": str(o), "passes": times, "spp": each, "seed": s} for o, s in zip(outs, seeds, strict=True)],
    }
    done = run_job([python, lookdev.MITSUBA_WORKER], folder / "job.json", job, "mitsuba@")
    pictures = tuple(np.asarray(read_npy(o), np.float32) for o in outs)
    return Rendered(pictures, tuple(done["seconds"]), f"mitsuba {done['mitsuba']} ({done['variant']})")


def _cycles(python: str, source: Subject, shot: RenderView, spp: int, seeds: Sequence[int]) -> Rendered:
    from mistyle.io.images.write import write_exr
    from mistyle.io.read import read_frame

    if shot.camera is None or source.asset is None:
        raise UsageError(f"{source.path}: Cycles reads no Mitsuba scenes; pass a GLB")
    folder = source.folder / f"cycles_{shot.name}_{spp}"
    folder.mkdir(parents=True, exist_ok=True)
    sky = lookdev.blender_environment(shot.lights)
    write_exr(folder / "environment.exr", dict(zip("RGB", np.moveaxis(sky, -1, 0), strict=True)))
    outs = [folder / f"{seed}.exr" for seed in seeds]
    matrix, scale = user_camera(source.asset, shot.camera)
    job = {
        "glb": str(as_glb(source).resolve()),
        "size": list(shot.camera.size[::-1]),
        "fov_x": shot.camera.fov,
        "camera": matrix.tolist(),
        "distance": 4.0 * scale,
        "depth": lookdev.DEPTH,
        "threads": source.threads or os.cpu_count() or 1,
        "suns": lookdev.suns(shot.lights, shot.camera),
        "environment": str((folder / "environment.exr").resolve()),
        "shots": [{"out": str(o.resolve()), "spp": spp, "seed": s} for o, s in zip(outs, seeds, strict=True)],
    }
    done = run_job(blender_command(python, lookdev.CYCLES_WORKER), folder / "job.json", job, "blender:cycles")
    pictures = tuple(_rgba(read_frame(o)) for o in outs)
    return Rendered(pictures, tuple(done["seconds"]), f"blender {done['blender']}")


def _command(name: str, template: str, source: Subject, shot: RenderView, spp: int, seeds: Sequence[int]) -> Rendered:
    from mistyle.io.read import read_frame

    pictures, seconds = [], []
    for seed in seeds:
        folder = source.folder / f"command_{shot.name}_{spp}_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        out = folder / f"{name}.exr"
        fields = {"scene": str(scene_for(source, shot, spp, seed)), "out": str(out), "spp": spp, "seed": seed}
        words = [_filled(word, fields | {"sensor": shot.sensor}) for word in shlex.split(template)]
        start = time.perf_counter()
        finished(words, name)
        seconds.append(time.perf_counter() - start)
        if not out.is_file():
            raise MistyleError(f"{name}: the command succeeded but wrote no {out.name}; expected an EXR at {{out}}")
        pictures.append(_rgba(read_frame(out)))
    return Rendered(tuple(pictures), tuple(seconds), name)


def _filled(word: str, fields: Mapping[str, Any]) -> str:
    """Plain replacement: other braces in the command stay."""
    for key, value in fields.items():
        word = word.replace(f"{{{key}}}", str(value))
    return word


def _rgba(frame: Any) -> np.ndarray:
    beauty, alpha = frame.layer("beauty"), frame.layer("alpha")
    if beauty is None:
        raise InputRefused(f"{frame.path}: found no R, G and B; expected the finished picture.")
    rgb = beauty.values()
    return rgb if alpha is None else np.concatenate([rgb, alpha.values()], axis=2)
