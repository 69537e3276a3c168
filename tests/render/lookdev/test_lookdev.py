"""The look-dev sheet: its references are what they claim to be, its light stands still, its passes tell the truth."""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.cli.main import main
from mistyle.core.errors import EnvironmentMissing
from mistyle.core.image import linear_from_srgb, luminance, srgb_from_linear
from mistyle.core.light import Ambient, Environment, bake_environment
from mistyle.deliver.lookdev import canvas as sheet_canvas
from mistyle.deliver.lookdev import job as lookdev_job
from mistyle.deliver.lookdev.canvas import Panel, PanelRow, Sheet, compose, fitted
from mistyle.io.read import read_exr
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs.report.turntable import write_turn
from mistyle.render.lookdev import sheet
from mistyle.render.lookdev.aovs import aovs, density

CYAN = 17
SMALL = 0.5
# 8-bit sRGB that X-Rite printed for the chart long before 2014: another source, rounded and of another batch.
PRINTED = {
    0: (115, 82, 68), 1: (194, 150, 130), 4: (133, 128, 177), 12: (56, 61, 150), 13: (70, 148, 73),
    14: (175, 54, 60), 15: (231, 199, 31), 18: (243, 243, 242), 21: (122, 122, 121), 23: (52, 52, 52),
}  # fmt: skip


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    """A ball with UVs, half as rough as can be, with a texture that is red on one half and blue on the other."""
    mesh = trimesh.creation.uv_sphere(count=[32, 32])
    around = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]) / (2 * np.pi) + 0.5
    uv = np.stack([0.02 + 0.96 * around, 0.02 + 0.96 * (mesh.vertices[:, 2] * 0.5 + 0.5)], axis=1)
    picture = Image.new("RGB", (64, 64), (188, 30, 30))
    picture.paste((30, 30, 188), (32, 0, 64, 64))
    flat, half = Image.new("RGB", (64, 64), (128, 128, 255)), Image.new("RGB", (64, 64), (0, 128, 0))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, metallicRoughnessTexture=half, normalTexture=flat, metallicFactor=1.0
    )
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    path = tmp_path_factory.mktemp("ball") / "ball.glb"
    mesh.export(path)
    return path


@pytest.fixture(scope="module")
def under_white() -> np.ndarray:
    """The references under radiance 1 from everywhere."""
    return sheet.references(Environment(np.ones((8, 16, 3), np.float32)), 64, scale=SMALL)


def lab(rgb: np.ndarray, white: np.ndarray) -> np.ndarray:
    """CIE Lab for `white` (xy) of linear Rec.709."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour

        xyz = colour.RGB_to_XYZ(rgb, "sRGB", illuminant=white, chromatic_adaptation_transform="Bradford")
        return colour.XYZ_to_Lab(xyz, white)


def difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    import colour

    return np.asarray(colour.difference.delta_E_CIE2000(one, other))


def test_the_grey_ball_is_18_percent_and_the_chrome_ball_a_mirror(under_white):
    np.testing.assert_allclose(sheet.ball_mean(under_white, "grey", SMALL), 0.18, atol=0.0005)
    np.testing.assert_allclose(sheet.ball_mean(under_white, "chrome", SMALL), 1.0, atol=0.001)


def patch_means(picture: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """The mean linear colours of the chart's patches, (24, 3), in the order of `colour_checker`."""
    columns, rows = sheet.PATCHES
    found = np.zeros((rows, columns, 3), np.float32)
    for row in range(rows):
        for column in range(columns):
            x = sheet.CHART_CENTRE[0] + sheet.CHART_SIZE[0] * ((column + 0.5) / columns - 0.5)
            y = sheet.CHART_CENTRE[1] - sheet.CHART_SIZE[1] * ((row + 0.5) / rows - 0.5)
            px, py = sheet.pixel_of(x, y, scale)
            reach = 0.25 * sheet.CHART_SIZE[0] / columns * sheet.UNIT * sheet.column_camera(scale).focal / 40.0
            block = picture[int(py - reach) : int(py + reach) + 1, int(px - reach) : int(px + reach) + 1, :3]
            found[row, column] = block.mean(axis=(0, 1))
    return np.rot90(found, 1).reshape(24, 3)


