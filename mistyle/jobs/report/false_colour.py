"""False colours for error maps, exposures and signed differences."""

import numpy as np
from jaxtyping import Float, UInt8

# Ten stops of a map from dark violet to yellow (magma's look, in a few linear pieces), as 8-bit red, green, blue.
HEAT = ((0, 0, 4), (28, 16, 68), (79, 18, 123), (129, 37, 129), (181, 54, 122), (229, 80, 100), (251, 135, 97))
HEAT += ((254, 194, 135), (252, 253, 191))
RAINBOW = ((48, 18, 59), (65, 69, 171), (70, 117, 237), (57, 162, 252), (27, 207, 212), (36, 236, 166), (97, 252, 108))
RAINBOW += ((164, 252, 59), (209, 232, 52), (243, 198, 58), (254, 155, 45), (243, 99, 21), (217, 56, 6), (122, 4, 3))
DIVERGING = (
    (5, 48, 97),
    (67, 147, 195),
    (209, 229, 240),
    (247, 247, 247),
    (253, 219, 199),
    (214, 96, 77),
    (103, 0, 31),
)


def heat(error: Float[np.ndarray, "h w"], most: float = 1.0) -> UInt8[np.ndarray, "h w 3"]:
    """An error of 0..`most` from black to yellow."""
    return mapped(error / np.float32(most), HEAT)


def mapped(values: np.ndarray, colours: tuple[tuple[int, int, int], ...]) -> UInt8[np.ndarray, "h w 3"]:
    """Values of 0..1 as interpolated colours of a list."""
    table = np.array(colours, np.float64)
    steps = np.linspace(0, len(table) - 1, 256)
    lookup = np.stack([np.interp(steps, np.arange(len(table)), table[:, c]) for c in range(3)], axis=1)
    index = np.clip(np.nan_to_num(values) * 255 + 0.5, 0, 255).astype(np.uint8)
    return np.round(lookup).astype(np.uint8)[index]
