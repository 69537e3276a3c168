"""The folder that comes out: every file listed and true to its hash, nothing half-written, nobody's files lost."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mistyle.atlas.texels import rasterise
from mistyle.core.errors import UsageError
from mistyle.core.maps import flat_maps
from mistyle.deliver import asset as export
from mistyle.deliver.asset import write_asset
from mistyle.io.gltf.write import write_glb
from mistyle.io.images import textures
from mistyle.io.images.write import encode_png
from mistyle.io.read_mesh import read_mesh
from tests.support.gltf_cases import bumpy_sphere, from_gltf, glb_parts, no_texels, quad, quarters, strange_gltf

OPEN = np.ones((16, 16), np.float32)


def files(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def write(folder: Path, asset=None, name: str = "cow_wave", **provenance):
    asset = asset or quad()
    parts = len(asset.mesh.parts)
    return write_asset(
        folder, name, asset, [quarters()] * parts, [OPEN] * parts, [no_texels()] * parts, provenance=provenance
    )


def read_exr(path: Path) -> tuple[dict, dict]:
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {k: np.array(v.pixels, np.float32) for k, v in file.channels().items()}, dict(file.header())


def test_every_file_is_there_and_listed(tmp_path):
    manifest = write(tmp_path / "asset", seed=3)
    maps = ("albedo", "normal", "roughness", "orm")
    expected = [f"textures/cow_wave_{m}.{kind}" for m in maps for kind in ("png", "exr")] + ["cow_wave.glb"]
    assert files(tmp_path / "asset") == sorted([*expected, "cow_wave.json"])
    assert json.loads((tmp_path / "asset" / "cow_wave.json").read_text()) == manifest
    assert sorted(f["file"] for f in manifest["files"]) == sorted(expected)
    for entry in manifest["files"]:
        content = (tmp_path / "asset" / entry["file"]).read_bytes()
        assert entry["sha256"] == hashlib.sha256(content).hexdigest() and entry["bytes"] == len(content)
    spaces = {f["file"]: f.get("colour_space") for f in manifest["files"]}
    assert spaces["textures/cow_wave_albedo.png"].startswith("sRGB")
    assert "lin_rec709_scene" in spaces["textures/cow_wave_albedo.exr"]
    assert spaces["textures/cow_wave_orm.png"] == spaces["textures/cow_wave_normal.exr"] == "none (linear data)"
    assert manifest["normal_map"]["green"] == "+Y (OpenGL)" and manifest["provenance"] == {"seed": 3}


def test_exr_values(tmp_path):
    write(tmp_path)
    maps = quarters()
    half = 2.0**-11  # half floats have 11 significant bits
    albedo, header = read_exr(tmp_path / "textures" / "cow_wave_albedo.exr")
    np.testing.assert_allclose(np.stack([albedo[c] for c in "RGB"], -1), maps.albedo, atol=half)
    assert header["colorInteropID"] == "lin_rec709_scene" and header["mistyle:map"] == "albedo"
    normal, header = read_exr(tmp_path / "textures" / "cow_wave_normal.exr")
    np.testing.assert_allclose(np.stack([normal[c] for c in "RGB"], -1) * 2 - 1, maps.normal, atol=2 * half)
    assert header["colorInteropID"] == "data"
    rough, _ = read_exr(tmp_path / "textures" / "cow_wave_roughness.exr")
    np.testing.assert_allclose(rough["Y"], maps.roughness, atol=half)
    orm, _ = read_exr(tmp_path / "textures" / "cow_wave_orm.exr")
    np.testing.assert_allclose(orm["B"], maps.metallic, atol=half)


def test_two_runs_write_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / name, bumpy_sphere(), seed=1)
    assert files(tmp_path / "a") == files(tmp_path / "b") and len(files(tmp_path / "a")) == 18
    for name in files(tmp_path / "a"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_part_names_become_different_safe_file_names(tmp_path):
    write(tmp_path, bumpy_sphere(), name="ball")
    assert {f.split("_albedo")[0] for f in files(tmp_path) if "_albedo" in f} == {
        "textures/ball_lower_half",
        "textures/ball_upper_half",
    }
    stems = textures.part_stems("x", ["a/b", "a b", "A_B", "", "../up", "con", "häuser"])
    assert stems == ["x_a_b", "x_a_b_2", "x_A_B_3", "x__", "x_up", "x__con", "x_häuser"]
    assert textures.part_stems("x", ["only"]) == ["x"]


@pytest.mark.parametrize("name", ["", "a/b", "../x", ".hidden", "a b", "nul", "x" * 90])
def test_names_that_are_no_file_names_are_refused(tmp_path, name):
    with pytest.raises(UsageError, match="--name.*try"):
        write(tmp_path / "asset", name=name)
    assert not (tmp_path / "asset").exists()


def test_a_second_export_replaces_its_own_files_only(tmp_path):
    write(tmp_path, bumpy_sphere(), name="ball")
    (tmp_path / "textures" / "mine.psd").write_text("mine")
    write(tmp_path, name="other")
    write(tmp_path, quad(), name="ball")
    left = files(tmp_path)
    assert "textures/mine.psd" in left and "other.glb" in left and "textures/other_orm.exr" in left
    assert "textures/ball_albedo.png" in left and not any("lower_half" in f for f in left)
    assert not list(tmp_path.rglob(".*"))


def test_a_failing_export_leaves_the_old_one(tmp_path, monkeypatch):
    write(tmp_path / "asset")
    before = {f: (tmp_path / "asset" / f).read_bytes() for f in files(tmp_path / "asset")}

    def fails(*_, **__):
        raise RuntimeError("stop")

    monkeypatch.setattr(export, "write_glb", fails)
    with pytest.raises(RuntimeError):
        write(tmp_path / "asset", bumpy_sphere())
    assert {f: (tmp_path / "asset" / f).read_bytes() for f in files(tmp_path / "asset")} == before
    assert [p.name for p in tmp_path.iterdir()] == ["asset"]


def test_alpha_of_a_cut_out_material_is_carried_over(tmp_path):
    """The file's alpha, moved by its texture transform, ends up where the same surface point now is."""
    from PIL import Image

    source = strange_gltf(tmp_path / "strange.glb")
    rows, columns = np.mgrid[0:64, 0:64]
    ramp = (0.25 + 0.5 * rows / 63)[..., None]
    (tmp_path / "cut out.png").write_bytes(encode_png(np.concatenate([np.ones((64, 64, 3)), ramp], -1)))
    for new_uvs in (False, True):
        asset = from_gltf(source, new_uvs=new_uvs)
        size = 64
        maps = replace_size(quarters(), size)
        texels = [rasterise(asset.mesh, p, size) for p in range(2)]
        out = tmp_path / f"out{new_uvs}"
        manifest = write_asset(out, "leaf", asset, [maps] * 2, [maps.roughness] * 2, texels, provenance={})
        image = np.asarray(Image.open(out / "textures" / "leaf_leaf_albedo.png"))
        assert image.shape == (size, size, 4)
        assert np.asarray(Image.open(out / "textures" / "leaf_glass_albedo.png")).shape == (size, size, 3)
        assert read_exr(out / "textures" / "leaf_leaf_albedo.exr")[0].keys() == {"R", "G", "B", "A"}
        assert [f["alpha"] for f in manifest["files"] if "alpha" in f] == [True, True]
        # The sheet's v (up) is its y, which is the texels' position; in the file the transform doubles v (down) and
        # the lookup repeats: down = 2 (1 - y) mod 1.
        y = texels[0].position[..., 1]
        down = (2 * (1 - y)) % 1
        inside = texels[0].covered & (down > 0.05) & (down < 0.95)  # bilinear filtering wraps at the border
        expected = 0.25 + 0.5 * np.clip(down * 64 - 0.5, 0, 63) / 63
        assert inside.sum() > 500
        np.testing.assert_allclose(image[inside, 3] / 255, expected[inside], atol=0.03)
        tree, _ = glb_parts(out / "leaf.glb")
        assert tree["materials"][0]["alphaMode"] == "MASK"


