"""Strips of pictures for mistyle/stylization/README.md: `python -m benchmarks.settings_strip [--out scenes/strips]`

One strip a setting: the demo mesh painted with the demo picture, everything else at its default, values growing from
left to right. Writes small JPGs (under 60 kB) and nothing else. --quick: two values of one setting, coarse.
"""

import argparse
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.common import ROOT
from mistyle.core.camera import rig
from mistyle.core.image import srgb_from_linear
from mistyle.core.settings import RigSettings
from mistyle.io.images.write import write_png
from mistyle.io.read import read_picture
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs import start
from mistyle.render.mitsuba.unlit import unlit
from mistyle.stylization.pipeline import painting
from mistyle.stylization.pipeline import start as stylize_start
from mistyle.stylization.settings import Settings

STRIPS: dict[str, tuple[dict[str, Any], ...]] = {
    "stroke_scale": tuple({"stroke_scale": v} for v in (0.5, 1.0, 2.0, 4.0)),
    "form": tuple({"form": v} for v in (0.0, 0.5, 1.0)),
    "detail": ({"detail": 0.0}, {}, {"glaze": 0.8}, {"detail": 12.0, "relief": 4.0}),
    "strength": tuple({"stroke_coherence": v} for v in (0.0, 0.02, 0.06, 0.15)),
    "palette": ({"palette": 0.02}, {}, {"palette": 4.0}, {"palette_mix": 1.0}),
    "direction": ({"orientation": 0.0}, {}, {"direction": "up"}, {"direction": "around"}, {"flow": (1, 1)}),
}
VIEW = 0  # of the paper's rig: front right
LARGEST = 60_000  # bytes of a strip
WHITE = 245  # of 255 and more counts as background where tiles are cropped


def strip(asset: Any, picture: Any, base: Settings, variants: tuple[dict[str, Any], ...], side: int) -> Image.Image:
    """The demo painted with every variant of the surface's settings, side by side."""
    camera = rig(RigSettings(resolution=side))[VIEW]
    tiles = []
    for change in variants:
        with tempfile.TemporaryDirectory() as folder:
            settings = changed(base, change, Path(folder))
            tiles.append(np.round(tile(asset, picture, settings, [camera], lambda done: None) * 255).astype(np.uint8))
    used = np.stack([(t < WHITE).any(axis=2) for t in tiles]).any(axis=0)
    rows, columns = np.flatnonzero(used.any(axis=-1)), np.flatnonzero(used.any(axis=0))
    window = np.s_[max(rows[0] - 4, 0) : rows[-1] + 5, max(columns[0] - 4, 0) : columns[-1] + 5]
    return Image.fromarray(np.concatenate([t[window] for t in tiles], axis=1))


def changed(base: Settings, change: dict[str, Any], folder: Path) -> Settings:
    """The settings with other ones of the surface, or ("flow") with a direction map of one colour, left in `folder`."""
    if "flow" not in change:
        return base.model_copy(update={"surface": base.surface.model_copy(update=change)})
    path = folder / "flow.png"
    write_png(path, np.broadcast_to(np.array([*change["flow"], 0.5], np.float32), (8, 8, 3)))
    return base.model_copy(update={"paint": base.paint.model_copy(update={"direction_map": path})})


def save(picture: Image.Image, path: Path) -> int:
    """Write a JPG of the best quality that stays under LARGEST; returns its bytes."""
    for quality in range(90, 20, -5):
        held = io.BytesIO()
        picture.save(held, "JPEG", quality=quality, optimize=True)
        if held.tell() < LARGEST:
            break
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(held.getvalue())
    return held.tell()


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.settings_strip", description=__doc__)
    options.add_argument("--out", type=Path, default=ROOT / "scenes" / "strips", metavar="FOLDER")
    options.add_argument("--only", choices=list(STRIPS), help="one strip")
    options.add_argument("--quick", action="store_true")
    chosen = options.parse_args()
    samples, side, atlas = (8_000, 128, 256) if chosen.quick else (50_000, 360, 1024)
    base = Settings.model_validate({"surface": {"samples": samples}, "atlas": {"size": atlas}})
    start.start_engines(base)
    asset = read_mesh(ROOT / "scenes" / "demo.obj")
    picture = read_picture(ROOT / "scenes" / "demo_style.png")
    for name, variants in STRIPS.items():
        if chosen.only in (None, name) and not (chosen.quick and name != "stroke_scale"):
            made = strip(asset, picture, base, variants[:2] if chosen.quick else variants, side)
            size = save(made, chosen.out / f"{name}.jpg")
            print(f"{chosen.out / name}.jpg  {made.width} x {made.height}  {size} bytes", flush=True)


def tile(asset, picture, settings, cameras, report) -> np.ndarray:
    """The painted surface from every camera, without light, side by side, on white, encoded sRGB."""
    atlas = stylize_start.lay_out(asset, settings, lambda done: None)
    layers = painting.paint_layers(asset, picture, atlas, settings, report)
    drawn = unlit(asset.mesh, painting.painted(asset, layers, atlas, settings), cameras)
    return np.concatenate([srgb_from_linear(rgb + 1 - share[..., None]) for rgb, share in drawn], axis=1)


if __name__ == "__main__":
    main()
