"""Baked light left in a finished albedo, over all texture sets; the measure is in `measure/baked_light.py`."""

from collections.abc import Sequence

import numpy as np

from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.measure.baked_light import BakedLight, baked_light, texel_areas
from mistyle.render.mitsuba.occlusion import open_sky

LOOKED_AT = 40_000  # upper limit of texels, evenly over the sets: enough for two digits


def light_left(
    mesh: Mesh, sets: Sequence[Texels], maps: Sequence[Maps], seed: int = 0, most: int = LOOKED_AT
) -> BakedLight | None:
    """The albedo's dependence on surface direction and openness, from about `most` texels; None without covered
    texels."""
    covered = sum(int(texels.covered.sum()) for texels in sets)
    if covered == 0:
        return None
    areas = face_areas(mesh).astype(np.float64)
    step = max(1, covered // most)
    samples = []
    for texels, chosen in zip(sets, maps, strict=True):
        at = np.flatnonzero(texels.covered)
        weight = texel_areas(texels.face.reshape(-1)[at], areas)[::step]
        at = at[::step]
        flat = (values.reshape(-1, 3)[at] for values in (chosen.albedo, texels.position, texels.normal))
        samples.append((*flat, weight))
    albedo, positions, normals, weight = (np.concatenate(columns) for columns in zip(*samples, strict=True))
    share = open_sky(mesh, positions, normals, seed=seed)[:, 3].copy()
    return baked_light(albedo, normals, share, weight)
