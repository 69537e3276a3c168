"""Foreground masks of stylized views: the rendered coverage, or a segmenter from an ONNX file.

BiRefNet (the paper's choice) is read as ONNX, so no code is downloaded with its weights. Its logits pass a plain
sigmoid and a threshold of 0.5. Common wrappers stretch the mask to 0..1 first, which would turn a picture without
foreground into foreground everywhere.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.core.image import resize, srgb_from_linear
from mistyle.core.view import View
from mistyle.stylization.mvst.sweep import Masker

SIDE = 1024  # BiRefNet's input where the file leaves the size open
MEAN, SPREAD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)


def segmenter(path: Path) -> Masker:
    """A Masker from an ONNX file with one picture (1 3 s s) in and logits (1 1 s s) out, the last of its outputs.

    The input is as in BiRefNet's training: sRGB, resized to a square, normalised by ImageNet's mean and deviation.
    Raises EnvironmentMissing without onnxruntime, InputRefused for a file that is not such a model.
    """
    session = opened(path)
    inputs = session.get_inputs()
    if len(inputs) != 1 or len(inputs[0].shape) != 4:
        shapes = ", ".join(str(one.shape) for one in inputs)
        raise InputRefused(
            f"{path}: found inputs of shape {shapes}, expected one picture (1, 3, height, width);"
            " use the ONNX file of BiRefNet or of a similar segmenter"
        )
    half = getattr(inputs[0], "type", "") == "tensor(float16)"
    height, width = (n if isinstance(n, int) and n > 0 else SIDE for n in inputs[0].shape[2:])

    def mask(view: View) -> np.ndarray:
        ready = prepared(srgb_from_linear(view.rgb), (height, width)).astype(np.float16 if half else np.float32)
        return foreground(session.run(None, {inputs[0].name: ready})[-1], view.camera.size, path)

    return mask


def opened(path: Path) -> Any:
    """The inference session of a file on the CPU."""
    try:
        import onnxruntime
    except ImportError:
        raise EnvironmentMissing(
            "a segmenter needs the package onnxruntime, which is not installed; `pip install onnxruntime` adds it,"
            " or leave the segmenter out: the rendered masks are exact"
        ) from None
    if not path.is_file():
        raise InputRefused(f"{path}: found nothing, expected the ONNX file of a segmenter; check the path")
    try:
        return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base class
        raise InputRefused(f"{path}: onnxruntime cannot open it ({error}); is it a whole ONNX model?") from error


def prepared(encoded: Float[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float[np.ndarray, "1 3 a b"]:
    """A picture (sRGB 0..1) as the network's input."""
    scaled = (np.clip(resize(encoded, size), 0, 1) - MEAN) / SPREAD
    return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None], np.float32)


def foreground(logits: np.ndarray, size: tuple[int, int], path: Path) -> Bool[np.ndarray, "h w"]:
    """sigmoid(logits) > 0.5 at `size`; the probabilities are resized, not the mask."""
    plane = np.squeeze(np.asarray(logits, np.float32))
    if plane.ndim != 2 or not np.isfinite(plane).all():
        raise InputRefused(
            f"{path}: its output has the shape {np.shape(logits)} or is not finite, expected finite logits"
            " (1, 1, height, width); use a segmenter of one class"
        )
    probability = 0.5 * (1 + np.tanh(plane / 2))  # the sigmoid, without overflow
    return resize(probability.astype(np.float32), size) > 0.5
