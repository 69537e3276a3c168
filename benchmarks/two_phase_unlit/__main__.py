"""Is the fit of unlit stylized views worth its time to a viewer? `python -m benchmarks.two_phase_unlit VERB`

sheets   paints STYLES on MESHES, once each, and finishes every painting in two ways (DESIGNS); writes `sheets/NN.png`
         and `key.json` into --out. A sheet shows A on the left and B on the right: turned under an environment, the
         environment turned about it, and a hard key light from four sides. Which way is A is drawn by lot (--seed).
score    compares answers, {"NN": {viewer: "A", "B" or "="}}, with the key: `unlit.preferred` is the share of the
         answers that chose the fit (a "=" counts half), `unlit.preferred.MESH` and `.STYLE` the same of a part. The
         key and answers in this folder are of 9824def's drafts, phase 1 against the painter's maps, phase 2 in both.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import common
from benchmarks.common import DATA
from benchmarks.look.light import close_camera, encoded, sky
from benchmarks.look.sheets import lettered, write

HERE = Path(__file__).resolve().parent
KEY_FILE, ANSWERS = HERE / "key.json", HERE / "answers.json"
MESHES = {"spot": "spot.obj", "bunny": "stanford-bunny.obj", "teapot": "teapot.obj"}
STYLES = ("starry_night", "great_wave", "mosaic_ducks", "woodcut_head")
# What is set for the one with the fit, and for the one without.
DESIGNS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "phase1": ({"fit": {"refine": "all"}}, {"fit": {"refine": "albedo"}}),
    "phase2": ({"fit": {"refine": "albedo"}}, {"fit": {"refine": "off"}}),
    "both": ({"fit": {"refine": "all"}}, {"fit": {"refine": "off"}}),
    # Twice the relief, to begin with and to aim at.
    "bold": ({"fit": {"refine": "all", "relief": 0.3}, "paint": {"height": 0.3}}, {"fit": {"refine": "off"}}),
    "bold_unfitted": ({"fit": {"refine": "off"}, "paint": {"height": 0.3}}, {"fit": {"refine": "off"}}),
}
SMALL, LARGE = 252, 378  # pixels of a picture's side, under an environment and under the key light
SPP = {"path": 32, "direct": 16}  # samples a pixel under either
TURNED = ((35.0, 15.0), (125.0, 10.0), (215.0, -12.0), (305.0, 20.0))  # azimuth and elevation of the camera
TURNS = (90.0, 200.0)  # degrees by which the environment is turned about the asset
FRONT = {"spot": (120.0, 12.0), "bunny": (35.0, 12.0), "teapot": (35.0, 20.0)}  # the side that the key light shows
CLOSE = 0.6  # share of a picture's side that pictures under the key light show, its middle
# Towards the key light, in the camera's axes (x right, y down, z forward), and its irradiance; ambient radiance.
KEYS = ((-0.87, -0.35, -0.35), (0.87, -0.35, -0.35), (0.1, -0.93, -0.35), (-0.5, 0.75, -0.43))
KEY, FILL = 3.2, 0.10
GAP = 16


@dataclass(frozen=True)
class Painted:
    """A mesh with a painting on it, up to where the fit begins, and its settings without those of a design."""

    mesh: str
    style: str
    settings: Any
    asset: Any
    atlas: Any
    layers: Any
    views: Any
    picture: Any


@dataclass(frozen=True)
class Finished:
    """The maps of one way to finish a painting, which phases stayed, and processor seconds of the fit."""

    maps: tuple[Any, ...]
    kept: dict[str, bool]
    figures: dict[str, tuple[float, float]]
    cpu: float


def silent(done: float) -> None:
    pass


def settings_of(preset: str, change: Mapping[str, Any]) -> Any:
    """A preset's settings with some of them changed."""
    from mistyle.jobs.settings import merge
    from mistyle.stylization.settings import PRESETS, Settings

    return Settings.model_validate(merge(PRESETS[preset], change))


