"""What is compared of two pictures: layers matched by name, windows aligned, pixels masked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.errors import InputRefused
from mistyle.core.image import resize
from mistyle.io.images.layers import BEAUTY, Layer, LayeredPicture, Window


@dataclass(frozen=True)
class Planes:
    """One layer of both pictures over the same pixels, float32 (h w c), and the mask of compared pixels.

    `odd` marks pixels with a NaN or infinite channel in either picture (data layers: only where the pictures differ);
    `mask` excludes them. `bad` counts NaN and infinite pixels of the reference and of the test.
    """

    layer: str
    kind: Literal["colour", "data"]
    reference: Float[np.ndarray, "h w c"]
    test: Float[np.ndarray, "h w c"]
    mask: Bool[np.ndarray, "h w"]
    odd: Bool[np.ndarray, "h w"]
    bad: dict[str, int]


def chosen_layers(
    reference: LayeredPicture, test: LayeredPicture, requested: Sequence[str]
) -> tuple[list[str], list[str], list[str]]:
    """The names of the layers to compare, and of those that only the reference and only the test has.

    `requested` names them (InputRefused where a picture lacks one); empty: all common layers.
    """
    names = [layer.name for layer in reference.layers]
    if requested:
        for name in requested:
            for frame in (reference, test):
                if frame.layer(name) is None:
                    available = ", ".join(layer.name for layer in frame.layers)
                    raise InputRefused(f"{frame.path}: found layers {available}; expected {name!r}. Name one of them.")
        return list(requested), [], []
    both = [name for name in names if test.layer(name) is not None]
    if not both:
        theirs = ", ".join(layer.name for layer in test.layers)
        raise InputRefused(f"{test.path}: found layers {theirs}; expected one of {', '.join(names)}. Rename layers.")
    lost = [name for name in names if test.layer(name) is None]
    return both, lost, [layer.name for layer in test.layers if reference.layer(layer.name) is None]


def window_notes(frame: LayeredPicture) -> list[str]:
    """What the display window hides of a file's pixels, and where it has none."""
    beyond = [layer for layer in frame.layers if _outside(layer.window, layer.display)]
    empty = [layer for layer in frame.layers if _outside(layer.display, layer.window)]
    notes = ["pixels outside the display window were not compared (--window overlap does)"] if beyond else []
    return notes + ["pixels without data in the display window count as 0"] * bool(empty)


def _outside(inner: Window, outer: Window) -> bool:
    """Whether a window has pixels outside another one."""
    (x, y, width, height), (left, top, wide, high) = inner, outer
    return x < left or y < top or x + width > left + wide or y + height > top + high


def planes(
    reference: LayeredPicture,
    test: LayeredPicture,
    name: str,
    window: Literal["display", "overlap"],
    mask: np.ndarray | None,
) -> Planes:
    """One layer of both frames over the same window. InputRefused where sizes, channels or colour spaces differ.

    window  "display": the display window, of equal size in both, zero outside a data window (as OpenEXR defines it);
            "overlap": the intersection of the data windows
    mask    (h w) of the display window: pixels to compare; None: all

    Display windows of equal size are aligned at their top left corners, windows of different size by absolute
    coordinates.
    """
    a, b = _layer(reference, name), _layer(test, name)
    if a.channels != b.channels:
        found, expected = "".join(b.channels), "".join(a.channels)
        raise InputRefused(f"{test.path}: found channels {found} in layer {name!r}; expected {expected}. Match them.")
    if a.kind == "colour" and not np.allclose(reference.chromaticities, test.chromaticities, atol=1e-4):
        found, expected = (" ".join(f"{v:.4f}" for v in f.chromaticities) for f in (test, reference))
        raise InputRefused(f"{test.path}: found primaries {found}; expected {expected}. Convert one of them.")
    if a.display[2:] == b.display[2:]:
        b = b.moved(a.display[0] - b.display[0], a.display[1] - b.display[1])
    area = _window(a, b, reference, test, window)
    left, right = a.values(area), b.values(area)
    counted = np.ones(left.shape[:2], bool) if mask is None else _cut(mask, a.display, area, test.path)
    return _compared_pixels(name, a.kind, left, right, counted)


