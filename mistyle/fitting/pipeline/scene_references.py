"""The reference pictures of a scene fit: the file of each sensor, and its channels."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import linear_from_srgb

PICTURES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".webp")
# Linear Rec.709 from CIE XYZ (IEC 61966-2-1), as Mitsuba converts.
RGB_FROM_XYZ = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)

Planes = Mapping[str, Float[np.ndarray, "h w"]]


def reference_files(folder: Path, names: Sequence[str], sensors: int, numbers: Sequence[int]) -> list[Path]:
    """The picture of each sensor: the file named after its id, else the pictures in order if the counts match."""
    if not folder.is_dir():
        raise InputRefused(f"{folder}: found no folder, expected one with a picture for each sensor; check the path")
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)
    by_name = {p.stem: p for p in reversed(files)}
    if all(name in by_name for name in names):
        return [by_name[name] for name in names]
    if len(files) == sensors:
        return [files[k] for k in numbers]
    if len(files) == len(names):
        return files
    raise InputRefused(
        f"{folder}: found {len(files)} pictures for {len(names)} sensor(s) ({', '.join(names[:4])}, ...); expected one "
        "named after each sensor's id, or as many as sensors, in their order"
    )


def read_reference(
    path: Path, channels: str = ""
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"], tuple[str, ...]]:
    """Linear radiance, the mask of valid pixels (finite, and in encoded pictures not saturated), and notes.

    `channels` selects channels of an EXR: a prefix ("image" for image.R, …) or three names with commas.
    """
    from mistyle.io.read import read_exr, read_picture

    if path.suffix.lower() == ".exr":
        planes = read_exr(path, colours=True)
        names, notes = choose_channels(path, planes, channels)
        rgb = np.stack([planes[c] for c in names], axis=-1)
        if names[0].rpartition(".")[2] == "X":
            rgb = (rgb @ RGB_FROM_XYZ.T).astype(np.float32)
        valid = np.asarray(np.isfinite(rgb).all(axis=-1))
        return np.where(valid[..., None], rgb, 0).astype(np.float32), valid, notes
    if channels:
        raise UsageError(f"{path}: --channels {channels} belongs to EXR references; leave it out for this picture")
    picture = read_picture(path)
    valid = np.asarray((picture.rgb < 1).all(axis=-1))
    saturated = 1 - float(valid.mean())
    notes = (f"{path.name}: {saturated:.1%} of its pixels are saturated and do not count.",) if saturated else ()
    return linear_from_srgb(picture.rgb).astype(np.float32), valid, notes


def choose_channels(path: Path, planes: Planes, requested: str = "") -> tuple[tuple[str, str, str], tuple[str, ...]]:
    """Three channels of an EXR, and a note where they were guessed. InputRefused where none match.

    Default: R, G, B; else the only group `<prefix>.R, .G, .B` that is not a second moment (`m2_…`, Mitsuba's `moment`
    integrator), else the only group X, Y, Z of a `moment` integrator.
    """
    if requested.count(",") == 2:
        first, second, third = (n.strip() for n in requested.split(","))
        if {first, second, third} <= set(planes):
            return (first, second, third), ()
        raise InputRefused(f"{path}: found channels {_shown(planes)}; expected {requested}. Choose three of those.")
    if requested:
        for letters in ("RGB", "XYZ"):
            red, green, blue = (f"{requested.rstrip('.')}.{c}" for c in letters)
            if {red, green, blue} <= set(planes):
                return (red, green, blue), ()
        raise InputRefused(
            f"{path}: found channels {_shown(planes)}; expected {requested}.R, .G and .B. Choose a prefix of those, or "
            "three names with commas, with --channels."
        )
    if {"R", "G", "B"} <= set(planes):
        return ("R", "G", "B"), ()
    second = {n for n in planes if n.rpartition("/")[2].startswith("m2_")}
    groups = [_groups(planes, "RGB", second)]
    # X, Y and Z are often a position or a normal; in a file with second moments they are a colour.
    groups += [_groups(planes, "XYZ", second)] if second else []
    for letters, prefixes in zip(("RGB", "XYZ"), groups, strict=False):
        if len(prefixes) == 1:
            red, green, blue = (f"{prefixes[0]}.{c}" for c in letters)
            return (red, green, blue), (f"{path.name}: the channels {prefixes[0]}.{letters} are used as the picture.",)
    raise InputRefused(
        f"{path}: found channels {_shown(planes)}; expected R, G and B, or one group of them. Name the group with "
        "--channels PREFIX, or three channels with commas."
    )


def _groups(planes: Planes, letters: str, without: set[str]) -> list[str]:
    stems = dict.fromkeys(n.rpartition(".")[0] for n in planes if "." in n and n not in without)
    return [stem for stem in stems if {f"{stem}.{c}" for c in letters} <= set(planes)]


def _shown(planes: Planes) -> str:
    return ", ".join(sorted(planes))[:300]
