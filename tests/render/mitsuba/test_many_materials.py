"""Meshes of many materials: drawn as one, baked set by set, planned and refused by what their materials need."""

import json
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from mistyle.cli.main import main
from mistyle.core.asset import Material
from mistyle.core.camera import rig
from mistyle.core.errors import UsageError
from mistyle.core.maps import Maps, OwnMaps, Texels
from mistyle.core.paths import scenes
from mistyle.core.settings import RigSettings
from mistyle.io.read_mesh import read_extent, read_mesh
from mistyle.jobs import memory_budget as budget
from mistyle.jobs.progress import Progress
from mistyle.process import memory
from mistyle.render.lookdev import scenes as lookdev
from mistyle.render.mitsuba import device, draw
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba import texture_pages as pages
from mistyle.stylization.pipeline import budget as stylize_budget
from mistyle.stylization.pipeline import single_stages as verbs
from mistyle.stylization.settings import resolve
from tests.render.deferred.test_seam import random_maps, torus

STYLE = str(scenes() / "demo_style.png")
SMALL = {"rig": {"kind": "turntable", "views": 2, "resolution": 32}, "draw": {"spp": 1}, "atlas": {"size": 32}}


def squares(folder: Path, count: int) -> Path:
    """An OBJ of so many squares side by side, each with a material of its own."""
    lines, library = ["mtllib squares.mtl"], []
    for k in range(count):
        x, y = k % 8, k // 8
        lines += [f"v {x + a} {y + b} 0" for a, b in ((0, 0), (0.9, 0), (0.9, 0.9), (0, 0.9))]
        lines += ["vt 0.1 0.1", "vt 0.9 0.1", "vt 0.9 0.9", "vt 0.1 0.9", f"usemtl m{k}"]
        first = 4 * k + 1
        lines.append("f " + " ".join(f"{first + c}/{first + c}" for c in range(4)))
        library.append(f"newmtl m{k}\nKd {k / count:.4f} 0.5 {1 - k / count:.4f}\nPr {0.3 + 0.6 * k / count:.4f}")
    (folder / "squares.mtl").write_text("\n".join(library))
    (folder / "squares.obj").write_text("\n".join(lines) + "\n")
    return folder / "squares.obj"


def of_sizes(*sizes: tuple[int, int]) -> list[Maps]:
    """Random maps, a height and width for each texture set."""
    return random_maps(np.random.default_rng(0), sizes)


def test_pages_draw_what_a_bsdf_for_each_texture_set_draws():
    """One delta light and rays through pixel centres: no noise."""
    import mitsuba as mi

    device.use()
    mesh = torus(parts=2)
    # Coordinates on both sides of the unit square; a wide and an odd page, then the least one.
    moved = mesh.corner_uvs + np.float32(0.3) * (2 * mesh.part[:, None, None] - 1)
    mesh = replace(mesh, corner_uvs=moved.astype(np.float32))
    maps = of_sizes((16, 6), (7, 2))
    mixed = [OwnMaps(**{**vars(maps[k]), "normal": maps[1 - k].normal}) for k in range(2)]
    (camera,) = rig(RigSettings(kind="turntable", views=1, resolution=40))
    sensor = scenery.sensor_dict(camera)
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
    described = {"type": "scene", "sensor": sensor, "light": {"type": "directional", "direction": [-1.0, -1, -2]}}
    described["integrator"] = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}

    def drawn(shapes) -> np.ndarray:
        return np.array(mi.render(mi.load_dict(described | shapes), spp=1))[..., :3]

    many = scenery.object_shapes(mesh, mixed, flip_invalid=True, frame="mikkt")
    one = pages.paged_shapes(mesh, mixed, flip_invalid=True)
    assert len(many) == 2 and len(one) == 1
    expected = drawn(many)
    assert expected.max() > 0.1
    np.testing.assert_allclose(drawn(one), expected, atol=1e-4 * expected.max())
    # Pages in another order are another picture: the comparison can fail.
    swapped = drawn(pages.paged_shapes(mesh, mixed[::-1], flip_invalid=True))
    assert np.abs(swapped - expected).max() > 0.05 * expected.max()


