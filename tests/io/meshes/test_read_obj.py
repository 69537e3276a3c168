"""OBJ and MTL as other programs write them: marks, encodings, spellings, options and paths of another disk."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.core.asset import Asset
from mistyle.core.image import linear_from_srgb
from mistyle.geometry.retexture import fetch
from mistyle.io.images.write import write_exr
from mistyle.io.meshes.mtl_read import Statement, statement
from mistyle.io.meshes.obj_read import read_obj
from mistyle.io.read_mesh import read_mesh, read_references
from mistyle.io.sandbox.nearby import unmarked

SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\n"
FACE = "f 1/1/1 2/2/1 3/3/1 4/4/1\n"
RED, GREEN, BLUE, YELLOW = (220, 40, 40), (40, 200, 40), (40, 40, 220), (230, 220, 40)


def quadrants(path: Path, side: int = 16) -> Path:
    """Top left red, top right green, bottom left blue, bottom right yellow."""
    picture = np.array([[RED, GREEN], [BLUE, YELLOW]], np.uint8).repeat(side // 2, 0).repeat(side // 2, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)
    return path


def square(folder: Path, mtl: str | bytes | None, head: str = "mtllib m.mtl\n", use: str = "usemtl mat\n") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if mtl is not None:
        (folder / "m.mtl").write_bytes(mtl.encode() if isinstance(mtl, str) else mtl)
    path = folder / "q.obj"
    path.write_text(head + SQUARE + use + FACE)
    return path


def corners(asset: Asset) -> list[list[int]]:
    """The colours of the square's quadrants as they are seen: top left, top right, bottom left, bottom right."""
    return [nearest(shown(asset, x, y)) for y in (0.5, -0.5) for x in (-0.5, 0.5)]


def shown(asset: Asset, x: float, y: float) -> np.ndarray:
    """The linear albedo at a point of the square in the file's own coordinates."""
    (material,) = asset.materials
    assert material.albedo is not None
    where = asset.source.user_positions[asset.mesh.faces].reshape(-1, 3)
    plane = np.linalg.lstsq(np.c_[where[:, :2], np.ones(len(where))], asset.mesh.corner_uvs.reshape(-1, 2), rcond=None)[
        0
    ]
    return fetch(material.albedo, np.array([[x, y, 1]]) @ plane)[0] * material.albedo_factor


def nearest(linear: np.ndarray) -> list[int]:
    wanted = np.array([RED, GREEN, BLUE, YELLOW])
    return wanted[np.abs(linear_from_srgb(wanted / np.float32(255)) - linear).max(axis=1).argmin()].tolist()


SEEN = [list(RED), list(GREEN), list(BLUE), list(YELLOW)]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks_are_no_letters(encoding: str, tmp_path: Path) -> None:
    quadrants(tmp_path / "wood.png")
    path = square(tmp_path, "newmtl mat\nmap_Kd wood.png\n".encode(encoding))
    path.write_bytes(path.read_text().encode(encoding))
    asset = read_mesh(path, uv="keep")
    assert corners(asset) == SEEN and not asset.source.notes
    assert [p.name for p in read_references(path)] == ["m.mtl", "wood.png"]


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_what_is_not_marked_stays(mark: bytes) -> None:
    assert unmarked(mark + "ö\r\n".encode()) == "ö\r\n".encode()


def test_names_of_old_encodings(tmp_path: Path) -> None:
    quadrants(tmp_path / "Größe.png")
    path = square(tmp_path, "newmtl Holz_größer\nmap_Kd Größe.png\n".encode("latin-1"))
    path.write_bytes(path.read_text().replace("usemtl mat", "usemtl Holz_größer").encode("latin-1"))
    asset = read_mesh(path, uv="keep")
    assert asset.mesh.parts == ("Holz_größer",) and corners(asset) == SEEN
    assert any("m.mtl is not UTF-8" in note for note in asset.source.notes)


