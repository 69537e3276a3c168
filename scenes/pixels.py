"""The demo's pixel art: a castle on a hill by the water, drawn cell by cell with one palette.

Every cell is one colour of PALETTE and is shown as a square of SCALE pixels. Skies and far hills are ordered dither
(Bayer 4 x 4) between neighbours of a ramp; trees, bricks, flowers and clouds are sprites written as text.
"""

import numpy as np

CELLS = (104, 128)  # height, width
SCALE = 8
PALETTE = {
    ".": "#000000", "k": "#1a1c2c", "n": "#29366f", "b": "#3b5dc9", "s": "#41a6f6", "c": "#73eff7", "w": "#f4f4f4",
    "l": "#c3ccd6", "g": "#94a0b8", "d": "#566c86", "x": "#333c57", "t": "#257179", "e": "#38b764", "y": "#a7f070",
    "o": "#ef7d57", "a": "#ffcd75", "r": "#b13e53", "p": "#5d275d", "m": "#8a4836", "u": "#c47a46", "h": "#f6a98c",
}  # fmt: skip
NAMES = "".join(PALETTE)
BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16 + 1 / 32

PINE = """
.....k......
....kek.....
....key.....
...kteek....
...keeyk....
..kteeeek...
...kteek....
..kteeyek...
.kttteeeyk..
..kkteeek...
..kteeeyek..
.ktteeeeeyk.
ktttteeeeeek
.kkktteekkk.
....kmuk....
....kmuk....
"""
TREE = """
.....kkkkk......
...kkeeyyykk....
..keeeyyeyyyk...
.kteeeeyyeeyek..
.kteeyeeeeyyek..
ktteeeeyeeeeyek.
kteeyeeeeeyeeek.
ktteeeteeeeeetk.
.kttteeeteeetk..
..kttkteettkk...
...kkkkmukk.....
......kmuk......
......kmuk......
.....kmmuuk.....
"""
CLOUD = """
.......wwww.........
.....wwwwwwww.......
..wwwwwwwwwwwwww....
.wwwwwwwwwwwwwwwww..
wwwwwwwwwwlwwwwwwwww
llwwwwlllwwwlllwwlll
.lllllllllllllllll..
"""
FLOWER = ("""
.r.
rar
.r.
.e.
""", """
.w.
waw
.w.
.e.
""", """
.a.
aoa
.a.
.e.
""")  # fmt: skip
MUSHROOM = """
...kkkk...
.kkrrrrkk.
krrwwrrrrk
krrwwrrwrk
krrrrrrwrk
kkhhhhhhkk
..kawwak..
..kawwak..
...kkkk...
"""
CRATE = """
kkkkkkkkkk
kuuuuuuuuk
kummmmmmuk
kumuuuumuk
kumummumuk
kumummumuk
kumuuuumuk
kummmmmmuk
kuuuuuuuuk
kkkkkkkkkk
"""
DOOR = """
....kkkk....
..kkmuumkk..
.kmuumuumuk.
kmmuumuummuk
kmmuumuummuk
kmmuumuummuk
kmmuumuaamuk
kmmuumuaamuk
kmmuumuummuk
kmmuumuummuk
kmmuumuummuk
kmmuumuummuk
"""
WINDOW = """
.kkkk.
kaaaak
kaokak
kkkkkk
kaakak
kaakak
kookok
kkkkkk
"""
BOAT = """
........k........
........kww......
........kwww.....
........kwwww....
.......kkrrrrr...
......wkkrrrrrr..
.....wwkkwwwwwww.
........k........
kkkkkkkkkkkkkkkkk
kuuuuuuuuuuuuuuuk
.kmummmmummmmumk.
..kkkkkkkkkkkkk..
"""
BRICK = """
lggggggk
ggggggdk
ggggggdk
kkkkkkkk
gggklggg
ggdkgggg
ggdkgggg
kkkkkkkk
"""
SOIL = """
mmmmmmmmmmmm
mmuummmmmmmm
mmmmmmmpmmmm
mmmmmmppmmmm
mmmmmmmmmmum
mpmmmmmmmmmm
mmmmumpmmmmm
mmmmmmmmmmmm
umppmmmmuumm
mmmmmmmmmmmm
"""
VAULT = """
kxxxxxxxkxxx
kxddddxxkxdd
kxddxxxxkxdx
kxxxxxnnkxxn
kkkkkkkkkkkk
xxxkxxxxxxxk
ddxkxddddxxk
xxxkxddxxxxk
xxnkxxxxxnnk
kkkkkkkkkkkk
"""
GEM = """
..kkkkk..
.kwcssbk.
kwccsssbk
kccwssbbk
.kcssbbk.
..kcsbk..
...ksk...
....k....
"""
CHEST = """
.kkkkkkkk.
kuummmmmmk
kaaaaaaaak
kummkkmmmk
kkkkaakkkk
kummaammmk
kummmmmmmk
kaaaaaaaak
kkkkkkkkkk
"""


