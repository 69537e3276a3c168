"""Pictures as layers for comparison: every AOV of a multi-layer or multi-part EXR by its name, or one plain picture.

Colours are linear Rec.709 as stored, premultiplied by alpha (EXR is; PNG and similar formats are straight and are
multiplied here, in linear light). Nothing is resampled, tone-mapped or clipped, and NaN and infinities stay.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Shaped

from mistyle.core.asset import Picture
from mistyle.io.images import hdr
from mistyle.io.images.float_tiff import read_float_tiff
from mistyle.io.images.quantisation import linear_rows
from mistyle.io.images.write import REC709_CHROMATICITIES
from mistyle.io.sandbox.bounds import refuse

BEAUTY = "beauty"
# Renderers' names of the finished picture, which is matched across renderers as one layer.
BEAUTY_NAMES = {"", "beauty", "combined", "rgba", "rgb", "color", "colour", "composite"}
AGAIN = "Write or copy it again"
Window = tuple[int, int, int, int]


@dataclass(frozen=True)
class Layer:
    """One layer of a frame: planes (h w) in the file's own precision, all over `window`.

    kind     "colour" (red, green, blue) or "data" (everything else: alpha, depth, normals, ids)
    window   x, y, width, height of the planes in the frame's pixel coordinates
    display  the display window, in which frames are compared
    """

    name: str
    channels: tuple[str, ...]
    planes: tuple[Shaped[np.ndarray, "h w"], ...]
    kind: Literal["colour", "data"]
    window: Window
    display: Window

    def moved(self, x: int, y: int) -> "Layer":
        """The same picture with both windows moved to the right and down."""
        if (x, y) == (0, 0):
            return self
        data, shown = ((a + x, b + y, width, height) for a, b, width, height in (self.window, self.display))
        return replace(self, window=data, display=shown)

    def values(self, window: Window | None = None) -> Float[np.ndarray, "h w c"]:
        """Values over `window` (None: the display window), zero where the file has no data; float32, of integers
        float64, which holds each of them exactly."""
        x, y, width, height = window or self.display
        whole = any(plane.dtype.kind in "iu" for plane in self.planes)
        result = np.zeros((height, width, len(self.planes)), np.float64 if whole else np.float32)
        left, top = max(x, self.window[0]), max(y, self.window[1])
        right, bottom = (
            min(a + n, b + m) for a, n, b, m in ((x, width, *self.window[::2]), (y, height, *self.window[1::2]))
        )
        if right > left and bottom > top:
            rows = slice(top - self.window[1], bottom - self.window[1])
            columns = slice(left - self.window[0], right - self.window[0])
            for k, plane in enumerate(self.planes):
                result[top - y : bottom - y, left - x : right - x, k] = plane[rows, columns]
        return result


@dataclass(frozen=True)
class LayeredPicture:
    """A picture file. `high`: its values are not bounded by 1 (EXR, HDR, PFM). `chromaticities` are its header's
    (Rec.709 without an entry)."""

    path: Path
    layers: tuple[Layer, ...]
    high: bool
    chromaticities: tuple[float, ...] = REC709_CHROMATICITIES
    notes: tuple[str, ...] = ()

    def layer(self, name: str) -> Layer | None:
        """The layer of that name (ignoring case), or None."""
        return next((layer for layer in self.layers if layer.name.casefold() == name.casefold()), None)


def read_frame(path: Path) -> LayeredPicture | None:
    """An .exr, an .hdr, a .pfm, or a TIFF of floating-point numbers (None for other TIFFs); see io/read.py."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".exr":
        return _read_exr(path)
    if kind in (".hdr", ".pfm"):
        rgb = hdr.read_hdr(path) if kind == ".hdr" else hdr.read_pfm(path)
        whole = (0, 0, rgb.shape[1], rgb.shape[0])
        return LayeredPicture(path, (Layer(BEAUTY, ("R", "G", "B"), _planes(rgb), "colour", whole, whole),), True)
    if kind in (".tif", ".tiff"):
        values = read_float_tiff(path)
        if values is None:
            return None
        whole = (0, 0, values.shape[1], values.shape[0])
        layers = [Layer(BEAUTY, ("R", "G", "B"), _planes(values[..., :3]), "colour", whole, whole)]
        if values.shape[2] == 4:
            layers.append(Layer("alpha", ("A",), (values[..., 3],), "data", whole, whole))
        return LayeredPicture(
            path, tuple(layers), True, notes=("A TIFF of floating-point numbers was taken as linear.",)
        )
    raise refuse(path, f"a file ending in '{kind}'", "an .exr, .hdr, .pfm or .tif", "Read it as a picture")