def _layer(frame: LayeredPicture, name: str) -> Layer:
    layer = frame.layer(name)
    if layer is None:
        raise InputRefused(f"{frame.path}: found no layer {name!r}; expected it, since the other picture has it.")
    return layer


def _window(a: Layer, b: Layer, reference: LayeredPicture, test: LayeredPicture, mode: str) -> Window:
    if mode == "display":
        if a.display == b.display:
            return a.display
        found, expected = (f"{w} x {h}" for _, _, w, h in (b.display, a.display))
        raise InputRefused(
            f"{test.path}: found {found} pixels; expected {expected} as {reference.path} has. Nothing is resampled: "
            "render both at one size, or compare their common pixels with --window overlap"
        )
    x, y = max(a.window[0], b.window[0]), max(a.window[1], b.window[1])
    right = min(w[0] + w[2] for w in (a.window, b.window))
    bottom = min(w[1] + w[3] for w in (a.window, b.window))
    if right <= x or bottom <= y:
        raise InputRefused(f"{test.path}: found a data window {b.window}; expected one that meets {a.window}.")
    return x, y, right - x, bottom - y


def _cut(mask: np.ndarray, display: Window, area: Window, path: Path) -> np.ndarray:
    if mask.shape != (display[3], display[2]):
        found, expected = (f"{s[1]} x {s[0]}" for s in (mask.shape, display[:1:-1]))
        raise InputRefused(f"{path}: found a mask of {found} pixels; expected {expected} as the picture has.")
    layer = Layer("mask", ("M",), (mask.astype(np.float32),), "data", display, display)
    return layer.values(area)[..., 0] > 0.5


def _compared_pixels(name: str, kind, left: np.ndarray, right: np.ndarray, counted: np.ndarray) -> Planes:
    bad = {}
    for who, values in (("reference", left), ("test", right)):
        bad[f"nan_{who}"] = int((np.isnan(values).any(axis=-1) & counted).sum())
        bad[f"inf_{who}"] = int((np.isinf(values).any(axis=-1) & counted).sum())
    broken = ~(np.isfinite(left).all(axis=-1) & np.isfinite(right).all(axis=-1))
    odd = broken & counted
    if kind == "data" and odd.any():
        # Background depth is infinite; equal infinities are not an error.
        same = ((left == right) | (np.isfinite(left) & np.isfinite(right))).all(axis=-1)
        odd &= ~same
    return Planes(name, kind, left, right, counted & ~broken, odd, bad)


def read_mask(path: Path, frame: LayeredPicture) -> Bool[np.ndarray, "h w"]:
    """A mask file above one half: its alpha where that is not everywhere 1, else its sRGB-encoded grey value."""
    from mistyle.io.read import read_frame

    picture = read_frame(path)
    layer = picture.layer("alpha") or picture.layer(BEAUTY) or picture.layers[0]
    values = layer.values()
    return np.asarray(values.mean(axis=-1) > 0.5 if layer.kind == "data" else values.mean(axis=-1) > 0.2140)


def alpha_mask(frame: LayeredPicture) -> Bool[np.ndarray, "h w"]:
    """The pixels whose alpha exceeds one half. InputRefused without alpha."""
    alpha = frame.layer("alpha")
    if alpha is None:
        raise InputRefused(f"{frame.path}: found no alpha channel; expected one for --mask alpha. Give a mask file.")
    return np.asarray(alpha.values()[..., 0] > 0.5)


def reduced(frame: LayeredPicture, test: LayeredPicture, factor: int) -> LayeredPicture:
    """The frame averaged over `factor` x `factor` pixels, if it is exactly `factor` times the test's size."""
    wide, high = test.layers[0].display[2:]
    if any(x.display != (0, 0, wide * factor, high * factor) for x in frame.layers):
        return frame
    window = (0, 0, wide, high)

    def small(layer: Layer) -> Layer:
        values = resize(layer.values(), (high, wide))
        return replace(layer, planes=tuple(np.moveaxis(values, -1, 0)), window=window, display=window)

    return replace(frame, layers=tuple(small(layer) for layer in frame.layers))
