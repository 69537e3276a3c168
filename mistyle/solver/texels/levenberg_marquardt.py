"""Per-texel materials by a batched Levenberg–Marquardt solver: texels are the lanes.

With known geometry, cameras and delta lights, a texel's own observations determine its own unknowns
x = (albedo r, g, b, tilt x, tilt y, roughness, metallic). No picture has to be rendered. Soft light is approximated by
one directional light per cell of the sky; each cell widens the lobe by its own width. The reflectance is
albedo · linear + constant of `render/deferred/bsdf.py`. With irradiance E and q = (tilt, roughness, metallic), the
model of an observation is, per channel c,

    f_c(x) = sum over its lights of E_c (albedo_c linear(q) + constant(q))

and the solver minimises  sum_c,k rho(w_k (f_ck - y_ck)) + sum_j prior_j (x_j - mean_j)²  with Huber's rho. The albedo
enters linearly and its channels are independent, so the normal matrix is an arrow: the Schur complement eliminates the
albedo, and Cholesky solves the remaining 4 x 4 system in each lane.

All iterations are one kernel with nested symbolic loops. It loops over a lane's observations, accumulates the normal
matrix at the trial values, accepts or rejects them, and proposes the next. Lanes are sorted by their number of
observations, and observation k of neighbouring lanes lies in neighbouring memory. Sums run within a lane in a fixed
order, so the bytes are equal in every run at any number of threads.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.drjit_arrays import aligned
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import dr, mi
from mistyle.solver.texels.algebra import Sums, flat_of, nothing, spread_of, step, triangle, unflat
from mistyle.solver.texels.records import UNKNOWNS, Observations, Options, Points, Rig, Solution
from mistyle.solver.texels.response import derivatives, differences, terms

__all__ = ["UNKNOWNS", "Observations", "Options", "Points", "Problem", "Rig", "Solution"]

LANES = 1 << 16
LIGHTER, HEAVIER = 0.25, 5.0  # factors of the damping after an accepted and after a rejected step


class Problem:
    """Observations on the device, for repeated solves with other targets, priors and starts."""

    def __init__(self, points: Points, rig: Rig, observations: Observations, options: Options) -> None:
        device.use()
        self.options, self.single, self.soft = options, rig.single, rig.cells is not None
        self.texels = len(points.position)
        count = np.diff(observations.start)
        self.order = np.argsort(-count, kind="stable")
        self.rig = {
            "eye": mi.Float(aligned(rig.eye.ravel())),
            "first": mi.UInt32(aligned(rig.first, np.uint32)),
        }
        self.lights = _light_rows(rig)
        self.relight(rig.irradiance)
        if rig.cells is not None:
            self.rig["cells"] = mi.UInt32(aligned(rig.cells, np.uint32))
        self.chunks = []
        for low in range(0, self.texels, LANES):
            texel = self.order[low : low + LANES]
            if count[texel[0]] == 0:
                break
            self.chunks.append(_chunk(points, observations, texel, count[texel]))

    def retarget(self, rgb: Float[np.ndarray, "o 3"]) -> None:
        """Replace the observed radiance; rows in the order of the Observations."""
        for chunk in self.chunks:
            chunk["rgb"] = _columns(rgb[chunk["rows"]])

    def relight(self, irradiance: Float[np.ndarray, "l 3"]) -> None:
        """Replace the lights' irradiance; rows in the order of the Rig."""
        self.lights[:, 4:7] = irradiance
        self.rig["light"] = mi.Float(aligned(self.lights.ravel()))

    def reweight(self, weight: Float[np.ndarray, " o"]) -> None:
        """Replace the weights."""
        for chunk in self.chunks:
            chunk["weight"] = mi.Float(aligned(np.where(chunk["real"], weight[chunk["rows"]], 0)))

    def solve(
        self,
        start: Float[np.ndarray, "t 7"],
        mean: Float[np.ndarray, "t 7"],
        prior: Float[np.ndarray, "t 7"],
        iterations: int,
        progress: Callable[[float], None] = lambda done: None,
    ) -> Solution:
        """`iterations` steps from `start`; `prior` is the weight of (x - mean)². Texels without observations end at
        `mean`, with the prior's spread."""
        values, cost = np.clip(mean, 0, 1).astype(np.float32), np.zeros(self.texels, np.float32)
        values[:, 3:5] = mean[:, 3:5]
        spread = (1 / np.sqrt(np.maximum(prior, 1e-12))).astype(np.float32)
        diagonal = np.zeros((self.texels, 7), np.float32)
        for k, chunk in enumerate(self.chunks):
            texel = chunk["texel"]
            values[texel], cost[texel], spread[texel], diagonal[texel] = self._solve(
                chunk, start[texel], mean[texel], prior[texel], iterations
            )
            progress((k + 1) / len(self.chunks))
        return Solution(values, cost, spread, diagonal, prior)

    def predict(self, values: Float[np.ndarray, "t 7"]) -> Float[np.ndarray, "o 3"]:
        """The model's radiance of every observation."""
        total = max((int(chunk["rows"].max()) for chunk in self.chunks), default=-1) + 1
        result = np.zeros((total, 3), np.float32)
        for chunk in self.chunks:
            x = _columns(values[chunk["texel"]])
            seen = [dr.zeros(type(x[0]), len(chunk["rows"])) for _ in range(3)]
            sizes = self._scatter(chunk, x, seen)
            dr.eval(seen, sizes)
            real = chunk["real"]
            result[chunk["rows"][real]] = np.stack([np.array(c)[real] for c in seen], axis=1)
        return result

    def _scatter(self, chunk: dict, x: list, seen: list) -> Any:
        def body(k, done):
            index = k * chunk["width"] + chunk["lane"]
            linear, constant, _, _ = self._response(chunk, index, x, slopes=False)
            for c in range(3):
                dr.scatter(seen[c], dr.fma(x[c], linear[c], constant[c]), index)
            return k + 1, done

        start = (dr.zeros(type(chunk["count"]), chunk["width"]), dr.zeros(type(x[0]), chunk["width"]))
        return dr.while_loop(start, lambda k, done: k < chunk["count"], body)

    def _solve(self, chunk: dict, start, mean, prior, iterations: int) -> tuple[np.ndarray, ...]:
        mean, prior = _columns(mean), _columns(prior)
        first = _project(_columns(start), self.options)
        kind, width = type(first[0]), chunk["width"]
        free = 7 if self.options.metallic else 6

        def body(k, *state):
            tried, accepted, sums, best, damping = state[:7], state[7:14], unflat(state[14:47]), state[47], state[48]
            new = self._accumulate(chunk, list(tried))
            total = new.cost
            for v, m, p in zip(tried, mean, prior, strict=True):
                total = dr.fma(p, dr.square(v - m), total)
            better = total < best
            damping = dr.clip(damping * dr.select(better, LIGHTER, HEAVIER), 1e-7, 1e6)
            best = dr.select(better, total, best)
            accepted = [dr.select(better, a, b) for a, b in zip(tried, accepted, strict=True)]
            flat = [dr.select(better, a, b) for a, b in zip(flat_of(new), flat_of(sums), strict=True)]
            change = step(unflat(flat), accepted, mean, prior, damping)
            tried = [v - s if j < free else v for j, (v, s) in enumerate(zip(accepted, change, strict=True))]
            return k + 1, *_project(tried, self.options), *accepted, *flat, best, damping

        state = [*first, *[kind(v) for v in first], *flat_of(nothing(kind, width))]
        state += [dr.full(kind, 1e30, width), dr.full(kind, 1e-2 / LIGHTER, width)]
        # The number of iterations is opaque: changing it does not compile another kernel.
        last = dr.opaque(type(chunk["count"]), iterations + 1)
        start_state = (dr.zeros(type(chunk["count"]), width), *state)
        done = dr.while_loop(start_state, lambda k, *rest: k < last, body, label="levenberg_marquardt")[1:]
        accepted, sums = list(done[7:14]), unflat(done[14:47])
        spread, diagonal = spread_of(sums, prior)
        dr.eval(accepted, sums.cost, spread, diagonal)
        return _rows(accepted), np.array(sums.cost), _rows(spread), _rows(diagonal)

    def _accumulate(self, chunk: dict, x: list) -> Sums:
        """Normal matrix, gradient and cost of every lane at x."""
        kind, huber = type(x[0]), self.options.huber

        def body(k, *flat):
            sums = unflat(flat)
            index = k * chunk["width"] + chunk["lane"]
            linear, constant, d_linear, d_constant = self._response(chunk, index, x, slopes=True)
            weight = dr.gather(kind, chunk["weight"], index)
            aa, aq, qq, ga, gq = (list(part) for part in sums[:5])
            cost = sums.cost
            residual, slope = [], []
            for c in range(3):
                y = dr.gather(kind, chunk["rgb"][c], index)
                residual.append(weight * (dr.fma(x[c], linear[c], constant[c]) - y))
                slope.append([weight * dr.fma(x[c], d_linear[c][q], d_constant[c][q]) for q in range(4)])
            # One robust weight for the three channels: outliers affect all of them.
            size = dr.sqrt(residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2)
            inside = size <= huber
            robust = dr.select(inside, 1, huber / dr.maximum(size, 1e-20))
            cost += dr.select(inside, dr.square(size), huber * (2 * size - huber))
            for c in range(3):
                a, r = weight * linear[c], residual[c] * robust
                ra = a * robust
                aa[c] = dr.fma(ra, a, aa[c])
                ga[c] = dr.fma(a, r, ga[c])
                for q in range(4):
                    aq[4 * c + q] = dr.fma(ra, slope[c][q], aq[4 * c + q])
                    gq[q] = dr.fma(slope[c][q], r, gq[q])
                    rq = slope[c][q] * robust
                    for p in range(q + 1):
                        qq[triangle(q, p)] = dr.fma(rq, slope[c][p], qq[triangle(q, p)])
            return k + 1, *aa, *aq, *qq, *ga, *gq, cost

        start = (dr.zeros(type(chunk["count"]), chunk["width"]), *flat_of(nothing(kind, chunk["width"])))
        done = dr.while_loop(start, lambda k, *rest: k < chunk["count"], body, label="texel_lm")
        return unflat(done[1:])

    def _response(self, chunk: dict, index: Any, x: list, *, slopes: bool) -> tuple[list, list, list, list]:
        """Both terms of the reflectance times irradiance per channel, and their derivatives by all but the albedo."""
        picture = dr.gather(mi.UInt32, chunk["picture"], index)
        eye = dr.gather(mi.Point3f, self.rig["eye"], picture)
        wi = local(chunk["frame"], dr.normalize(eye - chunk["position"]))
        first = dr.gather(mi.UInt32, self.rig["first"], picture)
        if self.single:
            return self._light(chunk, first, mi.Float(1), wi, x, slopes)
        lit, last = dr.gather(mi.UInt32, chunk["lit"], index), dr.gather(mi.UInt32, self.rig["first"], picture + 1)
        width = 30 if slopes else 6
        zeros = tuple(dr.zeros(mi.Float, dr.width(chunk["lane"])) for _ in range(width))

        cells = dr.gather(mi.UInt32, self.rig["cells"], picture) if self.soft else None

        def body(light, *flat):
            word, bit = lit, light - first
            if cells is not None:
                cell = dr.select(light >= cells, light - cells, 0)
                sky = dr.gather(mi.UInt32, chunk["open"], (cell >> 5) * chunk["width"] + chunk["lane"])
                word, bit = dr.select(light >= cells, sky, lit), dr.select(light >= cells, cell & 31, bit)
            shines = dr.select(((word >> bit) & 1) == 1, mi.Float(1), mi.Float(0))
            parts = self._light(chunk, light, shines, wi, x, slopes)
            return light + 1, *(a + b for a, b in zip(flat, _flat4(parts), strict=True))

        done = dr.while_loop((mi.UInt32(first), *zeros), lambda light, *rest: light < last, body, label="lights")
        return _unflat4(done[1:], slopes)

    def _light(self, chunk: dict, light: Any, scale: Any, wi: Any, x: list, slopes: bool) -> tuple:
        row = [dr.gather(mi.Float, self.rig["light"], light * 8 + k) for k in range(7)]
        near = row[3] > 0.5
        vector = mi.Vector3f(row[0], row[1], row[2])
        to_light = vector - dr.select(near, mi.Vector3f(chunk["position"]), mi.Vector3f(0))
        distance2 = dr.squared_norm(to_light)
        wo = local(chunk["frame"], to_light * dr.rsqrt(distance2))
        scale = scale * dr.select(near, 1 / distance2, 1)
        irradiance = [row[4 + c] * scale for c in range(3)]
        chosen = terms if not slopes else differences if self.options.differences else derivatives
        width2 = dr.gather(mi.Float, self.rig["light"], light * 8 + 7) if self.soft else None
        linear, constant, d_linear, d_constant = chosen(self.options, wi, wo, x[3:], width2)
        return (
            [e * linear for e in irradiance],
            [e * constant for e in irradiance],
            [[e * d for d in d_linear] for e in irradiance],
            [[e * d for d in d_constant] for e in irradiance],
        )


