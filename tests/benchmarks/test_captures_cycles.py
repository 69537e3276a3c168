"""benchmarks.captures --only cycles: its refusal and its measures. No Blender is needed."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.captures import cycles as captures_cycles
from benchmarks.material_recovery.metrics import best_constant
from mistyle.core.maps import Maps


def test_without_blender_it_is_refused_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("MISTYLE_BLENDER_PYTHON", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit, match=r"found no Blender; expected \$MISTYLE_BLENDER_PYTHON"):
        captures_cycles.cycles(tmp_path, quick=True)


def test_a_factor_per_channel_is_forgiven_by_one_figure_alone(rng):
    picture = np.concatenate([rng.uniform(0.1, 0.4, (32, 32, 3)), np.ones((32, 32, 1))], axis=-1).astype(np.float32)
    tinted = picture * np.array([1.2, 0.9, 1.1, 1.0], np.float32)
    found = captures_cycles.relit_errors("x", [picture], [tinted])
    assert found["x.relit_psnr"] < 30 < 100 < found["x.relit_psnr_scaled"]


def test_constant_maps_become_inputs_of_blenders_material():
    flat = np.zeros((4, 4, 3), np.float32) + np.array([0, 0, 1], np.float32)
    albedo = np.zeros((4, 4, 3), np.float32) + np.array([0.5, 0.25, 0.125], np.float32)
    maps = Maps(albedo, flat, np.full((4, 4), 0.3, np.float32), np.eye(4, dtype=np.float32), np.ones((4, 4), bool))
    (constant,) = best_constant([maps], [np.ones((4, 4))])
    assert captures_cycles.sockets(constant) == {
        "Base Color": pytest.approx([0.5, 0.25, 0.125, 1.0]),
        "Roughness": pytest.approx(0.3),
        "Metallic": pytest.approx(0.25),
    }
