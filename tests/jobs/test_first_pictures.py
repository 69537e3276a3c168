"""The asset before it is fitted, the preview, and reports of every size: which files are there, and what is said."""

import json
import re
import shutil

import numpy as np
import pytest

from mistyle.cli.main import main
from mistyle.core.errors import Stopped, UsageError
from mistyle.deliver.read_asset import read_finished
from mistyle.io.read import read_picture
from mistyle.jobs.progress import Progress
from mistyle.jobs.report.pictures import Encoder
from mistyle.stylization.pipeline import preview
from mistyle.stylization.pipeline import stylize as pipeline
from mistyle.stylization.settings import resolve
from tests.stylization.test_pipeline import inputs, job  # noqa: F401  (a fixture)


class Heard(Progress):
    """Keeps what is said."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)


def sized(job, **report):
    settings = job.settings
    return job.__class__(
        **{**vars(job), "settings": settings.model_copy(update={"report": settings.report.model_copy(update=report)})}
    )


@pytest.fixture(scope="module")
def stopped(inputs, tmp_path_factory):  # noqa: F811
    """A job that is stopped as its fit begins: its folder, of which tests take copies, and what was said."""

    def stop(*_):
        raise Stopped("stopped")

    out, progress = tmp_path_factory.mktemp("stopped") / "out", Heard()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "fit", stop)
        with pytest.raises(Stopped):
            pipeline.stylize(job(inputs, out), progress)
    return out, progress.lines


def test_the_first_asset_is_announced_before_the_fit_and_replaced_after_it(inputs, stopped, tmp_path):  # noqa: F811
    folder, lines = stopped
    told = next(k for k, line in enumerate(lines) if "painted and baked" in line)
    assert str(folder / "asset" / "bell.glb") in lines[told] and re.search(r"\d+ s after the start", lines[told])
    starts = {name: next(k for k, line in enumerate(lines) if line.startswith(name)) for name in ("bake the", "fit ")}
    assert starts["bake the"] < told < starts["fit "]
    out = shutil.copytree(folder, tmp_path / "out")
    assert json.loads((out / "asset" / "done.json").read_text())["first"] is True
    assert json.loads((out / "run.json").read_text())["finished"] is False
    early = read_finished(out)
    assert "not fitted" in early.manifest["provenance"]["state"]
    first = early.sets[0]
    (out / "asset" / "mine.txt").write_text("mine")
    again = Heard()
    pipeline.stylize(sized(job(inputs, out), detail="none"), again)
    assert not any("painted and baked" in line for line in again.lines), "what is there is not written again"
    late = read_finished(out)
    assert not np.array_equal(late.sets[0].normal, first.normal) and "state" not in late.manifest["provenance"]
    assert "first" not in json.loads((out / "asset" / "done.json").read_text())
    assert json.loads((out / "run.json").read_text())["finished"] is True
    assert (out / "asset" / "mine.txt").read_text() == "mine" and not list((out / "asset").glob(".*"))


def test_an_edit_of_the_first_asset_is_set_aside_not_lost(inputs, stopped, tmp_path):  # noqa: F811
    out = shutil.copytree(stopped[0], tmp_path / "out")
    file = out / "asset" / "textures" / "bell_albedo.png"
    file.write_bytes(b"mine")
    progress = Heard()
    pipeline.stylize(sized(job(inputs, out), detail="none"), progress)
    assert (out / "asset.edited-1" / "textures" / "bell_albedo.png").read_bytes() == b"mine"
    assert any("bell_albedo.png" in note for note in progress.notes) and file.stat().st_size > 100


def test_a_job_goes_on_from_its_preview_and_reports_come_in_three_sizes(inputs, tmp_path):  # noqa: F811
    out = tmp_path / "out"
    told = preview.preview(job(inputs, out), Heard())
    sheet = read_picture(out / "preview" / "preview.png").rgb
    assert told["preview"] == str(out / "preview" / "preview.png")
    assert sheet.shape == (2 * preview.SIDE, 4 * preview.SIDE, 3)
    views, maps = np.split(sheet, 2)
    for k in range(4):
        tile = views[:, k * preview.SIDE : (k + 1) * preview.SIDE]
        assert 0.1 < (tile.min(axis=-1) < 0.99).mean() < 0.9 and tile.std() > 0.02
    assert maps[:, : preview.SIDE].std() > 0.05 and (maps[:, 3 * preview.SIDE :] == 0).all(), "albedo; no metal"
    assert not (out / "asset").exists() and not (out / "report").exists()
    progress = Heard()
    summary = pipeline.stylize(sized(job(inputs, out), detail="none"), progress)
    assert progress.reused == ["mesh", "texels", "surface"] and (out / "preview" / "preview.png").is_file()
    assert "report" not in summary and not (out / "report").exists()
    pipeline.stylize(sized(job(inputs, out), detail="page"), Heard())
    assert {p.name for p in (out / "report").iterdir()} == {"done.json", "index.html", "overview.png"}
    pipeline.stylize(job(inputs, out), Heard())
    files = {p.relative_to(out / "report").as_posix() for p in (out / "report").rglob("*") if p.is_file()}
    frames = {f"turntable/{k:03}.png" for k in range(4)}
    assert files == {"done.json", "index.html", "overview.png", "beauty.png", "turntable.webp", *frames}
    page = (out / "report" / "index.html").read_text()
    # Frames of both looks, the poster, the pair, 16 views twice, four maps, their overlays, coverage and mask.
    assert page.count("data:image/webp") >= 2 * 4 + 1 + 2 + 32 + 4 + 2 + 2
    progress = Heard()
    pipeline.stylize(sized(job(inputs, out), detail="none"), progress)
    assert any("shows an earlier run" in note for note in progress.notes) and (out / "report" / "index.html").is_file()


def test_a_preview_of_a_larger_job_says_what_it_left_out_and_keeps_the_mesh(inputs, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(preview, "SAMPLES", 1000)
    out = tmp_path / "out"
    told = preview.preview(job(inputs, out), Heard())
    assert any("1,000 surface samples" in note and "3,000" in note for note in told["notes"])
    progress = Heard()
    preview.preview(job(inputs, out), progress)
    assert progress.reused == ["mesh", "preview"]


def test_usage(inputs, tmp_path, capsys):  # noqa: F811
    line = ["stylize", *map(str, inputs), "-o", str(tmp_path / "out"), "--preview"]
    assert main([*line, "--variations", "2"]) == 2 and "--variations" in capsys.readouterr().err
    assert main([*line, "--stylizer", "embedded-view"]) == 2 and "embedded-view" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match="detail"):
        resolve("draft", None, {"report": {"detail": "long"}}, {})
    assert main(["stylize", "--report", "page", "--print-config"]) == 0 and 'detail = "page"' in capsys.readouterr().out
    assert main(["fit", "--report", "none", "--print-config"]) == 0 and 'detail = "none"' in capsys.readouterr().out


def test_a_picture_that_comes_twice_is_encoded_once():
    rng = np.random.default_rng(0)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(512, 512, 3)), 0), 1)
    picture = ((smooth - smooth.min()) / np.ptp(smooth) * 255).astype(np.uint8)
    small, large = Encoder(0.25), Encoder(1.0)
    made = small(picture, 128)
    assert small(picture, 128) is made and small(picture, 64) is not made
    predicted, true = small.growth(1.0), len(large(picture, 512).uri) - len(made.uri) - len(small(picture, 64).uri)
    assert predicted > 0 and true > 0
