"""The first asset of a fit: the pictures as an unlit texture, seconds after the start.

A texel has the median of the pictures that show it, so light and shadows are still in its albedo. Normals are the
mesh's, roughness is constant. The asset of the first pass replaces this one.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.atlas.texels import rasterise
from mistyle.core.asset import Asset
from mistyle.core.capture import Captures, evenly_lit, shrunk_to, subset
from mistyle.core.image import luminance, nearest_fill, resize
from mistyle.core.maps import Maps, Texels, flat_maps, rows_of
from mistyle.core.rows import evenly, weighted_medians
from mistyle.fitting.pipeline.files import write
from mistyle.fitting.pipeline.times import FIRST_PICTURES
from mistyle.io.store.atomic import digest
from mistyle.jobs.stages import Run
from mistyle.render.mitsuba.draw import Tracer, tracer
from mistyle.solver.texels.observations import ObservationOptions, collect_observations

SIDE, ATLAS = 512, 512  # pixels along the longer side of a picture, texels a side
BRIGHT = 0.8  # luminance of the 95th percentile of the albedo
STATE = "no pass: the pictures as texture, with their light"

Texture = tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]


def first_asset(run: Run, asset: Asset, texels: Sequence[Texels], captures: Captures) -> None:
    """Write the asset, unless the folder has one already or no picture shows the mesh."""
    job = run.job
    if (job.out / "asset").exists():
        return
    with run.progress.stage("first asset", "write the first asset"):
        maps = first_look(asset, texels, captures)
        if any(m.known.any() for m in maps):
            sets = list(zip(texels, maps, strict=True))
            key = digest([run.base, "first look"])
            run.preliminary("asset", key, lambda folder: write(folder, job, asset, sets, state=STATE), {"first": True})


def first_look(asset: Asset, texels: Sequence[Texels], captures: Captures) -> tuple[Maps, ...]:
    """The maps at the size of `texels`, from few small pictures on a coarse level of the atlas."""
    few = shrunk_to(subset(captures, evenly(len(captures), FIRST_PICTURES)), SIDE)
    mesh, sizes = asset.mesh, [len(t.covered) for t in texels]
    coarse = [rasterise(mesh, part, min(ATLAS, size)) for part, size in enumerate(sizes)]
    textures = median_textures(tracer(mesh), coarse, few)
    shown = np.concatenate([luminance(texture[known]) for texture, known in textures])
    factor = BRIGHT / max(float(np.quantile(shown, 0.95)), 1e-9) if len(shown) else 1.0
    result = []
    for (texture, known), size in zip(textures, sizes, strict=True):
        albedo = np.clip(factor * resize(nearest_fill(texture, known), (size, size)), 0, 1)
        seen = resize(known.astype(np.float32), (size, size)) > 0.5
        result.append(replace(flat_maps(size), albedo=albedo, known=seen))
    return tuple(result)


def median_textures(traced: Tracer, texels: Sequence[Texels], captures: Captures) -> list[Texture]:
    """Per texture set the median radiance of the pictures that show a texel, and which texels any picture shows."""
    options = ObservationOptions(skies=False)
    observed = collect_observations(traced, texels, evenly_lit(captures), None, options)
    rgb, owner = observed.observations.rgb, np.repeat(observed.texel, observed.seen)
    texture = np.zeros((sum(t.covered.size for t in texels), 3), np.float32)
    known = np.zeros(len(texture), bool)
    for c in range(3):
        rows, texture_c = weighted_medians(owner, rgb[:, c], np.ones(len(owner)))
        texture[rows, c], known[rows] = texture_c, True
    sizes = [t.covered.shape for t in texels]
    return [
        (texture[part].reshape(*size, 3), known[part].reshape(size))
        for part, size in zip(rows_of(sizes), sizes, strict=True)
    ]
