"""benchmarks.gallery: how pairs of pictures are judged and which differences are explained. No Blender is needed."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from benchmarks.gallery import __main__ as gallery
from benchmarks.gallery.draw import Drawn
from mistyle.core.errors import UsageError

SIZE = 64


def disc(colour: tuple[float, float, float]) -> np.ndarray:
    """A premultiplied picture (SIZE, SIZE, 4): a disc of one linear colour on nothing."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    alpha = ((x**2 + y**2) < (SIZE / 3) ** 2).astype(np.float32)[..., None]
    return np.concatenate([alpha * np.array(colour, np.float32), alpha], axis=-1)


def drawn(ours, theirs, notes: tuple[str, ...] = (), **more) -> Drawn:
    return Drawn("a/b.glb", "a_b_glb", notes, ours=ours, theirs=theirs, **more)


def test_equal_pictures_are_no_distance_apart():
    picture = disc((0.6, 0.3, 0.1))
    assert gallery.apart(picture, picture) == (0.0, 0.0)


def test_the_background_dilutes_one_figure_and_not_the_other():
    whole, on_model = gallery.apart(disc((0.6, 0.1, 0.1)), disc((0.1, 0.6, 0.1)))
    covered = disc((1, 1, 1))[..., 3].mean()
    assert whole > 0.1
    assert on_model > whole
    # FLIP's filters reach a little beyond the disc, so that the background is not quite free of error.
    assert whole == pytest.approx(on_model * covered, rel=0.25)


def test_what_only_one_side_draws_counts():
    nothing = np.zeros((SIZE, SIZE, 4), np.float32)
    whole, on_model = gallery.apart(nothing, disc((1.0, 1.0, 1.0)))
    assert whole > gallery.LIMIT
    assert on_model > whole


def test_a_difference_is_silent_until_a_note_explains_it(tmp_path):
    pair = disc((0.6, 0.1, 0.1)), disc((0.1, 0.6, 0.1))
    reasons = {"notes": {"emits light": "emission is not drawn"}, "models": {}}
    silent = gallery.row(drawn(*pair, notes=("A primitive has no normals.",)), tmp_path, reasons)
    said = gallery.row(drawn(*pair, notes=("Material 'x' emits light.",)), tmp_path, reasons)
    assert silent.silent and silent.reason == ""
    assert not said.silent and said.reason == "emission is not drawn"
    assert (tmp_path / silent.ours).is_file() and (tmp_path / silent.cycles).is_file()


@pytest.mark.parametrize(
    ("entry", "explained"),
    [
        ({"reason": "no sheen", "note": "KHR_materials_sheen"}, True),
        ({"reason": "no sheen", "note": "KHR_materials_clearcoat"}, False),
        ({"reason": "nobody said so"}, False),
        ({"reason": "Blender fills missing normals", "by": "cycles"}, True),
    ],
)
def test_a_reason_holds_with_its_note_or_as_blenders_departure(entry, explained):
    reasons = {"notes": {}, "models": {"a/b.glb": entry}}
    assert gallery.why("a/b.glb", ["KHR_materials_sheen is not drawn."], reasons) == (entry["reason"], explained)


def test_figures(tmp_path):
    none = {"notes": {}, "models": {}}
    red, green = disc((0.6, 0.1, 0.1)), disc((0.1, 0.6, 0.1))
    same = gallery.row(drawn(red, red), tmp_path, none)
    other = replace(gallery.row(drawn(red, green), tmp_path, none), model="c.glb")
    refused = gallery.row(drawn(None, None, ("c.glb: found nothing",), refused=True), tmp_path, none)
    failed = gallery.row(drawn(red, None, trouble="Blender crashed"), tmp_path, none)
    rows = [same, other, refused, failed]
    figures = gallery.tally(rows)
    assert figures["models"] == 2
    assert figures["within_flip_005"] == figures["within_on_model"] == 1
    assert figures["share_within"] == 0.5
    assert figures["silent_differences"] == 1
    assert figures["refused"] == 1
    assert figures["cycles_failed"] == 1
    assert gallery.worst_first(rows)[0] is other
    (tmp_path / "gallery.json").write_text(json.dumps([asdict(r) for r in rows]))
    assert gallery.again(tmp_path) == rows
    assert 'class="silent"' in gallery.page(rows, figures)


def test_a_list_names_models_and_missing_ones_are_said(tmp_path):
    (tmp_path / "a.glb").touch()
    (tmp_path / "b.txt").touch()
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "c.usda").touch()
    assert gallery.models_of(tmp_path, None, "*") == ["a.glb", "sub/c.usda"]
    assert gallery.models_of(tmp_path, None, "sub/*") == ["sub/c.usda"]
    (tmp_path / "models.txt").write_text("# a list\nsub/c.usda  # one\n\n")
    assert gallery.models_of(tmp_path, None, "*") == ["sub/c.usda"]
    (tmp_path / "models.txt").write_text("d.glb\n")
    with pytest.raises(UsageError, match=r"found no d\.glb"):
        gallery.models_of(tmp_path, None, "*")


def test_the_reasons_of_the_repository_are_well_formed():
    reasons = gallery.read_json(gallery.REASONS)
    assert set(reasons) == {"notes", "models"}
    for model, entry in reasons["models"].items():
        assert set(entry) - {"mend"} in ({"reason", "note"}, {"reason", "by"}), model
        assert entry.get("by") == "cycles" or "mend" not in entry, model
        assert entry.get("by", "cycles") in gallery.BY, model
