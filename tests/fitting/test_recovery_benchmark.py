"""The parts of the recovery benchmark that need no fit: fetching, averaging, cameras, resolution, strong maps."""

import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from benchmarks import data as fetching
from benchmarks.material_recovery.pictures import fibonacci, one_at_a_time, together
from benchmarks.material_recovery.truth import average, fitted_size, footprint, seen, truth
from mistyle.core.maps import flat_maps
from tests.support.helpers import data


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A server of one small file, and the item that names it."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "a.bin").write_bytes(b"content")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "site")))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    digest = "ed7002b439e9ac845f22357d822bac1444730fbdb6016d3ec9432297b9ec9f73"
    yield fetching.Item("deep/a.bin", f"http://127.0.0.1:{server.server_address[1]}/a.bin", digest)
    server.shutdown()
    server.server_close()


def test_a_file_is_fetched_once_and_kept_only_when_it_is_the_right_one(served, tmp_path):
    out = tmp_path / "out"
    assert fetching.fetch(served, out) and (out / "deep" / "a.bin").read_bytes() == b"content"
    assert not fetching.fetch(served, out)
    with pytest.raises(fetching.NotFetched, match="not the pinned one"):
        fetching.fetch(replace(served, sha256="0" * 64), tmp_path / "other")
    assert not list((tmp_path / "other").rglob("*"))
    (out / "deep" / "a.bin").write_bytes(b"mine")
    with pytest.raises(fetching.NotFetched, match="other content"):
        fetching.fetch(served, out)
    assert (out / "deep" / "a.bin").read_bytes() == b"mine"


def test_what_does_not_come_is_named_with_what_to_do(served, tmp_path):
    for address in (served.address + "x", "http://127.0.0.1:9/a.bin"):
        with pytest.raises(fetching.NotFetched, match="HTTPS_PROXY"):
            fetching.fetch(replace(served, address=address), tmp_path)


def test_pinned_files_are_those_at_hand():
    for item in fetching.ITEMS:
        content = data(item.path).read_bytes()
        # The published glTF files end in a newline, the ones here do not.
        content += b"\n" if item.path.endswith(".gltf") else b""
        assert fetching._digest(content) == item.sha256


def test_averaging_counts_covered_texels_only():
    fine = flat_maps(4)
    values = np.arange(16, dtype=np.float32).reshape(4, 4) / 16
    tilt = np.zeros((4, 4, 3), np.float32)
    tilt[..., 0], tilt[..., 2] = 0.6, 0.8
    tilt[0, 0] = (-0.6, 0, 0.8)
    covered = np.zeros((4, 4), bool)
    covered[0, :2] = covered[2:, 2:] = True
    found = average(replace(fine, roughness=values, normal=tilt), covered, 2, np.ones((2, 2), bool))
    assert found.roughness[0, 0] == pytest.approx((values[0, 0] + values[0, 1]) / 2)
    assert found.roughness[1, 1] == pytest.approx(values[2:, 2:].mean())
    assert found.normal[0, 0] == pytest.approx([0, 0, 1])  # of (-0.6, 0, 0.8) and (0.6, 0, 0.8)
    assert found.roughness[0, 1] in (found.roughness[0, 0], found.roughness[1, 1])
    assert np.linalg.norm(found.normal, axis=-1) == pytest.approx(1)


def test_cameras_are_even_and_look_at_the_object():
    cameras = fibonacci(16, 64)
    eyes = np.stack([c.position for c in cameras])
    assert np.linalg.norm(eyes, axis=1) == pytest.approx(4)
    assert np.abs(eyes.mean(axis=0)).max() < 0.1
    apart = np.degrees(np.arccos(np.clip(eyes @ eyes.T / 16 - 2 * np.eye(16), -1, 1))).min(axis=1)
    assert apart.min() > 30
    assert footprint(cameras[0]) == pytest.approx(8 * np.tan(np.radians(15)) / 64)


def test_lights_one_at_a_time_add_up_to_all_together(rng):
    shots = one_at_a_time(fibonacci(2, 8))
    pictures = list(rng.random((6, 8, 8, 4)))
    kept = [p.copy() for p in pictures]
    summed, sums = together(shots, pictures)
    assert len(shots) == 6 and len(summed) == 2 and all(len(s.lights) == 3 for s in summed)
    assert sums[1] == pytest.approx(sum(pictures[3:]))
    assert all(np.array_equal(a, b) for a, b in zip(pictures, kept, strict=True))
    assert np.array_equal(summed[1].camera.world_from_cam, shots[3].camera.world_from_cam)


def test_the_atlas_matches_the_pixels_and_strong_maps_are_strong():
    camera = fibonacci(1, 128)[0]
    known = truth(data("meshes/pbr/Avocado/Avocado.gltf"), "avocado", camera, strong=True)
    size = len(known.texels[0].covered)
    covered = known.texels[0].covered
    ratio = np.sqrt(known.areas[0].sum() / covered.sum()) / footprint(camera)
    # Coverage is read off a coarser atlas.
    assert 0.97 < ratio < 2.06 and size == fitted_size(known.mesh, 0, footprint(camera))
    maps = known.maps[0]
    tilt = maps.normal[covered][:, :2]
    assert tilt.std(axis=0) == pytest.approx(0.15, rel=0.2)
    assert 0.15 <= maps.roughness.min() < 0.2 and 0.9 < maps.roughness.max() <= 0.95
    inner = covered[:, 1:] & covered[:, :-1]
    step = np.abs(np.diff(maps.roughness, axis=1))[inner]
    assert np.percentile(step, 50) < 0.1 * np.ptp(maps.roughness)
    counts = seen(known, fibonacci(16, 128))[0]
    assert counts[~covered].max() == 0 and 4 < counts[covered].mean() < 8
