"""The stage "displace" of a job: the mesh follows the outlines, and everything after it uses the displaced mesh."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Asset
from mistyle.core.errors import UsageError
from mistyle.core.maps import Heights
from mistyle.core.view import View
from mistyle.io.gltf.displaced import refuse_shared
from mistyle.io.sandbox.bounds import USD
from mistyle.io.store.records import load_record
from mistyle.solver.shape.moved import displaced_asset
from mistyle.stylization.displace.outlines import Shape, follow_outlines, moved_views
from mistyle.stylization.records import Atlas, Baked


@dataclass(frozen=True)
class Reshaped:
    """The asset, its atlas and its stylized views on the displaced mesh, the asset before, and the account."""

    asset: Asset
    atlas: Atlas
    stylized: Sequence[View]
    before: Asset
    shape: Shape


def check_displace(run: Any, asset: Asset) -> None:
    """UsageError where the files of this job could not hold the displaced mesh."""
    s = run.job.settings
    if s.displace.most == 0:
        return
    refuse_shared(asset)
    if s.deliver.wanted and "usd" in s.deliver.formats and asset.source.path.suffix.lower() in USD:
        raise UsageError(
            f"--displace: the USD delivery of {asset.source.path.name} is a look layer over the file, whose points "
            "stay; expected another format. Leave usd out of --formats, or leave out --displace"
        )


def displace_stage(run: Any, asset: Asset, atlas: Atlas, baked: Baked, stylized: Sequence[View]) -> Reshaped:
    """The stage "displace": positions that match the views' outlines, cached like any stage."""
    s, edited = run.job.settings, run.edited.get("stylized", {})
    masks = None
    if s.stylizer != "embedded" and s.sweep.segmenter is not None and not edited:
        masks = [one.seen for one in load_record(run.hidden.root / "surface" / "record")]
    shape = run.record(
        "displace",
        ["stylized"],
        [s.displace.model_copy(update={"height_map": False})],
        lambda r: follow_outlines(asset.mesh, stylized, masks, s.displace, r),
    )
    run.progress.note(*sentences(asset, shape))
    if not shape.changed:
        return Reshaped(asset, atlas, stylized, asset, shape)
    moved = displaced_asset(asset, shape.result.positions)
    names = [name.rpartition(".")[0] for name in edited]
    views = moved_views(moved, baked.maps, stylized, names)
    size = atlas.texels[0].covered.shape[0]
    texels = tuple(rasterise(moved.mesh, part, size) for part in range(len(atlas.texels)))
    return Reshaped(moved, replace(atlas, texels=texels), views, asset, shape)


def height_stage(run: Any, asset: Asset, atlas: Atlas) -> Heights | None:
    """The stage "height": the painting's height on the mesh as it was painted; None without --height-map."""
    from mistyle.stylization.displace.height import height_maps
    from mistyle.stylization.pipeline.painting import relief_slope

    s = run.job.settings
    if not s.displace.height_map:
        return None
    slope = relief_slope(s)

    def make(report: Any) -> Heights:
        layers = load_record(run.hidden.root / "surface" / "record")
        return height_maps(asset, layers, atlas, s, slope, report)

    return run.record("height", ["surface", "texels"], [slope], make)


def sentences(asset: Asset, shape: Shape) -> list[str]:
    """The notes on the displacement."""
    notes = []
    if shape.apart:
        notes.append(f"--displace: {shape.apart} painted pieces do not touch the object and were left out.")
    if shape.result is None:
        return [
            *notes,
            "--displace: every view has the mesh's own outline, so no vertex moved. Draw outside the object on a PNG "
            "in stylized/, keep its transparency, and rerun.",
        ]
    if not shape.changed:
        return [
            *notes,
            f"--displace: the outlines of {', '.join(shape.views)} differ, but no checked displacement came closer to "
            "them; no vertex moved. The mesh may be too coarse there, a boundary, or the bound too small.",
        ]
    most = shape.result.moved[1]
    before, after = shape.overlap
    notes.append(
        f"--displace: vertices moved by up to {100 * most:.1f} % of the bounding radius to the outlines of "
        f"{len(shape.views)} view(s); their overlap with the mesh went from {before:.4f} to {after:.4f}. UVs, topology "
        "and skinning are unchanged."
    )
    return notes
