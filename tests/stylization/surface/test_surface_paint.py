"""The surface's further choices: cells, palettes, glaze, relief, directions, what an asset keeps, masks and slots."""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from mistyle.atlas.texels import rasterise
from mistyle.cli import options
from mistyle.core.asset import Asset, Material, Picture, Source
from mistyle.core.camera import resized, rig
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import bilinear
from mistyle.core.maps import Maps, flat_maps
from mistyle.core.mesh import face_areas
from mistyle.core.settings import RigSettings
from mistyle.geometry.tangents import corner_tangents
from mistyle.io.images.write import write_png
from mistyle.render.mitsuba.draw import gbuffer, tracer
from mistyle.render.mitsuba.unlit import unlit
from mistyle.stylization.pipeline import painting, preview, variations
from mistyle.stylization.pipeline import start as stylize_start
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface import cells, lookup, samples, synthesis
from mistyle.stylization.surface import layers as coat
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.exemplar import relief as reliefs
from mistyle.stylization.surface.guides import guides, linefield
from mistyle.stylization.surface.guides.glaze import band, glaze
from mistyle.stylization.surface.settings import SurfaceSettings
from tests.stylization.surface.test_surface import (  # noqa: F401
    box,
    dented_ball,
    dj,
    mesh_of,
    open_sky,
    sheet,
    solved,
    spread_on,
    strokes,
)
from tests.support.helpers import fixed_surface


def on_a_ball(count: int, rng):
    directions = rng.normal(size=(count, 3))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def test_thinning_is_that_of_one_point_after_the_other(dj, rng):  # noqa: F811
    points, radius = on_a_ball(3000, rng), 0.12
    normals = np.where(rng.random((3000, 1)) < 0.5, points, -points)  # two surfaces that face away from each other
    rank = rng.permutation(3000)
    kept = cells.thin(dj, cells.point_grid(dj, points, normals, radius, rank), radius)
    tree, alive, plain = KDTree(points), np.ones(3000, bool), np.zeros(3000, bool)
    for i in np.argsort(-rank):
        if alive[i]:
            plain[i] = True
            near = np.array(tree.query_ball_point(points[i], radius))
            alive[near[normals[near] @ normals[i] > 0]] = False
    assert (kept == plain).all() and 300 < kept.sum() < 1000


def test_lists_of_near_points_are_complete(dj, rng):  # noqa: F811
    points = on_a_ball(800, rng)
    normals = np.where(points[:, :1] > 0, points, -points)
    listed = cells.near(dj, points, normals, 0.3, 0.1, 64)
    square = ((points[:, None] - points) ** 2).sum(2) + 0.01 * ((normals[:, None] - normals) ** 2).sum(2)
    for i in range(800):
        assert set(listed[i]) == set(np.flatnonzero(square[i] < 0.09)) | {i}


def test_palette_mix_gives_rare_colours_room(rng):
    picture = np.tile(np.array([0.8, 0.7, 0.5], np.float32), (64, 64, 1))
    picture[:, :6] = [0.1, 0.2, 0.6]
    painting = style.prepare(picture)
    blue = [
        np.mean(style.palette(painting, 0.0, np.random.default_rng(0), mix)[:, 2] < -0.1) for mix in (0.0, 0.5, 1.0)
    ]
    assert blue[0] == pytest.approx(6 / 64, abs=0.03)
    assert blue[0] < blue[1] - 0.05 < blue[2] - 0.1 and blue[2] == pytest.approx(0.5, abs=0.15)
    assert (style.rarity(np.zeros((5, 5, 3), np.float32), 1.0) == 1).all()


def test_middle_tones_tell_a_woodcut_from_a_painting(rng):
    two = (rng.random(5000) < 0.3).astype(np.float32)
    assert style.middle_tones(two) == 0 and style.middle_tones(np.full(100, 0.4, np.float32)) == 0
    assert style.middle_tones(rng.random(5000).astype(np.float32)) == 1
    assert style.middle_tones(rng.normal(0.5, 0.1, 5000).astype(np.float32)) == 1