def test_the_files_own_maps_are_those_of_the_atlas():
    """Where the atlas has the resolution of the file's maps, nothing is resampled and both are the same."""
    from mistyle.atlas.texels import start_maps

    rng = np.random.default_rng(0)
    grey = rng.random((16, 16), np.float32)
    normal = of_sizes((16, 16))[0].normal
    made = Material("m", rng.random((16, 16, 3), np.float32), normal, grey, grey, np.array([0.5, 1, 0.25]), 0.7, 0.5)
    nothing = np.zeros((16, 16), bool)
    texels = Texels(np.zeros((16, 16, 3), np.float32), normal, nothing, *(np.full((16, 16), -1, np.int32),) * 2)
    for metallic in ("keep", "zero"):
        atlas, own = start_maps(made, texels, 16, metallic), lookdev.material_maps(made, metallic)
        for name in ("albedo", "normal", "roughness"):
            np.testing.assert_allclose(getattr(own, name), getattr(atlas, name), atol=1e-6)
        # A constant takes the renderer's least.
        np.testing.assert_allclose(own.metallic, atlas.metallic[: len(own.metallic), : len(own.metallic)], atol=1e-6)


def test_each_map_is_as_fine_as_pictures_show_it():
    fine = of_sizes((64, 64))[0]
    mixed = OwnMaps(**{**vars(fine), "known": np.ones((2, 2), bool)})
    small = draw.as_fine_as(mixed, 4)
    assert small.albedo.shape == (16, 16, 3) and small.roughness.shape == (16, 16) and small.known.shape == (2, 2)
    np.testing.assert_allclose(np.linalg.norm(small.normal, axis=-1), 1, atol=1e-5)
    assert draw.as_fine_as(mixed, 64).albedo is mixed.albedo


@pytest.fixture
def alive(monkeypatch):
    """How many texture sets were in memory when the next was laid out."""
    from mistyle.stylization.pipeline import start as stylize_start

    living: list[weakref.ref] = []
    counts: list[int] = []
    lay_out = stylize_start.lay_out_one

    def watched(*given):
        import gc

        gc.collect()
        counts.append(sum(each() is not None for each in living))
        texels, maps = lay_out(*given)
        living.extend(map(weakref.ref, (texels, maps)))
        return texels, maps

    for module in (stylize_start, verbs):
        monkeypatch.setattr(module, "lay_out_one", watched)
    return counts


def test_render_needs_no_atlas_and_bake_one_set_at_a_time(tmp_path, alive):
    mesh, settings = squares(tmp_path, 5), resolve("draft", None, SMALL, {})
    verbs.render_views(mesh, tmp_path / "views", settings, Progress(quiet=True))
    assert alive == []
    made = verbs.bake_views(mesh, tmp_path / "views", tmp_path / "out", settings, "squares", Progress(quiet=True))
    assert len(alive) == 5 and max(alive) == 0  # a set is let go before the next one is made
    assert list(made["painted"]) == [f"m{k}" for k in range(5)] and min(made["painted"].values()) > 0.5
    assert len(list((tmp_path / "out" / "textures").glob("*_albedo.png"))) == 5


def test_a_budget_changes_no_picture_and_no_texture(tmp_path, monkeypatch):
    mesh, settings = squares(tmp_path, 3), resolve("draft", None, SMALL, {})
    monkeypatch.setattr(memory, "LEAST", 1024)  # small arrays go to files as well
    tight: list[bool] = []
    draw_one, bake_one = verbs.draw, verbs.baked_set
    monkeypatch.setattr(verbs, "draw", lambda *given: [tight.append(memory.tight()), draw_one(*given)])
    monkeypatch.setattr(verbs, "baked_set", lambda *given: [tight.append(memory.tight()), bake_one(*given)][1])

    def made(out: Path) -> dict[str, bytes]:
        verbs.render_views(mesh, out / "views", settings, Progress(quiet=True))
        verbs.bake_views(mesh, out / "views", out / "baked", settings, "squares", Progress(quiet=True))
        return {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("*") if p.is_file()}

    monkeypatch.setattr(memory, "limit", lambda: int(64e9))
    free = made(tmp_path / "free")
    assert tight == [False] * 4
    # As if every array in memory were far too much for this machine, and arrays in files were not.
    tiled = (*stylize_budget.RENDER_TILED.values(), *stylize_budget.BAKE_TILED.values())
    monkeypatch.setattr(budget, "peaks", lambda needs, count: {k: 0.1 if n in tiled else 1e6 for k, n in needs.items()})
    assert made(tmp_path / "kept") == free and len(free) > 10
    assert tight[4:] == [True] * 4
    assert sorted(p.name for p in (tmp_path / "kept").iterdir()) == ["baked", "views"], "no scratch files are left"


