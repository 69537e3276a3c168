"""Exposures of 8-bit pictures under known light: solved by default, and left alone where the pictures agree."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import mistyle
from benchmarks.captures.phone import Drawn, gains, photograph
from benchmarks.material_recovery.pictures import Shot
from mistyle.cli.main import main
from mistyle.core.light import Lights
from mistyle.fitting.pipeline.job import MaterialJob
from mistyle.fitting.pipeline.photometry import photometry_mode
from mistyle.fitting.settings.material import MaterialSettings, PhotometrySettings
from mistyle.io.read_mesh import read_mesh
from mistyle.solver.photometry import material as with_material
from mistyle.solver.photometry.record import Gains
from tests.fitting.test_material import KEYS, SIDE, SIZE, bowl, orbit, photographed
from tests.fitting.test_passes import hashes

QUICK = {
    "recover": {"solver": "texels", "rounds": 1, "solver_iterations": 4, "bounces": 0, "joint": 0},
    "report": {"detail": "none"},
    "atlas": {"size": SIZE},
}


@pytest.fixture(scope="module", autouse=True)
def few():
    """Half of the usual observations of a picture, which the solver's time is proportional to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(with_material, "OBSERVATIONS", 150 * 16)
        patch.setattr(with_material, "LEAST_EACH", 150)
        yield


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A mesh file, and linear pictures of 8 cameras under two lights fixed to them, one at a time."""
    folder = tmp_path_factory.mktemp("known")
    bowl(folder / "bowl.obj")
    cameras = [replace(c, name=f"{c.name}_{k}") for c in orbit(8, 0.55, SIDE) for k in range(2)]
    rigs: list[Lights] = [(replace(light, irradiance=(1.0, 1.0, 1.0)),) for _ in range(8) for light in KEYS]
    views = photographed(read_mesh(folder / "bowl.obj", size=SIZE).mesh, cameras, rigs)
    pictures = [np.concatenate([view.rgb, view.coverage[..., None]], axis=-1) for view in views]
    shots = [Shot(camera, rig) for camera, rig in zip(cameras, rigs, strict=True)]
    return Drawn(folder / "bowl.obj", cast(Any, None), shots, pictures)


def test_exposures_under_known_light_are_solved_and_said(drawn, tmp_path, capsys):
    done = gains(len(drawn.shots), 1)
    photograph(tmp_path / "shots", drawn, done)
    words = ["--atlas", SIZE, "--set", "recover.solver=texels", "--set", "recover.bounces=0", "--report", "none"]
    words += ["--set", "recover.joint=0", "--set", "recover.rounds=1", "--set", "recover.solver_iterations=4"]
    shots = [tmp_path / "shots", "--masks", tmp_path / "shots" / "masks", "-o", tmp_path / "out"]
    assert main([str(word) for word in ("fit", drawn.file, *shots, *words)]) == 0
    assert "--photometry none" in capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "run.json").read_text())["photometry"]
    assert found["applied"]
    solved = np.array([np.log(2) * found["ev"][s.camera.name] + np.log(found["white_balance"][s.camera.name])
                       for s in drawn.shots])  # fmt: skip
    assert np.abs(np.expm1(solved - done.gain)).max() < 0.02


def test_pictures_that_agree_give_the_bytes_of_a_fit_without_photometry(drawn, tmp_path):
    nothing = Gains(np.zeros((len(drawn.shots), 3)), np.zeros(3))
    photograph(tmp_path / "shots", drawn, nothing)
    fits = []
    for mode in ("auto", "none"):
        words = {"masks": tmp_path / "shots" / "masks", "photometry": {"mode": mode}}
        summary = mistyle.fit(drawn.file, tmp_path / "shots", tmp_path / mode, **words, **QUICK)
        fits.append((summary["notes"], hashes(tmp_path / mode)))
    assert any("nothing was corrected" in note for note in fits[0][0])
    assert fits[0][1] == fits[1][1]


@pytest.mark.parametrize("lights", ["unknown", None])
def test_8_bit_pictures_without_exposures_are_solved_for(lights):
    job = MaterialJob(Path("a.obj"), Path("b"), Path("c"), MaterialSettings(), "a", lights)
    jpegs, floats = ([SimpleNamespace(picture=Path(f"k.{kind}"))] * 3 for kind in ("jpg", "exr"))
    assert photometry_mode(job, jpegs) == "full"
    assert photometry_mode(job, floats) == photometry_mode(job, [*jpegs, *floats]) == "none"
    assert photometry_mode(replace(job, exposure=Path("ev.json")), jpegs) == "none"
    chosen = MaterialSettings(photometry=PhotometrySettings(mode="exposure"))
    assert photometry_mode(replace(job, settings=chosen), floats) == "exposure"
