"""Light transport matrix: radiance that each cell of the sky contributes to each observation of the solver."""

import numpy as np
from jaxtyping import Float

from mistyle.core.drjit_arrays import aligned
from mistyle.render.mitsuba.device import dr, mi
from mistyle.solver.texels.levenberg_marquardt import Problem, local
from mistyle.solver.texels.response import terms


def light_transport_matrix(
    problem: Problem, values: Float[np.ndarray, "t 7"], observations: int, cells: int
) -> tuple[Float[np.ndarray, "o k"], Float[np.ndarray, "o k"]]:
    """Both terms of every observation per unit irradiance from each cell, zero where the mesh hides it.

    The problem's pictures have `cells` cells of the sky and no other light; the model's radiance in channel c is
    sum_k E_kc (albedo_c paint_k + gloss_k), as in `texels/levenberg_marquardt.py`.
    """
    linear, constant = np.zeros((observations, cells), np.float32), np.zeros((observations, cells), np.float32)
    for chunk in problem.chunks:
        width = chunk["width"]
        material = [mi.Float(aligned(values[chunk["texel"], j])) for j in range(3, 7)]
        real = chunk["real"].reshape(-1, width)
        for slot, present in enumerate(real):  # texels are sorted by their number of observations
            count = int(present.sum())
            pair = dr.arange(mi.UInt32, count * cells)
            lane, cell = pair // cells, pair % cells
            picture = dr.gather(mi.UInt32, chunk["picture"], lane + slot * width)
            frame = tuple(dr.gather(mi.Vector3f, axis, lane) for axis in chunk["frame"])
            away = dr.gather(mi.Point3f, problem.rig["eye"], picture) - dr.gather(mi.Point3f, chunk["position"], lane)
            light = (dr.gather(mi.UInt32, problem.rig["cells"], picture) + cell) * 8
            x, y, z, width2 = (dr.gather(mi.Float, problem.rig["light"], light + k) for k in (0, 1, 2, 7))
            own = [dr.gather(mi.Float, column, lane) for column in material]
            parts = terms(
                problem.options, local(frame, dr.normalize(away)), local(frame, mi.Vector3f(x, y, z)), own, width2
            )
            word = dr.gather(mi.UInt32, chunk["open"], (cell >> 5) * width + lane)
            free = ((word >> (cell & 31)) & 1) == 1
            rows = chunk["rows"].reshape(-1, width)[slot, :count]
            for result, part in zip((linear, constant), parts[:2], strict=True):
                result[rows] = np.array(dr.select(free, part, 0)).reshape(count, cells)
    return linear, constant
