"""The benchmark of looks: its made styles, its sheets and key, and how answers are scored."""

import json
import sys

import cv2
import numpy as np
import pytest

from benchmarks.look import __main__ as look
from benchmarks.look import light as look_light
from benchmarks.look import paint as look_paint
from benchmarks.look import peer as look_peer
from benchmarks.look import score as look_score
from benchmarks.look import sheets as look_sheets
from benchmarks.look import styles as look_styles
from benchmarks.look.paint import Piece, Tree
from benchmarks.pipeline.against import Took, compared, of_reports, placed
from mistyle.measure.baked_light import BakedLight


def choice_line(kind: str, head: str, preset: str = "draft", test: str = "choice") -> dict[str, str]:
    other = "B" if head == "A" else "A"
    return {"test": test, "kind": kind, "preset": preset, head: "head", other: "other", "sha256": f"{kind}{head}"}


KEY = {
    "sheets": {
        "one": choice_line("oil", "A"),
        "two": choice_line("structured", "B"),
        "three": {"test": "odd", "kind": "oil", "odd": "C", "sha256": "3"},
        "four": choice_line("oil", "B", test="ebsynth"),
        "six": choice_line("structured", "A", test="finish"),
    }
}


def test_made_styles_are_the_same_each_time_and_not_flat():
    first, again = (look_styles.MADE["tartan"][0]() for _ in range(2))
    assert first.dtype == np.uint8 and first.shape[2] == 3 and (first == again).all()
    assert first.std() > 20


def test_sprites_are_squares_of_eight_pixels():
    sheet = look_styles.MADE["sprites"][0]()
    blocks = sheet.reshape(128, 8, 128, 8, 3)
    assert (blocks == blocks[:, :1, :, :1]).all()
    assert (np.diff(sheet.astype(int), axis=1) != 0).any()


def test_every_style_has_a_kind_and_a_file(tmp_path):
    assert set(look_styles.KINDS) == set(look_styles.FOUND) | set(look_styles.MADE)
    assert len(look_styles.KINDS) == 22 and set(look_styles.KINDS.values()) == {"oil", "structured"}
    assert look_styles.file_of("great_wave", tmp_path).name == "great_wave.jpg"
    path = look_styles.file_of("sprites", tmp_path)
    stamp = path.stat().st_mtime_ns
    assert look_styles.file_of("sprites", tmp_path).stat().st_mtime_ns == stamp


def test_choices_count_by_question_kind_and_preset():
    answers = {
        "one": {
            "anna": {"shipped": "A", "style": "B", "shape": "a"},
            "ben": {"shipped": "A", "style": "A", "shape": "B"},
        },
        "two": {"sha256": "structuredB", "anna": {"shipped": "A"}},
        "three": {"anna": {"odd": "C"}, "ben": {"odd": "D"}, "carl": {"odd": "c"}, "dora": {}},
        "four": {"anna": {"shipped": "B", "style": "A"}},
        "six": {"anna": {"shipped": "A"}, "ben": {"shipped": "B"}},
    }
    found = look_score.score(KEY, answers)
    assert found["chosen.ship.oil"] == 1 and found["chosen.style.oil"] == 0.5 and found["chosen.shape.oil"] == 0.5
    assert found["chosen.ship.structured"] == 0 and found["chosen.ship.oil.draft"] == 1
    assert found["odd_one_out"] == pytest.approx(2 / 3) and found["answers.odd_one_out"] == 3
    assert found["chosen.finish.structured"] == 0.5 and "chosen.finish.oil" not in found
    assert found["chosen.ebsynth.oil"] == 1 and found["answers.chosen.ship.oil"] == 2
    assert "chosen.style.structured" not in found


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ({"one": {"sha256": "other", "anna": {"shipped": "A"}}}, "rebuild the sheets"),
        ({"five": {"anna": {"shipped": "A"}}}, "no sheet five"),
        ({"one": {"anna": {"shipped": "C"}}}, "must be one of AB"),
        ({"three": {"anna": {"odd": ""}}}, "must be one of ABCD"),
    ],
)
def test_answers_that_do_not_fit_the_key_are_refused(answers, said):
    with pytest.raises(SystemExit, match=said):
        look_score.score(KEY, answers)


