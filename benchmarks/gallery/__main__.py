"""A folder of other people's models, each drawn here and by Blender's Cycles under one light, and what differs.

    python -m benchmarks.gallery --models DIR [--list FILE] [--only PATTERN] [--out DIR] [--judge] [--quick] [--json F]

Models are the glTF and USD files of DIR, or those that FILE names (paths relative to DIR, one a line, '#' begins a
comment; default: DIR/models.txt where there is one). `benchmarks/gallery/models.txt` lists the files of the figures in
benchmarks/README.md, with the repositories and commits that they were taken from. Both sides see the same camera (35
degrees to the right, 15 up, the model's sphere in a field of view of 30 degrees) and one soft sky of three colours.
Both pictures lie over the same grey and have the same exposure, 256 pixels a side and 32 samples a pixel. Blender is a
check, not a dependency: --blender or $MISTYLE_BLENDER_PYTHON names a Python in which `import bpy` works. It keeps its
pictures in OUT/cycles, so that a second run draws only our side.

`benchmarks/gallery/reasons.json` says why models differ, where that is known:

    notes    text of a note of mistyle's -> reason: a model whose notes have that text is explained by them
    models   model -> {"reason", and "note" or "by"}. With "note", the reason holds as long as a note of this run has
             that text. "by": "cycles" says that Blender's side departs from the file or from its specification,
             "by": "noise" that more samples bring the pictures together. "mend" names what is corrected in
             Blender's import for this model (mended_worker.py): it is drawn as its specification says.

Figures: models (drawn by both), within_flip_005 (mean FLIP of the whole picture up to 0.05), share_within,
within_on_model (the same of the mean over the pixels that either picture covers, which no background dilutes),
silent_differences (beyond 0.05, and neither a note nor a reason with "by" explains it), cycles_departs (beyond 0.05
because Blender departs from the specification; they count as misses), mended (models whose import into Blender was
corrected) and, not among the models, refused (by mistyle,
with a sentence) and cycles_failed. --judge draws nothing and judges the last list of OUT again.
OUT/index.html and OUT/gallery.json list every model with both pictures, FLIP, notes and reason, worst first. Ends with
1 where a difference is silent.
"""

import argparse
import html
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.common import finish, parser
from benchmarks.gallery.draw import Drawn, draw_cycles, draw_ours
from mistyle.core.errors import UsageError
from mistyle.core.image import srgb_from_linear
from mistyle.io.images.write import write_png
from mistyle.io.read import read_json
from mistyle.measure.pictures.metrics import measure_colour
from mistyle.render.external.blender import find_blender

REASONS = Path(__file__).with_name("reasons.json")
KINDS = (".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")
BY = ("cycles", "noise")  # what explains a difference without a note
LIMIT = 0.05  # mean FLIP
GREY = 0.2  # linear, behind both pictures


@dataclass(frozen=True)
class Row:
    """A model's place in the list.

    flip         mean FLIP of the whole picture, on_model of what either picture covers; None where one is missing
    reason       why it differs, "" where nobody knows; explained: whether a note or Blender's own departure says so
    by           who departs from the specification, where `BY` says so
    mend         what was corrected in Blender's import, "" for nothing
    notes        the reader's sentences, or the one of a refusal (refused); trouble: why Blender made no picture
    """

    model: str
    flip: float | None
    on_model: float | None
    reason: str
    explained: bool
    notes: tuple[str, ...]
    trouble: str
    refused: bool
    ours: str
    cycles: str
    by: str = ""
    mend: str = ""

    @property
    def within(self) -> bool:
        return self.flip is not None and self.flip <= LIMIT

    @property
    def silent(self) -> bool:
        return not self.within and not self.explained and not self.trouble and not self.refused


def over_grey(picture: Float[np.ndarray, "h w 4"]) -> Float[np.ndarray, "h w 3"]:
    """A premultiplied linear picture over the common background."""
    alpha = np.clip(picture[..., 3:], 0, 1)
    return np.nan_to_num(picture[..., :3]) + GREY * (1 - alpha)


