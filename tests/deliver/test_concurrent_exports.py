"""Exports of several processes into one folder: no version is taken twice, and no two deliveries mix."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mistyle.core.errors import UsageError
from mistyle.deliver.asset import write_asset
from mistyle.deliver.exclusive import hold
from mistyle.deliver.export import DeliveryRequest, export
from mistyle.io.store.atomic import LOCK, sha256_file
from tests.support.gltf_cases import no_texels, quad, quarters

EXPORT = "import sys; from mistyle.cli.main import main; sys.exit(main(['export', *sys.argv[1:]]))"
HOLD = """
import sys, time
from pathlib import Path
from mistyle.deliver.exclusive import hold
with hold(Path(sys.argv[1])):
    print('held', flush=True)
    time.sleep(60)
"""


def run_folder(folder: Path, shade: float) -> Path:
    """A run folder whose asset differs from others of the same name by its albedo."""
    maps = quarters()
    parts = ([replace(maps, albedo=np.full_like(maps.albedo, shade))], [np.ones((16, 16), np.float32)], [no_texels()])
    write_asset(folder / "asset", "tile", quad(), *parts, provenance={})
    return folder


def together(runs: list[Path], out: Path, *options: str) -> list[tuple[int, str]]:
    """Export every run into `out` at once, one process each; their exit codes and stderr."""
    commands = [[sys.executable, "-c", EXPORT, str(run), "-o", str(out), *options] for run in runs]
    children = [subprocess.Popen(c, stderr=subprocess.PIPE, text=True) for c in commands]
    told = [child.communicate(timeout=300)[1] for child in children]
    return [(child.returncode, text) for child, text in zip(children, told, strict=True)]


def listings(out: Path) -> list[dict]:
    """The lists in a folder; every file is as its list has it."""
    lists = [json.loads(p.read_text()) for p in sorted(out.glob("*.export.json"))]
    for listing in lists:
        for entry in listing["files"]:
            assert sha256_file(out / entry["file"]) == entry["sha256"], entry["file"]
    return lists


def test_exports_at_once_take_different_versions(tmp_path):
    runs = [run_folder(tmp_path / f"run{k}", 0.2 + 0.2 * k) for k in range(3)]
    out = tmp_path / "delivered"
    for code, text in together(runs, out, "--name", "{asset}_v{v:03}"):
        assert code == 0, text
    lists = listings(out)
    assert [listing["version"] for listing in lists] == [1, 2, 3]
    assert len({listing["of"] for listing in lists}) == 3
    assert not (out / LOCK).exists()


def test_exports_of_one_name_at_once_do_not_mix(tmp_path):
    runs = [run_folder(tmp_path / f"run{k}", 0.2 + 0.5 * k) for k in range(2)]
    out = tmp_path / "delivered"
    for code, text in together(runs, out):
        assert code == 0, text
    (listing,) = listings(out)
    assert (out / "tile.glb").read_bytes() in [(run / "asset" / "tile.glb").read_bytes() for run in runs]
    assert sorted(p.name for p in out.iterdir() if p.is_file() and not p.name.startswith(".")) == [
        "tile.export.json",
        "tile.glb",
    ]
    assert listing["name"] == "tile"


def test_an_export_waits_for_another_and_a_killed_one_blocks_nobody(tmp_path):
    run, out = run_folder(tmp_path / "run", 0.5), tmp_path / "delivered"
    child = subprocess.Popen([sys.executable, "-c", HOLD, str(out / LOCK)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "held\n"
    waiting = subprocess.Popen(
        [sys.executable, "-c", EXPORT, str(run), "-o", str(out)], stderr=subprocess.PIPE, text=True
    )
    assert waiting.stderr is not None
    first = waiting.stderr.readline()
    assert first.startswith("waiting up to") and str(child.pid) in first
    assert waiting.poll() is None and not (out / "tile.glb").exists()
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    assert (out / LOCK).exists()
    assert waiting.wait(timeout=60) == 0
    assert (out / "tile.glb").exists() and not (out / LOCK).exists()


def test_waiting_ends_with_a_sentence_that_names_the_holder(tmp_path):
    place = tmp_path / LOCK
    told: list[str] = []
    with (
        hold(place),
        pytest.raises(UsageError, match=f"process {os.getpid()}"),
        hold(place, told.append, 0.5),
    ):
        pass
    assert len(told) == 1 and not place.exists()


def test_a_refused_export_leaves_no_folder(tmp_path):
    run = run_folder(tmp_path / "run", 0.5)
    (run / "asset" / "tile.glb").unlink()
    with pytest.raises(Exception, match="found nothing"):
        export(run, tmp_path / "new" / "delivered", DeliveryRequest(formats=["maps"], target="blender"))
    assert not (tmp_path / "new").exists()


def test_an_equal_delivery_needs_no_lock(tmp_path):
    run, out = run_folder(tmp_path / "run", 0.5), tmp_path / "delivered"
    request = DeliveryRequest(formats=["glb"], target="blender")
    files = export(run, out, request)
    since = time.monotonic()
    with hold(out / LOCK):
        assert export(run, out, request) == files
    assert time.monotonic() - since < 5
