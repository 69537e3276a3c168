"""Sheets for blind viewers, and their key: `benchmarks.look sheets`.

A sheet shows the painting in the middle and two candidates, A above and B below it, each lit by two environments from
two sides. It has no names, and its own name says nothing. An `odd` sheet shows four pieces, three of the painting and
one of the asset. The key says what is what, and the sheet's sha256.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.look.light import lit, piece_of_asset
from benchmarks.look.paint import Piece, about, sha256

WIDTH, BAND = 1488, 26  # pixels of a sheet, and of a line with a letter
PAINTING = 420  # most rows of the painting
WHITE, GAP = 255, 8
CUT, LONG = 44, 512  # side of a piece, of a painting so long
ENLARGED, SOFTEN = 340, 0.6  # pixels of a piece on the sheet; blur that hides the last difference in sharpness


def name_of(*what: str) -> str:
    """A sheet's name: always the same for the same sheet, and silent about it."""
    return hashlib.sha256("\n".join(what).encode()).hexdigest()[:8]


def flipped(name: str, seed: int) -> bool:
    """Whether a sheet's candidates change places."""
    return bool(np.random.default_rng([seed, int(name, 16)]).integers(2))


def read(path: Path) -> np.ndarray:
    """A picture, (h w 3) uint8 RGB; transparent parts lie on white."""
    from mistyle.io.read import read_picture

    picture = read_picture(path)
    alpha = 1.0 if picture.alpha is None else picture.alpha[..., None]
    return np.round(255 * (picture.rgb * alpha + 1 - alpha)).astype(np.uint8)


def resized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """To (rows, columns): averaged where smaller, nearest pixels where much larger (pixel art stays square)."""
    smaller = size[0] < picture.shape[0]
    return cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def lettered(letter: str, width: int) -> np.ndarray:
    """A white line with a letter in its middle."""
    line = np.full((BAND, width, 3), WHITE, np.uint8)
    cv2.putText(line, letter, (width // 2 - 8, BAND - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 0, 0), 2, cv2.LINE_AA)
    return line


def fitted(picture: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """A picture in the middle of a white field of that size, as large as it goes."""
    factor = min(rows / picture.shape[0], columns / picture.shape[1])
    height, width = (max(1, round(side * factor)) for side in picture.shape[:2])
    field = np.full((rows, columns, 3), WHITE, np.uint8)
    top, left = (rows - height) // 2, (columns - width) // 2
    field[top : top + height, left : left + width] = resized(picture, (height, width))
    return field


def choice(painting: np.ndarray, above: Sequence[np.ndarray], below: Sequence[np.ndarray]) -> np.ndarray:
    """The sheet of a choice: four pictures of A, the painting, four pictures of B."""
    rows = [np.concatenate(pictures, axis=1) for pictures in (above, below)]
    width = rows[0].shape[1]
    space = np.full((GAP, width, 3), WHITE, np.uint8)
    middle = [space, fitted(painting, PAINTING, width), space]
    return np.concatenate([lettered("A", width), rows[0], *middle, rows[1], lettered("B", width)])


def softened(piece: np.ndarray) -> np.ndarray:
    """A piece of CUT pixels (0..1), a little blurred and enlarged, uint8."""
    soft = cv2.GaussianBlur(np.ascontiguousarray(piece, np.float32), (0, 0), SOFTEN)
    large = cv2.resize(soft, (ENLARGED, ENLARGED), interpolation=cv2.INTER_CUBIC)
    return np.round(255 * np.clip(large, 0, 1)).astype(np.uint8)


def cuts(painting: np.ndarray, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Pieces of CUT pixels, anywhere in the painting (uint8) at LONG pixels; they overlap by less than half."""
    factor = LONG / max(painting.shape[:2])
    size = [max(CUT, round(side * factor)) for side in painting.shape[:2]]
    small = resized(painting, (size[0], size[1])) / np.float32(255)
    places: list[np.ndarray] = []
    for _ in range(1000):
        place = np.array([rng.integers(side - CUT + 1) for side in size])
        if all(np.abs(place - other).max() >= CUT / 2 for other in places) or len(places) + 1000 < count:
            places.append(place)
        if len(places) == count:
            break
    return [small[y : y + CUT, x : x + CUT] for y, x in places]


def odd(painting: np.ndarray, glb: Path, seed: int) -> tuple[np.ndarray, str]:
    """The sheet of the odd one out, and its letter."""
    rng = np.random.default_rng(seed)
    pixel = about(glb)["pixel"]
    if pixel is None:
        raise SystemExit(f"{glb}: its run did not say how large the painting lies on the surface")
    kept = min(max(painting.shape[:2]), 2048)  # the stylizer keeps no more
    imitation = piece_of_asset(glb, pixel * kept / LONG, CUT, seed)
    pieces = [softened(piece) for piece in cuts(painting, 3, rng)]
    place = int(rng.integers(4))
    pieces.insert(place, softened(imitation))
    columns = [np.concatenate([lettered("ABCD"[k], ENLARGED), piece]) for k, piece in enumerate(pieces)]
    space = np.full((len(columns[0]), GAP, 3), WHITE, np.uint8)
    spaced = [part for column in columns for part in (column, space)][:-1]
    return np.concatenate(spaced, axis=1), "ABCD"[place]


def write(path: Path, picture: np.ndarray) -> str:
    """A PNG of an RGB picture; returns its sha256."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return sha256(path)


def build_choice(
    piece: Piece, kind: str, ours: Path, theirs: Path, out: Path, seed: int, test: str = "choice"
) -> dict[str, Any]:
    """Write the sheet of a choice; returns its line of the key. `test`: "choice", "ebsynth" or
    "finish"."""
    name = name_of(test, piece.style, piece.mesh, piece.preset, str(seed))
    pictures = {"head": lit(ours), "other": lit(theirs)}
    order = ("other", "head") if flipped(name, seed) else ("head", "other")
    sheet = choice(read(piece.style_file), *(pictures[who] for who in order))
    known = {"test": test, "style": piece.style, "kind": kind, "mesh": piece.mesh, "preset": piece.preset}
    return known | {"name": name, "A": order[0], "B": order[1], "sha256": write(out / f"{name}.png", sheet)}


def build_odd(piece: Piece, kind: str, ours: Path, out: Path, seed: int) -> dict[str, Any]:
    """Write the sheet of the odd one out; returns its line of the key."""
    name = name_of("odd", piece.style, piece.mesh, piece.preset, str(seed))
    sheet, letter = odd(read(piece.style_file), ours, seed + int(name, 16) % 2**31)
    known = {"test": "odd", "style": piece.style, "kind": kind, "mesh": piece.mesh, "preset": piece.preset}
    return known | {"name": name, "odd": letter, "sha256": write(out / f"{name}.png", sheet)}


def write_key(path: Path, lines: Sequence[Mapping[str, Any]], **made_of: Any) -> None:
    """The key: what the sheets were made of, and one line a sheet, by name."""
    sheets = {line["name"]: {k: v for k, v in line.items() if k != "name"} for line in lines}
    text = json.dumps({**made_of, "sheets": dict(sorted(sheets.items()))}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")
