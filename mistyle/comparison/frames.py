"""Pairs of files to compare: pictures, and folders of frames that are matched by name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.paths import real_path

# The order of preference among files of one name. Formats that mistyle cannot open count as pictures too: their rows
# then fail, and no frame passes unopened.
ENDINGS = (
    *(".exr", ".hdr", ".pfm", ".png", ".tif", ".tiff", ".webp", ".bmp", ".tga", ".jpg", ".jpeg", ".jfif", ".avif"),
    *(".gif", ".dpx", ".cin", ".ppm", ".pgm", ".pnm", ".jp2", ".j2k", ".jxl", ".heic", ".heif", ".sgi", ".iff", ".tx"),
)


@dataclass(frozen=True)
class Match:
    """One picture of one test and its reference; one of the two is None where it is missing. `notes` say what was
    chosen among several files."""

    name: str
    test_name: str
    reference: Path | None
    test: Path | None
    notes: tuple[str, ...] = ()


def matches(reference: Path, tests: Sequence[Path], out: Path | None = None) -> list[Match]:
    """Every pair to compare, test by test; folders match by relative name without ending, or by frame number.

    A picture that only one folder has becomes a Match with None. Of files of one name that differ in their endings, an
    ending counts that both folders have, in the order of ENDINGS. Files below `out` are no frames. InputRefused without
    any pair.
    """
    names = labels(tests)
    if reference.is_dir():
        files = [t for t in tests if not t.is_dir()]
        if files:
            raise UsageError(f"{reference} is a folder and {files[0]} is not: give folders, or one picture each")
        return [m for name, test in zip(names, tests, strict=True) for m in _folders(reference, test, name, out)]
    for path in (reference, *tests):
        if not path.exists():
            raise InputRefused(f"{path}: found nothing; expected a picture or a folder of frames. Check the path.")
    pairs = []
    for name, test in zip(names, tests, strict=True):
        if test.is_dir():
            raise UsageError(f"{test} is a folder and {reference} is not: give folders, or one picture each")
        pairs.append(Match(reference.stem, name, reference, test))
    return pairs


def labels(tests: Sequence[Path]) -> list[str]:
    """Short distinct names of the tests: the last parts of their paths."""
    for depth in (1, 2, 3):
        names = ["/".join(t.with_suffix("").parts[-depth:]) if t.suffix else "/".join(t.parts[-depth:]) for t in tests]
        if len(set(names)) == len(names):
            return names
    return [f"{k}:{t.name}" for k, t in enumerate(tests)]


def _folders(reference: Path, test: Path, label: str, out: Path | None) -> list[Match]:
    left, right = (pictures_of(folder, out) for folder in (reference, test))
    if not left:
        raise InputRefused(
            f"{reference}: found no pictures ({', '.join(ENDINGS[:12])}, …); expected frames. Check the path."
        )
    if set(left) & set(right):
        return [_match(name, label, left.get(name, []), right.get(name, [])) for name in sorted({*left, *right})]
    by_number = {_number(name): name for name in left}, {_number(name): name for name in right}
    usable = len(by_number[0]) == len(left) and len(by_number[1]) == len(right) and None not in by_number[0]
    if not usable or not set(by_number[0]) & set(by_number[1]):
        raise InputRefused(
            f"{test}: found {len(right)} pictures, none named as one of {reference} "
            f"({', '.join(sorted(left)[:3])}); expected equal names, or one frame number each. Rename them."
        )
    right = {by_number[0].get(number, name): right[name] for number, name in by_number[1].items()}
    result = [_match(name, label, left.get(name, []), right.get(name, [])) for name in sorted({*left, *right})]
    first, other = next((m.reference, m.test) for m in result if m.reference and m.test)
    note = f"paired by the frame number, since no names are equal ({first.name} with {other.name}, and so on)"
    return [replace(m, notes=(*m.notes, note)) if m.reference and m.test else m for m in result]


def _match(name: str, label: str, left: Sequence[Path], right: Sequence[Path]) -> Match:
    """The pair of one name among files that differ in their endings."""
    shared = [(a, b) for a in left for b in right if a.suffix.lower() == b.suffix.lower()]
    first, other = shared[0] if shared else (left[0] if left else None, right[0] if right else None)
    rest = sorted({p.suffix.lower() for p in (*left, *right) if p not in (first, other)})
    chosen = " and ".join(dict.fromkeys(p.suffix.lower() for p in (first, other) if p is not None))
    notes = (f"{', '.join(rest)} of the same name left out; {chosen} compared",) if rest else ()
    return Match(name, label, first, other, notes)


def pictures_of(folder: Path, out: Path | None = None) -> dict[str, list[Path]]:
    """Relative name without ending -> its files in the order of ENDINGS, without hidden files and files below `out`."""
    if not folder.is_dir():
        raise InputRefused(f"{folder}: found no folder; expected one with pictures. Check the path.")
    left_out = None if out is None else real_path(out)
    pictures: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*"), key=_rank):
        if path.suffix.lower() not in ENDINGS or not path.is_file() or path.name.startswith("."):
            continue
        if left_out is None or not real_path(path).is_relative_to(left_out):
            pictures.setdefault(path.relative_to(folder).with_suffix("").as_posix(), []).append(path)
    return pictures


def _rank(path: Path) -> tuple[int, Path]:
    ending = path.suffix.lower()
    return ENDINGS.index(ending) if ending in ENDINGS else len(ENDINGS), path


def _number(name: str) -> str | None:
    digits = re.findall(r"\d+", name.rsplit("/", 1)[-1])
    return digits[-1].lstrip("0") or "0" if digits else None
