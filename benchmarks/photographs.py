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
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from benchmarks import recovery_pictures as drawing
from benchmarks.common import finish, run_mistyle
from benchmarks.material_metrics import map_errors
from benchmarks.recovery_truth import data_folder, find_asset, truth
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
FINEST = 4


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.photographs", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", choices=("large", "strong"), action="append", help="only this part (repeatable)")
    parser.add_argument("--keep", type=Path, help="folder for the photographs and the run, to look at afterwards")
    options = parser.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        if "large" in (options.only or ["large"]):
            figures |= large(options.keep or Path(scratch), *((2, 1732) if options.quick else (8, 3464)))
        if "strong" in (options.only or ["strong"]):
            figures |= strong(64 if options.quick else 128)
    finish(figures, options.json)


def large(place: Path, views: int, side: int) -> dict[str, float]:
    """Photographs made, read, predicted once as they are and averaged, and fitted to."""
    mesh, folder = find_asset("waterbottle", data_folder()), place / "photographs"
    count = photograph(mesh, folder, views, side)
    captures = read_captures(folder, saturation=0.99)
    asset = read_mesh(mesh)
    by = downsampling_factors([rasterise(asset.mesh, 0, ATLAS)], captures.cameras)
    figures = {"large.pictures": float(count), "large.megapixels": side * side / 1e6, "large.block": float(by[0])}
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


def photograph(mesh: Path, folder: Path, views: int, side: int) -> int:
    """Write JPEGs of the object in its own material, their cameras and lights; how many. Direct light only."""
    folder.mkdir(parents=True, exist_ok=True)
    asset = read_mesh(mesh)
    cameras = [replace(c, focal=1.25 * c.focal) for c in drawing.fibonacci(views, side)]
    lens = Lens((cameras[0].focal,) * 2, cameras[0].centre, cameras[0].size, RADIAL)
    where = _bent(lens, cameras[0])
    shots = drawing.one_at_a_time(cameras)
    exposure = None
    lit, files = {}, []
    for shot, picture in zip(shots, _pictures(asset, shots), strict=True):
        if exposure is None:
            exposure = 0.8 / float(np.quantile(picture[picture.max(axis=-1) > 0], 0.999))
        bent = cv2.remap(picture * exposure, *where, cv2.INTER_LINEAR)
        name = f"{shot.camera.name}.jpg"
        encoded = (255 * srgb_from_linear(np.clip(bent, 0, 1)) + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / name), encoded[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        files.append(name)
        lit[shot.camera.name] = tuple(
            replace(light, irradiance=tuple(exposure * x for x in light.irradiance))
            for light in shot.lights
            if isinstance(light, Directional)
        )
    tree = transforms([shot.camera for shot in shots], files)
    tree |= {"camera_model": "OPENCV", "k1": RADIAL[0], "k2": RADIAL[1], "k3": RADIAL[2]}
    (folder / "transforms.json").write_text(json.dumps(tree))
    (folder / "lights.json").write_text(json.dumps(to_json((), lit)))
    return len(shots)


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
    known = truth(find_asset("suzanne", data_folder()), "suzanne", drawing.fibonacci(1, size)[0], "auto", True)
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
