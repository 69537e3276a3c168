"""`mistyle compare --render FILE --with A --with B`: the same asset, camera and light by several renderers.

Each renderer draws every shot with several seeds. The means are compared as pictures are; whether they are noisy
pictures of the same thing is tested from the seeds. OUT/renders/<renderer>/<shot>.exr are the means.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mistyle.comparison.pictures import webp
from mistyle.comparison.pipeline import FILES, compare
from mistyle.comparison.records import CompareJob
from mistyle.core.names import safe_name
from mistyle.io.images.write import write_exr
from mistyle.io.store.atomic import atomic_write
from mistyle.io.store.output import claim
from mistyle.jobs.progress import Progress
from mistyle.jobs.report.false_colour import DIVERGING, mapped
from mistyle.measure.pictures.statistics import Tested, same_picture
from mistyle.render.external.render_files import RenderView
from mistyle.render.external.renderers import Rendered, Renderer, left_out, renderer, shots, subject

LEVEL = 0.01


@dataclass(frozen=True)
class RenderJob:
    """What several renderers draw: an asset or a scene file under each of `lights`, and where the comparison goes.

    renderers  as on the command line, such as mitsuba:path; the first is the reference
    seeds      independent renders of a shot; from two on they are tested
    views      cameras around an asset
    threads    of blender:cycles, 0: all
    blender    the Python that has bpy
    """

    file: Path
    renderers: tuple[str, ...]
    out: Path
    lights: tuple[str, ...]
    spp: int
    size: int
    seeds: int
    views: int
    threads: int = 0
    blender: str | None = None
    overwrite: bool = False


def compare_renders(
    job: RenderJob, compared: Callable[[Path, tuple[Path, ...]], CompareJob], progress: Progress
) -> dict[str, Any]:
    """Draw and compare; returns what compare.json holds. `compared` makes the comparison of the first renderer's folder
    of pictures with those of the others."""
    chosen = [renderer(text, job.blender) for text in job.renderers]
    claim(job.out, FILES, inputs=[job.file], overwrite=job.overwrite)
    with TemporaryDirectory(prefix="mistyle-") as work:
        folders, tests, context = _draw(job, chosen, Path(work), progress)
        titles = (f"{job.file.name} by {chosen[0].name}", *(r.name for r in chosen[1:]))
        pictures = replace(compared(folders[0], tuple(folders[1:])), titles=titles)
        return compare(pictures, progress, context, lambda folder: _keep(folder, folders, tests))


def _draw(job: RenderJob, chosen: Sequence[Renderer], work: Path, progress: Progress):
    """Render everything; returns a folder of pictures per renderer, the tests, and what the page says about it."""
    what = subject(job.file, work / "files", chosen, job.threads)
    what.folder.mkdir(parents=True, exist_ok=True)
    every = shots(what, job.lights, job.views, job.size)
    seeds = list(range(job.seeds))
    folders = [work / f"{k}_{safe_name(r.name)}" for k, r in enumerate(chosen)]
    drawn: dict[tuple[str, str], Rendered] = {}
    with progress.stage("render", f"render {len(every)} shot(s) by {len(chosen)} renderers") as report:
        for k, shot in enumerate(every):
            for j, (how, folder) in enumerate(zip(chosen, folders, strict=True)):
                # Seeds of different renderers must not meet: two versions of one renderer would share their noise.
                own = [1 + 1000 * j + s for s in seeds]
                drawn[folder.name, shot.name] = how.draw(what, shot, job.spp, own)
                _save(folder / f"{shot.name}.exr", drawn[folder.name, shot.name])
                report((k * len(chosen) + j + 1) / (len(every) * len(chosen)))
    tests = _tests(every, folders, drawn) if job.seeds > 1 else []
    versions = {r.name: drawn[f.name, every[0].name] for r, f in zip(chosen, folders, strict=True)}
    context = {
        "rendered": f"{job.file.name}, {job.spp} samples a pixel, {job.seeds} seed(s), shots "
        + ", ".join(s.name for s in every),
        "renderers": "; ".join(f"{n} = {v.version}, {np.mean(v.seconds):.2f} s a picture" for n, v in versions.items()),
    }
    missing = left_out(what) if any("mitsuba" in r.kind for r in chosen) else []
    if missing:
        context["not drawn by Mitsuba here"] = ", ".join(missing)
        progress.note(f"Mitsuba does not draw {', '.join(missing)} of {job.file.name} here.")
    if tests:
        context["z-test"] = "; ".join(f"{name}: {said(found)}" for name, found in tests)
    return folders, tests, context


def _save(path: Path, found: Rendered) -> None:
    mean = np.mean(np.stack(found.pictures).astype(np.float64), axis=0).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, dict(zip("RGBA", np.moveaxis(mean, -1, 0), strict=False)))


def _tests(every: Sequence[RenderView], folders: Sequence[Path], drawn: dict) -> list[tuple[str, Tested]]:
    result = []
    for shot in every:
        first = np.stack(drawn[folders[0].name, shot.name].pictures)[..., :3]
        for folder in folders[1:]:
            other = np.stack(drawn[folder.name, shot.name].pictures)[..., :3]
            if first.shape[1:] == other.shape[1:] and np.isfinite(first).all() and np.isfinite(other).all():
                result.append((f"{shot.name}, {folder.name}", same_picture(first, other, LEVEL)))
    return result


def said(found: Tested) -> str:
    """A test's result in a sentence."""
    where = (
        f"different in {100 * found.share:.2g} % of the picture" if found.share else "different in no place of its own"
    )
    verdict = "same picture" if found.passed else where + (" and in its mean" if found.whole else "")
    return f"{verdict} at {100 * LEVEL:g} % (Šidák), largest |t| {found.worst:.1f}, mean {100 * found.bias:+.2f} %"


def _keep(folder: Path, renders: Sequence[Path], tests: Sequence[tuple[str, Tested]]) -> list[dict[str, Any]]:
    """Copy the renders into OUT and write the tests' pictures; returns what the page shows of them."""
    for source in renders:
        shutil.copytree(source, folder / "renders" / source.name)
    shown = []
    for k, (name, found) in enumerate(tests):
        picture = mapped(found.t / 16 + 0.5, DIVERGING)
        edge = found.rejected
        picture[edge] = (0.35 * picture[edge] + 0.65 * np.array([255, 220, 0])).astype(np.uint8)
        atomic_write(folder / "ztest" / f"{k:03d}.webp", webp(picture, None))
        text = f"{said(found)}; blue: the test is darker, red: brighter, |t| up to 8; yellow: rejected blocks"
        shown.append({"title": f"z-test, {name}", "src": f"ztest/{k:03d}.webp", "text": text})
    return shown