PLACES = {
    "C:\\Users\\a\\wood.png": "wood.png",
    "/home/a/work/maps/wood.png": "maps/wood.png",
    "WOOD.PNG": "wood.png",
    '"wood.png"': "wood.png",
    "D:\\x\\wood.png": "Textures/wood.png",
    "../textures/wood.png": "../textures/wood.png",
    "somewhere/wood.png": "../textures/wood.png",
}


@pytest.mark.parametrize("named", PLACES)
def test_textures_are_found_by_their_names(named: str, tmp_path: Path) -> None:
    folder = tmp_path / "source"
    quadrants(folder / PLACES[named])
    path = square(folder, f"newmtl mat\nmap_Kd {named}\n")
    asset = read_mesh(path, uv="keep")
    assert corners(asset) == SEEN
    told = [note for note in asset.source.notes if "was found by its name" in note]
    assert len(told) == (0 if named.startswith('"') else 1)
    assert len(read_references(path)) == 2


def test_only_textures_beside_the_folder_are_opened(tmp_path: Path) -> None:
    """Neither another folder beside it, nor a folder below, nor a link out of it."""
    quadrants(tmp_path / "secret" / "wood.png")
    quadrants(tmp_path / "textures" / "deep" / "wood.png")
    (tmp_path / "textures" / "link.png").symlink_to(tmp_path / "secret" / "wood.png")
    for named in ("../secret/wood.png", "../textures/deep/wood.png", "../textures/link.png", "/secret/wood.png"):
        asset = read_mesh(square(tmp_path / "source", f"newmtl mat\nmap_Kd {named}\n"))
        assert asset.materials[0].albedo is None and any("left out" in note for note in asset.source.notes)


def test_a_linked_folder_of_textures_is_not_followed(tmp_path: Path) -> None:
    quadrants(tmp_path / "secret" / "wood.png")
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "textures").symlink_to(tmp_path / "secret")
    asset = read_mesh(square(tmp_path / "a" / "source", "newmtl mat\nmap_Kd ../textures/wood.png\n"))
    assert asset.materials[0].albedo is None


@pytest.mark.parametrize("named", ["M.MTL", "C:\\old\\m.mtl"])
def test_libraries_are_found_by_their_names(named: str, tmp_path: Path) -> None:
    quadrants(tmp_path / "wood.png")
    path = square(tmp_path, "newmtl mat\nmap_Kd wood.png\n", head=f"mtllib {named}\n")
    asset = read_mesh(path, uv="keep")
    assert corners(asset) == SEEN
    assert asset.source.notes == (f"Material library {named} was found by its name at m.mtl.",)


def test_a_link_to_a_mesh_has_the_mesh_s_library(tmp_path: Path) -> None:
    quadrants(tmp_path / "real" / "wood.png")
    path = square(tmp_path / "real", "newmtl mat\nmap_Kd wood.png\n")
    (tmp_path / "links").mkdir()
    os.symlink(path, tmp_path / "links" / "a.obj")
    assert corners(read_mesh(tmp_path / "links" / "a.obj", uv="keep")) == SEEN


def test_the_only_material_needs_no_usemtl(tmp_path: Path) -> None:
    quadrants(tmp_path / "wood.png")
    path = square(tmp_path, "newmtl mat\nmap_Kd wood.png\n", use="")
    asset = read_mesh(path, uv="keep")
    assert corners(asset) == SEEN and asset.mesh.parts == ("mat",)
    assert any("the only one of its library" in note for note in asset.source.notes)
    (tmp_path / "m.mtl").write_text("newmtl mat\nmap_Kd wood.png\nnewmtl other\n")
    raw = read_obj(path, 100)
    assert raw.materials[0].name == "material" and any("state no material" in note for note in raw.notes)


