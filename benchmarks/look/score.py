"""Answers of blind viewers against the key: `benchmarks.look score`.

Answers are JSON: {"SHEET": {"sha256": "...", "VIEWER": {"shipped": "A", "style": "B", "shape": "A"}}} for a choice,
{"odd": "C"} for the odd one out. "sha256" may be left out; where it is there, it must be the key's.
"""

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

RIVALS = ("ebsynth", "finish")  # tests of one question, with a figure of their own
QUESTIONS = {"shipped": "ship", "style": "style", "shape": "shape"}


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file of this benchmark."""
    return json.loads(path.read_text(encoding="utf-8"))


def answers_of(sheet: str, line: Mapping[str, Any], answers: Mapping[str, Any]) -> list[Mapping[str, str]]:
    """The viewers' answers on one sheet. SystemExit where they belong to another picture."""
    given = answers.get(sheet, {})
    if given.get("sha256", line["sha256"]) != line["sha256"]:
        raise SystemExit(
            f"sheet {sheet}: the answers are about a picture of sha256 {given['sha256'][:12]}, the key has "
            f"{line['sha256'][:12]}; rebuild the sheets and ask again, or take the key of those sheets"
        )
    return [answer for viewer, answer in sorted(given.items()) if viewer != "sha256"]


def score(key: Mapping[str, Any], answers: Mapping[str, Any]) -> dict[str, float]:
    """Shares of answers: `chosen.QUESTION.KIND` for HEAD, `chosen.ebsynth.KIND` and
    `chosen.finish.KIND`, and `odd_one_out` found.

    `answers` counts them. SystemExit at a sheet or a letter that the key does not have.
    """
    sheets = key["sheets"]
    unknown = sorted(set(answers) - set(sheets))
    if unknown:
        raise SystemExit(f"the key has no sheet {unknown[0]}; take the key that was written with the sheets")
    found: dict[str, list[bool]] = defaultdict(list)
    for sheet, line in sheets.items():
        for answer in answers_of(sheet, line, answers):
            for name, right in judged(sheet, line, answer):
                found[name].append(right)
    figures = {name: sum(values) / len(values) for name, values in sorted(found.items())}
    counts = {f"answers.{name}": float(len(values)) for name, values in sorted(found.items())}
    return figures | counts


def judged(sheet: str, line: Mapping[str, Any], answer: Mapping[str, str]) -> list[tuple[str, bool]]:
    """One viewer's answers on one sheet as (figure, whether it counts for it); a choice counts by kind and preset."""
    if line["test"] == "odd":
        return [("odd_one_out", letter(sheet, answer, "odd", "ABCD") == line["odd"])] if "odd" in answer else []
    result = []
    for question in [q for q in QUESTIONS if q in answer]:
        chosen = line[letter(sheet, answer, question, "AB")] == "head"
        if line["test"] in RIVALS:
            result += [(f"chosen.{line['test']}.{line['kind']}", chosen)] if question == "shipped" else []
        else:
            stem = f"chosen.{QUESTIONS[question]}"
            result += [(f"{stem}.{line['kind']}", chosen), (f"{stem}.{line['kind']}.{line['preset']}", chosen)]
    return result


def letter(sheet: str, answer: Mapping[str, str], question: str, letters: str) -> str:
    """The answer to a question. SystemExit where it is none of the letters."""
    given = str(answer[question]).strip().upper()
    if given not in list(letters):
        raise SystemExit(f"sheet {sheet}: {question!r} is answered {answer[question]!r}; it must be one of {letters}")
    return given
