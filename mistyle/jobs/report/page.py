"""The report: one HTML file with all results of a job, which opens from disk without a network.

`Report` is pure data. Pictures are display-ready arrays: sRGB-encoded, 8 bit or float 0..1; grey, rgb or rgb with
straight alpha. Everything else is text and numbers. `write_report` inlines every picture as WebP and escapes every text
(jinja2 autoescape). A content-security policy forbids every connection and allows the page's scripts by their hashes.
A small enough asset is shown in 3D (jobs/report/model.py). Without scripts the turntable stays on its first frame, and
the asset is a picture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mistyle.io.store.atomic import atomic_write
from mistyle.jobs.report.charts import Chart, svg
from mistyle.jobs.report.html import csp_hash, template
from mistyle.jobs.report.model import PageModel, TooLarge, packed, viewer_script
from mistyle.jobs.report.pictures import Encoder, Sizes, accents, kind_in_step, kind_of_maps, palette

Pixels: TypeAlias = (
    UInt8[np.ndarray, "h w c"]
    | UInt8[np.ndarray, "h w"]
    | Float[np.ndarray, "h w c"]
    | Float[np.ndarray, "h w"]
    | Bool[np.ndarray, "h w"]
)

# Limit of the whole file; if a job's pictures exceed it, all of them are scaled down.
MOST_BYTES = 8_000_000
SCALES = (1.0, 0.75, 0.55, 0.4, 0.25)


@dataclass(frozen=True)
class ReportPicture:
    """One picture with its caption; `sharp` encodes it without loss (masks, charts)."""

    picture: Pixels
    caption: str
    detail: str = ""
    sharp: bool = False


@dataclass(frozen=True)
class BeforeAfter:
    """Two pictures of the same size in one frame with a handle between them."""

    before: ReportPicture
    after: ReportPicture
    caption: str = ""


@dataclass(frozen=True)
class Step:
    """One stage of the job: a heading, a sentence or two, comparisons, charts and pictures, and a few facts.

    `section` names the paper's section; `columns` is the number of pictures in a row on a wide screen.
    """

    title: str
    text: str = ""
    section: str = ""
    pairs: tuple[BeforeAfter, ...] = ()
    shots: tuple[ReportPicture, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    charts: tuple[Chart, ...] = ()
    columns: int = 4


@dataclass(frozen=True)
class Overlay:
    """An overlay on the maps of a texture set: a picture of their size with alpha, and the legend of its colours."""

    name: str
    picture: Pixels
    legend: str


@dataclass(frozen=True)
class MapSet:
    """The maps of one texture set, and their overlays."""

    name: str
    shots: tuple[ReportPicture, ...]
    overlays: tuple[Overlay, ...] = ()


@dataclass(frozen=True)
class Timing:
    """The seconds of a stage; `reused` where its result came from an earlier run."""

    name: str
    seconds: float
    reused: bool = False


@dataclass(frozen=True)
class Figure:
    """A measured figure and its meaning; `better` is the direction of improvement."""

    name: str
    value: str
    meaning: str
    better: Literal["higher", "lower", ""] = ""


@dataclass(frozen=True)
class Setting:
    """One setting of the job; `chosen` where it differs from the default."""

    name: str
    value: str
    meaning: str = ""
    chosen: bool = False


@dataclass(frozen=True)
class File:
    """One file of the asset: path relative to the report's run folder, size in bytes, sha256."""

    path: str
    size: int
    sha256: str
    detail: str = ""


@dataclass(frozen=True)
class Note:
    """A note to the reader; the page highlights a warning."""

    text: str
    warning: bool = False


@dataclass(frozen=True)
class Report:
    """The content of the page; empty tuples leave their part out.

    `turntable` and `plain` are evenly spaced frames round the stylized and the original asset, equal in size and
    number, with a transparent background. The page starts with the first frame. `made` names version and seed in one
    line. The title reads "mesh relation style". `model` is the 3D model, or the reason why the page has none.
    """

    title: str
    mesh: str
    style: str
    painting: ReportPicture
    turntable: tuple[Pixels, ...]
    plain: tuple[Pixels, ...] = ()
    made: str = ""
    facts: tuple[tuple[str, str], ...] = ()
    notes: tuple[Note, ...] = ()
    steps: tuple[Step, ...] = ()
    maps: tuple[MapSet, ...] = ()
    timings: tuple[Timing, ...] = ()
    figures: tuple[Figure, ...] = ()
    settings: Mapping[str, tuple[Setting, ...]] = field(default_factory=dict)
    versions: tuple[tuple[str, str], ...] = ()
    files: tuple[File, ...] = ()
    relation: str = "in the style of"
    model: PageModel | TooLarge | None = None


