"""The asset inside the report: the viewer that came along is the one it claims to be, the page fetches nothing, and a
browser shows the asset."""

import base64
import gzip
import hashlib
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mistyle.cli import lookdev as cli_lookdev
from mistyle.cli.main import main
from mistyle.core.errors import InputRefused
from mistyle.io.read import shrink_picture
from mistyle.jobs.report import model as report_model
from mistyle.jobs.report.model import (
    VENDOR,
    VIEWER,
    VIEWER_SHA256,
    PageModel,
    TooLarge,
    packed,
    page_model,
    viewer_script,
)
from mistyle.jobs.report.page import Report, write_report
from tests.jobs.test_report import Page, sample
from tests.support.browser import BROWSER, NO_BROWSER, Browser

RED = (200, 24, 16)


@pytest.fixture(scope="module")
def glb(tmp_path_factory) -> Path:
    """A red ball with a texture of 300 x 200, as another program writes it."""
    ball = trimesh.creation.uv_sphere(count=[24, 24])
    around = np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0]) / (2 * np.pi) + 0.5
    uv = np.stack([around, ball.vertices[:, 2] * 0.5 + 0.5], axis=1)
    picture = Image.new("RGB", (300, 200), RED)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, roughnessFactor=0.9, metallicFactor=0.0)
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    path = tmp_path_factory.mktemp("glb") / "ball.glb"
    ball.export(path)
    return path


def with_model(path: Path, glb: Path) -> Report:
    report = replace(sample(np.random.default_rng(0)), model=page_model(glb))
    write_report(path, report)
    return report


def test_the_viewer_is_the_one_that_was_published():
    assert hashlib.sha256(VIEWER.read_bytes()).hexdigest() == VIEWER_SHA256
    notice = (VENDOR / "NOTICE.txt").read_text()
    assert VIEWER_SHA256 in notice and "@google/model-viewer 4.4.0" in notice
    assert "Apache License" in (VENDOR / "LICENSE-model-viewer.txt").read_text()
    for name in ("three.js authors", "BSD 3-Clause", "fflate", "MONOGRID"):
        assert name in notice or name.replace("fflate", "Arjun Barrett") in notice


def test_the_page_allows_two_scripts_and_no_address(tmp_path, glb):
    with_model(tmp_path / "r.html", glb)
    text = (tmp_path / "r.html").read_text()
    page = Page(text)
    (policy,) = [m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().partition(" ")[::2] for rule in (policy or "").split(";"))
    scripts = re.findall(r"<script>(.*?)</script>", text, re.S)
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert rules.pop("script-src").split() == [f"'sha256-{h}'" for h in reversed(hashes)]
    assert rules == {
        "default-src": "'none'", "img-src": "data: blob:", "connect-src": "blob:", "style-src": "'unsafe-inline'",
        "base-uri": "'none'", "form-action": "'none'",
    }  # fmt: skip
    assert scripts[0] == viewer_script() and "sourceMappingURL" not in text
    published = VIEWER.read_text(encoding="utf-8")
    assert published.startswith(viewer_script().removeprefix(report_model.WITHOUT_WASM))
    rest = text.replace(scripts[0], "")
    rest = re.sub(r'"data:image/webp;base64,[A-Za-z0-9+/=]+"|>[A-Za-z0-9+/=]{200,}<', '""', rest)
    assert "http" not in rest.replace("http-equiv", "") and not re.search(r"[^:/]//[a-z]", rest.replace("  //", ""))
    assert "textures are at most 1024 pixels" in text.lower() and "ball.glb" in text


def test_the_packed_asset_is_the_asset_with_small_textures(glb):
    model = page_model(glb)
    assert isinstance(model, PageModel)
    text = packed(model, 64)
    assert text == packed(model, 64)
    back = trimesh.load(io.BytesIO(gzip.decompress(base64.b64decode(text))), file_type="glb", force="mesh")
    whole = trimesh.load(glb, force="mesh")
    assert np.array_equal(back.faces, whole.faces) and np.array_equal(back.vertices, whole.vertices)
    picture = back.visual.material.baseColorTexture
    assert picture.size == (64, 43) and b'"image/jpeg"' in gzip.decompress(base64.b64decode(text))
    assert np.abs(np.asarray(picture.convert("RGB"), float) - RED).max() < 6


def test_transparency_stays():
    see_through = Image.new("RGBA", (40, 40), (*RED, 0))
    see_through.paste((*RED, 255), (0, 0, 20, 40))
    buffer = io.BytesIO()
    see_through.save(buffer, "PNG")
    data, kind = shrink_picture(Path("x.glb"), buffer.getvalue(), 20, 80)
    alpha = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))[..., 3]
    assert kind == "image/png" and alpha.shape == (20, 20) and set(alpha[:, :9].ravel()) == {255}


