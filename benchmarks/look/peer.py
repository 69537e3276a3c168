"""EbSynth as a candidate of `benchmarks.look sheets`: view after view, then baked onto the mesh.

EbSynth gets the colour and the detail guide of our stylizer, as in `benchmarks.consistency.peer`, and its own way to
consistency: a third guide, from the painting to what earlier views show, carried into the view. A first pass without
that guide fills it where they show nothing; its time counts too. The views are those of the paper's rig, and `mistyle
bake` lays them on the mesh. Time counts from the mesh's file to the GLB, unwrapping and drawing of views included.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.consistency.peer import grey, save, source_guides
from benchmarks.look.paint import Piece, sha256

RESOLUTION, SAMPLES, ATLAS = 512, 80_000, 1024
PREVIOUS = 1.0  # weight of the guide of earlier views, as much as colour


def baked_peer(program: Path, piece: Piece, cache: Path, quick: bool = False) -> Path:
    """The GLB that EbSynth's views make, and beside it GLB.json with its processor seconds; kept in the cache."""
    kept = cache / "painted" / f"ebsynth-{sha256(program)[:12]}" / f"{piece.label}{'-quick' if quick else ''}.glb"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        begin = os.times()
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            sizes = (128, 5_000, 256) if quick else (RESOLUTION, SAMPLES, ATLAS)
            draw_views(program, piece, folder, sizes)
            made = bake(piece.mesh_file, folder, sizes[2])
            end = os.times()
            spent = sum(end[:4]) - sum(begin[:4])  # user and system, of this process and of its children
            kept.with_name(kept.name + ".json").write_text(json.dumps({"pixel": None, "cpu": spent}))
            kept.write_bytes(made.read_bytes())
    return kept


def draw_views(program: Path, piece: Piece, folder: Path, sizes: tuple[int, int, int]) -> None:
    """Stylize every view with EbSynth, each after the ones before it, and leave them in `folder`/views."""
    from benchmarks.consistency.scene import guided
    from mistyle.core.camera import rig
    from mistyle.core.image import linear_from_srgb
    from mistyle.core.settings import RigSettings
    from mistyle.io.cameras.views import write_views
    from mistyle.io.read import read_picture
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.mitsuba.draw import draw_views as drawn
    from mistyle.stylization.mvst.lift import lift
    from mistyle.stylization.mvst.settings import WarpSettings
    from mistyle.stylization.settings import resolve
    from mistyle.stylization.surface.exemplar.chosen import settled
    from mistyle.stylization.surface.settings import SurfaceSettings

    resolution, samples, atlas = sizes
    layers = {"surface": {"samples": samples}, "atlas": {"size": atlas}, "rig": {"resolution": resolution}}
    settings = resolve(None, None, layers)
    asset, style = read_mesh(piece.mesh_file, size=atlas), read_picture(piece.style_file)
    surface = SurfaceSettings(**settled(style.rgb, style.alpha, settings.surface).model_dump())
    settings = settings.model_copy(update={"surface": surface})
    views = drawn(asset.mesh, None, rig(RigSettings(resolution=resolution)), "paper_views", 1, settings.seed)
    colour, detail, painting = guided(asset, style, settings, views)
    broad, band = source_guides(painting.rgb)
    for name, picture in (("style", painting.rgb), ("source_colour", broad), ("source_detail", grey(band))):
        save(folder / f"{name}.png", picture)
    finished, lifted, warping = [], [], WarpSettings()
    strokes = settings.surface.relief * float(band.std())
    for k, view in enumerate(views):
        wanted = {"colour": colour[k], "detail": grey(strokes * detail[k])}
        paint = partial(stylized, program, folder, view.mask, detail=f"{settings.surface.detail:g}")
        picture = paint(wanted)
        if lifted:
            picture = paint(wanted | {"before": before(lifted, view, picture)})
        shown = linear_from_srgb(picture) * view.coverage[..., None]
        finished.append(replace(view, rgb=np.where(view.mask[..., None], shown, 0).astype(np.float32)))
        lifted.append(lift(finished[-1], warping))
        print(f"EbSynth: view {k + 1} of {len(views)}", file=sys.stderr)
    write_views(folder / "views", finished, ())


def before(lifted: Sequence[Any], view: Any, picture: np.ndarray) -> np.ndarray:
    """What earlier views show in this one, encoded; where they show nothing, `picture`, which was made without them."""
    from mistyle.core.image import srgb_from_linear
    from mistyle.stylization.mvst.settings import WarpSettings
    from mistyle.stylization.mvst.warp import composite

    prior = composite(lifted, view, WarpSettings())
    return np.where(prior.known[..., None], srgb_from_linear(np.clip(prior.rgb, 0, 1)), picture).astype(np.float32)


def stylized(program: Path, folder: Path, mask: np.ndarray, wanted: dict[str, np.ndarray], detail: str) -> np.ndarray:
    """What EbSynth paints after the guides, encoded sRGB."""
    from mistyle.core.image import nearest_fill
    from mistyle.io.read import read_picture

    sources = {
        "colour": ("source_colour", "1"),
        "detail": ("source_detail", detail),
        "before": ("style", f"{PREVIOUS}"),
    }
    command = [str(program.resolve()), "-style", "style.png", "-output", "out.png", "-backend", "cpu"]
    for name, picture in wanted.items():
        # It knows no mask: guides that end in black would draw dark strokes over the silhouette.
        save(folder / f"{name}.png", nearest_fill(picture, mask))
        command += ["-guide", f"{sources[name][0]}.png", f"{name}.png", "-weight", sources[name][1]]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return read_picture(folder / "out.png").rgb


def bake(mesh: Path, folder: Path, atlas: int) -> Path:
    """The GLB of `mistyle bake`."""
    from mistyle.cli.main import main

    out = folder / "baked"
    arguments = ["bake", str(mesh), str(folder / "views"), "-o", str(out), "--atlas", str(atlas), "--name", "look"]
    with contextlib.redirect_stdout(sys.stderr):
        code = main(arguments)
    if code != 0:
        raise SystemExit(f"mistyle {' '.join(arguments)} ended with {code}")
    return next(iter(sorted(out.rglob("*.glb"))))
