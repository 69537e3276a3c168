"""Losses by hand-computed values, closed forms and invariants."""

import numpy as np
import pytest
import torch

from mistyle.core import image
from mistyle.measure import losses
from mistyle.measure.features import filter_bank


def as_is(picture):
    """The simplest features: the picture itself."""
    return [picture]


def random_picture(rng, channels=3, size=24, count=2):
    return torch.from_numpy(rng.random((count, channels, size, size)).astype(np.float32))


def test_sliced_wasserstein_of_a_permutation_is_zero(rng):
    pixels = torch.from_numpy(rng.random((500, 3)).astype(np.float32))
    shuffled = pixels[torch.from_numpy(rng.permutation(500))]
    assert float(losses.sliced_wasserstein(pixels, shuffled, rng)) < 1e-12


def test_sliced_wasserstein_of_a_shift_is_a_third_of_its_square(rng):
    """Shifting by mu moves every projection by mu.d, and E (mu.d)² = |mu|² / 3 over the sphere."""
    pixels = torch.from_numpy(rng.random((400, 3)).astype(np.float32))
    shift = torch.tensor([0.3, -0.2, 0.1])
    value = losses.sliced_wasserstein(pixels + shift, pixels, rng, projections=4096)
    # The variance of (mu.d)² is 4/45 |mu|^4: 4096 directions leave 1.5 % of the mean.
    assert float(value) == pytest.approx(0.14 / 3, rel=0.06)


def test_sliced_wasserstein_by_hand_along_one_axis():
    class Axis(np.random.Generator):
        def normal(self, size):
            return np.array([[2.0], [0.0], [0.0]])

    a = torch.tensor([[0.0, 9, 9], [1.0, 9, 9]])
    b = torch.tensor([[0.5, 0, 0], [0.0, 0, 0]])
    # Sorted reds 0, 1 against 0, 0.5: mean of 0 and 0.25.
    assert float(losses.sliced_wasserstein(a, b, Axis(np.random.PCG64(0)), projections=1)) == pytest.approx(0.125)


def test_sliced_wasserstein_sorts_negative_numbers_and_ties_in_their_places(rng):
    rows = torch.from_numpy((np.round(rng.normal(size=(3, 500)), 1) + 0.0).astype(np.float32))
    rows[0, :4] = torch.tensor([0.0, -0.0, -1e30, 1e-40])
    expected = rows.sort(dim=1, stable=True)
    assert torch.equal(rows.gather(1, losses._order(rows)), expected.values)
    assert torch.equal(losses._order(rows)[1:], expected.indices[1:])


def test_sliced_wasserstein_draws_equal_numbers_and_pulls_colours_together(rng):
    mine = torch.full((300, 3), 0.2, requires_grad=True)
    theirs = torch.full((1000, 3), 0.6)
    value = losses.sliced_wasserstein(mine, theirs, rng, samples=128)
    value.backward()
    assert float(value.detach()) > 0 and bool((mine.grad <= 0).all())
    assert int((mine.grad.abs().sum(1) > 0).sum()) == 128


def test_aligned_style_loss_is_the_masked_squared_distance(rng):
    a, b, mask = random_picture(rng), random_picture(rng), torch.zeros(2, 1, 24, 24)
    mask[..., :12] = 1
    value = losses.style_aligned(*losses.masked_features(as_is, a, b, mask, mask), mask)
    by_hand = ((a - b)[..., :12] ** 2).sum() / a.numel() / 0.5
    assert float(value) == pytest.approx(float(by_hand), rel=1e-5)


def test_pixels_outside_the_mask_do_not_matter_at_all(rng):
    a, b = random_picture(rng), random_picture(rng)
    mask = torch.zeros(2, 1, 24, 24)
    mask[:, :, 5:17, 3:20] = 1
    changed = torch.where(mask > 0, a, random_picture(rng))
    for loss in (losses.style_aligned, lambda x, y, m: losses.style_statistics(x, y, m, m)):
        values = [float(loss(*losses.masked_features(filter_bank, x, b, mask, mask), mask)) for x in (a, changed)]
        assert values[0] == values[1] > 0
    leaf = a.clone().requires_grad_()
    losses.style_aligned(*losses.masked_features(filter_bank, leaf, b, mask, mask), mask).backward()
    assert bool((leaf.grad[(mask == 0).expand_as(a)] == 0).all())


KINDS = pytest.mark.parametrize("kind", ["gram", "mean-std", "swd"])


