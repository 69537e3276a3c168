"""Does the mesh follow outlines, and stay whole? `python -m benchmarks.geometry [--quick] [--sheets DIR]`

A sphere (5,120 faces) follows 16 outlines of an ellipsoid with half axes 1, 0.82 and 0.9: the two-sided Hausdorff
distance to the ellipsoid, in bounding radii. Then a shape is drawn onto the outline of one view of three meshes: a
horn on spot, a tip on an ear of the bunny, a fin on the handle of the teapot. Figures are the mean overlap of the three
with the drawn outline before and after, triangles that turned over, and pairs of triangles that intersect now and did
not before.

With --blender PYTHON (or $MISTYLE_BLENDER_PYTHON) the displaced spot is written as GLB and read by Blender: the largest
difference of its corners from the displaced ones (bounding radii) and of its UVs from those of the file.
"""

import os
import subprocess
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from benchmarks.common import DATA, finish, parser
from mistyle.core.camera import Camera, orbit, px_from_world, rig
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.solver.shape.checks import flipped, new_intersections, start_of
from mistyle.solver.shape.displace import TargetOutline, displace
from mistyle.solver.shape.settings import DisplaceSettings
from mistyle.solver.shape.surface import surface_of
from mistyle.stylization.displace.outlines import coverages, follow_outlines

AXES = np.array([1.0, 0.82, 0.9])
BOUND = 0.2


@dataclass(frozen=True)
class Drawing:
    """A triangle drawn onto an outline: the mesh, the azimuth of the view, where on the outline (the point farthest
    along a direction in the picture, y down), and its height and width in bounding radii."""

    mesh: str
    azimuth: float
    towards: tuple[float, float]
    height: float
    width: float


DRAWINGS = (
    Drawing("meshes/plain/spot.obj", 30.0, (0.1, -1.0), 0.15, 0.1),
    Drawing("meshes/plain/stanford-bunny.obj", 30.0, (0.3, -1.0), 0.12, 0.15),
    Drawing("meshes/plain/teapot.obj", 30.0, (-0.6, -1.0), 0.12, 0.5),
)


def main() -> None:
    options = parser("python -m benchmarks.geometry")
    options.add_argument("--blender", default=os.environ.get("MISTYLE_BLENDER_PYTHON"), help="Python with bpy")
    options.add_argument("--sheets", type=Path, help="folder for the pictures before and after")
    chosen = options.parse_args()
    began, size = time.perf_counter(), 256 if chosen.quick else 512
    figures = ellipsoid(size, 3 if chosen.quick else 4)
    rows = [drawn_on(d, size, chosen.sheets) for d in (DRAWINGS[:1] if chosen.quick else DRAWINGS)]
    for name in ("silhouette_iou_before", "silhouette_iou_after"):
        figures[name] = float(np.mean([row[name] for row in rows]))
    for name in ("flipped", "new_self_intersections"):
        figures[name] = figures.get(name, 0) + sum(row[name] for row in rows)
    if chosen.blender:
        figures |= in_blender(DRAWINGS[0], size, chosen.blender)
    for drawing, row in zip(DRAWINGS, rows, strict=False):
        figures |= {f"{Path(drawing.mesh).stem}.{name}": value for name, value in row.items()}
    finish(figures | {"seconds": time.perf_counter() - began}, chosen.json)


def ellipsoid(size: int, rounds: int) -> dict[str, float]:
    """Hausdorff distance of a displaced sphere to the ellipsoid of its 16 outlines."""
    import trimesh

    sphere = trimesh.creation.icosphere(rounds, 0.9)
    fine = trimesh.creation.icosphere(6, 1.0)
    begun = plain_mesh(np.array(sphere.vertices), np.array(sphere.faces))
    wanted = plain_mesh(np.array(fine.vertices) * AXES, np.array(fine.faces))
    cameras = rig(RigSettings(resolution=size))
    views = [empty_view(camera) for camera in cameras]
    pairs = zip(cameras, coverages(wanted, views), coverages(begun, views), strict=True)
    outlines = [TargetOutline(camera, target, np.abs(target - own) > 0.3) for camera, target, own in pairs]
    result = displace(begun, outlines, DisplaceSettings(most=BOUND))
    moved = replace(begun, positions=result.positions)
    both = [farthest(moved, wanted), farthest(wanted, moved)]
    return {"ellipsoid_hausdorff": max(both), "ellipsoid_pixels": result.distance[1], **wholeness(begun, moved)}


def farthest(one: Mesh, other: Mesh, count: int = 60_000, near: int = 24) -> float:
    """The largest distance of vertices and random points of one mesh from the triangles of the other."""
    import trimesh
    from scipy.spatial import KDTree

    own = trimesh.Trimesh(one.positions, one.faces, process=False)
    points = np.concatenate([one.positions, np.asarray(trimesh.sample.sample_surface(own, count, seed=0)[0])])
    corners = other.positions[other.faces].astype(float)
    index = np.asarray(KDTree(corners.mean(axis=1)).query(points, k=near)[1])
    best = np.full(len(points), np.inf)
    for k in range(near):
        place = trimesh.triangles.closest_point(corners[index[:, k]], points.astype(float))
        best = np.minimum(best, np.linalg.norm(place - points, axis=1))
    return float(best.max())


