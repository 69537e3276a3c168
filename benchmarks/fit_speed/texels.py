"""How fast the per-texel solver is, for the benchmarks."""

import time

import numpy as np

from mistyle.solver.texels.levenberg_marquardt import Problem
from mistyle.solver.texels.records import Observations, Options, Points, Rig


def throughput(
    texels: int = 65536, pictures: int = 16, *, differences: bool = False, iterations: int = 20, seed: int = 0
) -> float:
    """Texels solved per second: two roughness starts of `iterations` steps, `pictures` observations a texel.

    Random texels under one light a picture, targets from the model itself; packing and compiling are not counted.
    `differences` takes central differences for the Jacobian. Threads are those of `device.use`.
    """
    rng = np.random.default_rng(seed)

    def cap(count: int, degrees: float) -> np.ndarray:
        z = rng.uniform(np.cos(np.radians(degrees)), 1, count)
        angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(1 - z**2)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)

    true = np.zeros((texels, 7), np.float32)
    true[:, :3], true[:, 3:5] = rng.uniform(0.1, 0.8, (texels, 3)), np.clip(rng.normal(0, 0.15, (texels, 2)), -0.6, 0.6)
    true[:, 5] = rng.uniform(0.15, 0.95, texels)
    shape = (pictures, 3)
    rig = Rig(
        4 * cap(pictures, 65), np.arange(pictures + 1), cap(pictures, 60), np.zeros(pictures), np.full(shape, 2.0)
    )
    total = texels * pictures
    seen = Observations(
        np.arange(texels + 1) * pictures,
        np.tile(np.arange(pictures), texels),
        np.zeros((total, 3), np.float32),
        np.full(total, 200, np.float32),
        np.ones(total, np.uint32),
    )
    points = Points(np.zeros((texels, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (texels, 1, 1)))
    problem = Problem(points, rig, seen, Options(differences=differences))
    problem.retarget(problem.predict(true))
    mean = np.tile(np.array([0.5, 0.5, 0.5, 0, 0, 0.5, 0], np.float32), (texels, 1))
    prior, begun = np.ones((texels, 7), np.float32), 0.0
    for warm in (True, False):
        begun = time.perf_counter()
        for roughness in (0.25, 0.7):
            start = mean.copy()
            start[:, 5] = roughness
            problem.solve(start, mean, prior, 1 if warm else iterations)
    return texels / (time.perf_counter() - begun)