def test_what_is_not_understood_is_said(tmp_path: Path) -> None:
    mtl = (
        "newmtl mat\nKd 1 1 1\nKa 1 1 1\nKe 0 0 0\nillum 2\nKs 0.5 0.5 0.5\nNs 250\nmap_Ke glow.png\nwibble 3\nd 0.5\n"
    )
    path = square(tmp_path, mtl, head="#comment\nmtllib m.mtl\ns 1\nl 1 2\nfoo 1\n")
    raw = read_obj(path, 100)
    assert raw.notes == (
        "The opacity and emission of material 'mat' shows in lookdev and compare; "
        "views, paintings and finished assets omit it.",
        "m.mtl: these statements were not read: Ks, Ns, wibble.",
        "Lines and points were left out.",
        "Statements that OBJ does not have were left out: 'foo'.",
    )
    path.write_text(path.read_text().replace("usemtl mat", "usemtl none"))
    assert "No library has the material(s) 'none'; they were read as plain." in read_obj(path, 100).notes
    path.write_text(path.read_text().replace("usemtl none", "usemtl MAT"))
    raw = read_obj(path, 100)
    assert raw.materials[0].name == "mat" and "Material 'MAT' was matched to 'mat' of its library." in raw.notes


def test_neutral_statements_are_not_worth_a_note(tmp_path: Path) -> None:
    mtl = "newmtl mat\nKd 1 1 1\nKa 1 1 1\nKs 0 0 0\nNs 10\nKe 0.0 0 0\nTf 1 1 1\nNi 1.5\nd 1.0\nTr 0\nillum 2\n"
    assert read_obj(square(tmp_path, mtl), 100).notes == ()


STATED = {
    "d 0.25\n": (0.25, (0, 0, 0)),
    "Tr 0.25\n": (0.75, (0, 0, 0)),
    "d 0.5\nTr 0.25\nKe 2 0.5 0\n": (0.5, (2, 0.5, 0)),
    "Ke 3\nd 4\n": (1, (3, 3, 3)),
}


@pytest.mark.parametrize("mtl", STATED)
def test_opacity_and_emission_are_read(mtl: str, tmp_path: Path) -> None:
    asset = read_mesh(square(tmp_path, f"newmtl mat\nKd 1 1 1\n{mtl}"), uv="keep")
    shading = asset.materials[0].shading
    assert (shading.opacity, shading.emission) == STATED[mtl]
    told = " ".join(asset.source.notes)
    assert "shows in lookdev and compare; views, paintings and finished assets omit it" in told
    assert ("disagree; d was read" in told) == ("Tr" in mtl and "d 0.5" in mtl)


def test_halos_are_said(tmp_path: Path) -> None:
    asset = read_mesh(square(tmp_path, "newmtl mat\nKd 1 1 1\nd -halo 0.5\n"), uv="keep")
    assert asset.materials[0].shading.opacity == 1
    assert "m.mtl: these statements were not read: d." in asset.source.notes


@pytest.mark.parametrize(
    ("statement", "expected", "told"),
    [("leaf.png", 51, True), ("-imfchan m leaf.png", 51, False), ("-imfchan l leaf.png", 204, False),
     ("-imfchan r leaf.png", 204, False), ("mask.png", 102, False)],
)  # fmt: skip
def test_opacity_textures(statement: str, expected: int, told: bool, tmp_path: Path) -> None:
    Image.new("RGBA", (4, 4), (204, 204, 204, 51)).save(tmp_path / "leaf.png")
    Image.new("L", (4, 4), 102).save(tmp_path / "mask.png")
    Image.new("RGB", (4, 4), (188, 188, 0)).save(tmp_path / "glow.png")
    path = square(tmp_path, f"newmtl mat\nd 0\nKe 0 0 0\nmap_d {statement}\nmap_Ke glow.png\n")
    material = read_mesh(path, uv="keep").materials[0]
    assert material.opacity is not None and material.emission is not None
    assert material.opacity == pytest.approx(expected / 255, abs=1e-3) and material.shading.opacity == 1
    assert material.emission[0, 0] == pytest.approx([0.503, 0.503, 0], abs=2e-3)
    assert any("from its alpha channel" in n for n in read_mesh(path, uv="keep").source.notes) == told


KD = {"0.5": (0.5, 0.5, 0.5), "0.1 0.2 0.3": (0.1, 0.2, 0.3), "spectral a.rfl 1": (1, 1, 1)}