@KINDS
def test_statistics_forget_places_and_aligned_features_do_not(rng, kind):
    a = random_picture(rng, count=1)
    order = torch.from_numpy(rng.permutation(24 * 24))
    shuffled = a.flatten(2)[:, :, order].view_as(a)
    mask = torch.ones(1, 1, 24, 24)
    maps = losses.masked_features(as_is, a, shuffled, mask, mask)
    assert float(losses.style_statistics(*maps, mask, mask, kind=kind)) < 1e-10
    assert float(losses.style_aligned(*maps, mask)) > 0.05


@KINDS
def test_statistics_lead_to_the_target_and_look_only_inside_the_masks(rng, kind):
    """Descending along the gradient brings another picture's features near; what lies outside has none."""
    target, leaf = random_picture(rng, count=2) * 0.3 + 0.6, random_picture(rng, count=2).requires_grad_()
    mask = torch.zeros(2, 1, 24, 24)
    mask[..., 4:20, 6:24] = 1
    found = []
    for _ in range(60):
        maps, wanted = losses.masked_features(as_is, leaf, target, mask, mask)
        loss = losses.style_statistics(maps, wanted, mask, mask, kind=kind, rng=np.random.default_rng(1))
        (slope,) = torch.autograd.grad(loss, leaf)
        assert bool((slope[(mask == 0).expand_as(leaf)] == 0).all())
        found.append(float(loss.detach()))
        leaf = (leaf - 0.02 * slope / slope.abs().max()).detach().requires_grad_()
    assert found[-1] < 0.2 * found[0]


def test_mean_and_deviation_by_hand():
    maps = torch.tensor([[1.0, 3.0], [2.0, 2.0]]).view(1, 2, 1, 2)
    wanted = torch.tensor([[4.0, 4.0], [1.0, 3.0]]).view(1, 2, 1, 2)
    mask = torch.ones(1, 1, 1, 2)
    # means 2, 2 against 4, 2; deviations 1, 0 against 0, 1; the target's mean squares are 16 and 5.
    value = losses.style_statistics([maps], [wanted], mask, mask, kind="mean-std")
    assert float(value) == pytest.approx((4 + 0 + 1 + 1) / 4 / 10.5, rel=1e-4)


def test_gram_by_hand():
    maps = torch.tensor([1.0, 2.0, 3.0, 4.0]).view(1, 2, 1, 2)  # pixels (1, 3) and (2, 4)
    expected = torch.tensor([[[2.5, 5.5], [5.5, 12.5]]])
    torch.testing.assert_close(losses.gram(maps, torch.ones(1, 1, 1, 2)), expected)
    first = losses.gram(maps, torch.tensor([[[[1.0, 0.0]]]]))
    torch.testing.assert_close(first, torch.tensor([[[1.0, 3.0], [3.0, 9.0]]]))


def test_light_leaves_no_trace_in_a_picture_without_light(rng):
    strokes = 0.5 + 0.1 * torch.from_numpy(rng.standard_normal((1, 1, 96, 96)).astype(np.float32))
    shade = torch.linspace(0.4, 1.6, 96).expand(1, 1, 96, 96)
    mask = torch.ones(1, 1, 96, 96)
    flat, lit = (losses.without_light(p, mask, 6.0) for p in (strokes, strokes * shade))
    inner = (flat - lit)[..., 8:-8, 8:-8]
    # The blur of the ramp is the ramp itself; what is left is its product with the strokes' own mean over 6 pixels.
    assert float(inner.std()) < 0.02 < 0.15 < float(flat.std())
    standard = losses.without_light(strokes * 3, mask, 6.0, standard=True)
    assert float(losses.deviation(standard, mask)) == pytest.approx(1, abs=1e-4)
    faint = losses.without_light(0.5 + (strokes - 0.5) * 1e-3, mask, 6.0, standard=True)
    assert float(faint.std()) < 0.05


def plane(size=64, width=0.5):
    """A plane z = 0 that faces +z, seen straight on: x to the right, y down the picture."""
    at = (torch.arange(size) + 0.5) / size * width
    y, x = torch.meshgrid(-at, at, indexing="ij")
    position = torch.stack([x, y, torch.zeros_like(x)])[None]
    normal = torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1).expand(1, 3, size, size)
    return x, position, normal