def _project(x: list, options: Options) -> list:
    length = dr.sqrt(dr.square(x[3]) + dr.square(x[4]))
    scale = dr.minimum(1, options.tilt / dr.maximum(length, 1e-9))
    colour = [dr.clip(v, 0, 1) for v in x[:3]]
    return [*colour, x[3] * scale, x[4] * scale, dr.clip(x[5], options.floor, 1), dr.clip(x[6], 0, 1)]


def _flat4(parts: tuple) -> list:
    linear, constant, d_linear, d_constant = parts
    return [*linear, *constant, *(d for row in d_linear for d in row), *(d for row in d_constant for d in row)]


def _unflat4(flat: Any, slopes: bool) -> tuple[list, list, list, list]:
    flat = list(flat)
    if not slopes:
        return flat[:3], flat[3:6], [[]] * 3, [[]] * 3
    return (
        flat[:3],
        flat[3:6],
        [flat[6 + 4 * c : 10 + 4 * c] for c in range(3)],
        [flat[18 + 4 * c : 22 + 4 * c] for c in range(3)],
    )


def local(frame: tuple, vector: Any) -> Any:
    """A world vector in the texels' frames."""
    return type(vector)(dr.dot(frame[0], vector), dr.dot(frame[1], vector), dr.dot(frame[2], vector))


