"""Records of a comparison: the job, its rows, and their machine-readable files compare.json, compare.csv, junit.xml."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from mistyle.comparison.limits import Limit
from mistyle.measure.pictures.metrics import COLOUR, DATA, Viewing

Protocol = Literal["stanford-orb", "tensoir", "idiff"]


@dataclass(frozen=True)
class CompareJob:
    """One comparison.

    metrics   names of measure/pictures/metrics.py; a protocol replaces them by its own
    layers    layers to compare; empty: all common layers
    window    "display" or "overlap" (comparison/inputs.py)
    mask      None, "alpha" (the reference's alpha above one half) or a mask file
    limits    in order; the last one that matches an image counts
    pictures  number of pictures on the page, worst first
    crop      x, y, width, height of the inset figure
    titles    titles of reference and tests on the page; empty: their paths
    overwrite whether to replace files in `out` that mistyle did not write
    """

    reference: Path
    tests: tuple[Path, ...]
    out: Path
    metrics: tuple[str, ...] = COLOUR + DATA
    layers: tuple[str, ...] = ()
    window: Literal["display", "overlap"] = "display"
    mask: str | None = None
    viewing: Viewing = field(default_factory=Viewing)
    protocol: Protocol | None = None
    limits: tuple[Limit, ...] = ()
    allow_nonfinite: bool = False
    allow_missing: bool = False
    pictures: int = 48
    crop: tuple[int, int, int, int] | None = None
    titles: tuple[str, ...] = ()
    overwrite: bool = False


@dataclass(frozen=True)
class ComparisonRow:
    """One layer of one picture of one test.

    values     metric -> number, for the metrics of this kind of layer
    worst      x, y, width, height, error of the worst regions, worst first
    folder     folder of its pictures, relative to the page; "" without pictures
    failures   messages; empty if it passed
    files      names of the two files, the reference's first; empty where one is missing
    """

    image: str
    test: str
    layer: str
    kind: str = ""
    size: tuple[int, int] = (0, 0)
    pixels: int = 0
    values: Mapping[str, float] = field(default_factory=dict)
    bad: Mapping[str, int] = field(default_factory=dict)
    exposures: tuple[float, float, int] | None = None
    worst: tuple[tuple[int, int, int, int, float], ...] = ()
    folder: str = ""
    high: bool = False
    failures: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


def number(value: float) -> float | str | None:
    """A number for JSON, which has no infinity and no NaN: "inf", "-inf" and null."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def row_record(row: ComparisonRow) -> dict[str, Any]:
    """A row as a record of compare.json and of the page."""
    return {
        "image": row.image,
        "test": row.test,
        "layer": row.layer,
        "kind": row.kind,
        "size": list(row.size),
        "pixels": row.pixels,
        "values": {name: number(value) for name, value in row.values.items()},
        "bad": dict(row.bad),
        "exposures": list(row.exposures) if row.exposures else None,
        "worst": [[*box[:4], number(box[4])] for box in row.worst],
        "folder": row.folder,
        "high": row.high,
        "failures": list(row.failures),
        "notes": list(row.notes),
        "files": list(row.files),
    }


def columns(rows: Sequence[ComparisonRow]) -> list[str]:
    """The metrics that any row has, in the order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row.values))


def csv_text(rows: Sequence[ComparisonRow]) -> str:
    """One line per row; an apostrophe protects cells that a spreadsheet could read as a formula."""
    names = columns(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    bad = ["nan_reference", "inf_reference", "nan_test", "inf_test"]
    writer.writerow(["image", "test", "layer", "width", "height", "pixels", *names, *bad, "status", "failures"])
    for row in rows:
        values = ["" if name not in row.values else repr(float(row.values[name])) for name in names]
        counts = [row.bad.get(name, 0) for name in bad]
        status = "failed" if row.failures else "passed"
        labels = [_cell(text) for text in (row.image, row.test, row.layer)]
        writer.writerow([*labels, *row.size, row.pixels, *values, *counts, status, _cell("; ".join(row.failures))])
    return text.getvalue()


def _cell(text: str) -> str:
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text


def junit_text(rows: Sequence[ComparisonRow], overall: Sequence[str] = ()) -> str:
    """JUnit XML: a suite per test, a case per image and layer, and a separate case for `overall` failures."""
    root = ElementTree.Element("testsuites", name="mistyle compare")
    for test in dict.fromkeys(row.test for row in rows):
        own = [row for row in rows if row.test == test]
        failed = sum(bool(row.failures) for row in own)
        suite = ElementTree.SubElement(
            root, "testsuite", name=_xml(test), tests=str(len(own)), failures=str(failed), errors="0"
        )
        for row in own:
            _case(suite, f"{row.image} [{row.layer}]" if row.layer else row.image, test, row.failures, row.values)
    if overall:
        suite = ElementTree.SubElement(root, "testsuite", name="comparison", tests="1", failures="1", errors="0")
        _case(suite, "comparison", "comparison", overall, {})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _case(suite: ElementTree.Element, name: str, test: str, failures: Sequence[str], values: Mapping[str, float]):
    case = ElementTree.SubElement(suite, "testcase", name=_xml(name), classname=_xml(test))
    if failures:
        text = "; ".join(failures)
        ElementTree.SubElement(case, "failure", message=_xml(text)).text = _xml(text)
    if values:
        lines = "\n".join(f"{k} = {v:.6g}" for k, v in values.items())
        ElementTree.SubElement(case, "system-out").text = lines


def _xml(text: str) -> str:
    """The text with U+FFFD for control characters that XML forbids."""
    return "".join(c if c in "\t\n" or 0x20 <= ord(c) < 0xD800 or 0xE000 <= ord(c) < 0xFFFE else "�" for c in text)
