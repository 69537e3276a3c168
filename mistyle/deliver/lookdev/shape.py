"""The sheet's row of a displaced mesh: the mesh before and after as clay under the hard key light."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.errors import MistyleError
from mistyle.solver.shape.moved import displaced_asset

CLAY, ROUGH = 0.5, 0.9
ASIDE = 60.0  # degrees from the changed view to the second side


def reshaped(folder: Path) -> tuple[tuple[Asset, Asset], float] | None:
    """The mesh of a run folder before and after its displacement, and the azimuth of the first changed view; None
    where no vertex moved."""
    from mistyle.io.cameras.camera_files import read_cameras
    from mistyle.io.store.records import load_record

    places = [folder / "work" / stage / "record" for stage in ("mesh", "displace")]
    if not all(place.is_dir() for place in places):
        return None
    try:
        asset, shape = (load_record(place) for place in places)
        cameras = {c.name: c for c in read_cameras(folder / "stylized" / "camera.json")}
    except MistyleError:
        return None  # written by another version: the sheet omits it
    if not shape.changed:
        return None
    clay = replace(asset, materials=tuple(_clay(m) for m in asset.materials))
    azimuth = cameras[shape.views[0]].azimuth if shape.views[0] in cameras else float("nan")
    pair = clay, displaced_asset(clay, shape.result.positions)
    return pair, azimuth if np.isfinite(azimuth) else 0.0


def _clay(material: Any) -> Any:
    none = dict(albedo=None, normal=None, roughness=None, metallic=None, opacity=None, emission=None, specular=None)
    grey = np.full(3, CLAY, np.float32)
    return replace(material, **none, albedo_factor=grey, roughness_factor=ROUGH, metallic_factor=0.0)
