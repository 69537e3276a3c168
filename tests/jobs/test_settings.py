"""Layers of settings: the later one wins, and the guilty one is named."""

import subprocess
import sys
from pathlib import Path

import pytest

from mistyle.core.errors import UsageError
from mistyle.fitting.settings.material import MATERIAL_PRESETS, MaterialSettings
from mistyle.jobs.settings import as_toml, assignments, known_keys
from mistyle.jobs.settings import resolve as settings_of
from mistyle.stylization.settings import PRESETS, Settings, resolve


def test_later_layers_win(tmp_path):
    config = tmp_path / "job.toml"
    config.write_text('preset = "draft"\nseed = 1\n[fit]\ncrops = 2\n[atlas]\nsize = 256\n')
    settings = resolve(None, config, {"seed": 3}, {"MISTYLE_SET": "seed=2; fit.crops=3"})
    assert (settings.seed, settings.fit.crops, settings.atlas.size) == (3, 3, 256)
    assert settings.rig.resolution == resolve("draft", None, {}, {}).rig.resolution


@pytest.mark.parametrize("preset", PRESETS)
def test_printed_settings_read_back_equal(tmp_path, preset):
    settings = resolve(preset, None, {}, {})
    path = tmp_path / "printed.toml"
    path.write_text(as_toml(settings))
    assert resolve("standard", path, {}, {}) == settings


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (
            {"fit": {"iteratons1": 3}},
            r"command line: there is no setting 'fit.iteratons1'; did you mean 'fit.iterations1'\?",
        ),
        ({"atlas": {"size": "large"}}, r"command line: atlas.size = 'large'"),
        ({"seed": -1}, r"command line: seed = -1"),
    ],
)
def test_wrong_settings_are_refused_with_their_path(said, expected):
    with pytest.raises(UsageError, match=expected):
        resolve(None, None, said, {})


@pytest.mark.parametrize("name", ["subsamples", "joint_subsamples"])
def test_samples_a_pixel_are_square_numbers(name):
    with pytest.raises(UsageError, match=rf"recover\.{name} = 24: expected a square number: 1, 4, 9"):
        settings_of(None, None, {"recover": {name: 24}}, {}, root=MaterialSettings, presets=MATERIAL_PRESETS)


def test_the_guilty_layer_is_named(tmp_path):
    config = tmp_path / "job.toml"
    config.write_text("sed = 1\n")
    with pytest.raises(UsageError, match=r"job.toml: there is no setting 'sed'; did you mean 'seed'"):
        resolve(None, config, {}, {})
    with pytest.raises(UsageError, match="MISTYLE_SET"):
        resolve(None, None, {}, {"MISTYLE_SET": "nonsense"})
    config.write_text("seed = = 1\n")
    with pytest.raises(UsageError, match="not a TOML file"):
        resolve(None, config, {}, {})
    with pytest.raises(UsageError, match="no such file"):
        resolve(None, Path(tmp_path / "absent.toml"), {}, {})


def test_assignments_nest_and_parse():
    assert assignments(["fit.crops=3", "fit.refine=off", "name=x"], "--set") == {
        "fit": {"crops": 3, "refine": "off"},
        "name": "x",
    }


def test_every_known_key_can_be_printed():
    assert {"seed", "fit.iterations1", "atlas.size"} <= set(known_keys(Settings))
    assert len(known_keys(Settings)) == len(set(known_keys(Settings)))
    assert Settings() == resolve("standard", None, {}, {}) or PRESETS["standard"]


def test_views_take_the_samples_that_their_use_needs():
    from mistyle.stylization.settings import DrawSettings

    assert (DrawSettings().samples(read=False), DrawSettings().samples()) == (1, 8)
    assert (DrawSettings(spp=3).samples(read=False), DrawSettings(spp=3).samples()) == (3, 3)


@pytest.mark.parametrize(
    ("preset", "change", "refined", "kept"),
    [
        ("draft", {}, "off", True),
        ("demo", {}, "off", True),
        ("standard", {}, "albedo", False),
        ("standard", {"stylizer": "diffusion"}, "all", False),
        ("draft", {"finish": {"method": "vgg"}, "fit": {"features": "vgg19"}}, "off", True),
        ("draft", {"fit": {"features": "vgg19"}}, "all", False),
        ("draft", {"stylizer": "embedded-view"}, "all", False),
        ("draft", {"stylizer": "diffusion"}, "all", False),
        ("draft", {"inpainter": "paint3d"}, "all", False),
        ("draft", {"fit": {"metallic": "fit"}}, "all", False),
        ("draft", {"fit": {"refine": "albedo"}}, "albedo", False),
        ("fine", {}, "all", False),
        ("fine", {"fit": {"refine": "off"}}, "off", True),
        ("paper", {}, "all", False),
    ],
)
def test_what_is_fitted_follows_what_painted_the_views(preset, change, refined, kept):
    settings = resolve(preset, None, change, {})
    assert (settings.refined, settings.keeps_painting) == (refined, kept)


@pytest.mark.parametrize(
    "module",
    [
        "stylization.settings",
        "fitting.settings.material",
        "fitting.settings.scene",
        "stylization.diffusion.train_settings",
    ],
)
def test_settings_are_read_without_the_stages_and_their_libraries(module):
    code = f"import sys, mistyle.{module}; print(*sys.modules)"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    )
    assert not loaded & {"numpy", "cv2", "scipy", "torch", "mitsuba", "drjit"}
    assert not any(name.startswith("mistyle.render") for name in loaded)