@pytest.fixture(scope="module")
def ball(dj):  # noqa: F811
    """A hierarchy on the dented ball with its details."""
    settings = fixed_surface(samples=6000, levels=6, stroke_scale=2.0, glaze=0.8)
    levels = synthesis.hierarchy(dented_ball(), settings, 0, dj)
    tone, cavity = guides.tones(levels, np.ones(len(levels[-2].directed), np.float32), 0.0)
    return settings, levels, tone, cavity


def test_glaze_adds_the_missing_light_and_dark(ball):
    settings, levels, tone, cavity = ball
    wanted = guides.detail(levels, tone, cavity)[-1]
    guide = guides.Guide(np.zeros((len(wanted), 3), np.float32), wanted, levels[-1].directed)
    book = style.exemplar(style.prepare(strokes()), 64, 0.5)
    grey = np.full(len(wanted), 0.5, np.float32)
    laid = glaze(levels, guide, grey, book, settings)
    assert np.corrcoef(laid, wanted)[0, 1] > 0.8 and 0.01 < np.abs(laid).max() <= 0.12
    # What shows the form already gets less, and a painting of two tones nothing.
    shown = grey + wanted * np.float32(settings.relief * book.band.std())
    assert np.abs(glaze(levels, guide, shown, book, settings)).mean() < 0.7 * np.abs(laid).mean()
    woodcut = replace(book, lab=np.where(book.lab[:, :1] > 0.5, [[1, 0, 0]], [[0, 0, 0]]).astype(np.float32))
    assert not glaze(levels, guide, grey, woodcut, settings).any()
    assert not glaze(levels, guide, grey, book, settings.model_copy(update={"glaze": 0.0})).any()
    assert np.abs(band(levels, grey)).max() < 1e-5


def test_lightening_changes_lightness_alone():
    colours = np.array([[0.3, 0.5, 0.4], [0.6, 0.4, 0.3], [1.0, 1.0, 1.0]], np.float32)
    before = style.lab_from_srgb(colours[None])[0]
    after = style.lab_from_srgb(style.lightened(colours, np.array([0.1, -0.1, 0.2], np.float32))[None])[0]
    np.testing.assert_allclose(after[:2] - before[:2], [[0.1, 0, 0], [-0.1, 0, 0]], atol=2e-3)
    np.testing.assert_allclose(after[2], before[2], atol=2e-3)


@pytest.mark.parametrize(("follow", "axis"), [("up", 1), ("around", 0)])
def test_strokes_go_where_they_are_told(follow, axis):
    points = spread_on(box(0.6, 1.2, 0.6), 1500)
    tangent, sure = linefield.directions(linefield.line_field(points, follow), points)
    front = (np.abs(points.normals[:, 2]) > 0.99) & (np.abs(points.positions[:, :2]) < [0.2, 0.4]).all(axis=1)
    assert front.sum() > 50 and (np.abs(tangent[front, axis]) > 0.99).all() and (sure[front] > 0.9).all()


def test_a_painted_direction_takes_the_place_of_the_form():
    points = spread_on(box(0.6, 1.2, 0.6), 1500)
    slanting = np.array([1, 1, 0], np.float32) / np.float32(np.sqrt(2))

    def course(where, facing):
        return np.broadcast_to(slanting, where.shape), (where[:, 1] > 0).astype(np.float32)

    with_it, without = (linefield.directions(linefield.line_field(points, "up", c), points)[0] for c in (course, None))
    front = (np.abs(points.normals[:, 2]) > 0.99) & (np.abs(points.positions[:, 0]) < 0.2)
    above, below = front & (points.positions[:, 1] > 0.15), front & (points.positions[:, 1] < -0.25)
    assert above.sum() > 30 and below.sum() > 20
    assert (np.abs(with_it[above] @ slanting) > 0.97).all() and (np.abs(without[above] @ slanting) < 0.8).all()
    assert (np.abs(with_it[below, 1]) > 0.97).all()


