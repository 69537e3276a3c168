"""`mistyle compare --render FILE --with A --with B`: the same asset, camera and light by several renderers.

Each renderer draws every shot with several seeds. The means over seeds are compared as pictures, and a z-test over
seeds decides whether they are equal up to noise. OUT/renders/<renderer>/<shot>.exr are the means.
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
    """An asset or a scene file, the renderers and `lights` that draw it, and the output folder of the comparison.

    renderers  as on the command line, such as mitsuba:path; the first is the reference
    seeds      independent renders of a shot; two or more allow the z-test
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
    """Draw and compare; returns the content of compare.json. `compared` gives the job that compares the first
    renderer's folder of pictures with the others' folders."""
    chosen = [renderer(text, job.blender) for text in job.renderers]
    claim(job.out, FILES, inputs=[job.file], overwrite=job.overwrite)
    with TemporaryDirectory(prefix="mistyle-") as work:
        folders, tests, context = _draw(job, chosen, Path(work), progress)
        titles = (f"{job.file.name} by {chosen[0].name}", *(r.name for r in chosen[1:]))
        pictures = replace(compared(folders[0], tuple(folders[1:])), titles=titles)
        return compare(pictures, progress, context, lambda folder: _keep(folder, folders, tests))


def _draw(job: RenderJob, chosen: Sequence[Renderer], work: Path, progress: Progress):
    """Render all shots; returns a folder of pictures per renderer, the z-tests, and the context of the page."""
    scene = subject(job.file, work / "files", chosen, job.threads)
    scene.folder.mkdir(parents=True, exist_ok=True)
    every = shots(scene, job.lights, job.views, job.size)
    seeds = list(range(job.seeds))
    folders = [work / f"{k}_{safe_name(r.name)}" for k, r in enumerate(chosen)]
    drawn: dict[tuple[str, str], Rendered] = {}
    with progress.stage("render", f"render {len(every)} shot(s) by {len(chosen)} renderers") as report:
        for k, shot in enumerate(every):
            for j, (engine, folder) in enumerate(zip(chosen, folders, strict=True)):
                # Renderers get disjoint seeds: two versions of one renderer would otherwise share their noise.
                own = [1 + 1000 * j + s for s in seeds]
                drawn[folder.name, shot.name] = engine.draw(scene, shot, job.spp, own)
                _save(folder / f"{shot.name}.exr", drawn[folder.name, shot.name])
                report((k * len(chosen) + j + 1) / (len(every) * len(chosen)))
    tests = _tests(every, folders, drawn) if job.seeds > 1 else []
    versions = {r.name: drawn[f.name, every[0].name] for r, f in zip(chosen, folders, strict=True)}
    context = {
        "rendered": f"{job.file.name}, {job.spp} samples a pixel, {job.seeds} seed(s), shots "
        + ", ".join(s.name for s in every),
        "renderers": "; ".join(f"{n} = {v.version}, {np.mean(v.seconds):.2f} s a picture" for n, v in versions.items()),
    }
    missing = left_out(scene) if any("mitsuba" in r.kind for r in chosen) else []
    if missing:
        context["not drawn by Mitsuba"] = ", ".join(missing)
        progress.note(f"Mitsuba does not draw {', '.join(missing)} of {job.file.name}.")
    if tests:
        context["z-test"] = "; ".join(f"{name}: {verdict_text(test)}" for name, test in tests)
    return folders, tests, context


def _save(path: Path, rendered: Rendered) -> None:
    mean = np.mean(np.stack(rendered.pictures).astype(np.float64), axis=0).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, dict(zip("RGBA", np.moveaxis(mean, -1, 0), strict=False)))


def _tests(every: Sequence[RenderView], folders: Sequence[Path], drawn: dict) -> list[tuple[str, Tested]]:
    result = []
    for shot in every:
        first = np.stack(drawn[folders[0].name, shot.name].pictures)[..., :3]
        for folder in folders[1:]:
            second = np.stack(drawn[folder.name, shot.name].pictures)[..., :3]
            if first.shape[1:] == second.shape[1:] and np.isfinite(first).all() and np.isfinite(second).all():
                result.append((f"{shot.name}, {folder.name}", same_picture(first, second, LEVEL)))
    return result


def verdict_text(test: Tested) -> str:
    """A z-test's result as a sentence."""
    differing = [f"in {100 * test.share:.2g} % of the picture"] if test.share else []
    differing += ["in its mean"] if test.whole else []
    verdict = "same picture" if test.passed else f"different {' and '.join(differing)}"
    return f"{verdict} at {100 * LEVEL:g} % (Šidák), largest |t| {test.worst:.1f}, mean {100 * test.bias:+.2f} %"


def _keep(folder: Path, renders: Sequence[Path], tests: Sequence[tuple[str, Tested]]) -> list[dict[str, Any]]:
    """Copy the renders into OUT and write the z-tests' pictures; returns their entries for the page."""
    for source in renders:
        shutil.copytree(source, folder / "renders" / source.name)
    shown = []
    for k, (name, test) in enumerate(tests):
        picture = mapped(test.t / 16 + 0.5, DIVERGING)
        edge = test.rejected
        picture[edge] = (0.35 * picture[edge] + 0.65 * np.array([255, 220, 0])).astype(np.uint8)
        atomic_write(folder / "ztest" / f"{k:03d}.webp", webp(picture, None))
        text = f"{verdict_text(test)}; blue: the test is darker, red: brighter, |t| up to 8; yellow: rejected blocks"
        shown.append({"title": f"z-test, {name}", "src": f"ztest/{k:03d}.webp", "text": text})
    return shown
