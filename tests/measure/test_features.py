"""The filter bank by closed forms and symmetries, VGG against torch's own layers."""

import json

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from mistyle.core.errors import InputRefused
from mistyle.measure import features
from mistyle.measure.features import SOFTNESS, filter_bank, load_features
from mistyle.measure.losses import style_aligned, style_statistics
from tests.support.helpers import data


def picture(rng, channels=3, size=32, count=2):
    return torch.from_numpy(rng.random((count, channels, size, size)).astype(np.float32))


def polarities(maps):
    """The two rectified polarities, 8 maps each, of a level of the bank, which keeps them turned by 45 degrees."""
    response, size = maps[:, :8], maps[:, 8:16]
    return torch.cat([size + response, size - response], dim=1) * 0.5**0.5


def plain_bank(image):
    """The bank with rectified maps, written out and differentiated by torch."""
    functional = nn.functional
    kernels = features._kernels(image.device, image.dtype)
    planes = features._opponent(image)
    levels = [planes := features._half(planes) if level else planes for level in range(features.LEVELS)]
    padded = [functional.pad(p, (3, 3, 3, 3), mode="replicate") for p in levels]
    responses = [functional.conv2d(p[:, :1], kernels) for p in padded]
    energy = [(r[:, :4].square() + r[:, 4:].square() + 2 * SOFTNESS**2).sqrt() for r in responses]
    maps = []
    for level, (p, r) in enumerate(zip(padded, responses, strict=True)):
        size = (r.square() + SOFTNESS**2).sqrt()
        parts = [0.5 * (size + r), 0.5 * (size - r)]
        if level + 1 < features.LEVELS:
            coarser = functional.interpolate(energy[level + 1], size=r.shape[2:], mode="bilinear")
            parts.append((energy[level] * coarser).sqrt())
        parts.append(features.LOW_SCALE * levels[level])
        parts += [functional.conv2d(p[:, c : c + 1], kernels[[0, 2]]) for c in range(1, p.shape[1]) if level]
        maps.append(torch.cat(parts, dim=1))
    return maps


@pytest.mark.parametrize("channels", [1, 3])
def test_the_bank_measures_as_its_plain_twin_does(rng, channels):
    """Aligned and Gram distances and their gradients are those of the rectified maps, differentiated by torch."""
    image, other = picture(rng, channels, 48).double(), picture(rng, channels, 48).double()
    mask = torch.ones(2, 1, 48, 48, dtype=torch.float64)
    found = []
    for bank in (filter_bank, plain_bank):
        leaf = image.clone().requires_grad_()
        maps, wanted = bank(leaf), bank(other)
        values = style_aligned(maps, wanted, mask), style_statistics(maps, wanted, mask, mask)
        slopes = [torch.autograd.grad(v, leaf, retain_graph=True)[0] for v in values]
        found.append((torch.stack(values).detach(), *slopes))
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-15)


def test_sizes_halve_and_grey_lacks_only_the_colour_maps(rng):
    maps, grey = filter_bank(picture(rng, 3, 64)), filter_bank(picture(rng, 1, 64))
    assert [m.shape[2] for m in maps] == [64, 32, 16, 8]
    assert [m.shape[1] for m in maps] == [23, 27, 27, 23]
    assert [m.shape[1] for m in grey] == [21, 21, 21, 17]


def test_a_flat_picture_has_no_detail():
    for maps in filter_bank(torch.full((1, 1, 32, 32), 0.4)):
        oriented, low = polarities(maps), maps[:, -1:]
        # The rectifier is rounded: it gives half of SOFTNESS at rest.
        torch.testing.assert_close(oriented, torch.full_like(oriented, SOFTNESS / 2), atol=1e-5, rtol=0)
        torch.testing.assert_close(low, torch.full_like(low, 0.4 * features.LOW_SCALE))


def test_the_odd_filter_measures_slope_and_the_even_one_curvature():
    x = torch.arange(32.0)
    kernels = features._kernels(torch.device("cpu"), torch.float64)[:, 0]
    offsets = torch.arange(-3.0, 4.0, dtype=torch.float64)
    column = offsets.expand(7, 7)
    # sum k(x) x over the window: slope per pixel, times the scale; the window of 3 sigma cuts off 3 % of the moment.
    assert float((kernels[0] * column).sum()) == pytest.approx(features.ODD_SCALE, rel=0.03)
    assert float(kernels[4].sum()) == pytest.approx(0, abs=1e-12)
    # A bright ridge answers positively, a valley negatively, and a ramp not at all.
    ramp = polarities(filter_bank((x / 64).expand(1, 1, 32, 32))[0])[0, :, 16, 16]
    assert float(ramp[0] - ramp[8]) == pytest.approx(features.ODD_SCALE / 64, rel=0.03)
    assert float(ramp[4] - ramp[12]) == pytest.approx(0, abs=1e-5)
    ridge = torch.exp(-((x - 16) ** 2) / 4).expand(1, 1, 32, 32)
    up, down = (polarities(filter_bank(p)[0])[0, :, 16, 16] for p in (ridge, -ridge))
    assert float(up[4]) > 0.5 > 0.05 > float(up[12])
    assert float(down[12]) == pytest.approx(float(up[4]))


