"""The README's picture: `python scenes/make_demo.py overview`.

Upper rows: the demo's four paintings, each above the mesh that wears it, under the studio's softboxes. Lower row: one
asset under a lamp that goes round it, from four sides. The surface is painted by the demo's own settings, with the
relief and gloss that the painting gives, and without the fit.
"""

from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
SIDE = 400  # pixels of a picture of an asset
LARGEST = 250_000  # bytes of the JPEG
GAP = 8
PAINTING = 240  # the height of a painting there, pixels
SAMPLES = 128  # a pixel
ELEVATION, DISTANCE = 12.0, 3.7
FACING = {"elephant": 28.0, "robot": 22.0}  # the camera's azimuth, degrees
LAMPS = (-85.0, -35.0, 35.0, 85.0)  # azimuths of the lamp against the camera's, degrees
LAMP_RADIANCE, LAMP_SHARPNESS, SKY_RADIANCE = 34.0, 60.0, 0.1
UNDER_LAMP = "oil"


def lamp_map(azimuth: float, rows: int = 97) -> np.ndarray:
    """A sky (rows, 2 rows, 3), linear, latitude-longitude: a soft lamp 35 degrees high at `azimuth` (degrees about +Y,
    0 at +Z, 90 at +X) over even, dim surroundings."""
    from mistyle.core.light import environment_directions

    a, e = np.radians(azimuth), np.radians(35)
    towards = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    lamp = LAMP_RADIANCE * np.exp(LAMP_SHARPNESS * (environment_directions(rows, 2 * rows) @ towards - 1))
    return (SKY_RADIANCE + lamp[..., None] * [1.0, 0.95, 0.86]).astype(np.float32)


def painted(mesh: Path, style: Path) -> tuple[Any, list[Any]]:
    """The asset and the maps of its texture sets, painted as `mistyle demo` paints them."""
    from mistyle.io.read import read_picture
    from mistyle.io.read_mesh import read_mesh
    from mistyle.jobs.start import start_engines
    from mistyle.stylization.pipeline import painting
    from mistyle.stylization.pipeline.start import lay_out
    from mistyle.stylization.settings import resolve

    settings = resolve("demo", None, {}, {})
    start_engines(settings)
    asset = read_mesh(mesh)
    atlas = lay_out(asset, settings, lambda done: None)
    layers = painting.paint_layers(asset, read_picture(style), atlas, settings, lambda done: None)
    return asset, painting.raised(asset, layers, atlas, settings)[1]


def cropped(path: Path, width: int, height: int) -> np.ndarray:
    """The middle of a picture, scaled to fill width x height, sRGB 0..1."""
    from PIL import Image, ImageOps

    with Image.open(path) as opened:
        fitted = ImageOps.fit(opened.convert("RGB"), (width, height), Image.Resampling.LANCZOS)
    return np.asarray(fitted, np.float32) / 255


def drawn(asset: Any, maps: list[Any], azimuth: float, lamp: float | None) -> np.ndarray:
    """One picture (SIDE, SIDE, 3), sRGB 0..1: in the studio, or under the lamp at `lamp` degrees from the camera."""
    from mistyle.core.camera import orbit
    from mistyle.core.image import srgb_from_linear
    from mistyle.render.mitsuba.draw import picture
    from mistyle.render.mitsuba.scene import Staging

    camera = orbit(azimuth, ELEVATION, distance=DISTANCE, fov=30, size=(SIDE, SIDE))
    if lamp is None:
        shot = picture(asset.mesh, maps, camera, Staging("studio", SAMPLES))
        return srgb_from_linear(shot[..., :3])
    shot = picture(asset.mesh, maps, camera, Staging("hdri", SAMPLES, hdri=lamp_map(azimuth + lamp)))
    ground = np.linspace(0.035, 0.012, SIDE)[:, None, None]  # a dark wall behind
    return srgb_from_linear(shot[..., :3] + (1 - shot[..., 3:]) * ground)


def row(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures side by side with white gaps."""
    gap = np.ones((len(pictures[0]), GAP, 3), np.float32)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1)


def write(path: Path) -> None:
    """Paint, draw and write the JPEG, in the best quality below LARGEST bytes."""
    import io

    from PIL import Image

    from mistyle.cli.demo_inputs import MESHES, PAINTINGS

    above, middle, below = [], [], []
    for name, painting in PAINTINGS.items():
        mesh, azimuth = HERE / MESHES[painting.mesh], FACING[painting.mesh]
        asset, maps = painted(mesh, HERE / painting.file)
        above.append(cropped(HERE / painting.file, SIDE, PAINTING))
        middle.append(drawn(asset, maps, azimuth, None))
        if name == UNDER_LAMP:
            below = [drawn(asset, maps, azimuth, lamp) for lamp in LAMPS]
    rows = [row(pictures) for pictures in (above, middle, below)]
    gap = np.ones((GAP, rows[0].shape[1], 3), np.float32)
    every = np.concatenate([part for one in rows for part in (gap, one)][1:])
    sheet = Image.fromarray(np.round(np.clip(every, 0, 1) * 255).astype(np.uint8))
    for quality in range(92, 30, -3):
        held = io.BytesIO()
        sheet.save(held, "JPEG", quality=quality, optimize=True)
        if held.tell() <= LARGEST:
            break
    path.write_bytes(held.getvalue())
    print(f"{path}  {sheet.width} x {sheet.height}  {held.tell()} bytes, quality {quality}")
