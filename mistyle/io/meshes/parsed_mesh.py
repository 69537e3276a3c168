"""Parsed mesh files, before `prepare` chooses UVs, normals and axes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import Primitive, Shading
from mistyle.core.errors import InputRefused
from mistyle.core.mesh import SpreadPoints
from mistyle.geometry.retexture import REPEAT, Wraps
from mistyle.io.images.quantisation import Kind, finished
from mistyle.io.sandbox.bounds import WORK_TEXTURE


@dataclass(frozen=True)
class RawMap:
    """One texture: values as `Material` has them (row 0 is v = 1) and their lookup. With a `kind` the values are still
    the file's own numbers, which io/images/quantisation.py converts (normals with x and y times `scale`).

    The lookup is at `uvs` where the map uses another UV set than the material's base, else at the mesh's UVs. Then
    `transform` (v up, homogeneous rows) is applied to it, and `wrap` sets the values outside the unit square.
    `tangents` is the frame of a normal map's normals: that of the UVs as authored, before the transform, or that of the
    lookup coordinates.
    """

    values: np.ndarray
    uvs: Float[np.ndarray, "f 3 2"] | None = None
    transform: Float[np.ndarray, "3 3"] | None = None
    kind: Kind | None = None
    scale: float = 1.0
    wrap: Wraps = REPEAT
    tangents: Literal["authored", "looked up"] = "authored"

    def finished(self) -> "RawMap":
        """The map with values as `Material` has them."""
        if self.kind is None:
            return self
        values = finished(self.values, self.kind, self.scale, WORK_TEXTURE)
        return replace(self, values=values, kind=None)


Maps = Mapping[str, RawMap]  # keys: albedo, normal, roughness, metallic, opacity, emission, specular


@dataclass(frozen=True)
class Tile:
    """The decoded textures of one UDIM tile, sentences about unread parts, and the reason why the tile as a whole
    cannot be used (None: it can)."""

    maps: dict[str, RawMap]
    notes: tuple[str, ...] = ()
    refused: str | None = None


@dataclass(frozen=True)
class Textures:
    """The `load` of a material whose textures are decoded: tiles by number, 1001 for every missing number. Its maps may
    be unfinished."""

    tiles: dict[int, Tile]

    def __call__(self, tile: int) -> tuple[Maps, tuple[str, ...]]:
        entry = self.tiles.get(tile) or self.tiles[1001]
        if entry.refused is not None:
            raise InputRefused(entry.refused)
        return entry.maps, entry.notes


@dataclass(frozen=True)
class RawMaterial:
    """A material of the file. `load` decodes its textures for a UDIM tile (1001 where there are none) and returns them
    with sentences about unread parts. `udim`: True when textures are named as tiles, False when a texture
    repeats over all of them, None without textures."""

    name: str
    load: Callable[[int], tuple[Maps, tuple[str, ...]]]
    udim: bool | None = None
    albedo_factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    roughness_factor: float = 1.0
    metallic_factor: float = 0.0
    shading: Shading = Shading()


@dataclass(frozen=True)
class Raw:
    """Triangles in file order, positions in the file's units and axes (glTF: world space).

    normals   per corner, zero or NaN where the file has none; None where it has none at all
    uvs       per corner, v up, NaN where a face has none; None where no face has any
    material  index into `materials` per face
    twin      the face whose UVs each face shares because the file stores them once (glTF instances), itself otherwise
    authored  the `uvs` of the file where io/meshes/lookups.py replaced them, else None
    colours   per corner, linear Rec.709, 0..1: factor of the albedo (vertex colours); None for white
    alphas    per corner, 0..1: factor of the opacity; None for 1
    """

    kind: str
    positions: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "f 3 3"] | None
    uvs: Float[np.ndarray, "f 3 2"] | None
    material: Int[np.ndarray, " f"]
    materials: tuple[RawMaterial, ...]
    primitives: tuple[Primitive, ...]
    twin: Int[np.ndarray, " f"] | None = None
    notes: tuple[str, ...] = field(default=())
    authored: Float[np.ndarray, "f 3 2"] | None = None
    colours: Float[np.ndarray, "f 3 3"] | None = None
    alphas: Float[np.ndarray, "f 3 1"] | None = None


@dataclass(frozen=True)
class Extent:
    """The size of a file's asset: faces, faces to unwrap anew, texture sets, and bytes of its own maps as float32.

    covered  the share of its sets that kept UVs cover; NaN where all are unwrapped anew
    surface  points of the mesh in working space, to which `work_from_user` takes the file's
    """

    faces: int
    unwrapped: int
    sets: int
    own: int
    covered: float
    surface: SpreadPoints
    work_from_user: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Corners:
    """Values that corners share, stored once: corner c of face f has `values[index[f, c]]`."""

    values: Float[np.ndarray, "n k"]
    index: Int[np.ndarray, "f 3"]

    def finished(self) -> Float[np.ndarray, "f 3 k"]:
        """The values per corner."""
        # Clipped: the index comes from the untrusted reader process.
        return self.values.take(self.index, axis=0, mode="clip")


@dataclass(frozen=True)
class Indexed:
    """A Raw for the transfer between processes: its normals, uvs and colours indexed, several times smaller, and its
    positions perhaps as float32."""

    raw: Raw
    normals: Corners
    uvs: Corners | None
    colours: Corners | None = None
    alphas: Corners | None = None

    def finished(self) -> Raw:
        """The Raw in its full form."""
        return replace(
            self.raw,
            positions=self.raw.positions.astype(np.float64, copy=False),
            normals=self.normals.finished(),
            uvs=None if self.uvs is None else self.uvs.finished(),
            colours=None if self.colours is None else self.colours.finished(),
            alphas=None if self.alphas is None else self.alphas.finished(),
        )


def spelled(mesh: Raw | Indexed) -> Raw:
    """A reader's result in its full form, per corner."""
    return mesh.finished() if isinstance(mesh, Indexed) else mesh


def no_textures(tile: int) -> tuple[Maps, tuple[str, ...]]:
    """The `load` of a material without textures."""
    return {}, ()
