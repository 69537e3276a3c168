"""Parts of a report that every kind of job has: pictures of maps, settings, and the list of files."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import Maps, Texels
from mistyle.io.store.trusted_json import read_own
from mistyle.jobs.report.page import File, ReportPicture, Setting
from mistyle.jobs.report.pictures import in_bands


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures in a row at the height of the first, with a white gap between them."""
    from mistyle.core.image import resize

    height = pictures[0].shape[0]
    gap = np.ones((height, height // 32, 3), np.float32)
    row: list[np.ndarray] = []
    for picture in pictures:
        width = round(picture.shape[1] * height / picture.shape[0])
        row += [resize(picture, (height, width)), gap]
    return np.clip(np.concatenate(row[:-1], axis=1), 0, 1)


def heat(values: np.ndarray, most: float, texels: Texels, longest: int) -> np.ndarray:
    """Values of 0..most of every covered texel as colour (viridis), white elsewhere; at most `longest` pixels."""
    import cv2

    def rows(at: slice) -> np.ndarray:
        levels = np.clip(np.sqrt(values[at] / max(most, 1)) * 255, 0, 255).astype(np.uint8)
        colours = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1]
        return np.where(texels.covered[at, :, None], colours, np.uint8(255)).astype(np.uint8)

    return in_bands(values.shape[:2], rows, longest, sharp=True)


def mask_over(mask: np.ndarray, maps: Maps, texels: Texels, longest: int) -> np.ndarray:
    """The albedo with the masked texels in magenta, white outside the islands; at most `longest` pixels."""

    def rows(at: slice) -> np.ndarray:
        albedo = srgb_from_linear(maps.albedo[at])
        tinted = np.where(mask[at, :, None], 0.35 * albedo + 0.65 * np.array([1.0, 0.0, 0.8], np.float32), albedo)
        return np.where(texels.covered[at, :, None], tinted, 1.0).astype(np.float32)

    return in_bands(mask.shape[:2], rows, longest)


def map_shots(maps: Maps, longest: int) -> tuple[ReportPicture, ...]:
    """The maps of a texture set, as written beside the asset, at most `longest` pixels wide and high."""

    def small(make: Callable[[slice], np.ndarray]) -> np.ndarray:
        return in_bands(maps.roughness.shape[:2], make, longest)

    return (
        ReportPicture(small(lambda at: srgb_from_linear(maps.albedo[at])), "albedo", "sRGB"),
        ReportPicture(small(lambda at: maps.normal[at] * 0.5 + 0.5), "normal", "tangent space, +Y, MikkTSpace"),
        ReportPicture(small(lambda at: maps.roughness[at]), "roughness", "linear"),
        ReportPicture(small(lambda at: maps.metallic[at]), "metallic", "linear"),
    )


def setting_groups(settings: BaseModel) -> dict[str, tuple[Setting, ...]]:
    """Every setting with its meaning, by stage."""
    groups: dict[str, tuple[Setting, ...]] = {}
    alone: list[Setting] = []
    root = type(settings)
    default = root()
    for name in root.model_fields:
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            groups[name] = tuple(
                Setting(
                    k,
                    str(getattr(value, k)),
                    " ".join((f.description or "").split()),
                    getattr(value, k) != getattr(getattr(default, name), k),
                )
                for k, f in type(value).model_fields.items()
            )
        else:
            meaning = " ".join((root.model_fields[name].description or "").split())
            alone.append(Setting(name, str(value), meaning, value != getattr(default, name)))
    return {"job": tuple(alone)} | groups


def file_list(folder: Path, name: str) -> tuple[File, ...]:
    """The files of the asset as its own list names them."""
    listed = read_own(folder / f"{name}.json")["files"]
    return tuple(
        File(
            f"asset/{entry['file']}",
            entry["bytes"],
            entry["sha256"],
            entry.get("colour_space") or entry.get("what") or "",
        )
        for entry in listed
    )
