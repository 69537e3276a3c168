"""The demo's robot, mosaic, ink drawing and pixel art: what the files hold, and that the scripts made them."""

import importlib

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, label, zoom

from tests.support.helpers import ROOT

SCENES = ROOT / "scenes"


@pytest.fixture
def scripts(monkeypatch):
    """The modules beside the scenes."""
    monkeypatch.syspath_prepend(str(SCENES))
    return lambda name: importlib.import_module(name)


def picture(name: str) -> np.ndarray:
    with Image.open(SCENES / name) as opened:
        return np.asarray(opened.convert("RGB"))


def test_the_files_are_small():
    names = ["robot.obj", "robot.mtl", "demo_mosaic.jpg", "demo_hatched.png", "demo_pixel.png"]
    assert sum((SCENES / name).stat().st_size for name in names) <= 1_500_000
    for name in names[2:]:
        assert max(picture(name).shape) == 1024
    assert (SCENES / "demo_overview.jpg").stat().st_size <= 250_000


def test_every_part_of_the_robot_is_closed_and_right_side_out(scripts):
    shells = scripts("robot").shells()
    assert len(shells) > 40
    for points, faces in shells:
        directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        edges = set(map(tuple, directed.tolist()))
        assert len(edges) == len(directed) and all((b, a) in edges for a, b in edges)
        a, b, c = (points[faces[:, k]] for k in range(3))
        assert (np.cross(a, b) * c).sum() > 0
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-9


def test_the_robots_file_is_the_scripts_form_and_its_uvs_are_kept(scripts):
    from mistyle.io.read_mesh import read_mesh

    points, faces, normals = scripts("robot").robot()
    rows = [line.split() for line in (SCENES / "robot.obj").read_text(encoding="ascii").splitlines()]
    v, vn = (np.array([row[1:] for row in rows if row[0] == kind], float) for kind in ("v", "vn"))
    assert np.allclose(v, points, atol=1e-5) and np.allclose(vn, normals, atol=1e-4)
    asset = read_mesh(SCENES / "robot.obj")
    assert asset.source.uv == "kept" and not asset.source.notes and asset.mesh.parts == ("robot",)
    assert np.array_equal(asset.mesh.faces, faces) and 5_000 < len(faces) < 15_000
    uv = asset.mesh.corner_uvs
    e, f = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]) / 2
    assert uv.min() >= 0 and uv.max() <= 1 and (area > 0).all() and area.sum() > 0.4
    assert abs(points[:, 1].min()) < 1e-9


def test_flat_sides_of_a_box_have_flat_normals(scripts):
    robot = scripts("robot")
    points, faces = robot.box((0.3, 0.2, 0.1), 0.04)
    assert np.allclose(np.ptp(points, axis=0), [0.6, 0.4, 0.2])
    normals = robot.normals(points, faces)
    corner = np.isclose(points[:, 1], 0.2) & (np.abs(points[:, 0]) < 0.27) & (np.abs(points[:, 2]) < 0.07)
    assert corner.any() and (normals[corner] @ [0, 1, 0] > np.cos(np.radians(12))).all()


def test_pixel_art_has_whole_cells_of_one_palette(scripts):
    pixels = scripts("pixels")
    shown = picture("demo_pixel.png")
    scale = pixels.SCALE
    cells = shown[::scale, ::scale]
    assert np.array_equal(np.kron(cells, np.ones((scale, scale, 1), np.uint8)), shown)
    assert np.array_equal(shown, pixels.painting())
    colours = np.unique(shown.reshape(-1, 3), axis=0)
    assert 12 <= len(colours) <= len(pixels.PALETTE)
    drawn = pixels.picture(16)
    assert drawn.shape == pixels.CELLS and (drawn > 0).all(), "no cell is left see-through"


def test_sprites_are_stamped_where_they_are_not_see_through(scripts):
    pixels = scripts("pixels")
    board = np.zeros((6, 6), int)
    pixels.stamp(board, "w.\nkk\n", row=3, column=4)
    assert board[3, 4:].tolist() == [1 * pixels.NAMES.index("k")] * 2 and board[2, 4] == pixels.NAMES.index("w")
    assert np.count_nonzero(board) == 3
    pixels.stamp(board, "w.\nkk\n", row=0, column=5)  # half outside
    assert np.count_nonzero(board) == 4


