"""The batched per-texel solver: its derivatives, its answers on texels of known truth, and its determinism."""

from dataclasses import fields

import numpy as np
import pytest

from mistyle.render.mitsuba import device
from mistyle.solver.texels import levenberg_marquardt as lm

VIEWS = 16
LIGHTS = np.array([[1, 1, 1], [-1, 0.5, 1], [0, -1, 1]]) / np.sqrt([[3], [2.25], [2]])
STRENGTHS = np.array([2.0, 1.0, 0.5])
NEUTRAL = np.array([0.5, 0.5, 0.5, 0, 0, 0.5, 0], np.float32)


def cap(rng, count, degrees):
    """Unit vectors within `degrees` of +Z."""
    z = rng.uniform(np.cos(np.radians(degrees)), 1, count)
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def truth(rng, count, metallic=False):
    """Random texels: albedo 0.1..0.8, tilt of 0.15, roughness 0.15..0.95."""
    metal = rng.uniform(0, 1, (count, 1)) if metallic else np.zeros((count, 1))
    parts = [rng.uniform(0.1, 0.8, (count, 3)), rng.normal(0, 0.15, (count, 2)), rng.uniform(0.15, 0.95, (count, 1))]
    return np.concatenate([*parts, metal], axis=1).astype(np.float32)


