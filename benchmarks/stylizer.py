"""What the embedded stylizer costs: `python -m benchmarks.stylizer [--quick] [--json FILE]`

A mesh of 69k faces with UVs (the bunny, unwrapped beforehand) is painted with `starry_night.jpg`, its 2048² atlas baked
and 16 views of 1024² drawn from it. Every count of samples runs in a process of its own, so that kernel compilation and
peak memory count; imports and reading do not. Figures: seconds_250k, seconds_1m, peak_gb_250k, peak_gb_1m (the whole
process, the mesh and the views included) and `250k.<part>` in seconds. --quick: the demo mesh, small.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.common import DATA, ROOT, finish, peak_gb, timed

SCENES = ROOT / "scenes"
COUNTS = {"250k": 250_000, "1m": 1_000_000}


def paint(asset_file: Path, style_file: Path, samples: int, views: int, resolution: int, atlas: int) -> dict:
    """The parts of one stylization, timed; runs in the process that is measured."""
    import numpy as np

    from mistyle.core.camera import rig
    from mistyle.core.settings import RigSettings
    from mistyle.core.view import View
    from mistyle.io.read import read_picture
    from mistyle.io.store.records import load_record
    from mistyle.jobs import start
    from mistyle.stylization.pipeline import painting
    from mistyle.stylization.pipeline import start as stylize_start
    from mistyle.stylization.settings import resolve
    from mistyle.stylization.surface.painter import solve_surface

    settings = resolve(
        None, None, {"surface": {"samples": samples}, "atlas": {"size": atlas}, "rig": {"resolution": resolution}}
    )
    variant = start.start_engines(settings)
    assert "llvm" in variant or "cuda" in variant
    asset = load_record(asset_file)
    style = read_picture(style_file)
    parts: dict[str, float] = {"faces": len(asset.mesh.faces), "before_gb": peak_gb()}

    def nothing(done: float) -> None:
        pass

    solution = timed(parts, "surface", lambda: solve_surface(asset.mesh, style, settings.surface, 0))
    parts["surface_gb"] = peak_gb()
    laid = timed(parts, "rasterise", lambda: stylize_start.lay_out(asset, settings, nothing))
    maps = timed(parts, "bake", lambda: painting.painted(asset, solution, laid, settings))
    blank = []
    for camera in rig(RigSettings(resolution=resolution))[:views]:
        empty = np.zeros((*camera.size, 3), np.float32)
        part = np.zeros(camera.size, np.int32)
        blank.append(View(camera, empty, empty[..., 0], empty, empty[..., :2], part, part > 0, empty[..., 0]))
    timed(parts, "views", lambda: painting.unlit_views(asset, maps, blank, nothing))
    parts["seconds"] = sum(parts[name] for name in ("surface", "rasterise", "bake", "views"))
    parts["peak_gb"] = peak_gb()
    return parts


def measured(arguments: list[str]) -> dict[str, float]:
    """`paint` in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.stylizer", "--one", *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise SystemExit(f"the stylizer ended with {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.stylizer", description=__doc__)
    options.add_argument("--quick", action="store_true", help="the demo mesh with 20,000 samples, 2 views")
    options.add_argument("--json", type=Path, metavar="FILE", help="also write the figures as JSON")
    options.add_argument("--mesh", type=Path, help="another mesh")
    options.add_argument("--style", type=Path, help="another picture")
    options.add_argument("--counts", default="250k,1m", help="which of 250k,1m (default both)")
    options.add_argument("--asset", type=Path, help="where the mesh with its UVs is kept between runs")
    options.add_argument("--one", nargs=6, help=argparse.SUPPRESS)
    chosen = options.parse_args()
    if chosen.one:
        mesh, style, *numbers = chosen.one
        print(json.dumps(paint(Path(mesh), Path(style), *map(int, numbers))))
        return
    mesh = chosen.mesh or (SCENES / "demo.obj" if chosen.quick else DATA / "meshes/plain/stanford-bunny.obj")
    style = chosen.style or (SCENES / "demo_style.png" if chosen.quick else DATA / "styles/starry_night.jpg")
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        asset = chosen.asset or Path(scratch) / "asset"
        if not asset.exists():
            unwrap(mesh, asset)
        if chosen.quick:
            parts = measured([str(asset), str(style), "20000", "2", "256", "512"])
            figures |= {f"quick.{name}": value for name, value in parts.items()}
        else:
            for name in chosen.counts.split(","):
                parts = measured([str(asset), str(style), str(COUNTS[name]), "16", "1024", "2048"])
                figures |= {f"seconds_{name}": parts["seconds"], f"peak_gb_{name}": parts["peak_gb"]}
                figures |= {f"{name}.{part}": value for part, value in parts.items()}
    finish(figures, chosen.json)


def unwrap(mesh: Path, target: Path) -> None:
    """Read a mesh and give it UVs where it has none, out of the measured process."""
    code = (
        "import sys; from pathlib import Path; from mistyle.io.read import read_mesh;"
        "from mistyle.io.store.records import save_record;"
        "save_record(Path(sys.argv[2]), read_mesh(Path(sys.argv[1])))"
    )
    subprocess.run([sys.executable, "-c", code, str(mesh), str(target)], check=True)


if __name__ == "__main__":
    main()
