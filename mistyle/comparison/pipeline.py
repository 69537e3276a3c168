"""`mistyle compare`: pictures against their references, one pair in memory at a time.

OUT/index.html, OUT/pairs/   a page that works from disk, and its pictures
OUT/compare.json, .csv, junit.xml   the same, machine-readable
OUT/inset.png, inset.pdf     the figure of --crop
"""

import heapq
import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.comparison.frames import Match, matches
from mistyle.comparison.inputs import Planes, alpha_mask, chosen_layers, planes, read_mask, reduced, window_notes
from mistyle.comparison.limits import broken, without_effect
from mistyle.comparison.pictures import PairPictures, thumbnail, worst_regions, write_pictures
from mistyle.comparison.records import CompareJob, ComparisonRow, columns, csv_text, junit_text, number, row_record
from mistyle.core.errors import InputRefused
from mistyle.io.images.layers import BEAUTY, LayeredPicture
from mistyle.io.store.atomic import atomic_write
from mistyle.io.store.output import claim, replace_files
from mistyle.jobs.progress import Progress, grouped
from mistyle.jobs.versions import peak_gb, versions
from mistyle.measure.pictures import metrics, protocols
from mistyle.measure.pictures.metrics import METRICS, MetricValues

ALPHA = (
    "EXR and HDR are treated as premultiplied; straight alpha (PNG, TIFF, WebP) is multiplied in linear light. "
    "Pictures are compared over black; alpha is a separate layer."
)
NONFINITE = (
    "Pixels with a NaN or infinite channel are left out of every metric, magenta in every picture, and fail their row "
    "unless --allow-nonfinite; in data layers equal infinities (background depth) do not fail it."
)
FILES = ("compare.json", "compare.csv", "junit.xml", "index.html")
# The metric that ranks a frame: the first of these that it has.
RANK = ("flip", "hdr_flip", "relmse", "psnr", "psnr_h", "rms_error", "rmse")


