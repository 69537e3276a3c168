"""Weight-free texture inpainter: colours of the surface solution.

It replaces the paper's 4.3 (Stable Diffusion inpainting with ControlNet and IP-Adapter), which needs weights.
"""

import numpy as np
from jaxtyping import Float

from mistyle.core.maps import Texels
from mistyle.stylization.inpaint.repair import Inpainter


def from_paint(painted: Float[np.ndarray, "h w 3"]) -> Inpainter:
    """An Inpainter that copies a painting of the whole surface (linear, finite on covered texels)."""

    def paint(albedo: np.ndarray, hole: np.ndarray, texels: Texels, rng: np.random.Generator) -> np.ndarray:
        return np.where((hole & texels.covered)[..., None], painted, albedo)

    return paint
