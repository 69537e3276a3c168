"""`mistyle compare` as a user meets it: files in, page, tables and exit code out."""

import csv
import json
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mistyle.cli.main import main
from mistyle.comparison.frames import matches
from mistyle.comparison.limits import Limit, broken
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.read import read_frame
from tests.support.helpers import data

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FAST = ["--metrics", "psnr,relmse,rmse,mae"]


def picture(rng, height=40, width=50):
    return (0.2 + rng.random((height, width, 3))).astype(np.float32)


def save(path, rgb, **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, dict(zip("RGB", np.moveaxis(rgb, -1, 0), strict=True)) | more)
    return path


def run(capsys, *words):
    """Exit code, what --json printed, and stderr."""
    code = main(["compare", *map(str, words), "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else {}, err


@pytest.fixture
def pair(tmp_path, rng):
    a = picture(rng)
    return save(tmp_path / "a.exr", a), save(tmp_path / "b.exr", a * 1.1), tmp_path / "out"


def test_two_renders_and_everything_that_is_written(pair, capsys):
    a, b, out = pair
    code, record, _ = run(capsys, a, b, "-o", out, "--crop", "10,5,16,12")
    assert code == 0 and record["passed"]
    (row,) = record["rows"]
    values = row["values"]
    assert set(values) == {
        *("flip", "hdr_flip", "psnr", "psnr_linear", "ssim", "de2000", "de2000_p95", "relmse", "smape")
    }
    rgb = read_frame(a).layers[0].values().astype(np.float64)
    assert values["psnr_linear"] == pytest.approx(-10 * np.log10((0.01 * rgb**2).mean()), abs=1e-3)
    assert values["relmse"] == pytest.approx((0.01 * rgb**2 / (rgb**2 + 0.01)).mean(), rel=1e-4)
    assert f"{row['exposures'][2]} exposures" in record["definitions"]["hdr_flip"]
    folder = out / row["folder"]
    names = {p.name for p in folder.iterdir()}
    assert {"reference.webp", "test_wide.webp", "flip.webp", "difference.webp", "test_false.webp"} <= names
    with Image.open(folder / "test.webp") as image:
        assert image.size == (50, 40)
    assert (out / "inset.pdf").read_bytes().startswith(b"%PDF")
    with Image.open(out / "inset.png") as image:
        assert image.width > 700
    (line,) = csv.DictReader((out / "compare.csv").read_text().splitlines())
    assert float(line["relmse"]) == pytest.approx(values["relmse"]) and line["status"] == "passed"
    # The same again replaces it; anything else is left alone.
    assert run(capsys, a, b, "-o", out, *FAST)[0] == 0
    assert not (out / "inset.png").exists()
    (out / "index.html").write_text("mine")
    code, _, said = run(capsys, a, b, "-o", out)
    assert code == 2 and "edited after mistyle wrote it" in said and (out / "index.html").read_text() == "mine"


def test_the_worst_region_is_where_the_error_is(pair, capsys, rng):
    a, _, out = pair
    rgb = read_frame(a).layers[0].values()
    rgb[20:36, 30:46] *= 2
    _, record, _ = run(capsys, a, save(out.parent / "c.exr", rgb), "-o", out, *FAST)
    assert record["rows"][0]["worst"][0][:4] == [30, 20, 16, 16]


def test_a_pair_of_two_sizes_is_refused(pair, capsys, rng):
    a, _, out = pair
    code, _, said = run(capsys, a, save(out.parent / "small.exr", picture(rng, 30, 50)), "-o", out)
    assert code == 3 and "50 x 30" in said and "50 x 40" in said and "--window overlap" in said
    assert not out.exists()


def test_pixels_that_are_not_finite_fail(pair, capsys, rng):
    a, _, out = pair
    rgb = read_frame(a).layers[0].values()
    rgb[3, 4], rgb[5, 6, 1] = np.nan, np.inf
    bad = save(out.parent / "nan.exr", rgb)
    code, record, said = run(capsys, a, bad, "-o", out, *FAST)
    assert code == 5 and "2 pixels are not finite (1 nan in the test, 1 inf in the test)" in said
    row = record["rows"][0]
    assert row["pixels"] == 40 * 50 - 2 and row["values"]["psnr"] == "inf"
    with Image.open(out / row["folder"] / "test.webp") as image:
        assert image.getpixel((4, 3)) == (255, 0, 255)
    assert run(capsys, a, bad, "-o", out, *FAST, "--allow-nonfinite")[0] == 0


def test_layers_meet_by_name_and_infinite_depth_is_no_error(tmp_path, capsys, rng):
    rgb, depth = picture(rng), np.full((40, 50), np.inf, np.float32)
    depth[:20] = 4
    flat = {"normal.X": 0 * rgb[..., 0], "normal.Y": 0 * rgb[..., 0], "normal.Z": 1 + 0 * rgb[..., 0]}
    tilted = flat | {"normal.X": flat["normal.Z"]}
    colours = {f"albedo.{c}": rgb[..., k] for k, c in enumerate("RGB")}
    a = save(
        tmp_path / "a.exr", rgb, **flat, **colours, **{"depth.Z": depth, "A": np.ones_like(depth), "only.V": depth}
    )
    b = save(tmp_path / "b.exr", rgb, **tilted, **colours, **{"depth.Z": depth + 0.5, "A": np.ones_like(depth)})
    code, record, _ = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "psnr,rmse,angle")
    rows = {row["layer"]: row for row in record["rows"]}
    assert code == 0 and set(rows) == {"beauty", "alpha", "albedo", "depth", "normal"}
    assert not rows["depth"]["failures"] and rows["depth"]["values"]["rmse"] == 0.5
    assert rows["depth"]["pixels"] == 20 * 50
    assert rows["normal"]["values"]["angle"] == pytest.approx(45, abs=1e-4)
    assert "'only'" in rows["beauty"]["notes"][0]
    code, record, _ = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "rmse", "--layer", "Depth")
    assert code == 0 and [row["layer"] for row in record["rows"]] == ["Depth"]
    code, _, said = run(capsys, a, b, "-o", tmp_path / "out", "--layer", "only")
    assert code == 3 and "beauty" in said


