"""Assets that Mitsuba photographs as a phone does, and their fits: parts of `python -m benchmarks.captures`.

Pictures are 8-bit JPEGs with exposures of ±1 EV, white balances of ±10 % and a fall-off of 30 % in the corners, or
`clean`, without those. Gains have mean 0, the gauge of a fit.

`phone` (Suzanne and Avocado with their own maps, 24 views under a sky that the fit does not know):

    phone.relight_psnr_l, phone.albedo_psnr_scaled  after a factor per channel; means over the assets
    phone.exposure_error                            largest error of a gain, relative (where gains were solved)
    phone.seconds                                   of a fit

`--only bounds`: the same figures as `bounds.clean.*` (clean pictures, unknown sky, no photometry) and
`bounds.known.*` (the phone's pictures, known sky).

`--only known`: 16 views and three delta lights, one at a time. They stand still around Suzanne, with 26 pictures of
lit sides, and are fixed to the camera for Avocado, with 48 pictures.

    known.exposure_error    largest error of a gain, relative
    known.maps_ratio        largest ratio of an error to that from clean pictures without photometry: mean angle of the
                            normal, root mean square of roughness, albedo and relit sRGB pictures
    known.clean_ratio       the same for clean pictures with photometry
    known.uncorrected_ratio the same for the phone's pictures without photometry
"""

import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.common import DATA, run_mistyle
from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery.metrics import align_channels, map_errors, orb_mask, psnr_ldr
from benchmarks.material_recovery.pictures import Shot
from benchmarks.material_recovery.truth import ASSETS, Truth, find_asset, observed_areas, seen, truth
from mistyle.core.camera import Camera, pixel_centres
from mistyle.core.image import srgb_from_linear
from mistyle.core.light import Directional, Environment, to_json
from mistyle.io.cameras.camera_files import transforms
from mistyle.io.read import read_hdr
from mistyle.io.store.records import load_record
from mistyle.solver.photometry.record import Gains, coordinates, fall_terms

QUICK = ["--set", "recover.solver=texels", "--set", "recover.bounces=0"]
NAMES, SKY = ("suzanne", "avocado"), "kiara_1_dawn_1k.hdr"
FALL = np.array([-0.25, -0.1, np.log(0.7) + 0.35])
LEVEL = 0.25  # 0.9 quantile of the pictures
# Towards the lights that stand still: about 110° from each other.
STANDING = ((0.8, 0.55, 0.25), (-0.62, 0.5, 0.6), (-0.1, -0.45, -0.89))
MAPS = ("normal", "roughness", "albedo", "relit")


@dataclass(frozen=True)
class Drawn:
    """An asset, its file, and its linear pictures, (h, w, 4) with coverage; the shots' lights are in their scale."""

    file: Path
    known: Truth
    shots: list[Shot]
    pictures: list[np.ndarray]


def phone(place: Path, quick: bool) -> dict[str, float]:
    """Disturbed pictures under an unknown sky."""
    rows = [_under_sky(name, place / name, quick, ["--light", "unknown"]) for name in NAMES]
    return _summary("phone", rows)


def bounds(place: Path, quick: bool) -> dict[str, float]:
    """How far clean pictures or a known sky would lead."""
    unknown = ["--light", "unknown", "--photometry", "none"]
    clean = [_under_sky(name, place / f"clean_{name}", quick, unknown, clean=True) for name in NAMES]
    lit = [_under_sky(name, place / f"known_{name}", quick, ["--photometry", "full"]) for name in NAMES]
    return _summary("bounds.clean", clean) | _summary("bounds.known", lit)


