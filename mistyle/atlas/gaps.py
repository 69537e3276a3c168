"""Gap filling: the nearest texel of the same island, else the nearest on the surface."""

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.atlas.texels import threaded
from mistyle.core.image import nearest
from mistyle.core.maps import Texels

NEIGHBOURS_3D = 1_000_000  # most known texels in a search across islands


def fill_in_place(albedo: Float[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], texels: Texels) -> None:
    """Give every covered unknown texel the value of the nearest known one of its island, or, if the island has none, of
    the nearest on the surface. Nothing is filled if no texel is known.
    """
    hole = texels.covered & ~known
    known = known & texels.covered
    if not hole.any() or not known.any():
        return
    boxes = island_boxes(texels.island, np.unique(texels.island[hole]))
    lost: list[np.ndarray] = []

    def work(k: int) -> None:
        island, box = boxes[k]
        own = texels.island[box] == island
        missing, offered = own & hole[box], own & known[box]
        if offered.any():
            index, part = nearest(offered)[0][missing], albedo[box]
            part[missing] = part[np.unravel_index(index, own.shape)]
        else:
            rows, columns = np.nonzero(missing)
            lost.append((rows + box[0].start) * hole.shape[1] + columns + box[1].start)

    threaded(work, len(boxes))
    if lost:
        missing = np.concatenate(lost)
        source = nearest_in_space(known.reshape(-1), texels.position.reshape(-1, 3), missing)
        flat = albedo.reshape(-1, 3)
        flat[missing] = flat[source]


def nearest_in_space(
    known: Bool[np.ndarray, " t"], position: Float[np.ndarray, "t 3"], targets: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """The known texel nearest in space; with more than NEIGHBOURS_3D of them, among every k-th."""
    from scipy.spatial import KDTree

    seeds = np.flatnonzero(known)
    seeds = seeds[:: -(-len(seeds) // NEIGHBOURS_3D)]
    tree = KDTree(position[seeds], balanced_tree=False, compact_nodes=False)
    return seeds[tree.query(position[targets])[1]]


def island_boxes(
    island: Int[np.ndarray, "h w"], numbers: Int[np.ndarray, " n"]
) -> list[tuple[int, tuple[slice, slice]]]:
    """The non-empty ones of the given islands, each with its bounding rectangle in the atlas."""
    from scipy.ndimage import find_objects

    slices = find_objects(island + 1)
    return [(int(k), slices[k]) for k in numbers if k < len(slices) and slices[k] is not None]
