"""The rivals: `naive_fit.py` run as a program of its own, on the same pictures, for the same time.

The naive loop knows Mitsuba's own frames of normal maps only. Where the references were drawn in MikkTSpace frames, its
maps are judged relit in its own frame; as texels its normals are compared as they stand, though the two frames are
turned against one another by 1.1 to 1.4 degrees on average, which moves a normal that leans 9 degrees by 0.2.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.material_recovery.pictures import FOV, Shot, sensor_to_world
from benchmarks.material_recovery.truth import Truth
from mistyle.core.light import Directional, direction_in_world
from mistyle.core.maps import Maps
from mistyle.io.images.write import write_exr
from mistyle.render.mitsuba.scene import mitsuba_mesh

NAIVE = Path(__file__).with_name("naive_fit.py")


def write_job(folder: Path, truth: Truth, shots: Sequence[Shot], pictures: Sequence[np.ndarray]) -> None:
    """The folder that `naive_fit.py` reads. The lights must be directional."""
    folder.mkdir(parents=True, exist_ok=True)
    shapes = []
    for p, texels in enumerate(truth.texels):
        mitsuba_mesh(truth.mesh, p).write_ply(str(folder / f"part{p}.ply"))
        shapes.append({"file": f"part{p}.ply", "texture": len(texels.covered)})
    entries = []
    for k, (shot, picture) in enumerate(zip(shots, pictures, strict=True)):
        write_exr(folder / f"{k:03d}.exr", dict(zip("RGB", np.moveaxis(picture[..., :3], -1, 0), strict=True)))
        lights = []
        for light in shot.lights:
            if not isinstance(light, Directional):
                raise ValueError(f"the naive loop knows directional lights, not {type(light).__name__}")
            travels = (-direction_in_world(light, shot.camera)).tolist()
            lights.append({"direction": travels, "irradiance": list(light.irradiance)})
        entries.append({"file": f"{k:03d}.exr", "to_world": sensor_to_world(shot.camera).tolist(), "lights": lights})
    (folder / "job.json").write_text(json.dumps({"fov": FOV, "shapes": shapes, "pictures": entries}, indent=1))


# Options of each loop; the converged ones end where their loss settles, or after CONVERGED times our seconds.
LOOPS = {
    "naive": (),
    "naive_pyramid": ("--pyramid",),
    "naive_prb": ("--integrator", "prb"),
    "naive_prb_pyramid": ("--integrator", "prb", "--pyramid"),
}
LOOPS |= {f"{name}_converged": (*options, "--converge") for name, options in LOOPS.items()}
CONVERGED = 10


@dataclass(frozen=True)
class NaiveFit:
    """Maps of a loop, its steps and seconds, and whether its loss had settled."""

    maps: list[Maps]
    steps: float
    seconds: float
    settled: bool


def naive(folder: Path, truth: Truth, seconds: float, name: str) -> NaiveFit:
    """Run the loop `name` of LOOPS on `write_job`'s folder for `seconds`, a converged one for at most CONVERGED times
    as many."""
    options = LOOPS[name]
    seconds *= CONVERGED if "--converge" in options else 1
    out = folder / "maps.npz"
    command = [
        sys.executable,
        "-P",
        str(NAIVE),
        str(folder),
        "--seconds",
        f"{seconds:.2f}",
        "--out",
        str(out),
        *options,
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr[-3000:]}")
    with np.load(out, allow_pickle=False) as found:
        maps = [
            Maps(
                *(found[f"{name}_{k}"].astype(np.float32) for name in ("albedo", "normal", "roughness", "metallic")),
                known=texels.covered.copy(),
            )
            for k, texels in enumerate(truth.texels)
        ]
        return NaiveFit(maps, float(found["steps"]), float(found["seconds"]), bool(found["converged"]))
