"""Carrying views into other views, against scenes whose pictures are known in closed form from any side."""

from dataclasses import replace

import numpy as np
import pytest

from mistyle.core.camera import Camera, look_at, orbit, pixel_centres, px_from_world, world_from_px
from mistyle.core.image import dilate, distance_to
from mistyle.core.view import View
from mistyle.stylization.mvst import warp as warp_module
from mistyle.stylization.mvst.lift import depth_tolerance, discontinuities
from mistyle.stylization.mvst.settings import WarpSettings
from mistyle.stylization.mvst.warp import angle, composite, lift, splat

BALL = (0.0, 0.0, 0.0, 0.9)
BARE = WarpSettings(fill=0, erosion=0, facing=0.0, sharpness=0.0, look_up=False)  # the scatter alone


def warp(source, view, settings):
    """One finished view as a prior for another."""
    return composite([source], view, settings)


def colours(points: np.ndarray) -> np.ndarray:
    """Smooth, and different everywhere: nothing is its own mirror image."""
    return (0.5 + 0.4 * np.sin(points * np.array([5, 7, 9]) + np.arange(3))).astype(np.float32)


def see(camera: Camera, balls=(), plane: float | None = None, paint=None, fine: int = 1) -> View:
    """Spheres (x, y, z, r) and the plane z = `plane` seen by a camera; `paint(points, which)` colours them (-1: plane).

    With `fine` the colour and coverage are means over fine x fine rays, as a renderer's are; depth and mask are those
    of the pixel centre.
    """
    paint = paint or (lambda points, which: colours(points))
    height, width = camera.size

    def cast(px: np.ndarray):
        rays = np.concatenate([(px - camera.centre) / camera.focal, np.ones((*px.shape[:-1], 1))], axis=-1)
        rays = rays @ camera.world_from_cam[:3, :3].T
        depth, which = np.full(px.shape[:-1], np.inf), np.full(px.shape[:-1], -2)
        normal = np.zeros((*px.shape[:-1], 3))
        for k, (x, y, z, r) in enumerate(balls):
            away = camera.position - np.array([x, y, z])
            a, b, c = (rays**2).sum(axis=-1), rays @ away, away @ away - r * r
            under = b * b - a * c
            t = np.where(under > 0, (-b - np.sqrt(np.maximum(under, 0))) / a, np.inf)
            at = t < depth
            depth, which = np.where(at, t, depth), np.where(at, k, which)
            normal[at] = (away + rays[at] * t[at][:, None]) / r
        if plane is not None:
            with np.errstate(divide="ignore"):
                t = (plane - camera.position[2]) / rays[..., 2]
            there = camera.position + rays * np.where(np.isfinite(t), t, 0)[..., None]
            at = (t > 0) & (t < depth) & (np.abs(there[..., :2]) < 1.5).all(axis=-1)
            depth, which = np.where(at, t, depth), np.where(at, -1, which)
            normal[at] = (0, 0, 1)
        hit = np.isfinite(depth)
        rgb = np.zeros((*px.shape[:-1], 3), np.float32)
        rgb[hit] = paint((camera.position + rays * np.where(hit, depth, 0)[..., None])[hit], which[hit])
        return rgb, depth.astype(np.float32), normal.astype(np.float32), hit

    rgb, depth, normal, mask = cast(pixel_centres(camera.size))
    coverage = mask.astype(np.float32)
    if fine > 1:
        px = pixel_centres((height * fine, width * fine)) / fine
        many, _, _, hit = cast(px)
        rgb = many.reshape(height, fine, width, fine, 3).mean(axis=(1, 3))
        coverage = hit.reshape(height, fine, width, fine).mean(axis=(1, 3), dtype=np.float32)
    nothing = np.zeros((*camera.size, 2), np.float32)
    return View(camera, rgb, depth, normal, nothing, np.where(mask, 0, -1).astype(np.int32), mask, coverage)


def at(azimuth: float, elevation: float = 0.0, size: int = 96) -> Camera:
    return orbit(azimuth, elevation, distance=4.0, fov=30.0, size=(size, size))


