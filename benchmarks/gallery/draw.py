"""Both sides of benchmarks.gallery: our picture of every model, and Blender's."""

import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera, orbit
from mistyle.core.errors import MistyleError
from mistyle.core.light import Ambient, SphericalGaussian
from mistyle.io.images.write import write_exr
from mistyle.io.read import read_exr
from mistyle.io.read_mesh import read_mesh
from mistyle.render.external.blender import blender_command

# A sky without edges: what differs is the model then, not the noise of two ways to sample small lamps.
LIGHTS = (
    Ambient((0.25, 0.27, 0.3)),
    SphericalGaussian((-0.6, 0.64, 0.48), 8.0, (3.2, 3.0, 2.7)),
    SphericalGaussian((0.8, 0.36, -0.48), 6.0, (0.9, 1.1, 1.5)),
    SphericalGaussian((0.6, 0.0, 0.8), 12.0, (0.8, 0.6, 0.5)),
)
WORKER = str(Path(__file__).with_name("worker.py"))
MENDED = str(Path(__file__).with_name("mended_worker.py"))
TRIES = 20  # crashes of Blender that are lived with


@dataclass(frozen=True)
class Drawn:
    """A model's two pictures, premultiplied linear (h w 4), and what was said of it.

    notes     the reader's sentences, or the one that refuses the file
    refused   whether mistyle refused it
    job       Blender's job (see mistyle/render/external/cycles_worker.py); None where there is no camera for it
    trouble   why Blender made no picture
    mend      what was corrected in Blender's import (mended_worker.py), "" for nothing
    """

    model: str
    slug: str
    notes: tuple[str, ...]
    refused: bool = False
    ours: Float[np.ndarray, "h w 4"] | None = None
    theirs: Float[np.ndarray, "h w 4"] | None = None
    job: dict[str, Any] | None = None
    trouble: str = ""
    mend: str = ""


def draw_ours(folder: Path, models: Mapping[str, str], out: Path, size: int, samples: int) -> list[Drawn]:
    """Read and draw every model (name -> mend); a refusal is a result."""
    from mistyle.render.lookdev import scenes as lookdev

    camera = orbit(35.0, 15.0, distance=4.0, fov=30.0, size=(size, size))
    environment = out / "environment.exr"
    sky = lookdev.blender_environment(LIGHTS)
    write_exr(environment, dict(zip("RGB", np.moveaxis(sky, -1, 0), strict=True)))
    result = []
    for k, (name, mend) in enumerate(models.items()):
        print(f"{k + 1}/{len(models)} {name}", file=sys.stderr, flush=True)
        result.append(replace(_ours(folder / name, name, camera, samples, environment), mend=mend))
    return result


def _ours(path: Path, name: str, camera: Camera, samples: int, environment: Path) -> Drawn:
    from mistyle.render.lookdev import scenes as lookdev

    slug = re.sub(r"[^A-Za-z0-9]+", "_", name)
    try:
        asset = read_mesh(path)
    except MistyleError as error:
        return Drawn(name, slug, (str(error),), refused=True)
    scene = lookdev.asset_scene(lookdev.asset_shapes(asset), camera, LIGHTS, "path")
    picture = lookdev.drawn(scene, 0, samples, 1)
    job = _job(path, asset, camera, samples, environment)
    return Drawn(name, slug, asset.source.notes, ours=picture, job=job)


def _job(path: Path, asset: Asset, camera: Camera, samples: int, environment: Path) -> dict[str, Any]:
    """What Blender needs. The reader has glTF and USD in metres and Y up; Blender turns both as cycles_worker says."""
    from mistyle.render.external.render_files import user_camera
    from mistyle.render.lookdev import scenes as lookdev

    matrix, scale = user_camera(asset, camera)
    return {
        "glb": str(path.resolve()),
        "size": list(camera.size[::-1]),
        "fov_x": camera.fov,
        "camera": matrix.tolist(),
        "distance": 4.0 * scale,
        "depth": lookdev.DEPTH,
        "threads": os.cpu_count() or 1,
        "suns": [],
        "environment": str(environment.resolve()),
        "shots": [{"spp": samples, "seed": 1}],
    }


def draw_cycles(drawn: Sequence[Drawn], out: Path, blender: str) -> list[Drawn]:
    """Blender's pictures, kept in out/cycles under the contents of their jobs and files."""
    folder = out / "cycles"
    folder.mkdir(parents=True, exist_ok=True)
    places = [_place(folder, d) for d in drawn]
    pairs = list(zip(drawn, places, strict=True))
    _run(blender, WORKER, [_shot(d, place) for d, place in pairs if d.job is not None and not d.mend], folder)
    _run(blender, MENDED, [_shot(d, place) for d, place in pairs if d.job is not None and d.mend], folder)
    return [_with_theirs(d, place) for d, place in pairs]


def _shot(drawn: Drawn, place: Path) -> dict[str, Any]:
    assert drawn.job is not None
    shots = [drawn.job["shots"][0] | {"out": str(place.resolve())}]
    return drawn.job | {"shots": shots} | ({"mend": drawn.mend} if drawn.mend else {})


def _run(blender: str, worker: str, jobs: Sequence[dict[str, Any]], folder: Path) -> None:
    """One worker over its jobs, started again after each crash of Blender."""
    from mistyle.render.lookdev.scenes import CYCLES_WORKER

    if not jobs:
        return
    order = folder / f"jobs_{os.getpid()}.json"
    order.write_text(json.dumps({"settings": str(Path(CYCLES_WORKER).parent), "jobs": jobs}))
    # What leads this process to its own packages would lead Blender's environment astray.
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    for _ in range(TRIES):
        done = subprocess.run([*blender_command(blender, worker), str(order)], env=clean, check=False)
        if done.returncode >= 0:
            break


def _place(folder: Path, drawn: Drawn) -> Path:
    if drawn.job is None:
        return folder / f"{drawn.slug}_none.exr"
    sources = (drawn.job["glb"], drawn.job["environment"], WORKER, *([MENDED] if drawn.mend else []))
    files = (Path(name).read_bytes() for name in sources)
    # Rounded: the last digits of a camera follow how the mesh was read and change nothing that can be seen.
    text = json.dumps(drawn.job | {"camera": np.round(drawn.job["camera"], 5).tolist()} | {"distance": 0}) + drawn.mend
    key = hashlib.sha256(text.encode() + b"".join(files)).hexdigest()[:12]
    return folder / f"{drawn.slug}_{key}.exr"


def _with_theirs(drawn: Drawn, place: Path) -> Drawn:
    if drawn.job is None:
        return drawn
    if not place.is_file():
        said = Path(f"{place}.error")
        text = said.read_text(encoding="utf-8", errors="replace") if said.is_file() else "Blender ended early"
        return replace(drawn, trouble=text.strip()[-300:])
    layers = read_exr(place)
    return replace(drawn, theirs=np.stack([layers[c] for c in "RGBA"], axis=-1))
