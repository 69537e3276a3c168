"""What the stages of a job hand on to one another."""

from dataclasses import dataclass

import numpy as np

from mistyle.core.maps import Maps, Texels
from mistyle.core.view import View


@dataclass(frozen=True)
class Atlas:
    """Per texture set: where each texel lies and the material that the asset brought along."""

    texels: tuple[Texels, ...]
    start: tuple[Maps, ...]


@dataclass(frozen=True)
class Baked:
    """Per texture set: the maps with the painted albedo, and by how many views each texel is seen.

    `begin` are the same maps with the painting's relief, where the fit starts at them (else empty); `gains` are the
    factors, per stylized view, that took the painted light out of it, where the stylizer paints lit objects, and
    `taken` the share of the known shading that this was.
    """

    maps: tuple[Maps, ...]
    seen: tuple[np.ndarray, ...]
    begin: tuple[Maps, ...] = ()
    gains: tuple[np.ndarray, ...] = ()
    taken: float | None = None


@dataclass(frozen=True)
class Retouched:
    """The painted texture and the views after a person's edits of the views were laid into both."""

    baked: Baked
    views: tuple[View, ...]


@dataclass(frozen=True)
class Repaired:
    """Per texture set: the final maps and which texels were repaired."""

    maps: tuple[Maps, ...]
    mask: tuple[np.ndarray, ...]
