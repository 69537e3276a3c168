"""A folder as a batch: what takes part, and that everything else is named."""

import json
import shutil

import pytest

from mistyle.batch import folder_jobs as module
from mistyle.batch.folder_jobs import folder_jobs
from mistyle.batch.pipeline import Choices, opening_notes, planned, run_batch
from mistyle.cli.main import main
from mistyle.core.errors import InputRefused
from tests.support.batch_parts import CUBE, stand_in

ONE = Choices(threads=1)


@pytest.fixture
def mixed(props):
    """A folder with two meshes, two styles, and one of each kind that takes no part."""
    for path in [*(props / "meshes").iterdir(), *(props / "styles").iterdir()]:
        path.rename(props / path.name)
    (props / "meshes").rmdir()
    (props / "styles").rmdir()
    for name in ("a.fbx", "b.BLEND", "c.abc", "d.dae", "e.max", "style.psd"):
        (props / name).write_bytes(b"?")
    (props / "cube.obj").write_text("mtllib cube.mtl\nusemtl skin\n" + CUBE)
    (props / "cube.mtl").write_text("newmtl skin\nmap_Kd cube_skin.png\nnorm bumps.exr\n")
    (props / "bumps.exr").write_bytes(b"?")
    shutil.copy(props / "wave.png", props / "cube_skin.png")
    for place in ("sub", "sub/deeper", ".hidden", "out"):
        (props / place).mkdir()
        (props / place / "deep.obj").write_text(CUBE)
    (props / "out" / ".mistyle.written").write_text("{}")
    return props


def test_what_takes_no_part_is_named(mixed):
    found = folder_jobs(mixed)
    assert [p.name for p in found.meshes] == ["box.obj", "cube.obj"]
    assert [p.name for p in found.styles] == ["ink.jpg", "wave.png"]
    formats, pictures, textures, deeper = found.left_out
    assert "5 files of mesh formats" in formats and "a.fbx, b.BLEND, c.abc, d.dae and 1 more" in formats
    assert "1 picture of formats" in pictures and "style.psd" in pictures and "bumps.exr" not in pictures
    assert "1 picture that meshes name as their textures, hence not styles: cube_skin.png" in textures
    assert "2 meshes in other folders: sub (1), sub/deeper (1)" in deeper


def test_images_of_a_gltf_file_are_its_textures(props):
    tree = {"asset": {"version": "2.0"}, "images": [{"uri": "skin%20of%20it.png"}]}
    (props / "meshes" / "it.gltf").write_text(json.dumps(tree))
    shutil.copytree(props / "styles", props / "meshes", dirs_exist_ok=True)
    shutil.copy(props / "styles" / "wave.png", props / "meshes" / "skin of it.png")
    found = folder_jobs(props / "meshes")
    assert [p.name for p in found.styles] == ["ink.jpg", "wave.png"] and "skin of it.png" in found.left_out[0]


def test_a_folder_that_is_wholly_taken_has_no_notes(props):
    assert folder_jobs(props).left_out == () and not opening_notes(planned(props, props / "out", ONE))


def test_what_lies_beside_the_subfolders_is_named(props):
    shutil.copy(props / "meshes" / "box.obj", props / "late.obj")
    shutil.copy(props / "styles" / "ink.jpg", props / "late.jpg")
    (props / "meshes" / "x.fbx").write_bytes(b"?")
    text = "\n".join(folder_jobs(props).left_out)
    assert "late.jpg" in text and "the folder itself (1)" in text and "x.fbx" in text


def test_a_very_large_tree_is_counted_in_part(mixed, monkeypatch):
    monkeypatch.setattr(module, "MOST_ENTRIES", 1)
    assert "at least 1 mesh in other folders: sub (1);" in folder_jobs(mixed).left_out[-1]
    for k in range(3):
        (mixed / "a").mkdir(exist_ok=True)
        (mixed / "a" / f"{k}.txt").write_text("")
    assert "the subfolders; 3 files" in folder_jobs(mixed).left_out[-1]


def test_a_refusal_names_what_was_left_out(mixed):
    for name in ("wave.png", "ink.jpg"):
        (mixed / name).unlink()
    with pytest.raises(InputRefused, match="0 style pictures") as refused:
        planned(mixed, mixed / "out", ONE)
    assert "cube_skin.png" in str(refused.value)


def test_console_summary_page_and_plan_say_it(mixed, tmp_path, monkeypatch, capsys):
    assert main(["batch", str(mixed), "-o", str(tmp_path / "out"), "--dry-run", "--json"]) == 0
    said = capsys.readouterr()
    left_out = json.loads(said.out)["left_out"]
    assert len(left_out) == 4 and all(text in said.err for text in left_out)
    stand_in(monkeypatch, "import sys; sys.exit(9)")
    summary = run_batch(planned(mixed, tmp_path / "out", ONE), ONE)
    assert summary["left_out"] == left_out
    page = (tmp_path / "out" / "batch.html").read_text()
    assert "a.fbx, b.BLEND" in page and "deeper (1)" in page
    assert opening_notes(planned(tmp_path / "out", None, ONE)) == left_out
