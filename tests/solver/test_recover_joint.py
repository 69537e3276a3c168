"""The joint steps at the end of a recovery: their algebra against dense matrices, their model against real pictures."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from mistyle.core.capture import subset
from mistyle.core.image import gaussian
from mistyle.render.deferred import image_samples as collecting
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.render.mitsuba import draw
from mistyle.solver.context import DirectCaptures, FitContext
from mistyle.solver.joint import algebra
from mistyle.solver.joint import gauss_newton as joint
from mistyle.solver.joint.pixels import UnknownTexels, image_footprints
from mistyle.solver.prior import NOTHING
from mistyle.solver.recover import recover
from mistyle.solver.schedule import runnable
from mistyle.solver.table import linked
from tests.solver.test_recover import QUICK, errors, world  # noqa: F401
from tests.solver.test_recover_smooth import atlas

FEW = QUICK.model_copy(update={"iterations": 60, "rounds": 1})


def random_linear(rng: np.random.Generator, pixels: int, texels: int) -> algebra.LinearisedImage:
    weights = rng.uniform(0, 1, (pixels, texels)) * (rng.random((pixels, texels)) < 0.4)
    derivative, weight, wrong = (
        rng.normal(size=(pixels, 3, 4)),
        rng.uniform(0.5, 2, (pixels, 3)),
        rng.normal(size=(pixels, 3)),
    )
    return algebra.LinearisedImage(
        csr_array(weights.astype(np.float32)), *(a.astype(np.float32) for a in (derivative, weight, wrong))
    )


def dense(each: algebra.LinearisedImage) -> np.ndarray:
    """D B as a matrix, channels of pixels x unknowns of texels."""
    fetch, d = each.fetch.toarray().astype(np.float64), each.derivative.astype(np.float64)
    by = np.zeros((*d.shape[:2], 6))
    by[:, range(3), range(3)], by[..., 3:] = d[..., 0], d[..., 1:]
    return np.einsum("pci,pt->pcti", by, fetch).reshape(d.shape[0] * 3, -1)


def test_the_equations_are_those_of_dense_matrices(rng):
    texels = 5
    linear = [random_linear(rng, pixels, texels) for pixels in (7, 4)]
    matrix = sum(dense(each).T @ np.diag(each.weight.ravel()) @ dense(each) for each in linear)
    right = sum(dense(each).T @ (each.weight * each.residual).ravel() for each in linear)
    v = rng.normal(size=(texels, 6)).astype(np.float32)
    np.testing.assert_allclose(algebra.normal_matvec(linear, v).ravel(), matrix @ v.ravel(), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(algebra.rhs(linear, texels).ravel(), right, rtol=1e-4, atol=1e-4)
    blocks = algebra.diagonal_blocks(linear, texels)
    for t in range(texels):
        np.testing.assert_allclose(blocks[t], matrix[6 * t : 6 * t + 6, 6 * t : 6 * t + 6], rtol=1e-4, atol=1e-4)
    inverse = np.linalg.inv(blocks + np.eye(6, dtype=np.float32))
    solved = algebra.pcg(
        lambda x: algebra.normal_matvec(linear, x) + x, right.reshape(texels, 6).astype(np.float32), inverse
    )
    exact = np.linalg.solve(matrix + np.eye(6 * texels), right)
    assert np.linalg.norm(solved.ravel() - exact) < 0.02 * np.linalg.norm(exact)


def test_weights_are_the_slope_of_the_cost(rng):
    """Of Cauchy's cost, by differences; what is no number, or does not count, has none."""
    wrong = rng.normal(0, 3, (6, 3)).astype(np.float32)
    wrong[0, 1] = np.nan
    derivative = rng.normal(size=(6, 3, 4)).astype(np.float32)
    derivative[1, 2, 3] = np.inf
    own = joint.ResidualStd(rng.uniform(0.5, 2, 6).astype(np.float32), np.array([1, 1, 0, 1, 1, 1], np.float32))
    weight = joint._weights(wrong, derivative, own)
    assert weight[0, 1] == weight[1, 2] == 0 and (weight[2] == 0).all() and np.isfinite(derivative).all()
    count = 3 * own.counts.sum()
    for p, c in ((3, 0), (4, 1), (5, 2)):
        up, down = wrong.copy(), wrong.copy()
        up[p, c] += 0.01
        down[p, c] -= 0.01
        slope = count * (joint._cost([up], [own]) - joint._cost([down], [own])) / 0.02
        np.testing.assert_allclose(2 * weight[p, c] * wrong[p, c], slope, rtol=5e-3, atol=1e-3)


