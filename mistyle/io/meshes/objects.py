"""The objects of a source file, for writers of formats that name objects."""

import numpy as np
from jaxtyping import Int

from mistyle.core.asset import Asset
from mistyle.core.names import distinct


def objects(asset: Asset) -> tuple[Int[np.ndarray, " f"], list[str]]:
    """The object of every face, by number, and the objects' different names; the asset's where the source has none."""
    numbers: dict[tuple[int, str], int] = {}
    object_of_face = np.zeros(len(asset.mesh.faces), np.int32)
    for p in asset.source.primitives:
        object_of_face[p.start : p.stop] = numbers.setdefault((p.node, p.name), len(numbers))
    names = [name for _, name in numbers] or [""]
    if asset.source.kind == "usd":
        names = [path.rsplit("/", 1)[-1] for path in names]
    return object_of_face, distinct([name or asset.name for name in names], key=str)
