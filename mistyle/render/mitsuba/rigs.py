"""A camera rig for a mesh (paper 6.2.1): the fewest views that see all of the surface well."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera
from mistyle.core.errors import InputRefused
from mistyle.core.mesh import Mesh, face_areas, face_normals
from mistyle.core.settings import RigSettings
from mistyle.geometry.next_best_view import candidate_cameras, choose
from mistyle.render.mitsuba.draw import tracer
from mistyle.render.mitsuba.visible import face_on

SAMPLES = 20_000


@dataclass(frozen=True)
class Planned:
    """A rig in visiting order and its coverage; shares are of the surface's area.

    reachable  share that some candidate sees at the required weight
    covered    share of the reachable that the rig sees at that weight
    overlap    least overlap of a view with its best earlier view (NaN for a single view)
    """

    cameras: tuple[Camera, ...]
    reachable: float
    covered: float
    overlap: float

    def sentence(self) -> str:
        """A one-line summary."""
        text = f"{len(self.cameras)} views see {100 * self.covered:.2f} % of the reachable surface"
        if self.covered < 1:
            text += f"; {100 * (1 - self.covered):.2f} % is left uncovered"
        if self.reachable < 1:
            text += f" ({100 * (1 - self.reachable):.2f} % of the surface is not seen well by any candidate camera)"
        return text


@dataclass(frozen=True)
class VisibilitySamples:
    """Samples of equal area: shading normals, and unit normals of their faces on the outer side."""

    positions: Float[np.ndarray, "s 3"]
    normals: Float[np.ndarray, "s 3"]
    fronts: Float[np.ndarray, "s 3"]


def next_best_views(mesh: Mesh, settings: RigSettings, traced: Any = None) -> Planned:
    """The rig of kind 'nbv' for a mesh in working space, from its shape alone; the same mesh gives the same rig.

    Some view sees every point at a face-on weight of `settings.facing` or more, if any of the `settings.candidates`
    cameras about the mesh does. Neighbouring views overlap by `settings.overlap`. There are at most
    `settings.most_views`. `traced` is a `render.mitsuba.draw.Tracer` of the mesh, built here by default. The surface is
    sampled at SAMPLES points of equal area, so features smaller than a few of them may be missed. Raises InputRefused
    if no candidate sees the mesh.
    """
    points = sample_surface(mesh, SAMPLES)
    cameras = candidate_cameras(settings)
    weight = face_on(traced or tracer(mesh), cameras, points.positions, points.normals, points.fronts)
    chosen = choose(weight, settings.facing, settings.overlap, settings.most_views)
    if not chosen.reachable.any():
        raise InputRefused(
            f"none of {len(cameras)} cameras at distance {settings.distance:g} sees the mesh at a face-on weight of "
            f"{settings.facing:g}; turn its faces outwards, or lower rig.facing"
        )
    return Planned(
        tuple(cameras[k] for k in chosen.order),
        float(chosen.reachable.mean()),
        float(chosen.covered.sum() / chosen.reachable.sum()),
        float(np.nanmin(chosen.overlap)) if len(chosen.order) > 1 else float("nan"),
    )


def sample_surface(mesh: Mesh, count: int, seed: int = 0) -> VisibilitySamples:
    """`count` points of equal area, stratified over the faces in their order. Raises InputRefused without area."""
    areas = face_areas(mesh)
    total = float(areas.sum())
    if not total > 0 or not np.isfinite(total):
        raise InputRefused(f"the mesh has a surface area of {total:g}; at least one triangle must have an area")
    rng = np.random.default_rng(seed)
    steps = (np.arange(count) + rng.random(count)) / count * total
    face = np.minimum(np.searchsorted(np.cumsum(areas), steps, side="right"), np.flatnonzero(areas > 0)[-1])
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    bary = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    positions = np.einsum("sk,skc->sc", bary, mesh.positions[mesh.faces[face]])
    normals = np.einsum("sk,skc->sc", bary, mesh.corner_normals[face])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    fronts = face_fronts(mesh)[face]
    return VisibilitySamples(positions.astype(np.float32), normals.astype(np.float32), fronts)


def face_fronts(mesh: Mesh) -> Float[np.ndarray, "f 3"]:
    """Unit normal of every face on the side to which its corner normals point."""
    normals = face_normals(mesh)
    inward = (normals * mesh.corner_normals.sum(axis=1)).sum(axis=1) < 0
    return np.where(inward[:, None], -normals, normals).astype(np.float32)
