"""How long 16 views of 1024² take into a 4096² atlas, and how right the result is.

The object is five spheres that hide parts of one another (69k faces, 30 islands); their depth and colour are known in
closed form, so nothing but the bake is measured. `bake.seconds` is everything from views and rasterised atlas to
padded albedo. Baking reads neither normal, uv nor part of a view: the views here share one array of zeros for them.
"""

import numpy as np

from benchmarks.common import arguments, finish, peak_gb, timed
from mistyle.atlas.bake import Backprojection, backproject, fill_in_place
from mistyle.atlas.settings import BakeSettings
from mistyle.atlas.texels import pad_in_place, rasterise
from mistyle.core.camera import Camera, pixel_centres, rig
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.core.view import View

# Centre and radius.
SPHERES = np.array(
    [(0, 0, 0, 0.6), (0.65, 0.3, 0.2, 0.28), (-0.6, 0.4, 0.3, 0.26), (0, -0.7, 0.3, 0.22), (0.2, 0.6, -0.4, 0.25)]
)


def spheres(cells: int, margin: float = 0.006) -> Mesh:
    """Every sphere as a cube's six faces of cells² squares, each an island of its own in a 6 x 5 grid."""
    line = np.tan(np.linspace(-1, 1, cells + 1) * np.pi / 4)
    a, b = (x.ravel() for x in np.meshgrid(line, line))
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1)))
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    below = corner + cells + 1
    quads = np.stack([corner, corner + 1, below + 1, corner, below + 1, below], axis=1).reshape(-1, 3)
    positions, normals, uvs, faces = [], [], [], []
    for row, sphere in enumerate(SPHERES):
        for side in range(6):
            sign = 1.0 if side % 2 else -1.0
            d = np.roll(np.stack([np.full(len(a), sign), sign * a, b], axis=1), side // 2, axis=1)
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            uvs.append((np.array([side, row]) + margin * 6 + (1 - 12 * margin) * np.stack([u, v], axis=1)) / 6)
            faces.append(quads + sum(map(len, positions)))
            positions.append(d * sphere[3] + sphere[:3])
            normals.append(d)
    f = np.concatenate(faces)
    corners = np.concatenate(normals)[f].astype(np.float32), np.concatenate(uvs)[f].astype(np.float32)
    return Mesh(np.concatenate(positions).astype(np.float32), f, *corners, np.zeros(len(f), np.int32), ("spheres",))


def paint(points: np.ndarray) -> np.ndarray:
    """A colour for every point in space, smooth at the scale of a pixel."""
    return (0.5 + 0.4 * np.sin(points * np.array([7, 9, 11]) + np.arange(3))).astype(np.float32)


def draw(camera: Camera) -> View:
    """What a camera sees of the exact spheres, one ray through each pixel centre."""
    local = (pixel_centres(camera.size) - np.asarray(camera.centre)) / camera.focal
    rays = np.concatenate([local, np.ones((*camera.size, 1))], axis=-1) @ camera.world_from_cam[:3, :3].T
    depth = np.full(camera.size, np.inf)
    for x, y, z, r in SPHERES:
        away = camera.position - np.array([x, y, z])
        a, b, c = (rays**2).sum(axis=-1), rays @ away, away @ away - r * r
        under = b * b - a * c
        depth = np.minimum(depth, np.where(under > 0, (-b - np.sqrt(np.maximum(under, 0))) / a, np.inf))
    mask = np.isfinite(depth)
    points = camera.position + rays * np.where(mask, depth, 0)[..., None]
    rgb = np.where(mask[..., None], paint(points), 0).astype(np.float32)
    nothing = np.broadcast_to(np.float32(0), (*camera.size, 3))
    part = np.broadcast_to(np.int32(0), camera.size)
    return View(camera, rgb, depth.astype(np.float32), nothing, nothing[..., :2], part, mask, mask.astype(np.float32))


def bake(views: list[View], texels: Texels, mesh: Mesh) -> Backprojection:
    """All of section 4.1.4 after the rasterisation, in one array."""
    baked = backproject(views, texels, BakeSettings(), mesh=mesh)
    fill_in_place(baked.albedo, baked.known, texels)
    pad_in_place([baked.albedo], texels, 16)
    return baked


def measure(figures: dict[str, float], size: int, resolution: int, cells: int) -> None:
    """Rasterise and bake once; what it needed is gone when it returns."""
    views = [draw(camera) for camera in rig(RigSettings(resolution=resolution))]
    mesh = spheres(cells)
    figures["bake.faces"] = len(mesh.faces)
    texels = timed(figures, "bake.rasterise_seconds", lambda: rasterise(mesh, 0, size))
    baked = timed(figures, "bake.seconds", lambda: bake(views, texels, mesh))
    figures["bake.peak_gb"] = peak_gb()
    figures["bake.covered_share"] = float(texels.covered.mean())
    figures["bake.known_share"] = float(baked.known[texels.covered].mean())
    wrong = np.abs(baked.albedo[baked.known] - paint(texels.position[baked.known]))
    figures["bake.error_mean"] = float(wrong.mean())


def main(argv: list[str] | None = None) -> None:
    options = arguments(__doc__ or "", argv)
    size, resolution, cells = (512, 128, 12) if options.quick else (4096, 1024, 34)
    figures: dict[str, float] = {}
    measure(figures, size, resolution, cells)
    dense = spheres(3 * cells)
    figures["bake.dense_faces"] = len(dense.faces)
    timed(figures, "bake.dense_rasterise_seconds", lambda: rasterise(dense, 0, size))
    finish(figures, options.json)


if __name__ == "__main__":
    main()