@dataclass
class ComparisonState:
    """The comparison so far: mutable, since rows arrive one by one and only the worst keep their pictures."""

    rows: list[ComparisonRow] = field(default_factory=list)
    written: dict[str, PairPictures] = field(default_factory=dict)
    heap: list[tuple[float, int, str]] = field(default_factory=list)
    exposures: dict[tuple[str, str], tuple[float, float, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class _LayerPair:
    """One layer of two pictures over the same window, and its source files."""

    match: Match
    frames: tuple[LayeredPicture, LayeredPicture]
    planes: Planes

    @property
    def high(self) -> bool:
        """Whether the values of either picture may exceed 1."""
        return self.frames[0].high or self.frames[1].high


def compare(
    job: CompareJob,
    progress: Progress,
    context: Mapping[str, Any] | None = None,
    extras: Callable[[Path], list[dict[str, Any]]] | None = None,
) -> dict[str, Any]:
    """Compare all pairs, write the folder, and return the content of compare.json.

    `context` appears in it and on the page (renderers, seeds, …). `extras` may add files to the folder and returns
    pictures for the page: title, src (relative) and text. Failed rows do not raise; the result lists them in
    "failures".
    """
    pairs = matches(job.reference, job.tests, job.out)
    start, state = time.perf_counter(), ComparisonState()
    result: dict[str, Any] = {}

    def write(folder: Path) -> None:
        if job.crop is not None:
            from mistyle.comparison.figure import inset

            with progress.stage("inset", "draw the inset figure"):
                inset(job, pairs, folder)
        with progress.stage("compare", f"compare {len(pairs)} picture{'s' * (len(pairs) != 1)}") as report:
            for k, match in enumerate(pairs):
                _compare_pair(
                    job, match, folder, state, lambda done, k=k: report((k + done) / len(pairs)), len(pairs) == 1
                )
                report((k + 1) / len(pairs))
        overall = without_effect(job.limits, [(r.image, r.layer, r.values) for r in state.rows if r.size[0]])
        result.update(_record(job, state, overall, time.perf_counter() - start, context or {}))
        result["figures"] = extras(folder) if extras is not None else []
        _write_files(folder, result, state, overall)

    inputs = [job.reference, *job.tests]
    claim(job.out, FILES, inputs=inputs, overwrite=job.overwrite)
    replace_files(job.out, "compare", write, inputs=inputs, overwrite=job.overwrite)
    return result


def _compare_pair(
    job: CompareJob, match: Match, folder: Path, state: ComparisonState, report: Callable, alone: bool
) -> None:
    """Compare one pair. A missing or refused picture becomes a failed row; a refusal of the only pair is raised."""
    if match.reference is None or match.test is None:
        who = "the reference" if match.reference is None else "the test"
        missing = f"{who} has no picture of this name"
        failures = () if job.allow_missing else (missing,)
        state.rows.append(ComparisonRow(match.name, match.test_name, "", failures=failures, notes=(missing,)))
        return
    from mistyle.io.read import read_frame

    try:
        reference, test = read_frame(match.reference), read_frame(match.test)
        if job.window == "display":
            reference, test = (replace(f, notes=(*f.notes, *window_notes(f))) for f in (reference, test))
        if job.protocol == "stanford-orb":
            reference = reduced(reference, test, 4)
        names, lost, new = chosen_layers(reference, test, job.layers)
        gate = bool(job.limits) and not job.allow_missing
        notes = [] if gate else [f"layer {name!r} is in the reference only" for name in lost]
        notes += [f"layer {name!r} is in the test only" for name in new]
        mask, refused = _mask(job, reference), []
        for k, name in enumerate(names):
            try:
                pair = _LayerPair(match, (reference, test), planes(reference, test, name, job.window, mask))
            except InputRefused as error:
                refused.append((name, error))
                continue
            _compare_layer(job, pair, notes, folder, state, lambda d, k=k: report((k + d) / len(names)))
            notes = []
        if len(refused) == len(names):
            raise refused[0][1]
        failed = [(name, f"refused: {error}") for name, error in refused]
        failed += [(name, "the test has no layer of this name") for name in lost if gate]
        state.rows += [ComparisonRow(match.name, match.test_name, name, failures=(why,)) for name, why in failed]
    except InputRefused as error:
        if alone:
            raise
        state.rows.append(ComparisonRow(match.name, match.test_name, "", failures=(f"refused: {error}",)))


def _mask(job: CompareJob, reference: LayeredPicture) -> np.ndarray | None:
    if job.mask is None:
        return None
    return alpha_mask(reference) if job.mask == "alpha" else read_mask(Path(job.mask), reference)


def _compare_layer(
    job: CompareJob,
    pair: _LayerPair,
    notes: Sequence[str],
    folder: Path,
    state: ComparisonState,
    report: Callable[[float], None],
) -> None:
    """Compare one layer: its row in `state`, and its pictures in `folder`."""
    match, frames, both, high = pair.match, pair.frames, pair.planes, pair.high
    measured = _measure(job, pair, state, report)
    odd = int(both.odd.sum())
    failures = [] if job.allow_nonfinite or not odd else [_nonfinite(both)]
    if not both.mask.any():
        failures.append("no pixel could be compared")
    failures += broken(job.limits, match.name, both.layer, measured.values)
    error = next((measured.maps[n] for n in ("flip", "hdr_flip") if n in measured.maps), None)
    ranked = error if error is not None else _plain_error(both)
    row = ComparisonRow(
        image=match.name,
        test=match.test_name,
        layer=both.layer,
        kind=both.kind,
        size=(both.mask.shape[1], both.mask.shape[0]),
        pixels=int(both.mask.sum()),
        values=measured.values,
        bad=both.bad,
        exposures=measured.exposures,
        worst=worst_regions(ranked, both.mask),
        high=high,
        failures=tuple(failures),
        notes=(*match.notes, *notes, *_of_files(*frames)),
        files=(frames[0].path.name, frames[1].path.name),
    )
    place = f"pairs/{len(state.rows):05d}"
    thumbnail(folder / f"{place}.webp", both, error)
    if _worth_showing(job, row, place, folder, state):
        state.written[place] = write_pictures(folder / place, both, measured.maps, high)
        row = replace(row, folder=place)
    state.rows.append(row)


def _of_files(reference: LayeredPicture, test: LayeredPicture) -> list[str]:
    """The notes of reading both files, each with the file that it is about."""
    texts = dict.fromkeys((*reference.notes, *test.notes))
    who = {text: [w for w, f in (("reference", reference), ("test", test)) if text in f.notes] for text in texts}
    return [f"{' and '.join(who[text])}: {text}" for text in texts]


def _measure(
    job: CompareJob, pair: _LayerPair, state: ComparisonState, report: Callable[[float], None]
) -> MetricValues:
    both = pair.planes
    if job.protocol is not None:
        return MetricValues(_protocol(job, pair.frames, both) if both.kind == "colour" else {})
    if both.kind == "data":
        return metrics.measure_data(both.reference, both.test, both.mask, job.metrics)
    names = [n for n in job.metrics if METRICS[n].kind == "colour" and (pair.high or n != "hdr_flip")]
    if job.viewing.lpips is None:
        names = [n for n in names if n != "lpips"]
    viewing = job.viewing
    if "hdr_flip" in names and viewing.exposures is None:
        key = (pair.match.name, both.layer)
        if key not in state.exposures:
            usable = (both.mask | both.odd) & np.isfinite(both.reference).all(axis=-1)
            state.exposures[key] = metrics.flip_exposures(both.reference, usable)
        viewing = replace(viewing, exposures=state.exposures[key])
    return metrics.measure_colour(both.reference, both.test, both.mask, names, viewing, report)


def _protocol(job: CompareJob, frames: tuple[LayeredPicture, LayeredPicture], both: Planes) -> dict[str, float]:
    a, b = both.reference, both.test
    if job.protocol == "idiff":
        return protocols.idiff(*(_stored(f, both.layer, v) for f, v in zip(frames, (a, b), strict=True)))
    if job.protocol == "tensoir":
        return protocols.tensoir(*(_over_white(f, both.layer, v) for f, v in zip(frames, (a, b), strict=True)))
    alpha = frames[0].layer("alpha")
    shown = both.mask if job.mask is not None or alpha is None else alpha.values()[..., 0]
    return protocols.stanford_orb(a, b, np.asarray(shown, np.float32))


def _straight(frame: LayeredPicture, layer: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """sRGB-encoded colours without premultiplication, and the alpha of the beauty layer."""
    alpha = frame.layer("alpha") if layer == BEAUTY else None
    if alpha is None:
        return metrics.encoded(values), None
    a = alpha.values()
    return metrics.encoded(np.where(a > 0, values / np.maximum(a, 1e-6), 0).astype(np.float32)), a


def _stored(frame: LayeredPicture, layer: str, values: np.ndarray) -> np.ndarray:
    """The channels for idiff: an EXR's values, else encoded colours times alpha; alpha is a channel."""
    if frame.high:
        alpha = frame.layer("alpha") if layer == BEAUTY else None
        return values if alpha is None else np.concatenate([values, alpha.values()], axis=2)
    straight, alpha = _straight(frame, layer, values)
    if alpha is None:
        return straight
    product = straight * alpha
    if np.abs(straight * 255 - np.round(straight * 255)).max() < 0.02:
        product = np.round(product * 255) / np.float32(255)  # idiff multiplies 8-bit pictures in 8 bits
    return np.concatenate([product, alpha], axis=2)


def _over_white(frame: LayeredPicture, layer: str, values: np.ndarray) -> np.ndarray:
    straight, alpha = _straight(frame, layer, values)
    return straight if alpha is None else straight * alpha + (1 - alpha)


def _nonfinite(both: Planes) -> str:
    counts = ", ".join(f"{n} {key.replace('_', ' in the ')}" for key, n in both.bad.items() if n)
    return f"{int(both.odd.sum())} pixels are not finite ({counts})"


def _plain_error(both: Planes) -> np.ndarray:
    result = np.empty(both.mask.shape, np.float32)
    for start in range(0, len(result), 64):  # whole pictures would need four times their memory
        a, b = (np.nan_to_num(v[start : start + 64], posinf=0, neginf=0) for v in (both.reference, both.test))
        result[start : start + 64] = np.abs(b - a).mean(axis=-1)
    return result


def badness(row: ComparisonRow) -> float:
    """The sort key of rows: larger is worse; failures and rows without metrics come first."""
    for name in RANK:
        if name in row.values:
            value = row.values[name]
            lower = (
                name in METRICS and METRICS[name].better == "lower" or protocols.PROTOCOL_BETTER.get(name) == "lower"
            )
            score = 1e6 if math.isnan(value) else value if lower else -value
            return max(-1e9, min(score, 1e9)) + (1e9 if row.failures else 0.0)
    return 1e9


def _worth_showing(job: CompareJob, row: ComparisonRow, place: str, folder: Path, state: ComparisonState) -> bool:
    """Whether the row is among the `job.pictures` worst so far; the best of those then loses its pictures."""
    if job.pictures <= 0:
        return False
    entry = (badness(row), len(state.rows), place)
    if len(state.heap) < job.pictures:
        heapq.heappush(state.heap, entry)
        return True
    if entry <= state.heap[0]:
        return False
    _, index, dropped = heapq.heapreplace(state.heap, entry)
    shutil.rmtree(folder / dropped, ignore_errors=True)
    state.written.pop(dropped, None)
    state.rows[index] = replace(state.rows[index], folder="")
    return True


def _record(
    job: CompareJob, state: ComparisonState, overall: Sequence[str], seconds: float, context: Mapping
) -> dict[str, Any]:
    rows = state.rows
    failed = [r for r in rows if r.failures]
    names = columns(rows)
    if job.protocol is None:
        exposures = {r.exposures for r in rows if r.exposures}
        viewing = replace(job.viewing, exposures=next(iter(exposures))) if len(exposures) == 1 else job.viewing
        definitions = metrics.definitions(viewing, names)
    else:
        definitions = {job.protocol: protocols.PROTOCOLS[job.protocol]}
    return {
        "reference": job.titles[0] if job.titles else str(job.reference),
        "tests": list(job.titles[1:]) if job.titles else [str(t) for t in job.tests],
        "protocol": job.protocol,
        "definitions": definitions,
        "conventions": {"alpha": ALPHA, "not finite": NONFINITE, "mask": _mask_text(job), "window": job.window},
        "limits": [f"{x.side} {x.metric}={x.value:g} of {x.image} [{x.layer}]" for x in job.limits],
        "summary": summary(rows),
        "rows": [row_record(r) for r in rows],
        "failures": [f"{_row_title(r)}: {text}" for r in failed for text in r.failures] + list(overall),
        "passed": not failed and not overall,
        "notes": grouped((r.image, text) for r in rows for text in r.notes),
        "context": dict(context),
        "seconds": round(seconds, 3),
        "peak_gb": round(peak_gb(), 3),
        "versions": versions(),
    }


def _row_title(row: ComparisonRow) -> str:
    return f"{row.test}: {row.image}" + (f" [{row.layer}]" if row.layer else "")


def _mask_text(job: CompareJob) -> str:
    if job.mask is None:
        return "all pixels"
    return "the reference's alpha above 0.5" if job.mask == "alpha" else f"{Path(job.mask).name} above one half"


def summary(rows: Sequence[ComparisonRow]) -> list[dict[str, Any]]:
    """Per test and layer: the number of rows and of failed rows, and the mean and worst of every metric."""
    result = []
    for test, layer in dict.fromkeys((r.test, r.layer) for r in rows):
        own = [r for r in rows if (r.test, r.layer) == (test, layer)]
        values: dict[str, Any] = {}
        for name in columns(own):
            measured = np.array([r.values[name] for r in own if name in r.values])
            better = METRICS[name].better if name in METRICS else protocols.PROTOCOL_BETTER[name]
            known = measured[~np.isnan(measured)]
            worst = (known.max() if better == "lower" else known.min()) if len(known) else math.nan
            mean = known.mean() if len(known) else math.nan
            values[name] = {"mean": number(float(mean)), "worst": number(float(worst)), "better": better}
        failed = sum(bool(r.failures) for r in own)
        result.append({"test": test, "layer": layer, "images": len(own), "failed": failed, "values": values})
    return result


def _write_files(folder: Path, record: dict[str, Any], state: ComparisonState, overall: Sequence[str]) -> None:
    from mistyle.comparison.page import page

    text = json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    atomic_write(folder / "compare.json", text.encode("utf-8", "replace"))
    atomic_write(folder / "compare.csv", csv_text(state.rows).encode("utf-8", "replace"))
    atomic_write(folder / "junit.xml", junit_text(state.rows, overall).encode("utf-8", "replace"))
    atomic_write(folder / "index.html", page(record, state.written).encode("utf-8", "replace"))
