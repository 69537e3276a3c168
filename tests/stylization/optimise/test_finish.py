"""Finishing the painting by VGG-19: gradients against finite differences, places in the painting, what may not change,
the option end to end, and weights in torchvision's layout."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from mistyle.atlas.texels import rasterise
from mistyle.cli.main import main
from mistyle.core.errors import UsageError
from mistyle.core.image import srgb_from_linear
from mistyle.core.maps import flat_maps
from mistyle.jobs.progress import Progress
from mistyle.measure.features import TORCHVISION_CONVOLUTIONS, TORCHVISION_POOLS, load_features
from mistyle.render.deferred import pyramid
from mistyle.render.mitsuba import device
from mistyle.stylization.optimise import finish_style
from mistyle.stylization.optimise.finish import Film, Finishing, PaintedAsset, finish, own_directions, shape_edges
from mistyle.stylization.optimise.finish_settings import FinishSettings
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.pipeline.finishing import check_finish
from mistyle.stylization.pipeline.job import Job
from mistyle.stylization.settings import resolve
from mistyle.stylization.surface.lookup import PaintedSurface, colour
from tests.render.deferred.test_seam import sphere
from tests.stylization.test_pipeline import TINY, hashes, inputs  # noqa: F401

SIZE = 64
QUICK = FinishSettings(method="vgg", steps=3, crops=2, crop_size=64, texels_per_pixel=1)


def vgg19(widths: tuple[int, ...], seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights in torchvision's layout; `widths` are the channels of its five blocks."""
    made, channels, generator = {}, 3, torch.Generator().manual_seed(seed)
    for n in TORCHVISION_CONVOLUTIONS:
        out = widths[sum(n > pool for pool in TORCHVISION_POOLS)]
        made[f"features.{n}.weight"] = (
            torch.randn(out, channels, 3, 3, generator=generator) * (2 / (9 * channels)) ** 0.5
        )
        made[f"features.{n}.bias"] = 0.1 * torch.randn(out, generator=generator)
        channels = out
    made["classifier.0.weight"] = torch.randn(4, 7, generator=generator)
    return made


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "vgg19.pth"
    torch.save(vgg19((4, 6, 8, 8, 8)), path)
    return path