def frame_of(picture: Picture) -> LayeredPicture:
    """A plain picture as a frame; its rgb is linearised and premultiplied."""
    whole = (0, 0, picture.rgb.shape[1], picture.rgb.shape[0])
    linear = linear_rows(picture.rgb)
    layers = []
    if picture.alpha is not None:
        linear *= picture.alpha[..., None]
        layers.append(Layer("alpha", ("A",), (picture.alpha,), "data", whole, whole))
    layers.insert(0, Layer(BEAUTY, ("R", "G", "B"), _planes(linear), "colour", whole, whole))
    return LayeredPicture(picture.path, tuple(layers), False, notes=picture.notes)


def _planes(rgb: Float[np.ndarray, "h w 3"]) -> tuple[np.ndarray, ...]:
    return tuple(rgb[..., k] for k in range(rgb.shape[2]))


def _read_exr(path: Path) -> LayeredPicture:
    parts = hdr.parts_of_exr(path)
    groups = [group for part in parts for group in _groups(part, len(parts) > 1, path)]
    beauty = next((name for name, *_ in groups if name.rpartition(".")[2].casefold() in BEAUTY_NAMES), None)
    mattes = {_text(v) for part in parts for key, v in part.header.items() if re.fullmatch("cryptomatte/.+/name", key)}
    layers: list[Layer] = []
    for group in groups:
        matte = any(re.fullmatch(rf"(.*\.)?{re.escape(name)}\d\d", group[0]) for name in mattes)
        layers += _matte(*group) if matte else _split(*group, group[0] == beauty)
    names = [layer.name.casefold() for layer in layers]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise refuse(path, f"two layers called {duplicates[0]!r}", "names that tell layers apart", "Rename one of them")
    return LayeredPicture(path, tuple(layers), True, hdr.chromaticities(parts[0].header, path))


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _matte(name: str, planes: dict[str, np.ndarray], window: Window, display: Window) -> list[Layer]:
    """Two ranks of Cryptomatte 1.2: IDs are bit patterns in R and B, not numbers; G and A are their coverage."""
    upper = {channel.upper(): plane for channel, plane in planes.items()}
    if set(upper) != set("RGBA") or any(plane.dtype != np.float32 for plane in planes.values()):
        order = sorted(planes)
        return [Layer(name, tuple(order), tuple(planes[c] for c in order), "data", window, display)]
    ids = tuple(np.ascontiguousarray(upper[c]).view(np.uint32) for c in "RB")
    return [
        Layer(f"{name}.id", ("R", "B"), ids, "data", window, display),
        Layer(f"{name}.coverage", ("G", "A"), (upper["G"], upper["A"]), "data", window, display),
    ]


def _groups(part: Any, several: bool, path: Path) -> list[tuple[str, dict[str, np.ndarray], Window, Window]]:
    """A part's channels by layer: the layer's full name, its planes by short name, data and display window."""
    window, display = hdr.window_of(part.header, "dataWindow"), hdr.window_of(part.header, "displayWindow")
    part_name = str(part.header.get("name") or "") if several else ""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, channel in part.channels.items():
        pixels = np.asarray(channel.pixels)
        if pixels.shape != (window[3], window[2]):
            raise refuse(path, f"{pixels.shape} texels", f"{(window[3], window[2])} by its header", AGAIN)
        layer, _, short = name.rpartition(".")
        groups.setdefault(_full(part_name, layer), {})[short] = pixels
    return [(name, planes, window, display) for name, planes in groups.items()]


def _full(part: str, layer: str) -> str:
    """The layer's name with its part's, which many writers repeat in the channels' names."""
    if not part or layer == part or layer.startswith(f"{part}."):
        return layer or part
    return f"{part}.{layer}" if layer else part


def _split(name: str, planes: dict[str, np.ndarray], window: Window, display: Window, beauty: bool) -> list[Layer]:
    """The colour, alpha and data layers of a group of channels."""
    title = BEAUTY if beauty else name
    upper = {channel.upper(): channel for channel in planes}
    result = []
    if set("RGB") <= set(upper):
        used = tuple(upper[c] for c in "RGB")
        result.append(Layer(title, tuple("RGB"), tuple(planes[c] for c in used), "colour", window, display))
    elif beauty and "Y" in upper and "X" not in upper:
        used = (upper["Y"],)
        result.append(Layer(title, tuple("RGB"), (planes[used[0]],) * 3, "colour", window, display))
    else:
        used = ()
    rest = {c: p for c, p in planes.items() if c not in used}
    if not result and set(rest) != {"A"}:
        order = sorted(rest)
        return [Layer(name or "data", tuple(order), tuple(rest[c] for c in order), "data", window, display)]
    for channel, plane in rest.items():
        layer_name = "alpha" if beauty and channel.upper() == "A" else f"{name}.{channel}" if name else channel
        result.append(Layer(layer_name, (channel,), (plane,), "data", window, display))
    return result