def test_the_chart_shows_the_published_colours(under_white):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour

        chart = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
        published = colour.XYZ_to_Lab(colour.xyY_to_XYZ(np.array(list(chart.data.values()))), chart.illuminant)
    apart = difference(lab(patch_means(under_white, SMALL), chart.illuminant), published)
    inside = np.arange(24) != CYAN
    assert apart[inside].max() < 0.3, apart
    # Cyan lies outside Rec.709: its red cannot be reflected, and nothing else is clipped.
    assert (sheet.colour_checker() < 0).any(axis=1).tolist() == (~inside).tolist() and 0.3 < apart[CYAN] < 4


def test_the_chart_agrees_with_values_from_another_source():
    ours = sheet.colour_checker()
    white = np.array([0.3127, 0.3290])
    for patch, value in PRINTED.items():
        apart = difference(lab(ours[patch], white), lab(linear_from_srgb(np.array(value) / 255), white))
        # Editions differ by up to 3.4 (light skin); a white point that is not adapted, or a wrong curve, by far more.
        assert apart < 4, f"patch {patch}: {srgb_from_linear(ours[patch]) * 255} for {value}"


def test_the_chart_is_held_upright_and_not_mirrored():
    """Turned right by 90 degrees: dark skin at the upper right, white at the upper left, black below it."""
    picture = sheet.chart_texture(16, 2)
    at = {name: picture[row * 16 + 8, column * 16 + 8] for name, (row, column) in
          {"dark skin": (0, 3), "white": (0, 0), "black": (5, 0), "bluish green": (5, 3)}.items()}  # fmt: skip
    rgb = np.clip(sheet.colour_checker(), 0, 1)
    for name, k in {"dark skin": 0, "bluish green": 5, "white": 18, "black": 23}.items():
        np.testing.assert_allclose(at[name], rgb[k], atol=1e-6)


@pytest.mark.parametrize("level", [0.03, 7.0])
def test_a_light_is_exposed_for_the_grey_ball(level):
    rig = sheet.exposed(sheet.LightRig("dim", Environment(bake_environment((Ambient((level, level, 2 * level)),), 8))))
    seen = sheet.ball_mean(sheet.references(rig.light, 16, 1, SMALL), "grey", SMALL)
    assert abs(float(luminance(seen[None])[0]) - 0.18) < 0.002
    assert abs(rig.stops + np.log2(level * (1 + 0.0722))) < 0.02


def test_light_and_camera_stand_still_while_the_asset_turns(tmp_path):
    path = tmp_path / "grey.obj"
    trimesh.creation.icosphere(subdivisions=4).export(path)
    stage = sheet.Stage(read_mesh(path))
    light = sheet.rigs(None, read=lambda p: np.ones((8, 16, 3), np.float32))[1].light
    first, turned = (stage.picture(a, 10, light, 48, 64)[..., :3] for a in (0, 90))
    (_, opposite) = stage.turn(2, light, 48, 64, 0, lambda done: None, of_light=True)
    here, other = np.abs(turned - first).mean(), np.abs(opposite[..., :3] - first).mean()
    assert here < 0.2 * other, (here, other)
    # The hard key comes from the upper left.
    bright = luminance(first)
    assert bright[:24, :24].mean() > 1.5 * bright[24:, 24:].mean()


def test_the_sky_has_its_sun_where_it_shines_from():
    sky = sheet.clear_sky(128)
    row, column = np.unravel_index(luminance(sky).argmax(), sky.shape[:2])
    from mistyle.core.light import environment_directions

    sun = environment_directions(128, 256)[row, column]
    np.testing.assert_allclose(sun, np.array([0.62, 0.574, 0.534]) / np.linalg.norm([0.62, 0.574, 0.534]), atol=0.04)
    assert np.isfinite(sky).all() and sky.min() >= 0
    assert sky[5, :, 2].mean() > 2 * sky[5, :, 0].mean() and sky[-5].mean() < 0.2


