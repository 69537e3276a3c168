"""Records that the stages of a stylization job exchange."""

from dataclasses import dataclass

import numpy as np

from mistyle.core.maps import Maps, Texels
from mistyle.core.view import View


@dataclass(frozen=True)
class Atlas:
    """Per texture set: the texels' surface points and the asset's own material."""

    texels: tuple[Texels, ...]
    start: tuple[Maps, ...]


@dataclass(frozen=True)
class Baked:
    """Per texture set: the maps with the painted albedo, and by how many views each texel is seen.

    `begin` are the same maps with the painting's relief, if the fit starts from them, else empty. For a stylizer that
    paints lit objects, `gains` are the factors per stylized view that removed the painted light; `taken` is the removed
    share of the known shading.
    """

    maps: tuple[Maps, ...]
    seen: tuple[np.ndarray, ...]
    begin: tuple[Maps, ...] = ()
    gains: tuple[np.ndarray, ...] = ()
    taken: float | None = None


@dataclass(frozen=True)
class Retouched:
    """The painted texture and the views, both with the user's edits of the views."""

    baked: Baked
    views: tuple[View, ...]


@dataclass(frozen=True)
class Repaired:
    """Per texture set: the final maps and the mask of repaired texels."""

    maps: tuple[Maps, ...]
    mask: tuple[np.ndarray, ...]
