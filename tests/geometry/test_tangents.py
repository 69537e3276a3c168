"""Tangents against closed forms and against the reference implementation (npm mikktspace, compiled from its source).

Measured: on the real meshes every corner has the same sign and agrees to 3.1e-5 (99.9 % of them to 7e-7), except
those where the reference has no tangent to give and returns (1, 0, 0) or zero (DamagedHelmet 1 of 46356 corners, a
needle whose angle rounds to 0; spot, Avocado, NormalTangentTest, capsule none).
"""

import numpy as np
import pytest

from mistyle.geometry.tangents import mikktspace
from tests.support.helpers import data
from tests.support.node_tools import mikktspace as reference

# Both compute in float32 (0.006 degrees); only the order of the sums differs, which needles multiply.
ROUNDING = 1e-4


def grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertex (x, y) of a unit square's grid and its triangles, counter-clockwise."""
    x, y = np.meshgrid(np.linspace(0, 1, size + 1), np.linspace(0, 1, size + 1))
    a = (np.arange(size)[:, None] * (size + 1) + np.arange(size)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 1, a + size + 2], 1), np.stack([a, a + size + 2, a + size + 1], 1)])
    return np.stack([x, y], -1).reshape(-1, 2), faces


def compare(positions, normals, uvs, faces) -> float:
    """Assert agreement with the reference; the share of corners where the reference has no answer."""
    ours = mikktspace(positions, normals, uvs, faces)
    theirs = reference(positions[faces], normals[faces], uvs[faces])
    assert np.isfinite(ours).all() and np.abs(np.linalg.norm(ours[..., :3], axis=-1) - 1).max() < 1e-5
    silent = (theirs[..., :3] == np.float32([1, 0, 0])).all(-1) | (np.linalg.norm(theirs[..., :3], axis=-1) < 0.5)
    agree = (np.abs(ours - theirs).max(-1) < ROUNDING) | silent
    assert agree.all(), f"{(~agree).sum()} of {agree.size} corners differ"
    return float((np.abs(ours - theirs).max(-1) >= ROUNDING).mean())


def test_plane_has_the_direction_of_u():
    xy, faces = grid(3)
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    positions = np.concatenate([xy, np.zeros((len(xy), 1))], 1)
    result = mikktspace(positions, np.tile([0.0, 0, 1], (len(xy), 1)), xy @ turn, faces)
    np.testing.assert_allclose(result[..., :3], np.broadcast_to([turn[0, 0], turn[1, 0], 0], (18, 3, 3)), atol=1e-6)
    assert (result[..., 3] == 1).all()


def test_sphere_tangents_are_perpendicular_and_the_bitangent_follows_v():
    xy, faces = grid(24)
    longitude, height = xy[:, 0] * 2 * np.pi, (xy[:, 1] - 0.5) * 2.6
    positions = np.stack([np.sin(longitude) * np.cos(height), np.sin(height), np.cos(longitude) * np.cos(height)], 1)
    result = mikktspace(positions, positions, xy, faces)
    normal = positions[faces]
    assert np.abs((result[..., :3] * normal).sum(-1)).max() < 1e-6
    east = np.stack([np.cos(longitude), 0 * longitude, -np.sin(longitude)], 1)[faces]
    assert (result[..., :3] * east).sum(-1).min() > 0.99
    up = result[..., 3:] * np.cross(normal, result[..., :3])
    assert up[..., 1].min() > 0.2, "v grows with height"


def test_mirrored_half_gets_its_own_tangents():
    """u = |x|: the shared edge has two groups, so one vertex carries two tangents."""
    xy, faces = grid(4)
    positions = np.concatenate([xy - [0.5, 0], np.zeros((len(xy), 1))], 1)
    uvs = np.stack([np.abs(positions[:, 0]), xy[:, 1]], 1)
    result = mikktspace(positions, np.tile([0.0, 0, 1], (len(xy), 1)), uvs, faces)
    right = positions[faces].mean(1)[:, 0] > 0
    np.testing.assert_allclose(result[right], np.broadcast_to([1, 0, 0, 1], result[right].shape), atol=1e-6)
    np.testing.assert_allclose(result[~right], np.broadcast_to([-1, 0, 0, -1], result[~right].shape), atol=1e-6)


