"""Meshes that are reached through a link: what they name lies beside the link, or beside the file that it leads to."""

import sys

import pytest

from mistyle.core.errors import InputRefused
from mistyle.io.sandbox.bounds import beside
from tests.support.named_files import BLUE, RED, colour, files, gltf, obj, picture, usda

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")


@pytest.mark.parametrize("make", [obj, gltf, usda])
def test_what_a_linked_mesh_names_lies_beside_the_file(tmp_path, make):
    (tmp_path / "store").mkdir()
    (tmp_path / "scene").mkdir()
    mesh = make(tmp_path / "store")
    link = tmp_path / "scene" / mesh.name
    link.symlink_to(mesh)
    assert colour(link) == list(RED)
    # What a key is made of are the same files.
    assert tmp_path / "store" / "maps" / "red.png" in files(link)


@pytest.mark.parametrize("make", [obj, gltf])
def test_what_lies_beside_the_link_comes_first(tmp_path, make):
    (tmp_path / "store").mkdir()
    mesh = make(tmp_path / "store")
    scene = tmp_path / "scene"
    picture(scene / "maps" / "red.png", BLUE)
    (scene / mesh.name).symlink_to(mesh)
    if make is obj:
        (scene / "box.mtl").write_text("newmtl m\nmap_Kd maps/red.png\n")
    assert colour(scene / mesh.name) == list(BLUE)


def test_a_link_leads_nowhere_else(tmp_path):
    for name in ("store", "scene", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "t.png").write_bytes(b"x")
    (tmp_path / "store" / "box.obj").write_text("")
    link = tmp_path / "scene" / "box.obj"
    link.symlink_to(tmp_path / "store" / "box.obj")
    # Each of the two folders is the mesh's own, however it is spelled; all others are not.
    assert beside(link, "t.png") == tmp_path / "scene" / "t.png"
    assert beside(link, "../store/t.png") == tmp_path / "store" / "t.png"
    assert beside(link, "absent.png") == tmp_path / "scene" / "absent.png"
    (tmp_path / "scene" / "out.png").symlink_to(tmp_path / "other" / "t.png")
    (tmp_path / "store" / "out.png").symlink_to(tmp_path / "other" / "t.png")
    for name in ("../other/t.png", "../t.png", "out.png", str(tmp_path / "other" / "t.png")):
        with pytest.raises(InputRefused, match="a file inside the mesh's own folder"):
            beside(link, name)
    loop = tmp_path / "scene" / "loop"
    loop.symlink_to(loop)
    with pytest.raises(InputRefused):
        beside(link, "loop/t.png")