def write_report(path: Path, report: Report) -> None:
    """Write the report to `path` as one HTML file.

    The file stays below MOST_BYTES unless even pictures of a quarter of the usual size exceed it.
    Raises ValueError where the turntable has no frames, or where `plain` has another number of frames.
    """
    if not report.turntable:
        raise ValueError("a report needs at least one turntable frame")
    if report.plain and len(report.plain) != len(report.turntable):
        raise ValueError(f"{len(report.plain)} frames of the original for {len(report.turntable)} of the turntable")
    # Encoding at the smallest size takes a tenth of the usual time, and predicts the sizes that can fit.
    tried = Encoder(SCALES[-1])
    smallest = render(report, SCALES[-1], tried).encode()
    page = smallest
    for scale in SCALES[:-1]:
        if len(smallest) + tried.growth(scale) > MOST_BYTES:
            continue
        page = render(report, scale).encode()
        if len(page) <= MOST_BYTES:
            break
        page = smallest
    atomic_write(path, page)


def render(report: Report, scale: float = 1.0, encoder: Encoder | None = None) -> str:
    """The page as text, with every picture at `scale` of its usual size, encoded once."""
    from markupsafe import Markup

    folder = Path(__file__).parent
    script = (folder / "report.js").read_text(encoding="utf-8")
    viewer = viewer_script() if isinstance(report.model, PageModel) else ""
    swatches, sizes = palette(report.painting.picture), Sizes(scale)
    return _template().render(
        report=report,
        total=sum(t.seconds for t in report.timings),
        longest=max([t.seconds for t in report.timings], default=0.0) or 1.0,
        sizes=sizes,
        webp=encoder or Encoder(scale),
        kind_in_step=kind_in_step,
        kind_of_maps=kind_of_maps,
        palette=swatches,
        accent=accents(swatches),
        # Both files belong to mistyle and hold no foreign text.
        style=Markup((folder / "report.css").read_text(encoding="utf-8")),
        script=Markup(script),
        # base64 needs no escaping.
        asset=Markup(packed(report.model, sizes.of("texture"))) if isinstance(report.model, PageModel) else "",
        viewer=Markup(viewer),
        policy=Markup(policy([script, viewer] if viewer else [script])),
    )


@cache
def _template() -> Any:
    """The page's template, compiled."""
    from markupsafe import Markup

    def drawing(chart: Chart) -> Any:
        return Markup(svg(chart))  # svg() escapes the chart's own texts

    path = Path(__file__).with_name("report.html.j2")
    return template(path, seconds=seconds, size=size, slug=slug, svg=drawing)


def policy(scripts: Sequence[str]) -> str:
    """The content-security policy of a page with these scripts: the page may load only its own blobs and data URIs.

    The viewer, the second script, reads the asset and its textures from blobs of the page.
    """
    hashes = [csp_hash(script) for script in scripts]
    blobs = len(scripts) > 1
    rules = {
        "default-src": "'none'",
        "img-src": "data: blob:" if blobs else "data:",
        **({"connect-src": "blob:"} if blobs else {}),
        "style-src": "'unsafe-inline'",
        "script-src": " ".join(f"'sha256-{value}'" for value in hashes),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def seconds(value: float) -> str:
    """A duration as text: '0.4 s', '12 s', '3 min 05 s', '1 h 02 min'."""
    if value < 9.95:
        return f"{value:.1f} s"
    whole = round(value)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size(count: int) -> str:
    """A number of bytes as text, in powers of 1000."""
    if count < 1000:
        return f"{count} B"
    power = 1
    while power < 4 and count / 1000**power >= 999.5:
        power += 1
    value, unit = count / 1000**power, ("kB", "MB", "GB", "TB")[power - 1]
    return f"{value:.1f} {unit}" if value < 99.95 else f"{value:.0f} {unit}"


def slug(text: str) -> str:
    """A text as an anchor: letters, digits and hyphens."""
    words = "".join(c if c.isascii() and c.isalnum() else " " for c in text.lower())
    return "-".join(words.split()) or "part"