def test_without_any_uv_area_the_frame_still_stands():
    positions = np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])
    normals = np.tile([1.0, 0, 0], (4, 1))
    result = mikktspace(positions, normals, np.zeros((4, 2)), np.array([[0, 1, 2], [0, 3, 1]]))
    assert np.abs(result[..., 0]).max() < 1e-6 and np.allclose(np.linalg.norm(result[..., :3], axis=-1), 1)
    assert mikktspace(positions, normals, np.zeros((4, 2)), np.zeros((0, 3), int)).shape == (0, 3, 4)


@pytest.mark.parametrize("seed", range(4))
def test_reference_agrees_on_nasty_random_meshes(seed):
    """Faces without uv area, degenerate faces, edges with three faces, mirrored charts, shared and split vertices."""
    random = np.random.default_rng(seed)
    xy, faces = grid(12)
    positions = np.concatenate([xy, random.normal(0, 0.05, (len(xy), 1))], 1).astype(np.float32)
    normals = random.normal(0, 0.3, positions.shape) + [0, 0, 1]
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    uvs = np.round(random.random((len(xy), 2)) * (3, 3, 8, 1000)[seed]).astype(np.float32) / 4
    extra = random.integers(0, len(xy), (60, 3))
    degenerate = np.repeat(random.integers(0, len(xy), (10, 1)), 3, 1)
    degenerate[:, 2] = random.integers(0, len(xy), 10)
    faces = random.permutation(np.concatenate([faces, extra, degenerate]))
    different = compare(positions, normals, uvs, faces)
    assert different < 0.25, "the comparison says nothing if most corners have no tangent"


@pytest.mark.parametrize(
    "name, silent",
    [
        ("plain/spot.obj", 0),
        ("pbr/Avocado/Avocado.gltf", 0),
        ("pbr/DamagedHelmet/DamagedHelmet.glb", 1e-4),
        ("pbr/NormalTangentTest.glb", 0),
        ("nasty/capsule.obj", 1e-3),
        ("nasty/chair_model.obj", 0.3),  # 9639 of its 12756 faces have no uv area
    ],
)
def test_reference_agrees_on_real_meshes(name, silent):
    import trimesh

    mesh = trimesh.load(data(f"meshes/{name}"), process=False, force="mesh")
    arrays = (np.asarray(x, np.float32) for x in (mesh.vertices, mesh.vertex_normals, mesh.visual.uv))
    assert compare(*arrays, np.asarray(mesh.faces)) <= silent


def test_tangents_that_blender_wrote():
    """Suzanne carries the tangents of Blender's exporter, which has an implementation of its own."""
    from mistyle.io.gltf.check import load_gltf
    from mistyle.io.gltf.glb import values

    tree, buffers = load_gltf(data("meshes/pbr/Suzanne/02_suzanne.gltf"))
    primitive = tree["meshes"][0]["primitives"][0]
    read = {name: values(tree, buffers, index) for name, index in primitive["attributes"].items()}
    faces = values(tree, buffers, primitive["indices"]).reshape(-1, 3).astype(np.int64)
    v_up = read["TEXCOORD_0"] * np.float32([1, -1])
    ours, theirs = mikktspace(read["POSITION"], read["NORMAL"], v_up, faces), read["TANGENT"][faces]
    assert (ours[..., 3] == theirs[..., 3]).all(), "glTF's sign belongs to v up"
    angle = np.degrees(np.arccos(np.clip((ours * theirs)[..., :3].sum(-1), -1, 1)))
    # It made them before quads became triangles, so they differ a little; a wrong frame differs by tens of degrees.
    assert np.median(angle) < 0.2 and np.quantile(angle, 0.95) < 2