def test_turning_the_picture_turns_the_orientations(rng):
    image = picture(rng, 1, 33, 1)
    level = filter_bank(image)[0]
    turned = torch.rot90(filter_bank(torch.rot90(image, 1, (2, 3)))[0], -1, (2, 3))
    even, even_turned = level[:, 4:8], turned[:, 4:8]
    torch.testing.assert_close(even_turned, even[:, [2, 3, 0, 1]], atol=1e-5, rtol=1e-4)


def test_gradient_reaches_every_pixel_even_from_a_flat_start():
    """A rectifier with a corner at zero would leave a flat render without a direction to go."""
    image = torch.full((1, 1, 16, 16), 0.5, requires_grad=True)
    wanted = filter_bank(torch.linspace(0, 1, 16).expand(1, 1, 16, 16))
    torch.stack([(a - b).square().mean() for a, b in zip(filter_bank(image), wanted, strict=True)]).sum().backward()
    assert bool((image.grad != 0).all())


def torchvision_like(widths):
    """nn.Sequential in the order of torchvision's vgg19().features, with fewer channels."""
    layers, channels = [], 3
    for width in widths:
        if width == "M":
            layers.append(nn.MaxPool2d(2))
        else:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return nn.Sequential(*layers)


def test_torchvision_weights_give_torchvisions_features(rng, tmp_path):
    torch.manual_seed(0)
    model = torchvision_like([4, 4, "M", 6, 6, "M", 8, 8, 8, 8, "M", 10])
    path = tmp_path / "vgg.pth"
    torch.save({f"features.{k}": v for k, v in model.state_dict().items()}, path)
    image = picture(rng)
    mean, std = torch.tensor(features.IMAGENET_MEAN).view(3, 1, 1), torch.tensor(features.IMAGENET_STD).view(3, 1, 1)
    x, expected = (image - mean) / std, []
    for n, layer in enumerate(model):
        x = layer(x)
        if n in (1, 6, 11, 20):  # relu1_1, 2_1, 3_1, 4_1
            expected.append(x)
    maps = load_features(path)(image)
    assert len(maps) == 4
    for a, b in zip(maps, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)


def test_safetensors_are_read_without_the_package(rng, tmp_path):
    model = torchvision_like([4])
    header, blob = {}, b""
    for name, value in model.state_dict().items():
        raw = value.numpy().tobytes()
        header[name] = {"dtype": "F32", "shape": list(value.shape), "data_offsets": [len(blob), len(blob) + len(raw)]}
        blob += raw
    text = json.dumps(header).encode()
    path = tmp_path / "vgg.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text + blob)
    torch.save(model.state_dict(), tmp_path / "vgg.pth")
    image = picture(rng)
    torch.testing.assert_close(load_features(path)(image)[0], load_features(tmp_path / "vgg.pth")(image)[0])
    path.write_bytes(len(text).to_bytes(8, "little") + text + blob[:-8])
    with pytest.raises(InputRefused, match="outside the file"):
        load_features(path)


def test_normalised_weights_pad_by_reflection(rng, tmp_path):
    torch.manual_seed(1)
    entry, first, second, third = nn.Conv2d(3, 3, 1), nn.Conv2d(3, 4, 3), nn.Conv2d(4, 4, 3), nn.Conv2d(4, 6, 3)
    state = {}
    for n, layer in ((0, entry), (2, first), (5, second), (9, third)):
        state |= {f"{n}.weight": layer.weight.detach(), f"{n}.bias": layer.bias.detach()}
    torch.save(state, tmp_path / "n.pth")
    image = picture(rng)
    pad = nn.ReflectionPad2d(1)
    one = torch.relu(first(pad(entry(image))))
    two = torch.relu(third(pad(nn.functional.max_pool2d(torch.relu(second(pad(one))), 2))))
    maps = load_features(tmp_path / "n.pth")(image)
    torch.testing.assert_close(maps[0], one, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(maps[1], two, atol=1e-5, rtol=1e-4)


def test_real_normalised_vgg_has_activations_of_order_one():
    extract = load_features(data("weights/vgg19_normalised_relu3_1.pth"))
    painting = cv2.imread(str(data("styles/great_wave.jpg")))[:256, :256, ::-1].astype(np.float32) / 255
    maps = extract(torch.from_numpy(painting.transpose(2, 0, 1).copy())[None])
    assert [m.shape[1] for m in maps] == [64, 128, 256]
    # Li et al. scaled every layer to a mean activation of 1 over ImageNet.
    assert all(0.3 < float(m.mean()) < 3 for m in maps)


@pytest.mark.parametrize(
    "state, message",
    [
        ({"classifier.weight": torch.zeros(3)}, "no layer"),
        ({"0.weight": torch.zeros(4, 3, 5, 5), "0.bias": torch.zeros(4)}, "expected a 3x3"),
        ([1, 2], "expected a dictionary"),
    ],
)
def test_other_weights_are_refused(tmp_path, state, message):
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(InputRefused, match=message):
        load_features(tmp_path / "w.pth")


def test_files_that_are_no_weights_are_refused(tmp_path):
    (tmp_path / "w.pth").write_bytes(b"no weights")
    for name, message in (("w.pth", "cannot be read"), ("missing.pth", "no such file")):
        with pytest.raises(InputRefused, match=message):
            load_features(tmp_path / name)