def cells(text: str) -> np.ndarray:
    """A sprite as indices into NAMES (h, w); '.' is see-through (0)."""
    rows = text.strip("\n").split("\n")
    assert len({len(row) for row in rows}) == 1, f"rows of unequal length in the sprite\n{text}"
    return np.array([[NAMES.index(c) for c in row] for row in rows])


def stamp(board: np.ndarray, text: str, row: int, column: int, flip: bool = False) -> None:
    """Draw a sprite with its lower left cell at (row, column)."""
    sprite = cells(text)[:, :: -1 if flip else 1]
    top = row - len(sprite) + 1
    for i, line in enumerate(sprite):
        for j, value in enumerate(line):
            if value and 0 <= top + i < len(board) and 0 <= column + j < board.shape[1]:
                board[top + i, column + j] = value


def tiled(board: np.ndarray, mask: np.ndarray, text: str) -> None:
    """Fill `mask` with a repeating tile."""
    tile = cells(text)
    y, x = np.nonzero(mask)
    board[y, x] = tile[y % len(tile), x % tile.shape[1]]


def dithered(board: np.ndarray, mask: np.ndarray, value: np.ndarray, ramp: str) -> None:
    """Fill `mask` with colours of `ramp` at `value` 0..1, neighbours mixed by ordered dither."""
    y, x = np.nonzero(mask)
    place = np.clip(value[y, x], 0, 1) * (len(ramp) - 1)
    # Steps are kept flat, and mixed only about half way between two colours.
    sharp = np.floor(place) + np.clip((place % 1 - 0.5) * 2.2 + 0.5, 0, 1)
    level = np.floor(sharp + BAYER[y % 4, x % 4] * 0.999).astype(int).clip(0, len(ramp) - 1)
    board[y, x] = np.array([NAMES.index(c) for c in ramp])[level]


def skyline(rng: np.random.Generator, width: int, level: float, height: float, pace: float) -> np.ndarray:
    """Rows (w,) of a hill's crest."""
    x = np.arange(width)
    waves = sum(np.sin(x * pace * k + rng.uniform(0, 6.28)) / k for k in (1, 2, 3.3))
    return np.round(level - height * waves).astype(int)


