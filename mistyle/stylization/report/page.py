"""Content of a stylization job's report: pictures, steps and metrics; `jobs/report/page.py` renders the page."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.camera import Camera
from mistyle.core.view import View
from mistyle.jobs.progress import Progress
from mistyle.jobs.report import overlays as report_overlays
from mistyle.jobs.report.draw import close_up, draw, shown
from mistyle.jobs.report.model import page_model
from mistyle.jobs.report.page import (
    BeforeAfter,
    Figure,
    MapSet,
    Note,
    Report,
    ReportPicture,
    Step,
    Timing,
    write_report,
)
from mistyle.jobs.report.parts import file_list, heat, map_shots, mask_over, setting_groups, side_by_side
from mistyle.jobs.report.pictures import Sizes, kind_in_step, kind_of_maps
from mistyle.jobs.report.turntable import write_turn
from mistyle.jobs.versions import versions
from mistyle.stylization.optimise.judge import TOLERANCE, regressed, undone_where
from mistyle.stylization.pipeline.finishing import finish_pair
from mistyle.stylization.pipeline.job import DISPLACE, FINISH, FIRST, RETOUCH, STAGES
from mistyle.stylization.report.style_reading import look_facts
from mistyle.stylization.report.summary import MEANINGS, figures

SAME = "Under the same studio light"
UNFITTED = (
    "The painting's own relief and gloss. The views were drawn from these maps, so no fit ran; --refine all runs it."
)


def job_report(folder: Path, result: Any, progress: Progress, report: Callable[[float], None]) -> None:
    """Draw the pictures and write `index.html` and `overview.png` (mesh, style, result) into `folder`.

    A full report also has `beauty.png` (path-traced) and the turntable's frames, `turntable/*.png` and
    `turntable.webp`.
    """
    from mistyle.io.images.write import write_png

    settings = result.job.settings
    full = settings.report.detail == "full"
    looks = (result.repaired.maps, result.atlas.start, *(() if settings.keeps_painting else (result.baked.maps,)))
    drawn = draw(result.asset, looks, settings, lambda done: report(0.7 * done), turning=2, path_traced=full)
    after, bare, *before = drawn.close
    best = after if drawn.traced is None else drawn.traced
    if full:
        write_turn(folder / "turntable", drawn.turns[0])
        write_png(folder / "beauty.png", best)
    write_png(folder / "overview.png", side_by_side([bare, result.style.rgb, best]))
    report(0.8)
    named = STAGES | RETOUCH | FINISH | FIRST | DISPLACE
    page = Report(
        title=result.job.name,
        mesh=result.job.mesh.name,
        style=result.job.style.name,
        painting=ReportPicture(result.style.rgb, f"The style: {result.job.style.name}"),
        turntable=tuple(drawn.turns[0]),
        plain=tuple(drawn.turns[1]),
        made=f"mistyle {versions()['mistyle']}, seed {settings.seed}",
        facts=facts(result),
        notes=tuple(Note(text) for text in progress.notes),
        steps=steps(
            result,
            [
                BeforeAfter(ReportPicture(b, "as baked"), ReportPicture(after, "after fit and repair"), SAME)
                for b in before
            ],
        ),
        maps=map_sets(result),
        model=page_model(result.folder / f"{result.job.name}.glb"),
        timings=tuple(Timing(named[k], v, k in progress.reused) for k, v in progress.seconds.items()),
        figures=tuple(Figure(k, f"{v:.4g}", *MEANINGS[k.split(".")[-1]]) for k, v in figures(result).items()),
        settings=setting_groups(settings),
        versions=tuple(versions().items()),
        files=file_list(result.folder, result.job.name),
    )
    write_report(folder / "index.html", page)


def map_sets(result: Any) -> tuple[MapSet, ...]:
    """The final maps of every texture set, with their overlays."""
    sets, longest = [], Sizes().of(kind_of_maps(len(result.asset.mesh.parts)))
    for k, (name, texels) in enumerate(zip(result.asset.mesh.parts, result.atlas.texels, strict=True)):
        pulled = report_overlays.struggle(result.fit.struggle[k], result.fit.touched[k], texels, longest)
        over = (
            report_overlays.coverage(result.baked.seen[k], len(result.views), texels, longest),
            *((pulled,) if pulled is not None else ()),
            report_overlays.repaired(result.repaired.mask[k], texels, longest),
        )
        sets.append(MapSet(name, map_shots(result.repaired.maps[k], longest), over))
    return tuple(sets)


def facts(result: Any) -> tuple[tuple[str, str], ...]:
    """Counts of the mesh, its textures and the views."""
    mesh = result.asset.mesh
    return (
        ("faces", f"{len(mesh.faces):,}"),
        ("texture sets", str(len(mesh.parts))),
        ("texture size", f"{result.job.settings.atlas.size}²"),
        ("UVs", {"kept": "the mesh's own", "shifted": "the mesh's own", "new": "new"}[result.asset.source.uv]),
        ("views", str(len(result.views))),
    )


def steps(result: Any, refined: Sequence[BeforeAfter]) -> tuple[Step, ...]:
    """The stages in the order of the paper; `refined` are pictures before and after fit and repair."""
    views = Step(
        "Views of the mesh",
        "Every camera of the rig, with the mesh's own material.",
        "4.1.1",
        shots=tuple(ReportPicture(view_picture(v), angle(v.camera)) for v in result.views),
        columns=8,
    )
    stylized = Step(
        "Stylized views",
        (
            "The surface is painted once, so the views agree by construction."
            if result.job.settings.stylizer == "embedded"
            else "Views are painted one after another and keep the pixels that earlier views show."
        )
        + " Paint one over in stylized/ and rerun: the paint goes into the texture.",
        "4.1.3",
        shots=tuple(ReportPicture(view_picture(v), angle(v.camera)) for v in result.stylized),
        facts=look_facts(result.looks),
        columns=8,
    )
    parts, longest = list(zip(result.asset.mesh.parts, result.atlas.texels, strict=True)), Sizes().of(kind_in_step(3))
    baked = Step(
        "Bake",
        "How many views see each texel: dark blue none, yellow many.",
        "4.1.4",
        shots=tuple(
            ReportPicture(
                heat(result.baked.seen[k], len(result.views), t, longest), f"{name}: seen by views", sharp=True
            )
            for k, (name, t) in enumerate(parts)
        ),
        columns=3,
    )
    finish = () if result.finishing is None else (finish_step(result),)
    shape = () if result.reshaped is None or not result.reshaped.shape.changed else (shape_step(result),)
    return (views, stylized, baked, *finish, *shape, *refining(result, refined, longest))


def refining(result: Any, pairs: Sequence[BeforeAfter], longest: int) -> tuple[Step, ...]:
    """The steps of fit and repair, or the reason why none ran."""
    if result.job.settings.keeps_painting:
        return (Step("Normal and roughness", UNFITTED, "4.2"),)
    parts = list(zip(result.asset.mesh.parts, result.atlas.texels, strict=True))
    fit = Step(
        "Differentiable fit",
        "Normal and roughness under directional light, then albedo under ambient light. "
        + (undone_where() if result.job.settings.fit.judge else "Every phase is kept: fit.judge is off."),
        "4.2",
        pairs=tuple(pairs),
        facts=fit_facts(result.fit),
    )
    repair = Step(
        "Repair",
        "Texels that did not converge in the fit or that no view saw, repainted from the surface. The masks are in "
        "masks/: edit one and rerun to repair its white texels.",
        "4.3",
        shots=tuple(
            ReportPicture(
                mask_over(result.repaired.mask[k], result.repaired.maps[k], t, longest), f"{name}: repaired texels"
            )
            for k, (name, t) in enumerate(parts)
        ),
        columns=3,
    )
    return (fit, repair)


def shape_step(result: Any) -> Step:
    """The stage 'displace': the mesh before and after under a key light, and its account."""
    from mistyle.stylization.displace.pictures import cameras_of, under_key

    shape, settings = result.reshaped.shape, result.job.settings
    changed = [view.camera for view in result.stylized if view.camera.name in shape.views]
    cameras = cameras_of(changed, settings.report.resolution * 2)
    before, after = (under_key(a.mesh, cameras, settings.seed) for a in (result.reshaped.before, result.asset))
    (was, now), moved, account = shape.overlap, shape.result.moved, shape.result
    return Step(
        "Shape",
        "Vertices follow the outlines that differ from the mesh's. Fit, repair and the asset use the displaced mesh; "
        "UVs and topology are the mesh's own.",
        "6.2.2",
        pairs=(
            BeforeAfter(ReportPicture(before, "the mesh"), ReportPicture(after, "displaced"), "Clay under a key light"),
        ),
        facts=(
            ("views with another outline", ", ".join(shape.views)),
            ("overlap with these outlines", f"{was:.4f} → {now:.4f}"),
            ("distance from them", f"{account.distance[0]:.2f} → {account.distance[1]:.2f} pixels"),
            ("largest displacement", f"{100 * moved[1]:.2f} % of the bounding radius"),
            ("points held by the checks", str(account.held)),
        ),
    )


def finish_step(result: Any) -> Step:
    """The stage 'finish': the painting before and after, and its metrics."""
    (before, after), moved = result.finishing.style, f"{result.finishing.moved:.3f} (sRGB, root mean square)"
    return Step(
        "Finish",
        "Style losses of VGG-19 on many rendered crops, each compared with its source region in the painting.",
        pairs=(finish_pair(result.asset, result.finishing, close_up(result.job.settings)),),
        facts=(("style loss", f"{before:.4g} → {after:.4g}"), ("albedo change", moved)),
    )


def angle(camera: Camera) -> str:
    """A camera's azimuth and elevation, else its name."""
    known = np.isfinite(camera.azimuth) and np.isfinite(camera.elevation)
    return f"{camera.azimuth:.0f}° / {camera.elevation:+.0f}°" if known else camera.name