def test_a_step_keeps_within_bounds():
    table = np.zeros((4, 8), np.float32)
    table[:, :6] = 0.5, 0.5, 0.5, 0.6, 0.6, 0.1
    change = np.full((3, 6), 9.0, np.float32)
    change[1], change[2, 5] = np.nan, -9
    moved = joint._updated(table, UnknownTexels(np.array([0, 1, 3]), np.ones(3, bool)), change, 0.04)
    np.testing.assert_allclose(moved[0, :3], 0.7, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*moved[0, 3:5]), joint.STEEPEST, atol=1e-6)
    np.testing.assert_array_equal(moved[1:3], table[1:3])
    np.testing.assert_allclose(moved[3, 5], 0.04, atol=1e-6)


@pytest.fixture(scope="module")
def drawn(world):  # noqa: F811
    """Six pictures, as the joint steps see them."""
    mesh, maps, texels, captures = world
    some = subset(captures, range(0, 30, 5))
    tangents = collecting.tangents_of(mesh, "mikkt")
    context = FitContext(draw.tracer(mesh), tangents, [texels], linked(mesh, [texels]), some, QUICK)
    renderer = context.renderer(subsamples=9)
    footprints = image_footprints(context, renderer)
    assert footprints is not None
    pictures, unknown, _ = footprints
    problem = joint.JointProblem(context, renderer, pictures, unknown, DirectCaptures(some), ())
    return problem, pack([maps])


def test_a_pixel_is_the_mean_of_its_texels(drawn, rng):
    """Changes that differ from texel to texel move the pictures as the model says, nearly, and equal ones nearer:
    where the camera is faced, since reflectance jumps where the mapped normal turns away."""
    problem, table = drawn
    pictures, unknown = problem.footprints, problem.unknown
    for pixels in pictures:
        np.testing.assert_allclose(pixels.fetch.sum(axis=1), 1, atol=1e-5)
        assert (pixels.lit > 0).all() and (pixels.lit <= 1).all()
    faced = np.concatenate([facing(problem.renderer, k) > 0.6 for k in range(len(pictures))])
    assert faced.mean() > 0.5
    before, derivatives = problem.images_and_slopes(table)
    noise = rng.standard_normal((64, 64, 6)).astype(np.float32)
    smooth = np.stack([gaussian(noise[..., c], 2.0) for c in range(6)], axis=-1)
    for change, most in ((np.full((4096, 6), 2e-4, np.float32), 0.04), (2e-3 * smooth.reshape(-1, 6), 0.1)):
        moved = table.copy()
        moved[:, :6] += change
        after = problem.images(moved)
        real = np.concatenate([b - a for a, b in zip(before, after, strict=True)])
        each = [p.fetch @ change[unknown.rows] for p in pictures]
        told = np.concatenate(
            [
                d[..., 0] * v[:, :3] + np.einsum("pcj,pj->pc", d[..., 1:], v[:, 3:])
                for d, v in zip(derivatives, each, strict=True)
            ]
        )
        assert np.linalg.norm((told - real)[faced]) < most * np.linalg.norm(real[faced])


def facing(renderer: MaterialRenderer, picture: int) -> np.ndarray:
    """The least cosine between surface and camera of each lit pixel's samples."""
    least = []
    for block in renderer.blocks(picture):
        count = block.hits.counts[0]
        of = np.full(len(block.pixel), np.inf, np.float32)
        np.minimum.at(of, np.array(block.hits.samples.slot)[:count], np.array(block.hits.samples.wi.z)[:count])
        least.append(of)
    return np.concatenate(least)


