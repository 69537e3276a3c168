"""What mistyle makes of one file or folder of a stranger's: counts, sentences, and a picture without light.

Meshes are drawn here, face by face, in parallel projection from one side: a judge of readers that needs no renderer.
"""

import itertools
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from benchmarks.common import PROGRAM
from mistyle.core.asset import Asset
from mistyle.core.errors import InputRefused, MistyleError
from mistyle.core.image import srgb_from_linear
from mistyle.io.cameras.captures import read_captures, read_shots
from mistyle.io.cameras.reading_notes import reading_notes
from mistyle.io.read import read_frame, read_picture
from mistyle.io.read_mesh import MESHES, read_mesh

PIXELS = 64  # along each side of a drawn mesh
LIMIT = 600.0  # seconds of one command
# What points to the right and up in a picture taken from that side; the mesh is as the reader has it, Y up.
SIDES = {
    "front": ((1, 0, 0), (0, 1, 0)),
    "back": ((-1, 0, 0), (0, 1, 0)),
    "right": ((0, 0, -1), (0, 1, 0)),
    "left": ((0, 0, 1), (0, 1, 0)),
    "top": ((1, 0, 0), (0, 0, -1)),
    "bottom": ((1, 0, 0), (0, 0, 1)),
}


@dataclass(frozen=True)
class Seen:
    """What came of a case; None where it has no such thing.

    said      everything printed, or the reader's notes, or the sentence of a refusal
    picture   sRGB-encoded, 0..255, row 0 at the top, black where nothing is
    size      width and height in pixels, of a picture file or of the first picture of a capture
    cameras   world_from_cam of every picture of a capture
    """

    exit: int = 0
    said: str = ""
    picture: Float[np.ndarray, "h w 3"] | None = None
    size: tuple[int, int] | None = None
    materials: int | None = None
    faces: int | None = None
    pictures: int | None = None
    cameras: tuple[Float[np.ndarray, "4 4"], ...] = ()


def read(path: Path, read: Mapping[str, Any], look: str, surface_map: str) -> Seen:
    """What the readers make of a mesh, a picture or a capture; a refusal is seen like the command line shows it."""
    try:
        if path.is_dir():
            return _capture(path, read)
        if path.suffix.lower() in MESHES:
            return _mesh(read_mesh(path, **read), look, surface_map)
        return _picture(path)
    except MistyleError as error:
        return Seen(exit=error.exit_code, said=str(error))
    # A judge of readers goes on to the next case when one breaks; what broke is said, and is wrong with any `exit`.
    except (ArithmeticError, AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError) as error:
        return Seen(exit=-1, said=f"{type(error).__name__}: {error}")


def run(commands: Sequence[Sequence[str]], out: Path, show: str | None, look: str, surface_map: str) -> Seen:
    """The commands, one after the other until one fails, each in a process of its own; then what `show` (a pattern of
    one path in `out`) looks like."""
    said = ""
    for words in commands:
        line = [sys.executable, "-c", PROGRAM, *words]
        try:
            done = subprocess.run(line, capture_output=True, text=True, timeout=LIMIT, check=False)
        except subprocess.TimeoutExpired:
            return Seen(exit=-1, said=f"{said}\nnot done after {LIMIT:.0f} s")
        said += done.stdout + done.stderr
        if done.returncode:
            return Seen(exit=done.returncode, said=said)
    if show is None:
        return Seen(said=said)
    there = sorted(out.glob(show))
    if len(there) != 1:
        return Seen(exit=-1, said=f"{said}\n{len(there)} results match '{show}', not one")
    shown = read(there[0], {}, look, surface_map)
    return replace(shown, said=said + shown.said)


def _capture(folder: Path, read: Mapping[str, Any]) -> Seen:
    captures = read_captures(folder, **read)
    first = captures.load(0)[0]
    return Seen(
        said="\n".join(reading_notes(folder, read_shots(folder))),
        picture=_encoded(first),
        size=(first.shape[1], first.shape[0]),
        pictures=len(captures),
        cameras=tuple(camera.world_from_cam for camera in captures.cameras),
    )


def _picture(path: Path) -> Seen:
    if path.suffix.lower() in (".exr", ".hdr"):
        frame = read_frame(path)
        colours = next((layer for layer in frame.layers if layer.kind == "colour"), None)
        if colours is None:
            raise InputRefused(f"{path}: found no layer of colours, expected one")
        picture, notes = _encoded(colours.values()[..., :3]), frame.notes
    else:
        decoded = read_picture(path)
        picture, notes = decoded.rgb * 255.0, decoded.notes
    return Seen(said="\n".join(notes), picture=picture, size=(picture.shape[1], picture.shape[0]))