def view_picture(view: View) -> np.ndarray:
    """A view as straight sRGB with coverage."""
    return shown(np.concatenate([view.rgb, view.coverage[..., None]], axis=-1))


def fit_facts(fit: Any) -> tuple[tuple[str, str], ...]:
    """Each phase: kept (with metrics that got worse within the tolerance) or undone, and its metrics."""
    phases = [
        (phase, _judgement(fit, phase) if accepted else "undone: a metric got worse")
        for phase, accepted in fit.kept.items()
    ]
    figures = []
    for name, (before, after) in fit.figures.items():
        undone = "" if fit.kept[name.partition(".")[0]] else f" (undone: the result has {before:.4g})"
        figures.append((name, f"{before:.4g} → {after:.4g}{undone}"))
    return (*phases, *figures)


def _judgement(fit: Any, phase: str) -> str:
    pairs = {name.partition(".")[2]: pair for name, pair in fit.figures.items() if name.startswith(f"{phase}.")}
    if set(pairs) != set(TOLERANCE):
        return "kept, not judged"
    slipped = regressed(*({name: pair[k] for name, pair in pairs.items()} for k in (0, 1)), times=0.0)
    return f"kept; worse within the tolerance: {', '.join(slipped)}" if slipped else "kept; no figure got worse"
