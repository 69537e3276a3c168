"""Settings that every kind of job has: delivery to other programs, and the colour spaces of inputs and outputs."""

import re
import string
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mistyle.core.settings import FrozenModel

FORMATS = ("glb", "usd", "mtlx", "obj", "maps")
TEXTURES = "{asset}_{map}.{ext}"
NAME_FIELDS = frozenset({"asset", "mesh", "style", "target", "v"})
TEXTURE_FIELDS = frozenset({"asset", "map", "ext", "udim"})


def listed(value: Any) -> Any:
    """'glb,usd' and ['glb,usd', 'maps'] as a tuple of names, each once; anything else unchanged."""
    if isinstance(value, str):
        value = [value]
    if isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value):
        return tuple(dict.fromkeys(word.strip() for v in value for word in v.split(",") if word.strip()))
    return value


def fields_of(pattern: str) -> dict[str, str]:
    """The plain {fields} of a pattern and their format specifications. ValueError for conversions and other formats."""
    fields: dict[str, str] = {}
    for _, name, spec, conversion in string.Formatter().parse(pattern):
        if name is None:
            continue
        if not re.fullmatch(r"[a-z]+", name) or conversion or not re.fullmatch(r"|0?[1-9]d?", spec or ""):
            raise ValueError(f"'{{{name}}}' is not a plain field such as {{v}} or {{v:03}}")
        fields[name] = spec or ""
    return fields


def _tried(pattern: str) -> set[str] | None:
    try:
        return set(fields_of(pattern))
    except ValueError:
        return None


def checked_name(pattern: str) -> str:
    """A pattern for delivered names: {asset} {mesh} {style} {target} {v}, no folders."""
    fields = _tried(pattern)
    if fields is None or fields - NAME_FIELDS or not pattern or "/" in pattern or "\\" in pattern:
        offered = ", ".join(f"{{{f}}}" for f in sorted(NAME_FIELDS))
        raise ValueError(f"--name {pattern!r}: expected a file name, in which {offered} are filled in")
    return pattern


def checked_textures(pattern: str) -> str:
    """A pattern for texture files: {map} and {ext}, and maybe {asset} and {udim}."""
    fields = _tried(pattern)
    if fields is None or not {"map", "ext"} <= fields or fields - TEXTURE_FIELDS or "/" in pattern or "\\" in pattern:
        expected = "a file name with {map} and {ext}, and maybe {asset}, {udim}"
        raise ValueError(f"--texture-name {pattern!r}: expected {expected}")
    return pattern


Format = Literal["glb", "usd", "mtlx", "obj", "maps"]
Program = Literal["blender", "unreal", "unity-urp", "unity-hdrp", "houdini", "arnold"]


class DeliverSettings(FrozenModel):
    """The files for other programs in OUT/delivered/<target>; none while all fields keep their defaults."""

    formats: Annotated[tuple[Format, ...], BeforeValidator(listed)] = ()
    """glb, usd, mtlx, obj, maps (maps and glb where only a target is named)"""
    target: Annotated[tuple[Program, ...], BeforeValidator(listed)] = ()
    """the programs that textures are packed for (blender where only formats are named)"""
    name: Annotated[str, BeforeValidator(checked_name)] = "{asset}"
    """pattern of the delivered name: {asset} {mesh} {style} {target}; {v:03} counts up, so that no earlier delivery is
    overwritten"""
    textures: Annotated[str, BeforeValidator(checked_textures)] = TEXTURES
    """pattern of texture files: {asset} {map} {udim} {ext}"""
    metres_per_unit: float = Field(default=1.0, gt=0)
    """metresPerUnit of USD"""

    @property
    def wanted(self) -> bool:
        """Whether anything is delivered: formats, a target or a name pattern is set."""
        return bool(self.formats or self.target or self.name != "{asset}" or self.textures != TEXTURES)

    @property
    def chosen_formats(self) -> tuple[Format, ...]:
        return self.formats or ("maps", "glb")

    @property
    def chosen_targets(self) -> tuple[Program, ...]:
        return self.target or ("blender",)


class ColourSettings(FrozenModel):
    """Colour spaces of inputs and outputs, by their OpenColorIO names; all computation is in linear Rec.709."""

    space: str | None = None
    """scene-linear space of EXR and HDR pictures in and of delivered EXR textures (linear Rec.709)"""
    pictures: str | None = None
    """space of PNG, JPEG, TIFF pictures in (their profile, else sRGB)"""
    config: str | None = None
    """the OpenColorIO config ($OCIO, else the one inside opencolorio)"""