def apart(ours: Float[np.ndarray, "h w 4"], theirs: Float[np.ndarray, "h w 4"]) -> tuple[float, float]:
    """Mean FLIP of two premultiplied linear pictures: over the whole picture, and over what either one covers."""
    everywhere = np.ones(ours.shape[:2], bool)
    found = measure_colour(over_grey(theirs), over_grey(ours), everywhere, ("flip",))
    covered = np.maximum(ours[..., 3], theirs[..., 3]) > 0
    return found.values["flip"], float(found.maps["flip"][covered].mean()) if covered.any() else 0.0


def why(model: str, notes: Sequence[str], reasons: Mapping[str, Any]) -> tuple[str, bool]:
    """The reason for a difference, and whether it is explained: by a note of this run, or as Blender's departure."""
    said = "\n".join(notes)
    own = reasons.get("models", {}).get(model)
    if own is not None:
        return own["reason"], own.get("by") in BY or ("note" in own and own["note"] in said)
    general = [reason for text, reason in reasons.get("notes", {}).items() if text in said]
    return "; ".join(general), bool(general)


def row(drawn: Drawn, folder: Path, reasons: Mapping[str, Any]) -> Row:
    """Judge one model and write its two pictures as PNG."""
    flip = on_model = None
    shown = {}
    for side, picture in (("ours", drawn.ours), ("cycles", drawn.theirs)):
        if picture is not None:
            shown[side] = f"pictures/{drawn.slug}_{side}.png"
            write_png(folder / shown[side], srgb_from_linear(over_grey(picture)))
    if drawn.ours is not None and drawn.theirs is not None:
        flip, on_model = apart(drawn.ours, drawn.theirs)
    found = Row(
        model=drawn.model,
        flip=flip,
        on_model=on_model,
        reason="",
        explained=False,
        notes=drawn.notes,
        trouble=drawn.trouble,
        refused=drawn.refused,
        ours=shown.get("ours", ""),
        cycles=shown.get("cycles", ""),
        mend=drawn.mend,
    )
    return judged(found, reasons)


def judged(found: Row, reasons: Mapping[str, Any]) -> Row:
    """A row with its reason."""
    reason, explained = why(found.model, found.notes, reasons)
    found = replace(found, by=reasons.get("models", {}).get(found.model, {}).get("by", ""))
    if found.refused:
        return replace(found, reason=reason or "refused, with a sentence", explained=True)
    return replace(found, reason=reason, explained=explained)


def tally(rows: Sequence[Row]) -> dict[str, float]:
    """The figures of a list."""
    compared = [r for r in rows if r.flip is not None]
    within = sum(r.within for r in compared)
    return {
        "models": len(compared),
        "within_flip_005": within,
        "share_within": within / max(len(compared), 1),
        "within_on_model": sum(r.on_model is not None and r.on_model <= LIMIT for r in compared),
        "silent_differences": sum(r.silent for r in compared),
        "cycles_departs": sum(not r.within and r.by == "cycles" for r in compared),
        "mended": sum(bool(r.mend) for r in compared),
        "refused": sum(r.refused for r in rows),
        "cycles_failed": sum(bool(r.trouble) for r in rows),
    }


def worst_first(rows: Sequence[Row]) -> list[Row]:
    return sorted(rows, key=lambda r: (not r.silent, -(2.0 if r.flip is None else r.flip), r.model))


