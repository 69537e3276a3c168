"""What a job will need, said before it begins, and what is refused."""

import argparse
import json

import pytest

from mistyle.cli.main import main
from mistyle.cli.options import gigabytes
from mistyle.core.errors import UsageError
from mistyle.fitting.pipeline import budget as material_budget
from mistyle.fitting.pipeline.job import MATERIAL_STAGES
from mistyle.fitting.settings.material import MATERIAL_PRESETS, MaterialSettings
from mistyle.jobs import memory_budget as budget
from mistyle.jobs.settings import resolve as settings_of
from mistyle.process import memory
from mistyle.stylization.pipeline import budget as stylize_budget
from mistyle.stylization.pipeline.job import FINISH, STAGES
from mistyle.stylization.pipeline.plan import lit_seconds
from mistyle.stylization.settings import Settings, resolve


def job(**more) -> Settings:
    return resolve("draft", None, more, {})


@pytest.mark.parametrize(
    ("text", "expected"), [("4G", 4.0), ("4GB", 4.0), ("4096M", 4.096), ("1.5g", 1.5), ("2", 2.0), ("0.5T", 500.0)]
)
def test_amounts_of_memory(text, expected):
    assert gigabytes(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "much", "0", "-3G", "4X", "nan", "1e9"])
def test_what_is_no_amount_of_memory(text):
    with pytest.raises(argparse.ArgumentTypeError, match="not a valid memory size; write 4G"):
        gigabytes(text)


def test_every_stage_has_its_needs():
    assert set(stylize_budget.PLAIN) == set(stylize_budget.TILED) == {*STAGES, *FINISH}
    assert set(material_budget.MATERIAL) <= set(MATERIAL_STAGES)


def test_more_of_anything_needs_no_less():
    fitted = {"refine": "all"}
    least = stylize_budget.memory_gb(job(fit=fitted))
    more = [
        {"atlas": {"size": 4096}},
        {"rig": {"resolution": 2048}},
        {"rig": {"kind": "turntable", "views": 200}},
        {"fit": fitted | {"crops": 16, "crop_size": 512}},
        {"report": {"frames": 240, "resolution": 2048}},
    ]
    for change in more:
        assert stylize_budget.memory_gb(job(**{"fit": fitted} | change)) > least, change
    # Files take the place of memory: what has to be there all the same is less.
    counts = stylize_budget.counts(job(atlas={"size": 8192}))
    plain, tiled = (budget.peaks(needs, counts) for needs in (stylize_budget.PLAIN, stylize_budget.TILED))
    assert max(tiled.values()) < 0.6 * max(plain.values())


def test_a_budget_that_is_large_enough_changes_nothing_and_a_small_one_tiles():
    large = {"atlas": {"size": 4096}}
    whole = stylize_budget.memory_gb(job(**large))
    assert not stylize_budget.tiles(job(**large)) and not stylize_budget.tiles(job(**large, memory=whole + 0.1))
    assert stylize_budget.tiles(job(**large, memory=whole - 0.5))
    assert stylize_budget.memory_gb(job(**large, memory=whole - 0.5)) <= whole - 0.5
    # Two texture sets are twice the texels.
    assert stylize_budget.tiles(job(**large, memory=whole + 0.1), sets=2)


def test_the_refusal_names_what_would_work():
    asked = job(atlas={"size": 8192}, memory=1.0)
    with pytest.raises(UsageError) as caught:
        stylize_budget.tiles(asked)
    text = str(caught.value)
    smallest = float(text.split("give it --memory ")[1].split("G")[0])
    assert stylize_budget.tiles(job(atlas={"size": 8192}, memory=smallest))
    with pytest.raises(UsageError):
        stylize_budget.tiles(job(atlas={"size": 8192}, memory=smallest - 0.2))
    assert "--set atlas.size=4096" in text
    need = float(text.rsplit("which needs ", 1)[1].split()[0])
    assert stylize_budget.tiles(job(atlas={"size": 4096}, memory=need))