def paint(mesh: str, style: str, preset: str) -> Painted:
    """The stages before the bake, as a job runs them."""
    from mistyle.core.view import View
    from mistyle.io.read import read_picture
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.mitsuba.draw import gbuffer, tracer
    from mistyle.stylization.pipeline import painting
    from mistyle.stylization.pipeline import start as stylize_start

    chosen = settings_of(preset, {})
    asset = read_mesh(DATA / "meshes/plain" / MESHES[mesh], size=chosen.atlas.size)
    atlas = stylize_start.lay_out(asset, chosen, silent)
    picture = read_picture(next((DATA / "styles").glob(f"{style}.*")))
    layers = painting.paint_layers(asset, picture, atlas, chosen, silent)
    traced, views = tracer(asset.mesh), []
    for camera in stylize_start.cameras_of(chosen, asset.mesh, print):
        hits = gbuffer(traced, camera)
        cover = hits.mask.astype(np.float32)
        views.append(View(camera, hits.position, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, cover))
    return Painted(mesh, style, chosen, asset, atlas, layers, views, picture)


def finish(painted: Painted, preset: str, change: Mapping[str, Any]) -> Finished:
    """Bake, fit and repair with a design's settings."""
    from mistyle.stylization.inpaint.repair import struggle_mask
    from mistyle.stylization.pipeline import painting
    from mistyle.stylization.pipeline import stylize as pipeline

    s = settings_of(preset, change)
    baked = painting.bake(painted.asset, painted.layers, painted.atlas, painted.views, s, silent)
    stylized = painting.unlit_views(painted.asset, baked.maps, painted.views, silent)
    took: dict[str, float] = {}
    fitted = common.timed(
        took,
        "fit",
        lambda: pipeline.fit(painted.asset, painted.picture, painted.atlas, baked, stylized, s, silent),
    )
    masks = [
        struggle_mask(fitted.struggle[k], fitted.touched[k], baked.seen[k], texels, s.repair, fitted.agreed[k])
        for k, texels in enumerate(painted.atlas.texels)
    ]
    repaired = pipeline.repair(
        painted.asset, painted.picture, painted.atlas, baked, painted.views, fitted, masks, s, silent
    )
    return Finished(tuple(repaired.maps), fitted.kept, fitted.figures, took["fit.cpu"])


def pictures(asset: Any, maps: Sequence[Any], front: tuple[float, float]) -> list[np.ndarray]:
    """SMALL pictures of the turned asset and of the turned environment, then LARGE ones under the moving key light."""
    from mistyle.core.camera import zoom
    from mistyle.core.light import Ambient, Directional
    from mistyle.render.lookdev.scenes import asset_scene, drawn
    from mistyle.render.mitsuba.scene import object_shapes

    shapes = object_shapes(asset.mesh, list(maps), flip_invalid=True, model="gltf", frame="mikkt")
    light = sky("venice_sunset_1k.hdr")

    def shown(place: tuple[float, float], size: int, lights: Sequence[Any], part: float, how: str) -> np.ndarray:
        camera = close_camera(asset.mesh.positions, *place, size)
        corner = size * (1 - part) / 2
        camera = zoom(camera, corner, corner, size * part, (size, size))
        return encoded(drawn(asset_scene(shapes, camera, tuple(lights), how), 0, SPP[how], 0))

    result = [shown(place, SMALL, [replace(light, turn=light.turn + place[0])], 1.0, "path") for place in TURNED]
    result += [shown(front, SMALL, [replace(light, turn=light.turn + front[0] + turn)], 1.0, "path") for turn in TURNS]
    for key in KEYS:
        unit = tuple((np.array(key) / np.linalg.norm(key)).tolist())
        sun = Directional(unit, (KEY, KEY, KEY), frame="camera")
        result.append(shown(front, LARGE, [sun, Ambient((FILL, FILL, FILL))], CLOSE, "direct"))
    return result


def difference(after: Sequence[np.ndarray], before: Sequence[np.ndarray]) -> dict[str, float]:
    """How far the pictures of a pair are apart, in steps of 255, where they show the asset: mean and 99th percentile,
    under the environments and under the key light."""
    result = {}
    for name, part in (("environment", slice(0, 6)), ("key", slice(6, 10))):
        one, two = (np.stack(shown[part]).astype(np.float32) for shown in (after, before))
        apart = np.abs(one - two).max(axis=-1)
        at = (np.stack(before[part]) != np.stack(before[part])[:, :1, :1]).any(axis=-1)
        result |= {f"{name}.mean": round(float(apart[at].mean()), 2)}
        result |= {f"{name}.most": round(float(np.percentile(apart[at], 99)), 1)}
    return result


def side(letter: str, shown: Sequence[np.ndarray]) -> np.ndarray:
    """One candidate's half of a sheet."""
    rows = [np.concatenate(shown[k : k + n], axis=1) for k, n in ((0, 3), (3, 3), (6, 2), (8, 2))]
    return np.concatenate([lettered(letter, rows[0].shape[1]), *rows])


