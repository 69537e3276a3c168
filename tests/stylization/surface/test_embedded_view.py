"""The weight-free stylizer one view at a time: the samples of a view, what is pinned, and the job that uses it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mistyle.core.asset import Picture
from mistyle.core.errors import EnvironmentMissing, InputRefused, UsageError
from mistyle.core.image import distance_to, linear_from_srgb, srgb_from_linear
from mistyle.core.mesh import Mesh
from mistyle.core.view import Prior, View
from mistyle.jobs.progress import Progress
from mistyle.stylization.mvst.settings import SweepSettings
from mistyle.stylization.mvst.sweep import ViewPainter, sweep
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.pipeline.job import Job
from mistyle.stylization.settings import resolve
from mistyle.stylization.surface import view_samples
from mistyle.stylization.surface.samples import GRID
from tests.stylization.mvst.test_mvst import disagreement
from tests.stylization.mvst.test_warp import at, see
from tests.stylization.test_pipeline import TINY, hashes, inputs, job
from tests.support.helpers import fixed_surface

__all__ = ["inputs"]
RADIUS = 0.9
SETTINGS = fixed_surface(samples=3000, stroke_scale=0.7)


def ball_mesh() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    positions, faces = ball.vertices.astype(np.float32), ball.faces.astype(np.int32)
    corners = (positions / RADIUS)[faces]
    nothing = np.zeros((len(faces), 3, 2), np.float32)
    return Mesh(positions, faces, corners, nothing, np.zeros(len(faces), np.int32), ("ball",))


def strokes(rng: np.random.Generator) -> np.ndarray:
    """A picture of slanted strokes in a few colours."""
    y, x = np.mgrid[:96, :128] / 6
    wave = np.sin(x + 2 * y + np.sin(y))[..., None]
    tone = 0.5 + 0.3 * wave * np.array([1.0, 0.6, -0.5]) + 0.04 * rng.normal(size=(96, 128, 3))
    return np.clip(tone, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def paint():
    """The stylizer of the ball."""
    from mistyle.stylization.surface.painter import stylizer

    style = Picture(strokes(np.random.default_rng(0)), None, Path("strokes.png"))
    return stylizer(ball_mesh(), style, SETTINGS, 0)


def ball(azimuth: float, size: int = 96) -> View:
    return see(at(azimuth, size=size), [(0.0, 0.0, 0.0, RADIUS)])


def test_every_cell_has_the_pixel_nearest_to_its_middle(rng):
    mask = rng.random((50, 37)) < 0.2
    for side in (1, 2, 5, 16):
        pixel, cell, (rows, columns) = view_samples.representatives(mask, side)
        assert (rows, columns) == (-(-50 // side), -(-37 // side)) and mask.reshape(-1)[pixel].all()
        y, x = pixel // 37, pixel % 37
        assert np.array_equal(y // side * columns + x // side, cell)
        for k in range(0, len(cell), 7):
            middle = np.array([cell[k] // columns, cell[k] % columns]) * side + (side - 1) / 2
            own = np.argwhere(mask)
            own = own[(own // side == (cell[k] // columns, cell[k] % columns)).all(axis=1)]
            assert np.hypot(y[k] - middle[0], x[k] - middle[1]) == pytest.approx(np.hypot(*(own - middle).T).min())


@pytest.mark.parametrize("degrees", [0, 90, 180, 45])
def test_tables_on_a_sheet_are_the_turned_grid(degrees):
    from mistyle.stylization.surface.samples import as_points

    pixel, cell, size = view_samples.representatives(np.ones((24, 24), bool), 2)
    positions = np.stack([pixel % 24 + 0.5, pixel // 24 + 0.5, np.zeros(len(pixel))], axis=1).astype(np.float32)
    angle = np.radians(degrees)
    tangent = np.tile(np.array([np.cos(angle), np.sin(angle), 0], np.float32), (len(pixel), 1))
    points = as_points(positions, np.broadcast_to(view_samples.TOWARDS, positions.shape), 2.0)
    depth = np.full(len(pixel), 4.0, np.float32)
    level = view_samples.flat_level(points, tangent, np.ones(len(pixel), np.float32), cell, size, depth, 100.0)
    assert np.abs(np.cross(tangent, view_samples.TOWARDS) - level.across).max() < 1e-6
    assert not level.turned.any()
    inner = (np.abs(positions[:, :2] - 12) < 4).all(axis=1)
    # A turned grid falls between cells: the nearest sample is at most half a cell off along each axis.
    off = np.abs(level.offsets[inner] + GRID)
    assert off.max() < (0.01 if degrees % 90 == 0 else 0.75)
    way = (positions[level.neighbours] - positions[:, None])[inner] / 2
    along = np.stack([way @ tangent[0], way @ level.across[0]], axis=-1)
    assert np.abs(along + level.offsets[inner]).max() < 1e-5


def test_neighbours_never_lie_across_a_depth_step():
    view = see(at(0, size=96), [(0.0, 0.0, 0.6, 0.3)], plane=-0.6)
    pixel, cell, size = view_samples.representatives(view.mask, 2)
    depth = view.depth.reshape(-1)[pixel]
    positions = view_samples.flat_positions(view, pixel)
    from mistyle.stylization.surface.samples import as_points

    points = as_points(positions, np.broadcast_to(view_samples.TOWARDS, positions.shape), 2.0)
    tangent = np.tile(np.array([1, 0, 0], np.float32), (len(pixel), 1))
    focal = view.camera.focal
    level = view_samples.flat_level(points, tangent, np.ones(len(pixel), np.float32), cell, size, depth, focal)
    near = depth < 3.9
    assert 20 < near.sum() < len(near) - 20
    assert np.array_equal(near[level.neighbours], np.broadcast_to(near[:, None], level.neighbours.shape))


def test_tangents_on_screen_are_those_that_are_seen(rng):
    view = ball(30)
    pixel = np.flatnonzero(view.mask)[::50]
    px = np.stack([pixel % 96, pixel // 96], axis=1) + 0.5
    from mistyle.core.camera import px_from_world, world_from_px

    depth = view.depth.reshape(-1)[pixel]
    points = world_from_px(view.camera, px, depth.astype(float))
    direction = rng.normal(size=(len(pixel), 3))
    seen = px_from_world(view.camera, points + 1e-5 * direction)[0] - px
    flat, _ = view_samples.on_screen(view, px, direction.astype(np.float32))
    assert np.abs(flat[:, :2] - seen / np.linalg.norm(seen, axis=1, keepdims=True)).max() < 2e-3
    assert not flat[:, 2].any()


def test_the_prior_is_kept_and_the_rest_goes_on_from_it(paint, rng):
    view = ball(30)
    first = paint(view, None, np.random.default_rng(0))
    assert np.isfinite(first).all() and not first[~view.mask].any()
    assert srgb_from_linear(first[view.mask]).std(axis=0).min() > 0.03
    half = view.mask & (np.arange(96) < 48)[None]
    prior = Prior(np.where(half[..., None], first, 0), half)
    second = paint(view, prior, np.random.default_rng(1))
    assert np.abs(second - first)[half].max() < 1e-4
    a, b = (srgb_from_linear(c) for c in (first, second))
    rest = view.mask & ~half
    assert np.abs(a - b)[rest].mean() > 0.01, "another generator paints other strokes"
    # Across the border colours differ no more than side by side elsewhere.
    row = slice(30, 66)
    across = np.abs(b[row, 48] - b[row, 47]).mean()
    beside = np.mean([np.abs(b[row, x + 1] - b[row, x]).mean() for x in range(36, 60) if x != 47])
    assert across < 2 * beside


def test_a_view_that_is_known_already_stays_as_it_is(paint):
    view = ball(30, 48)
    rgb = np.where(view.mask[..., None], linear_from_srgb(np.full(view.rgb.shape, 0.4, np.float32)), 0)
    assert np.abs(paint(view, Prior(rgb, view.mask), np.random.default_rng(0)) - rgb).max() < 1e-5


def test_the_same_generator_paints_the_same_and_an_empty_view_nothing(paint):
    view = ball(0, 48)
    one, two = (paint(view, None, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one, two)
    empty = replace(view, mask=np.zeros_like(view.mask), depth=np.full_like(view.depth, np.inf))
    assert not paint(empty, None, np.random.default_rng(0)).any()


def test_pins_are_means_of_known_pixels():
    view = ball(0, 48)
    known = view.mask & (np.indices((48, 48)).sum(axis=0) % 3 == 0)
    rgb = np.where(known[..., None], linear_from_srgb(np.full((48, 48, 3), 0.25, np.float32)), 0.9)
    pixel, cell, _ = view_samples.representatives(view.mask, 4)
    pins = view_samples.constrain(cell, 4, view, Prior(rgb.astype(np.float32), known))
    assert not pins.known[distance_to(~view.mask).reshape(-1)[pixel] > 6].any(), "a third is too little"
    everything = view_samples.constrain(cell, 4, view, Prior(rgb.astype(np.float32), view.mask))
    assert everything.known.all()
    assert everything.colour[:, 0].min() > pins.colour[pins.colour[:, 0] > 0, 0].max()


def test_a_sweep_agrees_where_single_views_do_not(paint):
    views = [ball(30, 64), ball(60, 64)]
    alone = sweep(views, ViewPainter(lambda v, p, rng: paint(v, None, rng), keeps_outlines=True), SweepSettings(), 0)
    together = sweep(views, ViewPainter(paint, keeps_outlines=True), SweepSettings(), 0)
    assert disagreement(list(together.views)) < 0.6 * disagreement(list(alone.views))


def by_view(inputs, out, **more) -> Job:
    few = {"rig": {"kind": "turntable", "views": 3, "resolution": 48}, "fit": TINY["fit"] | {"refine": "off"}}
    few |= {"surface": {"samples": 1000}, "report": {"detail": "none"}}
    chosen = resolve("draft", None, TINY | few | {"stylizer": "embedded-view"} | more, {})
    return replace(job(inputs, out), settings=chosen)


def test_the_job_with_this_stylizer_and_its_resumption(inputs, tmp_path, monkeypatch):
    """Killed in the third view, run again: only the rest is painted, and every file ends with the same bytes."""
    from mistyle.stylization.surface import painter as embedded_view

    pipeline.stylize(by_view(inputs, tmp_path / "whole"), Progress(quiet=True))
    painted = []
    make = embedded_view.stylizer

    def killed(*given, **named):
        stylizer = make(*given, **named)

        def paint(view, prior, rng):
            if len(painted) == 2:
                raise KeyboardInterrupt
            painted.append(view.camera.name)
            return stylizer(view, prior, rng)

        return paint

    with monkeypatch.context() as patch:
        patch.setattr(embedded_view, "stylizer", killed)
        with pytest.raises(KeyboardInterrupt):
            pipeline.stylize(by_view(inputs, tmp_path / "again"), Progress(quiet=True))
    assert len(list((tmp_path / "again" / "work" / "sweep").glob("*.npz"))) == 2
    painted[:] = ["none of these counts"] * 3
    with monkeypatch.context() as patch:
        patch.setattr(embedded_view, "stylizer", killed)
        pipeline.stylize(by_view(inputs, tmp_path / "again"), Progress(quiet=True))
    assert len(painted) == 3 + 1
    assert not (tmp_path / "again" / "work" / "sweep").exists()
    assert hashes(tmp_path / "again") == hashes(tmp_path / "whole")


def test_what_it_cannot_follow_is_refused(inputs, tmp_path):
    with pytest.raises(UsageError, match="paint.height"):
        pipeline.stylize(by_view(inputs, tmp_path, paint={"height": 0.2}), Progress(quiet=True))
    absent = {"segmenter": str(tmp_path / "absent.onnx")}
    with pytest.raises((InputRefused, EnvironmentMissing)):
        pipeline.stylize(by_view(inputs, tmp_path, sweep=absent), Progress(quiet=True))
    assert not list(tmp_path.iterdir())