def known(place: Path, quick: bool) -> dict[str, float]:
    """Disturbed and clean pictures under known delta lights."""
    figures = {f"known.{key}": 0.0 for key in ("exposure_error", "maps_ratio", "clean_ratio", "uncorrected_ratio")}
    for name, lit in zip(NAMES, (standing, drawing.one_at_a_time), strict=True):
        drawn = draw(name, lit(drawing.fibonacci(16, 96 if quick else 128)), 16 if quick else 64)
        nothing, done = Gains(np.zeros((len(drawn.shots), 3)), np.zeros(3)), gains(len(drawn.shots), len(name))
        words = ["--preset", "draft", *(QUICK if quick else [])]
        clean = fitted(place / f"{name}_clean", drawn, nothing, [*words, "--photometry", "none"])
        tried = {
            "maps_ratio": (done, "full"),
            "clean_ratio": (nothing, "full"),
            "uncorrected_ratio": (done, "none"),
        }
        for key, (own, mode) in tried.items():
            row = fitted(place / f"{name}_{key}", drawn, own, [*words, "--photometry", mode])
            ratio = {part: row[part] / clean[part] for part in MAPS}
            _print(f"{name} {key}", ratio | {part: row[part] for part in ("exposure_error", "seconds") if part in row})
            figures[f"known.{key}"] = max(figures[f"known.{key}"], *ratio.values())
            if key == "maps_ratio":
                figures["known.exposure_error"] = max(figures["known.exposure_error"], row["exposure_error"])
    return figures


def standing(cameras: Sequence[Camera]) -> list[Shot]:
    """Every camera under those of the lights of STANDING that do not shine from behind the object."""
    units = [(np.array(d) / np.linalg.norm(d)).tolist() for d in STANDING]
    lights = [Directional((x, y, z), (2.5, 2.5, 2.5)) for x, y, z in units]
    return [
        Shot(replace(camera, name=f"{camera.name}_light{k}"), (light,))
        for camera in cameras
        for k, light in enumerate(lights)
        if camera.position @ np.array(light.direction) > 0
    ]


def _under_sky(name: str, place: Path, quick: bool, words: Sequence[Any], *, clean: bool = False) -> dict[str, float]:
    cameras = [replace(c, focal=1.2 * c.focal) for c in drawing.fibonacci(24, 160 if quick else 320)]
    radiance = read_hdr(DATA / "hdri" / SKY)
    sky = Environment(radiance, scale=drawing.HDRI_MEAN / float(radiance.mean()), file=SKY)
    drawn = draw(name, [Shot(camera, (sky,)) for camera in cameras], 16 if quick else 64)
    done = Gains(np.zeros((len(cameras), 3)), np.zeros(3)) if clean else gains(len(cameras), len(name))
    row = fitted(place, drawn, done, [*words, "--preset", "draft", *(QUICK if quick else [])])
    _print(str(place.name), row)
    return row


def _summary(part: str, rows: Sequence[dict[str, float]]) -> dict[str, float]:
    keys = ("relight_psnr_l", "albedo_psnr_scaled", "seconds")
    figures = {f"{part}.{key}": float(np.mean([row[key] for row in rows])) for key in keys}
    errors = [row["exposure_error"] for row in rows if "exposure_error" in row]
    return figures | ({f"{part}.exposure_error": max(errors)} if errors else {})


def _print(name: str, row: dict[str, float]) -> None:
    print(name, {key: round(value, 4) for key, value in row.items()}, file=sys.stderr, flush=True)


def draw(name: str, shots: list[Shot], spp: int, strong: bool = False) -> Drawn:
    """The pictures of an asset, their 0.9 quantile brought to LEVEL, as are the lights."""
    file = find_asset(name, DATA)
    known = truth(file, name, shots[0].camera, ASSETS[name][1], strong)
    pictures = drawing.render(known.mesh, known.maps, shots, frame="mikkt", spp=spp)
    inside = np.concatenate([p[..., :3][p[..., 3] > 0.99] for p in pictures])
    level = LEVEL / float(np.quantile(inside, 0.9))
    lit = {id(light): _scaled(light, level) for shot in shots for light in shot.lights}
    scaled = [Shot(shot.camera, tuple(lit[id(light)] for light in shot.lights)) for shot in shots]
    return Drawn(file, known, scaled, [np.concatenate([level * p[..., :3], p[..., 3:]], axis=-1) for p in pictures])


def _scaled(light: Any, level: float) -> Any:
    if isinstance(light, Environment):
        return replace(light, scale=level * light.scale)
    r, g, b = (level * value for value in light.irradiance)
    return replace(light, irradiance=(r, g, b))


def gains(n: int, seed: int) -> Gains:
    """Random exposures and balances in the gauge of a fit, and the vignetting."""
    rng = np.random.default_rng(seed)
    exposure, balance = rng.uniform(-1, 1, n) * np.log(2), rng.uniform(np.log(0.9), np.log(1.1), (n, 3))
    balance -= balance.mean(axis=1, keepdims=True)
    return Gains((exposure - exposure.mean())[:, None] + balance - balance.mean(axis=0), FALL)


