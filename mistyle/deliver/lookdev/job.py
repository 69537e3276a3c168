"""`mistyle lookdev`: a look-dev sheet of any asset, and its turntables.

OUT/lookdev.png .exr       the sheet: sRGB without a tone curve, and the same linear
OUT/turntable/000.png …    the asset turning under fixed light, with --turntable; OUT/turntable.webp (.mp4)
OUT/light_turn/000.png …   the light turning about a fixed asset, with --hdri-turn; OUT/light_turn.webp (.mp4)
OUT/lookdev.json           asset, settings, exposures and versions of the sheet
"""

import datetime
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from mistyle import __version__
from mistyle.core.asset import Asset
from mistyle.core.errors import MistyleError
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.core.settings import FrozenModel
from mistyle.deliver.lookdev.canvas import PANEL, Panel, PanelRow, Sheet, beside, compose, measures, panel_widths
from mistyle.deliver.lookdev.shape import ASIDE, reshaped
from mistyle.io.store.atomic import atomic_write, sha256_file
from mistyle.io.store.output import claim, replace_files
from mistyle.jobs.progress import Progress
from mistyle.jobs.report.overlays import MAGENTA, viridis

VIEW_TRANSFORM = "sRGB (Rec.709), no tone curve"
USUAL = 560  # pixels of a hero picture at which the sheet's type has scale 1
TURNS = {"turntable": "turn the asset", "light_turn": "turn the light"}
LIGHT_STEPS = 8  # pictures of the HDRI's rotation on the sheet


class LookSettings(FrozenModel):
    """Settings of the sheet and the turntables."""

    size: int = Field(default=USUAL, ge=64, le=4096)
    """pixels of the sheet's largest pictures of the asset"""
    spp: int = Field(default=64, ge=1, le=65536)
    """samples per pixel of the largest pictures"""
    seed: int = Field(default=0, ge=0, lt=2**31)
    """every random choice follows from it"""
    turntable: int = Field(default=0, ge=0, le=720)
    """frames of a turntable; 0: none"""
    hdri_turn: int = Field(default=0, ge=0, le=720)
    """frames of the light's turn; 0: none"""
    frame: int = Field(default=512, ge=32, le=4096)
    """pixels of a turntable's frame"""
    mp4: bool = False
    """the turntables as mp4 too (needs mistyle[video])"""
    threads: int = Field(default=0, ge=0, le=1024)
    """threads; 0 takes all cores"""
    variant: str = "auto"
    """the Mitsuba variant"""


@dataclass(frozen=True)
class SheetSubject:
    """The subject of a sheet: the asset, its file, pictures of the run's texel data per texture set, and, for a
    displaced mesh, the mesh before and after with the azimuth of the change."""

    asset: Asset
    path: Path
    known: dict[str, list[np.ndarray]]
    shapes: tuple[tuple[Asset, Asset], float] | None = None