def castle(board: np.ndarray, base: int, left: int) -> None:
    """Two towers and a wall between them, with battlements, a gate, windows and flags."""
    y, x = np.mgrid[0 : board.shape[0], 0 : board.shape[1]]
    for at, wide, top in ((left + 12, 24, base - 21), (left, 14, base - 34), (left + 34, 16, base - 42)):
        body = (x >= at) & (x < at + wide) & (y > top) & (y <= base)
        tiled(board, body, BRICK)
        board[body & (x >= at + wide - 3)] = np.where(
            board[body & (x >= at + wide - 3)] == NAMES.index("k"), NAMES.index("k"), NAMES.index("d")
        )
        head = (x >= at - 1) & (x < at + wide + 1) & (y > top - 5) & (y <= top)
        head &= (y > top - 3) | ((x - at + 1) % 5 < 3)
        tiled(board, head, "gggl\nkkkk\nggld\ngggd\n")
        board[(x >= at - 1) & (x < at + wide + 1) & (y == top)] = NAMES.index("k")
        board[body & ((x == at) | (x == at + wide - 1))] = NAMES.index("k")
    for at, wide, top in ((left, 14, base - 38), (left + 34, 16, base - 46)):
        for k in range(10):
            half = (wide / 2 - 1) * (1 - k / 10)
            row = top - k
            span = np.arange(int(at + wide / 2 - half), int(np.ceil(at + wide / 2 + half)))
            board[row, span] = [NAMES.index("rrro"[min(3, int(4 * t))]) for t in np.linspace(1, 0, len(span))]
            board[row, [span[0] - 1, span[-1] + 1]] = NAMES.index("k")
        board[top - 14 : top - 9, at + wide // 2] = NAMES.index("k")
        board[top - 14 : top - 11, at + wide // 2 + 1 : at + wide // 2 + 6] = NAMES.index("a")
    stamp(board, DOOR, base, left + 18)
    for row, column in ((base - 20, left + 4), (base - 6, left + 4), (base - 26, left + 39), (base - 9, left + 39)):
        stamp(board, WINDOW, row, column)


def picture(seed: int) -> np.ndarray:
    """The cells (h, w), indices into NAMES."""
    rng = np.random.default_rng(seed)
    h, w = CELLS
    board = np.zeros(CELLS, int)
    y, x = np.mgrid[0:h, 0:w]
    everywhere = np.ones(CELLS, bool)
    dithered(board, everywhere, 1 - y / 66, "aahcssbb")
    far = np.hypot(x - 100, y - 20)
    board[far < 12.5] = NAMES.index("a")
    board[far < 10] = NAMES.index("w")
    for row, column, flip in ((20, 8, False), (12, 48, True), (34, 80, False), (38, 24, True)):
        stamp(board, CLOUD, row, column, flip)
    crest = skyline(rng, w, 52, 6, 0.075)
    dithered(board, y > crest, (y - crest) / 16, "bnn")
    board[(y > crest) & (y <= crest + 2) & (x % 5 < 3) & (crest < 50)] = NAMES.index("w")
    crest = skyline(rng, w, 62, 3, 0.11)
    dithered(board, y > crest, (y - crest) / 14, "ett")
    for column in range(66, 126, 9):
        stamp(board, PINE, int(crest[min(column + 6, w - 1)]) + 4 + int(rng.integers(0, 3)), column)
    shore = 78
    water = y >= shore
    dithered(board, water, (y - shore) / 14, "csbb")
    for _ in range(46):
        row, column = int(rng.integers(shore + 1, 97)), int(rng.integers(0, w - 9))
        length = int(rng.integers(3, 9))
        board[row, column : column + length] = NAMES.index("wccs"[int(rng.integers(0, 4))])
    board[shore, :] = NAMES.index("w")
    stamp(board, BOAT, 91, 86)
    hill = np.where(x < 70, 72 - 4 * np.sin(x / 22), 72 + (x - 70).clip(0) ** 1.5 / 3)
    bank = (y > hill) & (x < 88) & (y < 104)
    bank &= x < 80 - (y - 80).clip(0) * 0.4 + 2 * ((y // 3) % 2)
    tiled(board, bank, SOIL)
    depth = y - hill
    vault = bank & (y > 91 + 2 * np.sin(x / 9)) & (x < 70)
    tiled(board, vault, VAULT)
    rim = vault & ~np.roll(vault, 1, 0)
    board[rim | np.roll(rim, -1, 0)] = NAMES.index("k")
    dithered(board, bank & (depth < 6), depth / 6, "yee")
    board[bank & (depth >= 5) & (depth < 6 + ((x * 7) % 5) // 2)] = NAMES.index("t")
    stones = rng.integers(0, [[10], [76]], (2, 12))
    for row, column in zip(stones[0] + 80, stones[1], strict=True):
        if row + 1 < h and bank[row, column] and bank[row + 1, column + 1]:
            board[row, column : column + 3] = [NAMES.index(c) for c in "lgd"]
            board[row + 1, column : column + 3] = [NAMES.index(c) for c in "gdx"]
    castle(board, 71, 13)
    for column, sprite in ((-3, TREE),):
        stamp(board, sprite, int(hill[0, max(column + 6, 0)]) + 2, column)
    ground = np.minimum(h - 1, hill[0].astype(int))
    for k, column in enumerate(range(3, 74, 6)):
        stamp(board, FLOWER[k % 3], int(ground[column]) + 3, column + int(rng.integers(0, 3)))
    stamp(board, CRATE, int(ground[69]) + 3, 66)
    for column, sprite in ((8, GEM), (30, CHEST), (50, GEM)):
        stamp(board, sprite, 101, column)
    near = np.where(x > 74, 101 - 5 * np.sin((x - 74) / 18), 200)
    dithered(board, y > near, (y - near) / 8, "yet")
    for column, sprite in ((114, MUSHROOM), (108, FLOWER[0]), (89, FLOWER[2]), (99, FLOWER[1])):
        stamp(board, sprite, int(near[0, column]) + 2, column)
    return board


def painting(scale: int = SCALE, seed: int = 16) -> np.ndarray:
    """The finished picture, sRGB uint8 (h, w, 3), every cell `scale` pixels along a side."""
    colours = np.array([[int(code[i : i + 2], 16) for i in (1, 3, 5)] for code in PALETTE.values()], np.uint8)
    return np.kron(colours[picture(seed)], np.ones((scale, scale, 1), np.uint8))