def test_passes_tell_what_they_are_named(ball):
    asset = read_mesh(ball)
    known = {"coverage": [np.full((4, 4, 3), 0.25, np.float32)]}
    passes = aovs(asset, sheet.asset_camera(0, 0, 64), known)
    names = ["albedo", "normal", "roughness", "position", "UV checker", "texel density", "coverage"]
    assert list(passes) == names  # no metallic: it is zero everywhere
    inside = passes["albedo"][..., 3] > 0.999
    assert 0.6 < inside.mean() < 0.75 and (passes["albedo"][0, 0] == 0).all()
    np.testing.assert_allclose(passes["normal"][32, 32, :3], (0.5, 0.5, 1.0), atol=0.05)
    assert passes["normal"][32, 58, 0] > 0.85 and passes["normal"][6, 32, 1] > 0.85
    np.testing.assert_allclose(passes["roughness"][inside][:, :3], 0.5, atol=0.01)
    np.testing.assert_allclose(passes["coverage"][inside][:, :3], 0.25, atol=1e-5)
    assert passes["position"][6, 32, 1] > 0.85 > 0.15 > passes["position"][58, 32, 1]
    colours = {tuple(np.round(c * 255).astype(int)) for c in passes["albedo"][inside][:, :3]}
    assert colours & {(188, 30, 30)} or colours & {(30, 30, 188)}
    # The texture's halves are the upper and the lower half of the ball, from every side.
    upper, lower = (passes["albedo"][row, 32, :3] - passes["albedo"][row, 32, 2::-1] for row in (16, 48))
    assert upper[0] * lower[0] < -0.3