def test_a_large_asset_is_a_picture_and_a_sentence(tmp_path, glb, monkeypatch):
    monkeypatch.setattr(report_model, "MOST_GEOMETRY", 1000)
    report = with_model(tmp_path / "r.html", glb)
    assert isinstance(report.model, TooLarge)
    text = (tmp_path / "r.html").read_text()
    assert "The vertices and faces of ball.glb take" in text and 'class="poster"' in text
    assert "model-viewer" not in text.replace(".stage3d model-viewer", "").replace('"model-viewer"', "")
    assert len(re.findall("<script", text)) == 1 and "connect-src" not in text


def test_view_prints_where_the_report_lies(tmp_path, capsys, monkeypatch):
    page = tmp_path / "out" / "report" / "index.html"
    page.parent.mkdir(parents=True)
    page.write_text("<p>")
    assert main(["view", str(tmp_path / "out"), "--print"]) == 0
    assert capsys.readouterr().out.strip() == str(page)
    assert main(["view", str(page), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"report": str(page)}
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    monkeypatch.setattr(cli_lookdev, "has_display", lambda: False)
    assert main(["view", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert said.out.strip() == str(page) and "scp " in said.err and str(page) in said.err and not opened
    monkeypatch.setattr(cli_lookdev, "has_display", lambda: True)
    assert main(["view", str(tmp_path / "out")]) == 0 and opened == [page.as_uri()]


def test_view_refuses_what_has_no_report(tmp_path, capsys):
    assert main(["view", str(tmp_path)]) == InputRefused.exit_code
    assert "found no report" in capsys.readouterr().err


@pytest.mark.skipif(BROWSER is None, reason=NO_BROWSER)
def test_a_browser_shows_the_asset_and_asks_for_nothing(tmp_path, glb):
    with_model(tmp_path / "r.html", glb)
    with Browser(tmp_path / "profile", 420, 560) as browser:
        browser.open((tmp_path / "r.html").as_uri())
        browser.value("document.querySelector('#model').scrollIntoView({behavior: 'instant'})")
        browser.until("document.querySelector('.stage3d.shown') !== null")
        place = browser.value("JSON.stringify(document.querySelector('model-viewer').getBoundingClientRect())")
        box = json.loads(place)
        picture = browser.picture().astype(float)
        middle_x, middle_y = int(box["x"] + box["width"] / 2), int(box["y"] + box["height"] / 2)
        centre = picture[middle_y - 8 : middle_y + 8, middle_x - 8 : middle_x + 8].mean(axis=(0, 1))
        corner = picture[int(box["y"]) + 6, int(box["x"]) + 6]
        assert centre[0] > 2 * centre[1] and centre[0] > 2 * centre[2], f"a red ball, found {centre}"
        assert np.abs(centre - corner).max() > 60
        assert abs(corner[0] - corner[1]) < 20, "the ground behind it is the page's"
        # Overlays: one picture over each map of the group, and off again.
        over = "document.querySelectorAll('.maps .overlay').length"
        browser.value("document.querySelectorAll('.overlays button')[1].click()")
        assert browser.value(over) == 2
        browser.value("document.querySelectorAll('.overlays button')[0].click()")
        assert browser.value(over) == 0
        assert browser.said == []
        assert {address.partition(":")[0] for address in browser.asked} == {"file", "data", "blob"}
        assert sum(address.startswith("file:") for address in browser.asked) == 1
        # The console is heard and the policy holds: a page that did phone home would be stopped and found out.
        assert browser.value("fetch('https://example.org/x').then(() => 'sent', () => 'stopped')") == "stopped"
        assert any("Content Security Policy" in text for text in browser.said)


@pytest.mark.skipif(BROWSER is None, reason=NO_BROWSER)
def test_without_webgl_the_picture_stays_and_that_is_said(tmp_path, glb):
    with_model(tmp_path / "r.html", glb)
    with Browser(tmp_path / "profile", 420, 560, options=("--disable-3d-apis",)) as browser:
        browser.open((tmp_path / "r.html").as_uri())
        browser.value("document.querySelector('#model').scrollIntoView({behavior: 'instant'})")
        browser.until("document.querySelector('.failed').hidden === false")
        assert browser.value("getComputedStyle(document.querySelector('.stage3d .poster')).visibility") == "visible"
        assert browser.said == []