@pytest.fixture(scope="module")
def painting() -> np.ndarray:
    """Stripes of two colours with soft noise, encoded."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:72, :96] / 6
    wave = 0.5 + 0.4 * np.sin(x + 0.5 * y)
    picture = np.stack([wave, 0.3 + 0.3 * wave, 1 - wave], axis=2) + rng.normal(0, 0.02, (72, 96, 3))
    return np.clip(picture, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def painted(painting) -> PaintedAsset:
    """A sphere with pieces of the painting, some turned by quarters."""
    device.use()
    mesh, rng = sphere(24, 12), np.random.default_rng(1)
    texels = rasterise(mesh, 0, SIZE)
    normals = rng.normal(size=(700, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    tangent = np.cross(np.array([0.0, 1.0, 0.0]), normals)
    tangent = (tangent / np.linalg.norm(tangent, axis=1, keepdims=True)).astype(np.float32)
    radius = float(np.linalg.norm(texels.position[texels.covered], axis=1).mean())
    count = len(normals)
    piece = (normals[:, 1] > 0).astype(np.int32)
    centre = np.stack([rng.uniform(20, 76, count), rng.uniform(16, 56, count)], axis=1).astype(np.float32)
    solution = PaintedSurface(
        positions=radius * normals,
        normals=normals,
        tangent=tangent,
        turn=(2 * piece + rng.integers(0, 2, count)).astype(np.int32),
        centre=centre,
        spacing=float(radius * np.sqrt(4 * np.pi / count)),
        scale=(4.0, 4.0),
        painting=painting,
        glaze=np.zeros(count, np.float32),
        piece=np.arange(count, dtype=np.int32),
        crisp=8.0,
        whole_pixels=False,
    )
    albedo = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    at = texels.covered
    encoded = colour(solution, texels.position[at], texels.normal[at])
    albedo[at] = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return PaintedAsset(mesh, (replace(flat_maps(SIZE), albedo=albedo),), (texels,), solution)


@pytest.mark.parametrize("statistic", ["gram", "mean-std", "swd"])
def test_the_gradient_is_that_of_finite_differences(painted, weights, statistic):
    """Along the gradient itself and along a random direction; of style and content together."""
    settings = QUICK.model_copy(update={"statistic": statistic})
    run = Finishing(painted, load_features(weights, 3), settings, 0)
    crops = run.crops(run.rng, run.seen)
    rng = np.random.default_rng(2)
    start = run.table.values["albedo"][crops.taps.texels]
    start = np.clip(start + rng.normal(0, 0.05, start.shape), 0.05, 0.95).astype(np.float32)

    def total(values: np.ndarray, leaf: torch.Tensor | None = None) -> torch.Tensor:
        leaf = torch.from_numpy(np.ascontiguousarray(values, np.float32)) if leaf is None else leaf
        style, content = run.losses(crops, leaf, np.random.default_rng(3))
        return style + content

    def loss(values: np.ndarray) -> float:
        return float(total(values).detach())

    leaf = torch.from_numpy(start).requires_grad_()
    slope = torch.autograd.grad(total(start, leaf), leaf)[0].numpy().astype(np.float64)
    assert np.abs(slope).max() > 0
    ways = (slope / np.linalg.norm(slope), np.sign(slope) * np.abs(rng.normal(size=slope.shape)))
    for way in ways:
        way = way / np.linalg.norm(way)
        found = (loss(start + 0.05 * way) - loss(start - 0.05 * way)) / 0.1
        # Single precision, and kinks of the rectifiers between the two points.
        assert found == pytest.approx(float((slope * way).sum()), rel=0.03)


@pytest.mark.parametrize("bridge", ["frozen", "wrap"])
def test_the_film_shows_the_albedo_alone(painted, weights, bridge):
    """By either bridge: the bilinear albedo, and the gradient of what is seen."""
    from mistyle.render.deferred import torch_bridge

    run = Finishing(painted, load_features(weights, 3), QUICK, 0)
    crops, film = run.crops(run.rng, run.seen), Film(QUICK.crops, QUICK.crop_size, bridge)
    texels = torch.from_numpy(run.table.values["albedo"][crops.taps.texels]).requires_grad_()
    pixels = torch_bridge.fetch(texels, crops.taps)
    shown = film(crops.lit, pixels, True)
    target = pixels.detach().reshape(2, 64, 64, 3).permute(0, 3, 1, 2) * crops.on
    assert torch.allclose(shown * crops.on, target, atol=2e-3)
    (slope,) = torch.autograd.grad((shown * crops.on).sum(), texels)
    plain = torch.from_numpy(crops.taps.matrix.T @ np.repeat(crops.on.numpy().reshape(-1, 1), 3, axis=1))
    assert torch.allclose(slope, plain, rtol=2e-3, atol=2e-3)


def test_pixels_find_their_own_place_in_the_painting(painted):
    """With the picture itself for features, the places show what the surface shows."""
    run = Finishing(painted, lambda image: [image], QUICK.model_copy(update={"content": 0.0}), 0)
    crops = run.crops(run.rng, run.seen)
    target = finish_style.target_features(run.painting, crops.places, 2, 64)[0]
    shown = run.shown(crops, torch.from_numpy(run.table.values["albedo"][crops.taps.texels]))
    half = (target.shape[2] + 63) // target.shape[2]
    assert half == 1 or half == 2
    shown, counts = (maps[:, :, half // 2 :: half, half // 2 :: half] for maps in (shown, crops.counts))
    at = (counts > 0.2).expand_as(shown).numpy()
    assert at.mean() > 0.02
    match = np.corrcoef(shown.numpy()[at], target.numpy()[at])[0, 1]
    flipped = np.corrcoef(shown.numpy()[at], target.flip(3).numpy()[at])[0, 1]
    assert match > 0.8 > flipped


def test_the_style_loss_falls_and_colours_stay(painted, weights):
    """Same bytes twice; less loss on crops that no step used; the mean colour stands still; what is masked stands."""
    covered = painted.texels[0].covered
    free = covered & (painted.texels[0].position[..., 1] > 0)
    soiled = painted.maps[0].albedo + np.random.default_rng(6).normal(0, 0.15, painted.maps[0].albedo.shape)
    maps = replace(painted.maps[0], albedo=np.clip(soiled, 0, 1).astype(np.float32))
    masked = replace(painted, maps=(maps,), only=(free,))
    settings = QUICK.model_copy(update={"steps": 12, "content": 0.0})
    first, again = (finish(masked, load_features(weights, 3), settings, 5) for _ in range(2))
    assert all((a == b).all() for a, b in zip(first.albedo, again.albedo, strict=True))
    assert first.style[1] < first.style[0] and len(first.trace) == 12 and 0 < first.moved < 0.12
    before, after = maps.albedo, first.albedo[0]
    assert np.allclose(before[covered & ~free], after[covered & ~free], atol=1e-6)
    mean = [srgb_from_linear(albedo[free]).mean(axis=0) for albedo in (before, after)]
    assert np.abs(mean[0] - mean[1]).max() < 0.01


def test_several_materials_are_finished_together(painted, weights, monkeypatch):
    """Two texture sets of two sizes: crops across their border move both."""
    monkeypatch.setattr(Finishing, "judged", lambda self: -float(len(self.trace)))
    middle = painted.mesh.positions[painted.mesh.faces].mean(axis=1)[:, 1]
    mesh = replace(painted.mesh, part=(middle > 0).astype(np.int32), parts=("low", "high"))
    sets = (rasterise(mesh, 0, SIZE), rasterise(mesh, 1, SIZE // 2))
    maps = tuple(flat_maps(len(texels.covered)) for texels in sets)
    found = finish(replace(painted, mesh=mesh, maps=maps, texels=sets), load_features(weights, 3), QUICK, 0)
    assert [albedo.shape for albedo in found.albedo] == [(SIZE, SIZE, 3), (SIZE // 2, SIZE // 2, 3)]
    for before, after, texels in zip(maps, found.albedo, sets, strict=True):
        assert np.abs(after - before.albedo)[texels.covered].max() > 1e-3


def test_what_does_not_help_is_undone(painted, weights, monkeypatch):
    monkeypatch.setattr(Finishing, "judged", lambda self: 1.0)
    found = finish(painted, load_features(weights, 3), QUICK, 0)
    assert found.moved == 0 and np.allclose(found.albedo[0], painted.maps[0].albedo, atol=1e-6)


def test_a_woodcut_takes_no_colour(painting):
    grey = np.repeat(painting[..., :1], 3, axis=2)
    kept = own_directions(grey)
    assert np.allclose(kept @ np.ones(3), np.ones(3), atol=0.05)
    assert np.abs(kept @ np.array([1.0, -1.0, 0.0])).max() < 0.01
    assert np.abs(own_directions(painting) @ np.array([1.0, 0.3, -1.0]) - [1, 0.3, -1]).max() < 0.2


def test_edges_of_the_shape_are_where_normals_turn():
    normals = np.zeros((1, 32, 32, 3), np.float32)
    normals[:, :, :16, 0], normals[:, :, 16:, 2] = 1, 1
    found = shape_edges(normals)[0]
    assert found[:, 15:18].min() == 1 and found[:, :8].max() == 0 == found[:, 24:].max()


def test_damping_holds_texels_with_little_gradient():
    gradient = np.full((4, 4, 1), 0.01, np.float32)
    gradient[0, 0] = 1
    plain, damped = (
        pyramid.change(pyramid.start((4, 4, 1), pyramid=False), gradient, 0.1, damping=d)[..., 0] for d in (0.0, 3.0)
    )
    assert np.allclose(plain, -0.1, rtol=1e-3)
    assert damped[0, 0] < 20 * damped[1, 1] < 0


@pytest.mark.parametrize("ending", [".pth", ".safetensors"])
def test_torchvisions_layers_are_chosen_alike(tmp_path, rng, ending):
    """relu1_1, relu2_1 and relu3_1 of a full VGG-19, as torch's own layers compute them."""
    state = vgg19((4, 6, 8, 8, 8))
    path = tmp_path / f"vgg19{ending}"
    if ending == ".pth":
        torch.save(state, path)
    else:
        from safetensors.torch import save_file

        save_file(state, path)
    layers: list[nn.Module] = []
    for n in range(13):
        if n in TORCHVISION_CONVOLUTIONS:
            weight = state[f"features.{n}.weight"]
            layer = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
            layer.load_state_dict({k: state[f"features.{n}.{k}"] for k in ("weight", "bias")})
            layers.append(layer)
        else:
            layers.append(nn.MaxPool2d(2) if n in TORCHVISION_POOLS else nn.ReLU())
    picture = torch.from_numpy(rng.random((1, 3, 32, 32)).astype(np.float32))
    mean, std = (torch.tensor(v).view(1, 3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    x, target = (picture - mean) / std, []
    for n, layer in enumerate(layers):
        x = layer(x)
        if n in (1, 6, 11):
            target.append(x)
    found = load_features(path, 3)(picture)
    assert len(found) == 3 and len(load_features(path)(picture)) == 5
    for a, b in zip(found, target, strict=True):
        assert torch.allclose(a, b, atol=1e-5)


def test_the_option_from_end_to_end(inputs, weights, tmp_path):  # noqa: F811
    """The stage's record, figures, note, picture and key."""
    tiny = TINY | {"fit": {"refine": "off"}, "rig": {"kind": "turntable", "views": 2, "resolution": 32}}
    layers = tiny | {"finish": {"method": "vgg", "steps": 2, "crops": 1, "crop_size": 64, "features": str(weights)}}
    job = Job(inputs[0], inputs[1], tmp_path / "out", resolve("draft", None, layers, {}), "bell")
    pipeline.stylize(job, Progress(quiet=True))
    run = json.loads((job.out / "run.json").read_text())
    assert run["settings"]["finish"]["method"] == "vgg" and run["seconds"]["finish"] > 0
    assert {"finish.style_before", "finish.style_after", "finish.moved"} <= set(run["figures"])
    assert 1 / 1.5 < run["figures"]["light_up_over_down"] < 1.5
    assert any(note.startswith("finish: the style loss") for note in run["notes"])
    assert "Style losses of VGG-19" in (job.out / "report" / "index.html").read_text()
    before = hashes(job.out)
    progress = Progress(quiet=True)
    pipeline.stylize(job, progress)
    assert "finish" in progress.reused and hashes(job.out) == before
    # Without the finish the painting is taken over, and what hangs on it is made anew.
    plain = replace(job, settings=resolve("draft", None, tiny, {}))
    progress = Progress(quiet=True)
    pipeline.stylize(plain, progress)
    assert "bake" in progress.reused and "stylized" not in progress.reused
    assert "finish.moved" not in json.loads((job.out / "run.json").read_text())["figures"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({}, "found no weights of VGG-19"),
        ({"stylizer": "embedded-view"}, "expected the embedded stylizer"),
        ({"paint": {"slots": ["wood=bark.jpg"]}}, "found 2 style pictures; expected one"),
        ({"surface": {"glaze": 0.5}}, "glaze"),
    ],
)
def test_what_cannot_be_finished_is_refused(more, words):
    with pytest.raises(UsageError, match=words):
        check_finish(resolve("draft", None, {"finish": {"method": "vgg"}} | more, {}))


def test_the_plan_counts_the_finish(inputs, weights, tmp_path, capsys):  # noqa: F811
    words = ["stylize", str(inputs[0]), str(inputs[1]), "-o", str(tmp_path / "out"), "--dry-run", "--json"]
    plans = []
    for more in ([], ["--finish", "vgg", "--vgg", str(weights)]):
        assert main([*words, *more]) == 0
        plans.append(json.loads(capsys.readouterr().out))
    stages = [[row["stage"] for row in plan["stages"]] for plan in plans]
    assert "finish" not in stages[0] and stages[1][stages[1].index("bake") + 1] == "finish"
    assert plans[1]["seconds"] > plans[0]["seconds"] and "finish" in plans[1]["peaks_gb"]


def test_help_names_the_option(capsys):
    with pytest.raises(SystemExit):
        main(["stylize", "--help"])
    assert "--finish {off,vgg}" in capsys.readouterr().out
