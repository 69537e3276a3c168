"""Strangers' files: every case of a folder, judged by what was written down as right before anything was run.

    python -m benchmarks.strangers --cases DIR [--expected FILE] [--only PATTERN] [--quick] [--json FILE]

What is right stands in DIR/expected.json, else in benchmarks/strangers/expected.json (for ../shared/cases). It is one
JSON object: the path of a file or folder relative to DIR, and what to do with it and to find. A second case of the same
path has a name after '#' ("a.glb#baked"). With --expected FILE, that file counts.

What is done, by default: a mesh is read and drawn without light, in parallel projection, into a square of 64 pixels
that just holds it; a picture is read; a folder is read as a capture, of which the first picture is looked at.

    read     options of that reading, such as {"uv": "keep"}
    look     side that a mesh is drawn from: front (default: from +Z, Y up), back, left, right, top, bottom
    map      map of the mesh that is drawn: albedo (default) or normal
    run      instead: a command of mistyle as a list of words, or a list of such commands; {case}, {folder} (its folder)
             and {out} (an empty folder) are filled in
    show     with run: pattern of one path in {out} (mesh, picture or folder) that is looked at after it
    slow     true: left out by --quick (renders and fits)

What is checked; a colour is [r, g, b], sRGB 0..255, or one letter of the quadrant picture: R 220 40 40, G 40 200 40,
B 40 40 220, Y 230 220 40:

    exit       exit code (default 0; 3: refused)
    note       text, or list of texts, that must occur on the console or in the reader's notes
    quadrants  mean colours of the picture's quadrants: top left, top right, bottom left, bottom right
    grid       rows of colours, as strings of letters or as lists: the same for a finer grid, of each cell's middle half
    points     list of [x, y, colour]: the colour at x to the right and y down, as shares of the picture
    like       path of another case that must look the same: the mean difference is within the tolerance
    lit        true: the picture was drawn under light; its brightness is matched first, by one factor. Sheen stays:
               a tolerance of 60, a third of what separates the letters, tells them apart
    tolerance  of colours, in steps of 0..255 (default 12)
    distinct   least number of distinct colours in the picture
    size       [width, height] in pixels, of a picture or of a capture's first one
    materials, faces, pictures   how many
    cameras    path of another capture whose cameras stand at the same places (within 0.0001)
    values     {parameter: numbers, rounded to three decimals}, as a fit of a scene prints them
    within     of values, the share by which they may differ (default 0.01)

Figures: cases, cases_right. Ends with 1 where a case is wrong.
"""

import sys
import tempfile
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import finish, parser
from benchmarks.strangers.seen import Seen, cells, read, run
from mistyle.core.errors import UsageError
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.io.read import read_json

EXPECTED = Path(__file__).with_name("expected.json")
LETTERS = {"R": (220, 40, 40), "G": (40, 200, 40), "B": (40, 40, 220), "Y": (230, 220, 40)}
COUNTS = ("materials", "faces", "pictures")
COLOURS = {"quadrants", "grid", "points", "like", "distinct"}
CHECKS = COLOURS | {"exit", "note", "lit", "tolerance", "size", "cameras", "values", "within", *COUNTS}
KEYS = CHECKS | {"read", "look", "map", "run", "show", "slow"}
Entry = Mapping[str, Any]


def look(folder: Path, name: str, entry: Entry) -> Seen:
    """What comes of a case."""
    path = folder / name.split("#")[0]
    if not path.exists():
        return Seen(exit=-1, said=f"there is no {path}")
    side, surface_map = entry.get("look", "front"), entry.get("map", "albedo")
    if "run" not in entry:
        return read(path, entry.get("read", {}), side, surface_map)
    with tempfile.TemporaryDirectory() as out:
        commands = entry["run"] if isinstance(entry["run"][0], list) else [entry["run"]]
        places = {"{case}": str(path), "{folder}": str(path.parent), "{out}": out}
        return run([_filled(words, places) for words in commands], Path(out), entry.get("show"), side, surface_map)


def _filled(words: list[str], places: Mapping[str, str]) -> list[str]:
    result = []
    for word in words:
        for mark, place in places.items():
            word = word.replace(mark, place)
        result.append(word)
    return result


def judge(folder: Path, name: str, cases: Mapping[str, Entry]) -> list[str]:
    """What is wrong with a case, one sentence each; none where it is right."""
    entry = cases[name]
    seen = look(folder, name, entry)
    expected = entry.get("exit", 0)
    if seen.exit != expected:
        return [f"expected exit {expected}, found {seen.exit}: {_end(seen.said)}"]
    notes = entry.get("note", [])
    wrong = [
        f"expected the note '{note}', found: {_end(seen.said) or 'nothing'}"
        for note in ([notes] if isinstance(notes, str) else notes)
        if note not in seen.said
    ]
    for key in COUNTS:
        if key in entry and getattr(seen, key) != entry[key]:
            wrong.append(f"expected {entry[key]} {key}, found {getattr(seen, key)}")
    if "size" in entry and seen.size != tuple(entry["size"]):
        wrong.append(f"expected a size of {tuple(entry['size'])}, found {seen.size}")
    if "cameras" in entry:
        wrong += _cameras(seen, look(folder, entry["cameras"], cases.get(entry["cameras"], {})), entry["cameras"])
    wrong += _values(seen.said, entry.get("values", {}), entry.get("within", 0.01))
    if COLOURS & set(entry):
        if seen.picture is None:
            wrong.append("expected a picture, found none")
        else:
            wrong += _colours(seen.picture, entry)
            if "like" in entry:
                twin = look(folder, entry["like"], cases.get(entry["like"], {}))
                wrong += _alike(seen.picture, twin, entry["like"], entry.get("tolerance", 12))
    return wrong


