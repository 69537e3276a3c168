"""The texture inpainter: position maps, the plan for large atlases, what each condition does, what is written where."""

import numpy as np
import pytest
import torch

from mistyle.atlas.texels import rasterise
from mistyle.core.errors import EnvironmentMissing
from mistyle.core.maps import Texels, flat_maps
from mistyle.core.mesh import Mesh
from mistyle.stylization.diffusion.settings import LIGHTING, ModelSettings, Paint3dSettings
from mistyle.stylization.inpaint import paint3d
from mistyle.stylization.inpaint import paint3d_plan as plan
from mistyle.stylization.inpaint.repair import repair
from mistyle.stylization.inpaint.settings import RepairSettings
from tests.support import tiny_models

torch.set_num_threads(1)
SETTINGS = Paint3dSettings(size=32, overlap=8, steps=2)


def mesh() -> Mesh:
    """Two triangles in space on two islands, one above the other in the atlas."""
    positions = np.array([[-1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -0.5, 0.5]], np.float32)
    faces = np.array([[0, 1, 2], [3, 4, 0]])
    uvs = np.array([[[0.05, 0.55], [0.95, 0.55], [0.5, 0.95]], [[0.05, 0.05], [0.95, 0.05], [0.5, 0.45]]], np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (2, 3, 1))
    return Mesh(positions, faces, normals, uvs, np.zeros(2, np.int64), ("a",))


def texels(size: int = 32) -> Texels:
    """Two rectangles of texels, left red, right blue country, with a gap between them."""
    covered = np.zeros((size, size), bool)
    island = np.full((size, size), -1)
    half = size // 2
    for k, columns in enumerate((slice(1, half - 1), slice(half + 1, size - 1))):
        covered[1 : size - 1, columns] = True
        island[1 : size - 1, columns] = k
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    position = np.where(covered[..., None], np.stack([x, -y, x * y], -1), 0).astype(np.float32)
    normal = np.where(covered[..., None], [0, 0, 1], 0).astype(np.float32)
    return Texels(position, normal, covered, island, np.where(covered, 0, -1))


def middle(size: int = 32) -> np.ndarray:
    """A hole across both islands."""
    hole = np.zeros((size, size), bool)
    hole[size // 4 : size // 2, size // 4 : -size // 4] = True
    return hole & texels(size).covered


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((20, 30, 3)).astype(np.float32)


def settings(**more) -> ModelSettings:
    return ModelSettings(**({"folder": tiny_models.folder(), "device": "cpu"} | more))


@pytest.fixture(scope="module")
def brushes() -> dict[str, paint3d.Brush]:
    return {
        recipe: paint3d.load(settings(), SETTINGS.model_copy(update={"recipe": recipe}), picture())
        for recipe in paint3d.RECIPES
    }


@pytest.fixture(scope="module")
def plain(brushes) -> dict[str, np.ndarray]:
    """What each recipe answers."""
    return {recipe: answer(brush) for recipe, brush in brushes.items()}


@pytest.mark.parametrize("recipe", list(paint3d.RECIPES))
@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_half_precision_paints_what_float32_paints(plain, recipe, precision):
    """The VAE stays float32 while the pipeline hands it the network's type."""
    chosen = SETTINGS.model_copy(update={"recipe": recipe, "precision": precision})
    half = paint3d.load(settings(), chosen, picture())
    assert half.pipeline.vae.dtype == torch.float32 and half.pipeline.unet.dtype == getattr(torch, precision)
    seen = answer(half)
    assert np.isfinite(seen).all() and np.abs(seen - plain[recipe]).mean() < 0.05


def test_ddim_never_clips_latents(brushes, tmp_path):
    folder = tiny_models.copy_without(tmp_path / "models")
    tiny_models.edit_json(folder / "inpaint" / "scheduler" / "scheduler_config.json", clip_sample=True)
    made = paint3d.load(settings(folder=folder), SETTINGS, picture())
    assert made.pipeline.scheduler.config.clip_sample is False


def test_position_map_is_paint3ds():
    m = mesh()
    centre, radius = plan.centre_and_radius(m)
    np.testing.assert_allclose(centre, [0, 0.1, 0.3], atol=1e-6)
    assert radius == pytest.approx(np.sqrt(1 + 0.01 + 0.09))
    t = rasterise(m, 0, 64)
    where = plan.position_map(t, centre, radius)
    placed = (t.position[t.covered] - centre) / radius * 0.6 + [0, 0.25, 0]
    expected = (placed / 2 + 0.5) * 255
    levels = where[t.covered] * 255
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-4, err_msg="eight bits")
    # Cut off, not rounded: never above, less than a step below.
    assert (levels <= expected + 1e-3).all() and (levels > expected - 1 - 1e-3).all()
    assert not where[~t.covered].any()


