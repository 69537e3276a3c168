"""The reflectance of one observation and its derivatives by tilt, roughness and metallic, two ways."""

from typing import Any

from mistyle.render import bsdf
from mistyle.render.texel_records import Options

STEP = 1e-3  # of central differences, the twin of the derivatives by AD
MIN_Z2 = 1e-4


def terms(options: Options, wi: Any, wo: Any, q: list) -> tuple[Any, Any, list, list]:
    import drjit as dr

    z = dr.sqrt(dr.maximum(1 - dr.square(q[0]) - dr.square(q[1]), MIN_Z2))
    normal = type(wi)(q[0], q[1], z)
    paint, gloss = bsdf.terms(options.model, wi, wo, normal, q[2], q[3])
    return paint, gloss, [], []


def derivatives(options: Options, wi: Any, wo: Any, q: list) -> tuple[Any, Any, list, list]:
    """By forward-mode AD: the operations that several directions share are compiled once."""
    import drjit as dr

    moving = [type(v)(v) for v in q]
    dr.enable_grad(moving)
    paint, gloss, _, _ = terms(options, wi, wo, moving)
    d_paint, d_gloss = [], []
    for j, v in enumerate(moving):
        if j == 3 and not options.metallic:
            d_paint.append(dr.zeros(type(v)))
            d_gloss.append(dr.zeros(type(v)))
            continue
        for other in moving:
            dr.set_grad(other, 1.0 if other is v else 0.0)
        dr.enqueue(dr.ADMode.Forward, moving)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearInterior)
        d_paint.append(dr.grad(paint))
        d_gloss.append(dr.grad(gloss))
        dr.clear_grad(paint)
        dr.clear_grad(gloss)
    return dr.detach(paint), dr.detach(gloss), d_paint, d_gloss


def differences(options: Options, wi: Any, wo: Any, q: list) -> tuple[Any, Any, list, list]:
    import drjit as dr

    paint, gloss, _, _ = terms(options, wi, wo, q)
    d_paint, d_gloss = [], []
    for j in range(4):
        if j == 3 and not options.metallic:
            d_paint.append(dr.zeros(type(q[j])))
            d_gloss.append(dr.zeros(type(q[j])))
            continue
        high, low = (terms(options, wi, wo, [v + e if k == j else v for k, v in enumerate(q)]) for e in (STEP, -STEP))
        d_paint.append((high[0] - low[0]) * (0.5 / STEP))
        d_gloss.append((high[1] - low[1]) * (0.5 / STEP))
    return paint, gloss, d_paint, d_gloss
