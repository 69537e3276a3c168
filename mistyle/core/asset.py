"""The content of a mesh file: the mesh in working space, its materials, and the record for writing back.

UVs of `Mesh.corner_uvs`: v up, and every consumer takes them **modulo 1** (textures repeat). Reading shifts whole UV
islands by integers into the unit square. An island that fits the square but crosses its border (u from -0.05 to 0.99)
keeps its place, and its faces stay whole. So single coordinates may lie anywhere in [-1, 2]. A fragment outside the
square belongs to the texel on the other side, and a texture fetch wraps. A new unwrapping never leaves the square.

Faces may share texels (stacked or mirrored shells, instances of one glTF mesh): the face that comes first in
`Mesh.faces` is painted and measured; the others show the same texels.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from mistyle.core.mesh import Mesh

UpAxis = Literal["y", "z", "-y", "-z"]  # of a file, that points up
TURNED = " up to Y up"  # part of the note of every mesh that reading has turned
# Rows and columns as the file stores them, or as a viewer shows the picture (EXIF orientation).
Pixels = Literal["stored", "upright"]
# In a reader's note: pictures of the file show the feature that the note is about, and other renders do not.
SHOWN = "shows in lookdev and compare"
# Endings of cameras' RAW files.
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")


@dataclass(frozen=True)
class Picture:
    """An image file, decoded: sRGB-encoded Rec.709, 0..1, upright (row 0 is the top) unless requested otherwise.

    `alpha` is linear coverage 0..1, or None when the file is opaque; rgb is not premultiplied. `notes` are sentences
    about conversions while reading.
    """

    rgb: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"] | None
    path: Path
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Shading:
    """The material's properties besides albedo, normal, roughness and metalness. Pictures of the file show them;
    painted views do not.

    opacity         factor of the coverage, 0..1
    cutoff          coverage threshold: opaque at or above it, else transparent (glTF: MASK); None: blended
    emission        factor of the emitted radiance, linear Rec.709, >= 0, unbounded
    specular        factor of the dielectric's reflectance at normal incidence (F0), linear Rec.709, 0..1
    edge            factor of its reflectance at grazing incidence (F90), 0..1
    coat            weight of a clear coat of index 1.5, 0..1; coat_roughness its perceptual roughness
    transmission    share of the dielectric's diffuse part that is transmitted, 0..1; ior the index, thin: no volume
    unlit           the albedo is displayed without lighting
    black           the albedo holds the emission; the material reflects nothing
    stated          "colour": the file sets no metalness and roughness, and glTF's default, rough metal, is drawn;
                    "nothing": the file has no material, and a matt grey of 0.8 is drawn, as in Blender
    """

    opacity: float = 1.0
    cutoff: float | None = None
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    specular: tuple[float, float, float] = (0.04, 0.04, 0.04)
    edge: float = 1.0
    coat: float = 0.0
    coat_roughness: float = 0.0
    transmission: float = 0.0
    ior: float = 1.5
    thin: bool = True
    unlit: bool = False
    black: bool = False
    stated: Literal["surface", "colour", "nothing"] = "surface"


@dataclass(frozen=True)
class Material:
    """The material that a file gives one texture set. Row 0 of every map is v = 1; maps repeat outside the square.

    The maps are as stored, factors not yet applied: the surface's albedo is `albedo * albedo_factor`, its roughness
    `roughness * roughness_factor`, its metallic `metallic * metallic_factor`, with 1 where a map is None. They belong
    to `Mesh.corner_uvs`: reading has resampled them where the mesh was unwrapped anew.

    albedo     linear Rec.709, 0..1
    normal     unit tangent-space normal, +Y, the file's normal scale applied
    roughness  perceptual, 0..1
    metallic   0..1
    opacity    coverage, linear, 0..1
    emission   linear Rec.709, 0..1
    specular   linear Rec.709, 0..1
    shading    the factors of the last three, and properties without maps
    """

    name: str
    albedo: Float[np.ndarray, "h w 3"] | None
    normal: Float[np.ndarray, "hn wn 3"] | None
    roughness: Float[np.ndarray, "hr wr"] | None
    metallic: Float[np.ndarray, "hm wm"] | None
    albedo_factor: Float[np.ndarray, " 3"]
    roughness_factor: float
    metallic_factor: float
    opacity: Float[np.ndarray, "ho wo"] | None = None
    emission: Float[np.ndarray, "he we 3"] | None = None
    specular: Float[np.ndarray, "hs ws 3"] | None = None
    shading: Shading = Shading()


@dataclass(frozen=True)
class Primitive:
    """Faces start:stop of `Mesh.faces` and their origin in the file; -1 where the file has no such index.

    `texcoord` is the index of the TEXCOORD set that `Source.old_uvs` were read from (-1: none). `part` is the texture
    set, or -1 when the faces land in several UDIM tiles and `Mesh.part` decides face by face. On glTF
    `Mesh.faces[start:stop] - first_vertex` index the vertices of the primitive's own accessors; the faces are in the
    file's order (strips and fans spelled out), and where the node mirrors space their corners 1 and 2 are swapped.
    `name` is the object's: of OBJ its o (g where there is none), of glTF the node's, of USD the prim's whole path.
    """

    node: int
    mesh: int
    primitive: int
    start: int
    stop: int
    material: int
    texcoord: int
    part: int
    first_vertex: int = 0
    name: str = ""


@dataclass(frozen=True)
class Source:
    """The file of an asset, and the data for writing back to it.

    primitives      in face order, together they cover `Mesh.faces`
    user_positions  `Mesh.positions` in the file's own units and axes, same order (glTF: world space, node transforms
                    applied; a skinned mesh in the pose of its joints)
    work_from_user  takes user_positions (homogeneous columns) to `Mesh.positions`
    old_uvs         the authored corner UVs as the file has them, v up; None when it has none
    uv              "kept" (bit-equal to old_uvs), "shifted" (moved by integers, or as texture transforms and wrap modes
                    demand) or "new" (unwrapped here)
    notes           sentences for the report
    lit             whether a result's unlit materials are to become lit ones (glTF)
    displacement    how far the vertices were moved from the file's, in its units and axes; user_positions have it in
                    them. None for an unchanged mesh
    """

    path: Path
    kind: str
    primitives: tuple[Primitive, ...]
    user_positions: Float[np.ndarray, "v 3"]
    work_from_user: Float[np.ndarray, "4 4"]
    old_uvs: Float[np.ndarray, "f 3 2"] | None
    uv: str
    notes: tuple[str, ...]
    lit: bool = False
    displacement: Float[np.ndarray, "v 3"] | None = None


@dataclass(frozen=True)
class Asset:
    """A mesh with one material per texture set (`materials[p]` belongs to `mesh.parts[p]`) and its source."""

    name: str
    mesh: Mesh
    materials: tuple[Material, ...]
    source: Source

    def notes_of_pictures(self) -> tuple[str, ...]:
        """The reader's notes without those on features that pictures of the file show."""
        return tuple(note for note in self.source.notes if SHOWN not in note)