def photograph(folder: Path, drawn: Drawn, done: Gains) -> None:
    """Write JPEGs with masks, cameras and lights."""
    (folder / "masks").mkdir(parents=True, exist_ok=True)
    for k, (shot, picture) in enumerate(zip(drawn.shots, drawn.pictures, strict=True)):
        x = coordinates(shot.camera, pixel_centres(shot.camera.size))
        taken = picture[..., :3] * np.exp(done.gain[k] + (fall_terms(x) @ done.vignetting)[..., None])
        encoded = (255 * srgb_from_linear(np.clip(taken, 0, 1).astype(np.float32)) + 0.5).astype(np.uint8)
        quality = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        cv2.imwrite(str(folder / f"{shot.camera.name}.jpg"), encoded[..., ::-1], quality)
        mask = (255 * (picture[..., 3] > 0.999)).astype(np.uint8)
        cv2.imwrite(str(folder / "masks" / f"{shot.camera.name}.png"), mask)
    names = [f"{shot.camera.name}.jpg" for shot in drawn.shots]
    (folder / "transforms.json").write_text(json.dumps(transforms([shot.camera for shot in drawn.shots], names)))
    (folder / "lights.json").write_text(json.dumps(to_json((), {s.camera.name: s.lights for s in drawn.shots})))
    for light in {light.file for shot in drawn.shots for light in shot.lights if isinstance(light, Environment)}:
        shutil.copyfile(DATA / "hdri" / light, folder / light)


def fitted(place: Path, drawn: Drawn, done: Gains, words: Sequence[Any]) -> dict[str, float]:
    """Photograph with these gains, fit with these words, and measure."""
    photograph(place / "shots", drawn, done)
    known, size = drawn.known, len(drawn.known.texels[0].covered)
    start = time.perf_counter()
    run_mistyle("fit", drawn.file, place / "shots", "-o", place / "out", "--masks", place / "shots" / "masks",
                "--atlas", size, *words)  # fmt: skip
    result = {"seconds": time.perf_counter() - start}
    record = place / "out" / "work" / "exposures" / "record"
    if record.exists():
        solved = load_record(record).photometry.gains.gain
        result["exposure_error"] = float(np.abs(np.expm1(solved - done.gain)).max())
    maps = load_record(place / "out" / "work" / "recover" / "record").maps
    counts = seen(known, list({s.camera.position.tobytes(): s.camera for s in drawn.shots}.values()))
    weights = observed_areas(known, counts)
    errors = map_errors(known.maps, maps, weights)
    result |= {"normal": errors.normal_mean_deg, "roughness": errors.roughness_mse**0.5}
    result |= {"albedo": 10 ** (-errors.albedo_psnr / 20), "albedo_psnr_scaled": errors.albedo_psnr_aligned}
    side, quick = drawn.shots[0].camera.size[0], "recover.solver=texels" in words
    plain, scaled = relit(known, maps, side, quick)
    return result | {"relit": 10 ** (-plain / 20), "relight_psnr_l": scaled}


def relit(known: Truth, maps: Any, side: int, quick: bool) -> tuple[float, float]:
    """Mean PSNR-L under the four unseen lights of `recovery_pictures.unseen`, as it is and after a factor per
    channel."""
    hdri, errors = DATA / "hdri" / "studio_small_03_1k.hdr", []
    for shots in drawing.unseen(hdri, side, 2 if quick else 4).values():
        spp = 16 if quick else 64
        true = drawing.render(known.mesh, known.maps, shots, frame="mikkt", spp=spp)
        mine = drawing.render(known.mesh, maps, shots, frame="mikkt", spp=spp)
        for a, b in zip(true, mine, strict=True):
            mask = orb_mask(a[..., 3])
            tried = b[..., :3], align_channels(a[..., :3], b[..., :3], mask)
            errors.append([psnr_ldr(a[..., :3], each, mask) for each in tried])
    plain, scaled = np.mean(errors, axis=0).tolist()
    return plain, scaled


PARTS: dict[str, Callable[[Path, bool], dict[str, float]]] = {"phone": phone, "bounds": bounds, "known": known}
