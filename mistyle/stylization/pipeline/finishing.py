"""The stage "finish" of a job: its checks, its record, and before/after pictures for the report."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera
from mistyle.core.errors import UsageError
from mistyle.core.maps import Maps
from mistyle.jobs.progress import Report
from mistyle.jobs.report.page import BeforeAfter, ReportPicture
from mistyle.jobs.stages import Run
from mistyle.stylization.optimise.finish import StyleFinish
from mistyle.stylization.records import Atlas, Baked
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface.layers import StyleLayers

LEVELS = 3  # of VGG-19: relu1_1 to relu3_1
WEIGHTS = "for example --vgg vgg19-normalised (see mistyle models), or torchvision's --vgg vgg19.pth"


@dataclass(frozen=True)
class FinishRecord:
    """Result of the finish: maps before and after, style loss (before, after), RMS change of the albedo (sRGB)."""

    before: tuple[Maps, ...]
    after: tuple[Maps, ...]
    style: tuple[float, float]
    moved: float


def weights_file(settings: Settings) -> Path | None:
    """The finish's VGG-19 weights: its own setting, else the fit's (`--vgg`)."""
    from mistyle.stylization.pipeline.generative import named

    return named(settings, settings.finish.features or settings.fit.features)


def check_finish(settings: Settings) -> None:
    """UsageError where the painting cannot be finished, InputRefused where the weights are not VGG-19's."""
    if settings.finish.method == "off":
        return
    if settings.stylizer != "embedded":
        raise UsageError(
            f"--finish vgg: --stylizer {settings.stylizer} paints views; expected the embedded stylizer, which maps "
            "surface points to places of the picture. Leave out --finish, or use --stylizer embedded"
        )
    if settings.paint.slots:
        raise UsageError(
            f"--finish vgg: found {1 + len(settings.paint.slots)} style pictures; expected one. Leave out --style "
            "SLOT=PICTURE or --finish"
        )
    if settings.surface.glaze > 0:
        raise UsageError("--finish vgg would remove the glaze; leave out surface.glaze or --finish")
    path = weights_file(settings)
    if path is None:
        raise UsageError(f"--finish vgg: found no weights of VGG-19; name them, {WEIGHTS}")
    from mistyle.measure.features import load_features

    load_features(path, LEVELS)


def finish_stage(run: Run, asset: Asset, layers: StyleLayers, atlas: Atlas, baked: Baked) -> tuple[Baked, FinishRecord]:
    """The stage "finish": VGG-19 style losses move the painted albedo; normal and roughness stay."""
    s = run.job.settings
    protect = [s.paint.protect] if s.paint.protect is not None else []
    # The key covers the bytes of the weights.
    inputs = [s.finish, weights_file(s), s.fit.bridge, protect, s.seed]
    outcome = run.record("finish", ["bake"], inputs, lambda r: finished(asset, layers, atlas, baked, s, r))
    moved = f"the albedo moved by {outcome.moved:.3f} (sRGB, root mean square)"
    improved = outcome.style[1] < outcome.style[0]
    run.progress.note(
        f"finish: the style loss on held-out crops went from {outcome.style[0]:.4f} to {outcome.style[1]:.4f}; "
        f"{moved if improved else 'the painting stays unchanged'}."
    )
    after = laid(baked, outcome)
    return after, FinishRecord(baked.maps, after.maps, outcome.style, outcome.moved)


def finished(
    asset: Asset, layers: StyleLayers, atlas: Atlas, baked: Baked, settings: Settings, report: Report
) -> StyleFinish:
    """Run the finish on the painted maps; protected texels stay."""
    from mistyle.measure.features import load_features
    from mistyle.stylization.optimise.finish import PaintedAsset, finish
    from mistyle.stylization.surface.layers import painted_mask

    protect = settings.paint.protect
    only = None if protect is None else tuple(~painted_mask(protect, t) for t in atlas.texels)
    painted = PaintedAsset(asset.mesh, baked.maps, atlas.texels, layers.solutions[0], only)
    features = load_features(weights_file(settings), LEVELS)
    return finish(painted, features, settings.finish, settings.seed, report, bridge=settings.fit.bridge)


def laid(baked: Baked, outcome: StyleFinish) -> Baked:
    """The baked maps, and the fit's start maps, with the finished albedo."""
    pairs = zip(baked.begin, outcome.albedo, strict=True) if baked.begin else ()
    begin = tuple(replace(maps, albedo=albedo) for maps, albedo in pairs)
    maps = tuple(replace(m, albedo=albedo) for m, albedo in zip(baked.maps, outcome.albedo, strict=True))
    return replace(baked, maps=maps, begin=begin)


def finish_pair(asset: Asset, finishing: FinishRecord, camera: Camera) -> BeforeAfter:
    """Unlit renders of the painting before and after, for the report."""
    from mistyle.jobs.report.draw import shown
    from mistyle.render.mitsuba.unlit import unlit

    shots = []
    for maps, caption in ((finishing.before, "as painted"), (finishing.after, "finished")):
        rgb, share = unlit(asset.mesh, maps, [camera])[0]
        shots.append(ReportPicture(shown(np.concatenate([rgb, share[..., None]], axis=2)), caption))
    return BeforeAfter(shots[0], shots[1], "The albedo alone, without light")