def page(rows: Sequence[Row], figures: Mapping[str, float]) -> str:
    """The list as one HTML page beside its pictures."""

    def cell(r: Row) -> str:
        pictures = "".join(f'<img src="{html.escape(p)}" width=192>' for p in (r.ours, r.cycles) if p)
        number = "" if r.flip is None else f"{r.flip:.3f} ({r.on_model:.3f} on the model)"
        state = "silent" if r.silent else "within" if r.within else "said"
        text = [f"<b>{html.escape(r.model)}</b>", f"{number} {state}", html.escape(r.reason), html.escape(r.trouble)]
        text += [f"<small>{html.escape(n)}</small>" for n in r.notes]
        return f'<tr class="{state}"><td>{pictures}</td><td>{"<br>".join(t for t in text if t)}</td></tr>'

    head = ", ".join(f"{k} {v:g}" for k, v in figures.items())
    style = "body{font:14px sans-serif}td{vertical-align:top}.silent{background:#fdd}.said{background:#ffd}"
    rows_text = "\n".join(cell(r) for r in rows)
    return (
        f'<!doctype html><meta charset="utf-8"><title>gallery</title><style>{style}</style><p>{head}</p>'
        f"<p>left: mistyle, right: Cycles</p><table>{rows_text}</table>\n"
    )


def models_of(folder: Path, listed: Path | None, only: str) -> list[str]:
    """Paths of the models relative to the folder."""
    own = listed or (folder / "models.txt" if (folder / "models.txt").is_file() else None)
    if own is None:
        found = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix.lower() in KINDS)
    else:
        lines = (line.split("#")[0].strip() for line in own.read_text(encoding="utf-8").splitlines())
        found = [line for line in lines if line]
    missing = [name for name in found if not (folder / name).is_file()]
    if missing:
        raise UsageError(f"{own}: found no {missing[0]} in {folder} ({len(missing)} are missing); fetch the models")
    return [name for name in found if fnmatch(name, only)]


def again(folder: Path) -> list[Row]:
    """The rows of an earlier run, with the reasons as they are now."""
    rows = json.loads((folder / "gallery.json").read_text(encoding="utf-8"))
    reasons = read_json(REASONS)
    return [judged(Row(**r | {"notes": tuple(r["notes"])}), reasons) for r in rows]


def drawn_rows(given: argparse.Namespace) -> list[Row]:
    """Every model drawn on both sides and judged."""
    blender = find_blender(given.blender)
    if blender is None:
        raise UsageError("needs --blender PYTHON or $MISTYLE_BLENDER_PYTHON: a Python in which `import bpy` works")
    size, samples = (96, 16) if given.quick else (256, 32)
    names = models_of(given.models, given.list, given.only)
    reasons = read_json(REASONS)
    models = {name: reasons["models"].get(name, {}).get("mend", "") for name in names}
    jobs = draw_ours(given.models, models, given.out, size, samples)
    return [row(drawn, given.out, reasons) for drawn in draw_cycles(jobs, given.out, blender)]


def main(argv: list[str] | None = None) -> int:
    options = parser((__doc__ or "").splitlines()[0])
    options.add_argument("--models", type=Path, required=True, metavar="DIR", help="the folder of the models")
    options.add_argument("--list", type=Path, metavar="FILE", help="which of them (default: DIR/models.txt, else all)")
    options.add_argument("--only", default="*", metavar="PATTERN", help="only models whose path matches")
    options.add_argument("--out", type=Path, default=Path("gallery"), metavar="DIR", help="pictures, page and list")
    options.add_argument("--judge", action="store_true", help="draw nothing: judge the last list of OUT again")
    options.add_argument("--blender", metavar="PYTHON", help="a Python in which `import bpy` works")
    given = options.parse_args(argv)
    rows = worst_first(again(given.out) if given.judge else drawn_rows(given))
    figures = tally(rows)
    quiet = str(given.json) == "-"
    for r in rows:
        number = "     " if r.flip is None else f"{r.flip:.3f}"
        state = "silent" if r.silent else "failed" if r.trouble else "within" if r.within else "said"
        print(f"{number}  {state}  {r.model}  {r.reason}", file=sys.stderr if quiet else sys.stdout)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "gallery.json").write_text(json.dumps([asdict(r) for r in rows], indent=1), encoding="utf-8")
    (given.out / "index.html").write_text(page(rows, figures), encoding="utf-8")
    finish(figures, given.json)
    return 1 if figures["silent_differences"] else 0


if __name__ == "__main__":
    sys.exit(main())