def test_the_mosaic_has_stones_of_one_size_between_mortar(scripts):
    mosaic, paint = scripts("mosaic"), scripts("paint")
    shown = paint.oklab_from_srgb(picture("demo_mosaic.jpg") / 255)
    mortar = paint.oklab_from_srgb(scripts("sunset").hexa("#8b8171"))
    stone = np.linalg.norm(gaussian_filter(shown, (0.5, 0.5, 0)) - mortar, axis=-1) > 0.07
    which, count = label(stone)
    sizes = np.bincount(which.ravel())[1:]
    whole = sizes[sizes > 60]
    assert 0.6 < stone.mean() < 0.95
    assert 1000 < len(whole) < 3500
    assert 0.5 < np.median(whole) / (mosaic.STONE - mosaic.MORTAR) ** 2 < 1.2


def test_the_mosaic_is_the_scripts_composition(scripts):
    mosaic, paint = scripts("mosaic"), scripts("paint")
    size = (208, 256)
    plan = mosaic.compose(size, 547)
    shown = zoom(picture("demo_mosaic.jpg") / 255, (208 / 832, 256 / 1024, 1), order=1)
    blurred = [gaussian_filter(x, (6, 6, 0)).ravel() for x in (paint.srgb_from_oklab(plan.colour), shown)]
    assert np.corrcoef(*blurred)[0, 1] > 0.85


def test_a_stone_keeps_to_its_region(scripts, rng):
    """Two regions side by side: no pixel takes a stone of the other one, and the nearest one wins."""
    mosaic = scripts("mosaic")
    stones = np.array([[5.0, 5], [15, 5], [25, 5], [35, 5], [5, 15], [15, 15], [25, 15], [35, 15], [5, 25], [35, 25]])
    region = (stones[:, 0] > 20).astype(int)
    points = rng.uniform(0, 40, (500, 2)) * [1, 0.7]
    own = (points[:, 0] > 20).astype(int)
    which, first, second = mosaic.nearest(points, stones, np.zeros(len(stones)), own, region)
    assert (region[which] == own).all() and (first <= second).all()
    near = np.abs(points - stones[which]).max(axis=1)
    assert np.allclose(first, near), "the distance is the maximum norm"


def test_the_drawing_is_ink_on_paper_and_follows_the_light(scripts):
    """Two tones far apart; where the scene is darker more ink lies."""
    hatched = scripts("hatched")
    shown = picture("demo_hatched.png").mean(axis=2) / 255
    paper, ink = (scripts("sunset").hexa(code).mean() for code in (hatched.PAPER, hatched.INK))
    middle = (shown > ink + 0.3 * (paper - ink)) & (shown < paper - 0.3 * (paper - ink))
    assert middle.mean() < 0.2
    size = (104, 128)
    seen = hatched.traced(size)
    tone = gaussian_filter(seen.tone, 2)
    amount = zoom(gaussian_filter(shown, 12), (104 / 832, 128 / 1024), order=1)
    assert np.corrcoef(tone.ravel(), amount.ravel())[0, 1] > 0.7
    assert len(np.unique(seen.thing)) >= 8, "every thing is in sight"


def test_lines_of_one_layer_keep_their_distance(scripts):
    hatched = scripts("hatched")
    hatch = hatched.Hatch(apart=8.0, pen=1.0, turned=0, tone=0.9, longest=60)
    thing, angle = np.zeros((60, 80), int), np.zeros((60, 80))
    taken, lines = hatched.Taken((60, 80), hatch.apart), []
    for y in np.arange(2.5, 58, 1.0):
        start = (40.5, y)
        if taken.free(*start, hatch.apart):
            line = hatched.streamline(start, angle, thing, np.ones((60, 80), bool), taken, hatch)
            taken.take(line)
            lines.append(np.array(line))
    rows = np.array([line[:, 1].mean() for line in lines])
    assert len(lines) >= 5 and np.diff(rows).min() > hatch.apart - 1e-9
    assert all(50 < np.ptp(line[:, 0]) <= hatch.longest for line in lines)


@pytest.mark.parametrize("name", ["mosaic", "hatched"])
def test_equal_seeds_make_equal_pictures(scripts, name):
    module = scripts(name)
    first, again, other = (module.painting((104, 128), seed) for seed in (5, 5, 6))
    assert np.array_equal(first, again) and (first != other).any()


def test_the_lamp_of_the_readmes_picture_is_where_it_is_said_to_be(scripts):
    from mistyle.core.light import environment_directions

    sky = scripts("overview").lamp_map(90.0)
    towards = environment_directions(*sky.shape[:2])[np.unravel_index(sky[..., 0].argmax(), sky.shape[:2])]
    assert np.allclose(towards, [np.cos(np.radians(35)), np.sin(np.radians(35)), 0], atol=0.05)
