"""A job's generative backends: checks before rendering, the view stylizer, the texture inpainter."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.asset import Asset, Picture
from mistyle.core.errors import EnvironmentMissing, UsageError
from mistyle.core.light import Lights, SceneLights, lights
from mistyle.core.paths import real_path
from mistyle.core.view import View
from mistyle.jobs.progress import Report
from mistyle.jobs.stages import Run
from mistyle.stylization.inpaint.repair import Inpainter
from mistyle.stylization.mvst.sweep import Stylizer
from mistyle.stylization.optimise.settings import FitSettings
from mistyle.stylization.settings import Settings

LORAS = "loras"  # in work/: trained LoRAs outlive the stages that trained them
SPOKEN = 20.0  # seconds between progress lines of a training


def named(settings: Settings, path: Path | None) -> Path | None:
    """The file of a setting: the user's own path, or the file of the model with that name (`mistyle models`)."""
    from mistyle.stylization.models.folder import MODELS, file

    if path is None or path.exists() or str(path) not in MODELS:
        return path
    return file(str(path), settings.models.folder)


def fit_settings(settings: Settings) -> FitSettings:
    """The fit's settings with values from the rest of the job: path of the features, whether views show light, and
    which maps may change."""
    chosen, painted = settings.fit, settings.fit.painted
    if painted == "auto":
        painted = "with-light" if settings.stylizer == "diffusion" else "without-light"
    return chosen.model_copy(
        update={"features": named(settings, chosen.features), "painted": painted, "refine": settings.refined}
    )


def solves_lit(chosen: FitSettings) -> bool:
    """Whether lit views are solved for before the phases; `chosen` are the `fit_settings`."""
    return chosen.painted == "with-light" and chosen.solve and chosen.refine == "all" and chosen.iterations1 > 0


def lights_of_views(settings: Settings) -> Lights | None:
    """The lights under which the views are drawn; None where only the user's own scene file describes them."""
    from mistyle.core.paths import scenes

    file = settings.draw.scene
    if file is not None and real_path(file).parent != real_path(scenes()):
        return None
    view_lights = lights("paper_views" if file is None else file.stem)
    return None if any(isinstance(light, SceneLights) for light in view_lights) else view_lights


def check(settings: Settings, say: Callable[[str], None]) -> None:
    """EnvironmentMissing or UsageError for missing models or unsupported settings, before rendering; reports the
    cost."""
    try:
        _check(settings, say)
    except EnvironmentMissing as error:
        raise EnvironmentMissing(
            f"{error}. Without models: --preset fine, with the paper's sizes and the embedded stylizer"
        ) from None


def _check(settings: Settings, say: Callable[[str], None]) -> None:
    fit_settings(settings)
    named(settings, settings.sweep.segmenter)
    if settings.stylizer == "diffusion":
        from mistyle.stylization.diffusion.stylizer import announcement
        from mistyle.stylization.diffusion.stylizer import check as check_stylizer

        if settings.paint.style_mask is not None:
            raise UsageError("--style-mask: the diffusion stylizer learns whole pictures; crop the picture instead")
        if settings.paint.direction_map is not None:
            raise UsageError("--direction-map: the diffusion stylizer cannot follow it; leave it out")
        check_stylizer(settings.models, settings.diffusion, settings.rig.resolution)
        if settings.rig.kind in ("paper", "turntable"):
            views = 16 if settings.rig.kind == "paper" else settings.rig.views
            say(announcement(settings.models, settings.train, settings.diffusion, views))
    if settings.inpainter == "paint3d":
        from mistyle.stylization.inpaint.paint3d import check as check_inpainter

        check_inpainter(settings.models, settings.paint3d)


def diffusion_job(settings: Settings, style: Picture, name: str, out: Path) -> Any:
    """The stylizer's own job; transparent parts of the style picture are white."""
    from mistyle.stylization.diffusion.stylizer import DiffusionJob

    loras = settings.models.loras or out / "work" / LORAS
    return DiffusionJob(settings.models, settings.train, settings.diffusion, opaque(style), name, loras, settings.seed)


def opaque(style: Picture) -> np.ndarray:
    """The style picture composited over white: the networks have no alpha input."""
    if style.alpha is None:
        return style.rgb
    alpha = style.alpha[..., None]
    return np.asarray(style.rgb * alpha + (1 - alpha), np.float32)


def sweep_key(run: Run, style: Picture, views: Sequence[View]) -> str:
    """Cache key of the views painted by diffusion."""
    from mistyle.stylization.diffusion.stylizer import key

    job = diffusion_job(run.job.settings, style, run.job.style.stem, run.job.out)
    return key(job, views)


def view_stylizer(run: Run, style: Picture, views: Sequence[View], report: Report) -> Stylizer:
    """Train the missing LoRAs and return the diffusion stylizer; `report` receives the training's progress."""
    from mistyle.stylization.diffusion.stylizer import stylizer

    job = diffusion_job(run.job.settings, style, run.job.style.stem, run.job.out)
    return stylizer(job, views, run.progress.say, watcher(run.progress.say, report))


def watcher(say: Callable[[str], None], report: Report) -> Callable[[int, int, float], None]:
    """A callback that reports a training's progress, and every SPOKEN seconds its mean loss over weight."""
    import time

    losses: list[float] = []
    last = time.perf_counter()

    def watch(step: int, steps: int, loss: float) -> None:
        nonlocal last
        report(step / steps)
        losses.append(loss)
        now = time.perf_counter()
        if now - last >= SPOKEN or step == steps:
            rate = len(losses) / max(now - last, 1e-9)
            mean = sum(losses) / len(losses)
            say(f"  step {step} of {steps}: loss over weight {mean:.4f}, {rate:.1f} steps a second")
            last = now
            losses.clear()

    return watch


def inpainter_inputs(settings: Settings, style: Picture) -> list[Any]:
    """Cache inputs of repaired maps besides the repair settings; empty for the weight-free inpainter."""
    if settings.inpainter == "fill":
        return []
    from mistyle.stylization.inpaint.paint3d import identity

    chosen = settings.paint3d.model_dump(exclude={"precision"})
    return [settings.inpainter, chosen, identity(settings.models, settings.paint3d), style.rgb, style.alpha]


def release(settings: Settings) -> None:
    """Free the device memory of a finished stage, so that the next stage can measure it."""
    from mistyle.stylization.models.check import empty
    from mistyle.stylization.models.load import device_of

    empty(device_of(settings.models))


def texture_inpainter(settings: Settings, asset: Asset, style: Picture) -> Inpainter:
    """Load Paint3D's inpainter."""
    from mistyle.stylization.inpaint.paint3d import inpainter

    return inpainter(asset.mesh, opaque(style), settings.models, settings.paint3d)
