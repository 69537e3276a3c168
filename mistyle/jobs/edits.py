"""Edits of a run folder: the files that a person may change, and how the next run uses them.

    stylized/<view>.png (.exr, or a .jpg, .webp, .tif beside it)   a view painted over
    masks/<set>.png                                                the texels that are painted again after the fit
    asset/textures/<set>_<map>.png or .exr                         a finished map

The sha256 detects an edit. The edited file stays unchanged; the stages that depend on it run again. No other file may
be edited: a finished stage with another changed file is set aside and runs again.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.core.maps import Maps
from mistyle.io.store.atomic import DONE, sha256_file
from mistyle.io.store.trusted_json import read_own

# Stage -> names of its files that a person may edit.
EDITABLE = {
    "stylized": re.compile(r"[^/]+\.(png|exr|jpe?g|webp|tiff?)"),
    "masks": re.compile(r"[^/]+\.png"),
    "asset": re.compile(r"textures/[^/]+(?<!_height)\.(png|exr)"),
}
# Stage -> the consequence of an edit, for the note to the user.
REDONE = {
    "stylized": "new paint is baked into the texture; fit, repair, asset and report are redone",
    "masks": "repair, asset and report are redone",
    "asset": "the asset and the report are redone",
}


def editable(stage: str, name: str) -> bool:
    """Whether a person may edit this file of a stage."""
    pattern = EDITABLE.get(stage)
    return pattern is not None and pattern.fullmatch(name) is not None


def edits_of(folder: Path, stage: str) -> tuple[dict[str, str], dict[str, str]]:
    """A person's edits of a finished stage's folder, name to sha256: (taken up by an earlier run, changed since).

    A file counts as changed if it differs from the stage's own, or was added with the stem of a stage's file.
    """
    try:
        done = read_own(folder / DONE)
        taken_up, written = dict(done.get("edited", {})), dict(done["files"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}, {}
    stems = {name.rpartition(".")[0] for name in written}
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    ours = [name for name in names if editable(stage, name) and name.rpartition(".")[0] in stems]
    hashes = {name: sha256_file(folder / name) for name in ours}
    return taken_up, {name: value for name, value in hashes.items() if written.get(name) != value}


def sentence(stage: str, names: Sequence[str], new: bool) -> str:
    """The note about a stage's edited files; `new` where no earlier run had taken them up."""
    files = ", ".join(f"{stage}/{name}" for name in names)
    return f"{files} {'was' if len(names) == 1 else 'were'} edited: {REDONE[stage] if new else 'kept'}."


@dataclass(frozen=True)
class Edited:
    """A person's edits of `folder`/textures: names that an earlier run took up, and those that changed since."""

    folder: Path | None = None
    taken_up: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()

    @property
    def provenance(self) -> dict[str, list[str]]:
        """The entry of the asset's provenance."""
        names = sorted({*self.taken_up, *self.changed})
        return {"edited": names} if names else {}

    def __call__(
        self, stems: Sequence[str], maps: Sequence[Maps], occlusion: Sequence[np.ndarray] | None = None
    ) -> tuple[list[Maps], list[np.ndarray]]:
        """The maps and occlusions of all texture sets with the edits applied."""
        edited_sets = list(maps)
        shade = [np.ones_like(m.roughness) for m in maps] if occlusion is None else list(occlusion)
        if self.folder is not None:
            for part, stem in enumerate(stems):
                arguments = (self.folder, stem, edited_sets[part], shade[part], self.taken_up, self.changed)
                edited_sets[part], shade[part] = edited_maps(*arguments)
        return edited_sets, shade


UNEDITED = Edited()


def asset_stage(
    run: Any,
    after: Sequence[str],
    write: Callable[[Path, Edited, Callable[[float], None]], object],
    about: Mapping[str, Any] | None = None,
) -> tuple[Path, Edited]:
    """The stage 'asset': its folder, and a person's edits of it.

    `write(folder, edited, report)` writes the asset. If its textures were edited since, it is written again with them:
    the GLB and the other file of each map change. `about` holds further entries of the stage's marker.
    """
    about = about or {}
    folder = run.stage("asset", after, [run.job.name], lambda f, r: write(f, UNEDITED, r), about)
    every, changed = run.edited.get("asset", {}), tuple(run.changed.get("asset", {}))
    if not every:
        return folder, UNEDITED
    if changed:
        edited = Edited(folder, tuple(name for name in every if name not in changed), changed)
        run.absorb("asset", lambda f, r: write(f, edited, r), about)
    return folder, Edited(folder, tuple(every))