def test_position_map_lies_in_the_range_of_its_training_and_stands_upright():
    ball = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    t = texels(64)
    position = np.where(t.covered[..., None], ball[np.arange(64 * 64) % 5000].reshape(64, 64, 3), 0)
    t = Texels(position.astype(np.float32), t.normal, t.covered, t.island, t.face)
    where = plan.position_map(t, np.zeros(3, np.float32), 1.0)[t.covered]
    assert where[:, [0, 2]].min() >= 0.2 - 1 / 255 and where[:, [0, 2]].max() <= 0.8
    assert where[:, 1].min() >= 0.325 - 1 / 255 and where[:, 1].max() <= 0.925
    m = mesh()
    upper = plan.position_map(rasterise(m, 0, 64), *plan.centre_and_radius(m))[:30]
    rows = np.flatnonzero(upper.any(axis=(1, 2)))
    assert upper[rows[0], :, 1].max() > upper[rows[-1], :, 1].max(), "v points up: the apex (y = 1) is in the top rows"


def test_scale_and_height_can_be_set():
    m = mesh()
    t, (centre, radius) = rasterise(m, 0, 32), plan.centre_and_radius(m)
    near, far = (plan.position_map(t, centre, radius, s, h) for s, h in ((0.6, 0.25), (0.3, 0.0)))
    assert np.ptp(far[t.covered], axis=0)[0] == pytest.approx(np.ptp(near[t.covered], axis=0)[0] / 2, abs=0.01)


