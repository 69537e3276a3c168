"""Does an asset look the same in Blender's Cycles as in our Mitsuba scene? `python -m benchmarks.blender ASSET.glb`

Blender is a check, not a dependency: bpy (GPL-3.0) lives in an environment of its own, named by --blender or
$MISTYLE_BLENDER_PYTHON (`python3.11 -m venv E && E/bin/pip install bpy==5.0.1`), and runs as a process of its own.
One sun and a constant sky light the asset from the same camera on both sides. Prints the alpha overlap, the mean
ratio and the relative error; writes both pictures side by side.
"""

import argparse
import json
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.common import finish
from mistyle.core.asset import Asset
from mistyle.core.camera import OPENGL_FROM_OPENCV, Camera, orbit
from mistyle.core.image import srgb_from_linear

SUN = {"direction": [0.5, 0.7, 0.6], "irradiance": 2.0}
SKY = 0.4


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.blender", description=__doc__)
    options.add_argument("assets", nargs="+", type=Path, metavar="ASSET.glb")
    options.add_argument("--blender", default=os.environ.get("MISTYLE_BLENDER_PYTHON"), help="Python with bpy")
    options.add_argument("--size", type=int, default=384)
    options.add_argument("--samples", type=int, default=64)
    options.add_argument("--pictures", type=Path, help="folder for the side-by-side pictures")
    options.add_argument("--quick", action="store_true", help="128 pixels, 16 samples")
    options.add_argument("--json", type=Path)
    chosen = options.parse_args()
    if not chosen.blender:
        options.error("needs --blender PYTHON or $MISTYLE_BLENDER_PYTHON: a Python in which `import bpy` works")
    size, samples = (128, 16) if chosen.quick else (chosen.size, chosen.samples)
    figures: dict[str, float] = {}
    for path in chosen.assets:
        figures |= {
            f"{path.stem}.{k}": v for k, v in compare(path, chosen.blender, size, samples, chosen.pictures).items()
        }
    finish(figures, chosen.json)


def compare(path: Path, blender: str, size: int, samples: int, pictures: Path | None) -> dict[str, float]:
    """Render one asset on both sides and measure how far apart the pictures are."""
    from mistyle.io.read_mesh import read_mesh

    asset = read_mesh(path, uv="keep")
    camera = orbit(35.0, 15.0, distance=4.0, fov=30.0, size=(size, size))
    ours = draw(asset, camera, samples)
    theirs = cycles(path, asset, camera, samples, blender)
    both = (ours[..., 3] > 0.99) & (theirs[..., 3] > 0.99)
    a, b = ours[both][:, :3], theirs[both][:, :3]
    union = ((ours[..., 3] > 0.5) | (theirs[..., 3] > 0.5)).sum()
    figures = {
        "alpha_iou": float(((ours[..., 3] > 0.5) & (theirs[..., 3] > 0.5)).sum() / max(union, 1)),
        "mean_ratio": float(a.mean() / b.mean()),
        "relative_error": float(np.abs(a - b).mean() / b.mean()),
        "correlation": float(np.corrcoef(a.ravel(), b.ravel())[0, 1]),
        # An asset that came out mirrored would agree better with the mirrored picture.
        "correlation_mirrored": float(np.corrcoef(ours[..., :3].ravel(), theirs[:, ::-1, :3].ravel())[0, 1]),
    }
    if pictures is not None:
        from mistyle.io.images.write import write_png

        pictures.mkdir(parents=True, exist_ok=True)
        pair = np.concatenate([image[..., :3] + 0.8 * (1 - image[..., 3:]) for image in (ours, theirs)], axis=1)
        write_png(pictures / f"{path.stem}_mitsuba_cycles.png", srgb_from_linear(pair))
    return figures


def draw(asset: Asset, camera: Camera, samples: int) -> np.ndarray:
    """Our side: linear rgb and alpha."""
    import mitsuba as mi

    from mistyle.render.lookdev.scenes import material_maps
    from mistyle.render.mitsuba import device
    from mistyle.render.mitsuba.scene import object_shapes, sensor_dict
    from mistyle.render.mitsuba.scene import samples as allowed

    device.use()
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5, "hide_emitters": True},
        "sensor": sensor_dict(camera, samples),
        "sky": {"type": "constant", "radiance": SKY},
        "sun": {"type": "directional", "direction": [-x for x in SUN["direction"]], "irradiance": SUN["irradiance"]},
    }
    scene |= object_shapes(asset.mesh, [material_maps(m) for m in asset.materials])
    return np.array(mi.render(mi.load_dict(scene), spp=allowed(samples)), dtype=np.float32)


def cycles(path: Path, asset: Asset, camera: Camera, samples: int, blender: str) -> np.ndarray:
    """Blender's side, in a process of its own."""
    from mistyle.io.read import read_exr

    user_from_work = np.linalg.inv(asset.source.work_from_user)
    scale = float(np.cbrt(np.linalg.det(user_from_work[:3, :3])))
    world_from_cam = user_from_work @ camera.world_from_cam @ OPENGL_FROM_OPENCV
    world_from_cam[:3, :3] /= scale
    with tempfile.TemporaryDirectory() as folder:
        job = {
            "glb": str(path.resolve()),
            "out": str(Path(folder) / "picture.exr"),
            "size": camera.size[0],
            "fov_x": camera.fov,
            "camera": world_from_cam.tolist(),
            "distance": 4.0 * scale,
            "samples": samples,
            "threads": os.cpu_count() or 1,
            "sun": SUN,
            "sky": SKY,
        }
        settings = Path(folder) / "job.json"
        settings.write_text(json.dumps(job))
        script = Path(__file__).with_name("scene.py")
        done = subprocess.run([blender, str(script), str(settings)], capture_output=True, text=True)
        if done.returncode != 0:
            raise SystemExit(f"Blender failed on {path}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
        layers = read_exr(Path(job["out"]))
    return np.stack([layers[c] for c in "RGBA"], axis=-1)


if __name__ == "__main__":
    main()
