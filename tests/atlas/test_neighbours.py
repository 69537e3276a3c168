"""Neighbours across seams: the right texels, over creases too, and nothing through walls or beyond borders."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.neighbours import STEPS, Links, links, weighted_seams, within
from mistyle.atlas.texels import rasterise
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh

Strip = tuple[list[tuple[float, float, float]], list[tuple[float, float]]]


def patches(*strips: Strip) -> Mesh:
    """Quadrilaterals, each by its four corners in order and their texture coordinates, with flat normals."""
    positions, faces, uvs, normals = [], [], [], []
    for corners, uv in strips:
        first, p, t = len(positions), np.array(corners, np.float32), np.array(uv, np.float32)
        positions += list(p)
        n = np.cross(p[1] - p[0], p[2] - p[0])
        for face in ((0, 1, 2), (0, 2, 3)):
            faces.append([first + k for k in face])
            uvs.append(t[list(face)])
            normals.append(np.tile(n / np.linalg.norm(n), (3, 1)))
    count = len(faces)
    return Mesh(
        np.array(positions, np.float32), np.array(faces, np.int32), np.array(normals, np.float32),
        np.array(uvs, np.float32), np.zeros(count, np.int32), ("only",),
    )  # fmt: skip


def square(x: float, y: float = 0.0, angle: float = 0.0) -> list[tuple[float, float, float]]:
    """A unit square whose left edge is at x, bent up from there by `angle` degrees."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return [(x, y, 0), (x + c, y, s), (x + c, y + 1, s), (x, y + 1, 0)]


def chart(u: float, v: float, quarter: int = 0, side: float = 0.4) -> list[tuple[float, float]]:
    """A square chart, turned by quarters."""
    corners = [(u, v), (u + side, v), (u + side, v + side), (u, v + side)]
    return corners[quarter:] + corners[:quarter]


def neighbours_of(mesh: Mesh, size: int = 40) -> tuple[Texels, Links]:
    texels = rasterise(mesh, 0, size)
    return texels, links(mesh, texels)


def sewn(one: Links) -> int:
    return sum(len(seam.here) for seam in one.seams)


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_the_surface_goes_on_in_the_other_chart(quarter):
    """Two squares side by side, the second laid out turned: the texels on both sides of their edge are neighbours, one
    width apart, in the direction that was asked for."""
    texels, every = neighbours_of(patches((square(0), chart(0.05, 0.05)), (square(1), chart(0.55, 0.55, quarter))))
    position, island = texels.position.reshape(-1, 3), texels.island.ravel()
    assert sewn(every) == 2 * 16
    for seam, step in zip(every.seams, STEPS, strict=True):
        apart = position[seam.there] - position[seam.here]
        np.testing.assert_allclose(np.linalg.norm(apart, axis=1), 1 / 16, atol=1e-5)
        assert (island[seam.there] != island[seam.here]).all()
        back = seam.here - (step[0] * 40 + step[1])  # the neighbour on the other side, in the grid
        np.testing.assert_allclose(position[seam.here] - position[back], apart, atol=1e-5)
    assert sewn(within(every)) == 0 and within(every).right is every.right


@pytest.mark.parametrize(("angle", "count"), [(40, 32), (90, 32), (115, 32), (150, 0)])
def test_a_crease_is_no_border(angle, count):
    """What is folded back on itself nearly whole is another side, not a neighbour."""
    mesh = patches((square(0), chart(0.05, 0.05)), (square(1, angle=angle), chart(0.55, 0.55)))
    assert sewn(neighbours_of(mesh)[1]) == count


def test_borders_of_the_surface_have_no_neighbours_and_neither_has_the_other_side_of_a_sheet():
    corners = square(0)
    mesh = patches((corners, chart(0.05, 0.05)), (corners[::-1], chart(0.55, 0.55)))
    assert sewn(neighbours_of(mesh)[1]) == 0


def test_a_chart_around_a_pipe_goes_on_at_its_own_other_end():
    sides = 24
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    strips = []
    for k in range(sides):
        a, b = ((float(np.cos(t)), float(np.sin(t))) for t in angle[k : k + 2])
        u, v = 0.05 + 0.9 * k / sides, 0.05 + 0.9 * (k + 1) / sides
        corners = [(*a, 0.0), (*b, 0.0), (*b, 2.0), (*a, 2.0)]
        strips.append((corners, [(u, 0.1), (v, 0.1), (v, 0.4), (u, 0.4)]))
    texels, every = neighbours_of(patches(*strips), 64)
    right, left, below, above = every.seams
    assert len(right.here) == len(left.here) == texels.covered.any(axis=1).sum()
    assert (right.here // 64 == right.there // 64).all() and (right.here % 64 > right.there % 64 + 50).all()
    assert len(below.here) == len(above.here) == 0


@pytest.mark.parametrize(("jump", "spread", "least", "most"), [
    (0.0, 0.01, 0.9, 1), (0.3, 0.01, 0, 0.01), (0.3, 1.0, 0.99, 1),
])  # fmt: skip
def test_a_seam_is_believed_unless_values_that_are_known_jump_there(rng, jump, spread, least, most):
    texels, every = neighbours_of(patches((square(0), chart(0.05, 0.05)), (square(1), chart(0.55, 0.55, 1))))
    values = 0.5 + 0.02 * texels.position + jump * (texels.island == 1)[..., None]
    values += rng.normal(0, 0.01, values.shape)
    open_ = np.full(values.shape[:2], spread, np.float32)
    found = weighted_seams(every, [(values[..., c].astype(np.float32), open_) for c in range(3)])
    shares = np.concatenate([seam.share for seam in found.seams])
    assert len(shares) == 32 and least <= np.median(shares) <= most
    assert all(np.array_equal(a.here, b.here) for a, b in zip(found.seams, every.seams, strict=True))


def test_an_empty_set_has_none():
    mesh = patches((square(0), chart(0.05, 0.05)))
    texels = rasterise(mesh, 0, 8)
    every = links(mesh, replace(texels, covered=texels.covered & False, island=np.full_like(texels.island, -1)))
    assert sewn(every) == 0 and not every.right.any()