def _colours(picture: np.ndarray, entry: Entry) -> list[str]:
    """What is wrong with the colours of a picture, (rows, columns, 3) 0..255."""
    height, width = picture.shape[:2]
    compared = {}
    for name in ("quadrants", "grid"):
        rows = entry.get(name, [])
        if name == "quadrants" and rows:
            rows = [rows[:2], rows[2:]]
        if rows:
            right = np.array([[_colour(cell) for cell in row] for row in rows])
            compared[name] = right, cells(picture, *right.shape[:2])
    if "points" in entry:
        places = [(min(int(y * height), height - 1), min(int(x * width), width - 1)) for x, y, _ in entry["points"]]
        right = np.array([_colour(colour) for _, _, colour in entry["points"]])
        compared["points"] = right, np.array([picture[place] for place in places])
    wrong = []
    for name, (right, found) in compared.items():
        levelled = _as_bright(found, right) if entry.get("lit") else found
        if np.abs(levelled - right).max() > entry.get("tolerance", 12):
            wrong.append(f"expected {name} {_numbers(right)}, found {_numbers(levelled)}")
    if "distinct" in entry:
        count = len(np.unique(np.rint(picture).reshape(-1, 3), axis=0))
        if count < entry["distinct"]:
            wrong.append(f"expected at least {entry['distinct']} distinct colours, found {count}")
    return wrong


def _as_bright(found: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The found colours times one factor of linear light, so that they are as bright as the right ones together."""
    linear = linear_from_srgb(found / 255)
    factor = linear_from_srgb(right / 255).sum() / max(float(linear.sum()), 1e-9)
    return srgb_from_linear(linear * factor) * 255


def _alike(picture: np.ndarray, twin: Seen, name: str, tolerance: float) -> list[str]:
    if twin.picture is None or twin.picture.shape != picture.shape:
        there = "none" if twin.picture is None else f"one of {twin.picture.shape[1::-1]}"
        return [f"expected the picture of {name}, found one of {picture.shape[1::-1]} and {there} there"]
    apart = float(np.abs(picture - twin.picture).mean())
    return [f"expected the picture of {name}, found a mean difference of {apart:.1f}"] if apart > tolerance else []


def _cameras(seen: Seen, twin: Seen, name: str) -> list[str]:
    if len(seen.cameras) != len(twin.cameras) or not seen.cameras:
        return [f"expected the cameras of {name}, found {len(seen.cameras)} and {len(twin.cameras)} there"]
    apart = float(np.abs(np.stack(seen.cameras) - np.stack(twin.cameras)).max())
    return [f"expected the cameras of {name}, found a difference of {apart:.4f}"] if apart > 1e-4 else []


def _values(said: str, right: Mapping[str, list[float]], within: float) -> list[str]:
    """What is wrong with the fitted values that were printed: "name: start → value ± error, value ± error"."""
    wrong = []
    for name, numbers in right.items():
        line = next((line for line in said.splitlines() if line.startswith(f"{name}: ") and "→" in line), "")
        found = [float(part.split("±")[0]) for part in line.partition("→")[2].split(",")] if line else []
        apart = [abs(a - b) > within * b + 0.0005 for a, b in zip(found, numbers, strict=False)]
        if len(found) != len(numbers) or any(apart):
            wrong.append(f"expected {name} at {numbers} within {within:.0%}, found {found}")
    return wrong


def _colour(value: str | list[float]) -> np.ndarray:
    return np.array(LETTERS[value] if isinstance(value, str) else value, float)


def _numbers(values: np.ndarray) -> str:
    return str(np.rint(values).astype(int).tolist())


def _end(said: str, most: int = 300) -> str:
    """The last of what was printed, on one line."""
    line = " ".join(said.split())
    return line if len(line) <= most else f"… {line[-most:]}"


def expected_cases(file: Path) -> dict[str, Entry]:
    """The cases of an expected.json; UsageError for words in it that mean nothing."""
    cases = read_json(file)
    for name, entry in cases.items():
        unknown = set(entry) - KEYS
        if unknown:
            raise UsageError(
                f"{file}, '{name}': found {', '.join(sorted(unknown))}, expected {', '.join(sorted(KEYS))}"
            )
    return cases


def main(argv: list[str] | None = None) -> int:
    options = parser((__doc__ or "").splitlines()[0])
    options.add_argument("--cases", type=Path, required=True, metavar="DIR", help="the folder of the cases")
    options.add_argument("--expected", type=Path, metavar="FILE", help="what is right (default: DIR/expected.json)")
    options.add_argument("--only", metavar="PATTERN", help="only cases whose path matches, such as 'gltf/*'")
    given = options.parse_args(argv)
    own = given.cases / "expected.json"
    cases = expected_cases(given.expected or (own if own.is_file() else EXPECTED))
    quiet = str(given.json) == "-"
    chosen = [
        name
        for name, entry in cases.items()
        if not (given.quick and entry.get("slow")) and fnmatch(name, given.only or "*")
    ]
    right = 0
    for name in chosen:
        wrong = judge(given.cases, name, cases)
        right += not wrong
        print(f"{'wrong' if wrong else 'right'}  {name}", file=sys.stderr if quiet else sys.stdout)
        for sentence in wrong:
            print(f"       {sentence}", file=sys.stderr if quiet else sys.stdout)
    finish({"cases": len(chosen), "cases_right": right}, given.json)
    return 0 if right == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