def test_red_and_green_of_a_direction_map_are_u_and_v(painted_sheet, tmp_path):
    mesh, texels, _ = painted_sheet
    rows, columns = np.nonzero(texels.covered[1:-1, 1:-1])
    at = (rows + 1, columns + 1)
    along_u = texels.position[at[0], at[1] + 1] - texels.position[at[0], at[1] - 1]
    along_v = texels.position[at[0] - 1, at[1]] - texels.position[at[0] + 1, at[1]]  # row 0 is v = 1
    inside = np.linalg.norm(along_u, axis=1) * np.linalg.norm(along_v, axis=1) > 0
    for colour, expected in (((1, 0.5, 0), along_u), ((0.5, 0, 1), along_v), ((0.9, 0.9, 0.5), along_u + along_v)):
        write_png(tmp_path / "flow.png", np.broadcast_to(np.array(colour, np.float32), (8, 8, 3)))
        course = coat.painted_direction(tmp_path / "flow.png", mesh, [texels])
        found, counts = course(texels.position[at][inside], texels.normal[at][inside])
        wanted = expected[inside] / np.linalg.norm(expected[inside], axis=1, keepdims=True)
        assert inside.sum() > 100 and (np.abs((found * wanted).sum(axis=1)) > 0.99).mean() > 0.95
        np.testing.assert_allclose(counts, 1)
    half = np.full((8, 8, 3), 0.5, np.float32)
    write_png(tmp_path / "grey.png", half)
    with pytest.raises(InputRefused, match="mid grey or transparent everywhere"):
        coat.painted_direction(tmp_path / "grey.png", mesh, [texels])
    half[:, :4] = (1, 0.5, 0)
    write_png(tmp_path / "half.png", half)
    found, counts = coat.painted_direction(tmp_path / "half.png", mesh, [texels])(
        texels.position[at], texels.normal[at]
    )
    assert (counts[at[1] < 12] == 1).all() and (counts[at[1] > 20] == 0).all()
    assert coat.painted_direction(None, mesh, [texels]) is None


def ramp_solution(turn):
    """One sample on the plane y = 0 that shows the middle of a picture of ramps in a quarter turn."""
    rows, columns = np.mgrid[:200, :200].astype(np.float32)
    picture = np.stack([columns / 200, rows / 200, 0 * rows], axis=2)
    up, tangent = np.array([[0, 1, 0]], np.float32), np.array([[0.6, 0, 0.8]], np.float32)
    centre, turns = np.full((1, 2), 100, np.float32), np.array([turn], np.int32)
    zero = np.zeros(1, np.float32)
    return lookup.PaintedSurface(
        0 * up, up, tangent, turns, centre, 0.05, (2.0, 2.0), picture, zero, turns * 0, 8.0, False
    )


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_relief_turns_as_the_picture_does(dj, turn):  # noqa: F811
    """Heights c . (column, row): their gradient on the surface is what finite differences of a looked-up ramp give."""
    solution = ramp_solution(turn)
    slope = np.array([0.3, -0.7], np.float32)
    constant = np.zeros((200, 200, 3), np.float32)
    constant[..., :2], constant[..., 2] = slope, 0.25
    at, up = solution.positions, solution.normals

    def shown(picture, where, slopes=False):
        near = lookup.neighbours(solution, where, up)
        return next(iter(lookup.looked_up(solution, where, near, picture, 0.0, slopes=slopes)))[1][0]

    gradient = shown(constant, at, slopes=True)
    assert gradient[3] == pytest.approx(0.25, abs=1e-6)
    step = 0.01
    for axis in np.eye(3, dtype=np.float32)[[0, 2]]:
        ahead, behind = (shown(solution.painting, at + sign * step * axis)[:2] for sign in (1, -1))
        pixels = (ahead - behind) * 200 / (2 * step)  # how the place in the picture moves
        per_unit = 2.0 / 0.05
        assert gradient[:3] @ axis == pytest.approx(float(pixels @ slope) / per_unit, abs=2e-3)


def test_a_dark_line_is_a_groove_and_a_flat_painting_flat():
    picture = np.full((160, 160, 3), 0.7, np.float32)
    picture[:, 79:81] = 0.1
    height, groove, _ = reliefs.height_and_grooves(picture)
    assert height[80, 80] < height[80, 60] - 0.5 and groove[80, 80] > 0.9 and groove[80, 40] < 0.01
    found = reliefs.relief(picture)
    assert found.slope[80, 78, 0] < 0 < found.slope[80, 81, 0] and found.dull[80, 80] > 0.2
    assert (found.slope**2).sum(axis=2).mean() == pytest.approx(1, rel=1e-3)
    assert np.abs(reliefs.relief(np.full((50, 60, 3), 0.5, np.float32)).slope).max() < 1e-3


