"""Pictures that are much finer than the texels: averaged once, kept, and fitted to."""

import json

import numpy as np
import pytest

import mistyle
from mistyle.atlas.texels import rasterise
from mistyle.core.camera import Camera, look_at
from mistyle.core.capture import in_memory, shrunk
from mistyle.core.errors import InputRefused
from mistyle.fitting.pipeline.pictures import read_averaged, write_averaged
from mistyle.io.read_mesh import read_mesh
from mistyle.render.deferred import image_samples, renderer
from mistyle.render.deferred.material_table import pack
from mistyle.render.mitsuba import draw
from mistyle.solver.texels import gbuffer as texel_views
from mistyle.solver.validate import LEAST_PIXELS, downsampling_factors
from tests.fitting.test_material import QUICK, bowl, one_by_one, orbit
from tests.render.deferred.test_seam import KEY, SIZES, crop, random_maps, torus
from tests.support.helpers import assert_same


@pytest.fixture(scope="module")
def bowls(tmp_path_factory):
    path = tmp_path_factory.mktemp("bowl") / "bowl.obj"
    bowl(path)
    return path


def above(side: int) -> Camera:
    return look_at((0, 0, 4), fov=30, size=(side, side))


def test_texels_are_left_two_blocks_wide(bowls):
    mesh = read_mesh(bowls, size=64).mesh
    cameras = [above(side) for side in (48, 256, 512)] + [look_at((0, 0, -4), fov=30, size=(512, 512))]
    for size in (32, 128):
        texels = [rasterise(mesh, 0, size)]
        found = downsampling_factors(texels, cameras)
        # The bowl is flat enough, and all but the four units away: 0.96 of the texture's side is its width.
        wide = np.ptp(mesh.positions[:, 0]) / (0.96 * size) * cameras[2].focal / 4
        assert found[2] == pytest.approx(wide / 2, abs=1) and found[2] <= max(1, 1.1 * wide / 2)
        assert found[1] == pytest.approx(found[2] / 2, abs=1)
        assert found[0] == 1  # 48 pixels are few enough
        assert found[3] == 1  # from below nothing faces the camera
    assert downsampling_factors([rasterise(mesh, 0, 2)], cameras[:3]) == [1, 256 // LEAST_PIXELS, 512 // LEAST_PIXELS]


def test_averages_are_kept_with_what_counts(bowls, tmp_path, rng):
    texels = [rasterise(read_mesh(bowls, size=64).mesh, 0, 32)]
    pictures = [rng.random((256, 256, 3)).astype(np.float32) for _ in range(2)]
    counts = [np.ones((256, 256), bool), rng.random((256, 256)) < 0.99]
    captures = in_memory([above(256)] * 2, [()] * 2, pictures, counts)
    write_averaged(tmp_path, texels, captures, 0, lambda done: None)
    found, notes = read_averaged(tmp_path, captures)
    (by, _) = downsampling_factors(texels, captures.cameras)
    small = shrunk(captures, [by, by])
    assert_same(found.cameras, small.cameras)
    assert by > 1 and found.cameras[0].size == (256 // by, 256 // by)
    for k in range(2):
        rgb, mask = found.load(k)
        wanted, counted = small.load(k)
        assert np.array_equal(mask, counted) and np.array_equal(rgb[mask], wanted[mask]) and not rgb[~mask].any()
    assert f"{by} x {by} pixels" in notes[-1] and "2 of 2 pictures" in notes[-1] and "fewer than 3" in notes[0]


def test_pictures_that_are_asked_for_as_they_are_are_not_copied(bowls, tmp_path):
    texels = [rasterise(read_mesh(bowls, size=64).mesh, 0, 8)]
    captures = in_memory([above(256)] * 3, [()] * 3, [np.ones((256, 256, 3), np.float32)] * 3)
    write_averaged(tmp_path, texels, captures, 1, lambda done: None)
    found, notes = read_averaged(tmp_path, captures)
    assert_same(found.cameras, captures.cameras)
    assert notes == () and not list(tmp_path.glob("*.npy"))
    assert found.load(1)[0] is captures.load(1)[0]
    black = in_memory([above(256)] * 3, [()] * 3, [np.zeros((256, 256, 3), np.float32)] * 3)
    with pytest.raises(InputRefused, match="3 pictures that are black"):
        write_averaged(tmp_path / "black", texels, black, 1, lambda done: None)


def test_a_fit_to_fine_pictures(bowls, tmp_path):
    one_by_one(tmp_path / "shots", read_mesh(bowls, size=64).mesh, orbit(8, 0.55, 240))
    summary = mistyle.fit(
        bowls, tmp_path / "shots", tmp_path / "out", atlas={"size": 32}, references={"hold_out": 2}, **QUICK
    )
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert any("pixels were averaged in 16 of 16 pictures" in note for note in record["notes"])
    assert summary["figures"]["psnr_held_out"] > 33
    # The scene's cameras are those of the pictures.
    assert 'value="240"' in (tmp_path / "out" / "scene" / "bowl.xml").read_text()


@pytest.mark.parametrize("memory", [0, 1])
def test_a_picture_that_is_not_kept_is_the_same_picture(rng, memory):
    """Collected without what gradients need, at once or the second time."""
    camera = crop(48)
    captures = in_memory([camera], [(KEY,)], [np.zeros((*camera.size, 3), np.float32)])
    table = pack(random_maps(rng, SIZES))
    traced = draw.tracer(torus())
    kept, lost = (
        renderer.MaterialRenderer(traced, captures, SIZES, renderer.RenderOptions(subsamples=4, memory=m))
        for m in (1e9, memory)
    )
    first = kept.image(table, 0)
    for _ in range(2):
        assert np.array_equal(lost.image(table, 0), first)
        assert np.array_equal(np.array(lost.step(table, [0])[1].array), np.array(kept.step(table, [0])[1].array))
    blocks = list(lost.blocks(0, gradients=False))
    assert all(block.hits.transpose is None for block in blocks)
    assert blocks[0].hits.bytes < next(iter(kept.blocks(0))).hits.bytes


def test_rays_beside_the_mesh_are_not_traced():
    """Samples of a mesh that fills little of the picture are those of a crop about it, wherever the mesh is."""
    traced, camera = draw.tracer(torus()), look_at((0.5, 3, 14), fov=40, size=(60, 90))
    down, across = image_samples.window(traced.mesh, camera)
    seen = draw.gbuffer(traced, camera).mask
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    assert down.start <= rows[0] <= down.start + 3 and down.stop - 4 <= rows[-1] < down.stop
    assert across.start <= columns[0] <= across.start + 3 and across.stop - 4 <= columns[-1] < across.stop
    near = look_at((0.5, 0.3, 0.2), fov=120, size=(60, 90))
    assert image_samples.window(traced.mesh, near) == (slice(0, 60), slice(0, 90))
    away = look_at((0, 0, 9), target=(0, 0, 20), fov=20, size=(60, 90))
    mask, surface = np.ones(away.size, bool), image_samples.TexturedMesh(traced, SIZES)
    assert not list(image_samples.collect(surface, away, (KEY,), mask))
    blocks = image_samples.collect(surface, camera, (KEY,), mask, image_samples.Sampling(subsamples=1))
    assert sum(b.covered.sum() for b in blocks) == seen.sum()


def test_what_pixels_see_does_not_hang_on_blocks(monkeypatch):
    """An upright camera's right axis has a zero, with which Dr.Jit multiplies in its own way."""
    traced, camera = draw.tracer(torus()), look_at((0, 1, 4), fov=40, size=(60, 50))
    whole = texel_views.trace_gbuffer(traced, camera, (KEY,))
    monkeypatch.setattr(texel_views, "BLOCK_RAYS", 2000)
    parts = texel_views.trace_gbuffer(traced, camera, (KEY,))
    assert camera.world_from_cam[1, 0] == 0
    for name in ("position", "normal", "mask"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    assert np.array_equal(whole.lit[0], parts.lit[0])
