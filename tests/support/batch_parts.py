"""Parts of tests of batches: jobs files, finished jobs without the work, shards that run something else."""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from mistyle.batch import engines
from mistyle.batch.shard import key_of, marker
from mistyle.io.store.atomic import sha256_file
from mistyle.io.store.output import keep_folder

CUBE = """v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 4 7 3\nf 4 8 7\nf 1 5 8\nf 1 8 4\nf 2 3 7\nf 2 7 6
"""


def write_props(folder: Path) -> Path:
    """Two meshes and two pictures."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "styles").mkdir()
    for name in ("cube", "box"):
        (folder / "meshes" / f"{name}.obj").write_text(CUBE)
    rng = np.random.default_rng(0)
    for name in ("wave.png", "ink.jpg"):
        pixels = (rng.random((12, 16, 3)) * 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
        Image.fromarray(pixels).save(folder / "styles" / name)
    return folder


def jobs_file(folder: Path, text: str, name: str = "jobs.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def done_by_hand(plan, index: int) -> None:
    """What a finished shard leaves behind, without the work."""
    job = plan.jobs[index]
    asset = plan.out / job.name / "asset" / "a.glb"
    asset.parent.mkdir(parents=True)
    asset.write_bytes(b"glTF")
    keep_folder(plan.out / job.name, "asset")
    keep_folder(plan.out, "shards")

    told = {
        "name": job.name, "key": key_of(job), "files": {f"{job.name}/asset/a.glb": sha256_file(asset)},
        "inputs": [str(job.mesh), str(job.style)], "seconds": 3.5, "peak_gb": 1.0, "figures": {"style": 0.5},
    }  # fmt: skip
    marker(plan, job).parent.mkdir(parents=True, exist_ok=True)
    marker(plan, job).write_text(json.dumps(told))


def stand_in(monkeypatch, script: str) -> None:
    """Shards that run `script` with the job's number as its argument instead."""
    monkeypatch.setattr(engines, "command", lambda plan, index, maps=(): [sys.executable, "-c", script, str(index)])
