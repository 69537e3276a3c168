"""Input colour management: pictures in the colour spaces of the settings, converted to the working spaces."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Picture
from mistyle.core.capture import Captures, Loaded
from mistyle.core.image import srgb_from_linear
from mistyle.core.light import Environment, Lights
from mistyle.jobs.deliver_settings import ColourSettings

LIGHT = (".exr", ".hdr")


def light_space(colour: ColourSettings) -> Any:
    """The ColourSpace of EXR and HDR files, None where it is linear Rec.709."""
    from mistyle.io.images.ocio import colour_space

    return None if colour.space is None else colour_space(colour.space, colour.config)


def picture_space(colour: ColourSettings) -> Any:
    """The ColourSpace of encoded pictures; None: their profiles, else sRGB."""
    from mistyle.io.images.ocio import colour_space

    return None if colour.pictures is None else colour_space(colour.pictures, colour.config, linear=False)


def key_of(colour: ColourSettings) -> list[Any]:
    """The part of a stage's key: the names of the spaces, and the config (by content if it is a file)."""
    named = colour.space or colour.pictures
    config = Path(colour.config) if named and colour.config and "://" not in colour.config else colour.config
    return [colour.space, colour.pictures, config if named else None]


def read_style(path: Path, colour: ColourSettings) -> Picture:
    """A style picture in any space, converted to sRGB-encoded Rec.709.

    An .exr or .hdr is linear light in `colour.space` (default linear Rec.709): it is clipped to 0..1 without a tone
    curve, with a note. Any other picture is in `colour.pictures` where that is set, whatever its profile.
    """
    from mistyle.io.read import read_picture

    if Path(path).suffix.lower() in LIGHT:
        return _style_of_light(Path(path), colour)
    picture, space = read_picture(path), picture_space(colour)
    if space is None:
        return picture
    note = f"Colours were converted from '{space.name}' to sRGB."
    return replace(picture, rgb=srgb_from_linear(space.to_working(picture.rgb)), notes=(*picture.notes, note))


def _style_of_light(path: Path, colour: ColourSettings) -> Picture:
    from mistyle.io.read import read_frame
    from mistyle.io.sandbox.bounds import refuse

    frame = read_frame(path)
    beauty, alpha = frame.layer("beauty"), frame.layer("alpha")
    if beauty is None:
        raise refuse(path, "no R, G and B", "a picture", "Write its colours as R, G, B")
    rgb = beauty.values()
    cover = None if alpha is None else np.clip(alpha.values()[..., 0], 0, 1)
    if cover is not None:
        rgb = rgb / np.maximum(cover, 1e-6)[..., None]
    space = light_space(colour)
    rgb = np.nan_to_num(rgb if space is None else space.to_working(rgb), nan=0.0, posinf=1.0, neginf=0.0)
    name = "linear Rec.709" if space is None else f"'{space.name}'"
    note = f"Light was converted from {name} to sRGB and clipped at 1."
    opaque = cover is None or bool((cover >= 1).all())
    return Picture(srgb_from_linear(rgb), None if opaque else cover, path, (note,))


def in_working_space(captures: Captures, shots: Sequence[Any], colour: ColourSettings) -> Captures:
    """The captures with pictures and environment maps in linear Rec.709; `shots` are the captures' files."""
    light, encoded = light_space(colour), picture_space(colour)
    if light is None and encoded is None:
        return captures

    def load(k: int) -> Loaded:
        rgb, counts = captures.load(k)
        if shots[k].picture.suffix.lower() in LIGHT:
            return (rgb if light is None else light.to_working(rgb)), counts
        if encoded is None:
            return rgb, counts
        # The reader decoded the file as sRGB: restore its values and decode them by their own curve.
        stored = srgb_from_linear(rgb * np.float32(shots[k].factor))
        return encoded.to_working(stored) / np.float32(shots[k].factor), counts

    lights = captures.lights if light is None else _converted(captures.lights, light)
    return Captures(captures.cameras, lights, load)


def _converted(rigs: Sequence[Lights], space: Any) -> tuple[Lights, ...]:
    """The rigs with environment maps of EXR and HDR files converted to linear Rec.709, each once."""
    done: dict[int, Environment] = {}

    def convert(light: Any) -> Any:
        if not isinstance(light, Environment) or Path(light.file or "").suffix.lower() not in LIGHT:
            return light
        if id(light) not in done:
            radiance = np.maximum(space.to_working(light.radiance), 0).astype(np.float32)
            done[id(light)] = replace(light, radiance=radiance)
        return done[id(light)]

    return tuple(tuple(convert(x) for x in rig) for rig in rigs)
