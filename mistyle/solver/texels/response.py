"""The reflectance of one observation and its derivatives by tilt, roughness and metallic, two ways."""

from typing import Any

from mistyle.render.deferred import bsdf
from mistyle.render.mitsuba.device import dr
from mistyle.solver.texels.records import Options

STEP = 1e-3  # of central differences, the twin of the derivatives by AD
MIN_Z2 = 1e-4


def terms(options: Options, wi: Any, wo: Any, q: list, width2: Any = None) -> tuple[Any, Any, list, list]:
    """Albedo-linear and constant term; light from a cell of `width2` (`sky.EnvironmentCells`) widens the lobe.

    GGX's α² is twice the variance of the microfacet slopes, and normals turn half as much as the light does.
    """
    z = dr.sqrt(dr.maximum(1 - dr.square(q[0]) - dr.square(q[1]), MIN_Z2))
    normal = type(wi)(q[0], q[1], z)
    roughness = q[2] if width2 is None else dr.sqrt(dr.sqrt(dr.square(dr.square(q[2])) + 0.5 * width2))
    linear, constant = bsdf.terms(bsdf.Reflectance(options.model), wi, wo, normal, roughness, q[3])
    return linear, constant, [], []


def derivatives(options: Options, wi: Any, wo: Any, q: list, width2: Any = None) -> tuple[Any, Any, list, list]:
    """By forward-mode AD: the operations that several directions share are compiled once."""
    moving = [type(v)(v) for v in q]
    dr.enable_grad(moving)
    linear, constant, _, _ = terms(options, wi, wo, moving, width2)
    d_linear, d_constant = [], []
    for j, v in enumerate(moving):
        if j == 3 and not options.metallic:
            d_linear.append(dr.zeros(type(v)))
            d_constant.append(dr.zeros(type(v)))
            continue
        for variable in moving:
            dr.set_grad(variable, 1.0 if variable is v else 0.0)
        dr.enqueue(dr.ADMode.Forward, moving)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearInterior)
        d_linear.append(dr.grad(linear))
        d_constant.append(dr.grad(constant))
        dr.clear_grad(linear)
        dr.clear_grad(constant)
    return dr.detach(linear), dr.detach(constant), d_linear, d_constant


def differences(options: Options, wi: Any, wo: Any, q: list, width2: Any = None) -> tuple[Any, Any, list, list]:
    linear, constant, _, _ = terms(options, wi, wo, q, width2)
    d_linear, d_constant = [], []
    for j in range(4):
        if j == 3 and not options.metallic:
            d_linear.append(dr.zeros(type(q[j])))
            d_constant.append(dr.zeros(type(q[j])))
            continue
        high, low = (
            terms(options, wi, wo, [v + e if k == j else v for k, v in enumerate(q)], width2) for e in (STEP, -STEP)
        )
        d_linear.append((high[0] - low[0]) * (0.5 / STEP))
        d_constant.append((high[1] - low[1]) * (0.5 / STEP))
    return linear, constant, d_linear, d_constant
