"""The sheets of fits to unlit views, and how viewers' answers are counted."""

import json

import numpy as np
import pytest

from benchmarks.two_phase_unlit import __main__ as unlit


def files(folder, answers):
    """A key of two sheets, the fit once on either side, and answers to it."""
    key = {"01": {"A": "fit", "B": "without"}, "02": {"A": "without", "B": "fit"}}
    sheets = {name: line | {"mesh": "spot", "style": f"style{name}"} for name, line in key.items()}
    (folder / "key.json").write_text(json.dumps({"sheets": sheets}))
    (folder / "answers.json").write_text(json.dumps(answers))
    words = ["score", "--key", str(folder / "key.json"), "--answers", str(folder / "answers.json")]
    return unlit.options(words)


def test_the_share_that_chose_the_fit_is_counted_by_the_key(tmp_path):
    figures = unlit.score(files(tmp_path, {"01": {"x": "A", "y": "B", "z": "A"}, "02": {"x": "B", "y": "="}}))
    assert figures["unlit.preferred"] == pytest.approx((2 + 1.5) / 5) and figures["answers"] == 5
    assert figures["unlit.preferred.style01"] == pytest.approx(2 / 3)
    assert figures["unlit.preferred.style02"] == pytest.approx(1.5 / 2)
    assert figures["unlit.preferred.spot"] == figures["unlit.preferred"]


def test_the_answers_that_lie_here_belong_to_the_key_beside_them():
    figures = unlit.score(unlit.options(["score"]))
    assert figures["answers"] == 36 and 0 <= figures["unlit.preferred"] < 0.5, "the default follows from it"


@pytest.mark.parametrize(("answers", "said"), [({"03": {"x": "A"}}, "sheet '03'"), ({"01": {"x": "C"}}, "found 'C'")])
def test_answers_that_belong_to_no_sheet_are_refused(tmp_path, answers, said):
    with pytest.raises(SystemExit, match=said):
        unlit.score(files(tmp_path, answers))


def test_a_sheet_has_both_candidates_beside_each_other():
    def shown(value):
        sizes = [unlit.SMALL] * 6 + [unlit.LARGE] * 4
        return [np.full((size, size, 3), value, np.uint8) for size in sizes]

    made = unlit.sheet(shown(10), shown(200))
    half = (made.shape[1] - unlit.GAP) // 2
    assert half == 3 * unlit.SMALL == 2 * unlit.LARGE
    below = made[-2 * unlit.SMALL :]
    assert (below[:, :half] == 10).all() and (below[:, -half:] == 200).all()


def test_the_difference_counts_only_what_shows_the_asset():
    before = [np.zeros((8, 8, 3), np.uint8) for _ in range(10)]
    for picture in before:
        picture[2:6, 2:6] = 100
    after = [picture.copy() for picture in before]
    for picture in after[6:]:
        picture[2:6, 2:6, 1] = 110
    found = unlit.difference(after, before)
    assert (found["environment.mean"], found["key.mean"], found["key.most"]) == (0.0, 10.0, 10.0)
