"""The doctor's table: complete, true of this machine, and with a command where something is missing."""

import json

import pytest

from mistyle.cli import doctor
from mistyle.setup import facts, llvm


@pytest.fixture(scope="module")
def rows() -> dict[str, facts.Row]:
    """What it finds on the machine that runs the tests."""
    return {row.name.strip(): row for row in facts.rows(2)}


def test_the_machine_that_runs_the_tests_can_do_the_main_job(rows):
    assert facts.works(list(rows.values()))
    assert {"mistyle", "Python", "system", "packages", "mitsuba", "GPU", "torch", "LLVM", "node"} <= set(rows)
    assert {"VGG-19 weights", "usd", "ray", "render farm", "diffusion stylizers"} <= set(rows)
    assert rows["mitsuba"].found.startswith("3.9.")
    assert any(row.state == "ok" for name, row in rows.items() if name.endswith("_ad_rgb"))


def test_json_is_one_object_and_the_exit_code_tells(monkeypatch, capsys):
    row = facts.Row("LLVM", "none [bold]that[/bold] works", "missing", "brew install llvm")
    monkeypatch.setattr(facts, "rows", lambda _: [row])
    assert doctor.main(json=True) == 4
    report = json.loads(capsys.readouterr().out)
    assert not report["works"] and report["rows"] == [row._asdict()]
    assert doctor.main() == 4
    table = capsys.readouterr().out
    assert "brew install llvm" in table
    assert "[bold]that" in table, "what was found is text, not markup"


def test_without_a_working_variant_the_command_is_named(monkeypatch):
    monkeypatch.setattr(llvm, "probe", lambda *_: llvm.Answer(False, why="LLVM ERROR: Cannot select"))
    found = {row.name.strip(): row for row in facts._renderers()}
    assert found["llvm_ad_rgb"].state == "missing"
    assert found["llvm_ad_rgb"].fix == llvm.command()
    assert "Cannot select" in found["llvm_ad_rgb"].found


def test_weights_that_are_named_but_absent_are_told(monkeypatch, tmp_path):
    monkeypatch.setenv("MISTYLE_VGG", str(tmp_path / "vgg.pth"))
    assert facts._weights().state == "optional" and "does not exist" in facts._weights().found
    (tmp_path / "vgg.pth").touch()
    assert facts._weights().state == "ok"


def test_another_version_than_the_pinned_is_named(monkeypatch):
    monkeypatch.setattr(facts, "_version", lambda name: "0.0.1" if name == "scipy" else "")
    assert facts._packages()[0].state == "missing"
    monkeypatch.undo()
    real = facts._version
    monkeypatch.setattr(facts, "_version", lambda name: "0.0.1" if name == "scipy" else real(name))
    assert "scipy 0.0.1 for" in facts._packages()[0].found


def test_torch_and_its_cuda_version_are_read_without_importing_it():
    import torch

    assert facts._torch_cuda() == (torch.version.cuda or "")