def test_parts_and_data_windows(tmp_path, capsys, rng):
    """A multi-part file of another writer: half floats, a data window inside, the finished picture called Combined."""
    rgb = picture(rng)
    inner = {"dataWindow": (np.array([10, 4], np.int32), np.array([29, 23], np.int32))}
    inner["displayWindow"] = (np.array([0, 0], np.int32), np.array([49, 39], np.int32))
    cut = rgb[4:24, 10:30]
    channels = {f"ViewLayer.Combined.{c}": np.ascontiguousarray(cut[..., k]) for k, c in enumerate("RGB")}
    parts = [
        OpenEXR.Part({"name": "ViewLayer.Combined", **inner}, channels),
        OpenEXR.Part({"name": "diffuse"}, {"RGB": rgb.astype(np.float16)}),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "b.exr"))
    a = save(tmp_path / "a.exr", rgb, **{f"diffuse.{c}": rgb[..., k] for k, c in enumerate("RGB")})
    words = (a, tmp_path / "b.exr", "-o", tmp_path / "out", "--metrics", "relmse")
    _, record, _ = run(capsys, *words, "--window", "overlap")
    rows = {row["layer"]: row for row in record["rows"]}
    assert rows["beauty"]["values"]["relmse"] == 0 and rows["beauty"]["size"] == [20, 20]
    assert 0 < rows["diffuse"]["values"]["relmse"] < 1e-6 and rows["diffuse"]["size"] == [50, 40]
    _, record, _ = run(capsys, *words)
    outside = np.ones(rgb.shape, bool)
    outside[4:24, 10:30] = False
    expected = np.where(outside, rgb**2 / (rgb**2 + 0.01), 0).mean()
    assert record["rows"][0]["values"]["relmse"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("window", ["display", "overlap"])
def test_one_overscan_written_two_ways(window, tmp_path, capsys, rng):
    """The same picture with its display window at another place: data from -4 or from 0."""
    rgb = picture(rng)
    height, width = rgb.shape[:2]
    for name, at in (("a.exr", 0), ("b.exr", 4)):
        corners = {"dataWindow": (at - 4, at - 4, at + width - 5, at + height - 5)}
        corners["displayWindow"] = (at, at, at + width - 9, at + height - 9)
        header = {k: (np.array(v[:2], np.int32), np.array(v[2:], np.int32)) for k, v in corners.items()}
        channels = {c: np.ascontiguousarray(rgb[..., k]) for k, c in enumerate("RGB")}
        OpenEXR.File([OpenEXR.Part(header, channels)]).write(str(tmp_path / name))
    words = (tmp_path / "a.exr", tmp_path / "b.exr", "-o", tmp_path / "out", "--metrics", "relmse")
    code, record, _ = run(capsys, *words, "--window", window)
    expected = [width - 8, height - 8] if window == "display" else [width, height]
    assert code == 0 and record["rows"][0]["values"]["relmse"] == 0 and record["rows"][0]["size"] == expected


def test_straight_alpha_is_multiplied_in(tmp_path, capsys):
    """A PNG of linear 0.2140411 (sRGB 0.5) at alpha 0.5 is the EXR's premultiplied half of it."""
    png = np.full((16, 16, 4), 0.5, np.float32)
    write_png(tmp_path / "a.png", png, 16)
    alpha = np.full((16, 16), 0.5, np.float32)
    b = save(tmp_path / "b.exr", np.full((16, 16, 3), 0.2140411 / 2, np.float32), A=alpha)
    code, record, _ = run(capsys, tmp_path / "a.png", b, "-o", tmp_path / "out", "--metrics", "psnr_linear,max_error")
    assert code == 0 and record["rows"][0]["values"]["psnr_linear"] > 90
    assert "premultiplied" in record["conventions"]["alpha"]


def test_pictures_of_eight_bits_have_no_high_dynamic_range(tmp_path, capsys):
    light = np.linspace(0.1, 0.9, 50, dtype=np.float32)[None, :, None]
    write_png(tmp_path / "a.png", np.repeat(np.repeat(light, 40, axis=0), 3, axis=2))
    Image.open(tmp_path / "a.png").save(tmp_path / "b.jpg", quality=60)
    code, record, _ = run(capsys, tmp_path / "a.png", tmp_path / "b.jpg", "-o", tmp_path / "out")
    values = record["rows"][0]["values"]
    assert code == 0 and "hdr_flip" not in values and 25 < values["psnr"] < 60
    assert not list((tmp_path / "out").rglob("*_wide.webp"))


def test_a_folder_with_a_missing_frame(tmp_path, capsys, rng):
    for k in range(4):
        rgb = picture(rng)
        save(tmp_path / "old" / f"f.{k:04d}.exr", rgb)
        if k != 2:
            save(tmp_path / "new" / f"f.{k:04d}.exr", rgb)
    words = (tmp_path / "old", tmp_path / "new", "-o", tmp_path / "out", *FAST)
    code, record, said = run(capsys, *words)
    assert code == 5 and "f.0002" in said and "the test has no picture of this name" in said
    assert [bool(row["failures"]) for row in record["rows"]] == [False, False, True, False]
    assert run(capsys, *words, "--allow-missing")[0] == 0
    suite = ElementTree.fromstring((tmp_path / "out" / "junit.xml").read_text().encode())
    assert suite.find("testsuite").get("tests") == "4"


def test_folders_with_other_names_meet_by_frame_number(tmp_path, rng):
    for k in (7, 8):
        save(tmp_path / "a" / f"ref_{k:04d}.exr", picture(rng))
        save(tmp_path / "b" / f"take2.{k}.exr", picture(rng))
    found = matches(tmp_path / "a", [tmp_path / "b"])
    assert [(m.name, m.test.name) for m in found] == [("ref_0007", "take2.7.exr"), ("ref_0008", "take2.8.exr")]


def test_one_bad_frame_fails_alone(tmp_path, capsys, rng):
    for k in range(2):
        save(tmp_path / "a" / f"{k}.exr", picture(rng))
    save(tmp_path / "b" / "0.exr", read_frame(tmp_path / "a" / "0.exr").layers[0].values())
    (tmp_path / "b" / "1.exr").write_bytes(b"\x76\x2f\x31\x01 cut off")
    code, record, _ = run(capsys, tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *FAST)
    assert code == 5 and not record["rows"][0]["failures"]
    assert "refused" in record["rows"][1]["failures"][0]


def test_limits_from_everywhere(tmp_path, capsys, rng):
    rgb = picture(rng)
    for name, factor in (("shot_01", 1.01), ("shot_02", 1.5)):
        save(tmp_path / "a" / f"{name}.exr", rgb)
        save(tmp_path / "b" / f"{name}.exr", rgb * factor)
    words = (tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *FAST)
    assert run(capsys, *words, "--min", "psnr=5", "--max", "relmse=1")[0] == 0
    code, record, said = run(capsys, *words, "--min", "psnr=30")
    assert code == 5 and len(record["failures"]) == 1 and "psnr is" in said and "below 30" in said
    (tmp_path / "a" / "compare.toml").write_text('[limits.min]\npsnr = 30\n[images."shot_02*".min]\npsnr = 5\n')
    assert run(capsys, *words)[0] == 0
    root = ElementTree.fromstring((tmp_path / "out" / "junit.xml").read_text().encode())
    assert root.find("testsuite").get("failures") == "0"
    (tmp_path / "a" / "compare.toml").write_text('[images."shot_2*".min]\npsnr = 5\n')
    code, record, _ = run(capsys, *words)
    assert code == 5 and "matched nothing" in record["failures"][0]
    for text in ("[limits]\npsnr = 3\n", "[limit]\n", "[limits.min]\npsnr = 'a'\n", "[limits.min\n"):
        (tmp_path / "a" / "compare.toml").write_text(text)
        code, _, said = run(capsys, *words)
        assert code == 3 and "compare.toml" in said
    (tmp_path / "a" / "compare.toml").unlink()
    for wrong in (["--max", "flop=1"], ["--max", "psnr"], ["--min", "psnr=nan"], ["--max", "lpips=1"]):
        assert run(capsys, *words, *wrong)[0] == 2


def test_a_figure_that_cannot_be_measured_keeps_no_limit():
    assert broken([Limit("psnr", "min", 3.0)], "a", "b", {"psnr": float("nan")}) == ["psnr could not be measured"]
    assert broken([Limit("psnr", "min", 3.0)], "a", "b", {"psnr": float("inf")}) == []
    assert broken([Limit("flip", "max", 1.0), Limit("flip", "max", 0.1, "a*")], "ab", "", {"flip": 0.2})


def test_a_regression_suite(tmp_path, capsys, rng):
    new, golden = tmp_path / "new", tmp_path / "golden"
    first = picture(rng)
    save(new / "chair.exr", first)
    save(golden / "old.exr", first)
    suite = ("--baseline", golden, new, "-o", tmp_path / "out", *FAST, "--min", "psnr=60")
    code, _, said = run(capsys, *suite)
    assert code == 3 and "none named as" in said
    approving = ["compare", "--baseline", str(golden), str(new), "--approve"]
    assert main([*approving, "chair"]) == 0
    capsys.readouterr()
    code, record, _ = run(capsys, *suite)
    assert code == 5 and [bool(row["failures"]) for row in record["rows"]] == [False, True]  # "old" was not rendered
    (golden / "old.exr").unlink()
    assert run(capsys, *suite)[0] == 0
    noted = json.loads((golden / "approved.json").read_text())["chair"]
    assert len(noted["sha256"]) == 64 and (golden / "chair.exr").read_bytes() == (new / "chair.exr").read_bytes()
    save(new / "chair.exr", first * 1.2)
    assert run(capsys, *suite)[0] == 5
    write_png(new / "chair.png", np.clip(first, 0, 1))
    (new / "chair.exr").unlink()
    assert main([*approving, "ch*"]) == 0
    assert sorted(p.name for p in golden.iterdir()) == ["approved.json", "chair.png"]
    assert main([*approving, "table"]) == 2


def test_idiff_protocol_of_pictures_with_alpha(tmp_path, capsys):
    """`idiff -v` 3.2.2 on these two PNGs: mean 0.00268714, RMS 0.00430669, SNR 47.3171, max 0.0156863, 622 pixels."""
    y, x = np.mgrid[0:24, 0:32].astype(np.float64)
    a = np.stack([x / 8, y / 12, (x + y) / 28], -1).astype(np.float32)
    b = (a + 0.05 * np.sin(x * y)[..., None] * np.array([1, -1, 0.5])).astype(np.float32)
    b[0] = a[0]
    for name, rgb in (("a", a), ("b", b)):
        rgba = np.concatenate([rgb / 4, ((x + 8) / 40)[..., None]], -1)
        write_png(tmp_path / f"{name}.png", np.clip(rgba, 0, 1).astype(np.float32))
    words = (tmp_path / "a.png", tmp_path / "b.png", "-o", tmp_path / "out", "--protocol", "idiff")
    _, record, _ = run(capsys, *words)
    expected = {
        "mean_error": 0.00268714,
        "rms_error": 0.00430669,
        "peak_snr": 47.3171,
        "max_error": 0.0156863,
        "over": 622,
    }
    assert record["rows"][0]["values"] == pytest.approx(expected, rel=3e-6)
    assert run(capsys, *words, "--max", "over=600")[0] == 5


def test_stanford_orb_reads_its_large_references(tmp_path, capsys, rng):
    """A reference of four times the size is reduced by area means; its alpha is the mask."""
    rgb = 0.1 + 0.5 * picture(rng, 24, 32)
    alpha = np.ones((24, 32), np.float32)
    alpha[:6] = 0
    test = rgb * np.array([0.5, 2, 1], np.float32)
    test[:6] = 9  # outside the mask
    big = np.kron(rgb, np.ones((4, 4, 1), np.float32))
    a = save(tmp_path / "a.exr", big, A=np.kron(alpha, np.ones((4, 4), np.float32)))
    words = ("-o", tmp_path / "out", "--protocol", "stanford-orb", "--layer", "beauty")
    code, record, _ = run(capsys, a, save(tmp_path / "b.exr", test), *words)
    assert code == 0 and record["rows"][0]["size"] == [32, 24]
    assert float(record["rows"][0]["values"]["psnr_h"]) > 90 and record["rows"][0]["values"]["ssim"] > 0.9999


def test_tensoir_over_white(tmp_path, capsys):
    """sRGB 0.5 at alpha 0.5 over white is 0.75; against 0.65 the error is 0.1 everywhere."""
    rgba = np.full((16, 16, 4), 0.5, np.float32)
    write_png(tmp_path / "a.png", rgba, 16)
    write_png(tmp_path / "b.png", np.full((16, 16, 3), 0.65, np.float32), 16)
    words = ("-o", tmp_path / "out", "--protocol", "tensoir", "--layer", "beauty")
    _, record, _ = run(capsys, tmp_path / "a.png", tmp_path / "b.png", *words)
    assert record["rows"][0]["values"]["psnr"] == pytest.approx(20, abs=1e-3)


def test_lpips_where_weights_are_given(pair, capsys):
    a, b, out = pair
    weights = [data(f"weights/{n}") for n in ("squeezenet1_1_torchvision_fp16.npz", "lpips_v0.1_squeeze_heads.pth")]
    words = ("-o", out, "--metrics", "lpips", "--lpips", *weights)
    _, record, _ = run(capsys, a, b, *words, "--max", "lpips=0.9")
    assert 1e-4 < record["rows"][0]["values"]["lpips"] < 0.5 and "SqueezeNet" in record["definitions"]["lpips"]
    assert run(capsys, a, a, *words)[1]["rows"][0]["values"]["lpips"] == 0


def test_only_the_worst_keep_their_pictures(tmp_path, capsys, rng):
    for k in range(6):
        rgb = picture(rng)
        save(tmp_path / "a" / f"{k}.exr", rgb)
        save(tmp_path / "b" / f"{k}.exr", rgb * (1 + 0.02 * ((k * 5) % 6)))
    words = (tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *FAST, "--show", "2")
    _, record, _ = run(capsys, *words)
    shown = [row["image"] for row in record["rows"] if row["folder"]]
    assert shown == ["1", "2"]  # factors 1.10 and 1.08
    kept = {p.name for p in (tmp_path / "out" / "pairs").iterdir()}
    assert kept == {*(f"{k:05d}.webp" for k in range(6)), "00001", "00002"}


EVIL = "a<img src=x onerror=alert(1)>'\"&{{7*7}}</script><script>alert(2)"


def test_names_are_only_names(tmp_path, capsys, rng):
    rgb = picture(rng)
    a = save(tmp_path / "old" / f"{EVIL.replace('/', '_')}.exr", rgb)
    save(tmp_path / "new" / a.name, rgb * 2)
    out = tmp_path / "out"
    code, record, _ = run(capsys, a.parent, tmp_path / "new", "-o", out, *FAST, "--min", "psnr=50")
    assert code == 5
    page = (out / "index.html").read_text()
    assert "<img src=x" not in page and "{{7*7}}" in page and page.count("<script") == 2
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy and "http" not in policy
    ElementTree.fromstring((out / "junit.xml").read_text().encode())
    (out / "compare.csv").read_text()
    formula = save(tmp_path / "old2" / "=1+1.exr", rgb)
    save(tmp_path / "new2" / formula.name, rgb)
    run(capsys, tmp_path / "old2", tmp_path / "new2", "-o", tmp_path / "out2", *FAST)
    assert "\n'=1+1," in (tmp_path / "out2" / "compare.csv").read_text()


def browse(page: Path, fragment: str = "") -> tuple[str, str]:
    """The page's elements after its script ran, and what the console said; without network."""
    words = "--headless=new --no-sandbox --disable-gpu --host-resolver-rules=MAP*~NOTFOUND --enable-logging=stderr"
    found = subprocess.run(
        [str(BROWSER), *words.split(), "--v=0", "--virtual-time-budget=3000", "--dump-dom", page.as_uri() + fragment],
        capture_output=True,
        text=True,
        timeout=120,
    )
    said = [line for line in found.stderr.splitlines() if "CONSOLE" in line]
    return found.stdout, "\n".join(said)


if BROWSER:

    def test_the_page_works_from_disk_without_a_word_on_the_console(tmp_path, capsys, rng):
        rgb = picture(rng)
        a = save(tmp_path / "old" / f"{EVIL.replace('/', '_')}.exr", rgb)
        save(tmp_path / "new" / a.name, rgb * 2)
        run(capsys, a.parent, tmp_path / "new", "-o", tmp_path / "out", "--metrics", "flip,psnr")
        document, said = browse(tmp_path / "out" / "index.html", "#row=0&mode=pair&ev=-2")
        assert said == ""
        assert re.search(r'<img alt="reference"[^>]*src="pairs/00000/reference_wide.webp"[^>]*url\(', document)
        assert 'id="viewer" hidden' not in document and "1 of 1" in document
        # The console is heard: the same page with a script that its policy forbids.
        text = (tmp_path / "out" / "index.html").read_text().replace("</body>", "<script>1</script></body>")
        (tmp_path / "out" / "wrong.html").write_text(text)
        assert "Content Security Policy" in browse(tmp_path / "out" / "wrong.html")[1]
