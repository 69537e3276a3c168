"""What is read from a style picture, on made pictures whose measures are known, and what follows from it."""

import cv2
import numpy as np
import pytest

from mistyle.core.errors import UsageError
from mistyle.stylization.settings import resolve
from mistyle.stylization.surface import field, synthesis
from mistyle.stylization.surface.exemplar import edges
from mistyle.stylization.surface.exemplar import exemplar as style
from mistyle.stylization.surface.exemplar.chosen import FROM_PAINTING, flat, graphic, resolved, settled
from mistyle.stylization.surface.exemplar.reading import read_style
from mistyle.stylization.surface.settings import SurfaceSettings
from tests.support.helpers import data, fixed_surface


def noise(size=(384, 512), blur=2.0, seed=0):
    """A painterly picture: blurred colour noise over the whole range."""
    rough = np.random.default_rng(seed).normal(size=(*size, 3)).astype(np.float32)
    calm = cv2.GaussianBlur(rough, (0, 0), blur)
    return np.clip(0.5 + 0.2 * calm / calm.std(), 0, 1)


def oil():
    """As much contrast at every scale, as brushwork has."""
    octaves = [noise(blur=2.0**k, seed=k) - 0.5 for k in range(6)]
    return np.clip(0.5 + 0.45 * sum(octaves), 0, 1)


def shapes(seed=0):
    """Large discs of one colour each on one ground."""
    rng = np.random.default_rng(seed)
    picture = np.full((384, 512, 3), 230, np.uint8)
    for _ in range(12):
        centre = (int(rng.integers(512)), int(rng.integers(384)))
        cv2.circle(picture, centre, int(rng.integers(40, 70)), (255 * rng.random(3)).tolist(), -1, cv2.LINE_AA)
    return (picture / 255).astype(np.float32)


