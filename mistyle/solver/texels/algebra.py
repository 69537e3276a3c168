"""Arrow-shaped normal equations of one texel per lane: seven unknowns, of which the albedo is eliminated.

Unknowns are (albedo r, g, b, tilt x, tilt y, roughness, metallic). An observation's channels share the last four, and
each depends on its own albedo alone. Everything is unrolled over Dr.Jit arrays, in single precision.
"""

from typing import Any, NamedTuple

from mistyle.render.mitsuba.device import dr

# Pivots below this share of the diagonal have no significant digits in single precision.
DIGITS = 1e-6


class Sums(NamedTuple):
    """Normal matrix (albedo's diagonal, albedo x rest, upper triangle of the rest), gradient / 2, cost."""

    aa: list
    aq: list
    qq: list
    ga: list
    gq: list
    cost: Any


def step(sums: Sums, x: list, mean: list, prior: list, damping: Any) -> list:
    """The damped Gauss–Newton step: (H + prior + damping diag) step = gradient."""
    ga = [dr.fma(p, v - m, g) for g, v, m, p in zip(sums.ga, x[:3], mean[:3], prior[:3], strict=True)]
    gq = [dr.fma(p, v - m, g) for g, v, m, p in zip(sums.gq, x[3:], mean[3:], prior[3:], strict=True)]
    grow = 1 + damping
    inverse = [1 / dr.maximum(dr.fma(h, grow, p), 1e-12) for h, p in zip(sums.aa, prior[:3], strict=True)]
    reduced = _reduced(sums, inverse, prior, grow)
    right = list(gq)
    for q in range(4):
        for c in range(3):
            right[q] -= sums.aq[4 * c + q] * inverse[c] * ga[c]
    sq = _cholesky_solve(_cholesky(reduced, _least(sums, prior)), right)
    sa = []
    for c in range(3):
        left = ga[c]
        for q in range(4):
            left = left - sums.aq[4 * c + q] * sq[q]
        sa.append(left * inverse[c])
    return sa + sq


def _reduced(sums: Sums, inverse: list, prior: list, grow: Any) -> list:
    """Schur complement of the albedo, as a lower triangle."""
    result = []
    for q in range(4):
        for p in range(q + 1):
            entry = sums.qq[triangle(q, p)]
            if p == q:
                entry = dr.fma(entry, grow, prior[3 + q])
            for c in range(3):
                entry = entry - sums.aq[4 * c + q] * sums.aq[4 * c + p] * inverse[c]
            result.append(entry)
    return result


def spread_of(sums: Sums, prior: list) -> tuple[list, list]:
    """Square roots of the inverse's diagonal, and the diagonal of the normal matrix."""
    inverse = [1 / dr.maximum(h + p, 1e-12) for h, p in zip(sums.aa, prior[:3], strict=True)]
    factor = _cholesky(_reduced(sums, inverse, prior, 1), _least(sums, prior))
    kind = type(sums.cost)
    columns = [_cholesky_solve(factor, [kind(1.0 if q == p else 0.0) for q in range(4)]) for p in range(4)]
    spread = []
    for c in range(3):
        variance = inverse[c]
        for q in range(4):
            for p in range(4):
                variance = variance + inverse[c] ** 2 * sums.aq[4 * c + q] * sums.aq[4 * c + p] * columns[q][p]
        spread.append(dr.sqrt(dr.maximum(variance, 0)))
    spread += [dr.sqrt(dr.maximum(columns[q][q], 0)) for q in range(4)]
    # The posterior variance cannot exceed the prior's; rounding may violate that.
    spread = [dr.minimum(s, dr.rsqrt(dr.maximum(p, 1e-12))) for s, p in zip(spread, prior, strict=True)]
    return spread, [*sums.aa, *(sums.qq[triangle(q, q)] for q in range(4))]


def _least(sums: Sums, prior: list) -> list:
    """Lower bound of the pivots: below it the Schur complement has no significant digits in single precision."""
    return [dr.maximum(DIGITS * sums.qq[triangle(q, q)], dr.maximum(prior[3 + q], 1e-10)) for q in range(4)]


def _cholesky(lower: list, least: list) -> list:
    """Factor of a 4 x 4 matrix given as a lower triangle; diagonal entries of the factor are stored inverted."""
    factor = list(lower)
    for q in range(4):
        for p in range(q + 1):
            entry = factor[triangle(q, p)]
            for k in range(p):
                entry = entry - factor[triangle(q, k)] * factor[triangle(p, k)]
            factor[triangle(q, p)] = dr.rsqrt(dr.maximum(entry, least[q])) if p == q else entry * factor[triangle(p, p)]
    return factor


def _cholesky_solve(factor: list, right: list) -> list:
    y = list(right)
    for q in range(4):
        for k in range(q):
            y[q] = y[q] - factor[triangle(q, k)] * y[k]
        y[q] = y[q] * factor[triangle(q, q)]
    for q in reversed(range(4)):
        for k in range(q + 1, 4):
            y[q] = y[q] - factor[triangle(k, q)] * y[k]
        y[q] = y[q] * factor[triangle(q, q)]
    return y


def triangle(q: int, p: int) -> int:
    return q * (q + 1) // 2 + p


def nothing(kind: Any, width: int) -> Sums:
    def zeros(count):
        return [dr.zeros(kind, width) for _ in range(count)]

    return Sums(zeros(3), zeros(12), zeros(10), zeros(3), zeros(4), dr.zeros(kind, width))


def unflat(flat: Any) -> Sums:
    flat = list(flat)
    return Sums(flat[:3], flat[3:15], flat[15:25], flat[25:28], flat[28:32], flat[32])


def flat_of(sums: Sums) -> list:
    return [*sums.aa, *sums.aq, *sums.qq, *sums.ga, *sums.gq, sums.cost]
