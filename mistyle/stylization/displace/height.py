"""The painting's relief as a height map: displacement along the normal, in the units of the mesh's file."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from mistyle.atlas.texels import pad_in_place
from mistyle.core.asset import Asset
from mistyle.core.errors import UsageError
from mistyle.core.maps import Heights
from mistyle.geometry.similarity import scale_of
from mistyle.process import memory
from mistyle.stylization.records import Atlas
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface import lookup
from mistyle.stylization.surface.layers import StyleLayers, painted_mask


def check_height(settings: Settings, slope: float) -> None:
    """UsageError where no painting with a relief exists; `slope` is that of the relief."""
    if not settings.displace.height_map:
        return
    if settings.stylizer != "embedded":
        raise UsageError(
            f"--height-map: --stylizer {settings.stylizer} paints views, which have no relief; expected the embedded "
            "stylizer. Leave out --height-map, or use --stylizer embedded"
        )
    if slope == 0:
        raise UsageError("--height-map: paint.height is 0, so the paint is flat; leave out one of them")


def height_maps(
    asset: Asset, layers: StyleLayers, atlas: Atlas, settings: Settings, slope: float, report: Callable[[float], None]
) -> Heights:
    """Heights of all texture sets with root mean square `slope`; 0 where the asset's own material is protected.

    They belong to the normal maps: a renderer that displaces the mesh by them should leave the normal map out.
    """
    from mistyle.stylization.pipeline.painting import pieces, texel_side, whose

    factor, maps = slope / scale_of(asset.source.work_from_user), []
    for part, texels in enumerate(atlas.texels):
        side, height = texel_side(asset, part, texels), memory.zeros(texels.covered.shape)
        for solution, at in whose(layers, part, texels):
            for rows in pieces(at):
                mask = at[rows]
                place = texels.position[rows][mask], texels.normal[rows][mask]
                height[rows][mask] = np.float32(factor) * lookup.height(solution, *place, footprint=side)
        if settings.paint.protect is not None:
            height[painted_mask(settings.paint.protect, texels)] = 0
        pad_in_place([height], texels, settings.atlas.padding)
        maps.append(height)
        report((part + 1) / len(atlas.texels))
    return Heights(tuple(maps), range_of(maps, [texels.covered for texels in atlas.texels]))


def range_of(maps: Sequence[Float[np.ndarray, "h w"]], covered: Sequence[Bool[np.ndarray, "h w"]]) -> float:
    """Twice the largest height, rounded up to three digits: the range of 16-bit files about their middle."""
    most = max((float(np.abs(m[c]).max(initial=0)) for m, c in zip(maps, covered, strict=True)), default=0.0)
    if most == 0:
        return 1.0
    step = 10.0 ** (np.floor(np.log10(2 * most)) - 2)
    return float(np.format_float_positional(np.ceil(2 * most / step) * step, 3, fractional=False))
