"""The segmenter's border: what goes into the network, what comes out, and what is refused."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.core.image import overlap, srgb_from_linear
from mistyle.stylization.mvst import masks
from mistyle.stylization.mvst.settings import SweepSettings
from mistyle.stylization.mvst.sweep import ViewPainter, sweep
from tests.stylization.mvst.test_warp import BALL, at, see


class Session:
    """Stands for a network that calls whatever is brighter than grey foreground: logits 20 (luma - 0.4)."""

    def __init__(self, shape=(1, 3, 64, 64)) -> None:
        self.shape, self.seen = shape, None

    def get_inputs(self):
        return [SimpleNamespace(name="picture", shape=list(self.shape))]

    def run(self, names, given):
        self.seen = given["picture"]
        picture = self.seen * masks.SPREAD[:, None, None] + masks.MEAN[:, None, None]
        return [np.zeros(3), 20 * (picture.mean(axis=1, keepdims=True) - 0.4)]


@pytest.fixture
def runtime(monkeypatch):
    """An onnxruntime that opens every file as the network above."""
    session = Session()
    monkeypatch.setitem(sys.modules, "onnxruntime", SimpleNamespace(InferenceSession=lambda path, providers: session))
    return session


def test_a_bright_thing_is_found(runtime, tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"net")
    view = see(at(0, size=128), [BALL], paint=lambda points, which: np.full((len(points), 3), 0.8, np.float32))
    found = masks.segmenter(tmp_path / "net.onnx")(view)
    assert runtime.seen.shape == (1, 3, 64, 64) and runtime.seen.dtype == np.float32
    assert overlap(found, view.mask) > 0.97
    middle = srgb_from_linear(view.rgb)[64, 64]
    assert runtime.seen[0, :, 32, 32] == pytest.approx((middle - masks.MEAN) / masks.SPREAD, abs=1e-5)


def test_a_picture_without_foreground_has_an_empty_mask(runtime, tmp_path):
    """A mask stretched to 0..1 would call the least dark pixels of darkness foreground."""
    (tmp_path / "net.onnx").write_bytes(b"net")
    view = see(at(0, size=64), [BALL], paint=lambda points, which: 0.01 * np.abs(points).astype(np.float32))
    assert not masks.segmenter(tmp_path / "net.onnx")(view).any()


def test_the_sweep_reports_the_drift(runtime, tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"net")
    views = [see(at(a, size=64), [BALL]) for a in (0, 40)]

    def grey(view, prior, rng):
        return 0.8 * view.mask[..., None] * np.ones(3, np.float32)

    painter = ViewPainter(grey, masks.segmenter(tmp_path / "net.onnx"))
    swept = sweep(views, painter, SweepSettings(), 0)
    assert all(0.9 < p.drift <= 1 for p in swept.painted)


def test_a_size_that_the_file_leaves_open_is_birefnets(runtime, tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"net")
    runtime.shape = ("batch", 3, "height", "width")
    masks.segmenter(tmp_path / "net.onnx")(see(at(0, size=32), [BALL]))
    assert runtime.seen.shape == (1, 3, masks.SIDE, masks.SIDE)


def test_logits_become_a_mask_by_sign():
    logits = np.array([[[[-1e4, -0.01], [0.01, 1e4]]]])
    assert masks.foreground(logits, (2, 2), Path("net")).tolist() == [[False, False], [True, True]]


def test_what_is_refused(runtime, tmp_path):
    with pytest.raises(InputRefused, match="found nothing"):
        masks.segmenter(tmp_path / "absent.onnx")
    (tmp_path / "net.onnx").write_bytes(b"net")
    runtime.shape = (1, 64)
    with pytest.raises(InputRefused, match="expected one picture"):
        masks.segmenter(tmp_path / "net.onnx")
    with pytest.raises(InputRefused, match="one class"):
        masks.foreground(np.zeros((1, 2, 4, 4)), (4, 4), tmp_path)
    with pytest.raises(InputRefused, match="finite"):
        masks.foreground(np.full((1, 1, 4, 4), np.nan), (4, 4), tmp_path)


def test_without_onnxruntime_the_message_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(EnvironmentMissing, match="pip install onnxruntime"):
        masks.segmenter(tmp_path / "net.onnx")


def test_a_broken_file_is_refused_by_the_real_runtime(tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"this is no network")
    expected = InputRefused if importlib.util.find_spec("onnxruntime") else EnvironmentMissing
    with pytest.raises(expected):
        masks.segmenter(tmp_path / "net.onnx")


@pytest.mark.parametrize("side", [64, None])
def test_a_real_onnx_file_is_opened_and_run(tmp_path, side):
    """A 1 x 1 convolution that says 20 (luma - 0.4), as a file; with its size fixed and left open."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    size = [side, side] if side else ["height", "width"]
    kind = onnx.TensorProto.FLOAT
    given = onnx.helper.make_tensor_value_info("picture", kind, [1, 3, *size])
    out = onnx.helper.make_tensor_value_info("logits", kind, [1, 1, *size])
    weight = (20 / 3 * masks.SPREAD).reshape(1, 3, 1, 1)
    bias = np.array([20 * (masks.MEAN.mean() - 0.4)], np.float32)
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Conv", ["picture", "weight", "bias"], ["logits"])],
        "bright",
        [given],
        [out],
        [onnx.numpy_helper.from_array(weight, "weight"), onnx.numpy_helper.from_array(bias, "bias")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=10)
    onnx.save(model, str(tmp_path / "net.onnx"))
    view = see(at(0, size=96), [BALL], paint=lambda points, which: np.full((len(points), 3), 0.8, np.float32))
    assert overlap(masks.segmenter(tmp_path / "net.onnx")(view), view.mask) > 0.97
    (tmp_path / "broken.onnx").write_bytes((tmp_path / "net.onnx").read_bytes()[:20])
    with pytest.raises(InputRefused, match="cannot open"):
        masks.segmenter(tmp_path / "broken.onnx")


@pytest.mark.skipif(importlib.util.find_spec("onnxruntime") is None, reason="onnxruntime is not installed")
@pytest.mark.parametrize("half", [False, True])
def test_a_network_of_birefnets_signature_runs_in_both_precisions(tmp_path, half):
    """What is brighter than ImageNet's mean in all channels is foreground; the last of several answers counts."""
    from tests.support import tiny_models

    tiny_models.birefnet(tmp_path / "birefnet", half)
    (file,) = (tmp_path / "birefnet").glob("*.onnx")
    view = see(at(0, size=128), [BALL], paint=lambda points, which: np.full((len(points), 3), 0.8, np.float32))
    assert overlap(masks.segmenter(file)(view), view.mask) > 0.97
