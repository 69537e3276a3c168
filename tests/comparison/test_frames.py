"""What a comparison takes of folders and files: no frame, no layer and no bit passes unopened."""

import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from mistyle.comparison.frames import matches
from mistyle.io.read import read_picture
from tests.comparison.test_compare import picture, run, save

GATE = ["--metrics", "psnr,differing", "--min", "psnr=60"]


def flat(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (16, 12), (value, 40, 90)).save(path)
    return path


@pytest.mark.parametrize("ending", [".png", ".tif", ".webp", ".bmp", ".tga", ".jpg", ".gif"])
def test_folders_take_what_single_files_take(tmp_path, capsys, ending):
    for folder, value in (("a", 10), ("b", 200)):
        flat(tmp_path / folder / "same.png", 10)
        flat(tmp_path / folder / f"other{ending}", value)
    code, record, _ = run(capsys, tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *GATE)
    assert code == 5 and [bool(row["failures"]) for row in record["rows"]] == [True, False]


@pytest.mark.parametrize("name", ["x.dpx", "x.pfm", "x.jxl"])
def test_a_picture_that_cannot_be_read_fails(tmp_path, capsys, name):
    for folder in "ab":
        flat(tmp_path / folder / "same.png", 10)
        (tmp_path / folder / name).write_bytes(b"of another format")
    (tmp_path / "b" / "notes.txt").write_text("no picture")
    code, record, said = run(capsys, tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *GATE)
    assert code == 5 and name in said and len(record["rows"]) == 2


def test_files_of_one_name_are_paired_by_their_ending_and_the_rest_is_said(tmp_path, capsys, rng):
    rgb = picture(rng)
    for folder in "ab":
        save(tmp_path / folder / "x.exr", rgb)
        flat(tmp_path / folder / "x.png", 10 if folder == "a" else 200)
        flat(tmp_path / folder / "y.png", 10)
    save(tmp_path / "a" / "y.exr", rgb)
    found = {m.name: (m.reference.name, m.test.name) for m in matches(tmp_path / "a", [tmp_path / "b"])}
    assert found == {"x": ("x.exr", "x.exr"), "y": ("y.png", "y.png")}
    _, record, said = run(capsys, tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *GATE)
    assert ".png of the same name left out; .exr compared" in said
    assert record["rows"][0]["files"] == ["x.exr", "x.exr"]


