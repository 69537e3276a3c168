"""The sampler against a Gaussian, whose ideal denoiser is linear and whose conditional is known."""

import numpy as np
import pytest

from mistyle.stylization.diffusion.repaint import Resampling, normal, refined, sample, step

RHO, GIVEN = 0.9, 1.5  # two unit normals of this correlation; the first one is known
MEAN, VARIANCE = RHO * GIVEN, 1 - RHO**2
COVARIANCE = np.array([[1.0, RHO], [RHO, 1.0]])


def karras(steps: int, low: float = 0.02, high: float = 20.0, rho: float = 7.0) -> list[float]:
    t = np.linspace(0, 1, steps)
    return [*((high ** (1 / rho) + t * (low ** (1 / rho) - high ** (1 / rho))) ** rho), 0.0]


def ideal(x: np.ndarray, sigma: float) -> np.ndarray:
    """E[clean | x] for the Gaussian."""
    return x @ (COVARIANCE @ np.linalg.inv(COVARIANCE + sigma**2 * np.eye(2))).T


def unknown(L: int, r: int, refine: float = 0.0, count: int = 20_000, seed: int = 0) -> np.ndarray:
    prior = np.tile([GIVEN, 0.0], (count, 1))
    mask = np.array([1.0, 0.0])
    return sample(ideal, prior, mask, karras(50), Resampling(L, r, refine=refine), rng=np.random.default_rng(seed))[
        :, 1
    ]


def test_resampling_brings_the_conditional():
    once, often = unknown(10, 1), unknown(10, 10)
    assert abs(once.mean() - MEAN) >= 4 * abs(often.mean() - MEAN)
    assert often.var() == pytest.approx(VARIANCE, rel=0.2)
    assert unknown(10, 30).mean() == pytest.approx(MEAN, abs=0.08)


def test_renoising_only_before_the_last_repeat_loses_half_the_variance():
    """The paper's wording, for comparison: it is the assertion on the variance that tells the two apart."""
    levels, rng, mask = karras(50), np.random.default_rng(0), np.array([1.0, 0.0])
    prior = np.tile([GIVEN, 0.0], (20_000, 1))
    x = levels[0] * normal(rng, prior)
    for first in range(0, 50, 10):
        for repeat in range(10):
            if repeat == 9:
                x = x + np.sqrt(levels[first] ** 2 - levels[first + 10] ** 2) * normal(rng, x)
            for k in range(first, first + 10):
                x = step(ideal, x, levels[k], levels[k + 1])
                x = mask * (prior + levels[k + 1] * normal(rng, x)) + (1 - mask) * x
    assert x[:, 1].var() < 0.5 * VARIANCE


def test_the_light_refinement_moves_little():
    """The mean of the unknown part stays; the known part is only nearly the prior afterwards."""
    plain, touched = unknown(10, 10), unknown(10, 10, refine=0.1)
    assert touched.mean() == pytest.approx(plain.mean(), abs=0.02)
    assert touched.var() == pytest.approx(VARIANCE, rel=0.2)
    assert not np.array_equal(plain, touched)


@pytest.mark.parametrize(
    ("steps", "L", "r", "refine"), [(30, 10, 10, 0.1), (50, 10, 3, 0.0), (7, 3, 2, 0.5), (5, 9, 4, 1)]
)
def test_the_denoiser_is_called_as_often_as_said(steps, L, r, refine):
    levels, seen = karras(steps), []

    def count(x, sigma):
        seen.append(sigma)
        return 0.5 * x

    prior = np.zeros((3, 2))
    sample(count, prior, np.ones(2), levels, Resampling(L, r, refine=refine), rng=np.random.default_rng(0))
    extra = int(refine * steps)
    blocks = [levels[k : min(k + L, steps)] * r for k in range(0, steps, L)]
    assert seen == [s for block in blocks for s in block] + levels[steps - extra : steps]


def test_pinned_pixels_are_the_prior_at_the_end(rng):
    prior, mask = rng.normal(size=(4, 8, 8)), (rng.random((8, 8)) < 0.4).astype(float)
    found = sample(
        lambda x, s: x / (1 + s), prior, mask, karras(20), Resampling(refine=0.0), rng=np.random.default_rng(3)
    )
    assert np.array_equal(found[:, mask == 1], prior[:, mask == 1])
    assert (found[:, mask == 0] != prior[:, mask == 0]).all()


def test_the_first_view_is_plain_sampling(rng):
    levels, like = karras(12), np.zeros((5, 2))
    found = sample(ideal, None, None, levels, Resampling(10, 10, refine=0.0), rng=np.random.default_rng(1), like=like)
    x = levels[0] * normal(np.random.default_rng(1), like)
    for a, b in zip(levels, levels[1:], strict=False):
        x = step(ideal, x, a, b)
    assert np.array_equal(found, x)
    again = sample(ideal, None, None, levels, rng=np.random.default_rng(1), like=like)
    generator = np.random.default_rng(1)
    generator.standard_normal(like.shape)
    assert np.array_equal(again, refined(ideal, x, levels, 0.1, generator))


def test_the_same_seed_gives_the_same_result():
    assert np.array_equal(unknown(10, 3, 0.1, 100, seed=5), unknown(10, 3, 0.1, 100, seed=5))
    assert not np.array_equal(unknown(10, 3, 0.1, 100, seed=5), unknown(10, 3, 0.1, 100, seed=6))


def test_torch_tensors_pass_through():
    import torch

    matrix = lambda s: torch.tensor(COVARIANCE @ np.linalg.inv(COVARIANCE + s * s * np.eye(2)))  # noqa: E731
    prior, mask = torch.tensor([GIVEN, 0.0], dtype=torch.float64).repeat(4000, 1), torch.tensor([1.0, 0.0])
    generator = torch.Generator().manual_seed(0)
    found = sample(lambda x, s: x @ matrix(s).T, prior, mask, karras(50), Resampling(refine=0.0), rng=generator)
    assert isinstance(found, torch.Tensor) and found.dtype == torch.float64
    assert torch.equal(found[:, 0], prior[:, 0])
    assert float(found[:, 1].mean()) == pytest.approx(unknown(10, 10).mean(), abs=0.03)


@pytest.mark.parametrize(
    "wrong",
    [
        {"sigmas": [1.0, 2.0, 0.0]},
        {"sigmas": [2.0, 1.0]},
        {"sigmas": [0.0]},
        {"L": 0},
        {"r": 0},
        {"refine": 1.5},
        {"mask": None},
        {"prior": None},
    ],
)
def test_what_cannot_be_sampled_is_refused(wrong, rng):
    right = {"prior": np.zeros((2, 2)), "mask": np.ones(2), "sigmas": [2.0, 1.0, 0.0], "L": 1, "r": 1, "refine": 0.0}
    given = right | wrong
    positional = [given[name] for name in ("prior", "mask", "sigmas")]
    with pytest.raises(ValueError):
        sample(ideal, *positional, Resampling(given["L"], given["r"], given["refine"]), rng=rng)