def tell_edits(run: Any) -> None:
    """Note the files of the run folder that a person edited, and the consequence."""
    # The first stage that depends on an edited one; an asset depends on itself.
    next_one = {"stylized": "retouch", "masks": "repair", "asset": "asset"}
    for stage, files in run.edited.items():
        run.progress.note(sentence(stage, sorted(files), next_one[stage] not in run.progress.reused))


def write_mask(path: Path, mask: np.ndarray) -> None:
    """A mask (h w) as an 8-bit PNG: white where it holds."""
    from mistyle.io.images.write import write_png

    write_png(path, mask.astype(np.float32))


def read_mask(path: Path, like: np.ndarray) -> np.ndarray:
    """A mask back from its picture: light texels hold. InputRefused for another size than that of `like`."""
    from mistyle.io.read import read_picture

    light = read_picture(path).rgb.mean(axis=-1) > 0.5
    _same_size(path, light.shape, like.shape)
    return light


def edited_maps(
    folder: Path, stem: str, maps: Maps, occlusion: np.ndarray, taken_up: Sequence[str], changed: Sequence[str]
) -> tuple[Maps, np.ndarray]:
    """The maps and occlusion of one texture set with a person's edits in `folder`/textures.

    `taken_up` names files whose content an earlier run took up, `changed` those that changed since and win. Where both
    the .png and the .exr of a map changed, the .exr counts.
    """
    for names, endings in ((taken_up, (".exr",)), (changed, (".png", ".exr"))):
        kinds = [k for k in ("albedo", "normal", "orm", "roughness") if _has_edit(names, stem, k)]
        for kind in kinds:
            files = [f"textures/{stem}_{kind}{e}" for e in endings]
            # Both files hold the edits of earlier runs; the .exr has the higher precision.
            file = next(name for name in reversed(files) if name in names or names is taken_up)
            maps, occlusion = _apply_edit(maps, occlusion, kind, folder / file)
    return maps, occlusion


def _has_edit(names: Sequence[str], stem: str, kind: str) -> bool:
    return any(f"textures/{stem}_{kind}.{ending}" in names for ending in ("png", "exr"))


def _apply_edit(maps: Maps, occlusion: np.ndarray, kind: str, path: Path) -> tuple[Maps, np.ndarray]:
    from mistyle.io.read import read_exr, read_picture

    if path.suffix == ".exr":
        planes = read_exr(path)
        channels: Mapping[str, str] = {"roughness": "Y"}
        if any(c not in planes for c in channels.get(kind, "RGB")):
            present = ", ".join(planes)
            raise InputRefused(f"{path}: found channels {present}, expected {', '.join(channels.get(kind, 'RGB'))}.")
        values = np.stack([planes[c] for c in (channels.get(kind, "RGB") * 3)[:3]], axis=-1)
    else:
        values = read_picture(path).rgb
        values = linear_from_srgb(values) if kind == "albedo" else values
    _same_size(path, values.shape[:2], maps.roughness.shape)
    if not np.isfinite(values).all():
        raise InputRefused(f"{path}: found values that are not finite. Paint it again.")
    values = values.astype(np.float32)
    if kind == "albedo":
        return replace(maps, albedo=values), occlusion
    if kind == "normal":
        normal = values * 2 - 1
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        up = np.array([0, 0, 1], np.float32)
        return replace(maps, normal=np.where(length > 1e-3, normal / np.maximum(length, 1e-3), up)), occlusion
    values = np.clip(values, 0, 1)
    if kind == "roughness":
        return replace(maps, roughness=np.ascontiguousarray(values[..., 0])), occlusion
    parts = {"roughness": np.ascontiguousarray(values[..., 1]), "metallic": np.ascontiguousarray(values[..., 2])}
    return replace(maps, **parts), np.ascontiguousarray(values[..., 0])


def _same_size(path: Path, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if tuple(found[:2]) != tuple(expected[:2]):
        raise InputRefused(
            f"{path}: found {found[1]} x {found[0]} pixels, expected {expected[1]} x {expected[0]} as it was written. "
            "Save it in that size, or delete it to have it written again."
        )