def test_pairs_by_number_are_said(tmp_path, capsys):
    for k in (1, 2):
        flat(tmp_path / "a" / f"lamp_{k}.png", 10)
        flat(tmp_path / "b" / f"chair-00{k}.png", 10)
    code, record, said = run(capsys, tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out", *GATE)
    assert code == 0 and "lamp_1.png with chair-001.png" in said
    assert record["rows"][1]["files"] == ["lamp_2.png", "chair-002.png"]


def test_a_comparison_within_an_input_is_not_compared_again(tmp_path, capsys):
    for folder in "ab":
        flat(tmp_path / folder / "1.png", 10)
    for _ in range(2):
        code, record, _ = run(capsys, tmp_path / "a", tmp_path / "b", "-o", tmp_path / "b" / "diff", *GATE)
        assert code == 0 and len(record["rows"]) == 1


def test_a_layer_that_is_gone_fails_a_gate(tmp_path, capsys, rng):
    rgb = picture(rng)
    depth = np.ones(rgb.shape[:2], np.float32)
    a = save(tmp_path / "a.exr", rgb, **{"spec.V": depth, "vector.X": depth, "vector.Y": depth})
    b = save(tmp_path / "b.exr", rgb, **{"specular.V": depth, "vector.X": depth})
    words = (a, b, "-o", tmp_path / "out")
    code, record, _ = run(capsys, *words, "--metrics", "psnr", "--min", "psnr=60")
    failed = {row["layer"]: row["failures"] for row in record["rows"] if row["failures"]}
    assert code == 5 and set(failed) == {"spec", "vector"} and "found channels X" in failed["vector"][0]
    assert "layer 'specular' is in the test only" in str(record["notes"])
    code, record, _ = run(capsys, *words, "--metrics", "psnr", "--min", "psnr=60", "--allow-missing")
    assert [row["layer"] for row in record["rows"] if row["failures"]] == ["vector"]
    assert "layer 'spec' is in the reference only" in str(record["notes"])


def exr(path, channels, **header):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(header, channels).write(str(path))
    return path


def test_whole_numbers_keep_every_bit(tmp_path, capsys):
    for k, (one, other) in enumerate([(16777216, 16777217), (4000000000, 4000000100)]):
        a, b = (
            exr(tmp_path / f"{name}{k}.exr", {"id": np.full((6, 8), value, np.uint32)})
            for name, value in (("a", one), ("b", other))
        )
        _, record, _ = run(capsys, a, b, "-o", tmp_path / "out")
        (row,) = record["rows"]
        assert row["values"]["max_error"] == other - one and row["values"]["differing"] == 1


@pytest.mark.parametrize("names", ["RGBA", "rgba"])
@pytest.mark.parametrize("layer", ["CryptoObject", "ViewLayer.CryptoObject"])
def test_mattes_are_compared_by_their_bits(tmp_path, capsys, names, layer):
    """IDs of Cryptomatte are hashes in floats: small ones would pass every colour metric, large ones fail them all."""
    ids = np.array([0x02345678, 0x1ABCDEF1], np.uint32).view(np.float32)
    half = np.full((6, 8), 0.5, np.float32)

    def matte(path, first, second):
        planes = dict(zip(names, (np.full_like(half, first), half, np.full_like(half, second), half), strict=True))
        beauty = {c: half for c in "RGB"}
        channels = beauty | {f"{layer}00.{c}": plane for c, plane in planes.items()}
        return exr(path, channels, **{"cryptomatte/1a2b3c4/name": layer})

    a, b = matte(tmp_path / "a.exr", *ids), matte(tmp_path / "b.exr", *ids[::-1])
    _, record, _ = run(capsys, a, b, "-o", tmp_path / "out")
    rows = {row["layer"]: row for row in record["rows"]}
    assert set(rows) == {"beauty", f"{layer}00.id", f"{layer}00.coverage"}
    assert all(row["kind"] == "data" for name, row in rows.items() if name != "beauty")
    assert rows[f"{layer}00.id"]["values"]["differing"] == 1
    assert rows[f"{layer}00.coverage"]["values"]["differing"] == 0


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_a_tiff_of_floats_is_linear(tmp_path, capsys, rng, options):
    rgb = 4 * picture(rng)
    tifffile.imwrite(tmp_path / "b.tif", rgb, photometric="rgb", **options)
    a, b = save(tmp_path / "a.exr", rgb), tmp_path / "b.tif"
    code, record, said = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "relmse,psnr", "--max", "relmse=1e-12")
    assert code == 0 and record["rows"][0]["values"]["relmse"] == 0 and "taken as linear" in said


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("grey", [False, True])
def test_a_portable_float_map_is_linear(tmp_path, capsys, rng, order, grey):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    rgb = 4 * picture(rng)
    rgb = rgb[..., :1] if grey else rgb
    header = f"P{'f' if grey else 'F'}\n{rgb.shape[1]} {rgb.shape[0]}\n{'-' if order == '<' else ''}2.0\n"
    b = tmp_path / "b.pfm"
    b.write_bytes(header.encode() + (rgb[::-1] / 2).astype(f"{order}f4").tobytes())
    assert np.array_equal(np.array(mi.Bitmap(str(b))).reshape(rgb.shape), rgb)
    a = save(tmp_path / "a.exr", np.broadcast_to(rgb, (*rgb.shape[:2], 3)))
    code, record, _ = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "relmse", "--max", "relmse=1e-12")
    assert code == 0 and record["rows"][0]["values"]["relmse"] == 0
    b.write_bytes(b.read_bytes()[:-8])
    assert run(capsys, a, b, "-o", tmp_path / "out2")[0] == 3
    b.write_bytes(b"PX\n3 3\n-1.0\n" + bytes(108))
    code, _, said = run(capsys, a, b, "-o", tmp_path / "out3")
    assert code == 3 and "PFM header" in said


