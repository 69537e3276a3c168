"""The note that a mesh lies on its side: where its form says so plainly, and nowhere else."""

import numpy as np
import pytest

from mistyle.geometry.upright import lies_on_its_side
from mistyle.io.meshes.prepare import SIDEWAYS
from mistyle.io.read_mesh import read_mesh
from tests.support.helpers import ROOT, data

Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # (x, y, z) with Y up -> (x, -z, y)


def turned_form(profile, sides=40):
    """A surface of revolution about +Y: (radius, height) knots; its ends are closed by fans."""
    radius, height = np.array(profile, float).T
    around = np.arange(sides) * 2 * np.pi / sides
    p = np.stack(
        [np.outer(radius, np.sin(around)), np.repeat(height[:, None], sides, 1), np.outer(radius, np.cos(around))]
    )
    p = np.concatenate([p.reshape(3, -1).T, [[0, height[0], 0], [0, height[-1], 0]]])
    faces, n = [], len(radius) * sides
    for i in range(sides):
        j = (i + 1) % sides
        for k in range(len(radius) - 1):
            a, b, c, d = k * sides + i, k * sides + j, (k + 1) * sides + j, (k + 1) * sides + i
            faces += [[a, b, c], [a, c, d]]
        faces += [[n, j, i], [n + 1, n - sides + i, n - sides + j]]
    return p, np.array(faces)


def box(size):
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T * np.asarray(size, float)
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    return corners, hull.simplices


VASE = turned_form([(0.5, 0), (0.8, 0.7), (0.9, 1.2), (0.5, 1.9), (0.2, 2.3), (0.22, 2.5)])
SPINDLE = turned_form([(0.01, 0), (0.5, 0.7), (0.6, 1.2), (0.3, 1.9), (0.01, 2.5)])
RIMMED = turned_form([(0.5, 0), (0.8, 0.7), (0.9, 1.2), (0.5, 1.9), (0.4, 2.3), (0.45, 2.5)])
DRUM = turned_form([(0.6, 0), (0.6, 2.5)])


def test_a_vase_and_a_robot_with_z_up_lie_on_their_sides():
    points, faces = VASE
    assert lies_on_its_side(points @ Z_UP.T, faces) and not lies_on_its_side(points, faces)
    open_below = faces[(faces < len(points) - 2).all(axis=1)]  # a scan has no bottom
    assert lies_on_its_side(points @ Z_UP.T, open_below) and not lies_on_its_side(points, open_below)
    for far in (1e-3, 1e4):
        assert lies_on_its_side(points @ Z_UP.T * far + 3 * far, faces), "neither the unit nor the place matters"
    robot = read_mesh(ROOT / "scenes" / "robot.obj").mesh
    assert lies_on_its_side(robot.positions @ Z_UP.T, robot.faces)


@pytest.mark.parametrize(
    "form",
    [
        SPINDLE,  # stands on neither end
        DRUM,  # stands on both
        RIMMED,  # on its rim too
        turned_form([(0.5, 0), (0.8, 0.3), (0.6, 0.5)]),  # flat: a bowl that shows us its bottom may be a wall lamp
        box((1, 1, 1)),
        box((1, 3, 0.2)),
    ],
)
@pytest.mark.parametrize("turn", [np.eye(3), Z_UP, Z_UP.T])
def test_forms_that_do_not_say_which_way_is_up(form, turn):
    assert not lies_on_its_side(form[0] @ turn.T, form[1])


def test_what_stands_on_its_head_is_not_called_upright_by_z():
    assert not lies_on_its_side(VASE[0] @ Z_UP, VASE[1])


def test_degenerate_meshes_say_nothing():
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 3], [1, 0, 3]])
    assert not lies_on_its_side(flat, np.array([[0, 1, 2], [1, 3, 2]]))
    assert not lies_on_its_side(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    line = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 3]])
    assert not lies_on_its_side(line, np.array([[0, 1, 2]]))


@pytest.mark.parametrize("name", ["spot", "stanford-bunny", "teapot", "armadillo"])
def test_known_meshes_stand(name):
    path = data(f"meshes/plain/{name}.obj")
    rows = [line.split() for line in path.read_text().splitlines()]
    points = np.array([row[1:4] for row in rows if row[:1] == ["v"]], float)
    faces = [[int(w.split("/")[0]) - 1 for w in row[1:]] for row in rows if row[:1] == ["f"]]
    fan = np.array([[f[0], f[k], f[k + 1]] for f in faces for k in range(1, len(f) - 1)])
    assert not lies_on_its_side(points, fan)


@pytest.mark.parametrize("name", ["demo", "robot"])
def test_our_own_meshes_stand(name):
    assert SIDEWAYS not in read_mesh(ROOT / "scenes" / f"{name}.obj").source.notes


def test_the_note_names_the_option_and_the_option_silences_it(tmp_path):
    points, faces = VASE
    path = tmp_path / "scan.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in points @ Z_UP.T] + ["f " + " ".join(str(k + 1) for k in f) for f in faces]
    path.write_text("\n".join(lines) + "\n")
    notes = read_mesh(path).source.notes
    assert notes.count(SIDEWAYS) == 1 and "--up z" in SIDEWAYS
    upright = read_mesh(path, up="z")
    assert SIDEWAYS not in upright.source.notes
    assert np.ptp(upright.mesh.positions, axis=0).argmax() == 1
