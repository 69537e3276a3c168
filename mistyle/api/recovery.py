"""A material from pictures under known light, in memory."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mistyle.api import html
from mistyle.core.asset import Asset
from mistyle.core.capture import Captures, shrunk
from mistyle.core.errors import InputRefused
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.process.cores import single_blas
from mistyle.solver.settings import RecoverSettings

SURE = 0.5  # confidence above which a texel counts as determined


@dataclass(frozen=True)
class MaterialFit:
    """A fitted material, per texture set.

    maps        albedo linear Rec.709, normal in tangent space (+Y, MikkTSpace), roughness, metallic; `known` where a
                picture shows the texel lit. Texels outside the UV islands have no meaning
    confidence  0..1: 1 well determined, 0 not seen
    spread      standard deviations of albedo, normal (radians of tilt), roughness and metallic, (h, w) by name
    seen        number of pictures that show the texel lit
    texels      surface position and coverage of the texels
    figures     seen_share and confident_share of the covered texels; residual and worst_residual: root mean square of
                reference - render, relative to the reference's, mean and largest over the pictures
    residuals   the relative residual of each picture, by its name
    notes       omissions, averaging, and undetermined quantities
    """

    maps: tuple[Maps, ...]
    confidence: tuple[Float[np.ndarray, "_ _"], ...]
    spread: tuple[dict[str, Float[np.ndarray, "_ _"]], ...]
    seen: tuple[Int[np.ndarray, "_ _"], ...]
    texels: tuple[Texels, ...]
    parts: tuple[str, ...]
    figures: dict[str, float]
    residuals: dict[str, float]
    notes: tuple[str, ...]

    def _repr_html_(self) -> str:
        rows = []
        for part, maps, sure, texels in zip(self.parts, self.maps, self.confidence, self.texels, strict=True):
            shown = html.map_pictures(maps) | {"confidence": np.where(texels.covered, sure, 0)}
            on = {name: np.where(_like(texels.covered, p), p, 1).astype(np.float32) for name, p in shown.items()}
            rows.append(html.page(part, html.thumbnails(on)))
        return html.page("Fitted material", html.table(("figure", "value"), self.figures.items()), *rows,
                         notes=self.notes)  # fmt: skip


def _like(mask: np.ndarray, picture: np.ndarray) -> np.ndarray:
    return mask if picture.ndim == 2 else mask[..., None]


def recover(
    mesh: Mesh | Asset,
    captures: Captures,
    size: int = 512,
    *,
    settings: RecoverSettings | Mapping[str, Any] | None = None,
    seed: int = 0,
    start: Maps | Sequence[Maps] | None = None,
    progress: Callable[[float], None] | None = None,
) -> MaterialFit:
    """Albedo, normal, roughness and metallic of a mesh from pictures of known cameras under known light.

    mesh      in working space with UVs, for example of `read_mesh`
    captures  of `read_captures`, of `render_views(...).captures`, or of `captures_of(cameras, lights, pictures)`
    size      texels a side of every texture set
    settings  a `RecoverSettings` record or some of its fields, for example `{"metallic": True}`
    seed      equal inputs, settings, seed and threads give equal bytes
    start     start maps, `size` texels a side; their metallic stays where metallic is not fitted
    progress  receives the completed share, 0..1

    The solver of `mistyle fit` without a run folder, checkpoints and held-out pictures. Pictures much finer than the
    texels are averaged in blocks first, with a note. Cameras and lights are not refined; a common scale of light and
    albedo is not identifiable. Raises InputRefused where no picture is usable, UsageError for unknown settings.
    """
    from mistyle.atlas.texels import rasterise
    from mistyle.jobs.settings import validate
    from mistyle.solver.recover import recover as solve
    from mistyle.solver.validate import downsampling_factors

    shape = mesh.mesh if isinstance(mesh, Asset) else mesh
    requested = {} if settings is None else settings
    chosen = requested if isinstance(requested, RecoverSettings) else validate(requested, "recover", RecoverSettings)
    unlit = [camera.name for camera, rig in zip(captures.cameras, captures.lights, strict=True) if not rig]
    if unlit:
        raise InputRefused(f"recover: found no light for the picture '{unlit[0]}', expected one for each. mistyle.fit"
                           '(..., lights="unknown") estimates an unknown light.')  # fmt: skip
    texels = tuple(rasterise(shape, part, size) for part in range(len(shape.parts)))
    by = downsampling_factors(texels, captures.cameras)
    first = [start] if isinstance(start, Maps) else start
    with single_blas():
        done = solve(shape, texels, shrunk(captures, by), chosen, seed, progress or (lambda share: None), start=first)
    return MaterialFit(
        maps=done.maps,
        confidence=done.confidence,
        spread=done.spread,
        seen=done.seen,
        texels=texels,
        parts=tuple(shape.parts),
        figures=_figures(texels, done.seen, done.confidence, done.residuals),
        residuals=done.residuals,
        notes=(*_averaged(by), *done.notes),
    )


def _averaged(by: Sequence[int]) -> tuple[str, ...]:
    """A note where pictures were averaged in blocks of `by` pixels a side."""
    count, most = sum(times > 1 for times in by), max(by, default=1)
    where = f"in {count} of {len(by)} pictures, which are much finer than the texels"
    return (f"Blocks of up to {most} x {most} pixels were averaged {where}.",) if count else ()


def _figures(
    texels: Sequence[Texels],
    seen: Sequence[np.ndarray],
    confidence: Sequence[np.ndarray],
    residuals: Mapping[str, float],
) -> dict[str, float]:
    covered = [t.covered for t in texels]
    total = max(sum(int(c.sum()) for c in covered), 1)

    def share(masks: Sequence[np.ndarray]) -> float:
        return sum(int((m & c).sum()) for m, c in zip(masks, covered, strict=True)) / total

    errors = list(residuals.values())
    return {
        "seen_share": share([s > 0 for s in seen]),
        "confident_share": share([c > SURE for c in confidence]),
        "residual": float(np.mean(errors)),
        "worst_residual": float(np.max(errors)),
    }
