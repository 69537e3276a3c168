"""MISTYLE_ASSETS: the files that a mesh may name outside its own folder, by one rule for all formats."""

import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from mistyle.core.errors import InputRefused, UsageError
from mistyle.io.read_mesh import read_mesh
from mistyle.io.sandbox.asset_folders import ASSETS, remedy
from tests.support.named_files import RED, files, gltf, obj, picture, ply, usd_layer, usd_materialx, usda

Make = Callable[[Path, str], Path]
# (folder of the mesh, folder that its name leads to, ending in /) -> the mesh; and the file that lies there.
CASES: dict[str, tuple[Make, str]] = {
    "obj library": (lambda folder, up: obj(folder, "red.png", f"{up}box.mtl"), "box.mtl"),
    "obj texture": (lambda folder, up: obj(folder, f"{up}red.png"), "red.png"),
    "gltf buffer": (lambda folder, up: gltf(folder, buffer=f"{up}box.bin"), "box.bin"),
    "gltf image": (lambda folder, up: gltf(folder, f"{up}red.png"), "red.png"),
    "ply texture": (lambda folder, up: ply(folder, f"{up}red.png"), "red.png"),
    "usd texture": (lambda folder, up: usda(folder, f"{up}red.png"), "red.png"),
    "usd layer": (lambda folder, up: usd_layer(folder, f"{up}box.usda"), "box.usda"),
    "usd document": (lambda folder, up: usd_materialx(folder, f"{up}m.mtlx"), "m.mtlx"),
    "usd document's texture": (lambda folder, up: usd_materialx(folder, "m.mtlx", f"{up}red.png"), "red.png"),
}
links = pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")
every = pytest.mark.parametrize("case", sorted(CASES))


def kit(root: Path, case: str, up: str = "../shared/") -> tuple[Path, Path]:
    """A mesh in root/kit/mesh, and the file in root/kit/shared that it names."""
    for name in ("mesh", "shared"):
        (root / "kit" / name).mkdir(parents=True)
    if case.startswith("usd"):
        pytest.importorskip("pxr")
    make, name = CASES[case]
    return make(root / "kit" / "mesh", up), root / "kit" / "shared" / name


def texel(mesh: Path) -> tuple[list[int] | None, str]:
    """The first texel of the texture, None without one, and what was said."""
    try:
        asset = read_mesh(mesh)
    except InputRefused as error:
        return None, str(error)
    albedo = asset.materials[0].albedo if asset.materials else None
    colour = None if albedo is None else [round(255 * float(c)) for c in albedo[0, 0]]
    return colour, " ".join(asset.source.notes)


@every
def test_files_elsewhere_are_read_in_a_named_folder_only(case, tmp_path, monkeypatch):
    mesh, target = kit(tmp_path, case)
    (tmp_path / "other").mkdir()
    for value in (None, "", str(tmp_path / "other"), str(mesh.parent)):
        monkeypatch.delenv(ASSETS, raising=False) if value is None else monkeypatch.setenv(ASSETS, value)
        colour, words = texel(mesh)
        assert colour != list(RED) and target not in files(mesh)
        # The fix is the value that allows it, and nothing wider.
        before = f"{value}{os.pathsep}" if value and value.endswith("other") else ""
        assert f"set {ASSETS}={before}{tmp_path / 'kit'} (meshes there may name each other's files)" in words
    for value in (str(tmp_path / "kit"), os.pathsep.join([str(tmp_path / "other"), "", f"{tmp_path}/kit/"])):
        monkeypatch.setenv(ASSETS, value)
        colour, words = texel(mesh)
        assert colour == list(RED) and ASSETS not in words
        assert target in files(mesh)


@every
def test_absolute_names_count_like_others(case, tmp_path, monkeypatch):
    mesh, target = kit(tmp_path, case, f"{tmp_path}/kit/shared/")
    monkeypatch.delenv(ASSETS, raising=False)
    assert texel(mesh)[0] != list(RED)
    monkeypatch.setenv(ASSETS, str(tmp_path))
    assert texel(mesh)[0] == list(RED) and target in files(mesh)


@links
@every
def test_links_out_of_a_named_folder_are_not_followed(case, tmp_path, monkeypatch):
    mesh, target = kit(tmp_path, case)
    secret = tmp_path / "secret" / target.name
    secret.parent.mkdir()
    target.rename(secret)
    for picture_file in target.parent.glob("*.png"):
        shutil.copy(picture_file, secret.parent)
    target.symlink_to(secret)
    monkeypatch.setenv(ASSETS, str(tmp_path / "kit"))
    assert texel(mesh)[0] != list(RED)
    assert not [file for file in files(mesh) if file.is_relative_to(secret.parent)]
    # A link that stays inside is followed.
    target.unlink()
    inside = tmp_path / "kit" / "store" / target.name
    shutil.copytree(secret.parent, inside.parent)
    target.symlink_to(inside)
    assert texel(mesh)[0] == list(RED) and inside in files(mesh)


