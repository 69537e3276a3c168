"""A job of `fit`: its inputs and settings, and the names of its stages."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mistyle.fitting.settings.material import MaterialSettings

MATERIAL_STAGES = {
    "mesh": "read the mesh",
    "texels": "rasterise the UVs",
    "cameras": "place the cameras",
    "photometry": "match the exposures",
    "exposures": "explain the exposures",
    "pictures": "check the pictures",
    "light": "solve for the light",
    "recover": "fit the material",
    "measure": "measure the fit",
    "asset": "write the asset",
    "scene": "write the Mitsuba scene",
    "report": "write the report",
}


@dataclass(frozen=True)
class MaterialJob:
    """A mesh and its references. `lights` and `masks` replace or complete those of the references' folder; "unknown"
    lights are estimated."""

    mesh: Path
    references: Path
    out: Path
    settings: MaterialSettings
    name: str
    lights: Path | Literal["unknown"] | None = None
    masks: Path | None = None
    exposure: Path | None = None
    pictures: Path | None = None
    albedo_of: Path | None = None
    redo_from: str | None = None
    overwrite: bool = False