def test_density_is_told_against_the_median(tmp_path):
    """Three squares of one size side by side, the last with a quarter of the others' UVs along each side."""
    vertices, faces, uvs = [], [], []
    for k, (side, at) in enumerate(((0.4, 0.0), (0.4, 0.5), (0.1, 0.0))):
        vertices += [(k, 0, 0), (k + 0.9, 0, 0), (k + 0.9, 0.9, 0), (k, 0.9, 0)]
        faces += [(4 * k, 4 * k + 1, 4 * k + 2), (4 * k, 4 * k + 2, 4 * k + 3)]
        v = 0.5 if k == 2 else 0.0
        uvs += [(at, v), (at + side, v), (at + side, v + side), (at, v + side)]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"vt {u} {v}" for u, v in uvs]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in faces]
    (tmp_path / "row.obj").write_text("\n".join(lines))
    asset = read_mesh(tmp_path / "row.obj", uv="keep")
    from mistyle.render.lookdev.scenes import material_maps
    from mistyle.render.mitsuba.draw import gbuffer

    maps = [material_maps(m) for m in asset.materials]
    hits = gbuffer(asset.mesh, sheet.asset_camera(0, 0, 96))
    colours, median = density(asset.mesh, hits, maps)
    first, last = (colours[hits.mask & (hits.face // 2 == k)].mean(axis=0) for k in (0, 2))
    np.testing.assert_allclose(first, (0.93, 0.93, 0.91), atol=0.01)
    np.testing.assert_allclose(last, (0.13, 0.35, 0.75), atol=0.01)
    span = float(np.ptp(asset.mesh.positions[:, 0])) / 2.9
    assert abs(median - 0.4 * 2 / (0.9 * span)) < 0.01 * median  # a material without textures has maps of 2 x 2


def test_the_canvas_keeps_pictures_as_they_are_and_aligns_them():
    grey = [np.full((40, w, 3), v, np.float32) for w, v in ((60, 0.2), (50, 0.4), (50, 0.6))]
    rows = (PanelRow("a heading", tuple(Panel(p, "name", "+1") for p in grey)), PanelRow("one", (Panel(grey[0], "n"),)))
    picture = compose(Sheet("title", ("a line",), rows, "foot"), 200, 0.5)
    left = sheet_canvas.measures(0.5)["margin"]
    assert picture.shape[1] == 200 + 2 * left
    (row,) = np.flatnonzero(picture[:, left + 199, 0] == np.float32(0.6))[:1]
    assert (picture[row, left : left + 60] == np.float32(0.2)).all() and (picture[row, left + 200 :] < 0.02).all()
    assert picture[:row].max() > 0.5, "title and heading are written"
    assert np.array_equal(picture, compose(Sheet("title", ("a line",), rows, "foot"), 200, 0.5))


def test_long_captions_are_shortened():
    assert fitted("short", 20, 500) == "short"
    cut = fitted("a caption that is far too long for its panel", 20, 120)
    assert cut.endswith("…") and cut.startswith("a cap")


def test_turntables_are_files(tmp_path, rng):
    frames = [rng.random((24, 26, 4)).astype(np.float32) for _ in range(5)]
    write_turn(tmp_path / "longer", frames)
    first = (tmp_path / "longer.webp").read_bytes()
    write_turn(tmp_path / "turn", frames[:4])
    assert sorted(p.name for p in (tmp_path / "turn").iterdir()) == [f"{k:03}.png" for k in range(4)]
    back = np.asarray(Image.open(tmp_path / "turn" / "002.png"))
    assert back.shape == (24, 26, 4) and np.abs(back / 255 - frames[2]).max() <= 0.5 / 255 + 1e-6
    with Image.open(tmp_path / "turn.webp") as film:
        assert film.n_frames == 4 and film.size == (26, 24) and film.info["loop"] == 0
    write_turn(tmp_path / "turn", frames)
    assert (tmp_path / "turn.webp").read_bytes() == first


def test_mp4_is_what_another_decoder_shows(tmp_path):
    """Even sides, as many frames as were given, in their colours; OpenCV reads it."""
    import cv2

    pytest.importorskip("imageio_ffmpeg", reason="mp4 needs mistyle[video]")
    frames = [np.full((33, 48, 4), 1, np.float32) * (k / 5, 0.5, 1 - k / 5, 1) for k in range(6)]
    write_turn(tmp_path / "turn", [f.astype(np.float32) for f in frames], mp4=True)
    film = cv2.VideoCapture(str(tmp_path / "turn.mp4"))
    shown = []
    while (read := film.read())[0]:
        shown.append(read[1][..., ::-1] / 255)
    assert len(shown) == 6 and shown[0].shape == (32, 48, 3)
    for frame, found in zip(frames, shown, strict=True):
        np.testing.assert_allclose(found.mean(axis=(0, 1)), frame[0, 0, :3], atol=0.03)


def test_mp4_without_its_encoder_is_refused_before_anything_is_drawn(tmp_path, ball, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    code = main(["lookdev", str(ball), "-o", str(tmp_path / "out"), "--turntable", "4", "--mp4"])
    assert code == EnvironmentMissing.exit_code and "mistyle[video]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_sheet_from_the_command_line(tmp_path, ball, capsys):
    out = tmp_path / "out"
    words = ["--size", "64", "--spp", "1", "--frame", "32", "--turntable", "3", "--date", "2026-01-02", "--json"]
    assert main(["lookdev", str(ball), "-o", str(out), *words]) == 0
    files = json.loads(capsys.readouterr().out)
    assert isinstance(files.pop("notes"), list)
    assert set(files) == {"sheet", "exr", "turntable"} and all(Path(p).is_file() for p in files.values())
    planes = read_exr(out / "lookdev.exr")
    linear = np.stack([planes[c] for c in "RGB"], axis=-1).astype(np.float32)
    picture = np.asarray(Image.open(out / "lookdev.png")).astype(float)
    assert np.abs(srgb_from_linear(np.clip(linear, 0, 1)) * 255 - picture).max() <= 1.01  # 16-bit floats
    assert len(list((out / "turntable").glob("*.png"))) == 3 and not (out / "light_turn").exists()
    record = json.loads((out / "lookdev.json").read_text())
    assert record["date"] == "2026-01-02" and len(record["sha256"]) == 64 and len(record["exposure_stops"]) == 3


@pytest.mark.parametrize("compile_seconds", [0.0, 20.0])
def test_the_time_left_allows_for_kernels(monkeypatch, compile_seconds):
    """Pictures of three sizes: the first of each compiles, or finds its kernels stored by an earlier run."""
    now = [100.0]
    monkeypatch.setattr(lookdev_job.time, "perf_counter", lambda: now[0])
    sizes = [240] * 3 + [130] * 5 + [80] * 8
    seconds = [1 + compile_seconds * (k in (0, 3, 8)) for k in range(16)]
    pace = lookdev_job.Pace(sizes)
    for k, each in enumerate(seconds[:-1]):
        now[0] += each
        done, elapsed, left = pace.drawn(), sum(seconds[: k + 1]), sum(seconds[k + 1 :])
        estimate = elapsed / done - elapsed
        assert left / 3 <= estimate <= 3 * left
        assert k < 1 or left / 1.5 <= estimate <= 1.5 * left
