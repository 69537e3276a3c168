"""The stage "finish" in a job: what it refuses, its record, and the painting before and after for the report."""

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
WEIGHTS = "for example --vgg vgg19-normalised (see mistyle models), or --vgg vgg19.pth as torchvision has it"


@dataclass(frozen=True)
class FinishRecord:
    """How the painting was finished: its maps before and after, style loss before and after, and how far it moved."""

    before: tuple[Maps, ...]
    after: tuple[Maps, ...]
    style: tuple[float, float]
    moved: float


def weights_file(settings: Settings) -> Path | None:
    """Where the finish has VGG-19 from: its own setting, or that of the fit (`--vgg`)."""
    from mistyle.stylization.pipeline.generative import named

    return named(settings, settings.finish.features or settings.fit.features)


def check_finish(settings: Settings) -> None:
    """UsageError where the painting cannot be finished, InputRefused where the weights are no VGG-19."""
    if settings.finish.method == "off":
        return
    if settings.stylizer != "embedded":
        raise UsageError(
            f"--finish vgg: --stylizer {settings.stylizer} paints views; expected the embedded stylizer, whose "
            "painting knows which place of the picture lies where. Leave out --finish, or use --stylizer embedded"
        )
    if settings.paint.slots:
        raise UsageError(
            f"--finish vgg: found {1 + len(settings.paint.slots)} style pictures; expected one. Leave out --style "
            "SLOT=PICTURE or --finish"
        )
    if settings.surface.glaze > 0:
        raise UsageError("--finish vgg would take the glaze off again; leave out surface.glaze or --finish")
    path = weights_file(settings)
    if path is None:
        raise UsageError(f"--finish vgg: found no weights of VGG-19; name them, {WEIGHTS}")
    from mistyle.measure.features import load_features

    load_features(path, LEVELS)


def finish_stage(run: Run, asset: Asset, layers: StyleLayers, atlas: Atlas, baked: Baked) -> tuple[Baked, FinishRecord]:
    """The stage "finish": the painted albedo moved by VGG-19's style losses; normal and roughness as they were."""
    s = run.job.settings
    protect = [s.paint.protect] if s.paint.protect is not None else []
    # The weights by their bytes.
    inputs = [s.finish, weights_file(s), s.fit.bridge, protect, s.seed]
    made = run.record("finish", ["bake"], inputs, lambda r: finished(asset, layers, atlas, baked, s, r))
    moved = f"the albedo moved by {made.moved:.3f} (sRGB, root mean square)"
    kept = made.style[1] < made.style[0]
    run.progress.note(
        f"finish: the style loss on crops that no step used went from {made.style[0]:.4f} to {made.style[1]:.4f}; "
        f"{moved if kept else 'the painting stays as it was'}."
    )
    after = laid(baked, made)
    return after, FinishRecord(baked.maps, after.maps, made.style, made.moved)


def finished(
    asset: Asset, layers: StyleLayers, atlas: Atlas, baked: Baked, settings: Settings, report: Report
) -> StyleFinish:
    """The painted maps, finished; protected texels stay."""
    from mistyle.measure.features import load_features
    from mistyle.stylization.optimise.finish import PaintedAsset, finish
    from mistyle.stylization.surface.layers import painted_mask

    protect = settings.paint.protect
    only = None if protect is None else tuple(~painted_mask(protect, t) for t in atlas.texels)
    painted = PaintedAsset(asset.mesh, baked.maps, atlas.texels, layers.solutions[0], only)
    features = load_features(weights_file(settings), LEVELS)
    return finish(painted, features, settings.finish, settings.seed, report, bridge=settings.fit.bridge)


def laid(baked: Baked, made: StyleFinish) -> Baked:
    """The painting with its finished albedo; what begins the fit has the same one."""
    pairs = zip(baked.begin, made.albedo, strict=True) if baked.begin else ()
    begin = tuple(replace(maps, albedo=albedo) for maps, albedo in pairs)
    maps = tuple(replace(m, albedo=albedo) for m, albedo in zip(baked.maps, made.albedo, strict=True))
    return replace(baked, maps=maps, begin=begin)


def finish_pair(asset: Asset, finishing: FinishRecord, camera: Camera) -> BeforeAfter:
    """The painting before and after, without light, for the report."""
    from mistyle.jobs.report.draw import shown
    from mistyle.render.mitsuba.unlit import unlit

    shots = []
    for maps, caption in ((finishing.before, "as painted"), (finishing.after, "finished")):
        rgb, share = unlit(asset.mesh, maps, [camera])[0]
        shots.append(ReportPicture(shown(np.concatenate([rgb, share[..., None]], axis=2)), caption))
    return BeforeAfter(shots[0], shots[1], "The albedo alone, without light")