def asset_of(mesh, albedo=None) -> Asset:
    material = Material("only", albedo, None, None, None, np.ones(3, np.float32), 0.5, 0.0)
    source = Source(Path("x.obj"), "obj", (), mesh.positions, np.eye(4, dtype=np.float32), None, "kept", ())
    return Asset("x", mesh, (material,), source)


@pytest.fixture(scope="module")
def painted_sheet():
    """The square with UVs, its texels, and maps with a dark left half."""
    flat = sheet()
    corners = flat.positions[flat.faces]
    uvs = np.stack([corners[..., 0] / 1.4 + 0.5, 0.5 - corners[..., 2] / 1.4], axis=-1).astype(np.float32)
    mesh = replace(flat, corner_uvs=uvs)
    maps = flat_maps(32)
    albedo = maps.albedo.copy()
    albedo[:, :16] = 0.02
    return mesh, rasterise(mesh, 0, 32), replace(maps, albedo=albedo)


def test_content_of_a_texture_rules_the_tone(painted_sheet, dj):  # noqa: F811
    mesh, texels, maps = painted_sheet
    striped = maps.albedo.copy()
    striped[:, np.arange(32) // 8 % 2 == 0], striped[:, np.arange(32) // 8 % 2 == 1] = 0.02, 0.5
    found = coat.content([texels], [replace(maps, albedo=striped)])
    assert found is not None and coat.content([texels], [flat_maps(32)]) is None
    settings = fixed_surface(samples=2500, keep_content=1.0)
    levels = synthesis.hierarchy(mesh, settings, 0, dj)
    palette = np.random.default_rng(0).random((500, 3)).astype(np.float32) * [1, 0.2, 0.2]
    light = {}
    for keep in (0.0, 1.0):
        chosen = settings.model_copy(update={"keep_content": keep})
        made = guides.level_guides(levels, palette, open_sky, chosen, np.random.default_rng(1), found)
        dark = np.floor((levels[-1].points.positions[:, 0] / 1.4 + 0.5) * 4) % 2 == 0
        light[keep] = made[-1].colour[~dark, 0].mean() - made[-1].colour[dark, 0].mean()
    assert light[1.0] > 0.3 > abs(light[0.0])


def test_existing_normals_are_composed_and_roughness_moved(painted_sheet, rng):
    mesh, texels, maps = painted_sheet
    asset = asset_of(mesh)
    tilt = rng.uniform(-0.3, 0.3, (32, 32, 2)).astype(np.float32)
    own = np.concatenate([tilt, np.sqrt(1 - (tilt**2).sum(-1, keepdims=True))], axis=2)
    start = replace(maps, normal=own.astype(np.float32))
    count = int(texels.covered.sum())
    nothing, dull = np.zeros((count, 3), np.float32), np.full(count, 0.2, np.float32)

    def laid(slope: np.ndarray, height: float, gloss: float) -> Maps:
        made = replace(start, normal=start.normal.copy(), roughness=start.roughness.copy())
        rows, tangents = slice(0, 32), corner_tangents(mesh)
        band = coat.TexelBand(texels, rows, texels.covered)
        coat.lay_relief(made, band, coat.PaintRelief(slope, dull), height, gloss, asset.mesh, tangents)
        return made

    same = laid(nothing, 0.15, 1.0)
    np.testing.assert_allclose(same.normal[texels.covered], start.normal[texels.covered], atol=1e-5)
    np.testing.assert_allclose(same.roughness[texels.covered], 0.7, atol=1e-6)
    # A slope along +x tilts the normal towards -x, which is -u here, and adds to the tilt that was there.
    slope = np.tile(np.array([1, 0, 0], np.float32), (count, 1))
    bent = laid(slope, 0.2, 0.0)
    at = texels.covered
    expected = own[at] - [0.2, 0, 0]
    np.testing.assert_allclose(bent.normal[at], expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-5)
    assert (bent.roughness == start.roughness).all()


def test_strokes_of_one_size_on_meshes_of_any_size():
    mesh = dented_ball()
    small, settings = asset_of(mesh), SurfaceSettings()
    twice = replace(small, source=replace(small.source, work_from_user=np.diag([0.5, 0.5, 0.5, 1]).astype(np.float32)))
    scales = [coat.scaled(settings, each, 0.1).stroke_scale for each in (small, twice)]
    assert scales[0] == pytest.approx(2 * scales[1])
    # The picture then spans 32 strokes: its pixels on the finest level times the samples' spacing.
    surface = coat.scaled(settings, small, 0.1)
    spacing = np.sqrt(face_areas(mesh).sum() / (samples.YIELD * surface.samples))
    assert synthesis.finest_size(surface) * spacing == pytest.approx(3.2, rel=1e-3)
    with pytest.raises(UsageError, match="choose from"):
        coat.scaled(settings, small, 100.0)
    assert coat.scaled(settings, small, None) is settings


def test_masks_and_slots(painted_sheet, tmp_path):
    mesh, texels, maps = painted_sheet
    asset = asset_of(mesh)
    half = np.zeros((8, 8, 3), np.float32)
    half[:, :4] = 1
    write_png(tmp_path / "half.png", half)
    write_png(tmp_path / "dark.png", 0 * half)
    pictures, masks = coat.slot_masks(asset, [texels], ["only=a.jpg", f"{tmp_path / 'half.png'}=b.jpg"])
    assert pictures == [Path("a.jpg"), Path("b.jpg")] and masks[0][0].all()
    assert masks[1][0][:, :15].all() and not masks[1][0][:, 17:].any()
    for wrong in ("only", "=a.jpg", "nobody=a.jpg"):
        with pytest.raises(UsageError):
            coat.slot_masks(asset, [texels], [wrong])
    own = coat.protected(replace(maps, albedo=maps.albedo + 0.5), maps, masks[1][0])
    assert (own.albedo[:, :15] == maps.albedo[:, :15]).all() and (own.albedo[:, 17:] > 0.5).all()
    style_picture = Picture(strokes(), None, tmp_path / "x.png")
    left = coat.masked_style(style_picture, tmp_path / "half.png")
    assert left.alpha is not None and left.alpha[:, :60].all() and not left.alpha[:, 70:].any()
    assert coat.masked_style(style_picture, None) is style_picture
    with pytest.raises(InputRefused, match="dark everywhere"):
        coat.masked_style(style_picture, tmp_path / "dark.png")


def test_a_coat_of_two_pictures_with_a_protected_part(painted_sheet, tmp_path):
    """Red paint, blue on the left half by a mask, and a strip that keeps the asset's own look."""
    mesh, _, _ = painted_sheet
    own = np.full((4, 4, 3), 0.3, np.float32)
    asset = asset_of(mesh, own)
    half, strip = np.zeros((32, 32, 3), np.float32), np.zeros((32, 32, 3), np.float32)
    half[:, :16], strip[:6] = 1, 1
    red, blue = np.zeros((40, 50, 3), np.float32), np.zeros((40, 50, 3), np.float32)
    red[..., 0], blue[..., 2] = np.tile(np.repeat([0.5, 0.9], 5), 5), np.tile(np.repeat([0.5, 0.9], 5), 5)
    for name, picture in (("half", half), ("strip", strip), ("blue", blue)):
        write_png(tmp_path / f"{name}.png", picture)
    chosen = {"slots": [f"{tmp_path / 'half.png'}={tmp_path / 'blue.png'}"], "protect": tmp_path / "strip.png"}
    settings = Settings.model_validate(
        {"surface": {"samples": 700}, "atlas": {"size": 32}, "paint": chosen | {"height": 0.2, "gloss": 1.0}}
    )
    atlas = stylize_start.lay_out(asset, settings, lambda done: None)
    layers = painting.paint_layers(asset, Picture(red, None, tmp_path / "red.png"), atlas, settings, lambda done: None)
    (flat,), (maps,) = painting.raised(asset, layers, atlas, settings)
    assert (flat.normal[..., 2] == 1).all()
    assert (painting.painted(asset, layers, atlas, settings)[0].albedo == flat.albedo).all()
    assert len(layers.solutions) == 2
    np.testing.assert_allclose(maps.albedo[:5], atlas.start[0].albedo[:5])
    # The darker stripes are 0.21; beside lighter ones the sharpened look-ups undershoot them.
    assert (maps.albedo[8:, :15, 2] > 0.05).all() and (maps.albedo[8:, :15, 0] < 0.02).all()
    assert (maps.albedo[8:, 17:, 0] > 0.05).all() and (maps.albedo[8:, 17:, 2] < 0.02).all()
    assert (maps.normal[:5, :, 2] == 1).all() and (maps.normal[8:, :, 2] < 0.9999).mean() > 0.3
    assert np.allclose(np.linalg.norm(maps.normal, axis=2), 1, atol=1e-5)


def test_unlit_views_agree_with_plain_fetches(painted_sheet, rng):
    mesh, _, maps = painted_sheet
    maps = replace(maps, albedo=cv2.GaussianBlur(rng.random((32, 32, 3)).astype(np.float32), (0, 0), 1.5))
    camera = rig(RigSettings(resolution=48))[2]
    traced = tracer(mesh)
    (rgb, coverage) = unlit(traced, [maps], [camera])[0]
    hits = gbuffer(traced, resized(camera, (144, 144)))
    fine = np.zeros((144, 144, 3), np.float32)
    uv = hits.uv[hits.mask]
    fine[hits.mask] = bilinear(maps.albedo, np.stack([uv[:, 0] * 32, (1 - uv[:, 1]) * 32], axis=1), "repeat")
    mean = fine.reshape(48, 3, 48, 3, 3).mean(axis=(1, 3))
    share = hits.mask.reshape(48, 3, 48, 3).mean(axis=(1, 3))
    # Rays on an edge may fall to either side by rounding.
    same = np.abs(coverage - share) < 1e-6
    assert same.mean() > 0.995 and coverage.sum() > 100
    np.testing.assert_allclose(rgb[same], mean[same], atol=2e-5)


def test_lengths_and_variations():
    assert [options.length(t) for t in ("3cm", "30mm", "0.03m", "0.03")] == pytest.approx([0.03] * 4)
    for wrong in ("3in", "cm", "big"):
        with pytest.raises(argparse.ArgumentTypeError, match="3cm"):
            options.length(wrong)
    made = variations.variations(Settings(seed=5), 4)
    assert [m.settings.seed for m in made] == [5, 6, 7, 8] and made[0].settings.surface.stroke_scale == 1
    assert len({m.label for m in made}) == 4 and made[1].settings.surface.stroke_scale != 1
    tiles = [np.full((3, 5, 3), k / 10, np.float32) for k in range(3)]
    sheet_of = preview.rows_of(tiles, 2)
    assert (
        sheet_of.shape == (6, 10, 3) and (sheet_of[3:, :5] == np.float32(0.2)).all() and (sheet_of[3:, 5:] == 1).all()
    )


def many_parts() -> object:
    """Thirty small boxes and one large one, which interpenetrate, and a sheet with a single triangle beside them."""
    rng = np.random.default_rng(3)
    positions, faces = [], []
    for k in range(31):
        part = box(*(rng.uniform(0.05, 0.2, 3) if k else np.ones(3)))
        faces.append(part.faces + 8 * k)
        positions.append(part.positions + rng.uniform(-0.5, 0.5, 3) * (k > 0))
    positions.append(np.array([[0.9, 0, 0], [0.95, 0, 0], [0.9, 0.05, 0]]))
    faces.append(np.array([[248, 249, 250]]))
    return mesh_of(np.concatenate(positions), np.concatenate(faces))


@pytest.mark.parametrize("shape", [box(1.2, 1.2, 0.001), many_parts(), sheet(2)], ids=["wall", "parts", "two-faces"])
def test_any_mesh_will_do(shape):
    settings = fixed_surface(samples=700)
    solution = solved(shape, strokes(), settings, 0)
    corners = shape.positions[shape.faces].mean(axis=1)
    normals = np.cross(*(np.diff(shape.positions[shape.faces], axis=1).transpose(1, 0, 2)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = lookup.colour(solution, corners.astype(np.float32), normals.astype(np.float32))
    assert np.isfinite(found).all() and (found >= 0).all() and (found <= 1).all() and found.std() > 0.02