def rolled(camera: Camera, degrees: float) -> Camera:
    """The camera turned about its own axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return replace(camera, world_from_cam=camera.world_from_cam @ turn)


def plain_scatter(view: View, camera: Camera):
    """The paper's scatter as it is written, pixel after pixel from far to near: colours and depths that win."""
    pixels = view.mask
    points = world_from_px(view.camera, pixel_centres(view.camera.size)[pixels], view.depth[pixels].astype(float))
    px, z = px_from_world(camera, points)
    rgb, depth = np.zeros((*camera.size, 3), np.float32), np.full(camera.size, np.inf, np.float32)
    colour = view.rgb[pixels]
    for n in np.argsort(-z, kind="stable"):
        column, row = (int(v) for v in np.floor(px[n]))
        if z[n] > 0 and 0 <= row < camera.size[0] and 0 <= column < camera.size[1]:
            rgb[row, column], depth[row, column] = colour[n], z[n]
    return rgb, depth


def test_a_view_carried_into_itself_is_itself():
    view = see(at(30), [BALL])
    prior = warp(lift(view, BARE), view, BARE)
    assert prior.known.sum() > 0.9 * view.mask.sum()
    assert np.array_equal(prior.rgb[prior.known], view.rgb[prior.known])
    assert not prior.rgb[~prior.known].any()


@pytest.mark.parametrize("roll", [0.0, 90.0, 180.0, 37.0])
def test_a_plane_lands_where_the_renderer_sees_it(roll):
    """On a linear ramp the mean error is the mean shift in pixels: half a pixel would show twenty times over.

    The target has four pixels for each of the source's, so that no two points meet in one and the nearer, which lies to
    one side on a tilted plane, never wins.
    """
    ramp = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    paint = lambda points, which: (0.5 + 0.3 * points @ ramp).astype(np.float32)  # noqa: E731
    source = see(at(0), plane=0.0, paint=paint)
    target = see(rolled(look_at((1.2, 0.9, 3.6), fov=30.0, size=(192, 192)), roll), plane=0.0, paint=paint)
    prior = warp(lift(source, BARE), target, BARE)
    assert prior.known.sum() > 0.1 * target.mask.sum()
    pixel = 0.3 * 4.0 / target.camera.focal
    error = (prior.rgb - target.rgb)[prior.known][:, :2] / pixel
    assert np.abs(error.mean(axis=0)).max() < 0.025
    assert np.abs(error).max() < 0.9


def test_a_ball_is_carried_without_mirroring_and_only_where_both_see_it():
    source, target = see(at(0), [BALL]), see(at(40, 25), [BALL])
    settings = WarpSettings(erosion=0, sharpness=0.0)
    prior = warp(lift(source, settings), target, settings)
    points = world_from_px(
        target.camera, pixel_centres((96, 96)), np.where(target.mask, target.depth, 1.0).astype(float)
    )
    ray = source.camera.position - points
    facing = (points / 0.9 * ray).sum(axis=-1) / np.linalg.norm(ray, axis=-1)
    error, scattered = (
        np.abs(warp(lift(source, s), target, s).rgb - target.rgb)[prior.known].mean()
        for s in (settings, settings.model_copy(update={"look_up": False}))
    )
    assert scattered < 0.02 and error < 0.5 * scattered
    mirrored = np.abs(prior.rgb[:, ::-1] - target.rgb)[prior.known & prior.known[:, ::-1]].mean()
    assert mirrored > 0.1
    assert (prior.known & (facing < 0.05)).sum() == 0
    assert prior.known[target.mask & (facing > 0.35)].mean() > 0.99


def test_the_scatter_is_the_plain_one():
    """Where the pixel's nearest point is of the surface the pixel shows, both give the same colour, bit for bit."""
    balls = [(0.0, 0.1, 0.0, 0.6), (0.5, 0.2, 0.6, 0.25), (-0.5, -0.3, 0.4, 0.3)]
    source, target = see(at(20, size=64), balls, plane=-0.9), see(at(-15, 20, size=64), balls, plane=-0.9)
    lifted = lift(source, BARE)
    whole = replace(source, mask=source.mask & ~discontinuities(source, BARE))
    rgb, depth = plain_scatter(whole, target.camera)
    tolerance = depth_tolerance(target.camera, depth, BARE)
    with np.errstate(invalid="ignore"):
        agree = np.isfinite(depth) & (np.abs(depth - target.depth) <= tolerance * 0.999)
    prior = warp(lifted, target, BARE)
    assert agree.sum() > 1000
    assert prior.known[agree].all()
    assert np.array_equal(prior.rgb[agree], rgb[agree])
    assert not prior.known[~np.isfinite(depth)].any()