def drawn_on(drawing: Drawing, size: int, sheets: Path | None) -> dict[str, float]:
    """Draw a triangle onto one outline of a mesh and let the mesh follow it."""
    from mistyle.io.read_mesh import read_mesh

    mesh = read_mesh(DATA / drawing.mesh).mesh
    camera = orbit(drawing.azimuth, 0.0, distance=4, fov=30, size=(size, size))
    (own,) = coverages(mesh, [empty_view(camera)])
    view = replace(empty_view(camera), coverage=with_triangle(own, camera, drawing))
    began = time.perf_counter()
    shape = follow_outlines(mesh, [view], None, DisplaceSettings(most=BOUND), lambda done: None)
    seconds = time.perf_counter() - began
    moved = mesh if shape.result is None else replace(mesh, positions=shape.result.positions)
    if sheets is not None:
        write_sheet(sheets / f"{Path(drawing.mesh).stem}.png", mesh, moved, view)
    before, after = shape.overlap
    figures = {"silhouette_iou_before": before, "silhouette_iou_after": after, "seconds": seconds}
    return figures | wholeness(mesh, moved)


def in_blender(drawing: Drawing, size: int, python: str) -> dict[str, float]:
    """Blender's corners and UVs of the displaced mesh against ours, triangle by triangle."""
    from mistyle.core.maps import flat_maps
    from mistyle.io.gltf.write import write_glb
    from mistyle.io.read_mesh import read_mesh
    from mistyle.solver.shape.moved import displaced_asset

    asset = read_mesh(DATA / drawing.mesh)
    camera = orbit(drawing.azimuth, 0.0, distance=4, fov=30, size=(size, size))
    (own,) = coverages(asset.mesh, [empty_view(camera)])
    view = replace(empty_view(camera), coverage=with_triangle(own, camera, drawing))
    result = follow_outlines(asset.mesh, [view], None, DisplaceSettings(most=BOUND), lambda done: None).result
    moved = displaced_asset(asset, asset.mesh.positions if result is None else result.positions)
    with tempfile.TemporaryDirectory() as folder:
        glb, out = Path(folder, "spot.glb"), Path(folder, "spot.npz")
        write_glb(glb, moved, [flat_maps(4)], [np.ones((4, 4), np.float32)], name="spot")
        worker = Path(__file__).with_name("worker.py")
        subprocess.run([python, str(worker), str(glb), str(out)], check=True, capture_output=True)
        with np.load(out) as found:
            corners, uvs = found["corners"], found["uvs"]
    unit = 1 / np.cbrt(np.linalg.det(asset.source.work_from_user[:3, :3]))
    shape = np.abs(corners - moved.source.user_positions[moved.mesh.faces]).max() / unit
    back = np.linalg.norm(moved.mesh.positions - asset.mesh.positions, axis=1).max()
    same = np.abs(uvs - asset.mesh.corner_uvs).max()
    return {"blender_displacement": float(back), "blender_corners": float(shape), "blender_uvs": float(same)}


def wholeness(before: Mesh, after: Mesh) -> dict[str, float]:
    """Turned triangles and new intersections, counted afresh on the result."""
    surface = surface_of(before)
    points = np.zeros_like(surface.points)
    points[surface.of_vertex] = after.positions
    start = start_of(surface)
    return {
        "flipped": float(flipped(start, surface, points).sum()),
        "new_self_intersections": float(len(new_intersections(start, surface, points))),
    }


def with_triangle(own: Float[np.ndarray, "h w"], camera: Camera, drawing: Drawing) -> Float[np.ndarray, "h w"]:
    """A coverage with a triangle on its outline that points outwards from the mesh's centre."""
    y, x = np.nonzero(own > 0.5)
    first = int(np.argmax(x * drawing.towards[0] + y * drawing.towards[1]))
    foot = np.array([x[first], y[first]], float)
    centre = px_from_world(camera, np.zeros((1, 3)))[0][0]
    out = (foot - centre) / np.linalg.norm(foot - centre)
    across, unit = np.array([-out[1], out[0]]), camera.focal / 4.0
    low = foot - 0.04 * unit * out
    half, tip = 0.5 * drawing.width * unit * across, foot + drawing.height * unit * out
    corners = np.round(np.array([low - half, low + half, tip]) * 16).astype(np.int32)
    page = np.zeros(own.shape, np.uint8)
    cv2.fillPoly(page, [corners], 255, lineType=cv2.LINE_AA, shift=4)
    return np.maximum(own, page / np.float32(255)).astype(np.float32)


def write_sheet(path: Path, before: Mesh, after: Mesh, view: View) -> None:
    """The mesh before and after from the view and from the side, and the drawn outline."""
    from mistyle.io.images.write import write_png
    from mistyle.solver.shape.moved import turned_normals
    from mistyle.stylization.displace.pictures import cameras_of, under_key

    cameras = cameras_of([view.camera], 400)
    moved = replace(before, positions=after.positions, corner_normals=turned_normals(before, after.positions))
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [under_key(before, cameras, 0), under_key(moved, cameras, 0)]
    outline = cv2.resize(1 - view.coverage, (400, 400), interpolation=cv2.INTER_AREA)
    outlines = [np.repeat(outline[..., None], 3, axis=2)] * 2
    write_png(path, np.concatenate([np.concatenate(pair, axis=1) for pair in zip(rows, outlines, strict=True)]))


def plain_mesh(points: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    """A mesh about the origin with radial normals and no UVs."""
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    return Mesh(
        points.astype(np.float32),
        faces.astype(np.int32),
        normals[faces].astype(np.float32),
        np.zeros((len(faces), 3, 2), np.float32),
        np.zeros(len(faces), np.int32),
        ("a",),
    )


def empty_view(camera: Camera) -> View:
    """A view without a picture."""
    none, size = np.zeros(camera.size, np.float32), camera.size
    colour = np.zeros((*size, 3), np.float32)
    return View(camera, colour, none, colour, colour[..., :2], none.astype(np.int32), none > 0, none)


if __name__ == "__main__":
    main()