def _columns(values: Float[np.ndarray, "n c"]) -> list:
    return [mi.Float(aligned(values[:, j])) for j in range(values.shape[1])]


def _rows(columns: list) -> Float[np.ndarray, "n c"]:
    return np.stack([np.array(c) for c in columns], axis=1)


def _light_rows(rig: Rig) -> Float[np.ndarray, "l 8"]:
    """One row per light: vector, near, irradiance (filled in by `relight`) and width2."""
    rows = np.zeros((len(rig.vector), 8), np.float32)
    rows[:, :3], rows[:, 3] = rig.vector, rig.near
    rows[:, 7] = 0 if rig.width2 is None else rig.width2
    return rows


def _chunk(points: Points, seen: Observations, texel: Int[np.ndarray, " n"], count: Int[np.ndarray, " n"]) -> dict:
    """One chunk's observations, the k-th of all lanes together; `rows` are their indices, `real` marks valid slots."""
    width, most = len(texel), int(count[0])
    slot = np.arange(most)[:, None]
    real = (slot < count).ravel()
    # 32 bits where they suffice: half the memory.
    index = np.int32 if seen.start[-1] <= np.iinfo(np.int32).max else np.int64
    rows = np.where(real, (seen.start[texel] + slot).ravel(), 0).astype(index)
    frame = points.frame[texel]
    chunk = {
        "texel": texel,
        "width": width,
        "rows": rows,
        "real": real,
        "lane": dr.arange(mi.UInt32, width),
        "count": mi.UInt32(aligned(count, np.uint32)),
        "position": mi.Point3f(*_columns(points.position[texel])),
        "frame": tuple(mi.Vector3f(*_columns(frame[:, k])) for k in range(3)),
        "picture": mi.UInt32(aligned(seen.picture[rows], np.uint32)),
        "weight": mi.Float(aligned(np.where(real, seen.weight[rows], 0))),
        "lit": mi.UInt32(aligned(seen.lit[rows], np.uint32)),
        "rgb": _columns(seen.rgb[rows]),
    }
    if points.open is not None:
        chunk["open"] = mi.UInt32(aligned(points.open[texel].T.ravel(), np.uint32))
    dr.eval(chunk["lane"])
    dr.make_opaque(chunk["lane"])
    return chunk
