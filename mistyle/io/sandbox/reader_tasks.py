"""Tasks of the reader process, by name: each opens, checks and decodes one file (or folder).

The first argument is the file's path; io/sandbox/rpc_codec.py must support all arguments and results. The job's own
process never calls these functions.
"""

import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path
from tokenize import TokenError
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import RAW, Pixels
from mistyle.core.errors import InputRefused
from mistyle.geometry.uvs import SPILL
from mistyle.io.gltf.check import load_gltf, read_json
from mistyle.io.gltf.glb import Buffers
from mistyle.io.images import hdr
from mistyle.io.images import read as pictures
from mistyle.io.meshes.parsed_mesh import Indexed, Raw, RawMaterial, Textures, Tile
from mistyle.io.sandbox.bounds import MAX_DEPTH, MAX_SETTINGS_BYTES, MAX_VALUES, read_bytes, refuse
from mistyle.io.sandbox.rpc_codec import Json

TILES = 10  # a UDIM layout has at most so many tiles along u and along v
AGAIN = "Write it again"


def mesh(path: Path, reader: str, max_faces: int) -> Raw | Indexed:
    """The mesh with all its textures decoded. `reader` is "module:function", of io/read_mesh.py."""
    module, _, function = reader.partition(":")
    if not module.startswith("mistyle.io."):
        raise ValueError(f"{reader} is not a reader of mistyle")
    with _usd(path):
        parsed: Raw | Indexed = getattr(import_module(module), function)(path, max_faces)
        raw = parsed.raw if isinstance(parsed, Indexed) else parsed
        if len(raw.faces) == 0:
            raise refuse(path, "no triangles", "at least one", "Export the mesh with its faces")
        # glTF, whose UVs are not yet part of `raw`, has no tiles.
        uvs = raw.uvs
        tiled = [uvs[raw.material == k] if m.udim and uvs is not None else None for k, m in enumerate(raw.materials)]
        pairs = zip(raw.materials, tiled, strict=True)
        raw = replace(raw, materials=tuple(replace(m, load=Textures(_tiles(m, uv))) for m, uv in pairs))
        return replace(parsed, raw=raw) if isinstance(parsed, Indexed) else raw


@contextmanager
def _usd(path: Path) -> Iterator[None]:
    """Convert exceptions of USD, of the archive and of the text to refusals."""
    if not path.suffix.lower().startswith(".usd"):
        yield
        return
    try:
        yield
    except (UnicodeDecodeError, BadZipFile, RuntimeError, ValueError, KeyError, IndexError, OSError) as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        fix = "Export it again, or flatten it (usdcat --flatten)"
        raise refuse(path, f"a layer that USD cannot read ({first})", "a USD file", fix) from error


def _tiles(material: RawMaterial, uvs: Float[np.ndarray, "f 3 2"] | None) -> dict[int, Tile]:
    """The textures of every tile that may contain a face (geometry/uvs.py `nearest_tiles`); tile 1001 where the UVs are
    not tiled."""
    numbers = {1001}
    if material.udim and uvs is not None:
        faces = uvs[np.isfinite(uvs).all(axis=(1, 2))]
        middles = (faces.min(axis=1) + faces.max(axis=1)) / 2
        corners = [faces.reshape(-1, 2) + np.array(step) for step in product((-SPILL, 0, SPILL), repeat=2)]
        u, v = np.clip(np.floor(np.concatenate([middles, *corners])), 0, TILES - 1).astype(np.int64).T
        numbers |= {int(n) for n in 1001 + np.flatnonzero(np.bincount(u + 10 * v))}
    loaded: dict[int, Tile] = {}
    for number in sorted(numbers):
        try:
            maps, notes = material.load(number)
            loaded[number] = Tile(dict(maps), tuple(notes))
        except InputRefused as error:
            if number == 1001 and len(numbers) == 1:
                raise
            loaded[number] = Tile({}, (), str(error))  # raised only if a face lies in that tile
    return loaded


def exr(path: Path, colours: bool) -> dict[str, np.ndarray]:
    return hdr.read_exr(path, colours)


def frame(path: Path) -> Any:
    from mistyle.io.images.layers import read_frame

    return read_frame(path)


def radiance(path: Path) -> Float[np.ndarray, "h w 3"]:
    kind = path.suffix.lower()
    if kind not in (".exr", ".hdr"):
        raise refuse(path, f"a file ending in '{kind}'", "an .exr or .hdr environment map", "Convert it to one of them")
    if kind == ".hdr":
        return _around(hdr.read_hdr(path), path)
    planes = hdr.read_exr(path, colours=True)
    if not {"R", "G", "B"} <= set(planes):
        raise refuse(path, f"channels {', '.join(sorted(planes))[:200]}", "R, G and B", "Write the colours as R, G, B")
    values = np.stack([planes[c] for c in "RGB"], axis=-1).astype(np.float32)
    if not np.isfinite(values).all() or values.min() < 0:
        raise refuse(path, "radiance that is negative, NaN or infinite", "finite radiance >= 0", "Write it again")
    return _around(values, path)


def _around(values: Float[np.ndarray, "h w 3"], path: Path) -> Float[np.ndarray, "h w 3"]:
    """The values, if their shape can be that of a latitude-longitude map; cube maps and mirror balls have others."""
    height, width = values.shape[:2]
    if not 1.8 < width / height < 2.2:
        found = f"a picture of {width} x {height} pixels"
        raise refuse(path, found, "a latitude-longitude map, twice as wide as high", "Convert it to one")
    return values


def picture(path: Path, pixels: Pixels = "upright") -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    return pictures.read_pixels(path, pixels)


