"""Baking views into the atlas, with views traced here in numpy, so that nothing is shared with the renderer."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas import bake as stage
from mistyle.atlas.bake import Backprojection, backproject, fill, pure_colours
from mistyle.atlas.settings import BakeSettings
from mistyle.atlas.texels import rasterise
from mistyle.core.camera import Camera, look_at, orbit, pixel_centres, px_from_world, rig
from mistyle.core.image import bilinear, linear_from_srgb
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from tests.support.helpers import data

SETTINGS = BakeSettings()
Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (points (n 3), uvs (n 2)) -> rgb (n 3)


def quads(*squares: np.ndarray, uv_boxes: list[tuple[float, float, float, float]] | None = None) -> Mesh:
    """One island per square; corners counter-clockwise from the front, u along the first side, v along the last."""
    count = len(squares)
    side = int(np.ceil(np.sqrt(count)))
    boxes = uv_boxes or [
        ((k % side + 0.05) / side, (k // side + 0.05) / side, (k % side + 0.95) / side, (k // side + 0.95) / side)
        for k in range(count)
    ]
    uvs = np.array([[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in boxes], np.float32)
    order = np.array([[0, 1, 2], [0, 2, 3]])
    positions = np.concatenate(squares).astype(np.float32)
    faces = np.concatenate([order + 4 * k for k in range(count)])
    front = [np.cross(s[1] - s[0], s[3] - s[0]) for s in squares]
    normals = np.repeat([n / np.linalg.norm(n) for n in front], 6, axis=0).reshape(-1, 3, 3).astype(np.float32)
    return Mesh(positions, faces, normals, uvs.reshape(-1, 2)[faces], np.zeros(len(faces), np.int32), ("part",))


def square(half: float, z: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """A square in the plane z that faces +Z."""
    return np.array(
        [[x - half, y - half, z], [x + half, y - half, z], [x + half, y + half, z], [x - half, y + half, z]]
    )


def box(half: float) -> Mesh:
    """A closed box, six islands."""
    front = square(half, half)
    turns = [
        np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]) for a in np.arange(4) * np.pi / 2
    ]
    tilts = [np.array([[1, 0, 0], [0, 0, s], [0, -s, 0]]) for s in (1, -1)]
    return quads(*(front @ m.T for m in turns + tilts))


def trace(mesh: Mesh, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Distance (in lengths of the ray), face and barycentric coordinates of the first hit, by brute force."""
    best = np.full(len(rays), np.inf)
    face, b1, b2 = np.full(len(rays), -1), np.zeros(len(rays)), np.zeros(len(rays))
    for k, corners in enumerate(mesh.positions[mesh.faces].astype(np.float64)):
        a, e1, e2 = corners[0], corners[1] - corners[0], corners[2] - corners[0]
        p = np.cross(rays, e2)
        det = p @ e1
        inverse = np.where(np.abs(det) > 1e-12, 1 / np.where(det == 0, 1, det), 0)
        u = p @ (origin - a) * inverse
        q = np.cross(origin - a, e1)
        v = rays @ q * inverse
        t = (q @ e2) * inverse
        hit = (inverse != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (t < best)
        best, face = np.where(hit, t, best), np.where(hit, k, face)
        b1, b2 = np.where(hit, u, b1), np.where(hit, v, b2)
    return best, face, b1, b2


def see(mesh: Mesh, camera: Camera, paint: Paint, fine: int = 1) -> View:
    """The view of a camera, unlit; with fine > 1 every pixel's colour is the mean of fine² rays, black for those that
    miss, as an antialiasing renderer has it. Depth and mask belong to the pixel's centre."""
    height, width = camera.size
    centres = pixel_centres(camera.size)

    def rays(px: np.ndarray) -> np.ndarray:
        local = (px - np.asarray(camera.centre)) / camera.focal
        return np.concatenate([local, np.ones((len(local), 1))], axis=1) @ camera.world_from_cam[:3, :3].T

    def colours(px: np.ndarray) -> tuple[np.ndarray, ...]:
        directions = rays(px)
        t, face, b1, b2 = trace(mesh, camera.position, directions)
        hit = face >= 0
        weights = np.stack([1 - b1 - b2, b1, b2], axis=1)[:, :, None]
        uv = (mesh.corner_uvs[face] * weights).sum(axis=1)
        rgb = np.zeros((len(px), 3))
        rgb[hit] = paint((camera.position + directions * np.where(hit, t, 0)[:, None])[hit], uv[hit])
        return t, face, uv, rgb

    depth, face, uv, rgb = colours(centres.reshape(-1, 2))
    hit = face >= 0
    coverage = hit.astype(float)
    if fine > 1:
        steps = (np.arange(fine) + 0.5) / fine - 0.5
        passes = [colours((centres + [dx, dy]).reshape(-1, 2)) for dx in steps for dy in steps]
        rgb = np.mean([p[3] for p in passes], axis=0)
        coverage = np.mean([p[1] >= 0 for p in passes], axis=0)
    normal = np.where(hit[:, None], mesh.corner_normals[face, 0], 0)

    def image(values: np.ndarray, kind: type = np.float32) -> np.ndarray:
        return values.reshape(height, width, *values.shape[1:]).astype(kind)

    return View(
        camera=camera,
        rgb=image(rgb),
        depth=image(depth),
        normal=image(normal),
        uv=image(np.where(hit[:, None], uv, 0)),
        part=image(np.where(hit, 0, -1), np.int32),
        mask=image(hit, bool),
        coverage=image(coverage),
    )


def front(size: int = 64, distance: float = 4.0) -> Camera:
    return look_at((0, 0, distance), fov=30, size=(size, size))


def smooth(points: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    return 0.5 + 0.4 * np.sin(3 * points + np.arange(3))


def test_a_plane_facing_the_camera_takes_its_colours_exactly():
    # Colour linear in position is linear in pixels on a plane that faces the camera, and bilinear look-up keeps it.
    mesh = quads(square(0.9, 0.0), uv_boxes=[(0, 0, 1, 1)])
    slope = np.array([[0.3, 0.1, -0.2], [-0.1, 0.4, 0.2], [0, 0, 0]])
    view = see(mesh, front(), lambda p, uv: p @ slope + 0.5)
    texels = rasterise(mesh, 0, 48)
    baked = backproject([view], texels, SETTINGS, mesh=mesh)
    # Between the outermost pixel centres nothing is renormalised; one pixel is 0.034 wide.
    inner = (np.abs(texels.position[..., :2]) < 0.86).all(axis=-1)
    assert baked.known.all()
    assert np.abs(baked.albedo - (texels.position @ slope + 0.5))[inner].max() < 1e-5


def test_colours_are_bilinear_between_pixel_centres(rng):
    mesh = quads(square(1.3, 0.0), uv_boxes=[(0, 0, 1, 1)])  # fills the frame
    view = see(mesh, front(24), smooth)
    noise = replace(view, rgb=rng.random((24, 24, 3)).astype(np.float32))
    texels = rasterise(mesh, 0, 64)
    baked = backproject([noise], texels, SETTINGS)
    px, _ = px_from_world(noise.camera, texels.position[baked.known].astype(float))
    inner = ((px > 0.5) & (px < 23.5)).all(axis=1)
    assert inner.sum() > 1500
    assert np.abs(baked.albedo[baked.known] - bilinear(noise.rgb, px))[inner].max() < 1e-4


def test_a_tilted_plane_agrees_to_second_order():
    mesh = quads(square(0.9, 0.0) @ np.array([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]), uv_boxes=[(0, 0, 1, 1)])
    texels = rasterise(mesh, 0, 48)
    inner = (slice(3, -3), slice(3, -3))
    errors = []
    for size in (64, 128):
        baked = backproject([see(mesh, front(size), smooth)], texels, SETTINGS, mesh=mesh)
        errors.append(np.abs(baked.albedo - smooth(texels.position, texels.position))[inner].mean())
    # Bilinear interpolation errs by curvature x pixel² / 8 along each axis: 0.4 x 9 x (0.034 / 0.6)² / 4 at most.
    assert errors[0] < 0.4 * 9 * (0.034 / 0.6) ** 2 / 4
    assert 3.0 < errors[0] / errors[1] < 5.0


def letter_f() -> np.ndarray:
    """A picture that no flip and no turn leaves alike, row 0 on top."""
    picture = np.full((32, 32, 3), (0.1, 0.2, 0.6), np.float32)
    picture[4:28, 8:12] = picture[4:8, 8:24] = picture[14:18, 8:20] = (0.9, 0.8, 0.1)
    picture[:, :, 0] *= np.linspace(0.6, 1, 32)
    return picture


def test_an_asymmetric_texture_survives_being_seen_and_baked():
    mesh = quads(square(0.9, 0.0), uv_boxes=[(0, 0, 1, 1)])
    texture = letter_f()
    view = see(mesh, front(256), lambda p, uv: bilinear(texture, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1) * 32))
    baked = backproject([view], rasterise(mesh, 0, 32), SETTINGS, mesh=mesh)

    def psnr(other: np.ndarray) -> float:
        return float(-10 * np.log10(np.mean((baked.albedo - other) ** 2)))

    turned = [np.rot90(texture, k)[:, ::flip] for k in range(4) for flip in (1, -1)]
    assert psnr(texture) > 35
    assert max(psnr(other) for other in turned[1:]) < 15


def test_a_texel_facing_away_is_never_painted():
    mesh = quads(square(0.5, 0.0))
    behind = look_at((0, 0, -4), fov=30, size=(32, 32))
    baked = backproject([see(mesh, behind, smooth)], rasterise(mesh, 0, 16), SETTINGS)
    assert see(mesh, behind, smooth).mask.any()
    assert not baked.known.any() and not baked.seen.any() and (baked.view == -1).all() and not baked.albedo.any()


def test_a_face_turned_away_is_not_painted_though_its_shading_normals_face_the_camera():
    mesh = quads(square(0.5, 0.0) @ np.array([[0.2, 0, -0.98], [0, 1, 0], [0.98, 0, 0.2]]))
    assert mesh.corner_normals[0, 0, 2] > 0  # seen at a grazing angle from +Z
    camera = look_at((-3, 0, 3), fov=30, size=(64, 64))
    bent = replace(mesh, corner_normals=np.broadcast_to(np.float32([0, 0, 1]), mesh.corner_normals.shape).copy())
    view, texels = see(bent, camera, smooth), rasterise(bent, 0, 16)
    away = ((camera.position - mesh.positions[0]) @ mesh.corner_normals[0, 0]) < 0
    assert away and view.mask.any()
    assert backproject([view], texels, SETTINGS).known.any()
    assert not backproject([view], texels, SETTINGS, mesh=bent).known.any()


def hidden(mesh: Mesh, camera: Camera, points: np.ndarray, margin: float) -> np.ndarray:
    """Which points have something more than `margin` in front of them."""
    away = points.astype(np.float64) - camera.position
    distance = np.linalg.norm(away, axis=1)
    t, *_ = trace(mesh, camera.position, away / distance[:, None])
    return t < distance - margin


def test_a_box_is_painted_by_the_view_that_faces_each_texel_most():
    mesh = box(0.55)
    views = [see(mesh, camera, smooth) for camera in rig(RigSettings(resolution=48))]
    texels = rasterise(mesh, 0, 48)
    baked = backproject(views, texels, SETTINGS, mesh=mesh)
    points, normals = texels.position[texels.covered], texels.normal[texels.covered]
    away = np.stack([view.camera.position for view in views])[:, None] - points
    weight = (away * normals).sum(axis=-1) / np.linalg.norm(away, axis=-1)
    chosen = baked.view[texels.covered]
    # Elevation +-89 and the ring see every side of the box, and a box hides nothing of the sides it shows.
    assert (chosen >= 0).all()
    best = weight.max(axis=0)
    assert (
        weight[chosen, np.arange(len(chosen))] >= best - 1e-5
    ).mean() > 0.97  # all but some in pixels that an edge crosses
    assert (weight[chosen, np.arange(len(chosen))] > 0.1).all()
    seen = baked.seen[texels.covered]
    assert (seen <= (weight > 0).sum(axis=0)).all() and (seen >= 1).all()
    for k, view in enumerate(views):
        assert not hidden(mesh, view.camera, points[chosen == k], 1e-3).any()


@pytest.mark.parametrize("gap", [0.3, 0.04, 0.01])
@pytest.mark.parametrize("size", [64, 200])
def test_a_hidden_sheet_is_never_painted(gap, size):
    # Both sheets face the camera and lie closer than the paper's 0.05 for the smaller gaps: red in front, blue behind.
    mesh = quads(square(0.4, gap, 0.1), square(0.9, 0.0))
    eye = (0.8, 0.5, 4)
    camera = look_at(eye, fov=30, size=(size, size))

    def paint(points: np.ndarray, uvs: np.ndarray) -> np.ndarray:
        return np.where(points[:, 2:] > gap / 2, [[1.0, 0, 0]], [[0, 0, 1.0]])

    texels = rasterise(mesh, 0, 128)
    baked = backproject([see(mesh, camera, paint, fine=3)], texels, SETTINGS, mesh=mesh)
    behind = (texels.position[..., 2] < gap / 2) & texels.covered
    covered_up = np.zeros_like(behind)
    covered_up[behind] = hidden(mesh, camera, texels.position[behind], 1e-4)
    assert covered_up.sum() > 500
    # A pixel decides by its centre: texels hidden by less than half a pixel (0.034 x 64 / size wide) may count as seen.
    edge = 0.75 * 2.14 / size / 0.9
    inside = np.abs(_over(texels.position, eye, gap)[..., :2] - [0.1, 0]).max(axis=-1) < 0.4 - edge
    assert not baked.known[covered_up & inside].any()
    # And nothing is ever painted with the other sheet's colour, not even at the silhouette's mixed pixels.
    truth = np.zeros_like(baked.albedo)
    truth[texels.covered] = paint(texels.position[texels.covered], texels.position[texels.covered])
    sure = baked.known & ~covered_up
    assert sure.sum() > 0.75 * (texels.covered & ~covered_up).sum()
    # Steps below the tolerance are no silhouettes: there up to two pixels may stay mixed.
    if gap > SETTINGS.depth_tolerance:
        assert np.abs(baked.albedo - truth)[sure].max() < 1e-5
    else:
        assert (np.abs(baked.albedo - truth)[sure].max(axis=-1) > 1e-5).mean() < 6 * edge


def _over(points: np.ndarray, eye: tuple[float, float, float], z: float) -> np.ndarray:
    """Where the lines from the points to the eye cross the plane at height z."""
    t = (z - points[..., 2:]) / (eye[2] - points[..., 2:])
    return points + t * (np.asarray(eye) - points)


def test_equal_weights_go_to_the_first_view_and_all_are_counted():
    mesh = quads(square(0.5, 0.0))
    views = [see(mesh, front(32), lambda p, uv, k=k: np.full((len(p), 3), k / 4)) for k in range(3)]
    baked = backproject(views, rasterise(mesh, 0, 16), SETTINGS)
    assert (baked.view[baked.known] == 0).all() and (baked.seen[baked.known] == 3).all()
    assert not baked.albedo[baked.known].any()


def test_views_of_several_sizes_each_name_themselves():
    mesh = quads(square(0.5, 0.0))
    cameras = [orbit(a, 0, distance=4, fov=30, size=(s, s)) for a, s in ((-50, 40), (20, 64), (60, 32))]
    views = [see(mesh, c, lambda p, uv, k=k: np.full((len(p), 3), k / 4)) for k, c in enumerate(cameras)]
    baked = backproject(views, rasterise(mesh, 0, 16), SETTINGS)
    assert (baked.view[baked.known] == 1).all() and np.abs(baked.albedo[baked.known] - 0.25).max() < 1e-6


def test_the_mask_the_frame_and_the_camera_s_back_keep_texels_unpainted():
    mesh, texels = quads(square(0.5, 0.0)), rasterise(quads(square(0.5, 0.0)), 0, 32)
    view = see(mesh, front(64), smooth)
    half = np.arange(64)[None, :] < 32
    baked = backproject([replace(view, mask=view.mask & half)], texels, SETTINGS)
    assert (texels.position[baked.known][:, 0] < 0.01).all() and baked.known.any()
    close = look_at((0, 0, 1.0), fov=30, size=(64, 64))
    baked = backproject([see(mesh, close, smooth)], texels, SETTINGS)
    inside = (np.abs(px_from_world(close, texels.position)[0] - 32) < 32).all(axis=-1) & texels.covered
    assert np.array_equal(baked.known, inside) and not inside[texels.covered].all()
    past = look_at((0, 0, -1), (0, 0, -2), fov=30, size=(64, 64))
    everything = replace(view, camera=past, mask=np.ones_like(view.mask), depth=np.ones_like(view.depth))
    turned = replace(mesh, corner_normals=-mesh.corner_normals)
    assert not backproject([everything], rasterise(turned, 0, 32), SETTINGS).known.any()


def test_what_lies_around_the_mask_never_mixes_in():
    mesh = quads(square(0.5, 0.0))
    view = see(mesh, look_at((0.5, 0.3, 4), fov=30, size=(50, 50)), lambda p, uv: np.full((len(p), 3), 0.25), fine=4)
    loud = np.where(view.mask[..., None], view.rgb, np.float32([1, 0, 1]))
    baked = backproject([replace(view, rgb=loud)], rasterise(mesh, 0, 64), SETTINGS)
    assert baked.known.any() and np.abs(baked.albedo[baked.known] - 0.25).max() < 1e-6


def test_mixed_pixels_take_the_colour_of_their_own_surface():
    mesh = quads(square(0.3, 0.4), square(0.9, 0.0))

    def paint(points: np.ndarray, uvs: np.ndarray) -> np.ndarray:
        return np.where(points[:, 2:] > 0.2, [[1.0, 0, 0]], [[0, 0, 1.0]])

    view = see(mesh, look_at((0.3, 0.2, 4), fov=30, size=(60, 60)), paint, fine=4)
    mixed = view.mask & (view.rgb.max(axis=-1) < 0.99)
    pure = pure_colours(view, SETTINGS)
    near = view.depth < view.depth[view.mask].min() + 0.2
    assert mixed.sum() > 50
    assert np.allclose(pure[view.mask & near], [1, 0, 0], atol=1e-6)
    assert np.allclose(pure[view.mask & ~near], [0, 0, 1], atol=1e-6)
    assert np.array_equal(pure[~view.mask], view.rgb[~view.mask])


def texels_of(island: np.ndarray, position: np.ndarray) -> Texels:
    return Texels(position.astype(np.float32), np.zeros_like(position, np.float32), island >= 0, island, island)


def test_holes_take_the_nearest_colour_of_their_own_island(rng):
    # Islands above and below the diagonal, painted along the picture's border and along the diagonal: the nearest
    # painted texel of many holes above is the neighbour's, and the rectangle around either island holds both.
    rows, columns = np.indices((40, 40))
    island = np.where(rows < columns - 1, 0, np.where(rows > columns + 1, 1, -1))
    known = ((island == 0) & (rows == 0)) | ((island == 1) & (rows == columns + 2))
    albedo = np.where(known[..., None], rng.random((40, 40, 3)), 0).astype(np.float32)
    marks = np.where(known, 0, -1).astype(np.int16), known.astype(np.int16)
    position = np.stack([rows, columns, 0 * rows], axis=-1)
    filled = fill(Backprojection(albedo, known, *marks), texels_of(island, position))
    for row, column in np.argwhere((island >= 0) & ~known)[::7]:
        mine = np.argwhere(known & (island == island[row, column]))
        distance = np.hypot(*(mine - [row, column]).T)
        near = mine[distance <= 1.04 * distance.min() + 0.5]  # the chamfer's choice may be that much farther
        assert (filled[row, column] == albedo[tuple(near.T)]).all(axis=-1).any()


def test_holes_are_filled_along_rows(rng):
    # Two islands side by side, painted at their far ends; the nearest painted texel of some holes is the neighbour's.
    island = np.full((24, 40), -1, np.int32)
    island[:, :19], island[:, 20:] = 0, 1
    known = np.zeros((24, 40), bool)
    known[:, :3], known[:, 21] = True, True
    albedo = np.where(known[..., None], rng.random((24, 40, 3)), 0).astype(np.float32)
    flat = np.stack([*np.indices((24, 40)), np.zeros((24, 40))], axis=-1)
    view, seen = np.where(known, 0, -1).astype(np.int16), known.astype(np.int16)
    filled = fill(Backprojection(albedo, known, view, seen), texels_of(island, flat))
    assert np.array_equal(filled[known], albedo[known])
    assert np.array_equal(filled[:, 3:19], np.broadcast_to(albedo[:, 2:3], (24, 16, 3)))
    assert np.array_equal(filled[:, 22:], np.broadcast_to(albedo[:, 21:22], (24, 18, 3)))
    assert not filled[:, 19].any()  # outside the islands nothing happens


def test_an_island_without_paint_takes_the_nearest_colour_on_the_surface():
    island = np.repeat([[0, 1, 2]], 4, axis=0).repeat(8, axis=1).astype(np.int32)
    position = np.zeros((4, 24, 3))
    position[..., 0] = np.repeat([0.0, 5.0, 4.5], 8)  # island 1 is next to 0 in the atlas and next to 2 in space
    known = np.repeat([[True, False, True]], 4, axis=0).repeat(8, axis=1)
    albedo = np.where(known[..., None], island[..., None] / 4 + 0.25, 0).repeat(3, axis=-1).astype(np.float32)
    view = np.where(known, 0, -1).astype(np.int16)
    filled = fill(Backprojection(albedo, known, view, known.astype(np.int16)), texels_of(island, position))
    assert (filled[:, 8:16] == 0.75).all()
    nothing = Backprojection(albedo, np.zeros_like(known), view, view)
    assert np.array_equal(fill(nothing, texels_of(island, position)), albedo)


def test_the_same_bytes_on_any_number_of_threads(monkeypatch):
    mesh = box(0.55)
    views = [see(mesh, camera, smooth) for camera in rig(RigSettings(kind="turntable", views=3, resolution=32))]
    texels = rasterise(mesh, 0, 64)
    monkeypatch.setattr(stage, "ROWS", 300)
    done: list[float] = []
    baked = backproject(views, texels, SETTINGS, done.append, mesh=mesh)
    assert done[-1] == 1 and done == sorted(done)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    again = backproject(views, texels, SETTINGS, mesh=mesh)
    for name in ("albedo", "known", "view", "seen"):
        assert getattr(baked, name).tobytes() == getattr(again, name).tobytes()
    filled = fill(again, texels)
    assert not again.known[texels.covered].all()  # the bottom is not seen
    assert (np.abs(filled[texels.covered]).sum(axis=-1) > 0).all()


def test_no_views_are_refused():
    mesh = quads(square(0.5, 0.0))
    with pytest.raises(ValueError, match="no views"):
        backproject([], rasterise(mesh, 0, 8), SETTINGS)


def test_spot_keeps_its_own_texture():
    # Mitsuba says where each pixel's ray meets the real mesh; its unlit texture goes into the views and comes back.
    from mistyle.io.read import read_picture
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.mitsuba.draw import gbuffer, tracer

    mesh = read_mesh(data("meshes/plain/spot.obj")).mesh
    texture = linear_from_srgb(read_picture(data("meshes/plain/spot_texture.png")).rgb)
    size = texture.shape[0]

    def texels_at(uv: np.ndarray) -> np.ndarray:
        return bilinear(texture, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1) * size, "repeat")

    traced = tracer(mesh)
    views = []
    for camera in rig(RigSettings(resolution=400)):
        hits = gbuffer(traced, camera)
        rgb = np.where(hits.mask[..., None], texels_at(hits.uv.reshape(-1, 2)).reshape(400, 400, 3), 0)
        coverage = hits.mask.astype(np.float32)
        views.append(View(camera, rgb, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, coverage))
    texels = rasterise(mesh, 0, 256)
    baked = backproject(views, texels, SETTINGS, mesh=mesh)
    centre = (np.arange(256) + 0.5) / 256
    truth = texels_at(np.stack(np.meshgrid(centre, 1 - centre), axis=-1).reshape(-1, 2)).reshape(256, 256, 3)
    error = np.abs(baked.albedo - truth).max(axis=-1)
    assert baked.known[texels.covered].mean() > 0.95
    # Spot's texture has sharp dark spots, so single texels at their rims may differ by a lot.
    assert np.median(error[baked.known]) < 0.01 and np.mean(error[baked.known] > 0.1) < 0.02
    assert np.mean(np.abs(baked.albedo[::-1] - truth).max(axis=-1)[baked.known] > 0.1) > 0.1  # flipped it would not