def red_and_green(points: np.ndarray, which: np.ndarray) -> np.ndarray:
    return np.where((which >= 0)[:, None], [0.9, 0.0, 0.0], [0.0, 0.9, 0.0]).astype(np.float32)


@pytest.mark.parametrize("erosion", [0, 20])
def test_an_occluder_never_leaks_its_colour(erosion):
    """A red ball before a green plane, edges mixed as a renderer's are: no red on the plane, no green on the ball."""
    ball = (0.0, 0.0, 0.5, 0.4)
    settings = WarpSettings(erosion=erosion)
    for azimuth, elevation in ((35, 0), (-25, 30), (10, -40)):
        source = see(at(0), [ball], plane=-0.5, paint=red_and_green, fine=4)
        target = see(at(azimuth, elevation), [ball], plane=-0.5, paint=red_and_green)
        prior = warp(lift(source, settings), target, settings)
        on_ball = target.rgb[..., 0] > 0.5
        assert (prior.known & on_ball).sum() > 100 and (prior.known & ~on_ball).sum() > 500
        assert prior.rgb[prior.known & ~on_ball][:, 0].max() == 0
        assert prior.rgb[prior.known & on_ball][:, 1].max() == 0


def test_the_far_side_does_not_show_through_the_gaps_of_the_near_one():
    """Four times nearer, most pixels of the ball's picture are gaps: no point of the plane behind may fill them."""
    ball = (0.0, 0.0, 0.5, 0.4)
    source = see(at(0, size=48), [ball], plane=-0.5, paint=red_and_green)
    target = see(at(0, size=192), [ball], plane=-0.5, paint=red_and_green)
    prior = warp(lift(source, BARE), target, BARE)
    on_ball = target.rgb[..., 0] > 0.5
    assert 0.01 < prior.known[on_ball].mean() < 0.1
    assert prior.rgb[prior.known & on_ball][:, 1].max() == 0


def test_holes_take_the_nearest_colour_of_their_own_surface_up_to_three_pixels():
    source, target = see(at(0, size=48), [BALL], plane=-0.95), see(at(0, size=192), [BALL], plane=-0.95)
    bare = warp(lift(source, BARE), target, BARE)
    filled = warp(lift(source, BARE), target, BARE.model_copy(update={"fill": 3}))
    inner = target.mask & (distance_to(~target.mask) > 12) & ~dilate(discontinuities(target, BARE), 12)
    assert bare.known[inner].mean() < 0.1 and filled.known[inner].mean() > 0.999
    assert np.array_equal(filled.rgb[bare.known], bare.rgb[bare.known])
    new = filled.known & ~bare.known
    assert distance_to(bare.known)[new].max() <= 3 * np.sqrt(2) + 1e-6
    away, own = np.argwhere(new)[::97], np.argwhere(bare.known)
    for row, column in away:
        distance = np.hypot(*(own - (row, column)).T)
        candidates = bare.rgb[tuple(own[distance <= distance.min() + 1e-9].T)]
        assert (np.abs(candidates - filled.rgb[row, column]).max(axis=1) == 0).any() or distance.min() > 2


def test_erosion_cuts_beside_shadows_only_along_the_line_to_the_source_and_no_farther():
    ball = (0.0, 0.0, 0.5, 0.4)
    source, target = see(at(0, size=256), [ball], plane=-0.5), see(at(35, size=256), [ball], plane=-0.5)
    whole, cut = (WarpSettings(erosion=k, sharpness=0.0) for k in (0, 20))
    before = warp(lift(source, whole), target, whole).known
    after = warp(lift(source, cut), target, cut).known
    removed = before & ~after
    reach = 20 * 256 / 1024
    assert (after <= before).all() and removed.sum() > 200
    assert distance_to(~before)[removed].max() <= reach * np.sqrt(2) + 1.5
    # The source stands to the left: whatever its shadow is, it lies to the right of the ball; the left rim stays.
    on_ball = target.depth < 3.6
    middle = range(110, 146)
    left_edge = [np.flatnonzero(before[r] & on_ball[r]).min() for r in middle]
    assert not any(removed[r, c : c + 8].any() for r, c in zip(middle, left_edge, strict=True))
    right_edge = [np.flatnonzero(before[r] & on_ball[r]).max() for r in middle]
    assert all(removed[r, c] for r, c in zip(middle, right_edge, strict=True))


