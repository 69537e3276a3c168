"""Fitting to photographs that are finer than the texels: `python -m benchmarks.photographs [--quick] [--json FILE]`

`large`: JPEGs of 12 megapixels of the water bottle by a lens that bends lines, 8 views under 3 lights one at a time,
fitted by `mistyle fit` with an atlas of 1024². (Direct light only, of few views: what it costs is looked at, not what
it finds.) Figures: `large.pictures`, `large.megapixels`, `large.block` (pixels a side that were averaged),
`large.seconds`, `large.peak_gb`, `large.estimate_gb`; and seconds that one picture takes to be read and made straight
(`large.read_seconds`), and where it is not kept to be predicted as it is (`large.predict_seconds`) and averaged
(`large.averaged.predict_seconds`).

`strong`: Suzanne with strong synthetic maps, 16 views x 3 lights by `path`, pictures in which a texel is about four
pixels wide, and the same averaged until it is two and one: `texel_of_4.…`, `texel_of_2.…`, `texel_of_1.…` with
`normal_mean_deg`, `roughness_mse`, `albedo_psnr` and `seconds`. --quick runs it small, and a `large` of 6 pictures of 3
megapixels.

`real_size` (only by `--only real_size`): a fit of an atlas of 4096² to 204 photographs of 12 megapixels (links to 12
renders) within --memory, of the first --passes alone. Figures: `real_size.pictures`, `.megapixels`, `.atlas`,
`.asked_gb`, `.plan_gb`, `.peak_gb` (resident, of all processes together), `.peak_over_plan`, `.seconds`, `.passes`,
`.passes_planned`, `.seconds_planned` and `.seconds_extrapolated`: those of all passes, the latter at the ratio of
seconds to planned seconds of the passes done. `--quick --atlas 512 --pictures 12 --memory 4` only shows that it works.
"""

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from benchmarks.common import DATA, finish, run_mistyle
from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery.metrics import map_errors
from benchmarks.material_recovery.truth import find_asset, truth
from mistyle.atlas.texels import rasterise, start_maps
from mistyle.core.camera import Camera, pixel_centres
from mistyle.core.capture import Captures, in_memory, shrunk
from mistyle.core.image import srgb_from_linear
from mistyle.core.light import Directional, to_json
from mistyle.core.maps import flat_maps
from mistyle.fitting.pipeline.budget import material_gb
from mistyle.fitting.settings.material import MaterialSettings
from mistyle.geometry.lens import Lens, distort
from mistyle.io.cameras.camera_files import transforms
from mistyle.io.cameras.captures import read_captures
from mistyle.io.read_mesh import read_mesh
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba.draw import tracer
from mistyle.solver.recover import recover
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.validate import downsampling_factors

RADIAL = (0.04, -0.02, 0.0)
ATLAS = 1024
PARTS = ("large", "strong", "real_size")
FINEST = 4


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.photographs", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", choices=PARTS, action="append", help="only this part (repeatable)")
    parser.add_argument("--pictures", type=int, default=200, help="of real_size")
    parser.add_argument("--atlas", type=int, default=4096, help="of real_size")
    parser.add_argument("--memory", type=float, default=16.0, help="of real_size, GB")
    parser.add_argument("--passes", type=int, default=1, help="of real_size: the first that run; 0: all")
    parser.add_argument("--keep", type=Path, help="folder for the photographs and the run, to look at afterwards")
    options = parser.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        if "large" in (options.only or ["large"]):
            figures |= large(options.keep or Path(scratch), *((2, 1732) if options.quick else (8, 3464)))
        if "strong" in (options.only or ["strong"]):
            figures |= strong(64 if options.quick else 128)
        if "real_size" in (options.only or []):
            figures |= real_size(options.keep or Path(scratch), options)
    finish(figures, options.json)


def large(place: Path, views: int, side: int) -> dict[str, float]:
    """Photographs made, read, predicted once as they are and averaged, and fitted to."""
    mesh, folder = find_asset("waterbottle", DATA), place / "photographs"
    count = photograph(mesh, folder, views, (side, side))
    captures = read_captures(folder, saturation=0.99)
    asset = read_mesh(mesh)
    by = downsampling_factors([rasterise(asset.mesh, 0, ATLAS)], captures.cameras)
    figures: dict[str, float] = {
        "large.pictures": float(count),
        "large.megapixels": side * side / 1e6,
        "large.block": float(by[0]),
    }
    figures["large.read_seconds"] = _seconds(lambda: captures.load(0))
    for name, seen in (("large", captures), ("large.averaged", shrunk(captures, by))):
        rgb, counts = seen.load(0)
        held = in_memory(seen.cameras[:1], seen.lights[:1], [rgb], [counts])
        figures[f"{name}.predict_seconds"] = _prediction(asset.mesh, held)
    words = ["fit", mesh, folder, "-o", place / "run", "--set", "references.saturation=0.99", "--atlas", ATLAS]
    start = time.perf_counter()
    made = run_mistyle(*words)
    figures |= {"large.seconds": time.perf_counter() - start, "large.peak_gb": made["peak_gb"]}
    told = json.loads((place / "run" / "run.json").read_text())
    settings = MaterialSettings.model_validate(told["settings"])
    figures["large.estimate_gb"] = material_gb(settings, [side * side] * count)
    print(json.dumps(told["seconds"]), file=sys.stderr)
    print({key: round(value, 3) for key, value in figures.items()}, file=sys.stderr, flush=True)
    return figures