def _mesh(asset: Asset, look: str, surface_map: str) -> Seen:
    return Seen(
        said="\n".join(asset.source.notes),
        picture=drawn(asset, look, surface_map),
        materials=len(asset.materials),
        faces=len(asset.mesh.faces),
    )


def drawn(asset: Asset, look: str = "front", surface_map: str = "albedo") -> Float[np.ndarray, "h w 3"]:
    """The albedo of the surface, or its tangent-space normal encoded as in a normal map, as seen from that side: the
    square picture just holds the mesh. Nearest texel, faces seen from both sides."""
    right, up = (np.array(axis, float) for axis in SIDES[look])
    mesh, toward = asset.mesh, np.cross(right, up)
    flat = np.stack([mesh.positions @ right, -(mesh.positions @ up)], -1).astype(float)
    low, high = flat.min(axis=0), flat.max(axis=0)
    side = max(float((high - low).max()), 1e-12)
    corners = ((flat - (low + high) / 2) / side + 0.5)[mesh.faces] * PIXELS
    face, weights = _nearest(corners, (mesh.positions @ toward)[mesh.faces])
    picture = np.zeros((PIXELS, PIXELS, 3))
    for part, material in enumerate(asset.materials):
        here = (face >= 0) & (mesh.part[face] == part)
        uvs = np.einsum("nk,nkc->nc", weights[here], mesh.corner_uvs[face[here]])
        if surface_map == "normal":
            normals = np.array([[[0.0, 0.0, 1.0]]]) if material.normal is None else material.normal
            picture[here] = (_texels(normals, uvs) * 0.5 + 0.5) * 255
        else:
            albedo = np.ones((1, 1, 3)) if material.albedo is None else material.albedo
            picture[here] = _encoded(_texels(albedo, uvs) * material.albedo_factor)
    return picture


def _nearest(
    corners: Float[np.ndarray, "f 3 2"], depth: Float[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Which face is in front at every pixel's centre (-1: none), and where in it; larger depth is nearer."""
    face = np.full((PIXELS, PIXELS), -1)
    weights, front = np.zeros((PIXELS, PIXELS, 3)), np.full((PIXELS, PIXELS), -np.inf)
    for number, ((a, b, c), heights) in enumerate(zip(corners, depth, strict=True)):
        whole = np.array([[b[0] - a[0], c[0] - a[0]], [b[1] - a[1], c[1] - a[1]]])
        if abs(np.linalg.det(whole)) < 1e-12:
            continue
        low = np.clip(np.floor(np.minimum(np.minimum(a, b), c)).astype(int), 0, PIXELS)
        high = np.clip(np.ceil(np.maximum(np.maximum(a, b), c)).astype(int), 0, PIXELS)
        rows, columns = np.mgrid[low[1] : high[1], low[0] : high[0]]
        second, third = np.linalg.solve(whole, np.stack([columns.ravel() + 0.5 - a[0], rows.ravel() + 0.5 - a[1]]))
        inside = np.stack([1 - second - third, second, third], -1)
        near = inside @ heights
        rows, columns = rows.ravel(), columns.ravel()
        wins = (inside > -1e-9).all(axis=1) & (near > front[rows, columns])
        place = rows[wins], columns[wins]
        face[place], weights[place], front[place] = number, inside[wins], near[wins]
    return face, weights


def _texels(image: Float[np.ndarray, "h w 3"], uvs: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    height, width = image.shape[:2]
    columns = np.floor((uvs[:, 0] % 1) * width).astype(int) % width
    rows = np.floor((1 - uvs[:, 1] % 1) * height).astype(int) % height
    return image[rows, columns].astype(float)


def _encoded(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return srgb_from_linear(np.clip(np.asarray(linear, float), 0, 1)) * 255


def cells(picture: Float[np.ndarray, "h w 3"], rows: int, columns: int) -> Float[np.ndarray, "r c 3"]:
    """Mean colour of the middle half of every cell of a grid over the picture."""
    result = np.zeros((rows, columns, 3))
    for r, c in itertools.product(range(rows), range(columns)):
        tall, wide = (_middle(k, n, size) for k, n, size in ((r, rows, len(picture)), (c, columns, picture.shape[1])))
        result[r, c] = picture[tall, wide].reshape(-1, 3).mean(axis=0)
    return result


def _middle(cell: int, count: int, size: int) -> slice:
    start = round((cell + 0.25) * size / count)
    return slice(start, max(start + 1, round((cell + 0.75) * size / count)))
