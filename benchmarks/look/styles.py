"""The style pictures of `benchmarks.look`: thirteen of `data/styles`, and nine that are made here, of other kinds.

The made ones are drawn by `made.py` and `made_more.py` from nothing but seeded random numbers, the same
pixels each time, and are dedicated to the public domain (CC0 1.0).
"""

from pathlib import Path

import cv2

from benchmarks.common import DATA
from benchmarks.look import made as look_made
from benchmarks.look import made_more as look_made_more

# "oil": brushwork without borders. "structured": what lives by its lines, grids, tiles, dots or flat shapes.
FOUND = {
    "composition_vii": ("composition_vii.jpg", "structured"),
    "contrast_of_forms": ("contrast_of_forms.jpg", "structured"),
    "cracked_rock": ("cracked_rock_polyhaven.jpg", "structured"),
    "great_wave": ("great_wave.jpg", "structured"),
    "mosaic_ducks": ("mosaic_ducks.jpg", "structured"),
    "pixelart_urban": ("pixelart_rpg_urban.png", "structured"),
    "sakai_hoitsu": ("sakai_hoitsu_gold.jpg", "structured"),
    "shipwreck": ("shipwreck_minotaur.jpg", "oil"),
    "starry_night": ("starry_night.jpg", "oil"),
    "the_scream": ("the_scream.jpg", "oil"),
    "udnie": ("udnie.jpg", "structured"),
    "wheat_field": ("wheat_field_cypresses.jpg", "oil"),
    "woodcut": ("woodcut_head.jpg", "structured"),
}
MADE = {
    "stained_glass": (look_made.stained_glass, "structured"),
    "tesserae": (look_made.tesserae, "structured"),
    "low_poly": (look_made.low_poly, "structured"),
    "tartan": (look_made.tartan, "structured"),
    "sprites": (look_made.sprites, "structured"),
    "halftone": (look_made_more.halftone, "structured"),
    "cross_hatching": (look_made_more.cross_hatching, "structured"),
    "pointillism": (look_made_more.pointillism, "oil"),
    "watercolour": (look_made_more.watercolour, "oil"),
}
KINDS = {name: kind for styles in (FOUND, MADE) for name, (_, kind) in styles.items()}


def file_of(name: str, folder: Path) -> Path:
    """The picture of a style; a made one is drawn into `folder` where it is not there yet."""
    if name in FOUND:
        return DATA / "styles" / FOUND[name][0]
    path = folder / f"{name}.png"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        drawn = MADE[name][0]()
        if not cv2.imwrite(str(path), cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR)):
            raise SystemExit(f"{path}: cannot be written")
    return path
