"""Style pictures made of pieces: stained glass, tesserae, triangles with outlines, tartan, sprites.

Each function draws one picture, (h w 3) uint8 sRGB, the same pixels each time.
"""

import cv2
import numpy as np
from scipy.spatial import Delaunay, KDTree

SIDE = 1024


def rgb(text: str) -> np.ndarray:
    """'e0a030' as float 0..255."""
    return np.array([int(text[k : k + 2], 16) for k in (0, 2, 4)], float)


def noise(side: int, cells: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth noise about 0 with standard deviation 1, (side side); `cells` waves along a side."""
    coarse = int(min(side, max(16, 8 * cells)))
    field = rng.normal(size=(coarse, coarse)).astype(np.float32)
    soft = cv2.GaussianBlur(field, (0, 0), coarse / cells / 3, borderType=cv2.BORDER_REFLECT)
    large = cv2.resize(soft, (side, side), interpolation=cv2.INTER_CUBIC)
    return (large - large.mean()) / large.std()


def eight(picture: np.ndarray) -> np.ndarray:
    """Float 0..255 as uint8."""
    return np.round(np.clip(picture, 0, 255)).astype(np.uint8)


def grid(side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """x and y (down) of pixels, 0..1."""
    line = (np.arange(side) + 0.5) / side
    return np.meshgrid(line, line)


def relaxed(count: int, rng: np.random.Generator, rounds: int = 12) -> np.ndarray:
    """Points in the unit square, evenly apart, (count 2): Lloyd's algorithm on a coarse grid."""
    points, (x, y) = rng.random((count, 2)), grid(256)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    for _ in range(rounds):
        owner = KDTree(points).query(pixels)[1]
        size = np.maximum(np.bincount(owner, minlength=count), 1)[:, None]
        sums = np.stack([np.bincount(owner, pixels[:, k], count) for k in (0, 1)], axis=1)
        points = np.where(np.bincount(owner, minlength=count)[:, None] > 0, sums / size, points)
    return points


def borders(label: np.ndarray) -> np.ndarray:
    """Where a pixel's right or lower neighbour has another label."""
    found = np.zeros(label.shape, bool)
    found[:, :-1] |= label[:, :-1] != label[:, 1:]
    found[:-1] |= label[:-1] != label[1:]
    return found


def hills(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Regions of a landscape: 0 sky, 1 sun, 2 and 3 its halos, 4 far hills, 5 near hills, 6 river, 7 meadow."""
    away = np.hypot(x - 0.64, y - 0.3)
    region = np.select([away < 0.1, away < 0.19, away < 0.3], [1, 2, 3], 0)
    region[y > 0.52 + 0.08 * np.sin(5.2 * x + 0.5) - 0.05 * np.sin(11 * x)] = 4
    region[y > 0.64 + 0.09 * np.sin(4 * x + 2.6)] = 5
    bank = 0.76 + 0.05 * np.sin(5 * x + 1)
    region[y > bank] = 6
    region[y > bank + 0.1 + 0.05 * x] = 7
    return region


def stained_glass() -> np.ndarray:
    """A sunrise over hills and a river in a leaded window: coloured panes with bubbles and streaks, black leads."""
    rng, (x, y) = np.random.default_rng(11), grid()
    region = hills(x, y)
    angle = np.arctan2(y - 0.3, x - 0.64)
    ray = np.floor((angle + np.pi) / (2 * np.pi) * 22).astype(int)
    points = relaxed(240, rng)
    cell = KDTree(points).query(np.stack([x.ravel(), y.ravel()], 1))[1].reshape(x.shape)
    # Panes of the halos are cut along the rays, those elsewhere as they come; the sun is one pane.
    inside = np.where(region == 1, 0, np.where((region == 2) | (region == 3), 300 + ray, cell))
    label = region * 1000 + inside
    palettes = {
        0: "1d3f9a 2a5fc0 1b2f78 3b82cf 5a3a9e", 1: "ffd84a",
        2: "ffb52e f79a1e ffc840", 3: "f0702a e2552e f58a3c d8402e",
        4: "6a3f8c 83509a 56347e", 5: "14713f 1f8a4c 0f5a38 3aa055", 6: "2fb4c8 1f95b5 58cad0 1b7fa5",
        7: "9fb52c b9c43a 7d9a24 c79a2a c0392b",
    }  # fmt: skip
    colour = np.zeros((SIDE, SIDE, 3))
    names, where = np.unique(label, return_inverse=True)
    panes = []
    for name in names:
        choices = palettes[int(name) // 1000].split()
        panes.append(rgb(choices[rng.integers(len(choices))]) * rng.uniform(0.86, 1.12))
    colour = np.array(panes)[where.reshape(label.shape)]
    streak = cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), 14, sigmaY=2.5)
    texture = 1 + 0.05 * noise(SIDE, 9, rng) + 0.05 * streak / streak.std() + 0.03 * noise(SIDE, 60, rng)
    edge = cv2.distanceTransform((~borders(label)).astype(np.uint8), cv2.DIST_L2, 5)
    lead = cv2.GaussianBlur((edge < 4.2).astype(np.float32), (0, 0), 0.8)[..., None]
    glow = 0.72 + 0.28 * np.clip(edge / 16, 0, 1)
    metal = rgb("17181c") + 26 * np.clip(1 - np.abs(edge - 1.0) / 1.6, 0, 1)[..., None]
    return eight(colour * (texture * glow)[..., None] * (1 - lead) + metal * lead)


def fish(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Signed distance, about, to two fish (negative inside), and which part: 0 sea, 1 body, 2 belly, 3 fin, 4 eye."""
    part = np.zeros(x.shape, int)
    for cx, cy, way in ((0.42, 0.34, 1), (0.56, 0.7, -1)):
        u, v = way * (x - cx) / 0.3, (y - cy - 0.03 * np.sin(9 * (x - cx))) / 0.13
        body = np.abs(v) < np.sqrt(np.clip(1 - u**2, 0, None)) * (1 - 0.25 * u)
        tail = (u < -0.82) & (u > -1.35) & (np.abs(v) < (-u - 0.72) * 1.7)
        fin = (np.abs(u + 0.1) < 0.35) & (v < -0.8) & (v > -1.45 + 0.9 * np.abs(u + 0.1))
        part[fin | tail] = 3
        part[body] = 1
        part[body & (v > 0.3)] = 2
        part[np.hypot(u - 0.62, (v + 0.15) * 0.45) < 0.075] = 4
    return part


def tesserae() -> np.ndarray:
    """Two fish in a sea of small square stones that follow their outlines: a mosaic floor (Hausner 2001)."""
    rng, small = np.random.default_rng(5), 512
    x, y = grid(small)
    part = fish(x, y)
    outside = cv2.distanceTransform((part == 0).astype(np.uint8), cv2.DIST_L2, 5)
    inside = cv2.distanceTransform((part != 0).astype(np.uint8), cv2.DIST_L2, 5)
    field = cv2.GaussianBlur((outside - inside).astype(np.float32), (0, 0), 5)
    turn = np.arctan2(cv2.Sobel(field, cv2.CV_32F, 0, 1), cv2.Sobel(field, cv2.CV_32F, 1, 0))
    points = relaxed(3600, rng, 3)
    for _ in range(10):
        owner = square_cells(points, turn, x, y)
        # Stones do not cross the outline: a cell's middle is that of its larger side.
        size = np.bincount(owner.ravel(), minlength=len(points))
        sums = np.stack([np.bincount(owner.ravel(), axis.ravel(), len(points)) for axis in (x, y)], axis=1)
        points = np.where(size[:, None] > 0, sums / np.maximum(size, 1)[:, None], points)
    big_x, big_y = grid()
    owner = square_cells(points, turn, big_x, big_y)
    at = np.clip((points * small).astype(int), 0, small - 1)
    parts, far = part[at[:, 1], at[:, 0]], outside[at[:, 1], at[:, 0]]
    sea = np.where(far[:, None] < 15, rgb("e9dfc6"), np.where(far[:, None] % 54 < 27, rgb("2f6f9f"), rgb("4fa3b8")))
    colours = np.stack([sea, *(np.broadcast_to(rgb(c), sea.shape) for c in ("c8452f", "efa94a", "7a2230", "16161a"))])
    stone = colours[parts, np.arange(len(points))] * rng.normal(1, 0.12, (len(points), 1)) + rng.normal(0, 9, sea.shape)
    edge = cv2.distanceTransform((~borders(owner)).astype(np.uint8), cv2.DIST_L2, 5)
    wobble = edge + 0.5 * noise(SIDE, 110, rng)
    tile = np.clip((wobble - 1.6) / 1.2, 0, 1)[..., None]
    face = stone[owner] * (1 + 0.05 * noise(SIDE, 160, rng) + 0.05 * noise(SIDE, 40, rng))[..., None]
    face *= (0.86 + 0.14 * np.clip((edge - 1.5) / 3.5, 0, 1))[..., None]
    grout = rgb("6e6455") * (1 + 0.08 * noise(SIDE, 200, rng))[..., None]
    return eight(face * tile + grout * (1 - tile))


def square_cells(points: np.ndarray, turn: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """For each pixel the point nearest in the larger of the distances along and across the direction at that point."""
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    near = KDTree(points).query(pixels, k=6)[1]
    at = np.clip((points * len(turn)).astype(int), 0, len(turn) - 1)
    angle = turn[at[:, 1], at[:, 0]]
    cosine, sine = np.cos(angle)[near], np.sin(angle)[near]
    dx, dy = pixels[:, None, 0] - points[near][..., 0], pixels[:, None, 1] - points[near][..., 1]
    far = np.maximum(np.abs(cosine * dx + sine * dy), np.abs(cosine * dy - sine * dx))
    return np.take_along_axis(near, far.argmin(axis=1)[:, None], axis=1)[:, 0].reshape(x.shape)


def low_poly() -> np.ndarray:
    """Mountains at dusk in flat triangles, each of one colour, with fine dark outlines."""
    rng, fine = np.random.default_rng(3), 2
    points = np.concatenate([relaxed(620, rng, 6) * 1.1 - 0.05, [[0, 0], [1, 0], [0, 1], [1, 1]]])
    triangles = Delaunay(points).simplices
    picture = np.zeros((SIDE * fine, SIDE * fine, 3), np.uint8)
    for corners in points[triangles]:
        x, y = corners.mean(axis=0)
        colour = dusk(x, y) * rng.uniform(0.86, 1.14)
        shape = np.round(corners * SIDE * fine).astype(np.int32)
        cv2.fillConvexPoly(picture, shape, [int(v) for v in np.clip(colour, 0, 255)])
    for corners in points[triangles]:
        shape = np.round(corners * SIDE * fine).astype(np.int32)
        cv2.polylines(picture, [shape], True, (34, 28, 48), 5, cv2.LINE_AA)
    return cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def dusk(x: float, y: float) -> np.ndarray:
    """The colour of the low-poly landscape at a place."""
    peak = 0.34 + 0.9 * min(abs(x - 0.28), 0.9 * abs(x - 0.76) + 0.08)
    if y > 0.86 - 0.06 * np.sin(7 * x):
        return rgb("24635a") if x < 0.5 else rgb("2f7a58")
    if y > 0.7 + 0.05 * np.sin(6 * x + 1):
        return rgb("3f9d8a") if np.sin(40 * x + 20 * y) > 0 else rgb("5cc1a4")
    if y > peak:
        if y < peak + 0.09:
            return rgb("f6efe6")
        return rgb("5b4b8a") if (x < 0.28 or 0.52 < x < 0.76) else rgb("8a5fa0")
    if np.hypot(x - 0.55, y - 0.2) < 0.09:
        return rgb("fff0a8")
    share = np.clip(y / 0.6, 0, 1)
    return rgb("ee5f6b") * (1 - share) + rgb("ffc27a") * share


def tartan() -> np.ndarray:
    """A woollen tartan: a two-by-two twill of coloured threads, five pixels wide."""
    rng, thread = np.random.default_rng(8), 5
    count = SIDE // thread + 1
    half = [("12233f", 20), ("8e1b22", 14), ("12233f", 4), ("d9b23c", 3), ("12233f", 4), ("1d5a3c", 18), ("efe9da", 2)]
    sett = np.concatenate([np.repeat(rgb(c)[None], n, axis=0) for c, n in [*half, *half[-2:0:-1]]])
    threads = sett[np.arange(count) % len(sett)]
    warp, weft = (threads * rng.normal(1, 0.05, (count, 1)) for _ in range(2))
    down, across = np.mgrid[:SIDE, :SIDE]
    bend = 1.2 * noise(SIDE, 4, rng)
    column, row = (across + bend) / thread % count, (down + 0.8 * noise(SIDE, 4, rng)) / thread % count
    i, j = column.astype(int) % count, row.astype(int) % count
    over = (i + j) % 4 < 2
    along, side = np.where(over, row, column) % 1, np.where(over, column, row) % 1
    phase = ((i + j) % 2 + along) / 2
    shade = (0.66 + 0.34 * np.sin(np.pi * side)) * (0.84 + 0.16 * np.sin(np.pi * phase))
    fibre = cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), 0.7)
    shade *= 1 + 0.09 * fibre / fibre.std() + 0.02 * noise(SIDE, 30, rng)
    return eight(np.where(over[..., None], warp[i], weft[j]) * shade[..., None] * 1.08)


# Left halves of eight sprites, 16 rows each, mirrored; letters index PALETTE.
SPRITES = """
......kk ....kkkk ...kgggg ..kgGGgg ..kgGggg .kggGggw .kgggggk .kgggggk
.kgrgggg .kggggkk ..kggggg ..kgGggg ...kgggg ...kkgkg ..kkk.kk ........
........ ....kkkk ...krrrr ..krrRRr .krrwwrr .krwwwrr krrwwrrr krrrrrrr
krrrrwwr kkrrrwwr .kkkkkkk ...ksskk ...kssss ...kSsss ....kkkk ........
........ ........ ...kkkkk ..kBbbbb ..kBbbbb ..kkkkkk ..kyyykk ..kbbbkk
..kBbbky ..kBbbky ..kBbbbk ..kBbbbb ..kBBBBB ..kkkkkk ........ ........
........ ........ ..kkk... .krrrk.. krrwrrk. krwrrrrk krwrrrrr krrrrrrr
.krrrrrr ..krrrrr ...krrrr ....krrr .....krr ......kr .......k ........
.......k ......kG .....kGG ....kGgg .....kGG ....kGGg ...kGggg ....kGGg
...kGGgg ..kGgggg .kkkkkkk ......kB ......kB ......kb ......kk ........
.....kkk ....kBBB ...kBbbb ...kBsss ...kssks ...kssks ...kssss ....kssr
..kkkkss .kuuUkkk .kuuUuUU .ksskuuU .kkkkuuu ...kBBkk ...kBBk. ...kkkk.
........ ......kk .....kyy ....kyYY ...kyYyy ...kyYyk ...kyYyk ...kyYyk
...kyYyk ...kyYyy ....kyYY .....kyy ......kk ........ ........ ........
........ .kk..... kwwk.... kwwwkkkk .kkwwwww ..kwkkww ..kwkkww ..kwwwwk
...kwwww ....kwkw ....kkkk ........ .kk...kk kwwkkkww .kwwwwkk ..kkkk..
"""
PALETTE = {
    "k": "1a1c2c", "w": "f4f4f4", "g": "38b764", "G": "257179", "r": "e43b44", "R": "ff9a8a", "s": "eab98a",
    "S": "c28a5c", "b": "b86f50", "B": "743f39", "y": "feae34", "Y": "fee761", "u": "3b5dc9", "U": "41a6f6",
}  # fmt: skip


def sprites() -> np.ndarray:
    """A sheet of 8 by 8 tiles of 16 pixels, each 8 pixels of the picture wide: figures before walls, water, grass."""
    rng, tiles = np.random.default_rng(21), []
    words = SPRITES.split()
    figures = [words[k : k + 16] for k in range(0, len(words), 16)]
    makers = [grass, bricks, water, planks]
    for k in range(64):
        row, column = divmod(k, 8)
        tile = makers[(column // 2 + row) % 4](rng)
        if (row + column) % 2 == 0 or rng.random() < 0.3:
            tile = stamped(tile, figures[rng.integers(len(figures))])
        tiles.append(tile)
    rows = [np.concatenate(tiles[8 * r : 8 * r + 8], axis=1) for r in range(8)]
    return eight(np.repeat(np.repeat(np.concatenate(rows), 8, axis=0), 8, axis=1))


def stamped(tile: np.ndarray, lines: list[str]) -> np.ndarray:
    """A tile with a sprite on it, whose left half is given."""
    result = tile.copy()
    for y, line in enumerate(lines):
        for x, letter in enumerate(line + line[::-1]):
            if letter in PALETTE:
                result[y, x] = rgb(PALETTE[letter])
    return result


def grass(rng: np.random.Generator) -> np.ndarray:
    """A tile of grass with blades and flowers."""
    tile = np.broadcast_to(rgb("5fbf4a"), (16, 16, 3)).copy()
    for x, y in rng.integers(1, 15, (14, 2)):
        tile[y, x] = tile[y - 1, x] = rgb("3e8f3d")
    for x, y in rng.integers(2, 14, (2, 2)):
        tile[y, x - 1 : x + 2] = tile[y - 1 : y + 2, x] = rgb(("f4f4f4", "feae34", "f77fb0")[rng.integers(3)])
    return tile


def bricks(rng: np.random.Generator) -> np.ndarray:
    """A tile of a brick wall."""
    tile = np.broadcast_to(rgb("5d3a3a"), (16, 16, 3)).copy()
    for row in range(4):
        for start in range(-4 * (row % 2), 16, 8):
            colour = rgb(("b5573f", "c4674a", "a34a3a")[rng.integers(3)])
            left = max(start, 0)
            tile[4 * row : 4 * row + 3, left : max(start + 7, 0)] = colour
            tile[4 * row, left : max(start + 7, 0)] = colour + 28
    return tile


def water(rng: np.random.Generator) -> np.ndarray:
    """A tile of water with waves."""
    tile = np.broadcast_to(rgb("3b7dd8"), (16, 16, 3)).copy()
    for y in range(2, 16, 4):
        x = int(rng.integers(16))
        for k, rise in enumerate((0, 0, -1, -1, 0, 0)):
            tile[y + rise, (x + k) % 16] = rgb("9fd6f7")
            tile[y + rise + 1, (x + k) % 16] = rgb("2a5cb0")
    return tile


def planks(rng: np.random.Generator) -> np.ndarray:
    """A tile of wooden boards."""
    tile = np.broadcast_to(rgb("c08a52"), (16, 16, 3)).copy()
    tile[::4] = rgb("7d5233")
    for board in range(4):
        x = int(rng.integers(16))
        tile[4 * board + 1 : 4 * board + 4, x] = rgb("7d5233")
        tile[4 * board + 2, (x + 4) % 16 : (x + 4) % 16 + 5] = rgb("a87442")
    return tile
