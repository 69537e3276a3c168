"""How well `fit --scene` finds the parameters of nine Mitsuba scenes again, and how fast beside a plain loop.

    python -m benchmarks.scene_recovery [--quick] [--json FILE]

<scene>.relative_error   the worst number against the truth; worst_relative_error over all scenes of numbers
<scene>.db               textures and attributes, over the texels that a camera sees (peak 1); worst_db over them
<scene>.plain_…          the same by a loop of mi.render, a squared loss and mi.ad.Adam (rate 0.02) with as many steps
<scene>.seconds          of both, compilation included; the reference is not
bias_4spp, _16spp, _64spp   where the loss is least along a common scale of the Cornell box's nine reflectances, from
                         renders of so many samples; 0 is the truth
"""

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.common import arguments, finish
from benchmarks.scene_recovery.scenes import HOUSE, INCLUDE, Case, cases, cornell

STEPS, SIZE, REFERENCE_SPP = 256, 64, 8192
SCALES = (0.98, 1.0, 1.02)
TRUE_INCLUDE = np.array([0.7, 0.2, 0.1])


def reference(scene: Any, spp: int, seed: int = 1) -> list[np.ndarray]:
    """Pictures by every sensor, with samples of their own."""
    import mitsuba

    mi: Any = mitsuba

    result = []
    for k, sensor in enumerate(scene.sensors()):
        parts = max(spp // 64, 1)
        pictures = [
            mi.render(scene, sensor=sensor, spp=64, seed=90_000 + 1000 * seed + 100 * k + j) for j in range(parts)
        ]
        result.append(np.mean([np.array(p)[..., :3] for p in pictures], axis=0))
    return result


def plain(scene: Any, keys: list[str], pictures: list[np.ndarray], steps: int) -> dict[str, np.ndarray]:
    """What a Mitsuba user writes: mi.render, a mean squared difference, Adam, values clipped to 0..1."""
    import drjit as dr
    import mitsuba

    mi: Any = mitsuba

    from mistyle.solver.scene.gradients import ad_integrator

    table, wanted = mi.traverse(scene), [mi.TensorXf(p) for p in pictures]
    engine, _ = ad_integrator(scene)
    optimizer: Any = mi.ad.Adam(lr=0.02)
    for key in keys:
        optimizer[key] = table[key]
    table.update(optimizer)
    for step in range(steps):
        k = step % len(wanted)
        picture = mi.render(scene, table, sensor=k, integrator=engine, spp=16, seed=step)
        dr.backward(dr.mean(dr.square(picture[..., :3] - wanted[k]), axis=None))
        optimizer.step()
        for key in keys:
            optimizer[key] = dr.clip(optimizer[key], 0.0, 1.0)
        table.update(optimizer)
    return {key: np.array(optimizer[key]) for key in keys}


def judged(case: Case, values: dict[str, np.ndarray], seen: dict[str, np.ndarray] | None) -> float:
    """The worst relative error of numbers, or dB of images over what is seen."""
    if not case.images:
        return max(float(np.abs(values[k].ravel() / np.ravel(v) - 1).max()) for k, v in case.true.items())
    wrong = []
    for key, true in case.true.items():
        value, at = values[key], np.ones(values[key].shape, bool) if seen is None else seen[key] > 0
        if value.ndim == 3 and value.shape[1] == true.shape[1] + 2:  # an environment map repeats its ends
            value, at = value[:, 1:-1], at[:, 1:-1]
        wrong.append((value[..., : true.shape[-1]] - true)[at[..., : true.shape[-1]]])
    return float(-10 * np.log10(np.mean(np.concatenate(wrong) ** 2)))


def compared(case: Case, steps: int, size: int, spp: int) -> dict[str, float]:
    """Both fits of one scene."""
    import mistyle

    pictures = reference(case.make(case.true, size), spp)
    what = "db" if case.images else "relative_error"
    start = time.perf_counter()
    fitted = mistyle.fit_scene(case.make(case.start, size), list(case.true), references=pictures, iterations=steps)
    middle = time.perf_counter()
    keys = [p.key for p in fitted.parameters]
    names = {p.key: next(n for n in case.true if n in (*p.names, p.key)) for p in fitted.parameters}
    other = plain(case.make(case.start, size), keys, pictures, steps)
    end = time.perf_counter()
    named, theirs = ({names[k]: v for k, v in values.items()} for values in (fitted.values, other))
    seen = {names[k]: v for k, v in fitted.seen.items()}
    return {
        f"{case.name}.{what}": judged(case, named, seen),
        f"{case.name}.plain_{what}": judged(case, theirs, seen),
        f"{case.name}.seconds": middle - start,
        f"{case.name}.plain_seconds": end - middle,
    }


def included(steps: int, size: int, spp: int) -> dict[str, float]:
    """The scene file with an include, fitted by the verb; judged by the written file as Mitsuba loads it."""
    import mitsuba

    mi: Any = mitsuba

    from mistyle.fitting.pipeline.scene import SceneJob, fit_scene
    from mistyle.fitting.settings.scene import SceneSettings
    from mistyle.io.images.write import write_exr
    from mistyle.jobs.progress import Progress

    with TemporaryDirectory(prefix="mistyle-") as place:
        folder = Path(place)
        (folder / "in").mkdir()
        (folder / "shots").mkdir()
        (folder / "in" / "house.xml").write_text(HOUSE)
        for values in (TRUE_INCLUDE, np.full(3, 0.5)):
            (folder / "in" / "paint.xml").write_text(INCLUDE.format(" ".join(f"{v:g}" for v in values)))
            scene: Any = mi.load_file(str(folder / "in" / "house.xml"), size=size)
            if values is TRUE_INCLUDE:
                (picture,) = reference(scene, spp)
                write_exr(folder / "shots" / "cam.exr", dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)))
        settings = SceneSettings(iterations=steps)
        start = time.perf_counter()
        job = SceneJob(
            folder / "in" / "house.xml",
            folder / "shots",
            folder / "out",
            ("paint.*",),
            settings,
            "house",
            {"size": str(size)},
        )
        summary = fit_scene(job, Progress(quiet=True))
        middle = time.perf_counter()
        found = np.array(mi.traverse(mi.load_file(summary["scene"]))["paint.reflectance.value"])
        theirs = plain(scene, ["paint.reflectance.value"], [picture], steps)["paint.reflectance.value"]
        return {
            "include.relative_error": float(np.abs(found.ravel() / TRUE_INCLUDE - 1).max()),
            "include.plain_relative_error": float(np.abs(theirs.ravel() / TRUE_INCLUDE - 1).max()),
            "include.seconds": middle - start,
            "include.plain_seconds": time.perf_counter() - middle,
        }


