"""The judge of strangers' files (benchmarks/strangers) tells right from wrong."""

import json

import pytest
from PIL import Image

from benchmarks.strangers.__main__ import expected_cases, main
from mistyle.core.errors import UsageError

QUAD = """mtllib m.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
usemtl mat
f 1/1/1 2/2/1 3/3/1 4/4/1
"""


@pytest.fixture
def cases(tmp_path):
    """Two quads with the quadrant picture; the second wears it upside down."""
    picture = Image.new("RGB", (2, 2))
    for place, colour in zip(
        [(0, 0), (1, 0), (0, 1), (1, 1)], [(220, 40, 40), (40, 200, 40), (40, 40, 220), (230, 220, 40)], strict=True
    ):
        picture.putpixel(place, colour)
    for name, image in (("right", picture), ("wrong", picture.transpose(Image.Transpose.FLIP_TOP_BOTTOM))):
        folder = tmp_path / name
        folder.mkdir()
        image.resize((16, 16), Image.Resampling.NEAREST).save(folder / "wood.png")
        (folder / "q.obj").write_text(QUAD)
        (folder / "m.mtl").write_text("newmtl mat\nmap_Kd wood.png\n")
    return tmp_path


def figures(folder, entries):
    (folder / "expected.json").write_text(json.dumps(entries))
    code = main(["--cases", str(folder), "--json", str(folder / "figures.json")])
    return code, json.loads((folder / "figures.json").read_text())["figures"]


def test_the_judge_tells_a_right_case_from_a_wrong_one(cases, capsys):
    entry = {"quadrants": "RGBY", "faces": 2, "materials": 1}
    code, found = figures(cases, {"right/q.obj": entry, "wrong/q.obj": entry})
    assert (code, found) == (1, {"cases": 2, "cases_right": 1})
    printed = capsys.readouterr().out
    assert "right  right/q.obj" in printed and "wrong  wrong/q.obj\n       expected quadrants" in printed
    assert figures(cases, {"right/q.obj": entry}) == (0, {"cases": 1, "cases_right": 1})


@pytest.mark.parametrize(
    ("holds", "fails"),
    [
        ({"grid": ["RRGG", "BBYY"]}, {"grid": ["RGRG", "BBYY"]}),
        ({"points": [[0.1, 0.1, "R"], [0.9, 0.9, [230, 220, 40]]]}, {"points": [[0.1, 0.9, "R"]]}),
        ({"quadrants": [[110, 20, 20], [20, 100, 20], [20, 20, 110], [115, 110, 20]], "lit": True}, {}),
        ({"distinct": 4}, {"distinct": 5}),
        ({"like": "right/q.obj#twin"}, {"like": "wrong/q.obj"}),
        ({"look": "back", "quadrants": "GRYB"}, {"look": "back", "quadrants": "RGBY"}),
        ({"map": "normal", "quadrants": [[128, 128, 255]] * 4}, {"map": "normal", "quadrants": "RGBY"}),
        ({"exit": 0}, {"exit": 3}),
        ({}, {"note": "no such sentence"}),
        ({"faces": 2}, {"faces": 1}),
    ],
)
def test_every_check_can_fail(cases, holds, fails):
    assert figures(cases, {"right/q.obj": holds})[0] == 0
    if fails:
        assert figures(cases, {"right/q.obj": fails})[0] == 1


def test_a_picture_has_a_size_and_a_command_an_exit_code(cases):
    command = {"run": ["render", "{case}", "-o", "{out}", "--resolution", "x"], "exit": 2, "note": "--resolution"}
    right = {"right/wood.png": {"size": [16, 16], "quadrants": "RGBY", "tolerance": 1}, "right/q.obj": command}
    assert figures(cases, right) == (0, {"cases": 2, "cases_right": 2})
    wrong = {"right/wood.png": {"size": [16, 8]}, "right/q.obj": {**command, "exit": 0}, "gone.glb": {}}
    assert figures(cases, wrong) == (1, {"cases": 3, "cases_right": 0})


def test_words_that_mean_nothing_are_refused(tmp_path):
    (tmp_path / "expected.json").write_text('{"a.glb": {"quadrant": "RGBY"}}')
    with pytest.raises(UsageError, match=r"'a.glb': found quadrant"):
        expected_cases(tmp_path / "expected.json")