@pytest.mark.parametrize("kd", KD)
def test_colours_of_one_number_or_three(kd: str, tmp_path: Path) -> None:
    raw = read_obj(square(tmp_path, f"newmtl mat\nKd {kd}\n"), 100)
    assert raw.materials[0].albedo_factor == KD[kd]
    assert raw.notes == (("m.mtl: these statements were not read: Kd.",) if "spectral" in kd else ())


STATEMENTS = {
    "wood.png": Statement("wood.png"),
    "-s 0.5 2 1 -o .25 0 0 a b.png": Statement("a b.png", (0.5, 2), (0.25, 0)),
    "-s 3 wood.png": Statement("wood.png", (3, 1)),
    "-bm 0.25 -clamp on x.png": Statement("x.png", clamp=True, strength=0.25),
    "-mm 0.1 0.5 -imfchan g -blendu on -colorspace Linear x.png": Statement(
        "x.png", base=0.1, gain=0.5, channel="g", space="linear"
    ),
    "-t 1 1 1 -texres 512 1.png": Statement("1.png", turbulence=True),
    "-clamp off -cc on -boost 2 - dash.png": Statement("- dash.png"),
}


@pytest.mark.parametrize("text", STATEMENTS)
def test_texture_statements(text: str) -> None:
    assert statement(text) == STATEMENTS[text]


def test_scale_and_offset_move_the_lookup(tmp_path: Path) -> None:
    quadrants(tmp_path / "wood.png")
    asset = read_mesh(square(tmp_path, "newmtl mat\nmap_Kd -s 0.5 0.5 1 wood.png\n"), uv="keep")
    assert corners(asset) == [list(BLUE)] * 4
    asset = read_mesh(square(tmp_path, "newmtl mat\nmap_Kd -o 0.5 0 0 wood.png\n"), uv="keep")
    assert corners(asset) == [SEEN[k] for k in (1, 0, 3, 2)]
    asset = read_mesh(square(tmp_path, "newmtl mat\nmap_Kd -s 0.5 0.5 -o 0 .5 wood.png\n"), uv="keep")
    assert corners(asset) == [list(RED)] * 4


def test_clamped_textures(tmp_path: Path) -> None:
    """Beyond the unit square the last texels go on; without -clamp the picture comes again."""
    quadrants(tmp_path / "wood.png")
    path = square(tmp_path, "newmtl mat\nmap_Kd -clamp on -o 0.75 0 0 wood.png\n")
    asset = read_mesh(path, uv="keep")
    assert [nearest(shown(asset, x, 0.5)) for x in (-0.9, -0.3, 0.9)] == [list(GREEN)] * 3
    (tmp_path / "m.mtl").write_text("newmtl mat\nmap_Kd -o 0.75 0 0 wood.png\n")
    asset = read_mesh(path, uv="keep")
    assert [nearest(shown(asset, x, 0.5)) for x in (-0.9, 0, 0.9)] == [list(GREEN), list(RED), list(GREEN)]


def test_values_are_scaled_and_channels_chosen(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (51, 102, 204)).save(tmp_path / "a.png")
    lines = "map_Kd -mm 0.2 0.5 a.png\nmap_Pr -imfchan b a.png\nmap_Pm -mm 0.1 2 -imfchan g a.png"
    (material,) = read_mesh(square(tmp_path, f"newmtl mat\n{lines}\n"), uv="keep").materials
    assert material.albedo is not None and material.roughness is not None and material.metallic is not None
    assert material.albedo[0, 0] == pytest.approx(linear_from_srgb(np.array([0.3, 0.4, 0.6], np.float32)), abs=1e-6)
    assert material.roughness[0, 0] == pytest.approx(0.8) and material.metallic[0, 0] == pytest.approx(0.9)


