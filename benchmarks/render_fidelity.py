"""How near our pictures are to others: `python -m benchmarks.render_fidelity [--blender PYTHON] [--json FILE]`.

1. DamagedHelmet under the light and camera of Khronos' render-fidelity test, against ten renderers' published pictures
   (data/reference/damaged_helmet_goldens): psnr.<renderer> over the surface, in their display encoding, and how near
   each is to the one of the others that is least like it (farthest_peer.<renderer>). Gates: 23.5 dB against Cycles,
   V-Ray and dspbr; nobody further from us than from the others.
2. GLBs that we wrote (demo, Avocado, Suzanne), in Cycles and in Mitsuba with glTF's own reflectance model: mean
   LDR-FLIP, flip.<asset>.<light>. Gate: 0.03. Needs --blender or $MISTYLE_BLENDER_PYTHON.
"""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.common import DATA, finish
from mistyle.core.camera import look_at
from mistyle.core.image import erode, srgb_from_linear
from mistyle.core.light import Environment
from mistyle.core.paths import scenes

EXPOSURE = 1 / 0.6
GATES = {"blender-cycles": 23.5, "vray": 23.5, "dspbr-pt": 23.5}
FLIP_GATE = 0.03
# Stephen Hill's fit of the ACES RRT and ODT, as three.js' ACESFilmicToneMapping has it.
ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.render_fidelity", description=__doc__)
    options.add_argument("--blender", default=os.environ.get("MISTYLE_BLENDER_PYTHON"), help="Python with bpy")
    options.add_argument("--data", type=Path, default=DATA)
    options.add_argument("--pictures", type=Path, help="folder for side-by-side pictures")
    options.add_argument("--only", help="part of the benchmark: helmet, demo, avocado or suzanne")
    options.add_argument("--quick", action="store_true", help="few samples, small pictures, one asset")
    options.add_argument("--json", type=Path)
    chosen = options.parse_args()
    if chosen.pictures is not None:
        chosen.pictures.mkdir(parents=True, exist_ok=True)
    figures: dict[str, float] = {}
    if chosen.only in (None, "helmet"):
        figures |= helmet(chosen.data, 16 if chosen.quick else 256, chosen.pictures)
    if chosen.blender and chosen.only != "helmet":
        figures |= cycles(chosen.data, chosen.blender, chosen.quick, chosen.pictures, chosen.only)
    if not chosen.blender:
        print("no --blender PYTHON: only the published pictures are compared with")
    finish(figures, chosen.json)
    for line in verdicts(figures):
        print(line)


def verdicts(figures: dict[str, float]) -> list[str]:
    """A line for each gate."""
    lines = [
        f"{'kept' if figures[f'psnr.{name}'] >= least else 'MISSED'}: psnr.{name} >= {least}"
        for name, least in GATES.items()
        if f"psnr.{name}" in figures
    ]
    for name in (k.removeprefix("psnr.") for k in figures if k.startswith("psnr.")):
        kept = figures[f"psnr.{name}"] >= figures[f"farthest_peer.{name}"]
        lines.append(f"{'kept' if kept else 'MISSED'}: {name} is no further from us than from its farthest peer")
    flips = {k: v for k, v in figures.items() if k.startswith("flip.")}
    lines += [f"{'kept' if v <= FLIP_GATE else 'MISSED'}: {k} <= {FLIP_GATE}" for k, v in flips.items()]
    return lines


def helmet(data: Path, spp: int, pictures: Path | None) -> dict[str, float]:
    """PSNR of our DamagedHelmet against each published picture, and theirs among themselves."""
    goldens = {p.stem: read_golden(p) for p in sorted((data / "reference/damaged_helmet_goldens").glob("*.webp"))}
    if not goldens:
        raise SystemExit(f"{data}: no data/reference/damaged_helmet_goldens there; set MISTYLE_DATA")
    mask = np.all([erode(np.asarray(alpha > 0.99), 2) for _, alpha in goldens.values()], axis=0)
    ours = displayed(draw_helmet(data, mask.shape, spp))
    figures = {"mask_share": float(mask.mean())}
    for name, (rgb, _) in goldens.items():
        figures[f"psnr.{name}"] = psnr(ours, rgb, mask)
    for name, (rgb, _) in goldens.items():
        peers = [psnr(other, rgb, mask) for peer, (other, _) in goldens.items() if peer != name]
        figures[f"farthest_peer.{name}"] = min(peers)
    if pictures is not None:
        from mistyle.io.images.write import write_png

        shown = [ours, goldens["blender-cycles"][0], 4 * np.abs(ours - goldens["blender-cycles"][0])]
        row = [np.where(mask[..., None], np.clip(p, 0, 1), 0.2).astype(np.float32) for p in shown]
        write_png(pictures / "helmet_ours_cycles_difference4.png", np.concatenate(row, axis=1))
    return figures