def piece(tmp_path) -> Piece:
    style, mesh = tmp_path / "style.png", tmp_path / "mesh.obj"
    cv2.imwrite(str(style), np.random.default_rng(1).integers(0, 255, (300, 500, 3), np.uint8))
    mesh.write_text("v 0 0 0\n")
    return Piece("made", "mesh", "draft", style, mesh)


def test_a_sheet_shows_what_the_key_says(tmp_path, monkeypatch):
    """Candidates of one colour each: A is above the painting, B below it, whichever way the seed shuffles them."""
    colours = {"ours.glb": 200, "theirs.glb": 60}
    monkeypatch.setattr(look_sheets, "lit", lambda glb: [np.full((372, 372, 3), colours[glb.name], np.uint8)] * 4)
    orders = set()
    for seed in range(8):
        ours, theirs = tmp_path / "ours.glb", tmp_path / "theirs.glb"
        line = look_sheets.build_choice(piece(tmp_path), "oil", ours, theirs, tmp_path, seed)
        path = tmp_path / f"{line['name']}.png"
        sheet = cv2.imread(str(path))
        assert sheet is not None and max(sheet.shape) <= 1500
        shown = {"A": sheet[100, 50, 0], "B": sheet[-100, 50, 0]}
        assert {shown[k]: line[k] for k in "AB"} == {200: "head", 60: "other"}
        assert line["sha256"] == look_paint.sha256(path)
        assert not {"made", "mesh", "draft", "head"} & set(line["name"].split("-"))
        orders.add(line["A"])
    assert orders == {"head", "other"}


def test_the_key_is_read_as_it_was_written(tmp_path, monkeypatch):
    monkeypatch.setattr(look_sheets, "lit", lambda glb: [np.full((372, 372, 3), 90, np.uint8)] * 4)
    line = look_sheets.build_choice(piece(tmp_path), "oil", tmp_path / "a.glb", tmp_path / "b.glb", tmp_path, 0)
    name, place = line["name"], tmp_path / "key.json"
    look_sheets.write_key(place, [line], against="58c2c91")
    ours = "A" if line["A"] == "head" else "B"
    figures = look_score.score(look_score.read_json(place), {name: {"sha256": line["sha256"], "v": {"style": ours}}})
    assert figures["chosen.style.oil"] == 1
    answers, flat = tmp_path / "answers.json", tmp_path / "figures.json"
    answers.write_text(json.dumps({name: {"v": {"shipped": "A"}}}))
    look.main(["score", "--key", str(place), "--answers", str(answers), "--json", str(flat)])
    assert json.loads(flat.read_text())["figures"]["chosen.ship.oil"] == (ours == "A")


def test_the_odd_one_stands_where_the_key_says(tmp_path, monkeypatch):
    monkeypatch.setattr(look_sheets, "about", lambda glb: {"pixel": 0.01})
    sides = []

    def black(glb, unit, pixels, seed):
        sides.append(unit * pixels)
        return np.zeros((pixels, pixels, 3), np.float32)

    monkeypatch.setattr(look_sheets, "piece_of_asset", black)
    painting = np.full((300, 500, 3), 180, np.uint8)
    letters = set()
    for seed in range(12):
        sheet, letter = look_sheets.odd(painting, tmp_path / "a.glb", seed)
        assert max(sheet.shape) <= 1500
        columns = [100 + k * (look_sheets.ENLARGED + look_sheets.GAP) for k in range(4)]
        assert "ABCD"[int(np.argmin([sheet[150, x].sum() for x in columns]))] == letter
        letters.add(letter)
    assert len(letters) > 2
    # 44 of 512 pixels of a painting of 500 pixels, each 0.01 wide on the surface.
    assert sides[0] == pytest.approx(44 / 512 * 500 * 0.01)


