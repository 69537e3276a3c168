"""Damaged and hostile files of every format: each is read, or refused with one sentence. What must hold is told in
benchmarks/faults/inputs.py; `python -m benchmarks.faults.inputs` tries thousands."""

import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.faults.corpus import Seed, png, seeds
from benchmarks.faults.damage import damaged
from benchmarks.faults.inputs import GIGABYTES, commands, listing, outcome, peak_reader_gb

SEEDS = seeds()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: seed.name)
def test_undamaged_files_are_read(seed: Seed, place: Path):
    """The seeds are good files: else the damaged ones would test little. Only what their UVs or channels are not good
    for may be refused."""
    found = outcome(seed, seed.files, place / "given")
    assert found.what == "read" or ("UVs cannot be kept" in found.sentence or "expected R, G and B" in found.sentence)


@settings(max_examples=300, suppress_health_check=list(HealthCheck))
@given(choices=st.data())
def test_damaged_files_are_read_or_refused_with_a_sentence(choices: st.DataObject, place: Path):
    seed = SEEDS[choices.draw(st.integers(0, len(SEEDS) - 1))]
    files = damaged(seed, lambda count: choices.draw(st.integers(0, count - 1)))
    found = outcome(seed, files, place / "given")
    assert found.held, f"{found.seed}: {found.what}"
    assert peak_reader_gb() < GIGABYTES


def test_nothing_is_written_outside(place: Path, monkeypatch: pytest.MonkeyPatch):
    """Neither beside the input, nor into the working folder, nor into the temporary one."""
    for name in ("work", "tmp"):
        (place / name).mkdir()
    monkeypatch.chdir(place / "work")
    monkeypatch.setenv("TMPDIR", str(place / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)
    for k, seed in enumerate(SEEDS):
        outcome(seed, damaged(seed, random.Random(k).randrange), place / "given")
    assert not listing(place / "work") and not listing(place / "tmp")


def test_the_command_line_answers_with_its_exit_codes(place: Path):
    (place / "commands").mkdir()
    (place / "commands" / "style.png").write_bytes(png())
    found = commands(2, place / "commands", print)
    assert all(result.held for result in found), found