def replace_size(maps, size: int):
    repeat = size // 16
    grown = {k: np.repeat(np.repeat(getattr(maps, k), repeat, 0), repeat, 1) for k in maps.__dataclass_fields__}
    return replace(maps, **grown)


def test_the_objects_of_an_obj_become_nodes_of_their_own_name(tmp_path):
    """Read back by trimesh: every object has its faces, and materials are shared between objects."""
    lines = ["mtllib none.mtl"]
    for k, name in enumerate(("lower half", "upper")):
        lines += [f"o {name}", *(f"v {x} {y + 2 * k} 0" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))]
        lines += [f"vt {x} {(y + k) / 2}" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
        a = 4 * k
        lines += ["usemtl paint", f"f {a + 1}/{a + 1} {a + 2}/{a + 2} {a + 3}/{a + 3}"]
        lines += ["usemtl other"] * k + [f"f {a + 1}/{a + 1} {a + 3}/{a + 3} {a + 4}/{a + 4}"]
    (tmp_path / "two.obj").write_text("\n".join(lines) + "\n")
    asset = read_mesh(tmp_path / "two.obj", size=64)
    maps = [flat_maps(16) for _ in asset.mesh.parts]
    write_glb(tmp_path / "two.glb", asset, maps, [np.ones((16, 16), np.float32)] * len(maps), name="two")
    scene = trimesh.load(tmp_path / "two.glb", process=False)
    faces = {}
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        faces[node] = faces.get(node, 0) + len(mesh.faces)
        low = mesh.vertices[:, 1].min()
        assert low == pytest.approx(0 if "lower" in node or "lower" in geometry else 2)
    assert sum(faces.values()) == 4
    tree, _ = glb_parts(tmp_path / "two.glb")
    assert [node["name"] for node in tree["nodes"]] == ["lower half", "upper"]
    assert [material["name"] for material in tree["materials"]] == ["paint", "other"]
    used = [[p["material"] for p in mesh["primitives"]] for mesh in tree["meshes"]]
    assert used == [[0], [0, 1]]
