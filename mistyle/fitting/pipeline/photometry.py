"""The stage `photometry` of `mistyle fit`: exposures of the pictures, solved and removed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.capture import Captures
from mistyle.fitting.pipeline.job import MaterialJob
from mistyle.fitting.pipeline.pictures import pixels_of, watched
from mistyle.fitting.pipeline.times import explaining_seconds, reading_seconds
from mistyle.io.read import read_exposure
from mistyle.jobs.progress import Report, parts
from mistyle.jobs.stages import Run
from mistyle.solver.photometry.record import Gains, Photometry, corrected, unchanged, without_gains

LINEAR = (".exr", ".hdr")


def photometry_mode(job: MaterialJob, shots: Sequence[Any]) -> Literal["none", "exposure", "full"]:
    """The mode of a job, with "auto" decided."""
    chosen = job.settings.photometry.mode
    if chosen != "auto":
        return chosen
    encoded = all(shot.picture.suffix.lower() not in LINEAR for shot in shots)
    return "full" if encoded and job.exposure is None else "none"


@dataclass(frozen=True)
class MatchedPictures:
    """The photometry that a material explains, and the light that was solved with it; None where it is known or still
    to be solved."""

    photometry: Photometry
    light: Any


def match_exposures(
    run: Run, asset: Asset, captures: Captures, shots: Sequence[Any]
) -> tuple[Captures, Photometry | None, Any]:
    """The captures without their exposures, their photometry, and a light that was solved with it; None where the
    stages were left out."""
    job = run.job
    mode = photometry_mode(job, shots)
    if mode == "none":
        run.skip(["photometry", "exposures"], ["cameras"])
        return captures, None, None
    if job.settings.photometry.mode == "auto":
        run.progress.say("The pictures' exposures are solved; --photometry none takes them as they are.")
    found = run.record(
        "photometry", ["cameras"], [mode, job.settings.photometry.exif],
        lambda report: _solved(job, asset, captures, shots, report),
    )  # fmt: skip
    s = job.settings
    matched = run.record(
        "exposures", ["photometry"], [s.recover, s.light],
        lambda report: _explained(job, asset, (captures, shots), (found, mode == "full"), report),
    )  # fmt: skip
    for text in matched.photometry.notes:
        run.progress.say(text)
    return corrected(captures, matched.photometry), matched.photometry, matched.light


def _explained(
    job: MaterialJob,
    asset: Asset,
    pictures: tuple[Captures, Sequence[Any]],
    points: tuple[Photometry, bool],
    report: Report,
) -> MatchedPictures:
    """`pictures` with their files; `points`: their photometry, and whether balances and vignetting are solved too."""
    from mistyle.fitting.light.unknown_light import PICTURES, find_light
    from mistyle.render.deferred.image_samples import tangents_of
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.solver.photometry.explain import explained, worth_explaining
    from mistyle.solver.photometry.material import material_samples
    from mistyle.solver.texels.levenberg_marquardt import Options

    (captures, shots), (found, full), s, light, start = pictures, points, job.settings, None, None
    n, unknown = len(captures), job.lights == "unknown"
    if n < 2 or not worth_explaining(found):
        return MatchedPictures(found, None)
    captures = corrected(captures, without_gains(found))
    read = reading_seconds(shots, pixels_of(captures))
    lit_reading, lighting, reading, explaining = parts(report, explaining_seconds(n, read, unknown))
    if unknown:
        begin = Gains(np.zeros((n, 3)), np.zeros(3))
        light = find_light(
            asset.mesh, watched(captures, min(n, PICTURES), lit_reading), s.recover, lighting,
            outside=s.light.sun, gains=begin, materials=asset.materials,
        )  # fmt: skip
        captures, start = replace(captures, lights=(light.lights,) * n), light.gains
    tangents = tangents_of(asset.mesh, s.recover.frame)
    samples = material_samples(tracer(asset.mesh), watched(captures, n, reading), tangents)
    options = Options(s.recover.model, floor=s.recover.roughness_floor)
    result, solved = explained(samples, found, options, full=full, start=start, progress=explaining)
    report(1.0)
    if result is not found:
        result = replace(result, notes=(*result.notes, *summary(result, 0)))
    return MatchedPictures(result, light if solved else None)


def _solved(job: MaterialJob, asset: Asset, captures: Captures, shots: Sequence[Any], report: Report) -> Photometry:
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.solver.photometry.solve import solve_photometry

    if len(captures) < 2:
        return unchanged(captures, ("Photometry: a single picture has no exposure relative to others.",))
    settings = job.settings.photometry
    exif = [exif_exposure(shot.picture) for shot in shots] if settings.exif else []
    known = sum(math.isfinite(value) for value in exif)
    full = photometry_mode(job, shots) == "full"
    found = solve_photometry(
        tracer(asset.mesh), captures, full=full, exif=exif if known > 1 else (), seed=job.settings.seed, progress=report
    )
    return replace(found, notes=(*found.notes, *summary(found, known)))


def exif_exposure(picture: Any) -> float:
    """Log of seconds · ISO / f-number² by EXIF, NaN where the time is missing. A missing ISO speed or f-number is
    taken to be that of the other pictures."""
    seconds, f_number, iso = read_exposure(picture)
    value = math.log(seconds) if math.isfinite(seconds) else math.nan
    value += math.log(iso) if math.isfinite(iso) else 0.0
    return value - (2 * math.log(f_number) if math.isfinite(f_number) else 0.0)


def summary(found: Photometry, known: int) -> tuple[str, ...]:
    """A sentence with the solved numbers; none where nothing was corrected."""
    if not found.applied:
        return ()
    stops = found.exposure / np.log(2)
    veiled = [name for name, row in zip(found.names, found.veil, strict=True) if np.abs(row).max() > 0]
    veil = " Veiling light (flare, haze) was subtracted." if veiled else ""
    radius, fall = found.gains.edge
    falls = f"corners at {100 * np.exp(fall):.0f} % of the centre"
    if radius < 1:  # the mesh is not seen beyond
        falls = f"{100 * np.exp(fall):.0f} % of the centre's light at {100 * radius:.0f} % of the half diagonal"
    prior = f" EXIF of {known} pictures was the prior." if known > 1 else ""
    return (
        f"Photometry: exposures from {stops.min():+.2f} to {stops.max():+.2f} EV, white balance within "
        f"{100 * (np.exp(np.abs(found.balance).max()) - 1):.0f} %, {falls};"
        f" a point differs between pictures by {100 * found.spread[1]:.0f} % instead of {100 * found.spread[0]:.0f} %."
        + veil + prior,
    )  # fmt: skip
