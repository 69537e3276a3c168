"""`mistyle verify`: written files opened by independent readers, and rendered by Cycles and Mitsuba.

OUT/verify.json       every check with its outcome, and the figures of the renders
OUT/<shot>.png        Cycles, Mitsuba, and the FLIP map of their difference (0 black to 1 white-yellow)
OUT/renders/*.exr     the renders, linear Rec.709
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.errors import InputRefused, MistyleError
from mistyle.deliver.read_asset import SHARDS, jobs_of_batch
from mistyle.deliver.verify_checks import MODELS, READERS, Check, by_blender, exr, listed_files, png
from mistyle.deliver.verify_surfaces import surface_checks
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.store.atomic import DONE
from mistyle.io.store.output import claim, replace_files
from mistyle.render.external.blender import BLENDER, find_blender

# Two correct renderers differ by noise (FLIP 0.05 to 0.09 at 64 samples) and by their pixel filters.
MOST_FLIP, LEAST_OVERLAP, LEAST_CORRELATION = 0.15, 0.98, 0.95

ASIDE = re.compile(r"\.(broken|edited)-\d+$")  # io/store/output.py move_aside


@dataclass(frozen=True)
class Rendering:
    """The renders of the comparison: number of cameras, pixels a side, samples per pixel, light (as for compare)."""

    views: int = 3
    size: int = 256
    spp: int = 128
    light: str = "studio"
    threads: int = 0


@dataclass(frozen=True)
class Difference:
    """The difference of one shot between the renderers, over the union of their silhouettes.

    flip         mean LDR-FLIP, 0..1
    overlap      intersection over union of the silhouettes
    correlation  of the luminances, linear
    brightness   mean of Mitsuba's over Cycles' luminance
    """

    shot: str
    flip: float
    overlap: float
    correlation: float
    brightness: float


def verify(
    place: Path,
    out: Path | None = None,
    *,
    blender: str | None = None,
    rendering: Rendering | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Check a run, a batch, an asset or a delivered folder, or one file; returns the content of verify.json.

    Nothing is downloaded: a reader that is not installed gives the outcome "not checked". `rendering` None leaves the
    renders out. Raises InputRefused where `place` is missing or holds no file of ours.
    """
    if not place.exists():
        raise InputRefused(f"{place}: found nothing, expected a run, an asset, a delivered folder, or one file")
    out = out or (place if place.is_dir() else place.parent) / "verify"
    claim(out, ["verify.json"], overwrite=overwrite)
    executable = find_blender(blender)
    files = _files(place, out)
    if not files:
        raise InputRefused(f"{place}: found none of our files; expected models ({' '.join(MODELS)}) or their lists")
    checks = list(file_checks(place, files, executable))
    record: dict[str, Any] = {}

    def fill(folder: Path) -> None:
        renders = list(_rendered(place, files, folder, executable, rendering, checks)) if rendering else []
        record.update(
            asset=str(place),
            failed=sum(c.outcome == "failed" for c in checks),
            not_checked=sum(c.outcome == "not checked" for c in checks),
            checks=[asdict(c) for c in checks],
            renders=[asdict(r) for r in renders],
            limits={"flip": MOST_FLIP, "overlap": LEAST_OVERLAP, "correlation": LEAST_CORRELATION},
            out=str(out),
        )
        (folder / "verify.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    replace_files(out, "verify", fill, inputs=[place], overwrite=overwrite)
    return record


def _files(place: Path, out: Path) -> list[Path]:
    """The files to check: of a run its asset, its deliveries and the markers of its stages, of a batch those of all its
    runs and its markers. Folders that were set aside do not belong to a run."""
    if place.is_file():
        return [place]
    jobs = jobs_of_batch(place)
    if jobs is not None:
        return [*(place / SHARDS).glob("*.json"), *(path for job in jobs for path in _files(job, out))]
    folders = [p for p in (place / "asset", place / "delivered") if p.is_dir()] or [place]
    paths = [p for folder in folders for p in sorted(folder.rglob("*")) if p.is_file() and out not in p.parents]
    if folders != [place]:
        paths += sorted({*place.glob(f"*/{DONE}"), *place.glob(f"work/*/{DONE}")} - set(paths))
    paths = [p for p in paths if not any(ASIDE.search(part) for part in p.relative_to(place).parts[:-1])]
    suffixes = (*READERS, ".json", ".png", ".exr")
    return [p for p in paths if p.suffix.lower() in suffixes]


def file_checks(place: Path, files: Sequence[Path], blender: str | None) -> Iterator[Check]:
    """The checks of every file by each of its readers."""
    base = place if place.is_dir() else place.parent

    def name(path: Path) -> str:
        return path.relative_to(base).as_posix()

    for path in files:
        if path.suffix == ".json":
            row = listed_files(path, name(path))
            if row is not None:
                yield row
    yield from surface_checks(files, name)
    for path in files:
        for reader in READERS.get(path.suffix.lower(), ()):
            yield from reader(path, name(path))
    for ending, reader in ((".png", png), (".exr", exr)):
        for folder in sorted({p.parent for p in files if p.suffix.lower() == ending}):
            chosen = [p for p in files if p.parent == folder and p.suffix.lower() == ending]
            yield from reader(chosen, f"{name(folder)}/*{ending}" if folder != base else f"*{ending}")
    models = [p for p in files if p.suffix.lower() in MODELS]
    if models:
        yield from by_blender(models, [name(p) for p in models], blender)


def _rendered(
    place: Path, files: Sequence[Path], folder: Path, blender: str | None, rendering: Rendering, checks: list[Check]
) -> Iterator[Difference]:
    """Render the first GLB (else the first model) with both renderers; adds a row to `checks` for each shot."""
    models = [p for p in files if p.suffix.lower() in (".glb", ".gltf")] or [
        p for p in files if p.suffix.lower() in MODELS and not p.name.endswith("_look.usda")
    ]
    if not models:
        return
    base = place if place.is_dir() else place.parent
    name, check = models[0].relative_to(base).as_posix(), "Cycles against Mitsuba"
    if blender is None:
        checks.append(Check(name, check, "not checked", f"Blender not found (name it with --blender or {BLENDER})"))
        return
    from mistyle.render.external.renderers import features, renderer, shots, subject

    both = [renderer("blender:cycles", blender), renderer("mitsuba:path")]
    with TemporaryDirectory(prefix="mistyle-") as work:
        try:
            scene = subject(models[0], Path(work), both, rendering.threads)
            unlike = features(scene)
            if unlike:
                checks.append(Check(name, check, "not checked", f"{', '.join(unlike)}: left out of this check"))
                return
            for k, shot in enumerate(shots(scene, [rendering.light], rendering.views, rendering.size)):
                pair = [r.draw(scene, shot, rendering.spp, [1 + 1000 * k + 100 * j]) for j, r in enumerate(both)]
                pictures = [drawn.pictures[0] for drawn in pair]
                difference, error = compared(shot.name, *pictures)
                _write_pictures(folder, shot.name, pictures, error)
                checks.append(_verdict(name, check, difference, " and ".join(drawn.version for drawn in pair)))
                yield difference
        except MistyleError as error:
            checks.append(Check(name, check, "failed", str(error)[-300:]))


def compared(
    shot: str, reference: Float[np.ndarray, "h w 4"], test: Float[np.ndarray, "h w 4"]
) -> tuple[Difference, Float[np.ndarray, "h w"]]:
    """The difference of two renders (linear Rec.709, premultiplied, alpha), and the FLIP map."""
    from mistyle.core.image import luminance, overlap
    from mistyle.measure.pictures.metrics import measure_colour

    a, b = (np.nan_to_num(p[..., :3]).astype(np.float32) for p in (reference, test))
    inside = [p[..., 3] > 0.5 for p in (reference, test)]
    seen = (reference[..., 3] > 0) | (test[..., 3] > 0)
    both = inside[0] & inside[1]
    metrics = measure_colour(a, b, seen, ("flip",))
    first, second = luminance(a)[both], luminance(b)[both]
    varies = len(first) > 1 and first.std() > 0 and second.std() > 0
    correlation = float(np.corrcoef(first, second)[0, 1]) if varies else float(np.array_equal(first, second))
    bright = float(second.mean() / first.mean()) if len(first) and first.mean() > 0 else float("nan")
    return Difference(shot, metrics.values["flip"], overlap(*inside), correlation, bright), metrics.maps["flip"]


def _verdict(name: str, check: str, d: Difference, versions: str) -> Check:
    fine = d.flip <= MOST_FLIP and d.overlap >= LEAST_OVERLAP and d.correlation >= LEAST_CORRELATION
    message = (
        f"{d.shot}: FLIP {d.flip:.4f}, silhouettes {d.overlap:.4f}, correlation {d.correlation:.4f}, "
        f"brightness {d.brightness:.4f} ({versions})"
    )
    return Check(name, check, "passed" if fine else "failed", message)


def _write_pictures(folder: Path, shot: str, pictures: Sequence[np.ndarray], error: np.ndarray) -> None:
    from mistyle.core.image import srgb_from_linear
    from mistyle.jobs.report.false_colour import heat

    for who, picture in zip(("cycles", "mitsuba"), pictures, strict=True):
        planes = dict(zip("RGBA", np.moveaxis(picture, -1, 0), strict=False))
        write_exr(folder / "renders" / f"{shot}_{who}.exr", planes)
    # Over middle grey, so that dark and missing parts differ.
    shown = [srgb_from_linear(p[..., :3] + 0.18 * (1 - p[..., 3:4])) for p in pictures]
    write_png(folder / f"{shot}.png", np.concatenate([*shown, heat(error) / np.float32(255)], axis=1))


def table(record: dict[str, Any]) -> str:
    """The checks as a text table: outcome, file, check, message."""
    rows = [(c["outcome"], c["file"], c["check"], c["said"]) for c in record["checks"]]
    widths = [max((len(row[k]) for row in rows), default=0) for k in range(3)]
    lines = ["  ".join([*(row[k].ljust(widths[k]) for k in range(3)), row[3]]) for row in rows]
    passed = len(rows) - record["failed"] - record["not_checked"]
    lines.append(f"{passed} passed, {record['failed']} failed, {record['not_checked']} not checked: {record['out']}")
    return "\n".join(lines)
