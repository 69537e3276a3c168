"""The report: one file that needs nothing else, shows what it was given, and runs nothing of what it was given."""

import base64
import hashlib
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mistyle.jobs.report import page as module
from mistyle.jobs.report.page import (
    BeforeAfter,
    Figure,
    File,
    MapSet,
    Note,
    Overlay,
    Report,
    ReportPicture,
    Setting,
    Step,
    Timing,
    seconds,
    size,
    slug,
    write_report,
)
from mistyle.jobs.report.pictures import accents, eight_bit, in_bands, palette, relative_luminance, webp

EVIL = """<script>alert('x')</script>"><img src=http://example.org/a onerror=alert(1)>&amp;{{ 7 * 7 }}"""
VOID = {"meta", "img", "input", "br", "link", "hr"}


class Page(HTMLParser):
    """Every element with its attributes and its text; refuses tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == [], f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def text(self, tag: str) -> str:
        return "".join(data for name, data in self.texts if name == tag)


def sample(rng: np.random.Generator, text: str = "word") -> Report:
    """A report with something in every part; `text` stands wherever a text can."""

    def shot(*shape: int, sharp: bool = False) -> ReportPicture:
        return ReportPicture(rng.random(shape).astype(np.float32), text, text, sharp)

    overlays = (Overlay(text, rng.random((64, 64, 4)).astype(np.float32), text),)
    frames = tuple(rng.integers(0, 256, (40, 40, 4)).astype(np.uint8) for _ in range(6))
    return Report(
        title=text,
        mesh=text,
        style=text,
        painting=shot(50, 70, 3),
        turntable=frames,
        plain=frames[::-1],
        made=text,
        facts=((text, text),),
        notes=(Note(text), Note(text, warning=True)),
        steps=(
            Step(
                text,
                text,
                text,
                (BeforeAfter(shot(30, 30, 3), shot(30, 30, 4), text),),
                (shot(20, 20),),
                ((text, text),),
            ),
            Step("Second", shots=(shot(20, 20, sharp=True), shot(9, 21, 3)), columns=2),
        ),
        maps=(MapSet(text, (shot(64, 64, 3), shot(64, 64)), overlays), MapSet("other", (shot(64, 64, 3),))),
        timings=(Timing(text, 0.2), Timing("fit", 212.0, reused=True)),
        figures=(Figure(text, text, text, "higher"), Figure("plain", "3", "a meaning")),
        settings={text: (Setting(text, text, text, chosen=True),), "other": (Setting("a", "b"),)},
        versions=((text, text),),
        files=(File(text, 12_345, hashlib.sha256(b"a").hexdigest(), text),),
    )


def page_of(path: Path, report: Report) -> tuple[str, Page]:
    write_report(path, report)
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def decoded(uri: str | None) -> Image.Image:
    assert uri is not None and uri.startswith("data:image/webp;base64,")
    image = Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2], validate=True)))
    image.load()
    return image


def test_nothing_is_fetched_from_anywhere(tmp_path, rng):
    text, page = page_of(tmp_path / "r.html", sample(rng))
    text = re.sub(r'"data:image/webp;base64,[A-Za-z0-9+/=]+"', '""', text)
    assert "http" not in text.replace("http-equiv", "") and not re.search(r"//\S", text)
    assert "url(" not in text and "@import" not in text and "srcset" not in text
    for _, attributes in page.elements:
        assert (attributes.get("src") or "data:").startswith("data:")
        assert (attributes.get("href") or "#").startswith("#")
    assert {"link", "iframe", "object", "embed", "form", "base"}.isdisjoint(tag for tag, _ in page.elements)


def test_the_policy_allows_our_script_and_nothing_else(tmp_path, rng):
    _, page = page_of(tmp_path / "r.html", sample(rng))
    (policy,) = [m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().partition(" ")[::2] for rule in (policy or "").split(";"))
    digest = base64.b64encode(hashlib.sha256(page.text("script").encode()).digest()).decode()
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    assert rules["script-src"] == f"'sha256-{digest}'"
    assert len(page.all("script")) == 1
    assert not [name for _, attributes in page.elements for name in attributes if name.startswith("on")]


def test_names_are_shown_as_they_are_and_never_run(tmp_path, rng):
    plain, harmless = page_of(tmp_path / "a.html", sample(rng))
    text, page = page_of(tmp_path / "b.html", sample(rng, EVIL))
    assert [tag for tag, _ in page.elements] == [tag for tag, _ in harmless.elements]
    assert page.text("h1") == EVIL
    assert page.text("title") == EVIL
    assert "<script>alert" not in text and "onerror=" in text  # it is there, as text
    assert "{{ 7 * 7 }}" in page.text("h1")
    assert "&amp;amp;" in text


def test_every_picture_decodes_and_has_its_size(tmp_path, rng):
    report = sample(rng)
    _, page = page_of(tmp_path / "r.html", report)
    images = page.all("img")
    shots = 1 + 2 + 1 + 2 + 3 + 1
    assert len(images) == shots + len(report.turntable) + len(report.plain)
    for attributes in images:
        image = decoded(attributes["src"])
        assert attributes["alt"]
        if "width" in attributes:
            assert image.size == (int(attributes["width"] or 0), int(attributes["height"] or 0))


def test_anchors_and_ids_agree(tmp_path, rng):
    report = sample(rng)
    wordless = (Step("<>", "a step without a letter"), Step("!"))
    report = replace(report, steps=(*report.steps, report.steps[1], *wordless))
    _, page = page_of(tmp_path / "r.html", report)
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    wanted = [(a.get("href") or "#")[1:] for a in page.all("a")]
    wanted += [a["aria-describedby"] or "" for _, a in page.elements if "aria-describedby" in a]
    assert set(wanted) <= set(ids)


def test_controls_can_be_reached_and_named_without_a_mouse(tmp_path, rng):
    _, page = page_of(tmp_path / "r.html", sample(rng))
    ranges = [a for a in page.all("input") if a.get("type") == "range"]
    assert len(ranges) == 2 and all(a.get("aria-label") for a in ranges)
    assert all(a.get("aria-label") or a.get("class") == "swap" or "aria-pressed" in a for a in page.all("button"))
    assert "Before" in page.text("button")
    assert [a for a in page.all("span") if a.get("class") == "term" and a.get("tabindex") == "0"]


def test_a_report_of_the_least(tmp_path, rng):
    bare = Report("t", "m", "s", ReportPicture(rng.random((4, 4, 3)), "p"), (rng.random((4, 4, 3)),))
    _, page = page_of(tmp_path / "r.html", bare)
    assert page.all("table") == [] and page.all("details") == [] and len(page.all("img")) == 2
    assert [a["id"] for a in page.all("section")] == ["top"]


def test_frames_must_agree(tmp_path, rng):
    report = sample(rng)
    with pytest.raises(ValueError, match="5 frames of the original for 6"):
        write_report(tmp_path / "r.html", replace(report, plain=report.plain[:5]))
    with pytest.raises(ValueError, match="at least one"):
        write_report(tmp_path / "r.html", replace(report, turntable=(), plain=()))
    assert not (tmp_path / "r.html").exists()


def test_large_pictures_are_scaled_until_the_file_is_small_enough(tmp_path, rng, monkeypatch):
    noise = ReportPicture(rng.integers(0, 256, (500, 500, 3)).astype(np.uint8), "noise")
    report = replace(sample(rng), maps=(MapSet("", (noise,)),))
    write_report(tmp_path / "whole.html", report)
    whole = (tmp_path / "whole.html").stat().st_size
    monkeypatch.setattr(module, "MOST_BYTES", whole - 100_000)
    _, page = page_of(tmp_path / "small.html", report)
    assert (tmp_path / "small.html").stat().st_size <= whole - 100_000
    assert max(decoded(a["src"]).size[0] for a in page.all("img")) < 500


def test_equal_reports_are_equal_bytes(tmp_path):
    for name in ("a", "b"):
        write_report(tmp_path / f"{name}.html", sample(np.random.default_rng(3)))
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_pictures_of_every_kind_become_eight_bit():
    grey = np.array([[0.0, 0.5], [1.0, np.nan]], np.float32)
    assert eight_bit(grey)[..., 0].tolist() == [[0, 128], [255, 0]]
    assert eight_bit(np.array([[np.inf, -np.inf, 1.7, -0.2]]))[0, :, 1].tolist() == [255, 0, 255, 0]
    assert eight_bit(np.array([[True, False]]))[0, :, 2].tolist() == [255, 0]
    same = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    assert np.array_equal(eight_bit(same), same)
    with_alpha = eight_bit(np.array([[[0.2, 0.6]]]))
    assert with_alpha.tolist() == [[[51, 51, 51, 153]]]
    for wrong in (np.zeros((2, 2, 5)), np.zeros((0, 2, 3))):
        with pytest.raises(ValueError, match="a picture of shape"):
            eight_bit(wrong)


def test_sharp_pictures_keep_every_pixel_and_the_others_nearly(rng):
    mask = rng.random((60, 45)) < 0.5
    kept = np.asarray(decoded(webp(mask, 100, sharp=True).uri).convert("RGB"))
    assert np.array_equal(kept[..., 0] > 127, mask) and set(np.unique(kept)) == {0, 255}
    ramp = np.linspace(0, 1, 300, dtype=np.float32)[None].repeat(200, axis=0)
    inline = webp(ramp, 150)
    assert (inline.width, inline.height) == (150, 100)
    back = np.asarray(decoded(inline.uri).convert("L"), float) / 255
    assert np.abs(back - np.linspace(0, 1, 150)[None]).max() < 0.03  # WebP at quality 84, and half a pixel of scaling


def test_the_palette_holds_the_colours_of_the_picture():
    picture = np.zeros((40, 40, 3), np.uint8)
    picture[:20] = (200, 30, 10)
    picture[20:] = (10, 60, 220)
    assert set(palette(picture, 2)) == {"#c81e0a", "#0a3cdc"}
    lightness = [relative_luminance(np.array([int(c[i : i + 2], 16) for i in (1, 3, 5)])) for c in palette(picture, 7)]
    assert lightness == sorted(lightness)


def test_accents_can_be_read_on_their_page(rng):
    def luminance(code: str) -> float:  # WCAG 2, written down again
        total = 0.0
        for weight, k in zip((0.2126, 0.7152, 0.0722), (1, 3, 5), strict=True):
            x = int(code[k : k + 2], 16) / 255
            total += weight * (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4)
        return total

    css = (Path(module.__file__).parent / "report.css").read_text()
    assert "--page: #faf8f4" in css and "--page: #141416" in css
    for _ in range(50):
        chosen = accents([f"#{c:06x}" for c in rng.integers(0, 2**24, 5)])
        assert (luminance("#faf8f4") + 0.05) / (luminance(chosen["light"]) + 0.05) >= 4.45  # rounding to 8 bits
        assert (luminance(chosen["dark"]) + 0.05) / (luminance("#141416") + 0.05) >= 4.45


def test_figures_as_people_say_them():
    assert [seconds(s) for s in (0.04, 9.94, 9.96, 59.4, 59.6, 185, 3661, 7199.7)] == [
        "0.0 s", "9.9 s", "10 s", "59 s", "1 min 00 s", "3 min 05 s", "1 h 01 min", "2 h 00 min"]  # fmt: skip
    assert [size(n) for n in (0, 999, 1000, 99_960, 4_211, 9_412_332, 2_000_000_000_000)] == [
        "0 B", "999 B", "1.0 kB", "100 kB", "4.2 kB", "9.4 MB", "2.0 TB"]  # fmt: skip
    assert [slug(t) for t in ("Stylized views", "<b>É!", "…")] == ["stylized-views", "b", "part"]


@pytest.mark.parametrize("shape", [(700, 500, 3), (300, 611), (257, 256, 4)])
@pytest.mark.parametrize("sharp", [False, True])
def test_a_picture_made_in_bands_is_shown_as_the_whole_would_be(shape, sharp, rng):
    whole = rng.random(shape).astype(np.float32)
    small = in_bands(shape[:2], lambda at: whole[at], 200, sharp)
    assert max(small.shape) == 200
    assert webp(small, 200, sharp=sharp) == webp(whole, 200, sharp=sharp)


def test_the_maps_of_a_large_atlas_are_never_whole_as_numbers():
    """Floats of all four maps are 128 MB here."""
    import tracemalloc

    from mistyle.core.maps import Texels, flat_maps
    from mistyle.jobs.report import overlays as report_overlays
    from mistyle.jobs.report.parts import heat, map_shots, mask_over

    size = 2048
    maps, covered = flat_maps(size), np.ones((size, size), bool)
    nowhere, none = np.zeros((size, size, 3), np.float32), np.zeros((size, size), np.int32)
    texels = Texels(nowhere, nowhere, covered, none, none)
    seen, looks = np.ones((size, size), np.int16), np.ones((size, size), np.float32)
    tracemalloc.start()
    try:
        shots = map_shots(maps, 640)
        over = [
            report_overlays.coverage(seen, 4, texels, 640),
            report_overlays.confidence(looks, texels, 640),
            report_overlays.repaired(covered, texels, 640),
            report_overlays.struggle(looks, looks, texels, 640),
        ]
        pictures = [heat(seen, 4, texels, 640), mask_over(covered, maps, texels, 640)]
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    every = [s.picture for s in shots] + [o.picture for o in over if o is not None] + pictures
    assert len(every) == 10 and all(p.dtype == np.uint8 and max(p.shape) == 640 for p in every)
    assert most < 64e6
