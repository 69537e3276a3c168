"""The published data sets, for whoever has them: fit to the training pictures, relight, compare with the held-out ones.

Stanford-ORB (`--stanford-orb FOLDER`, with blender_HDR and ground_truth; its scanned mesh): fitted to a scene's
training pictures under the environment of its first test picture, relit with the environments of the novel pictures.
PSNR-H and PSNR-L as its own code has them: pictures at a quarter of their size, mask eroded, brightness aligned per
channel, mean over the whole picture. The row to beat with known light: 26.6 / 34.2 dB.

TensoIR-Synthetic (`--tensoir FOLDER --mesh FILE --environments FOLDER`; its meshes are not part of it): fitted to the
training pictures under "sunset", relit with the five other lights from the test cameras. PSNR-L as its tables have it:
sRGB, whole picture, brightness aligned per channel.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.material_recovery.dataset_readers import TENSOIR_LIGHTS, read_stanford_orb, read_tensoir
from benchmarks.material_recovery.metrics import align_channels, orb_mask, psnr_hdr, psnr_ldr
from benchmarks.material_recovery.pictures import Shot, render
from benchmarks.material_recovery.truth import fitted_size
from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Asset
from mistyle.core.capture import Captures, shrunk, subset
from mistyle.core.errors import InputRefused
from mistyle.core.maps import Maps
from mistyle.geometry.similarity import moved
from mistyle.io.read_mesh import read_mesh
from mistyle.render.mitsuba.scene import Frame
from mistyle.solver.recover import recover
from mistyle.solver.settings import RecoverSettings

QUARTER = 4  # Stanford-ORB is scored at a quarter of its size
Figures = dict[str, float]


def stanford_orb(
    root: Path, *, frame: Frame, spp: int, scenes: Sequence[str] | None = None, limit: int | None = None
) -> Figures:
    """`<scene>.relight_psnr_h`, `.relight_psnr_l` of every scene in the folder, and their means under "stanford_orb".

    `limit` bounds the pictures that are relit per scene.
    """
    home = root / "blender_HDR"
    names = list(scenes or sorted(p.name for p in home.glob("*") if (p / "transforms_novel.json").is_file()))
    if not names:
        raise InputRefused(f"{home}: no scene with a transforms_novel.json; expected Stanford-ORB as it is unpacked.")
    figures: Figures = {}
    for name in names:
        train = read_stanford_orb(root, name, "train")
        if train.mesh is None:
            raise InputRefused(f"{root}: scene {name} has no mesh; expected ground_truth/{name}/mesh_blender/mesh.obj.")
        if not train.captures.lights[0]:
            raise InputRefused(f"{root}: scene {name} has no ground_truth/{name}/env_map; unpack the ground truth too.")
        asset = read_mesh(train.mesh, uv="auto")
        maps = fit(asset, quartered(train.captures), frame)
        novel = quartered(read_stanford_orb(root, name, "novel").captures)
        found = compare(asset, maps, _first(novel, limit), frame, spp, _orb)
        figures |= {f"{name}.relight_psnr_h": found[0], f"{name}.relight_psnr_l": found[1]}
    return figures | _means(figures, "stanford_orb")


def quartered(captures: Captures) -> Captures:
    return shrunk(captures, [QUARTER] * len(captures))


def tensoir(
    folder: Path, mesh: Path, environments: Path, *, frame: Frame, spp: int, limit: int | None = None
) -> Figures:
    """`<scene>.relight_psnr_l` under each light, and the scene's mean."""
    train = read_tensoir(folder, "train", light="sunset", maps=environments)
    asset = read_mesh(mesh, uv="auto")
    maps = fit(asset, train.captures, frame)
    figures: Figures = {}
    for light in TENSOIR_LIGHTS:
        test = read_tensoir(folder, "test", light=light, maps=environments).captures
        found = compare(asset, maps, _first(test, limit), frame, spp, _tensoir)
        figures[f"{folder.name}_{light}.relight_psnr_l"] = found[1]
    return figures | _means(figures, folder.name)


def fit(asset: Asset, captures: Captures, frame: Frame) -> Sequence[Maps]:
    """Our fit in the working space, the atlas matched to the first camera's pixels at the object's middle."""
    here = moved(captures, asset.source.work_from_user)
    camera = here.cameras[0]
    pixel = float(np.linalg.norm(camera.position)) / camera.focal
    mesh = asset.mesh
    texels = [rasterise(mesh, p, fitted_size(mesh, p, pixel)) for p in range(len(mesh.parts))]
    return recover(mesh, texels, here, RecoverSettings(metallic=True, frame=frame), seed=0).maps


def compare(
    asset: Asset,
    maps: Sequence[Maps],
    captures: Captures,
    frame: Frame,
    spp: int,
    judge: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[float, float]],
) -> tuple[float, float]:
    """Mean PSNR-H and PSNR-L of the maps, rendered as the held-out pictures were taken."""
    here = moved(captures, asset.source.work_from_user)
    found = []
    for k, (camera, lights) in enumerate(zip(here.cameras, here.lights, strict=True)):
        if not lights:
            raise InputRefused(f"picture '{camera.name}' has no environment map; the held-out pictures need theirs.")
        reference, counts = here.load(k)
        shown = render(asset.mesh, maps, [Shot(camera, lights)], frame=frame, spp=spp)[0][..., :3]
        found.append(judge(reference, shown, counts))
    return tuple(np.mean(found, axis=0).tolist())


def _orb(reference: np.ndarray, shown: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    mask = orb_mask(counts.astype(np.float32))
    aligned = align_channels(reference, shown, mask)
    return psnr_hdr(reference, aligned, mask, whole=True), psnr_ldr(reference, aligned, mask, whole=True)


def _tensoir(reference: np.ndarray, shown: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    aligned = align_channels(reference, shown, counts)
    return psnr_hdr(reference, aligned, counts, whole=True), psnr_ldr(reference, aligned, counts, whole=True)


def _first(captures: Captures, limit: int | None) -> Captures:
    return captures if limit is None else subset(captures, range(min(limit, len(captures))))


def _means(figures: Figures, name: str) -> Figures:
    result: Figures = {}
    for key in ("relight_psnr_h", "relight_psnr_l"):
        values = [v for k, v in figures.items() if k.endswith(key)]
        if values:
            result[f"{name}.{key}"] = float(np.mean(values))
    return result
