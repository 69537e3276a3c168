"""The job record of `stylize`, and its stages with their descriptions."""

from dataclasses import dataclass
from pathlib import Path

from mistyle.stylization.settings import Settings

STAGES = {
    "mesh": "read the mesh",
    "texels": "rasterise the UVs",
    "views": "render the views",
    "surface": "paint the surface",
    "bake": "bake the texture",
    "stylized": "draw the stylized views",
    "fit": "fit normal, roughness and albedo",
    "masks": "compute the struggle mask",
    "repair": "repair the texture",
    "asset": "write the asset",
    "report": "write the report",
}
# Skipped when nothing after the bake changes the maps.
REFINING = ("fit", "masks", "repair")
# Before fit and repair, in the place of "asset".
FIRST = {"first asset": "write the first asset"}
# Only where views were edited.
RETOUCH = {"retouch": "bake the edited views"}
# Only with --finish.
FINISH = {"finish": "finish the painting"}
# Only with --displace or --height-map.
DISPLACE = {"displace": "displace the mesh to the outlines", "height": "look up the painting's height"}
EVERY_STAGE = STAGES | RETOUCH | FINISH | DISPLACE
# Those of `mistyle stylize --preview`.
PREVIEW_STAGES = {name: STAGES[name] for name in ("mesh", "texels", "surface")} | {"preview": "draw the preview"}


@dataclass(frozen=True)
class Job:
    """One mesh, one style picture, settings and one run folder."""

    mesh: Path
    style: Path
    out: Path
    settings: Settings
    name: str
    redo_from: str | None = None
    overwrite: bool = False
