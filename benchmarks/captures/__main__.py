"""Photographs as they come: `python -m benchmarks.captures [--quick] [--json FILE] [--only PART] [--keep DIR]`

`castle`: eleven JPEGs of a façade (MISTYLE_DATA/photographs/castle) with a COLMAP model, a mesh in another frame, sky,
trees, lens flare, and no masks. `mistyle fit --align --light unknown --hold-out 2 --preset draft`:

    castle.seconds, castle.cpu_seconds  of the fit, and of its processor
    castle.plan_ratio                   its seconds over those of --dry-run
    castle.first_asset                  share of its seconds after which `asset` existed
    castle.exposure_r                   correlation of log exposures, solved without EXIF, with its log shutter times
    castle.psnr_held_out                of the held-out pictures (sRGB, peak 1, valid pixels of the mesh)
    castle.psnr_held_out_texture        the same for the fitted pictures projected as an unlit texture: each texel's
                                        median over the pictures that show it, at the same exposures and pixels
    castle.shadow_step_ratio            mean |log albedo| step across the borders of shadows by the light's brightest
                                        direction, over that of equally distant texels elsewhere
    castle.shadow_pairs                 the number of pairs across such borders

`phone`, and on request `bounds` and `known`: two assets photographed as by a phone (`phone.py`).

`metals`: DamagedHelmet and WaterBottle with their own maps, 16 views of 256² x an environment in three positions, as
`benchmarks.material_recovery --maps own_soft` draws and fits them; of both the worse: `metals.metallic_right` (share of
the surface that three cameras see), `metals.albedo_psnr` and `calibration.worst` (from 0.683, over all maps); and of
each `metals.NAME.within_MAP`, the share of that surface within the map's stated deviation.

`--only plan`: plan against time of five jobs (`plan.py`). `--only cycles`: pictures that Blender drew
(`cycles.py`).

--quick fits textures of 256², texel by texel alone; the phone's pictures have 160 pixels a side, those of
`known` and `metals` 96.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.captures.cycles import cycles
from benchmarks.captures.phone import PARTS, QUICK
from benchmarks.captures.plan import plans, watched
from benchmarks.common import DATA, finish, parser, run_mistyle
from benchmarks.material_recovery import __main__ as recovery
from mistyle.atlas.texels import rasterise
from mistyle.core.capture import Captures, subset
from mistyle.core.image import bilinear, luminance, nearest_fill, srgb_from_linear
from mistyle.core.light import Environment, environment_directions
from mistyle.core.maps import Texels
from mistyle.fitting.pipeline.first_look import median_textures
from mistyle.fitting.pipeline.photometry import exif_exposure
from mistyle.fitting.pipeline.pictures import read_averaged
from mistyle.io.cameras.captures import read_captures, read_shots
from mistyle.io.read_mesh import read_mesh
from mistyle.io.store.records import load_record
from mistyle.measure.metrics import psnr
from mistyle.render.mitsuba.draw import Tracer, gbuffer, tracer
from mistyle.solver.photometry.record import corrected
from mistyle.solver.photometry.solve import solve_photometry
from mistyle.solver.texels.gbuffer import open_sky

STEP = 3  # texels between the two of a pair


@dataclass(frozen=True)
class CastleRun:
    """A run folder of the castle: mesh, atlas, corrected captures at the fit's resolution, held-out pictures' indices,
    the solved light and the fitted maps."""

    traced: Tracer
    texels: Texels
    captures: Captures
    held: tuple[int, ...]
    light: Any
    recovered: Any


def main() -> None:
    options = parser(__doc__ or "")
    parts = ("castle", *PARTS, "metals", "plan", "cycles")
    options.add_argument("--only", choices=parts, action="append", help="only this part (repeatable)")
    options.add_argument("--keep", type=Path, help="folder for the runs, to look at afterwards")
    chosen = options.parse_args()
    figures: dict[str, float] = {}
    with TemporaryDirectory() as scratch:
        place = chosen.keep or Path(scratch)
        if "castle" in (chosen.only or ["castle"]):
            figures |= castle(place / "castle", chosen.quick)
        for part, run in PARTS.items():
            if part in (chosen.only or ["phone"]):
                figures |= run(place / part, chosen.quick)
        if "metals" in (chosen.only or ["metals"]):
            figures |= metals(place / "metals", chosen.quick)
        if "plan" in (chosen.only or []):
            figures |= plans(place / "plan", chosen.quick)
        if "cycles" in (chosen.only or []):
            figures |= cycles(place / "cycles", chosen.quick)
    finish(figures, chosen.json)


def castle(out: Path, quick: bool) -> dict[str, float]:
    """Fit the castle into `out` and measure it."""
    folder = DATA / "photographs" / "castle"
    words = ["fit", folder / "scene_mesh.ply", folder, "-o", out, "--align", "--light", "unknown", "--hold-out", 2]
    words += ["--preset", "draft", *(["--atlas", 256, *QUICK] if quick else [])]
    plan = run_mistyle(*words, "--dry-run")
    ran = watched(words, out)
    figures = {"castle.seconds": ran.seconds, "castle.cpu_seconds": ran.cpu}
    figures["castle.plan_ratio"] = ran.seconds / plan["seconds"]
    figures["castle.first_asset"] = ran.first_asset / ran.seconds
    run = castle_run(folder, out)
    figures["castle.exposure_r"] = exposure_r(folder, run)
    figures["castle.psnr_held_out"] = ran.summary["figures"]["psnr_held_out"]
    figures["castle.psnr_held_out_texture"] = texture_psnr(run)
    steps = shadow_steps(run)
    figures["castle.shadow_step_ratio"], figures["castle.shadow_pairs"] = steps
    return figures


def castle_run(folder: Path, out: Path) -> CastleRun:
    """The records of a finished run."""
    asset, record = read_mesh(folder / "scene_mesh.ply"), json.loads((out / "run.json").read_text())
    work = out / "work"
    cameras = load_record(work / "cameras" / "record").cameras
    captures = replace(read_captures(folder, lights="unknown"), cameras=cameras)
    captures = corrected(captures, load_record(work / "exposures" / "record").photometry)
    captures, _ = read_averaged(work / "pictures", captures)
    held = tuple(k for k, picture in enumerate(record["pictures"]) if picture["held_out"])
    recovered = load_record(work / "recover" / "record")
    size = recovered.maps[0].roughness.shape[0]
    light = load_record(work / "light" / "record").light
    return CastleRun(tracer(asset.mesh), rasterise(asset.mesh, 0, size), captures, held, light, recovered)


def exposure_r(folder: Path, run: CastleRun) -> float:
    """The correlation of solved and stated log exposures; EXIF is read for the comparison only."""
    captures = replace(read_captures(folder, lights="unknown"), cameras=_unaveraged(folder, run))
    solved = solve_photometry(run.traced, captures).exposure
    stated = [exif_exposure(shot.picture) for shot in read_shots(folder)]
    return float(np.corrcoef(solved, stated)[0, 1])


def _unaveraged(folder: Path, run: CastleRun) -> tuple[Any, ...]:
    """The aligned cameras at the size of the photographs."""
    whole = read_captures(folder, lights="unknown").cameras
    pairs = zip(whole, run.captures.cameras, strict=True)
    return tuple(replace(camera, world_from_cam=placed.world_from_cam) for camera, placed in pairs)


def texture_psnr(run: CastleRun) -> float:
    """Mean PSNR of the held-out pictures, predicted by the median of the others as an unlit texture."""
    fitted = [k for k in range(len(run.captures)) if k not in run.held]
    ((texture, known),) = median_textures(run.traced, [run.texels], subset(run.captures, fitted))
    texture = nearest_fill(texture, known)
    return float(np.mean([_texture_error(run, texture, k) for k in run.held]))


def _texture_error(run: CastleRun, texture: Float[np.ndarray, "h w 3"], k: int) -> float:
    """PSNR of picture k, predicted at four points a pixel, over the pixels that `measure` counts."""
    camera = run.captures.cameras[k]
    height, width = camera.size
    fine = replace(camera, focal=2 * camera.focal, centre=(2 * camera.centre[0], 2 * camera.centre[1]),
                   size=(2 * height, 2 * width))  # fmt: skip
    hits, side = gbuffer(run.traced, fine), len(texture)
    px = np.stack([hits.uv[..., 0] * side, (1 - hits.uv[..., 1]) * side], axis=-1).reshape(-1, 2)
    drawn = bilinear(texture, px).reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
    rgb, valid = run.captures.load(k)
    valid = valid & hits.mask.reshape(height, 2, width, 2).all(axis=(1, 3))
    return psnr(srgb_from_linear(rgb)[valid], srgb_from_linear(drawn)[valid])


def shadow_steps(run: CastleRun) -> tuple[float, float]:
    """The ratio of albedo steps across shadow borders to others, and the number of pairs across borders."""
    sun = brightest(run.light)
    covered = run.texels.covered & run.recovered.maps[0].known
    position, normal = run.texels.position[covered], run.texels.normal[covered]
    free = open_sky(run.traced, position, normal, sun[None].astype(np.float32))[:, 0] & 1
    lit = np.zeros(covered.shape, bool)
    lit[covered] = (free == 1) & (normal @ sun > 0.1)
    towards = np.zeros(covered.shape, bool)
    towards[covered] = normal @ sun > 0.1
    value = np.log(np.maximum(luminance(run.recovered.maps[0].albedo), 1e-3))
    border, other = [], []
    for axis in (0, 1):
        near, far = (np.take(np.arange(covered.shape[axis]), range(*cut)) for cut in _cuts(covered.shape[axis]))

        def pair(field: np.ndarray, near=near, far=far, axis=axis) -> tuple[np.ndarray, np.ndarray]:
            return np.take(field, near, axis=axis), np.take(field, far, axis=axis)

        a, b = pair(run.texels.position)
        size = np.median(np.linalg.norm(a - b, axis=-1)[np.logical_and(*pair(covered))])
        joined = np.logical_and(*pair(towards)) & np.logical_and(*pair(covered))
        joined &= np.linalg.norm(a - b, axis=-1) < 2 * size
        same = (np.stack(pair(run.texels.normal)).prod(axis=0)).sum(axis=-1) > 0.95
        step, differs = np.abs(np.subtract(*pair(value))), np.not_equal(*pair(lit))
        border.append(step[joined & same & differs])
        other.append(step[joined & same & ~differs])
    across, within = np.concatenate(border), np.concatenate(other)
    ratio = float(across.mean() / within.mean()) if len(across) and len(within) else 0.0
    return ratio, float(len(across))


def _cuts(size: int) -> tuple[tuple[int, int], tuple[int, int]]:
    return (0, size - STEP), (STEP, size)


def brightest(light: Environment) -> Float[np.ndarray, "3"]:
    """The direction of an environment's brightest pixel."""
    towards = environment_directions(*light.radiance.shape[:2]).reshape(-1, 3)
    return towards[int(luminance(light.radiance).argmax())]


def metals(place: Path, quick: bool) -> dict[str, float]:
    """The worse of two assets with metal and dark gloss, lit by an environment."""
    side, spp = (96, 32) if quick else (256, 128)
    words = ["--assets", "damagedhelmet", "waterbottle", "--maps", "own_soft", "--out", place]
    options = recovery.parse([str(word) for word in (*words, "--resolution", side, "--spp", spp)])
    figures, rows = {}, []
    for row in recovery.rows(options):
        methods, _ = recovery.measure(row, options)
        rows.append(methods["ours"])
        within = [name for name in methods["ours"] if name.startswith("within_")]
        for name in ("metallic_right", "albedo_psnr", "metallic_mse", "relight_psnr_l", *within, "calibration_worst"):
            figures[f"metals.{row.name}.{name}"] = methods["ours"][name]
            if name in methods["constant"]:
                figures[f"metals.{row.name}.constant.{name}"] = methods["constant"][name]
    for name in ("metallic_right", "albedo_psnr"):
        figures[f"metals.{name}"] = min(row[name] for row in rows)
    return figures | {"calibration.worst": max(row["calibration_worst"] for row in rows)}


if __name__ == "__main__":
    main()