def test_erosion_leaves_a_surface_without_occluders_alone():
    """The frame of the source cuts through the plane: an edge, but no depth discontinuity."""
    source = see(look_at((0.9, 0, 2.0), (0.9, 0, 0), fov=30.0, size=(96, 96)), plane=0.0)
    target = see(at(0), plane=0.0)
    near = warp(lift(source, WarpSettings(erosion=0)), target, WarpSettings(erosion=0)).known
    settings = WarpSettings(erosion=200)
    assert 0.05 < near[target.mask].mean() < 0.9
    assert np.array_equal(warp(lift(source, settings), target, settings).known, near)


def test_directions_away_from_the_source_are_those_in_which_points_move(rng):
    source, target = at(0), at(70, 20)
    points = rng.uniform(-0.8, 0.8, (50, 3))
    ray = points - source.position
    px = px_from_world(target, points)[0]
    moved = px_from_world(target, points + 1e-6 * ray)[0] - px
    expected = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    assert np.abs(warp_module._away_from(source, target, px) - expected).max() < 1e-4


def test_the_nearest_view_wins_and_others_only_add():
    views = [replace(see(at(a), [BALL]), rgb=np.full((96, 96, 3), a / 100, np.float32)) for a in (60, 10, 90)]
    target = see(at(30), [BALL])
    settings = WarpSettings(erosion=0, sharpness=0.0)
    lifted = [lift(v, settings) for v in views]
    prior = composite(lifted, target, settings)
    by_distance = sorted(range(3), key=lambda k: angle(views[k].camera, target.camera))
    assert by_distance == [1, 0, 2]
    taken = np.zeros(target.mask.shape, bool)
    for k in by_distance:
        known = splat(lifted[k], target, settings)[1]
        assert np.abs(prior.rgb[known & ~taken] - views[k].camera.azimuth / 100).max(initial=0) < 1e-5
        taken |= known
    assert np.array_equal(prior.known, taken)


def test_angles_between_cameras():
    assert angle(at(30), at(75)) == pytest.approx(np.radians(45))
    assert angle(at(30), at(30, 89)) == pytest.approx(np.radians(89))
    assert angle(at(0), at(0)) == 0


def test_what_a_source_saw_much_more_flatly_is_not_carried():
    source, target = see(at(0), [BALL]), see(at(60), [BALL])
    points = world_from_px(
        target.camera, pixel_centres((96, 96)), np.where(target.mask, target.depth, 1.0).astype(float)
    )

    def cosine(view: View) -> np.ndarray:
        ray = view.camera.position - points
        return np.abs((points / 0.9 * ray).sum(axis=-1)) / np.linalg.norm(ray, axis=-1)

    everything, sharp = (WarpSettings(erosion=0, facing=0.0, sharpness=k) for k in (0.0, 0.5))
    before, after = (warp(lift(source, s), target, s).known for s in (everything, sharp))
    ratio = cosine(source) / np.maximum(cosine(target), 1e-3)
    assert (after <= before).all()
    assert (before & (ratio < 0.35)).sum() > 50 and not (after & (ratio < 0.35)).any()
    assert np.array_equal(after & (ratio > 0.65), before & (ratio > 0.65))


def test_nothing_is_carried_off_a_mask_or_from_pixels_of_mixed_colour():
    view = see(at(0), [BALL], fine=4)
    half = view.mask.copy()
    half[:, :48] = False
    lifted = lift(view, BARE, half)
    assert (px_from_world(view.camera, lifted.points.T.astype(float))[0][:, 0] > 48).all()
    mixed = view.mask & (view.coverage < 0.99)
    assert mixed.sum() > 10
    assert lifted.points.shape[1] <= (half & ~mixed).sum()
    nothing = replace(view, mask=np.zeros_like(view.mask))
    assert not warp(lift(nothing, BARE), view, BARE).known.any()