def photograph(mesh: Path, folder: Path, views: int, size: tuple[int, int], radial=RADIAL, copies: int = 1) -> int:
    """Write JPEGs of the object in its own material, their cameras and lights; how many. Direct light only.

    `copies` of each are links, with cameras 1e-6 apart, so that no two are one camera.
    """
    folder.mkdir(parents=True, exist_ok=True)
    asset = read_mesh(mesh)
    centre = (size[1] / 2, size[0] / 2)
    cameras = [replace(c, focal=1.25 * c.focal, size=size, centre=centre) for c in drawing.fibonacci(views, size[0])]
    lens = Lens((cameras[0].focal,) * 2, cameras[0].centre, cameras[0].size, radial)
    where = _bent(lens, cameras[0])
    shots = drawing.one_at_a_time(cameras)
    exposure = None
    lit, files, taken = {}, [], []
    for shot, picture in zip(shots, _pictures(asset, shots), strict=True):
        if exposure is None:
            exposure = 0.8 / float(np.quantile(picture[picture.max(axis=-1) > 0], 0.999))
        bent = cv2.remap(picture * exposure, *where, cv2.INTER_LINEAR)
        encoded = (255 * srgb_from_linear(np.clip(bent, 0, 1)) + 0.5).astype(np.uint8)
        lights = tuple(
            replace(light, irradiance=tuple(exposure * x for x in light.irradiance))
            for light in shot.lights
            if isinstance(light, Directional)
        )
        for copy in range(copies):
            pose, name = shot.camera.world_from_cam.copy(), f"{shot.camera.name}_{copy}" if copy else shot.camera.name
            pose[:3, 3] += 1e-6 * copy
            files.append(f"{name}.jpg")
            if copy:
                (folder / files[-1]).symlink_to(files[-1 - copy])
            else:
                cv2.imwrite(str(folder / files[-1]), encoded[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
            taken.append(replace(shot.camera, name=name, world_from_cam=pose))
            lit[name] = lights
    tree = transforms(taken, files)
    tree |= {"camera_model": "OPENCV", "k1": radial[0], "k2": radial[1], "k3": radial[2]}
    (folder / "transforms.json").write_text(json.dumps(tree))
    (folder / "lights.json").write_text(json.dumps(to_json((), lit)))
    return len(taken)


def real_size(place: Path, options: argparse.Namespace) -> dict[str, float]:
    """The first passes of a fit to so many photographs within a budget: its peak, and the seconds of the whole."""
    mesh, folder = find_asset("waterbottle", DATA), place / "real_photographs"
    size = (480, 640) if options.quick else (3000, 4000)
    views = min(4, max(1, options.pictures // 3))
    count = photograph(mesh, folder, views, size, (0.0, 0.0, 0.0), max(1, -(-options.pictures // (3 * views))))
    words = ["fit", mesh, folder, "-o", place / "real_run", "--set", "references.saturation=0.99"]
    words += ["--atlas", options.atlas, "--memory", f"{options.memory:g}G", "--set", "report.frames=4"]
    planned = run_mistyle(*words, "--dry-run")
    words += ["--passes", options.passes]
    first = _rows(run_mistyle(*words, "--dry-run"))
    print({"planned": _rows(planned), "of these passes": first}, file=sys.stderr, flush=True)
    start = time.perf_counter()
    with tree_peak() as most:
        told = run_mistyle(*words)
    seconds, took = time.perf_counter() - start, told["seconds"]
    print({"seconds": took, "peaks_gb": told["peaks_gb"], "planned_gb": planned["peaks_gb"]}, file=sys.stderr)
    figures = {
        "pictures": float(count), "megapixels": size[0] * size[1] / 1e6, "atlas": float(options.atlas),
        "asked_gb": options.memory, "plan_gb": planned["memory_gb"], "peak_gb": most[0] / 1e9,
        "peak_over_plan": most[0] / 1e9 / planned["memory_gb"], "seconds": seconds,
        "passes": float(told["passes"]["done"]), "passes_planned": float(told["passes"]["planned"]),
        "seconds_planned": float(planned["seconds"]),
        "seconds_extrapolated": seconds + took["recover"] * (_rows(planned)["recover"] / first["recover"] - 1),
    }  # fmt: skip
    return {f"real_size.{name}": value for name, value in figures.items()}


def _rows(plan: dict[str, Any]) -> dict[str, float]:
    """The seconds of every stage of a plan."""
    return {row["stage"]: row["seconds"] for row in plan["stages"]}


@contextmanager
def tree_peak() -> Iterator[list[int]]:
    """The most bytes that this process's descendants hold together, read ten times a second: a list of one number."""
    most, done = [0], threading.Event()

    def watch() -> None:
        while not done.wait(0.1):
            most[0] = max(most[0], sum(map(_resident, _descendants(os.getpid()))))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield most
    finally:
        done.set()
        thread.join()


def _descendants(process: int) -> list[int]:
    found, new = [], [process]
    while new:
        try:
            files = Path(f"/proc/{new[-1]}/task").glob("*/children")
            new = [int(child) for file in files for child in file.read_text().split()] + new[:-1]
        except OSError:  # it has ended
            new.pop()
            continue
        found += [child for child in new if child not in found]
    return found


def _resident(process: int) -> int:
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmRSS:"))


def _pictures(asset, shots) -> Iterator[np.ndarray]:
    maps = [start_maps(m, rasterise(asset.mesh, p, 2048), 2048) for p, m in enumerate(asset.materials)]
    traced, table = tracer(asset.mesh), pack(maps)
    for shot in shots:
        empty = np.zeros((*shot.camera.size, 3), np.float32)
        one, options = in_memory([shot.camera], [shot.lights], [empty]), RenderOptions(subsamples=1, memory=0)
        yield MaterialRenderer(traced, one, [m.roughness.shape for m in maps], options).image(table, 0)


def undistort(lens: Lens, sent: Float[np.ndarray, "*n 2"], steps: int = 20) -> Float[np.ndarray, "*n 2"]:
    """The inverse of `distort`, by Newton's method; NaN where it finds no tangent within 1e-9."""
    (k1, k2, k3), (p1, p2) = lens.radial, lens.tangential
    target = np.asarray(sent, float)
    found = target.copy()
    with np.errstate(all="ignore"):
        for _ in range(steps):
            x, y = found[..., 0], found[..., 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))  # of `radial`, by r², twice
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            off = distort(lens, found) - target
            determinant = xx * yy - xy * xy
            step = np.stack([yy * off[..., 0] - xy * off[..., 1], xx * off[..., 1] - xy * off[..., 0]], axis=-1)
            found = found - step / determinant[..., None]
        miss = np.abs(distort(lens, found) - target).max(axis=-1, keepdims=True)
    return np.where(miss < 1e-9, found, np.nan)


def _bent(lens: Lens, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where in the camera's picture each pixel of the photograph lies (OpenCV's pixels), from every 16th of them."""
    height, width = lens.size
    coarse = pixel_centres((height // 16 + 2, width // 16 + 2)) * 16 - 16
    px = undistort(lens, (coarse - np.asarray(lens.centre)) / lens.focal) * camera.focal + np.asarray(camera.centre)
    grid = (pixel_centres(lens.size) + 16) / 16 - 0.5
    x, y = grid[..., 0].astype(np.float32), grid[..., 1].astype(np.float32)
    return tuple(cv2.remap((px[..., axis] - 0.5).astype(np.float32), x, y, cv2.INTER_CUBIC) for axis in (0, 1))


def _prediction(mesh, captures: Captures) -> float:
    """Seconds that the picture takes which is too large to be kept, after everything was compiled."""
    sizes, options = [(ATLAS, ATLAS)] * len(mesh.parts), RenderOptions(subsamples=9, memory=0)
    renderer, table = MaterialRenderer(tracer(mesh), captures, sizes, options), pack([flat_maps(ATLAS)] * len(sizes))
    renderer.image(table, 0)
    return _seconds(lambda: renderer.image(table, 0))


def strong(size: int) -> dict[str, float]:
    """The errors of fits to pictures that are finer than the texels, and to averages of them."""
    known = truth(find_asset("suzanne", DATA), "suzanne", drawing.fibonacci(1, size)[0], "auto", True)
    shots = drawing.one_at_a_time(drawing.fibonacci(16, FINEST * size))
    pictures = drawing.render(known.mesh, known.maps, shots, frame="mikkt", spp=32)
    masks = [picture[..., 3] > 0.999 for picture in pictures]
    fine = in_memory([s.camera for s in shots], [s.lights for s in shots], [p[..., :3] for p in pictures], masks)
    figures: dict[str, float] = {}
    for by in (1, 2, 4):
        name, start = f"texel_of_{FINEST // by}", time.perf_counter()
        captures = shrunk(fine, [by] * len(fine))
        found = recover(known.mesh, known.texels, captures, RecoverSettings(metallic=True), 0)
        figures[f"{name}.seconds"] = time.perf_counter() - start
        errors = asdict(map_errors(known.maps, found.maps, known.areas))
        figures |= {f"{name}.{key}": errors[key] for key in ("normal_mean_deg", "roughness_mse", "albedo_psnr")}
    return figures


def _seconds(work) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
