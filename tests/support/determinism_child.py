"""Every stage once, at a tiny size, in one process: `python determinism_child.py OUT THREADS [BUDGET]`.

`OUT/bytes.json` has a digest per stage; `OUT/<stage>.npz` the numbers of the stages whose gradients may add up in
another order. With BUDGET (GB) all arrays but the smallest lie in files. Run by test_determinism.py, twice, under
circumstances that must not matter.
"""

import faulthandler
import hashlib
import json
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

PATIENCE = 240  # seconds after which it says where each thread stands, and ends
SETTINGS = {
    "threads": 2,
    "rig": {"resolution": 64},
    "draw": {"spp": 2, "paper_files": True},
    "surface": {"samples": 1000},
    "atlas": {"size": 96, "padding": 4},
    "fit": {"refine": "all", "iterations1": 2, "iterations2": 2, "crops": 2, "crop_size": 48},
}


def parts(value: Any) -> list[bytes]:
    """What a stage made, as bytes: arrays with shape and type, records field by field, folders file by file."""
    if isinstance(value, np.ndarray):
        return [f"{value.dtype}{value.shape}".encode(), np.ascontiguousarray(value).tobytes()]
    if is_dataclass(value) and not isinstance(value, type):
        # Without the fields' names: renaming one changes no result.
        return [part for f in fields(value) for part in parts(getattr(value, f.name))]
    if isinstance(value, Path):
        files = sorted(p for p in value.rglob("*") if p.is_file()) if value.is_dir() else [value]
        return [part for p in files for part in (p.name.encode(), p.read_bytes())]
    if isinstance(value, dict):
        return [part for k, v in value.items() for part in (str(k).encode(), *parts(v))]
    if isinstance(value, (list, tuple)):
        return [part for item in value for part in parts(item)]
    return [repr(value).encode()]


def digest(value: Any) -> str:
    found = hashlib.sha256()
    for part in parts(value):
        found.update(part)
    return found.hexdigest()


def inputs(folder: Path) -> tuple[Path, Path]:
    """A bell without UVs in two materials, and a painting of diagonal strokes."""
    import trimesh
    from PIL import Image

    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.vertices *= 1 + 0.5 * np.cos(np.arctan2(ball.vertices[:, 1], 0.7) * 2)[:, None]
    half = len(ball.faces) // 2
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in ball.vertices]
    for name, faces in (("upper", ball.faces[:half]), ("lower", ball.faces[half:])):
        lines += [f"usemtl {name}", *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces)]
    (folder / "bell.obj").write_text("\n".join(lines) + "\n")
    y, x = np.mgrid[:64, :80] / 12
    stripes = np.stack([np.sin(x + y) * 0.4 + 0.5, np.sin(x + y + 1) * 0.3 + 0.4, np.cos(x - y) * 0.2 + 0.3], axis=-1)
    Image.fromarray((stripes * 255).astype(np.uint8)).save(folder / "strokes.png")
    return folder / "bell.obj", folder / "strokes.png"


def nothing(done: float) -> None:
    """Nobody watches."""