def test_a_plan_counts_the_files_materials(tmp_path, capsys):
    extents = {count: read_extent(squares(tmp_path, count)) for count in (1, 20)}
    assert {count: e.sets for count, e in extents.items()} == {1: 1, 20: 20}
    asset = read_mesh(squares(tmp_path, 20))
    assert budget.size_of(asset) == (40, 20, 0) and extents[20].faces == 40 and extents[20].unwrapped == 0
    assert read_extent(squares(tmp_path, 20), uv="new").unwrapped == 40
    verbs.render_views(squares(tmp_path, 1), tmp_path / "v", resolve("draft", None, SMALL, {}), Progress(quiet=True))
    mesh, told = str(tmp_path / "squares.obj"), {}
    for count in (1, 20):
        squares(tmp_path, count)
        for words in (["stylize", mesh, STYLE], ["render", mesh], ["bake", mesh, str(tmp_path / "v")]):
            assert main([*words, "-o", str(tmp_path / "o"), "--dry-run", "--json"]) == 0
            told[words[0], count] = json.loads(capsys.readouterr().out)
    assert told["stylize", 20]["texture_sets"] == 20
    assert told["stylize", 20]["memory_gb"] > 3 * told["stylize", 1]["memory_gb"]
    assert told["render", 20]["memory_gb"] == told["render", 1]["memory_gb"]
    assert told["bake", 20]["memory_gb"] < 2 * told["bake", 1]["memory_gb"]
    assert told["bake", 20]["seconds"] > 5 * told["bake", 1]["seconds"]
    assert not (tmp_path / "o").exists()


def test_own_maps_count_as_they_are_read(tmp_path):
    from PIL import Image

    Image.fromarray(np.full((8, 16, 3), 90, np.uint8)).save(tmp_path / "t.png")
    mesh = squares(tmp_path, 2)
    library = tmp_path / "squares.mtl"
    library.write_text(library.read_text() + "\nmap_Kd t.png\nmap_Pr t.png\n")
    choices: tuple[tuple[Literal["keep", "new"], int], ...] = (("keep", 2048), ("new", 4))
    for uv, size in choices:
        own = budget.size_of(read_mesh(mesh, uv=uv, size=size))[2]
        assert own > 0 and read_extent(mesh, uv=uv, size=size).own == own


@pytest.mark.parametrize("verb", ["render", "bake", "stylize"])
def test_a_job_too_large_for_its_budget_is_refused_before_it_begins(tmp_path, verb, capsys):
    mesh = squares(tmp_path, 40)
    words = [verb, str(mesh), *([STYLE] if verb == "stylize" else [])]
    if verb == "bake":
        verbs.render_views(mesh, tmp_path / "views", resolve("draft", None, SMALL, {}), Progress(quiet=True))
        words.append(str(tmp_path / "views"))
    words += ["--preset", "draft", "-o", str(tmp_path / "out"), "--memory", "500M"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "--memory 0.5G: the job needs" in said and "give it --memory" in said and "--set " in said
    assert not (tmp_path / "out").exists()


def test_the_machines_memory_bounds_a_job_that_was_given_none(monkeypatch):
    asked = resolve("draft", None, {"atlas": {"size": 4096}}, {})
    whole = max(budget.peaks(stylize_budget.PLAIN, stylize_budget.counts(asked)).values())
    monkeypatch.setattr(memory, "limit", lambda: None)
    assert not stylize_budget.tiles(asked) and stylize_budget.memory_gb(asked) == pytest.approx(whole, abs=0.01)
    monkeypatch.setattr(memory, "limit", lambda: int(1.01 * whole / budget.SHARE * 1e9))
    assert not stylize_budget.tiles(asked)
    monkeypatch.setattr(memory, "limit", lambda: int(0.8 * whole / budget.SHARE * 1e9))
    assert stylize_budget.tiles(asked) and stylize_budget.memory_gb(asked) <= 0.8 * whole + 0.01
    # A budget in words of one's own counts more than the machine.
    assert not stylize_budget.tiles(asked.model_copy(update={"memory": whole + 1}))
    monkeypatch.setattr(memory, "limit", lambda: int(1e9))
    with pytest.raises(UsageError) as caught:
        stylize_budget.tiles(asked)
    text = str(caught.value)
    assert "this machine has 1.0 GB of memory, 0.9 GB of them for a job: the job needs" in text
    assert "give it --memory" in text and "--set atlas.size=2048" in text