def tiles(period, size=512):
    """Light tiles with dark joints."""
    y, x = np.mgrid[:size, :size]
    joint = (y % period < period / 6) | (x % period < period / 6)
    rng = np.random.default_rng(0)
    tone = 0.7 + 0.1 * rng.random((size // period + 1, size // period + 1))[y // period, x // period]
    return np.repeat(np.where(joint, 0.15, tone)[..., None], 3, axis=2).astype(np.float32)


def bent(period, wave=0.35, size=512):
    """The tiles with rows that rise and sink by `wave` of their length, with grain."""
    y, x = np.mgrid[:size, :size].astype(np.float32)
    shift = wave * size / (2 * np.pi) * np.sin(2 * np.pi * x / size)
    picture = cv2.remap(tiles(period, 2 * size), x, (y + shift + size / 4).astype(np.float32), cv2.INTER_LINEAR)
    return np.clip(picture + 0.02 * np.random.default_rng(1).normal(size=picture.shape), 0, 1).astype(np.float32)


def stripes(angle, period=17.0, size=400):
    """Waves whose crests run along `angle` degrees, counter-clockwise from the x axis."""
    y, x = np.mgrid[:size, :size]
    a = np.radians(angle)
    across = x * np.sin(a) + y * np.cos(a)
    return np.repeat((0.5 + 0.4 * np.sin(2 * np.pi * across / period))[..., None], 3, axis=2).astype(np.float32)


def art(sides, quality=None, seed=1):
    """Pixel art of a few colours, enlarged; with `quality` through a JPEG."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (6, 3)).astype(np.uint8)[rng.integers(0, 6, (40, 56))]
    large = small.repeat(sides[0], axis=0).repeat(sides[1], axis=1)
    if quality is not None:
        large = cv2.imdecode(cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)
    return (large / 255).astype(np.float32)


@pytest.mark.parametrize("sides", [(1, 1), (2, 2), (3, 3), (5, 5), (2, 4)])
def test_the_grid_of_pixel_art_is_found(sides):
    assert edges.pixel_grid(art(sides)) == sides


@pytest.mark.parametrize("side", [2, 3, 4, 5, 8])
def test_the_grid_is_found_through_a_light_jpeg(side):
    assert edges.pixel_grid(art((side, side), quality=90)) == (side, side)


@pytest.mark.parametrize(
    "picture", [noise(), noise(blur=0.5), oil(), shapes(), style.blurred(tiles(32), 1.0), stripes(30)]
)
def test_other_pictures_have_no_grid(picture):
    assert edges.pixel_grid(picture) == (0, 0)
    compressed = cv2.imencode(".jpg", (255 * picture).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    assert edges.pixel_grid((cv2.imdecode(compressed, 1) / 255).astype(np.float32)) == (0, 0)


@pytest.mark.parametrize("picture", [bent(16), bent(24), 1 - bent(24), tiles(16), style.resized(bent(24), (384, 384))])
def test_tiles_are_closed_cells_of_one_size_even_where_rows_bend(picture):
    reading = read_style(picture)
    assert reading.tiled > 0.3 and graphic(reading) == 1


@pytest.mark.parametrize("picture", [noise(), noise(blur=0.7), oil(), shapes(), stripes(30), stripes(0, period=9.0)])
def test_strokes_and_shapes_are_no_tiles(picture):
    assert read_style(picture).tiled < 0.12


def lettered(left, base, ink=0.1, ground=0.8):
    """Brushwork with a calm part, and a word on it; and the word's pixels."""
    picture, word = (255 * noise((768, 1024), 4.0)).astype(np.uint8), np.zeros((768, 1024), np.uint8)
    picture[base - 60 : base + 40, left - 20 : left + 240] = 255 * ground
    cv2.putText(word, "NAME 1913", (left, base), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2, cv2.LINE_AA)
    share = word[..., None] / np.float32(255)
    return (picture / np.float32(255)) * (1 - share) + ink * share, word > 40


@pytest.mark.parametrize("place", [(40, 70), (740, 720), (40, 70, 0.9, 0.3)])
def test_words_on_calm_ground_near_the_edge_are_not_copied(place):
    """The box holds the word and little more; what it leaves of the picture has no ink."""
    picture, word = lettered(*place)
    reading = read_style(picture)
    (box,) = reading.lettering
    rows, columns = np.nonzero(word)
    top, left, bottom, right = box[0] * 768, box[1] * 1024, box[2] * 768, box[3] * 1024
    assert top <= rows.min() and rows.max() < bottom and left <= columns.min() and columns.max() < right
    assert (bottom - top) * (right - left) < 3 * np.ptp(rows) * np.ptp(columns)
    made = resolved(SurfaceSettings(), reading)
    alpha = style.without(None, picture.shape, made.omit)
    assert alpha is not None and not alpha[word].any() and alpha.mean() > 0.97
    ground = 0.8 if len(place) == 2 else place[3]
    assert np.abs(style.prepare(picture, alpha=alpha).rgb[word] - ground).max() < 0.02
    assert resolved(SurfaceSettings(omit=()), reading).omit == ()


@pytest.mark.parametrize("picture", [noise(), oil(), shapes(), tiles(32), bent(16), stripes(30), art((3, 3))])
def test_what_has_no_lettering_is_copied_whole(picture):
    assert read_style(picture).lettering == ()


@pytest.mark.parametrize("period", [16, 32, 64])
def test_the_unit_is_the_period_of_tiles(period):
    reading = read_style(tiles(period))
    assert reading.unit == pytest.approx(period / 512, rel=0.15)
    assert reading.clarity > 0.25 and reading.rectilinear > 0.6
    assert {round(d / 90) * 90 % 180 for d in reading.directions} == {0, 90}


def test_the_unit_does_not_depend_on_the_size_of_the_file():
    picture = tiles(32)
    large = cv2.resize(picture, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    assert read_style(np.clip(large, 0, 1)).unit == pytest.approx(read_style(picture).unit, rel=0.1)


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 135.0])
def test_stripes_are_lines_with_a_direction(angle):
    reading = read_style(stripes(angle))
    assert reading.line_likeness > 0.9 and reading.unit == pytest.approx(17 / 400, rel=0.15)
    off = abs((reading.directions[0] - angle + 90) % 180 - 90)
    assert len(reading.directions) == 1 and off < 3
    assert read_style(noise()).line_likeness < 0.6 and read_style(noise()).directions == ()


def test_flat_shapes_are_flat_and_noise_is_not():
    assert read_style(shapes()).flatness > 0.5 > 0.02 > read_style(noise()).flatness
    grain = np.random.default_rng(0).normal(scale=0.01, size=(384, 512, 3)).astype(np.float32)
    assert read_style(np.clip(shapes() + grain, 0, 1)).flatness > 0.5


def test_tones_are_counted():
    rng = np.random.default_rng(0)
    for count in (1, 2, 3):
        levels = np.linspace(0.1, 0.9, count).astype(np.float32) if count > 1 else np.array([0.5], np.float32)
        field = cv2.resize(rng.integers(0, count, (12, 16)).astype(np.uint8), (512, 384), interpolation=0)
        assert read_style(np.repeat(levels[field][..., None], 3, 2)).tones == count
    ramp = np.repeat(np.tile(np.linspace(0, 1, 512, dtype=np.float32), (384, 1))[..., None], 3, 2)
    assert read_style(ramp).tones >= 4


def test_a_margin_of_paper_is_border_and_the_picture_is_not():
    paper = np.full((480, 640, 3), [0.93, 0.9, 0.82], np.float32)
    paper[48:-48, 32:-32] = noise((384, 576))
    top, left, bottom, right = read_style(paper).border
    assert top == pytest.approx(0.1, abs=0.015) and bottom == pytest.approx(0.1, abs=0.015)
    assert left == pytest.approx(0.05, abs=0.012) and right == pytest.approx(0.05, abs=0.012)
    assert max(read_style(noise()).border) < 0.02 and read_style(art((3, 3))).border == style.UNCROPPED


def test_a_sky_of_one_colour_on_one_side_is_no_border():
    picture = noise()
    picture[:60] = [0.5, 0.6, 0.9]
    assert max(read_style(picture).border) < 0.02


def test_transparent_parts_are_filled_and_have_no_border():
    picture, alpha = noise(), np.ones((384, 512), np.float32)
    alpha[:, :40] = 0
    reading = read_style(picture, alpha)
    assert reading.border == style.UNCROPPED and reading == read_style(picture, alpha)


def test_settings_follow_the_reading_where_they_are_open():
    for picture in (noise(), shapes(), tiles(32), art((3, 3))):
        made = resolved(SurfaceSettings(), read_style(picture))
        assert all(getattr(made, name) is not None for name in FROM_PAINTING)
    brush, print_, pixels = (resolved(SurfaceSettings(), read_style(p)) for p in (oil(), shapes(), art((3, 3))))
    assert print_.stroke_coherence == 0.1 > brush.stroke_coherence and print_.detail == 3 < brush.detail
    assert (pixels.look_up, print_.look_up, brush.look_up) == ("nearest", "bilinear", "bilinear")
    assert (print_.borders, print_.palette) == ("cut", 0.05)
    assert print_.modelling == 0 < brush.modelling


def test_what_is_set_is_kept():
    own = {"levels": 4, "detail": 7.0, "palette": 0.0, "stroke_coherence": 0.2, "look_up": "nearest", "crop": 0.1}
    made = resolved(SurfaceSettings(**own), read_style(shapes()))
    assert made.model_dump() | own | {"crop": (0.1,) * 4} == made.model_dump()
    sides = SurfaceSettings(crop=(0.0, 0.1, 0.2, 0.0))
    assert settled(shapes(), None, sides).crop == (0.0, 0.1, 0.2, 0.0)
    with pytest.raises(ValueError, match="reading"):
        resolved(SurfaceSettings(), None)


def test_the_crop_is_taken_side_by_side():
    picture = noise((100, 200))
    assert style.prepare(picture, (0.1, 0.05, 0.2, 0.0)).rgb.shape == (70, 190, 3)
    np.testing.assert_array_equal(style.prepare(picture, (0.1, 0.05, 0.2, 0.0)).rgb, picture[10:80, 10:])


def test_the_old_name_is_answered_with_the_new_one():
    with pytest.raises(UsageError, match="now called 'surface.stroke_scale'"):
        resolve(None, None, {"surface": {"style_scale": 2.0}}, {})
    with pytest.raises(UsageError, match=r"'coat\.height' is now called 'paint\.height'"):
        resolve(None, None, {"coat": {"height": 0.2}}, {})
    assert (
        resolve(None, None, {"surface": {"stroke_coherence": 0.2, "crop": [0.1, 0, 0, 0]}}, {}).surface.levels is None
    )


@pytest.mark.parametrize("samples", [80_000, 250_000, 1_000_000])
def test_the_coarsest_level_sees_the_same_share_of_the_painting_at_every_stroke_scale(samples):
    for scale in (0.5, 1.0, 2.0, 4.0):
        settings = fixed_surface(samples=samples, stroke_scale=scale)
        coarsest = synthesis.finest_size(settings) / 2 ** (synthesis.level_count(settings) - 1)
        assert 22 <= coarsest <= 46
    levels = [synthesis.level_count(fixed_surface(samples=samples, levels=count)) for count in (5, 6)]
    assert levels[1] == levels[0] + 1


def test_a_piece_copied_once_is_no_overuse_where_the_surface_shows_a_part_of_the_picture():
    book = style.exemplar(style.prepare(noise((200, 200))), 200, 0.0)
    row, column = np.mgrid[50:90, 50:90].reshape(2, -1).astype(np.float32)
    page = np.zeros(len(row), np.int32)
    once = field.usage(book, field.NearestNeighbourField(page, column, row)).reshape(200, 200)
    twice = field.usage(book, field.NearestNeighbourField(page, column, 50 + np.floor(row / 2 - 25))).reshape(200, 200)
    assert once[60:80, 60:80] == pytest.approx(1) and twice[55:65, 60:80] == pytest.approx(2)


REAL = {
    "mosaic_ducks.jpg": lambda r: 0.02 < r.unit < 0.06 and graphic(r) > 0.8,
    "pixelart_rpg_urban.png": lambda r: r.pixel_grid == (1, 1) and abs(r.unit * 432 - 16) < 2,
    "woodcut_head.jpg": lambda r: r.tones == 2 and flat(r) == 1,
    "great_wave.jpg": lambda r: r.flatness > 0.2 and graphic(r) == 1 and len(r.lettering) == 1,
    "starry_night.jpg": lambda r: flat(r) < 0.1 and graphic(r) < 0.3 and r.tones > 3 and r.lettering == (),
    "udnie.jpg": lambda r: len(r.lettering) == 2,
    "shipwreck_minotaur.jpg": lambda r: graphic(r) < 0.5,
}


@pytest.mark.parametrize("name", sorted(REAL))
def test_paintings_read_as_what_they_are(name):
    from mistyle.io.read import read_picture

    reading = read_style(read_picture(data(f"styles/{name}")).rgb)
    assert REAL[name](reading), reading