@pytest.mark.parametrize(("size", "overlap"), [(32, 8), (32, 0), (24, 12), (64, 16)])
def test_crops_see_every_hole_with_its_surroundings(rng, size, overlap):
    hole = np.zeros((100, 120), bool)
    for _ in range(12):
        r, c = rng.integers(0, 95), rng.integers(0, 115)
        hole[r : r + 5, c : c + 5] = True
    depth = np.zeros(hole.shape)
    places = plan.crops(hole, size, overlap)
    for r, c in places:
        assert 0 <= r <= 100 - size and 0 <= c <= 120 - size
        box = slice(r, r + size), slice(c, c + size)
        y, x = np.mgrid[r : r + size, c : c + size]
        sides = [
            np.where(r > 0, y - r, size),
            np.where(c > 0, x - c, size),
            np.where(r + size < 100, r + size - 1 - y, size),
            np.where(c + size < 120, c + size - 1 - x, size),
        ]
        depth[box] = np.maximum(depth[box], np.min(sides, axis=0) + 1)
    assert (depth[hole] > overlap // 2).all()
    assert len(places) < 0.7 * hole.sum() and not plan.crops(np.zeros((100, 100), bool), size, overlap)


def test_a_small_atlas_is_one_crop():
    assert plan.crops(np.ones((20, 20), bool), 32, 8) == [(0, 0)]


def test_no_colour_crosses_islands_on_the_way_up():
    """A small atlas, red and blue with green between, spread over a large one: each island keeps its own colour."""
    t = texels(64)
    small = np.zeros((16, 16, 3), np.float32)
    small[:, :8], small[:, 8:] = [1, 0, 0], [0, 0, 1]
    labels = plan.sampled(t.island, (16, 16))
    small[labels < 0] = [0, 1, 0]
    hole = middle(64)
    result = plan.spread_islands(small, t, hole, np.zeros((64, 64, 3), np.float32))
    for k, colour in enumerate(([1, 0, 0], [0, 0, 1])):
        assert np.abs(result[hole & (t.island == k)] - colour).max() < 1e-6
    assert not result[~hole].any()


def test_spreading_a_smooth_picture_gives_it_back():
    t = texels(64)
    ramp = np.repeat(((np.arange(64) + 0.5) / 64)[:, None], 64, axis=1)[..., None].repeat(3, -1).astype(np.float32)
    small = plan.shrink(ramp, (16, 16))
    result = plan.spread_islands(small, t, middle(64), np.zeros_like(ramp))
    np.testing.assert_allclose(result[middle(64)], ramp[middle(64)], atol=2e-3)


def test_an_island_smaller_than_a_pixel_keeps_what_it_had():
    t = texels(64)
    island = t.island.copy()
    island[0, 0] = 2
    tiny = Texels(t.position, t.normal, t.covered | (island == 2), island, t.face)
    hole = island == 2
    result = plan.spread_islands(np.ones((8, 8, 3), np.float32), tiny, hole, np.full((64, 64, 3), 0.25, np.float32))
    assert (result[0, 0] == 0.25).all()


def atlas(size: int = 32) -> np.ndarray:
    t = texels(size)
    colour = np.where(t.island[..., None] == 0, [0.8, 0.2, 0.1], [0.1, 0.2, 0.8])
    return np.where(t.covered[..., None], colour, 0).astype(np.float32)


def answer(brush: paint3d.Brush, size: int = 32, hole=None, where=None, given=None, seed: int = 0) -> np.ndarray:
    t = texels(size)
    where = plan.position_map(t, np.zeros(3, np.float32), 1.5) if where is None else where
    hole = middle(size) if hole is None else hole
    given = atlas(size) if given is None else given
    return paint3d.paint_atlas(brush, given, hole, t, where, np.random.default_rng(seed))


@pytest.mark.parametrize("recipe", list(paint3d.RECIPES))
def test_only_the_hole_is_written(brushes, plain, recipe):
    one, same, other = plain[recipe], *(answer(brushes[recipe], seed=s) for s in (0, 1))
    hole = middle()
    np.testing.assert_array_equal(one[~hole], atlas()[~hole])
    assert np.array_equal(one, same) and np.abs(one - other)[hole].max() > 1e-3
    assert np.abs(one - atlas())[hole].max() > 1e-2 and 0 <= one.min() and one.max() <= 1


@pytest.mark.parametrize("recipe", list(paint3d.RECIPES))
@pytest.mark.parametrize("what", ["position", "position scale", "prompt", "negative", "guidance", "colours"])
def test_each_condition_alone_changes_the_answer(brushes, plain, recipe, what):
    brush = brushes[recipe]
    t, hole = texels(), middle()
    where, given = None, None
    if what == "position":
        where = plan.position_map(t, np.zeros(3, np.float32), 1.5, 0.3, 0.0)
    elif what == "colours":
        given = np.where(hole[..., None], atlas(), atlas()[:, ::-1])
    elif what in ("prompt", "negative"):
        text, negative = brush.pipeline.encode_prompt(
            "a red wave" if what == "prompt" else SETTINGS.prompt,
            "cpu",
            1,
            True,
            negative_prompt="blue" if what == "negative" else LIGHTING,
        )
        brush = paint3d.Brush(brush.pipeline, brush.picture, text, negative, brush.recipe, brush.settings)
    else:
        change = {"position scale": {"position": 0.1}, "guidance": {"guidance": 9.0}}[what]
        chosen = brush.settings.model_copy(update=change)
        brush = paint3d.Brush(brush.pipeline, brush.picture, brush.text, brush.negative, brush.recipe, chosen)
    changed = answer(brush, where=where, given=given)
    assert np.abs(changed - plain[recipe])[hole].max() > 1e-4


def test_the_ip_adapter_hears_the_style_picture(plain):
    other = paint3d.load(settings(), SETTINGS, picture(5))
    assert np.abs(answer(other) - plain["inpaint"])[middle()].max() > 1e-4
    silent = paint3d.load(settings(), SETTINGS.model_copy(update={"style": 0.0}), picture(5))
    deaf = paint3d.load(settings(), SETTINGS.model_copy(update={"style": 0.0}), picture())
    np.testing.assert_array_equal(answer(silent), answer(deaf))


def test_recipes_are_those_of_the_papers(brushes):
    ours, theirs = (paint3d.RECIPES[k] for k in ("inpaint", "paint3d"))
    assert (ours.channels, ours.controls, ours.style) == (9, ("position",), 0.6)
    assert (theirs.channels, theirs.scales, theirs.steps, theirs.guidance) == (4, (1.0, 0.5), 20, 3.0)
    assert type(brushes["paint3d"].pipeline.scheduler).__name__ == "EulerAncestralDiscreteScheduler"
    assert "shadow" in SETTINGS.negative and "light" in SETTINGS.negative
    assert brushes["inpaint"].pipeline.safety_checker is None


def test_paint3ds_inpaint_condition_is_minus_one_under_the_mask(brushes, monkeypatch):
    seen = {}
    brush = brushes["paint3d"]

    class Watched:
        def __call__(self, **given):
            seen.update(given)
            return brush.pipeline(**given)

    watched = paint3d.Brush(Watched(), brush.picture, brush.text, brush.negative, brush.recipe, brush.settings)
    mask = middle()
    where = np.full((32, 32, 3), 0.5, np.float32)
    paint3d.inpaint(watched, atlas(), mask, where, 1.0, np.random.default_rng(0))
    position, rest = seen["control_image"]
    under = seen["mask_image"][0, 0].bool()
    assert (rest[0][:, under] == -1).all() and (rest[0][:, ~under] >= 0).all() and (position == 0.5).all()
    assert under.sum() > mask.sum(), "dilated"
    np.testing.assert_allclose(rest[0].permute(1, 2, 0)[~under].numpy(), atlas()[~under.numpy()], atol=1e-2)


def test_a_large_atlas_is_painted_whole_and_then_in_crops(brushes, monkeypatch):
    calls = []
    original = paint3d.inpaint

    def watched(brush, encoded, mask, where, strength, rng):
        calls.append((encoded.shape[0], strength))
        return original(brush, encoded, mask, where, strength, rng)

    monkeypatch.setattr(paint3d, "inpaint", watched)
    hole = middle(96)
    result = answer(brushes["inpaint"], 96)
    places = plan.crops(hole, 32, 8)
    assert calls == [(32, 1.0)] + [(32, 0.5)] * len(places) and len(places) > 1
    np.testing.assert_array_equal(result[~hole], atlas(96)[~hole])
    calls.clear()
    coarse = answer_with(brushes["inpaint"], detail=0.0)
    assert calls == [(32, 1.0)] and np.abs(coarse - result)[hole].max() > 1e-3


def answer_with(brush: paint3d.Brush, **change) -> np.ndarray:
    chosen = brush.settings.model_copy(update=change)
    changed = paint3d.Brush(brush.pipeline, brush.picture, brush.text, brush.negative, brush.recipe, chosen)
    return answer(changed, 96)


def test_crops_see_positions_that_match_their_place(brushes, monkeypatch):
    seen = []
    t = texels(96)
    where = plan.position_map(t, np.zeros(3, np.float32), 1.5)

    def watched(brush, encoded, mask, part, strength, rng):
        seen.append(part)
        return encoded

    monkeypatch.setattr(paint3d, "inpaint", watched)
    answer(brushes["inpaint"], 96, where=where)
    for (r, c), part in zip(plan.crops(middle(96), 32, 8), seen[1:], strict=True):
        np.testing.assert_array_equal(part, where[r : r + 32, c : c + 32])
    np.testing.assert_array_equal(seen[0], where[1::3, 1::3])


def test_crops_meet_without_a_seam(brushes, monkeypatch):
    """A model that returns what it was given must leave no trace of the crops' borders."""
    monkeypatch.setattr(paint3d, "inpaint", lambda brush, encoded, *rest: encoded)
    t, hole = texels(96), middle(96)
    result = answer(brushes["inpaint"], 96)
    for k in (0, 1):
        inside = result[hole & (t.island == k)]
        np.testing.assert_allclose(inside, np.broadcast_to(atlas(96)[t.island == k][0], inside.shape), atol=1e-5)


def test_behind_the_inpainter_signature_the_edge_is_blended(brushes):
    m = mesh()
    t = rasterise(m, 0, 32)
    paint = paint3d.inpainter(m, picture(), settings(), SETTINGS)
    maps = flat_maps(32, albedo=0.3)
    mask = np.zeros((32, 32), bool)
    mask[5:12, 10:20] = True
    done = repair(maps, mask & t.covered, t, paint, RepairSettings(blend=0.05), np.random.default_rng(0))
    outside = np.ones((32, 32), bool)
    outside[2:15, 7:23] = False
    np.testing.assert_array_equal(done.albedo[outside], maps.albedo[outside])
    assert np.abs(done.albedo - maps.albedo)[mask & t.covered].max() > 1e-3


@pytest.mark.parametrize(
    ("file", "change", "match"),
    [
        ("inpaint/unet", {"in_channels": 4}, "in_channels is 4, expected 9: this is not an inpainting model"),
        ("position", {"cross_attention_dim": 64}, "not a ControlNet for Stable Diffusion 1.5"),
        ("ip-adapter/models/image_encoder", {"projection_dim": 48}, "not a plain IP-Adapter"),
    ],
)
def test_wrong_architectures_are_refused(tmp_path, file, change, match):
    folder = tiny_models.copy_without(tmp_path / "models")
    tiny_models.edit_json(folder / file / "config.json", **change)
    with pytest.raises(EnvironmentMissing, match=match):
        paint3d.check(settings(folder=folder), SETTINGS)


def test_missing_models_and_memory_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
    folder = tiny_models.copy_without(tmp_path / "models", "position")
    with pytest.raises(EnvironmentMissing, match=r"'position' .*mistyle models fetch position"):
        paint3d.check(settings(folder=folder), SETTINGS)
    paint3d.check(settings(), SETTINGS)
    with pytest.raises(EnvironmentMissing, match=r"inpainting 1024² texels needs about"):
        paint3d.check(settings(memory=0.1), SETTINGS.model_copy(update={"size": 1024}))