def test_alpha_of_a_tiff_of_floats(tmp_path, capsys, rng):
    rgb, alpha = picture(rng), np.full((40, 50), 0.25, np.float32)
    a = save(tmp_path / "a.exr", rgb * 0.25, A=alpha)
    for kind, colours in (("unassalpha", rgb), ("assocalpha", rgb * 0.25)):
        b = tmp_path / f"{kind}.tif"
        tifffile.imwrite(b, np.dstack([colours, alpha]), photometric="rgb", extrasamples=[kind])
        code, record, _ = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "relmse,rmse")
        assert code == 0 and [list(row["values"].values()) for row in record["rows"]] == [[0.0], [0.0]]


def test_other_floats_name_the_way_out(tmp_path, capsys, rng):
    rgb = picture(rng)
    tifffile.imwrite(tmp_path / "half.tif", rgb.astype(np.float16), photometric="rgb")
    tifffile.imwrite(tmp_path / "planes.tif", np.moveaxis(rgb, -1, 0), photometric="rgb", planarconfig="separate")
    tifffile.imwrite(tmp_path / "turned.tif", rgb, photometric="rgb", extratags=[(274, 3, 1, 6, True)])
    a = save(tmp_path / "a.exr", rgb)
    for name in ("half.tif", "planes.tif", "turned.tif"):
        code, _, said = run(capsys, a, tmp_path / name, "-o", tmp_path / "out")
        assert code == 3 and name in said and "floating-point" in said and "OpenEXR" in said


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_white_may_be_zero(tmp_path, kind):
    grey = (np.arange(12).reshape(3, 4) * 20).astype(kind) * (257 if kind is np.uint16 else 1)
    most = np.iinfo(kind).max
    tifffile.imwrite(tmp_path / "a.tif", most - grey, photometric="miniswhite")
    tifffile.imwrite(tmp_path / "b.tif", grey, photometric="minisblack")
    one, other = (read_picture(tmp_path / name).rgb for name in ("a.tif", "b.tif"))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("chunk", "value", "said"), [
    (b"gAMA", (100000).to_bytes(4, "big"), True),
    (b"gAMA", (45455).to_bytes(4, "big"), False),
    (b"cICP", bytes([9, 16, 0, 1]), True),
    (b"cICP", bytes([1, 13, 0, 1]), False),
])  # fmt: skip
def test_other_colours_of_a_png_are_said(tmp_path, chunk, value, said):
    from PIL import PngImagePlugin

    more = PngImagePlugin.PngInfo()
    more.add(chunk, value)
    Image.new("RGB", (8, 6), (90, 40, 10)).save(tmp_path / "a.png", pnginfo=more)
    assert bool([note for note in read_picture(tmp_path / "a.png").notes if chunk.decode() in note]) == said


def test_what_the_display_window_hides_is_said(tmp_path, capsys, rng):
    rgb = picture(rng, 12, 16)
    header = {"dataWindow": ((-2, -2), (13, 9)), "displayWindow": ((0, 0), (9, 7))}
    a, b = (
        exr(tmp_path / name, dict(zip("RGB", np.moveaxis(rgb * f, -1, 0).copy(), strict=True)), **header)
        for name, f in (("a.exr", 1), ("b.exr", 1))
    )
    _, record, said = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "psnr")
    assert record["rows"][0]["size"] == [10, 8] and "outside the display window were not compared" in said
    _, record, said = run(capsys, a, b, "-o", tmp_path / "out", "--metrics", "psnr", "--window", "overlap")
    assert record["rows"][0]["size"] == [16, 12] and "outside the display" not in said
