"""The benchmark of consistency: what its peer is given, and what its sheet shows, on a plane."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.consistency import judge as consistency_judge
from benchmarks.consistency import peer as consistency_peer
from benchmarks.consistency import scene as consistency_scene
from mistyle.core.asset import Picture
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface.exemplar import exemplar as styles
from tests.measure.test_metrics import noise, plane_view

# Instead of EbSynth: checks its arguments as EbSynth would, and answers with the target's colour guide.
PROGRAM = """#!{python}
import sys
from PIL import Image
arguments = sys.argv[1:]
style, first = Image.open(arguments[arguments.index("-style") + 1]), arguments.index("-guide")
source, target = arguments[first + 1], arguments[first + 2]
assert Image.open(source).size == style.size and arguments.count("-guide") == 2 and arguments.count("-weight") == 2
Image.open(target).save(arguments[arguments.index("-output") + 1])
"""


def scene(rng) -> consistency_scene.Scene:
    """Two views of the plane, a noisy painting, guides of known values."""
    views = (plane_view(0), plane_view(30))
    painting = noise(rng, size=128, sigma=2)
    coloured = tuple(np.where(v.mask[..., None], [0.2, 0.4, 0.6], 0).astype(np.float32) for v in views)
    detail = tuple(np.where(v.mask, 0.5, 0).astype(np.float32) for v in views)
    nothing: object = None
    return consistency_scene.Scene(
        asset=nothing,  # type: ignore[arg-type]
        texels=(),
        style=Picture(painting, None, Path("noise.png")),
        settings=Settings.model_validate({"surface": {"detail": 4.0}}),
        views=views,
        clay=coloured,
        colour=coloured,
        detail=detail,
        painting=painting,
        opaque=np.ones((128, 128), bool),
    )


@pytest.mark.skipif(sys.platform == "win32", reason="a script with a first line")
def test_the_peer_gets_guides_of_the_paintings_size_and_its_pictures_are_masked(rng, tmp_path):
    program = tmp_path / "peer"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    given = scene(rng)
    row = consistency_peer.ebsynth(program)(given)
    for picture, view in zip(row.pictures, given.views, strict=True):
        assert not picture[~view.mask].any()
        np.testing.assert_allclose(
            picture[view.mask], np.broadcast_to([0.2, 0.4, 0.6], (view.mask.sum(), 3)), atol=3e-3
        )
    assert row.seconds > 0 and row.held_gb > 0.001 and row.albedo is None


def test_source_guides_are_the_synthesis_own(rng):
    """The page's large-area colour and its band, at the same size."""
    painting = noise(rng, size=128, sigma=2)
    page = styles.exemplar(styles.StyleImage(painting, np.ones((128, 128), bool)), 128, 0.0)
    broad, band = consistency_peer.source_guides(painting)
    np.testing.assert_allclose(
        styles.lab_from_srgb(broad).reshape(-1, 3), page.broad[: 128 * 128], atol=4e-3
    )  # OpenCV goes through tables
    np.testing.assert_allclose(band.reshape(-1), page.band[: 128 * 128], atol=1e-5)
    assert consistency_peer.grey(np.array([[0.1]]))[0, 0].tolist() == pytest.approx([0.6] * 3)


def test_the_sheet_shows_every_row(rng, tmp_path):
    from PIL import Image

    given = scene(rng)
    given = replace(given, views=given.views * 3, clay=given.clay * 3)
    consistency_judge.sheet(tmp_path / "sheet.png", given, {"a": given.clay, "b": given.clay})
    with Image.open(tmp_path / "sheet.png") as picture:
        assert picture.size == (4 * consistency_judge.TILE, 3 * consistency_judge.TILE)
        assert np.asarray(picture)[consistency_judge.TILE :].max() > 150


def test_means_leave_out_what_is_no_number():
    assert consistency_judge.mean([1.0, float("nan"), 3.0]) == 2
    assert np.isnan(consistency_judge.mean([float("nan")]))
    assert consistency_judge.span(np.array([False, True, True, False])) == (1, 3)