@pytest.mark.parametrize(
    ("columns", "far", "most"), [((0, 1, 2), 0.02, 1e-3), ((3,), 3e-4, 0.02), ((4,), 3e-4, 0.02), ((5,), 3e-4, 0.02)]
)
def test_slopes_are_those_of_differences(drawn, columns, far, most):
    """Pictures are those without slopes; slopes equal central differences except where reflectance jumps between
    them, where the two one-sided differences disagree."""
    problem, table = drawn
    images, slopes = problem.images_and_slopes(table)
    moved = [table.copy(), table.copy()]
    moved[0][:, columns] += far
    moved[1][:, columns] -= far
    before, (ahead, back) = problem.images(table), (problem.images(m) for m in moved)
    number = {0: 0, 3: 1, 4: 2, 5: 3}[columns[0]]
    for image, plain, slope, a, b in zip(images, before, slopes, ahead, back, strict=True):
        np.testing.assert_allclose(image, plain, rtol=1e-5, atol=1e-6)
        smooth = np.abs((a - plain) - (plain - b)) < 0.1 * np.abs(a - b) + 1e-6
        assert smooth.mean() > 0.9
        wrong = (slope[..., number] - (a - b) / (2 * far))[smooth]
        assert np.linalg.norm(wrong) < most * np.linalg.norm((a - b)[smooth]) / (2 * far)


def test_uncovered_texels_are_nearly_as_the_nearest_covered_one():
    """Equal values cost nothing, and one apart by ALIKE costs one; straight ramps of covered texels cost nothing."""
    covered = np.ones((12, 12), bool)
    covered[:, 9:] = False
    where = atlas(covered)
    table = np.full((144, 8), 0.5, np.float32)
    noise = np.full((144, 7), NOTHING, np.float32)
    rows = np.flatnonzero(covered.ravel() | (np.arange(144) % 12 == 9))
    priors = joint._prior_matrices(table, noise, rows, where)
    ramp = np.minimum(np.arange(144) % 12, 8)[rows].astype(np.float32)
    assert len(priors) == 6
    for prior in priors:
        assert prior.shape == (len(rows), len(rows)) and abs(ramp @ (prior @ ramp)) < 1e-3 * (
            ramp @ (abs(prior) @ ramp)
        )
        one = np.where(rows == 9, joint.ALIKE, 0).astype(np.float32)
        np.testing.assert_allclose(one @ (prior @ one), 1, rtol=1e-3)


def test_few_pictures_find_more(world):  # noqa: F811
    mesh, maps, texels, captures = world
    some = subset(captures, range(0, 30, 5))
    found = {}
    for number in (0, 3):
        result = recover(mesh, [texels], some, QUICK.model_copy(update={"joint": number}), 0)
        angle, roughness, albedo = errors(result.maps[0], maps, texels.covered & (result.views[0] >= 3))
        found[number] = angle.mean(), (roughness**2).mean(), (albedo**2).mean()
        assert result.notes == ()
    costs = result.trace["joint.cost"]
    assert len(costs) == 4 and all(b < a for a, b in zip(costs[:-1], costs[1:], strict=True))
    for with_, without in zip(found[3], found[0], strict=True):
        assert with_ < 0.6 * without


def test_steps_that_help_not_or_need_too_much_are_left_out(world, monkeypatch):  # noqa: F811
    """With a note each, and the maps as without them."""
    mesh, _, texels, captures = world
    some = subset(captures, range(0, 30, 5))

    def found(**changed):
        return recover(mesh, [texels], some, FEW.model_copy(update=changed), 0)

    def same(a, b):
        names = ("albedo", "normal", "roughness")
        return all(getattr(a.maps[0], n).tobytes() == getattr(b.maps[0], n).tobytes() for n in names)

    without, smaller = found(joint=0), found(memory=1e-4)
    assert same(without, smaller) and any("joint steps" in n and "recover.memory" in n for n in smaller.notes)
    monkeypatch.setattr(
        joint, "_step", lambda table, linear, unknown, where: np.full((len(unknown.rows), 6), 0.1, np.float32)
    )
    undone = found()
    assert same(without, undone) and any("joint steps were undone" in n for n in undone.notes)


def test_where_there_are_none():
    assert runnable(QUICK, False, 1000).joint == 3 and runnable(QUICK, True, 1000).joint == 0
    for changed in ({"solver": "texels"}, {"solver": "pictures"}, {"smooth": False}):
        assert runnable(QUICK.model_copy(update=changed), False, 1000).joint == 0
    assert runnable(QUICK, False, 4096**2).joint == 0 == runnable(QUICK, False, 1000, pixels=1e9).joint