def test_strokes_are_shaded_like_the_relief_they_stand_for():
    """On a plane with height h(x) Lambert's factor is 1 - l_x h'(x) / l_z, h' having the asked root mean square."""
    x, position, normal = plane()
    strokes = torch.sin(x * 40).view(1, 1, 64, 64)
    light = torch.tensor([[0.6, 0.0, 0.8]])
    shading, valid = losses.stroke_shading(strokes, position, normal, light, torch.ones(1, 1, 64, 64), 0.1)
    slope = torch.cos(x * 40)
    inside = valid[0, 0] > 0
    slope = slope * (0.1 / slope[inside].square().mean().sqrt())
    expected = -0.6 / 0.8 * slope
    # Central differences shorten a wave of 20 pixels by 2 %.
    assert float((shading[0, 0] - expected)[inside].abs().max()) < 0.006
    assert int(inside.sum()) == 62 * 62


def test_the_light_from_the_other_side_turns_the_shading_around():
    x, position, normal = plane()
    strokes = torch.sin(x * 40).view(1, 1, 64, 64)
    mask = torch.ones(1, 1, 64, 64)
    left, right = (
        losses.stroke_shading(strokes, position, normal, torch.tensor([[side * 0.6, 0.0, 0.8]]), mask, 0.1)[0]
        for side in (-1, 1)
    )
    torch.testing.assert_close(left, -right)
    grazing = torch.tensor([[0.99, 0.0, 0.14]])
    assert float(losses.stroke_shading(strokes, position, normal, grazing, mask, 0.1)[1].sum()) == 0


def test_adaptive_weight_falls_with_texture(rng):
    flat, ramp = np.full((8, 8, 3), 0.5, np.float32), np.zeros((8, 8, 3), np.float32)
    ramp[:] = (np.arange(8) * 0.1)[None, :, None]
    assert losses.mean_gradient(flat) == 0
    # 0.1 across (56 pairs), 0 down (56 pairs).
    assert losses.mean_gradient(ramp) == pytest.approx(0.05)
    masked = np.zeros((8, 8), bool)
    masked[0] = True
    assert losses.mean_gradient(ramp, masked) == pytest.approx(0.1)
    assert losses.adaptive_tv_weight(0, 2.0) == 2.0
    assert losses.adaptive_tv_weight(losses.REFERENCE_GRADIENT, 2.0) == 1.0


def test_crops_stay_inside_and_look_at_the_object(rng):
    masks = [np.zeros((200, 300), bool) for _ in range(2)]
    masks[0][150:190, 20:60] = True
    masks[1][20:180, 100:250] = True
    crops = [c for _ in range(40) for c in losses.sample_crops(rng, masks, 2, 64, (0.5, 1.5), views=[0, 1])]
    assert {c.view for c in crops} == {0, 1}
    assert all(0 <= c.x and c.x + c.width <= 300 and 0 <= c.y and c.y + c.width <= 200 for c in crops)
    widths = np.array([c.width for c in crops])
    assert (widths[::2] == widths[1::2]).all() and widths.min() < 45 and widths.max() > 80
    big = [c for c in crops if c.view == 1]
    shares = [masks[1][int(c.y) : int(c.y + c.width), int(c.x) : int(c.x + c.width)].mean() for c in big]
    assert np.mean(np.array(shares) > 0.35) > 0.95
    again = losses.sample_crops(np.random.default_rng(3), masks, 4, 64)
    assert again == losses.sample_crops(np.random.default_rng(3), masks, 4, 64)


def test_a_crop_is_bilinear_at_pixel_centres(rng):
    y, x = np.mgrid[:40, :50] + 0.5
    picture = torch.from_numpy(np.stack([x, y]).astype(np.float32))
    crop = losses.Crop(0, 7.3, 11.6, 20.0)
    window = losses.crop_picture(picture, crop, 32)
    expected = 7.3 + (torch.arange(32) + 0.5) / 32 * 20
    torch.testing.assert_close(window[0, 5], expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(window[1, :, 5], expected + 4.3, atol=1e-4, rtol=0)
    whole = random_picture(rng, count=1)[0]
    torch.testing.assert_close(losses.crop_picture(whole, losses.Crop(0, 0, 0, 24), 24), whole, atol=1e-6, rtol=0)


def test_colour_curves_agree_with_the_array_ones(rng):
    values = rng.random(1000).astype(np.float32)
    there = losses.srgb_from_linear(torch.from_numpy(values))
    np.testing.assert_allclose(there.numpy(), image.srgb_from_linear(values), atol=1e-6)
    np.testing.assert_allclose(losses.linear_from_srgb(there).numpy(), values, atol=1e-6)
    colours = rng.random((1, 3, 4, 4)).astype(np.float32)
    grey = losses.luminance(torch.from_numpy(colours))[0, 0].numpy()
    np.testing.assert_allclose(grey, image.luminance(colours[0].transpose(1, 2, 0)), atol=1e-6)
