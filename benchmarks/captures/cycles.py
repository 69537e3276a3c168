"""Fits to pictures that Blender's Cycles drew: `python -m benchmarks.captures --only cycles [--quick] [--keep DIR]`.

Blender (bpy, an environment of its own, $MISTYLE_BLENDER_PYTHON) imports three glTF assets, takes pictures with its
factory settings but for samples and denoising, and writes `transforms.json` and `lights.json` in its own axes
(cycles_worker.py). `mistyle fit MODEL SHOTS -o OUT --set references.up=z --material gltf --metallic` reads
them.

    cycles.NAME          24 views under two suns and a point light, one at a time; linear EXR; light known
    cycles.NAME_sky      24 views under a sky; 8-bit PNG, view transform "Standard"; light known
    cycles.NAME_unknown  the same pictures; light unknown

`.normal_deg`, `.roughness_mse`, `.albedo_psnr`, `.metallic_right`: over the surface that three cameras see, against
the file's own maps at the atlas's resolution (`.albedo_psnr_scaled`: after a factor per channel). `.relit_psnr`: Cycles
draws the exported GLB and the original file under another sky; PSNR of the sRGB pictures (`_scaled`: after a factor per
channel). `cycles.NAME.constant.…`: the best maps of one value each. `cycles.NAME.own.…`: the same fit to Mitsuba's
pictures of the same files (glTF's reflectance, `path`), by the lamps: what is left is not Blender's. `.seconds` of the
fit.

Pictures have 256 pixels a side, 128 with --quick, which also takes 16 views and fits texel by texel alone.
"""

import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import DATA, run_mistyle
from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery import report
from benchmarks.material_recovery.metrics import align_channels, best_constant, map_errors, orb_mask, psnr_ldr
from benchmarks.material_recovery.truth import ASSETS, Truth, find_asset, observed_areas, seen, truth
from mistyle.core.maps import Maps
from mistyle.geometry.similarity import moved, upright
from mistyle.io.cameras.captures import read_captures
from mistyle.io.images.write import write_exr
from mistyle.io.read import read_exr, read_hdr
from mistyle.io.read_mesh import read_mesh
from mistyle.io.store.records import load_record
from mistyle.render.external.blender import BLENDER, blender_command, find_blender
from mistyle.render.external.render_files import run_job
from mistyle.render.lookdev import scenes

NAMES = ("avocado", "waterbottle", "suzanne")
SKY, UNSEEN = "kiara_1_dawn_1k.hdr", "studio_small_03_1k.hdr"
WORKER = str(Path(__file__).with_name("cycles_worker.py"))
WORDS = ("--set", "references.up=z", "--material", "gltf", "--metallic")
QUICKLY = ("--preset", "draft", "--set", "recover.solver=texels", "--report", "none")
MEAN = 0.3  # mean radiance of the skies, so that few pixels of the 8-bit pictures are saturated


@dataclass(frozen=True)
class Size:
    """Views, pixels a side and samples of the pictures (of lamps; a sky has twice as many)."""

    views: int
    side: int
    samples: int
    relit: int


FULL, QUICK = Size(24, 256, 64, 6), Size(16, 128, 64, 3)


@dataclass(frozen=True)
class Studio:
    """Blender, a model and where its pictures go."""

    blender: str
    model: Path
    place: Path
    size: Size
    plain: tuple[str, ...] = ()

    def take(self, kind: str, name: str, **more: Any) -> Path:
        """The folder `name` with pictures; those of an earlier run are kept."""
        out = self.place / name
        if (out / "lights.json").exists():
            return out
        hdri = DATA / "hdri" / (UNSEEN if kind == "relit" else SKY)
        samples = self.size.samples * (1 if kind == "lamps" else 2)
        job = {"model": str(self.model.resolve()), "out": str(out.resolve()), "kind": kind, "views": self.size.views}
        job |= {"turn": 0.0, "size": self.size.side, "samples": samples, "seed": 1, "threads": os.cpu_count() or 1}
        job |= {"hdri": str(hdri.resolve()), "strength": MEAN / float(read_hdr(hdri).mean())}
        job |= {"plain": self.plain, "maps": None, **more}
        out.mkdir(parents=True, exist_ok=True)
        if kind == "sky":
            shutil.copyfile(hdri, out / hdri.name)
        run_job(blender_command(self.blender, WORKER), out / "job.json", job, "cycles")
        return out

    def relit(self, name: str, model: Path, maps: Mapping[str, Any] | None = None) -> list[np.ndarray]:
        """Linear pictures (h, w, 4) of a model under the unseen sky, from cameras between those of the fit."""
        studio = Studio(self.blender, model, self.place, self.size, self.plain)
        folder = studio.take("relit", name, views=self.size.relit, turn=0.37, maps=maps)
        layers = [read_exr(file) for file in sorted(folder.glob("*.exr"))]
        return [np.stack([layer[c] for c in "RGBA"], axis=-1) for layer in layers]


def cycles(place: Path, quick: bool, names: Sequence[str] = NAMES) -> dict[str, float]:
    """The figures of the module; runs and pictures lie in `place`. SystemExit where Blender is missing."""
    blender = find_blender(None)
    if blender is None:
        raise SystemExit(
            f"--only cycles: found no Blender; expected ${BLENDER}, a Python in which `import bpy` works "
            "(`python3.11 -m venv E && E/bin/pip install bpy==5.0.1`), or `blender` on the PATH."
        )
    figures: dict[str, float] = {}
    for name in names:
        file = find_asset(name, DATA)
        found = asset(name, Studio(blender, file, place / name, QUICK if quick else FULL), quick)
        print(name, {key: round(value, 4) for key, value in found.items()}, file=sys.stderr, flush=True)
        figures |= found
    return figures