class Stages:
    """What was made so far; a class because every stage adds to it."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.bytes: dict[str, str] = {}

    def note(self, name: str, made: Any) -> Any:
        self.bytes[name] = digest(made)
        return made

    def numbers(self, name: str, **arrays: np.ndarray) -> None:
        np.savez(self.out / f"{name}.npz", **arrays)
        self.bytes[name] = digest(arrays)


def style_job(made: Stages, settings: Any) -> None:
    """The stages of `stylize`."""
    from mistyle.core.light import lights
    from mistyle.io.cameras.views import read_views, write_views
    from mistyle.io.read import read_picture
    from mistyle.jobs import start
    from mistyle.render.mitsuba.draw import draw_views
    from mistyle.stylization.optimise.two_phase import FitStart, FitTargets, two_phase
    from mistyle.stylization.pipeline import painting
    from mistyle.stylization.pipeline import start as stylize_start

    mesh_file, style_file = inputs(made.out)
    asset = made.note("read and unwrap", start.read(mesh_file, settings.read, settings.atlas.size, nothing))
    # The path of the file is where this run happens to work.
    made.bytes["read and unwrap"] = digest([asset.mesh, asset.source.notes])
    style = read_picture(style_file)
    atlas = made.note("texels", stylize_start.lay_out(asset, settings, nothing))
    cameras = stylize_start.cameras_of(settings, asset.mesh, lambda text: None)[:5]
    views = draw_views(asset.mesh, atlas.start, cameras, "paper_views", settings.draw.spp, settings.seed)
    write_views(made.out / "views", views, lights("paper_views"), paper_files=True)
    made.note("views", made.out / "views")
    views = read_views(made.out / "views")
    layers = painting.paint_layers(asset, style, atlas, settings, nothing)
    made.note("surface", layers)
    baked = made.note("bake", painting.bake(asset, layers, atlas, views, settings, nothing))
    stylized = made.note("stylized", painting.unlit_views(asset, baked.maps, views, nothing))
    phases = {"fit phase 1": {"refine": "normal-roughness"}, "fit phase 2": {"iterations1": 0, "refine": "all"}}
    fitted = None
    for name, change in phases.items():
        chosen = settings.fit.model_copy(update=change)
        fitted = two_phase(
            asset.mesh,
            FitStart(baked.maps, begin=baked.begin),
            FitTargets(stylized),
            atlas.texels,
            chosen,
            settings.seed,
        )
        maps = [getattr(m, key).ravel() for m in fitted.maps for key in ("albedo", "normal", "roughness")]
        made.numbers(name, maps=np.concatenate(maps), trace=np.concatenate([*fitted.trace.values()]))
    repaired = repair(made, asset, atlas, baked, fitted, settings)
    export(made, asset, atlas, repaired, settings)
    one_by_one(made, asset, style, atlas, views, settings)


def repair(made: Stages, asset: Any, atlas: Any, baked: Any, fitted: Any, settings: Any) -> list[Any]:
    from mistyle.stylization.inpaint.fill import from_paint
    from mistyle.stylization.inpaint.repair import repair as repaired
    from mistyle.stylization.inpaint.repair import struggle_mask

    result = []
    for part, texels in enumerate(atlas.texels):
        # The struggle of a fit is a gradient; a fixed one keeps this stage to itself.
        struggle = (texels.position[..., 0] ** 2).astype(np.float32)
        looks = np.ones_like(struggle)
        mask = struggle_mask(struggle, looks, baked.seen[part], texels, settings.repair)
        rng = np.random.default_rng(0)
        result.append(
            repaired(baked.maps[part], mask, texels, from_paint(1 - baked.maps[part].albedo), settings.repair, rng)
        )
    made.note("repair", result)
    return result


def export(made: Stages, asset: Any, atlas: Any, maps: list[Any], settings: Any) -> None:
    from mistyle.atlas.texels import pad_maps
    from mistyle.deliver import export as deliver
    from mistyle.deliver.asset import write_asset
    from mistyle.jobs import start

    open_sky = [start.ambient(asset, part, settings.atlas.size, 0, nothing) for part in range(len(maps))]
    made.note("occlusion", open_sky)
    padded = [pad_maps(m, t, 4) for m, t in zip(maps, atlas.texels, strict=True)]
    write_asset(made.out / "asset", "bell", asset, padded, open_sky, atlas.texels, provenance={"seed": 0})
    made.note("asset: GLB, EXR, PNG", made.out / "asset")
    formats = [f for f in deliver.FORMATS if f != "usd" or usd_is_there()]
    deliver.export(
        made.out / "asset", made.out / "delivered", deliver.DeliveryRequest(formats=formats, target="unity-hdrp")
    )
    for kind in ("usda", "usdz", "mtlx", "obj", "png"):
        made.note(f"delivered {kind}", [*sorted((made.out / "delivered").rglob(f"*.{kind}"))])


def usd_is_there() -> bool:
    from importlib.util import find_spec

    return find_spec("pxr") is not None


def one_by_one(made: Stages, asset: Any, style: Any, atlas: Any, views: list[Any], settings: Any) -> None:
    """The stylizer of single views, the warp between them, and the bake from views."""
    from mistyle.atlas.bake import backproject, fill
    from mistyle.atlas.texels import pad
    from mistyle.stylization.mvst.lift import lift
    from mistyle.stylization.mvst.settings import WarpSettings
    from mistyle.stylization.mvst.sweep import ViewPainter, sweep
    from mistyle.stylization.mvst.warp import composite
    from mistyle.stylization.pipeline.sweep import stylizer_of

    chosen = settings.model_copy(update={"stylizer": "embedded-view"})
    made.note("warp", composite([lift(view, WarpSettings()) for view in views[:2]], views[2], WarpSettings()))
    paint = stylizer_of(asset, style, atlas, chosen, nothing)
    made.note("one view", paint(views[0], None, np.random.default_rng(0)))
    swept = made.note("sweep", sweep(views[:3], ViewPainter(paint, keeps_outlines=True), chosen.sweep, 0))
    projected = backproject(swept.views, atlas.texels[0], chosen.bake, mesh=asset.mesh)
    filled = pad(fill(projected, atlas.texels[0]), atlas.texels[0], 4)
    made.note("bake from views", [projected, filled])


def compared(made: Stages) -> None:
    """Two pictures compared: the tables, the pictures, the page."""
    from mistyle.comparison.pipeline import compare
    from mistyle.comparison.records import CompareJob
    from mistyle.io.images.write import write_exr
    from mistyle.jobs.progress import Progress

    rng, folder = np.random.default_rng(0), made.out / "pictures"
    picture = 0.2 + rng.random((40, 48, 3), np.float32)
    folder.mkdir()
    for name, scale in (("a", 1.0), ("b", 1.1)):
        write_exr(
            folder / f"{name}.exr", dict(zip("RGB", np.moveaxis(picture * np.float32(scale), -1, 0), strict=True))
        )
    job = CompareJob(folder / "a.exr", (folder / "b.exr",), made.out / "compared", titles=("a", "b"))
    record = compare(job, Progress(quiet=True))
    made.note("compare: numbers", [row["values"] for row in record["rows"]])
    made.note("compare: pictures", sorted((made.out / "compared").rglob("*.webp")))


def photographs(mesh: Any, size: int) -> tuple[Any, Any]:
    """Texels and captures of a ball with known maps, drawn without noise."""
    from mistyle.atlas.texels import rasterise
    from mistyle.core.camera import look_at
    from mistyle.core.capture import in_memory
    from mistyle.core.light import Directional
    from mistyle.core.maps import Maps
    from mistyle.render.deferred.material_table import pack
    from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
    from mistyle.render.mitsuba.draw import tracer

    texels = rasterise(mesh, 0, size)
    wave = 0.5 + 0.4 * np.sin(9 * texels.position)
    flat = np.zeros((size, size, 3), np.float32)
    flat[..., 2] = 1
    maps = Maps(wave.astype(np.float32), flat, wave[..., 0].astype(np.float32), flat[..., 0], texels.covered)
    eyes = ((4, 0.5, 0), (0, 0.5, 4), (-3, 1, 2), (2, 2, -3))
    cameras = [look_at(list(eye), fov=30, size=(48, 48), name=f"v{k}") for k, eye in enumerate(eyes)]
    lamps = [(Directional((0.3, -0.5, -0.8), (2.0, 2.0, 2.0), "camera"),)] * len(eyes)
    blank = in_memory(cameras, lamps, [np.zeros((48, 48, 3), np.float32)] * len(eyes))
    renderer, table = MaterialRenderer(tracer(mesh), blank, [(size, size)], RenderOptions(subsamples=4)), pack([maps])
    return texels, in_memory(cameras, lamps, [renderer.image(table, k) for k in range(len(eyes))])


def recovered(made: Stages) -> None:
    """Per-texel Levenberg-Marquardt, then Adam on whole pictures."""
    from mistyle.solver.recover import recover
    from mistyle.solver.settings import RecoverSettings
    from tests.render.deferred.test_seam import sphere

    mesh = sphere(rings=16, sides=12)
    texels, captures = photographs(mesh, 32)
    for name, change in (("recover: texels", {"solver": "texels"}), ("recover: pictures", {"solver": "both"})):
        chosen = RecoverSettings(rounds=1, iterations=6, bounces=0, solver_iterations=4).model_copy(update=change)
        found = recover(mesh, [texels], captures, chosen, 0).maps[0]
        made.numbers(name, albedo=found.albedo, normal=found.normal, roughness=found.roughness)


def scene_fitted(made: Stages) -> None:
    """A live Mitsuba scene through prb."""
    from mistyle.solver.scene.fit import fit_scene
    from tests.solver.test_scene_fit import COLOUR, ROUGH, flat, references

    pictures = references(flat(), spp=4)
    made.note("scene: pictures", pictures)
    scene = flat()
    bright = [np.asarray(picture * 1.2, np.float32) for picture in pictures]
    found = fit_scene(scene, [COLOUR, ROUGH], references=bright, iterations=6, spp=4, fast=False)
    made.numbers("scene fit", **{key.replace(".", "_"): np.array(value) for key, value in found.values.items()})


def main(out: Path, threads: int, budget: float) -> None:
    from mistyle.jobs.start import start_engines
    from mistyle.process import memory
    from mistyle.stylization.settings import resolve

    settings = resolve("draft", None, SETTINGS | {"threads": threads}, {})
    start_engines(settings)
    out.mkdir(parents=True, exist_ok=True)
    made = Stages(out)
    work: list[Callable[[Stages], None]] = [lambda m: style_job(m, settings), compared, recovered, scene_fitted]
    memory.LEAST = 2048
    with memory.within(budget * 1e9, out / "work" if budget else None):
        for each in work:
            each(made)
    (out / "bytes.json").write_text(json.dumps(made.bytes, indent=1))


if __name__ == "__main__":
    faulthandler.dump_traceback_later(PATIENCE, exit=True)
    main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 0)