def test_colour_spaces_of_statements(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2), (51, 102, 204)).save(tmp_path / "a.png")
    path = square(tmp_path, "newmtl mat\nmap_Kd -colorspace linear a.png\nmap_Pr -colorspace sRGB a.png\n")
    (material,) = read_mesh(path, uv="keep").materials
    assert material.albedo is not None and material.roughness is not None
    assert material.albedo[0, 0] == pytest.approx([0.2, 0.4, 0.8])
    assert material.roughness[0, 0] == pytest.approx(linear_from_srgb(np.array([0.2], np.float32))[0], abs=1e-6)
    asset = read_mesh(square(tmp_path, "newmtl mat\nmap_Kd -t 1 1 1 -colorspace ACEScg a.png\n"), uv="keep")
    assert any("acescg" in note for note in asset.source.notes) and any("-t" in note for note in asset.source.notes)


@pytest.mark.parametrize("keyword", ["map_Bump -bm 1.000000", "map_bump", "bump -bm 1", "norm"])
def test_normal_maps_by_any_name(keyword: str, tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (204, 128, 230)).save(tmp_path / "n.png")
    asset = read_mesh(square(tmp_path, f"newmtl mat\n{keyword} n.png\n"), uv="keep")
    assert asset.materials[0].normal is not None
    assert asset.materials[0].normal[0, 0] == pytest.approx([0.6, 0, 0.8], abs=0.01)


def test_strength_of_a_normal_map(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (204, 128, 230)).save(tmp_path / "n.png")
    (material,) = read_mesh(square(tmp_path, "newmtl mat\nmap_Bump -bm 0.5 n.png\n"), uv="keep").materials
    assert material.normal is not None
    assert material.normal[0, 0, 0] / material.normal[0, 0, 2] == pytest.approx(0.375, abs=0.01)


def test_heights_are_no_normals(tmp_path: Path, rng: np.random.Generator) -> None:
    Image.fromarray(rng.integers(0, 256, (16, 16), np.uint8)).save(tmp_path / "h.png")
    Image.new("RGB", (4, 4), (204, 128, 230)).save(tmp_path / "n.png")
    asset = read_mesh(square(tmp_path, "newmtl mat\nmap_Bump h.png\n"), uv="keep")
    assert asset.materials[0].normal is None
    assert asset.source.notes == ("Bump map h.png holds heights, not normals, and was left out.",)
    asset = read_mesh(square(tmp_path, "newmtl mat\nbump h.png\nnorm n.png\n"), uv="keep")
    assert asset.materials[0].normal is not None and any("h.png was left out" in note for note in asset.source.notes)


def test_floating_point_textures(tmp_path: Path) -> None:
    shade = np.full((4, 4), 0.25, np.float32)
    write_exr(tmp_path / "a.exr", {"R": shade, "G": 2 * shade, "B": 8 * shade})
    write_exr(tmp_path / "r.exr", {"Y": shade})
    (material,) = read_mesh(square(tmp_path, "newmtl mat\nmap_Kd a.exr\nmap_Pr r.exr\n"), uv="keep").materials
    assert material.albedo is not None and material.roughness is not None
    assert material.albedo[0, 0] == pytest.approx([0.25, 0.5, 1]) and material.roughness[0, 0] == 0.25


def test_a_broken_texture_does_not_refuse_the_mesh(tmp_path: Path) -> None:
    for name in ("a.exr", "b.png", "c.psd"):
        (tmp_path / name).write_bytes(b"\x76\x2f\x31\x01 nothing" if name == "a.exr" else b"8BPS nothing")
        asset = read_mesh(square(tmp_path, f"newmtl mat\nmap_Kd {name}\n"), uv="keep")
        assert asset.materials[0].albedo is None and any(f"{name} was left out" in n for n in asset.source.notes)


def test_every_tile_is_a_reference(tmp_path: Path) -> None:
    for tile in (1001, 1002, 1011):
        quadrants(tmp_path / f"skin.{tile}.png")
    path = square(tmp_path, "newmtl mat\nmap_Kd skin.<UDIM>.png\n")
    assert [p.name for p in read_references(path)] == ["m.mtl", "skin.1001.png", "skin.1002.png", "skin.1011.png"]