def test_pieces_of_the_painting_lie_apart():
    painting = np.random.default_rng(0).integers(0, 255, (256, 512, 3), np.uint8)
    found = look_sheets.cuts(painting, 3, np.random.default_rng(3))
    assert [one.shape for one in found] == [(44, 44, 3)] * 3
    assert all(np.abs(found[a] - found[b]).mean() > 0.1 for a, b in ((0, 1), (0, 2), (1, 2)))


def test_means_of_light_are_over_styles():
    def light(ratio, y=0.0):
        return BakedLight(ratio, 0.1, y, 0.0, -0.3)

    found = look_light.mean_light([[light(4.0, 0.8), light(1.0, -0.4)], [light(0.5), light(None)]])
    assert found["light.ratio_mean"] == pytest.approx(1.0)
    assert found["light.ratio_spread"] == pytest.approx(2.0) and found["light.ratio_worst"] == pytest.approx(2.0)
    assert found["light.correlation"] == pytest.approx(0.3) and found["light.correlation.y"] == pytest.approx(0.3)


def test_the_close_camera_sees_the_whole_object_and_fills_the_picture(rng):
    points = rng.normal(size=(500, 3)) * (0.3, 0.1, 0.2) + (0.2, 0.0, -0.1)
    camera = look_light.close_camera(points, 40.0, 15.0, 100)
    seen = (points - camera.position) @ camera.world_from_cam[:3, :3]
    px = camera.focal * seen[:, :2] / seen[:, 2:] + np.ravel(camera.centre)
    assert px.min() > 0 and px.max() < 100
    assert np.abs(px - 50).max() == pytest.approx(50 / look_light.MARGIN, rel=0.02)


WORKER = """
import json, pathlib, sys
for job in json.load(sys.stdin):
    pathlib.Path(job["keep"]).write_text(" ".join([*job["arguments"], str(job.get("goes_on"))]))
    print(job["keep"], flush=True)
"""


def test_what_was_painted_once_is_not_painted_again(tmp_path, monkeypatch):
    worker = tmp_path / "worker.py"
    worker.write_text(WORKER)
    monkeypatch.setattr(look_paint, "WORKER", worker)
    tree, one = Tree("HEAD", tmp_path, "abc"), piece(tmp_path)
    (glb,) = look_paint.painted(tree, [one], tmp_path)
    assert "--preset draft" in glb.read_text() and "--refine off" in glb.read_text()
    worker.write_text("raise SystemExit('painted again')")
    assert look_paint.painted(tree, [one], tmp_path) == [glb]
    changed = look.with_settings([one], ["surface.detail=1"])
    with pytest.raises(SystemExit, match="painted again"):
        look_paint.painted(tree, changed, tmp_path)
    with pytest.raises(SystemExit, match="painted again"):
        look_paint.painted(Tree("HEAD", tmp_path, "abd"), [one], tmp_path)


def test_a_finish_goes_on_from_its_own_painting_alone(tmp_path, monkeypatch):
    worker = tmp_path / "worker.py"
    worker.write_text(WORKER)
    monkeypatch.setattr(look_paint, "WORKER", worker)
    one = piece(tmp_path)
    other = Piece(**vars(one) | {"mesh": "bunny", "options": (*one.options, "--uv", "new")})
    order = [
        one,
        look_paint.finished(one, tmp_path / "vgg.pth"),
        other,
        look_paint.finished(other, tmp_path / "vgg.pth"),
    ]
    texts = [glb.read_text() for glb in look_paint.painted(Tree("HEAD", tmp_path, "abc"), order, tmp_path)]
    assert [text.split()[-1] for text in texts] == ["None", "True", "False", "True"]
    assert "--finish vgg" in texts[1] and "--finish" not in texts[2]


