"""The same inputs, settings, seed, kind of machine and thread count give the same bytes, stage by stage.

Two processes run every stage once (determinism_child.py) under circumstances that must not matter: another working
folder, another order of hashes, memory that is handed out filled with other values, so that what is read before it is
written shows, a budget of memory, for which arrays lie in files, and what the environment tells BLAS of threads.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.helpers import ROOT

# Without gradients, or with gradients that are gathers: no order of additions is left to the threads.
SAME_BYTES = (
    "read and unwrap",
    "texels",
    "views",
    "surface",
    "bake",
    "stylized",
    "fit phase 1",
    "fit phase 2",
    "repair",
    "occlusion",
    "asset: GLB, EXR, PNG",
    "delivered usda",
    "delivered usdz",
    "delivered mtlx",
    "delivered obj",
    "delivered png",
    "warp",
    "one view",
    "sweep",
    "bake from views",
    "compare: numbers",
    "compare: pictures",
    "recover: texels",
    "recover: pictures",
    "scene: pictures",
)
# Mitsuba's own texture gradient adds up by atomic operations: after six steps of Adam values differ by at most this.
TOLERANCE = {"scene fit": 1e-4}
SAID = "said.txt"
MALLOC_FILL = "MALLOC_PERTURB_"  # glibc: the byte whose complement fresh memory is filled with


def start(folder: Path, out: Path, budget: str = "0", **environment: str) -> subprocess.Popen[bytes]:
    folder.mkdir()
    child = ROOT / "tests" / "support" / "determinism_child.py"
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with open(folder / SAID, "wb") as said:
        return subprocess.Popen(
            [sys.executable, str(child), str(out), "2", budget],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": paths} | environment,
            stderr=said,
        )


@pytest.fixture(scope="module")
def twice(tmp_path_factory) -> tuple[Path, Path]:
    """The folders of two runs, side by side."""
    place = tmp_path_factory.mktemp("twice")
    outs = place / "first", place / "second"
    other = {"PYTHONHASHSEED": "4711", MALLOC_FILL: "85", "OPENBLAS_NUM_THREADS": "3"}
    running = [
        start(place / "here", outs[0], PYTHONHASHSEED="0"),
        start(place / "else where", outs[1], "1", **other),
    ]
    ended = [child.wait() for child in running]  # they end by themselves, see PATIENCE there
    for code, folder in zip(ended, ("here", "else where"), strict=True):
        assert code == 0, (place / folder / SAID).read_text()[-6000:]
    return outs


def digests(out: Path) -> dict[str, str]:
    return json.loads((out / "bytes.json").read_text())


def test_every_stage_is_looked_at(twice):
    found = digests(twice[0])
    missing = {"delivered usda", "delivered usdz"} if "delivered usda" not in found else set()
    assert set(found) == {*SAME_BYTES, *TOLERANCE} - missing


@pytest.mark.parametrize("stage", SAME_BYTES)
def test_same_bytes(twice, stage):
    first, second = (digests(out) for out in twice)
    assert first.get(stage) == second.get(stage)


@pytest.mark.parametrize("stage", TOLERANCE)
def test_within_its_tolerance(twice, stage):
    first, second = (np.load(out / f"{stage}.npz") for out in twice)
    for name in first.files:
        np.testing.assert_allclose(first[name], second[name], rtol=0, atol=TOLERANCE[stage])


def test_a_difference_would_show(twice, tmp_path):
    """One changed bit of one array is another digest, and so is another type or shape."""
    from tests.support.determinism_child import digest

    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    changed = values.copy()
    changed.view(np.uint32)[1, 2] ^= 1
    assert len({digest(v) for v in (values, changed, values.T.copy(), values.astype(np.float64))}) == 4
    assert digest({"a": values}) == digest({"a": values.copy()})


def test_distances_do_not_depend_on_where_the_result_lies_in_memory(rng):
    """OpenCV hands small masks to a library that takes roots in pieces set by the address of the result."""
    from scipy.ndimage import distance_transform_edt

    from mistyle.core.image import distance_to

    mask = rng.random((333, 517)) < 0.01
    exact = distance_transform_edt(~mask).astype(np.float32)
    held = []
    for size in (1, 17, 4097, 70_001, 1_000_003) * 4:
        held.append(np.empty(size, np.uint8))  # what comes next lies elsewhere
        assert np.array_equal(distance_to(mask), exact)
        assert np.array_equal(distance_to(mask[:96, :96]), distance_to(mask[:96, :96].copy()))
