"""Shared state of one recovery, and its reference pictures without indirect light."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded
from mistyle.core.light import has_soft
from mistyle.core.maps import Texels
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver.indirect import enlarged
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.table import Atlas

DISTRUST = 10.0  # a pixel's weight halves where indirect light is a tenth of the direct light

Radiance = Float[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class FitContext:
    """State that all stages of one fit share.

    tangents  per face corner, None for Mitsuba's frames
    texels    of each texture set, at the atlas's resolution
    captures  the reference pictures with all their light
    notes     sentences for the report, in chronological order
    trace     values per round and step, by name
    cameras   of the pictures themselves, where `captures` are averages of them
    """

    traced: Tracer
    tangents: Float[np.ndarray, "f 3 4"] | None
    texels: Sequence[Texels]
    atlas: Atlas
    captures: Captures
    settings: RecoverSettings
    seed: int = 0
    notes: list[str] = field(default_factory=list)
    trace: dict[str, list[float]] = field(default_factory=dict)
    cameras: tuple[Camera, ...] = ()

    def renderer(
        self, subsamples: int | None = None, memory: float | None = None, gradients: bool = False
    ) -> MaterialRenderer:
        """A renderer of tables of this atlas; `memory` in bytes. Arguments left out come from the settings."""
        s, soft = self.settings, has_soft(self.captures.lights)
        usual = s.soft_subsamples if soft else s.subsamples
        options = RenderOptions(
            model=s.model,
            frame=s.frame,
            subsamples=usual if subsamples is None else subsamples,
            shadows=s.shadows,
            directions=s.soft_cells,
            memory=s.memory * 1e9 if memory is None else memory,
            gradients=gradients,
        )
        return MaterialRenderer(self.traced, self.captures, self.atlas.sizes, options)


@dataclass(frozen=True)
class DirectCaptures:
    """Reference pictures, and their estimated indirect light: linear radiance per picture, possibly coarser."""

    captures: Captures
    indirect: Mapping[int, Radiance] = field(default_factory=dict)

    def with_indirect(self, k: int, light: Radiance) -> "DirectCaptures":
        """A copy with another estimate for picture k."""
        return replace(self, indirect={**self.indirect, k: light})

    def load(self, k: int) -> Loaded:
        """Picture k less its indirect light, and its mask of valid pixels."""
        rgb, mask = self.captures.load(k)
        if k in self.indirect:
            rgb = rgb - self.enlarged(k)
        return rgb, mask

    def enlarged(self, k: int) -> Float[np.ndarray, "h w 3"]:
        """The indirect light of picture k at the picture's size."""
        return enlarged(self.indirect[k], self.captures.cameras[k].size)

    def direct_only(self) -> Captures:
        """The pictures without their indirect light."""
        return Captures(self.captures.cameras, self.captures.lights, self.load)

    def pixel_confidence(self, k: int) -> Float[np.ndarray, "h w"]:
        """Weights of a picture's pixels, 0..1: a half where the indirect light is a tenth of the direct light."""
        if k not in self.indirect:
            return np.ones(self.captures.cameras[k].size, np.float32)
        taken = self.enlarged(k).max(axis=-1)
        direct = np.maximum(np.nan_to_num(self.load(k)[0]).max(axis=-1), 0)
        return (direct / np.maximum(direct + DISTRUST * taken, 1e-9)).astype(np.float32)