def asset(name: str, studio: Studio, quick: bool) -> dict[str, float]:
    """One asset: pictures, three fits, relit pictures."""
    start = time.perf_counter()
    lamps, sky = studio.take("lamps", "lamps"), studio.take("sky", "sky")
    known = truth(studio.model, name, drawing.fibonacci(1, studio.size.side)[0], ASSETS[name][1])
    original = studio.relit("relit_truth", studio.model)
    figures = {f"cycles.{name}.blender_seconds": time.perf_counter() - start}
    sheet: dict[str, Maps] = {"truth": known.maps[0]}
    shown = {"truth": original}
    draft = QUICKLY if quick else []
    for kind, shots, words in (
        ("", lamps, draft),
        (".own", drawn(studio, lamps), draft),
        ("_sky", sky, draft),
        ("_unknown", sky, ["--light", "unknown", *draft]),
    ):
        label, out = f"cycles.{name}{kind}", studio.place / f"out{kind}"
        start = time.perf_counter()
        run_mistyle("fit", studio.model, shots, "-o", out, *WORDS, *words, "--atlas", len(known.texels[0].covered))
        figures[f"{label}.seconds"] = time.perf_counter() - start
        maps, weights = fitted(out, known)
        figures |= errors(label, known, maps, weights)
        pictures = studio.relit(f"relit{kind}", next((out / "asset").glob("*.glb")))
        figures |= relit_errors(label, original, pictures)
        sheet[kind or "lamps"], shown[kind or "lamps"] = maps[0], pictures
        if not kind:
            constant = best_constant(known.maps, weights)
            pictures = studio.relit("relit_constant", studio.model, sockets(constant[0]))
            label += ".constant"
            figures |= errors(label, known, constant, weights) | relit_errors(label, original, pictures)
            shown["constant"] = pictures
    report.map_sheet(studio.place / "maps.png", sheet, None, known.texels[0].covered)
    report.relit_sheet(studio.place / "relit.png", shown)
    return figures


def drawn(studio: Studio, shots: Path) -> Path:
    """A folder with Mitsuba's pictures of Blender's cameras and lamps."""
    out, model = studio.place / "own", read_mesh(studio.model)
    if (out / "lights.json").exists():
        return out
    out.mkdir(parents=True, exist_ok=True)
    captures = moved(upright(read_captures(shots)), model.source.work_from_user)
    black = (replace(m, shading=replace(m.shading, emission=(0.0, 0.0, 0.0))) for m in model.materials)
    dark = replace(model, materials=tuple(black))
    shapes = scenes.asset_shapes(dark)
    for camera, lights in zip(captures.cameras, captures.lights, strict=True):
        picture = scenes.drawn(scenes.asset_scene(shapes, camera, lights, "path"), 0, studio.size.samples, 1)
        write_exr(out / f"{camera.name}.exr", {c: picture[..., k] for k, c in enumerate("RGBA")})
    for name in ("transforms.json", "lights.json"):
        shutil.copyfile(shots / name, out / name)
    return out


def fitted(out: Path, known: Truth) -> tuple[tuple[Maps, ...], list[np.ndarray]]:
    """The maps of a run, and the surface of each texel that at least three of its viewpoints see."""
    cameras = load_record(out / "work" / "cameras" / "record").cameras
    places = {tuple(np.round(camera.position, 4)): camera for camera in cameras}
    counts = seen(known, list(places.values()))
    return load_record(out / "work" / "recover" / "record").maps, observed_areas(known, counts)


def errors(label: str, known: Truth, maps: Sequence[Maps], weights: Sequence[np.ndarray]) -> dict[str, float]:
    found = map_errors(known.maps, maps, weights)
    return {
        f"{label}.normal_deg": found.normal_mean_deg,
        f"{label}.roughness_mse": found.roughness_mse,
        f"{label}.albedo_psnr": found.albedo_psnr,
        f"{label}.albedo_psnr_scaled": found.albedo_psnr_aligned,
        f"{label}.metallic_right": found.metallic_right,
    }


def relit_errors(label: str, original: Sequence[np.ndarray], mine: Sequence[np.ndarray]) -> dict[str, float]:
    """Mean PSNR over the pictures, as drawn and after a factor per channel."""
    plain, scaled = [], []
    for a, b in zip(original, mine, strict=True):
        mask = orb_mask(a[..., 3])
        plain.append(psnr_ldr(a[..., :3], b[..., :3], mask))
        scaled.append(psnr_ldr(a[..., :3], align_channels(a[..., :3], b[..., :3], mask), mask))
    return {f"{label}.relit_psnr": float(np.mean(plain)), f"{label}.relit_psnr_scaled": float(np.mean(scaled))}


def sockets(maps: Maps) -> dict[str, Any]:
    """Maps of one value each, as inputs of Blender's material; its normals are the mesh's."""
    middle = tuple(n // 2 for n in maps.roughness.shape)
    colour = [*maps.albedo[middle].tolist(), 1.0]
    return {
        "Base Color": colour,
        "Roughness": float(maps.roughness[middle]),
        "Metallic": float(maps.metallic[middle]),
    }