def problem(rng, count, *, together=False, options=None):
    """`count` texels in one place, seen from all views under three lights, one a picture or `together`."""
    eyes = 4 * cap(rng, VIEWS, 65)
    if together:
        first, vectors, strengths = np.arange(VIEWS + 1) * 3, np.tile(LIGHTS, (VIEWS, 1)), np.tile(STRENGTHS, VIEWS)
    else:
        eyes = np.repeat(eyes, 3, axis=0)
        first = np.arange(3 * VIEWS + 1)
        vectors, strengths = np.tile(LIGHTS, (VIEWS, 1)), np.tile(STRENGTHS, VIEWS)
    pictures = len(eyes)
    near = np.zeros(len(vectors))
    near[1] = 1  # one lamp stands close by
    vectors = vectors.copy()
    vectors[1] *= 3
    colours = strengths[:, None] * np.where(near, 9, 1)[:, None] * np.array([1.0, 0.9, 0.8])
    rig = lm.Rig(eyes, first, vectors, near, colours)
    frame = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))
    # Texels see different numbers of pictures, in no order.
    counts = rng.permutation(np.linspace(pictures // 2, pictures, count).astype(int))
    start = np.concatenate([[0], np.cumsum(counts)])
    picture = np.concatenate([np.sort(rng.permutation(pictures)[:n]) for n in counts]).astype(np.int32)
    total = int(start[-1])
    seen = lm.Observations(
        start, picture, np.zeros((total, 3), np.float32), np.full(total, 200, np.float32), np.full(total, 7, np.uint32)
    )
    points = lm.Points(np.zeros((count, 3), np.float32), frame)
    return lm.Problem(points, rig, seen, options or lm.Options())


def best_of_starts(solver, count, roughness=(0.25, 0.7), metallic=(0.0,), iterations=20):
    prior = np.full((count, 7), 1.0, np.float32)
    mean = np.tile(NEUTRAL, (count, 1))
    best = None
    for rough in roughness:
        for metal in metallic:
            start = mean.copy()
            start[:, 5], start[:, 6] = rough, metal
            found = solver.solve(start, mean, prior, iterations)
            if best is None:
                best = found
            else:
                better = found.cost < best.cost
                pairs = {f.name: (getattr(found, f.name), getattr(best, f.name)) for f in fields(found)}
                chosen = {n: np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for n, (a, b) in pairs.items()}
                best = lm.Solution(**chosen)
    assert best is not None
    return best


def degrees_between(a, b):
    def normal(v):
        return np.concatenate([v[:, 3:5], np.sqrt(1 - (v[:, 3:5] ** 2).sum(1, keepdims=True))], axis=1)

    return np.degrees(np.arccos(np.clip((normal(a) * normal(b)).sum(1), -1, 1)))


@pytest.mark.parametrize("model", ["principled", "gltf"])
@pytest.mark.parametrize("together", [False, True])
def test_recovers_texels_of_known_truth(rng, model, together):
    count = 256
    wanted = truth(rng, count)
    solver = problem(rng, count, together=together, options=lm.Options(model=model))
    solver.retarget(solver.predict(wanted))
    found = best_of_starts(solver, count)
    angle = degrees_between(found.values, wanted)
    # All lights at once are badly conditioned: a few texels end in another minimum.
    assert np.median(angle) < (0.5 if together else 0.05) and angle.mean() < (4 if together else 0.5)
    assert np.median(np.abs(found.values[:, 5] - wanted[:, 5])) < 0.002
    assert np.median(np.abs(found.values[:, :3] - wanted[:, :3])) < 0.002


def test_recovers_metallic_when_asked(rng):
    count = 256
    wanted = truth(rng, count, metallic=True)
    solver = problem(rng, count, options=lm.Options(metallic=True))
    solver.retarget(solver.predict(wanted))
    found = best_of_starts(solver, count, metallic=(0.1, 0.9), iterations=30)
    assert np.median(np.abs(found.values[:, 6] - wanted[:, 6])) < 0.01
    assert np.median(degrees_between(found.values, wanted)) < 0.1


@pytest.mark.parametrize("model", ["principled", "gltf"])
def test_the_normal_matrix_is_that_of_finite_differences_of_the_prediction(rng, model):
    """JᵀJ's diagonal, and the spread from the inverse, against a Jacobian by central differences in NumPy."""
    count = 64
    options = lm.Options(model=model, metallic=True)
    solver = problem(rng, count, options=options)
    wanted = truth(rng, count, metallic=True)
    wanted[:, 3:5] *= 0.5
    solver.retarget(solver.predict(wanted))
    prior = np.full((count, 7), 1.0, np.float32)
    at = solver.solve(wanted, wanted, prior, 0)
    np.testing.assert_array_equal(at.values, wanted)
    columns = []
    for j in range(7):
        step = np.zeros(7, np.float32)
        step[j] = 2e-3
        columns.append(((solver.predict(wanted + step) - solver.predict(wanted - step)) / 4e-3).astype(np.float64))
    jacobian = 200 * np.stack(columns, axis=-1)
    start = np.concatenate([[0], np.cumsum(np.bincount(owner(solver), minlength=count))])
    compared = 0
    for i in range(count):
        rows = jacobian[start[i] : start[i + 1]].reshape(-1, 7)
        matrix = rows.T @ rows
        np.testing.assert_allclose(at.diagonal[i], np.diag(matrix), rtol=0.02, atol=1)
        expected = np.sqrt(np.diag(np.linalg.inv(matrix + np.eye(7))))
        if np.linalg.cond(matrix + np.eye(7)) < 1e5:  # beyond that single precision has no digits for the inverse
            np.testing.assert_allclose(at.spread[i], expected, rtol=0.05, atol=1e-4)
            compared += 1
        assert (at.spread[i] < 1.0001).all()
    assert compared > count / 2


def owner(solver):
    """The texel of every observation, from the packed chunks."""
    pairs = []
    for chunk in solver.chunks:
        lanes = np.tile(chunk["texel"], len(chunk["rows"]) // chunk["width"])
        pairs.append(np.stack([chunk["rows"][chunk["real"]], lanes[chunk["real"]]], axis=1))
    both = np.concatenate(pairs)
    return both[np.argsort(both[:, 0]), 1]


def test_automatic_derivatives_lead_where_finite_differences_lead(rng):
    count = 128
    wanted = truth(rng, count)
    results = []
    for differences in (False, True):
        solver = problem(np.random.default_rng(1), count, options=lm.Options(differences=differences))
        solver.retarget(solver.predict(wanted))
        results.append(best_of_starts(solver, count).values)
    assert np.median(np.abs(results[0] - results[1])) < 1e-4


def test_outliers_do_not_pull(rng):
    """A tenth of the observations gets light from elsewhere; the robust loss keeps the normals."""
    count = 256
    wanted = truth(rng, count)
    solver = problem(rng, count)
    target = solver.predict(wanted)
    spoiled = rng.random(len(target)) < 0.1
    target[spoiled] += rng.uniform(0.05, 0.3, (int(spoiled.sum()), 1)).astype(np.float32)
    solver.retarget(target)
    robust = best_of_starts(solver, count)
    solver.options = lm.Options(huber=1e6)
    plain = best_of_starts(solver, count)
    kept, lost = (np.median(degrees_between(found.values, wanted)) for found in (robust, plain))
    assert kept < lost / 3


def test_bounds_hold_and_unseen_texels_keep_the_prior(rng):
    count = 64
    solver = problem(rng, count)
    solver.retarget(np.full_like(solver.predict(truth(rng, count)), 50))
    found = best_of_starts(solver, count)
    assert found.values[:, :3].max() <= 1 and found.values[:, 5].min() >= np.float32(0.04)
    assert np.hypot(found.values[:, 3], found.values[:, 4]).max() <= 0.95 + 1e-6
    nothing = lm.Observations(np.zeros(3, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0), np.zeros(0, int))
    rig = lm.Rig(np.zeros((1, 3)), np.array([0, 1]), np.array([[0, 0, 1.0]]), np.zeros(1), np.ones((1, 3)))
    empty = lm.Problem(lm.Points(np.zeros((2, 3)), np.zeros((2, 3, 3))), rig, nothing, lm.Options())
    mean = np.tile(NEUTRAL, (2, 1))
    result = empty.solve(mean, mean, np.full((2, 7), 4.0, np.float32), 3)
    np.testing.assert_array_equal(result.values, mean)
    np.testing.assert_allclose(result.spread, 0.5)


def test_the_same_bytes_at_any_number_of_threads(rng):
    import drjit as dr

    count = 300
    device.use()
    before, results = dr.thread_count(), []
    try:
        for threads in (1, 2):
            device.use(threads=threads)
            solver = problem(np.random.default_rng(3), count)
            solver.retarget(solver.predict(truth(np.random.default_rng(4), count)))
            found = best_of_starts(solver, count, iterations=6)
            results.append(found.values.tobytes() + found.spread.tobytes())
    finally:
        dr.set_thread_count(before)
    assert results[0] == results[1]


def test_other_numbers_of_iterations_and_other_targets_compile_nothing_new(rng):
    """Kernels are found again whatever the place in memory of the arrays that come."""
    import drjit as dr

    count = 200
    solver = problem(rng, count)
    target = solver.predict(truth(rng, count))
    mean, prior = np.tile(NEUTRAL, (count, 1)), np.ones((count, 7), np.float32)
    solver.retarget(target)
    solver.solve(mean, mean, prior, 3)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for iterations in (4, 5):
            solver.retarget(target * 0.9)
            solver.solve(mean.copy(), mean.copy(), prior.copy(), iterations)
        history = [h for h in dr.kernel_history() if h["type"] == dr.KernelType.JIT and h["size"] > 1]
    assert history and all(h["cache_hit"] for h in history)