def sheet(left: Sequence[np.ndarray], right: Sequence[np.ndarray]) -> np.ndarray:
    """Both candidates side by side."""
    halves = [side(letter, shown) for letter, shown in (("A", left), ("B", right))]
    return np.concatenate([halves[0], np.full((len(halves[0]), GAP, 3), 255, np.uint8), halves[1]], axis=1)


def sheets(chosen: argparse.Namespace) -> dict[str, float]:
    """Write the sheets and the key of the chosen designs, one folder each below --out."""
    from mistyle.jobs.start import start_engines
    from mistyle.stylization.settings import Settings

    start_engines(Settings())
    pairs = [(mesh, style) for style in chosen.styles for mesh in chosen.meshes]
    keys: dict[str, dict[str, Any]] = {design: {} for design in chosen.designs}
    seconds: dict[str, list[float]] = {}
    for number, (mesh, style) in enumerate(pairs):
        painted = paint(mesh, style, chosen.preset)
        known: dict[str, tuple[Finished, list[np.ndarray]]] = {}
        for design in chosen.designs:
            ends = []
            for change in DESIGNS[design]:
                name = json.dumps(change, sort_keys=True)
                if name not in known:
                    made = finish(painted, chosen.preset, change)
                    known[name] = made, pictures(painted.asset, made.maps, FRONT[mesh])
                ends.append(known[name])
            (fitted, after), (_, before) = ends
            order = np.random.default_rng([chosen.seed, number]).permutation(2).tolist()
            shown = [(after, before)[k] for k in order]
            place = chosen.out / design / "sheets" / f"{number + 1:02}.png"
            keys[design][place.stem] = {
                **{"mesh": mesh, "style": style, "preset": chosen.preset, "kept": fitted.kept},
                **{"A": ("fit", "without")[order[0]], "B": ("fit", "without")[order[1]]},
                "difference": difference(after, before),
                "figures": {name: [round(v, 4) for v in both] for name, both in fitted.figures.items()},
                "sha256": write(place, sheet(*shown)),
            }
            seconds.setdefault(f"{design}.fit.cpu", []).append(fitted.cpu)
            text = json.dumps({"design": design, "sheets": keys[design]}, indent=1)
            (chosen.out / design / "key.json").write_text(text + "\n", encoding="utf-8")
    return {name: float(np.mean(values)) for name, values in seconds.items()} | {"sheets": float(len(pairs))}


def score(chosen: argparse.Namespace) -> dict[str, float]:
    """Shares of the answers that chose the fit."""
    key = json.loads(chosen.key.read_text())["sheets"]
    answers = json.loads(chosen.answers.read_text())
    wrong = sorted(set(answers) - set(key))
    if wrong:
        raise SystemExit(f"{chosen.answers}: sheet '{wrong[0]}' is not in {chosen.key}")
    found: dict[str, list[float]] = {}
    for name, said in answers.items():
        for letter in said.values():
            if letter not in ("A", "B", "="):
                raise SystemExit(f'{chosen.answers}: sheet {name}: found {letter!r}, expected "A", "B" or "="')
            value = 0.5 if letter == "=" else float(key[name][letter] == "fit")
            for part in ("", f".{key[name]['mesh']}", f".{key[name]['style']}"):
                found.setdefault(f"unlit.preferred{part}", []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()} | {
        "answers": float(len(found.get("unlit.preferred", [])))
    }


def options(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="python -m benchmarks.two_phase_unlit",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("verb", choices=("sheets", "score"))
    for name, known in (("meshes", tuple(MESHES)), ("styles", STYLES), ("designs", tuple(DESIGNS))):
        made.add_argument(f"--{name}", nargs="+", choices=known, default=known[:1] if name == "designs" else known)
    made.add_argument("--preset", choices=("draft", "standard", "demo"), default="draft")
    made.add_argument("--out", type=Path, default=Path("unlit"), metavar="DIR", help="sheets: a folder for each design")
    made.add_argument("--seed", type=int, default=0, help="of the shuffle")
    made.add_argument("--key", type=Path, default=KEY_FILE, metavar="FILE", help="score (default: in this folder)")
    made.add_argument("--answers", type=Path, default=ANSWERS, metavar="FILE", help="score (default: in this folder)")
    made.add_argument("--json", type=Path, metavar="FILE")
    return made.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    chosen = options(argv)
    common.finish({"sheets": sheets, "score": score}[chosen.verb](chosen), chosen.json)


if __name__ == "__main__":
    main()