def lookdev(
    place: Path,
    out: Path,
    settings: LookSettings,
    progress: Progress,
    *,
    hdri: Path | None = None,
    date: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw the sheet of a mesh file or run folder into `out`; returns the written paths.

    `hdri` is an .hdr or .exr environment map for the third light. `date` appears in the burn-in (default: the day of
    the asset file's last change, UTC). The same asset, settings and thread count give the same pictures.
    """
    from mistyle.io.read import read_radiance
    from mistyle.jobs.report.turntable import encoder
    from mistyle.jobs.start import start_engines
    from mistyle.render.lookdev import sheet as drawing

    if settings.mp4:
        encoder()
    inputs = [place, *([hdri] if hdri is not None else [])]
    claim(out, files_of_sheet(settings), inputs=inputs, overwrite=overwrite)
    start_engines(settings)
    with progress.stage("read", "read the asset") as report:
        subject = read_subject(place, report)
        sky = None if hdri is None else read_radiance(hdri)
    progress.note(*subject.asset.notes_of_pictures())
    with progress.stage("light", "expose the lights"):
        name = "" if hdri is None else hdri.stem
        lights = [drawing.exposed(rig, settings.seed) for rig in drawing.rigs(sky, name, read_radiance)]
        # Kernels hold all materials that are loaded, so that the references come before the asset's.
        scale = settings.size / USUAL
        columns = [drawing.references(rig.light, settings.spp, settings.seed, scale) for rig in lights]
        stage = drawing.Stage(subject.asset)
    with progress.stage("sheet", "draw the sheet") as report:
        day = date or datetime.datetime.fromtimestamp(subject.path.stat().st_mtime, datetime.UTC).date().isoformat()
        picture = compose(*sheet(subject, stage, list(zip(lights, columns, strict=True)), settings, day, report))
    written = {"sheet": "lookdev.png", "exr": "lookdev.exr"}
    record = {"asset": subject.path.name, "sha256": sha256_file(subject.path), "date": day, "mistyle": __version__}
    record |= {
        "settings": settings.model_dump(mode="json", exclude={"mp4"}),
        "view": VIEW_TRANSFORM,
        "hdri": hdri.name if hdri else None,
    }
    record["exposure_stops"] = {rig.name: round(rig.stops, 3) for rig in lights}

    def fill(folder: Path) -> None:
        write_sheet(folder, picture)
        written.update(write_turns(folder, stage, lights, settings, progress))
        atomic_write(folder / "lookdev.json", (json.dumps(record, indent=1) + "\n").encode())

    replace_files(out, "lookdev", fill, inputs=inputs, overwrite=overwrite)
    return {name: str(out / file) for name, file in written.items()}


def write_sheet(folder: Path, picture: np.ndarray) -> None:
    """Write the linear sheet (h w 3) as lookdev.png (sRGB, clipped) and lookdev.exr (half floats)."""
    from mistyle.io.images.write import write_exr, write_png

    write_png(folder / "lookdev.png", srgb_from_linear(np.clip(picture, 0, 1)))
    write_exr(folder / "lookdev.exr", dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)), half=True)


def write_turns(
    folder: Path, stage: Any, lights: Sequence[Any], settings: LookSettings, progress: Progress
) -> dict[str, str]:
    """Draw and write the turntables of the settings; returns the film of each, relative to the folder."""
    from mistyle.jobs.report.turntable import write_turn

    turns = {
        "turntable": (settings.turntable, stage.turn, lights[0]),
        "light_turn": (settings.hdri_turn, partial(stage.turn, of_light=True), lights[2]),
    }
    films = {}
    for name, (frames, draw, rig) in turns.items():
        if frames:
            with progress.stage(name, TURNS[name]) as report:
                drawn = draw(frames, rig.light, settings.frame, max(settings.spp // 2, 1), settings.seed, report)
                paths = write_turn(folder / name, [shown(p) for p in drawn], settings.mp4)
                films[name] = str(paths[-1].relative_to(folder))
    return films


def files_of_sheet(settings: LookSettings) -> list[str]:
    """The files of a sheet with these settings, relative to its folder."""
    names = ["lookdev.png", "lookdev.exr", "lookdev.json"]
    for name, frames in (("turntable", settings.turntable), ("light_turn", settings.hdri_turn)):
        if frames:
            names += [*(f"{name}/{k:03}.png" for k in range(frames)), f"{name}.webp", *([f"{name}.mp4"] * settings.mp4)]
    return names


def read_subject(place: Path, report: Callable[[float], None] = lambda done: None) -> SheetSubject:
    """A mesh file, or a run folder's asset with the run's knowledge of the texels. Raises InputRefused."""
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.external.renderers import finished_asset

    path = finished_asset(place) if place.is_dir() else place
    asset = read_mesh(path, progress=report)
    known = texel_knowledge(place, len(asset.mesh.parts)) if place.is_dir() else {}
    return SheetSubject(asset, path, known, reshaped(place) if place.is_dir() else None)


def texel_knowledge(folder: Path, parts: int) -> dict[str, list[np.ndarray]]:
    """Coverage, confidence and repair of a run folder's texels as sRGB colours, one picture per texture set."""
    from mistyle.io.store.records import load_record

    def record(stage: str) -> Any:
        place = folder / "work" / stage / "record"
        try:
            return load_record(place) if place.is_dir() else None
        except MistyleError:
            return None  # written by another version: the sheet omits it

    baked, repaired, recovered = (record(stage) for stage in ("bake", "repair", "recover"))
    pictures: dict[str, list[np.ndarray]] = {}
    source = recovered if recovered is not None else baked
    if source is not None:
        most = max(max(int(seen.max()) for seen in source.seen), 1)
        pictures["coverage"] = [viridis(np.sqrt(seen / most).astype(np.float32)) / 255 for seen in source.seen]
    if recovered is not None:
        pictures["confidence"] = [viridis(values.astype(np.float32)) / 255 for values in recovered.confidence]
    if repaired is not None:
        pictures["struggle"] = [
            np.where(mask[..., None], np.array(MAGENTA), 0.25 + 0.5 * srgb_from_linear(maps.albedo).mean(-1)[..., None])
            for mask, maps in zip(repaired.mask, repaired.maps, strict=True)
        ]
    return {name: [p.astype(np.float32) for p in each] for name, each in pictures.items() if len(each) == parts}


class Pace:
    """The share of the time after each of several pictures (of these sizes, in this order).

    The first picture of a size compiles kernels, which may take far longer than drawing it and depends on the
    materials and on the kernels stored by earlier runs: later ones are expected to take as long as these so far.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self._firsts = [k == 0 or size != sizes[k - 1] for k, size in enumerate(sizes)]
        self._began = self._last = time.perf_counter()
        self._seconds: list[float] = []

    def drawn(self) -> float:
        """Call this after every picture."""
        now = time.perf_counter()
        self._seconds.append(now - self._last)
        self._last, count = now, len(self._seconds)
        rest = 0.0
        for kind in (True, False):
            taken = [s for s, first in zip(self._seconds, self._firsts, strict=False) if first == kind]
            mean = float(np.mean(taken)) if taken else self._seconds[0] / 4
            rest += mean * self._firsts[count:].count(kind)
        elapsed = now - self._began
        return min(elapsed / max(elapsed + rest, 1e-9), 0.99)


def sheet(
    subject: SheetSubject,
    stage: Any,
    rigs: Sequence[tuple[Any, np.ndarray]],
    settings: LookSettings,
    day: str,
    report: Callable[[float], None],
) -> tuple[Sheet, int, float]:
    """The arguments of `compose`: the sheet with its pictures, the width of its rows, and the scale of its type.

    `rigs` are the lights, each with its picture of the references.
    """
    from mistyle.render.lookdev import sheet as drawing
    from mistyle.render.lookdev.aovs import aovs

    scale = settings.size / USUAL
    column = drawing.column_camera(scale).size[1]
    gutter = measures(scale)["gutter"]
    width = 3 * (settings.size + column) + 2 * gutter
    lights = [rig for rig, _ in rigs]
    side = panel_widths(len(drawing.CAMERAS), width, gutter)
    step = panel_widths(LIGHT_STEPS, width, gutter)
    pace = Pace([settings.size] * len(lights) + [side] * len(drawing.CAMERAS) + [step] * LIGHT_STEPS)

    def shot(azimuth: float, elevation: float, light: Any, size: int) -> np.ndarray:
        picture = stage.picture(azimuth, elevation, light, size, settings.spp, settings.seed)
        report(pace.drawn())
        return drawing.over(picture, (PANEL,) * 3)

    heroes = []
    for rig, references in rigs:
        hero = shot(*drawing.CAMERAS["3/4"], rig.light, settings.size)
        pictures = [hero, drawing.over(references, (PANEL,) * 3)[: settings.size]]
        heroes.append(Panel(beside(pictures), rig.name, f"{rig.stops:+.1f} stops"))
    cameras = [Panel(shot(*at, lights[0].light, side), name) for name, at in drawing.CAMERAS.items()]
    known = {name: each for name, each in subject.known.items()}
    passes = aovs(subject.asset, drawing.asset_camera(*drawing.CAMERAS["3/4"], 64), known)
    small = panel_widths(len(passes), width, gutter) // 2 * 2
    passes = aovs(subject.asset, drawing.asset_camera(*drawing.CAMERAS["3/4"], small), known)
    strip = [Panel(linear_from_srgb(on_panel(p)), name) for name, p in passes.items()]
    turned = []
    for k in range(LIGHT_STEPS):
        angle = 360 * k / LIGHT_STEPS
        light = type(lights[2].light)(**{**vars(lights[2].light), "turn": lights[2].light.turn + angle})
        turned.append(Panel(shot(*drawing.CAMERAS["3/4"], light, step), f"{angle:.0f}°"))
    rows = (
        PanelRow("Three lights, each exposed so that the grey ball is 18 %", tuple(heroes)),
        PanelRow("Soft studio from five sides: the asset turns, the light is fixed", tuple(cameras)),
        PanelRow("AOVs", tuple(strip)),
        PanelRow(f"{lights[2].name}, turned about the asset", tuple(turned)),
    )
    if subject.shapes is not None:
        rows = (*rows, shape_row(subject.shapes, lights[1].light, settings, panel_widths(4, width, gutter)))
    return Sheet(subject.path.stem, facts(subject), rows, burn_in(subject, settings, day)), width, scale


def shape_row(shapes: tuple[tuple[Asset, Asset], float], key: Any, settings: LookSettings, size: int) -> PanelRow:
    """The mesh before and after its displacement, from the changed view and from aside."""
    from mistyle.render.lookdev import sheet as drawing

    (pair, azimuth), panels = shapes, []
    stages = [(name, drawing.Stage(asset)) for name, asset in zip(("before", "after"), pair, strict=True)]
    for angle in (azimuth, azimuth + ASIDE):
        for name, stage in stages:
            picture = stage.picture(angle, 0.0, key, size, settings.spp, settings.seed)
            panels.append(Panel(drawing.over(picture, (PANEL,) * 3), name, f"{angle % 360:.0f}°"))
    return PanelRow("The displaced mesh as clay under the hard key", tuple(panels))


def on_panel(picture: np.ndarray) -> np.ndarray:
    """Straight sRGB with alpha, composited over a panel in sRGB."""
    ground = float(srgb_from_linear(np.array(PANEL, np.float32)))
    return (picture[..., :3] * picture[..., 3:] + (1 - picture[..., 3:]) * ground).astype(np.float32)


def shown(picture: np.ndarray) -> np.ndarray:
    """A premultiplied linear picture as straight sRGB and alpha."""
    alpha = np.clip(picture[..., 3:], 0, 1)
    colour = srgb_from_linear(np.clip(picture[..., :3] / np.maximum(alpha, 1e-4), 0, 1))
    return np.concatenate([colour, alpha], axis=-1).astype(np.float32)


def facts(subject: SheetSubject) -> tuple[str, ...]:
    """The asset in one line, and the first two notes of its reader that hold for the sheet."""
    mesh, sizes = subject.asset.mesh, []
    for material in subject.asset.materials:
        if material.albedo is not None:
            sizes.append(f"{material.albedo.shape[1]} x {material.albedo.shape[0]}")
    textures = ", ".join(sorted(set(sizes))) or "no textures"
    sets = f"{len(mesh.parts)} texture set{'s' if len(mesh.parts) > 1 else ''}"
    line = f"{len(mesh.faces):,} faces   ·   {sets}   ·   {textures}"
    return (line, *subject.asset.notes_of_pictures()[:2])


def burn_in(subject: SheetSubject, settings: LookSettings, day: str) -> str:
    """The line at the foot of the sheet."""
    digest = sha256_file(subject.path)[:16]
    parts = (subject.path.name, f"sha256 {digest}", day, f"mistyle {__version__}")
    return "   ·   ".join((*parts, f"{settings.spp} samples", "linear Rec.709", f"view: {VIEW_TRANSFORM}"))
