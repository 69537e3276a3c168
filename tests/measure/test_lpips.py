"""LPIPS-squeeze: the backbone against the published layers, the distance against its formula, real weights by order."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn

from mistyle.core.errors import InputRefused
from mistyle.core.image import gaussian
from mistyle.measure.lpips import SCALE, SHIFT, TAPS, load_lpips, taps
from tests.support.helpers import data

FULL = np.ones((64, 64), bool)


class Fire(nn.Module):
    """Iandola et al. 2016, in torchvision's names."""

    def __init__(self, channels: int, few: int, many: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, few, 1)
        self.expand1x1 = nn.Conv2d(few, many, 1)
        self.expand3x3 = nn.Conv2d(few, many, 3, padding=1)

    def forward(self, x):
        x = torch.relu(self.squeeze(x))
        return torch.cat([torch.relu(self.expand1x1(x)), torch.relu(self.expand3x3(x))], 1)


def published() -> nn.Sequential:
    """`features` of SqueezeNet 1.1 as its authors list it."""
    pool = [nn.MaxPool2d(3, 2, ceil_mode=True) for _ in range(3)]
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool[0]),
        *(Fire(64, 16, 64), Fire(128, 16, 64), pool[1]),
        *(Fire(128, 32, 128), Fire(256, 32, 128), pool[2]),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    )


@pytest.fixture
def files(tmp_path):
    """Random weights of both networks, in the two formats that the published ones come in."""
    torch.manual_seed(0)
    net = published()
    np.savez(tmp_path / "net.npz", **{f"features.{k}": v.numpy() for k, v in net.state_dict().items()})
    heads = {f"lin{k}.model.1.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(TAPS.values())}
    torch.save(heads, tmp_path / "heads.pth")
    return net, heads, tmp_path


def pictures(rng, size=64) -> tuple[np.ndarray, np.ndarray]:
    a = rng.random((size, size, 3)).astype(np.float32)
    return a, np.clip(a + 0.3 * rng.normal(size=a.shape).astype(np.float32), 0, 1)


def test_the_published_network_has_as_many_weights_as_its_authors_say():
    """1,235,496 with the classifier of 512 x 1000 + 1000."""
    assert sum(p.numel() for p in published().parameters()) == 1_235_496 - 513_000


def test_taps_are_those_of_the_published_network(files, rng):
    net, _, _ = files
    image = torch.from_numpy(rng.random((2, 3, 71, 64)).astype(np.float32))
    shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))
    x, wanted = (2 * image - 1 - shift) / scale, []
    for layer, module in enumerate(net):
        x = module(x)
        if layer in TAPS:
            wanted.append(x)
    found = taps({k: v for k, v in net.state_dict().items()}, image)
    assert [f.shape[1] for f in found] == [64, 128, 256, 384, 384, 512, 512]
    for mine, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(mine, theirs)


def test_the_distance_is_the_papers_formula(files, rng):
    """sum over taps of the mean over places of sum_c w_c (x_c / |x| - y_c / |y|)²."""
    net, heads, folder = files
    distance = load_lpips(folder / "net.npz", folder / "heads.pth")
    a, b = pictures(rng)
    pair = torch.from_numpy(np.stack([a, b])).permute(0, 3, 1, 2)
    total = 0.0
    for k, x in enumerate(taps(net.state_dict(), pair)):
        x = x.detach().numpy().astype(np.float64)
        unit = x / np.linalg.norm(x, axis=1, keepdims=True).clip(1e-10)
        weight = heads[f"lin{k}.model.1.weight"].numpy().reshape(-1, 1, 1)
        total += (weight * (unit[0] - unit[1]) ** 2).sum(axis=0).mean()
    assert distance(a, b, FULL) == pytest.approx(total, rel=1e-4)


def test_equal_pictures_symmetry_and_masks(files, rng):
    _, _, folder = files
    distance = load_lpips(folder / "net.npz", folder / "heads.pth")
    a, b = pictures(rng)
    assert distance(a, a, FULL) == 0
    assert distance(a, b, FULL) == pytest.approx(distance(b, a, FULL), rel=1e-5)
    left = FULL.copy()
    left[:, 32:] = False
    half = a.copy()
    half[:, 32:] = b[:, 32:]
    assert distance(a, half, left) == 0, "what is outside the mask does not count"
    assert distance(a, b, left) > 0
    assert np.isnan(distance(a, b, ~FULL))


def test_other_weights_are_refused(files, tmp_path):
    _, heads, folder = files
    with pytest.raises(InputRefused, match=r"features\.0.*SqueezeNet 1\.1"):
        load_lpips(folder / "heads.pth", folder / "heads.pth")
    with pytest.raises(InputRefused, match=r"lin0.*heads"):
        load_lpips(folder / "net.npz", folder / "net.npz")
    (tmp_path / "broken.npz").write_bytes(b"PK no archive")
    with pytest.raises(InputRefused, match="cannot be read"):
        load_lpips(tmp_path / "broken.npz", folder / "heads.pth")
    heads["lin3.model.1.weight"] = torch.rand(1, 100, 1, 1)
    torch.save(heads, tmp_path / "wrong.pth")
    with pytest.raises(InputRefused, match=r"lin3.*\(1, 100, 1, 1\)"):
        load_lpips(folder / "net.npz", tmp_path / "wrong.pth")


def test_published_weights_order_distortions_as_eyes_do():
    """More noise and more blur are farther; a blur is farther than a faint tint of smaller, equal or larger RMSE."""
    weights = (data("weights/squeezenet1_1_torchvision_fp16.npz"), data("weights/lpips_v0.1_squeeze_heads.pth"))
    distance = load_lpips(*weights)
    from PIL import Image

    with Image.open(data("styles/starry_night.jpg")) as opened:
        a = np.asarray(opened.convert("RGB").crop((300, 300, 556, 556)), np.float32) / 255
    mask = np.ones(a.shape[:2], bool)
    rng = np.random.default_rng(0)
    noise = rng.normal(size=a.shape).astype(np.float32)
    noisy = [distance(a, np.clip(a + s * noise, 0, 1), mask) for s in (0, 0.02, 0.05, 0.1, 0.2)]
    blurred = [distance(a, gaussian(a, s), mask) for s in (0, 1, 2, 4, 8)]
    for row in (noisy, blurred):
        assert row[0] == 0 and all(x < y for x, y in pairwise(row))
    blur = gaussian(a, 2)
    rmse = float(np.sqrt(((a - blur) ** 2).mean()))
    tinted = np.clip(a + rmse, 0, 1)
    assert distance(a, tinted, mask) < 0.5 * distance(a, blur, mask)