def read_golden(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A published picture (display encoding) and its coverage."""
    from mistyle.io.read import read_picture

    picture = read_picture(path)
    alpha = picture.alpha if picture.alpha is not None else np.ones(picture.rgb.shape[:2], np.float32)
    return picture.rgb, alpha


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return float(-10 * np.log10(((a[mask].astype(np.float64) - b[mask]) ** 2).mean()))


def displayed(linear: np.ndarray) -> np.ndarray:
    """The goldens' display transform: exposure, fitted ACES, gamma 2.2."""
    v = (linear * EXPOSURE) @ ACES_IN.T
    v = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    return (np.clip(v @ ACES_OUT.T, 0, 1) ** (1 / 2.2)).astype(np.float32)


def draw_helmet(data: Path, size: tuple[int, int], spp: int) -> np.ndarray:
    """Linear picture."""
    from mistyle.io.read import read_radiance
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.lookdev import scenes as lookdev

    path = data / "meshes/pbr/DamagedHelmet/DamagedHelmet.glb"
    asset = read_mesh(path, uv="keep")
    work = asset.source.work_from_user
    camera = look_at([0, 0, 3], fov=45, size=size)
    # The camera stands in the file's world; the mesh was moved and scaled into the working space.
    moved = work @ camera.world_from_cam
    moved[:3, :3] /= np.cbrt(np.linalg.det(work[:3, :3]))
    camera = replace(camera, world_from_cam=moved)
    light = Environment(read_radiance(data / "hdri/aircraft_workshop_01_1k.hdr"), turn=90.0)
    scene = lookdev.asset_scene(lookdev.asset_shapes(asset), camera, [light], "path")
    return lookdev.drawn(scene, 0, spp, 1)[..., :3]


def cycles(data: Path, blender: str, quick: bool, pictures: Path | None, only: str | None = None) -> dict[str, float]:
    """Mean LDR-FLIP between Mitsuba and Cycles on GLBs that we wrote."""
    from mistyle.io.read_mesh import read_mesh
    from mistyle.measure.pictures.metrics import measure_colour
    from mistyle.render.external.render_files import write_asset_glb
    from mistyle.render.external.renderers import renderer, shots, subject

    sources = {
        "demo": scenes() / "demo.obj",
        "avocado": data / "meshes/pbr/Avocado/Avocado.gltf",
        "suzanne": data / "meshes/pbr/Suzanne/02_suzanne.gltf",
    }
    size, spp = (96, 16) if quick else (256, 256)
    both = [renderer("mitsuba:path"), renderer("blender:cycles", blender)]
    figures: dict[str, float] = {}
    wanted = [only] if only else ["demo"] if quick else list(sources)
    for name, source in ((name, sources[name]) for name in wanted):
        with TemporaryDirectory() as folder:
            glb = Path(folder, f"{name}.glb")
            write_asset_glb(glb, read_mesh(source))
            what = subject(glb, Path(folder, "work"), both)
            for shot in shots(what, ["studio", "key"], 1, size):
                ours, theirs = (how.draw(what, shot, spp, [1]).pictures[0][..., :3] for how in both)
                whole = np.ones(ours.shape[:2], bool)
                found = measure_colour(theirs, ours, whole, ["flip", "psnr"]).values
                figures |= {f"{k}.{name}.{shot.name}".replace("psnr", "db"): v for k, v in found.items()}
                figures[f"bias.{name}.{shot.name}"] = float(ours.mean() / theirs.mean() - 1)
                print(f"{name} {shot.name}: FLIP {found['flip']:.4f}", file=sys.stderr)
                if pictures is not None:
                    from mistyle.io.images.write import write_png

                    row = np.concatenate([ours, theirs, 8 * np.abs(ours - theirs)], axis=1)
                    write_png(pictures / f"{name}_{shot.name}_mitsuba_cycles_difference8.png", srgb_from_linear(row))
    return figures


if __name__ == "__main__":
    main()