@links
@pytest.mark.parametrize("case", ["obj texture", "gltf image", "ply texture", "usd texture"])
def test_the_real_place_of_the_mesh_counts(case, tmp_path, monkeypatch):
    mesh, _ = kit(tmp_path, case)
    monkeypatch.setenv(ASSETS, str(tmp_path / "kit"))
    link = tmp_path / "scene" / mesh.name
    link.parent.mkdir()
    link.symlink_to(mesh)
    assert texel(link)[0] == list(RED)
    # A mesh from elsewhere gains nothing by a link in a named folder.
    foreign = tmp_path / "foreign" / "mesh"
    shutil.copytree(mesh.parent, foreign)
    shutil.copytree(tmp_path / "kit" / "shared", foreign.parent / "shared")
    link = tmp_path / "kit" / "links" / mesh.name
    link.parent.mkdir()
    link.symlink_to(foreign / mesh.name)
    assert texel(link)[0] != list(RED)


@pytest.mark.parametrize("case", ["obj library", "obj texture", "ply texture"])
def test_names_of_another_system_are_found_in_a_named_folder(case, tmp_path, monkeypatch):
    mesh, target = kit(tmp_path, case)
    mesh_text = [path for path in mesh.parent.iterdir() if path.suffix in (".obj", ".mtl", ".ply")]
    for path in mesh_text:
        path.write_text(path.read_text().replace("../shared/", "..\\Shared\\"))
    monkeypatch.setenv(ASSETS, str(tmp_path))
    colour, words = texel(mesh)
    assert colour == list(RED) and "found by its name at ../shared/" in words and target in files(mesh)


@pytest.mark.parametrize(("value", "words"), [("kit", "a relative path"), ("{}/absent", "not a folder")])
@pytest.mark.parametrize("case", ["obj library", "gltf image", "ply texture", "usd layer"])
def test_an_entry_that_is_no_absolute_folder_is_a_wrong_setting(case, value, words, tmp_path, monkeypatch):
    mesh, _ = kit(tmp_path, case)
    monkeypatch.setenv(ASSETS, os.pathsep.join([str(tmp_path), value.format(tmp_path)]))
    with pytest.raises(UsageError, match=f"{ASSETS} names .*, which is {words}; expected absolute paths"):
        read_mesh(mesh)


def test_no_fix_names_a_folder_that_is_too_wide(tmp_path, monkeypatch):
    home = tmp_path / "home" / "ann"
    for place in ("a", "b"):
        picture(home / place / "red.png", RED)
    picture(tmp_path / "home" / "red.png", RED)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "home" / "ann" / "b"))
    monkeypatch.delenv(ASSETS, raising=False)
    fix = partial(remedy, home / "a" / "c" / "box.obj", first="Copy it")
    assert (
        fix(home / "a" / "red.png")
        == f"Copy it, or set {ASSETS}={home / 'a'} (meshes there may name each other's files)"
    )
    for target in (
        home / "b" / "red.png",
        tmp_path / "home" / "red.png",
        Path("/etc/passwd"),
        home / "a" / "absent.png",
    ):
        assert fix(target) == "Copy it"
    assert remedy(home / "b" / "c" / "box.obj", home / "b" / "red.png", "Copy it", ["flatten"]) == "Copy it, or flatten"


@links
def test_a_layer_behind_a_link_names_files_by_its_own_folder(tmp_path):
    """USD resolves `..` from the link's folder, which may be another one than the checked one."""
    pytest.importorskip("pxr")
    for name in ("in/sub", "out"):
        (tmp_path / name).mkdir(parents=True)
    shutil.copy(usda(tmp_path / "out"), tmp_path / "secret.usda")
    (tmp_path / "in" / "secret.usda").write_text("#usda 1.0\n")
    (tmp_path / "in" / "sub" / "real.usda").write_text("#usda 1.0\n(subLayers = [@../secret.usda@])\n")
    (tmp_path / "in" / "link.usda").symlink_to("sub/real.usda")
    (tmp_path / "in" / "a.usda").write_text("#usda 1.0\n(subLayers = [@./link.usda@])\n")
    with pytest.raises(InputRefused, match="a link to a layer that names"):
        read_mesh(tmp_path / "in" / "a.usda")