def test_a_fit_to_pictures_keeps_less_of_their_samples_or_is_refused():
    settings = settings_of("draft", None, {}, {}, root=MaterialSettings, presets=MATERIAL_PRESETS)
    pixels = [1024**2] * 48
    assert material_budget.check_material(settings, pixels) is settings
    free = material_budget.material_gb(settings, pixels)
    kept = material_budget.check_material(settings.model_copy(update={"memory": free - 1}), pixels)
    assert 0 < kept.recover.memory < settings.recover.memory
    assert material_budget.material_gb(kept, pixels) <= free - 0.9
    with pytest.raises(UsageError, match=r"--memory 0\.5G: the fit needs .* even without a cache"):
        material_budget.check_material(settings.model_copy(update={"memory": 0.5}), pixels)


def test_a_large_mesh_is_refused_by_a_budget_in_words_only(monkeypatch):
    """What reading and unwrapping take is not known well enough to refuse a job that nobody bounded."""
    monkeypatch.setattr(memory, "limit", lambda: int(8e9))
    assert not stylize_budget.tiles(job(), faces=5_000_000)
    with pytest.raises(UsageError, match="in its stage 'mesh'"):
        stylize_budget.tiles(job(memory=8.0), faces=5_000_000)


def test_the_machines_memory_cuts_nothing_of_a_fit(monkeypatch):
    """A fit that keeps fewer samples may leave out steps: only who gives a budget may ask for that."""
    settings = settings_of("draft", None, {}, {}, root=MaterialSettings, presets=MATERIAL_PRESETS)
    pixels = [1024**2] * 48
    whole = material_budget.material_gb(settings, pixels)
    monkeypatch.setattr(memory, "limit", lambda: int((whole + 0.1) / budget.SHARE * 1e9))
    assert material_budget.check_material(settings, pixels) is settings
    monkeypatch.setattr(memory, "limit", lambda: int((whole - 1) / budget.SHARE * 1e9))
    with pytest.raises(UsageError, match=r"the fit needs .* GB; give it --memory .* smaller cache of the pictures"):
        material_budget.check_material(settings, pixels)
    assert material_budget.check_material(settings.model_copy(update={"memory": whole - 1}), pixels).recover.memory < 4
    monkeypatch.setattr(memory, "limit", lambda: int(0.6e9))
    with pytest.raises(UsageError, match="even without a cache"):
        material_budget.check_material(settings, pixels)


def test_the_command_line_plans_and_refuses(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "out"), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["memory_gb"] == pytest.approx(max(told["peaks_gb"].values()), abs=0.01) and not told["in_files"]
    seconds = {row["stage"]: row["seconds"] for row in told["stages"]}
    assert seconds["fit"] == seconds["masks"] == seconds["repair"] == 0 < seconds["surface"]
    assert main(["demo", "-o", str(tmp_path / "out"), "--dry-run", "--json", "--set", "fit.refine=all"]) == 0
    fitted = {row["stage"]: row["seconds"] for row in json.loads(capsys.readouterr().out)["stages"]}
    assert fitted["fit"] > 5 and fitted["repair"] > 0
    assert main(["demo", "-o", str(tmp_path / "out"), "--memory", "300M"]) == 2
    assert "--memory 0.3G: the job needs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists(), "refused before anything is made"


def test_the_solve_of_lit_views_is_counted(tmp_path):
    """Diffusion's views show light: they are solved for, where their light is known and the settings ask for it."""
    texels, lit = 1024**2, {"stylizer": "diffusion"}
    solved = lit_seconds(job(**lit), texels)
    assert solved > 10 > 0 == lit_seconds(job(), texels) == lit_seconds(job(**lit, fit={"solve": False}), texels)
    assert lit_seconds(job(**lit, rig={"resolution": 1024}), texels) > solved
    assert lit_seconds(job(**lit, rig={"kind": "turntable", "views": 8, "resolution": 512}), texels) < solved
    # Texels that the views do not resolve are not solved for.
    assert lit_seconds(job(**lit), 64 * texels) == pytest.approx(solved, rel=0.7)
    assert lit_seconds(job(**lit, draw={"scene": tmp_path / "own.xml"}), texels) == 0