def refused(size: int) -> dict[str, float]:
    """1 where the opacity of a mask is not offered."""
    from mistyle.render.live.parameters import parameters

    case = next(c for c in cases() if c.name == "mask")
    found = {p.name: p.reason for p in parameters(case.make(case.true, size))}
    return {"mask.opacity_refused": float(found["wall.bsdf.opacity.value"] is not None)}


def least(spp: int, pictures: int, size: int, wanted: np.ndarray) -> float:
    """Where the loss is least along the common scale, minus 1: the vertex of the parabola through three scales.

    A squared loss is taken of pairs of different pictures: that is the loss whose gradient the fit takes.
    """
    import mitsuba

    mi: Any = mitsuba

    from mistyle.solver.scene import gradients as scene_grad

    true = next(c for c in cases() if c.name == "cornell_box").true
    weights = scene_grad.relative_weights(wanted, np.ones(wanted.shape[:2], bool))
    losses = []
    for scale in SCALES:
        scene: Any = cornell({k: scale * v for k, v in true.items()}, size)
        shown = [np.array(mi.render(scene, spp=spp, seed=j)).astype(float) for j in range(pictures)]
        wrong = np.array(shown) - wanted
        products = (wrong.sum(axis=0) ** 2 - (wrong**2).sum(axis=0)) / (pictures * (pictures - 1))
        losses.append(float((weights * products).mean()))
    a, b, _ = np.polyfit(SCALES, losses, 2)
    return float(-b / (2 * a) - 1)


def main(argv: list[str] | None = None) -> int:
    options = arguments((__doc__ or "").splitlines()[0], argv)
    from mistyle.render.mitsuba import device

    device.use()
    steps, size, spp = (64, 32, 1024) if options.quick else (STEPS, SIZE, REFERENCE_SPP)
    figures: dict[str, float] = {}
    for case in cases():
        figures |= compared(case, steps, size, spp)
        print(
            case.name,
            {k.partition(".")[2]: round(v, 4) for k, v in figures.items() if k.startswith(case.name)},
            file=sys.stderr,
        )
    figures |= included(steps, size, spp) | refused(size)
    print("include", {k: round(v, 4) for k, v in figures.items() if k.startswith("include")}, file=sys.stderr)
    figures["worst_relative_error"] = max(v for k, v in figures.items() if k.endswith(".relative_error"))
    figures["worst_db"] = min(v for k, v in figures.items() if k.endswith(".db"))
    true = next(c for c in cases() if c.name == "cornell_box").true
    (wanted,) = reference(cornell(true, size), spp, seed=2)
    share = 8 if options.quick else 1
    for samples, pictures in ((4, 256), (16, 64), (64, 16)):
        figures[f"bias_{samples}spp"] = least(samples, max(pictures // share, 2), size, wanted)
    finish(figures, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