def test_a_tree_is_known_by_its_program(tmp_path):
    (tmp_path / "mistyle").mkdir()
    code = tmp_path / "mistyle/a.py"
    code.write_text("1")
    first = look_paint.program_hash(tmp_path)
    (tmp_path / "README.md").write_text("words")
    assert look_paint.program_hash(tmp_path) == first
    code.write_text("2")
    assert look_paint.program_hash(tmp_path) != first


def test_unknown_names_are_refused():
    with pytest.raises(SystemExit, match="no 'bob'"):
        look.pieces(look.options(["--meshes", "bob"]), ["draft"])
    with pytest.raises(SystemExit, match="no such commit"):
        look_paint.tree_at("not-a-commit", look_paint.ROOT)


def test_ratios_are_of_the_quickest_runs():
    def took(wall, cpu, report):
        return Took(wall, cpu, report, None, {"figures": {"seen_share": 0.9, "word": "x"}})

    found = compared("draft", [took(100, 150, 40), took(80, 120, 50)], [took(20, 60, 4), took(40, 30, 10)])
    assert found["ratio.draft"] == 0.25 and found["ratio.draft.cpu"] == 0.25 and found["ratio.report.draft"] == 0.1
    assert found["draft.here.seen_share"] == 0.9
    other = compared("standard", [took(100, 1, 40)], [took(100, 1, 20)])
    assert of_reports(found | other) == {"ratio.report": 0.5}


def test_objects_are_placed_side_by_side(tmp_path):
    source = tmp_path / "one.obj"
    source.write_text("mtllib x.mtl\nv 0 0 0\nv 2 0 0\nv 0 4 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\nf 1//1 2//1 3//1\n")
    lines, counts = placed(source, 4, np.array([10, 20, 30]))
    assert counts.tolist() == [3, 1, 0]
    assert "f 11/21 12/21 13/21" in lines and "f 11//31 12//31 13//31" in lines
    points = np.array([[float(x) for x in line.split()[1:]] for line in lines if line.startswith("v ")])
    np.testing.assert_allclose(points.max(axis=0) + points.min(axis=0), [2.2, 0, 2.2], atol=1e-6)
    assert np.ptp(points, axis=0).max() == pytest.approx(1) and not any("mtllib" in line for line in lines)


# Instead of EbSynth: answers with the target of the last guide, and fails where a source is not of the style's size.
EBSYNTH = """#!{python}
import sys
from PIL import Image
words = sys.argv[1:]
guides = [k for k, word in enumerate(words) if word == "-guide"]
size = Image.open(words[words.index("-style") + 1]).size
assert all(Image.open(words[k + 1]).size == size and words[k + 3] == "-weight" for k in guides)
Image.open(words[guides[-1] + 2]).save(words[words.index("-output") + 1])
"""


def test_the_peer_is_given_the_guides_without_a_silhouette(tmp_path):
    program = tmp_path / "ebsynth"
    program.write_text(EBSYNTH.format(python=sys.executable))
    program.chmod(0o755)
    for name in ("style", "source_colour", "source_detail"):
        look_peer.save(tmp_path / f"{name}.png", np.full((20, 30, 3), 0.5))
    mask = np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    colour, earlier = (
        np.where(mask[..., None], value, 0).astype(np.float32) * np.ones(3, np.float32) for value in (0.2, 0.8)
    )
    wanted = {"colour": colour, "detail": look_peer.grey(np.zeros((16, 16)))}
    assert np.abs(look_peer.stylized(program, tmp_path, mask, wanted, "4") - 0.5).max() < 0.01
    found = look_peer.stylized(program, tmp_path, mask, wanted | {"before": earlier}, "4")
    # The guide goes on beyond the mesh: no black border.
    assert np.abs(found - 0.8).max() < 0.01