def raw(path: Path, pixels: Pixels) -> np.ndarray:
    from mistyle.io.images.raw import read_raw

    return read_raw(path, pixels)


def exposure(path: Path) -> tuple[float, float, float]:
    nothing = float("nan"), float("nan"), float("nan")
    return nothing if path.suffix.lower() in (".exr", *RAW) else pictures.exposure_of_picture(path)


def size(path: Path) -> tuple[int, int, int]:
    if not path.is_file():
        raise refuse(path, "nothing", "a picture", "Check the path")
    kind = path.suffix.lower()
    if kind in RAW:
        from mistyle.io.images.raw import size_of_raw

        return size_of_raw(path)
    return (*hdr.size_of_exr(path), 1) if kind == ".exr" else pictures.size_of_picture(path)


def npy(path: Path) -> np.ndarray:
    if read_bytes(path, count=6) != b"\x93NUMPY":
        raise refuse(path, "no NumPy header", "an .npy file of numbers", AGAIN)
    try:
        # Mapped: a header that declares more data than the file holds is refused before allocation.
        array = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except (ValueError, OSError, EOFError, KeyError, TypeError, OverflowError, SyntaxError, TokenError) as error:
        raise refuse(path, f"no array ({str(error)[:100]})", "an .npy file of numbers", AGAIN) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        raise refuse(path, f"{getattr(array, 'dtype', type(array).__name__)}", "an array of numbers", AGAIN)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def json(path: Path) -> Json:
    return Json(read_json(path))


def gltf(path: Path) -> tuple[Json, Buffers]:
    tree, buffers = load_gltf(path)
    return Json(tree), buffers


def gltf_alpha(path: Path, image: int) -> Float[np.ndarray, "h w"] | None:
    from mistyle.io.gltf.alpha import image_bytes

    tree, buffers = load_gltf(path)
    data = image_bytes(tree["images"][image], tree, buffers, path)
    return None if data is None else pictures.alpha_of(data, str(path))


def toml(path: Path) -> dict[str, Any]:
    text = _text(path, "a TOML file")
    try:
        tree = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise refuse(path, f"no TOML ({str(error)[:200]})", "a TOML file", "Correct the file") from error
    return plain(tree, path)


def yaml(path: Path) -> Any:
    import yaml as library

    text = _text(path, "a YAML file")
    try:
        tree = library.safe_load(text)
    except (library.YAMLError, RecursionError, ValueError, TypeError, AttributeError, KeyError) as error:
        found = f"no YAML ({str(error).replace(chr(10), ' ')[:200]})"
        raise refuse(path, found, "a YAML file of plain values", "Correct the file") from error
    return plain(tree, path)


def _text(path: Path, expected: str) -> str:
    try:
        return read_bytes(path, MAX_SETTINGS_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise refuse(path, f"no UTF-8 text ({error})", expected, "Save it as UTF-8") from error


def plain(tree: Any, path: Path) -> Any:
    """The tree, if it holds only numbers, texts, truth values, lists and tables. At most MAX_VALUES (a YAML alias may
    repeat a value millions of times), nested at most MAX_DEPTH deep."""
    level, count = [tree], 0
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for item in level:
            if isinstance(item, Mapping):
                below += [*item.keys(), *item.values()]
            elif isinstance(item, list):
                below += item
            elif item is not None and not isinstance(item, bool | int | float | str):
                raise refuse(path, f"a {type(item).__name__}", "numbers, texts, lists and tables", "Put it in quotes")
            elif isinstance(item, int) and not -(2**63) <= item < 2**63:
                raise refuse(path, "a whole number of more than 64 bits", "a smaller one", "Correct the file")
            if (count := count + 1) + len(below) > MAX_VALUES:
                raise refuse(path, f"more than {MAX_VALUES} values", f"at most {MAX_VALUES}", "Shorten the file")
        if not below:
            return tree
        level = below
    raise refuse(path, f"values nested deeper than {MAX_DEPTH} levels", f"at most {MAX_DEPTH}", "Correct the file")


def colmap_model(folder: Path) -> list[Any]:
    from mistyle.io.cameras.colmap import read_model

    return read_model(folder)


def points(path: Path) -> Any:
    from mistyle.io.cameras.colmap import read_points
    from mistyle.io.meshes.ply_read import read_ply_points

    return read_points(path) if path.is_dir() else read_ply_points(path)


def metashape(path: Path) -> list[Any]:
    from mistyle.io.cameras.metashape import read_cameras

    return read_cameras(path)


def realityscan(path: Path) -> list[Any]:
    from mistyle.io.cameras.realityscan import read_cameras

    return read_cameras(path)


def usd_files(path: Path) -> list[str]:
    from mistyle.io.usd.read import files_of

    with _usd(path):
        return [str(file) for file in files_of(path)]


def shrink(path: Path, data: bytes, longest: int, quality: int) -> tuple[bytes, str]:
    return pictures.shrunk(data, str(path), longest, quality)


def references(path: Path) -> list[Path]:
    from mistyle.io.sandbox.references import references

    return references(path)


TASKS: dict[str, Callable[..., Any]] = {
    "mesh": mesh,
    "usd_files": usd_files,
    "exr": exr,
    "frame": frame,
    "hdr": hdr.read_hdr,
    "radiance": radiance,
    "picture": picture,
    "raw": raw,
    "shrink": shrink,
    "exposure": exposure,
    "size": size,
    "npy": npy,
    "json": json,
    "gltf": gltf,
    "gltf_alpha": gltf_alpha,
    "references": references,
    "toml": toml,
    "yaml": yaml,
    "colmap_model": colmap_model,
    "points": points,
    "metashape": metashape,
    "realityscan": realityscan,
}
