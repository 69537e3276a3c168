"""Detection of a style picture's pixel-art grid and of its border (paper, canvas, frame)."""

import numpy as np
from jaxtyping import Float

from mistyle.stylization.surface.exemplar import exemplar as style

LARGEST_GRID = 32  # picture pixels along an art pixel
STEP = 0.04  # least difference of neighbouring pixels (Lab / 100) at a step
ON_GRID = 0.85  # least share of the steps' squares on the lines of a grid
HARD = 0.35  # least share of one-pixel-wide steps, if every picture pixel is an art pixel
FEW_COLOURS = 256
COVERED = 0.97  # least share of pixels in the most common colours
EDGE = 0.01  # of the long side: typical visible paper, canvas or frame in a photograph of a painting or print
DEEPEST = 0.2  # of the height or width: the widest border
ALIKE = 0.06  # Lab / 100
EVEN = 0.9  # least share of the border's colour in one of its lines


def pixel_grid(rgb: Float[np.ndarray, "h w 3"]) -> tuple[int, int]:
    """Sides (down, across) of one art pixel in picture pixels; (0, 0) where the picture is not pixel art."""
    lab = style.lab_from_srgb(rgb)
    sizes = [grid_along(np.abs(np.diff(lab[..., 0], axis=axis)), axis) for axis in (0, 1)]
    if min(sizes) > 1:
        return sizes[0], sizes[1]
    return (1, 1) if hard_pixels(lab) else (0, 0)


def grid_along(step: Float[np.ndarray, "h w"], axis: int) -> int:
    """The largest period with nearly all steps along an axis on the lines of one grid; 0 or 1 for none."""
    # Squares: JPEG ringing beside an edge is small.
    strength = np.where(step > STEP, step**2, 0).sum(axis=1 - axis)
    total = float(strength.sum())
    if total == 0:
        return 0
    for period in range(min(LARGEST_GRID, len(strength) // 4), 1, -1):
        lines = np.bincount((np.arange(len(strength)) + 1) % period, strength, period)
        # A few lines can lie on any grid: every other line of it must have steps too.
        first = int(lines.argmax())
        used = strength[(first - 1) % period :: period] > 0
        if lines.max() >= ON_GRID * total and used.mean() > 0.5:
            return period
    return 1


def hard_pixels(lab: Float[np.ndarray, "h w 3"]) -> bool:
    """Whether the picture has few colours and one-pixel-wide edges: pixel art at its own size."""
    cell = np.rint(lab.reshape(-1, 3) * 50).astype(np.int64) + 128
    colours = np.sort(np.unique((cell[:, 0] * 256 + cell[:, 1]) * 256 + cell[:, 2], return_counts=True)[1])[::-1]
    if colours[:FEW_COLOURS].sum() < COVERED * len(cell):
        return False
    hard, all_steps = 0, 0
    for axis in (0, 1):
        d = np.moveaxis(np.diff(lab[..., 0], axis=axis), axis, 0)
        before, centre, after = d[:-2], d[1:-1], d[2:]
        big = np.abs(centre) > 0.1
        ramp = (before * centre > 0.15 * centre**2) | (after * centre > 0.15 * centre**2)
        hard, all_steps = hard + int((big & ~ramp).sum()), all_steps + int(big.sum())
    return all_steps > 0 and hard >= HARD * all_steps


def border(rgb: Float[np.ndarray, "h w 3"], exact: bool) -> style.Crop:
    """Crop at the top, left, bottom and right, in shares of the height or width.

    Uniform margins of one colour on two sides or more; without them EDGE, for the edges of paper and canvas, or 0 for
    pixel art (`exact`).
    """
    long = max(rgb.shape[:2])
    size = style.long_side(rgb.shape, min(long, 512))
    lab = style.lab_from_srgb(style.resized(rgb, size))
    sides = [lab, lab.swapaxes(0, 1), lab[::-1], lab[:, ::-1].swapaxes(0, 1)]
    margins = [margin(side) for side in sides]
    colours = [np.median(side[:2].reshape(-1, 3), axis=0) for side in sides]
    result = []
    for k, (share, colour) in enumerate(zip(margins, colours, strict=True)):
        alike = sum(margins[j] > 0 and np.abs(colours[j] - colour).sum() < ALIKE for j in range(4) if j != k)
        least = 0.0 if exact else EDGE * long / rgb.shape[k % 2]
        result.append(max(share + 0.4 * least, least) if share > 0 and alike else least)
    return result[0], result[1], result[2], result[3]


def margin(lab: Float[np.ndarray, "h w 3"]) -> float:
    """Depth of the margin of the first rows' colour, in shares of the height; 0 for none."""
    colour = np.median(lab[:2].reshape(-1, 3), axis=0)
    alike = (np.abs(lab - colour).sum(axis=2) < ALIKE).mean(axis=1)
    uneven = np.flatnonzero(alike < EVEN)
    depth = int(uneven[0]) if len(uneven) else len(lab)
    return depth / len(lab) if 1 <= depth <= DEEPEST * len(lab) else 0.0
