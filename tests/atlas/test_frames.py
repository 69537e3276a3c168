"""Normal maps turned from MikkTSpace into Mitsuba's own frame shade alike."""

from dataclasses import replace

import numpy as np
import torch

from mistyle.atlas.frames import mitsuba_normals
from mistyle.atlas.texels import pad, rasterise
from mistyle.core.camera import orbit
from mistyle.core.light import Directional
from mistyle.core.maps import flat_maps
from mistyle.core.mesh import Mesh
from mistyle.geometry.tangents import corner_tangents
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import torch_bridge
from mistyle.render.mitsuba import draw

SIZE = 256


def bent_sheet(mirrored: bool) -> Mesh:
    """Part of a cylinder in two charts, the second turned by 40 degrees in the atlas, mirrored or not."""
    n = 12
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, n), np.linspace(-0.6, 0.6, n), indexing="xy"), -1).reshape(-1, 2)
    points = np.stack([np.sin(grid[:, 0]), grid[:, 1], np.cos(grid[:, 0])], -1).astype(np.float32)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    normals = points * [1, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first = points[faces][:, :, 0].mean(axis=1) < 0
    plain = np.stack([grid[:, 0] * 0.35 + 0.4, grid[:, 1] * 0.3 + 0.25], -1)
    angle = np.radians(40)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    other = (grid * [0.35, 0.3]) @ turn.T * ([-1, 1] if mirrored else [1, 1]) + [0.5, 0.72]
    uvs = np.where(first[:, None, None], plain[faces], other[faces]).astype(np.float32)
    return Mesh(
        positions=points,
        faces=faces.astype(np.int32),
        corner_normals=normals[faces].astype(np.float32),
        corner_uvs=uvs,
        part=np.zeros(len(faces), np.int32),
        parts=("sheet",),
    )


def shaded(mesh: Mesh, normal: np.ndarray, tangents) -> np.ndarray:
    """Luminance under a slanting light, in the given frame (None: Mitsuba's own)."""
    traced, camera = draw.tracer(mesh), orbit(10, 15, distance=4, fov=30, size=(128, 128))
    surface = deferred.trace(traced, [camera], tangents)
    light = Directional((0.6, 0.5, 0.62), (2.0, 2.0, 2.0), "world")
    lit = deferred.light(traced, surface, (light,), shadows=False)
    where = torch_bridge.taps(surface, [normal.shape[:2]])
    maps = flat_maps(SIZE)
    tables = {"albedo": maps.albedo.reshape(-1, 3), "normal": normal.reshape(-1, 3)}
    tables |= {"roughness": maps.roughness.reshape(-1, 1), "metallic": maps.metallic.reshape(-1, 1)}
    pixels = torch.from_numpy(torch_bridge.bilinear(np.concatenate(list(tables.values()), axis=1), where))
    return torch_bridge.Shader(camera.size)(lit, pixels).numpy()[..., 0]


def check(mirrored: bool) -> None:
    mesh = bent_sheet(mirrored)
    texels = rasterise(mesh, 0, SIZE)
    rows, columns = np.indices((SIZE, SIZE))
    tilt = np.stack([0.3 * np.sin(columns / 9), 0.25 * np.cos(rows / 7)], -1)
    bumps = np.concatenate([tilt, np.sqrt(1 - (tilt**2).sum(-1, keepdims=True))], -1).astype(np.float32)
    bumps = pad(bumps, texels, 4)
    tangents = corner_tangents(mesh)
    turned = pad(mitsuba_normals(mesh, replace(flat_maps(SIZE), normal=bumps), texels), texels, 4)
    wanted, plain, made = shaded(mesh, bumps, tangents), shaded(mesh, bumps, None), shaded(mesh, turned, None)
    error, before = np.abs(made - wanted), np.abs(plain - wanted)
    assert np.percentile(error, 99) < 0.01 * wanted.max()
    assert before.mean() > 3 * error.mean()


def test_charts_that_are_turned():
    check(mirrored=False)


def test_charts_that_are_mirrored():
    check(mirrored=True)
