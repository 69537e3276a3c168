"""Limits on the metrics of a comparison, from the command line and from compare.toml, for all images or some."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from mistyle.core.errors import InputRefused, UsageError

Side = Literal["max", "min"]
EXPECTED = """expected tables of limits, as
  [limits.max]
  flip = 0.05
  [images."shot_01*".min]
  psnr = 38
  [layers.normal.max]
  angle = 0.5"""


@dataclass(frozen=True)
class Limit:
    """An upper (`max`) or lower (`min`) bound on `metric`, for images and layers that match the patterns."""

    metric: str
    side: Side
    value: float
    image: str = "*"
    layer: str = "*"

    def holds(self, value: float) -> bool:
        """Whether a value keeps the limit; NaN never does."""
        return value <= self.value if self.side == "max" else value >= self.value


def parse(text: str, side: Side, known: Sequence[str]) -> Limit:
    """`flip=0.05` as a limit; UsageError lists the known metrics."""
    name, equals, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not equals or math.isnan(number):
        raise UsageError(f"--{side} {text}: expected METRIC=NUMBER, for example --{side} flip=0.05")
    return Limit(checked(name.strip(), known, f"--{side} {text}"), side, number)


def checked(name: str, known: Sequence[str], where: str) -> str:
    if name not in known:
        raise UsageError(f"{where}: {name!r} is not measured; expected one of {', '.join(known)}")
    return name


def read_limits(path: Path, known: Sequence[str]) -> tuple[list[Limit], list[Limit]]:
    """A compare.toml: the limits for all images, and those for some images or layers, in the file's order."""
    from mistyle.io.read import read_toml

    try:
        data = read_toml(path)
    except InputRefused as error:
        raise InputRefused(f"{path}: found no readable TOML ({error}); {EXPECTED}") from error
    strange = sorted(set(data) - {"limits", "images", "layers"})
    if strange:
        raise InputRefused(f"{path}: found {strange[0]!r}; {EXPECTED}")
    some: list[Limit] = []
    for pattern, table in _table(data.get("layers", {}), path, "layers").items():
        some += _limits(table, path, f"layers.{pattern}", known, layer=pattern)
    for pattern, table in _table(data.get("images", {}), path, "images").items():
        some += _limits(table, path, f"images.{pattern}", known, image=pattern)
    return _limits(data.get("limits", {}), path, "limits", known), some


def _table(value: Any, path: Path, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputRefused(f"{path}: found {value!r} at {where}; {EXPECTED}")
    return value


def _limits(table: Any, path: Path, where: str, known: Sequence[str], **patterns: str) -> list[Limit]:
    parsed: list[Limit] = []
    for side, values in _table(table, path, where).items():
        if side not in ("max", "min"):
            raise InputRefused(f"{path}: found {side!r} at {where}; {EXPECTED}")
        for name, value in _table(values, path, f"{where}.{side}").items():
            if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
                raise InputRefused(f"{path}: found {value!r} at {where}.{side}.{name}; expected a number")
            checked(name, known, f"{path}: {where}.{side}")
            parsed.append(Limit(name, "max" if side == "max" else "min", float(value), **patterns))
    return parsed


def broken(limits: Sequence[Limit], image: str, layer: str, values: Mapping[str, float]) -> list[str]:
    """Messages about the limits that an image's layer exceeds; the last matching limit per metric and side counts.

    Limits on metrics that the layer does not have are ignored.
    """
    chosen: dict[tuple[str, str], Limit] = {}
    for limit in limits:
        if fnmatchcase(image, limit.image) and fnmatchcase(layer, limit.layer):
            chosen[limit.metric, limit.side] = limit
    result = []
    for limit in chosen.values():
        if limit.metric in values and not limit.holds(values[limit.metric]):
            direction = "above" if limit.side == "max" else "below"
            value = values[limit.metric]
            text = "could not be measured" if math.isnan(value) else f"is {value:.5g}, {direction} {limit.value:g}"
            result.append(f"{limit.metric} {text}")
    return result


def without_effect(limits: Sequence[Limit], rows: Sequence[tuple[str, str, Mapping[str, float]]]) -> list[str]:
    """Messages about limits that match no row, which are probably misspelt."""
    result = []
    for limit in limits:
        met = any(
            fnmatchcase(image, limit.image) and fnmatchcase(layer, limit.layer) and limit.metric in values
            for image, layer, values in rows
        )
        if not met:
            where = f" of images {limit.image!r}, layers {limit.layer!r}"
            result.append(f"the limit {limit.side} {limit.metric}={limit.value:g}{where} matched nothing")
    return result
