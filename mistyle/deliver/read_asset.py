"""Reader of a finished asset in a run folder, with edits of its textures."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.io.images.packing import TextureSet

SHARDS = "shards"  # the markers of a batch's jobs


@dataclass(frozen=True)
class FinishedAsset:
    """An asset folder of mistyle: the mesh, its texture sets, and the content of its list."""

    asset: Asset
    sets: tuple[TextureSet, ...]
    manifest: dict[str, Any]
    folder: Path


def read_finished(place: Path) -> FinishedAsset:
    """The asset of a run folder, an asset folder or a <name>.json. Raises InputRefused."""
    from mistyle.io.read_mesh import read_mesh

    folder, manifest = read_listing(place)
    stems = [(str(part["name"]), str(part["textures"])) for part in manifest["parts"]]
    name = str(manifest["name"])
    glb = folder / f"{name}.glb"
    if not glb.is_file():
        raise InputRefused(f"{glb}: found nothing, expected the asset that {name}.json lists")
    asset = read_mesh(glb, uv="keep")
    if len(asset.mesh.parts) != len(stems):
        raise InputRefused(
            f"{glb}: found {len(asset.mesh.parts)} texture sets, {name}.json lists {len(stems)}; run the job again"
        )
    scales = {e.get("file"): float(e["scale"]) for e in manifest["files"] if e.get("map") == "height"}
    sets = [_texture_set(folder / "textures", part, stem, scales) for part, stem in stems]
    return FinishedAsset(asset, tuple(sets), manifest, folder)


def read_listing(place: Path) -> tuple[Path, dict[str, Any]]:
    """The asset folder and its list of files. Raises InputRefused."""
    from mistyle.io.read import read_json

    listing = _listing(place)
    manifest = read_json(listing)
    try:
        stems = [str(part["textures"]) for part in manifest["parts"]]
        _ = [part["name"] for part in manifest["parts"]], manifest["files"]
        for name in (str(manifest["name"]), *stems):
            if name != Path(name).name:
                raise TypeError(f"{name[:80]!r} is not a file name")
    except (KeyError, TypeError) as error:
        raise InputRefused(
            f"{listing}: not the list of an asset of ours ({error}); export what mistyle wrote"
        ) from None
    return listing.parent, manifest


def jobs_of_batch(place: Path) -> list[Path] | None:
    """The run folders with an asset in a batch folder (batch/pipeline.py); None for any other place."""
    if not ((place / "plan.json").is_file() and (place / SHARDS).is_dir()):
        return None
    return [p for p in sorted(place.iterdir()) if (p / "asset").is_dir()]


def _listing(place: Path) -> Path:
    if place.suffix == ".json" and not place.is_dir():
        return place
    jobs = jobs_of_batch(place)
    if jobs is not None:
        way = f"one job's folder in it, for example {jobs[0]}" if jobs else "a folder of a finished job in it"
        raise InputRefused(f"{place}: found a batch folder with {len(jobs)} finished assets, expected {way}")
    for folder in (place / "asset", place):
        listings = [p for p in sorted(folder.glob("*.json")) if p.name != "done.json"] if folder.is_dir() else []
        if listings:
            return listings[0]
    raise InputRefused(
        f"{place}: found no asset; expected a run folder of mistyle, its asset folder, or its <name>.json"
    )


def _texture_set(folder: Path, part: str, stem: str, scales: Mapping[str, float]) -> TextureSet:
    from mistyle.io.read import read_exr, read_picture

    def planes(kind: str) -> Mapping[str, np.ndarray]:
        return read_exr(folder / f"{stem}_{kind}.exr")

    albedo, normal, roughness, orm = (planes(kind) for kind in ("albedo", "normal", "roughness", "orm"))
    scale = scales.get(f"textures/{stem}_height.png")
    tile = re.search(r"\.(1\d{3})$", part)
    rgb = np.stack([albedo[c] for c in "RGB"], axis=-1)
    # Other programs read the PNG, which may hold edits; where it differs, it replaces the EXR.
    shown = linear_from_srgb(read_picture(folder / f"{stem}_albedo.png").rgb)
    if shown.shape == rgb.shape and np.abs(shown - np.clip(rgb, 0, 1)).max() > 0.02:
        rgb = shown
    return TextureSet(
        name=stem,
        tile=int(tile[1]) if tile else 1001,
        albedo=rgb.astype(np.float32),
        normal=np.stack([normal[c] for c in "RGB"], axis=-1).astype(np.float32),
        roughness=roughness["Y"],
        metallic=orm["B"],
        occlusion=orm["R"],
        alpha=albedo.get("A"),
        height=None if scale is None else planes("height")["Y"],
        height_scale=scale or 1.0,
    )
