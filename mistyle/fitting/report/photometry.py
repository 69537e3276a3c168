"""The report's steps about the pictures themselves: solved exposures, and the pixels that the fit ignores."""

from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import of_corners
from mistyle.core.capture import Captures, shrunk_to
from mistyle.core.image import luminance, srgb_from_linear
from mistyle.core.rows import evenly
from mistyle.jobs.report.charts import Chart
from mistyle.jobs.report.page import ReportPicture, Step
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.photometry.record import Photometry, at_size, fall_terms
from mistyle.solver.texels.gbuffer import trace_gbuffer
from mistyle.solver.texels.observations import unmixed_pixels

LONGEST, MOST = 320, 24  # pixels of a side, and pictures
# Colours of ignored pixels.
OUTSIDE, BAND, OTHER, INVALID = (0.1, 0.15, 0.3), (0.95, 0.8, 0.1), (0.9, 0.1, 0.1), (0.2, 0.5, 0.95)


def photometry_steps(results: Any) -> tuple[Step, ...]:
    """Both steps; () for a fit without the stage."""
    found: Photometry | None = results.photometry
    if found is None:
        return ()
    from mistyle.render.mitsuba.draw import tracer

    charts = []
    if found.applied:
        charts = [
            Chart(
                "exposure", {"EV": (found.exposure / np.log(2)).tolist()}, x_label="picture", y_label="EV", bars=True
            ),
            Chart("transmission", {"of all pictures": _fall(found)}, x_label="radius (20: corner)", y_label="share"),
        ]
    matched = Step(
        "Exposures",
        "Exposure of each picture and the vignetting of all, solved from points that several pictures show. The fit "
        "uses pictures without them.",
        charts=tuple(charts),
    )
    shots = ignored_pictures(tracer(results.asset.mesh), results.captures, found)
    ignored = Step(
        "Ignored pixels",
        "Dark blue: beside the mesh. Yellow: silhouettes and creases. Light blue: saturated or masked. Red: other "
        "pictures show the place otherwise (people, trees, flare, wrong geometry).",
        shots=tuple(shots),
        columns=4,
    )
    return matched, ignored


def _fall(found: Photometry) -> list[float]:
    """Transmission at twentieths of the half diagonal, as far as observations reach."""
    radius = np.linspace(0, 1, 21)
    radius = radius[radius <= found.reach, None] * np.array([[1.0, 0.0]])
    return np.exp(fall_terms(radius) @ found.vignetting).tolist()


def ignored_pictures(traced: Tracer, captures: Captures, found: Photometry) -> list[ReportPicture]:
    """At most MOST pictures, evenly chosen, with their ignored pixels coloured."""
    cells = dict(zip(found.names, found.ignored, strict=True))
    chosen = evenly(len(captures), MOST)
    small = shrunk_to(captures, LONGEST)
    return [_picture(traced, small, k, cells[small.cameras[k].name]) for k in chosen]


def _picture(traced: Tracer, captures: Captures, k: int, cells: np.ndarray) -> ReportPicture:
    camera = captures.cameras[k]
    rgb, valid = captures.load(k)
    seen, corners = trace_gbuffer(traced, camera, ()), trace_gbuffer(traced, of_corners(camera), ())
    band = seen.mask & ~unmixed_pixels(camera, seen, corners)
    other = at_size(cells, camera.size) & seen.mask
    shown = _exposed(rgb)
    layers = ((seen.mask & ~valid, INVALID), (band, BAND), (other, OTHER), (~seen.mask, OUTSIDE))
    for mask, colour in layers:
        shown[mask] = 0.35 * shown[mask] + 0.65 * np.asarray(colour, np.float32)
    used = float((seen.mask & valid & ~band & ~other).sum()) / max(float(seen.mask.sum()), 1.0)
    return ReportPicture(shown, f"{camera.name}: {100 * used:.0f} % of the mesh's pixels are used")


def _exposed(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    light = luminance(rgb)
    white = float(np.percentile(light[light > 0], 99)) if (light > 0).any() else 1.0
    return srgb_from_linear(np.clip(rgb / max(white, 1e-6), 0, 1).astype(np.float32)).copy()
