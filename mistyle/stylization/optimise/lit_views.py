"""Two-phase fit for stylized views of lit objects under known light (paper 4.2).

Such views measure each texel's reflectance under known light, so the solver estimates normal, roughness and albedo: per
texel, then on whole pictures, and under delta lights jointly (`recover.py`). Phase 1 takes normal and roughness from
this solution; its smoothness priors replace the paper's total variation. Phase 2 starts at the solution's albedo and
minimises the paper's loss (style, total variation, sliced Wasserstein distance) against unlit views. An unlit view is
the solution rendered without light plus the view's residual, except residuals as broad as shading. If the solution
explains the views worse than the baked maps, both phases start at the baked maps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mistyle.atlas.texels import rasterise
from mistyle.core.capture import Captures, in_memory
from mistyle.core.image import luminance, resize
from mistyle.core.light import Lights, has_soft
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba.draw import tracer
from mistyle.render.mitsuba.unlit import unlit
from mistyle.solver.recover import Recovered, recover
from mistyle.solver.texels.solve import shrunk_maps
from mistyle.stylization.mvst.unlight import BOUND, LEAST, STROKE, blurred
from mistyle.stylization.optimise.settings import FitSettings, lit_solver
from mistyle.stylization.optimise.table import ROUGHNESS_FLOOR
from mistyle.stylization.optimise.two_phase import Fit, FitStart, FitTargets, shrinkage, two_phase, view_mask

SUBSAMPLES = 4  # of a pixel, in residuals
SOLVED_SHARE = 0.8  # share of the total progress
LEAST_Z = 0.3  # of a normal: 72 degrees from the surface normal
DESCRIBED = ("normal", "roughness", "albedo", "metallic")


@dataclass(frozen=True)
class LitViews:
    """Views (linear rgb) that show the object under known lights."""

    views: Sequence[View]
    lights: Lights

    def captures(self) -> Captures:
        """The views as captures for `recover`."""
        return in_memory(
            [view.camera for view in self.views],
            [self.lights] * len(self.views),
            [np.nan_to_num(view.rgb) for view in self.views],
            [view_mask(view) for view in self.views],
        )


@dataclass(frozen=True)
class Solved:
    """The solution at the fit's resolution, one set of maps per texture set, and the views without their light.

    start     the baked maps at that resolution
    residual  root mean square of view - render, relative to the views: (baked maps, solution)
    """

    start: tuple[Maps, ...]
    maps: tuple[Maps, ...]
    unlit: tuple[View, ...]
    residual: tuple[float, float]
    trace: dict[str, list[float]]
    notes: tuple[str, ...]


def lit_phases(
    mesh: Mesh,
    maps: Sequence[Maps],
    targets: Sequence[View],
    texels: Sequence[Texels],
    lights: Lights,
    settings: FitSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
    *,
    style: Float[np.ndarray, "sh sw 3"] | None = None,
) -> Fit:
    """Fit `maps` (one per texture set, as baked) to `targets` (linear rgb) that show the object under `lights`.

    `style` as in `two_phase`. The same inputs, settings, seed and thread count give the same bytes.
    """
    lit = LitViews(targets, lights)
    solved = solve(mesh, maps, lit, texels, settings, seed, lambda done: progress(SOLVED_SHARE * done))
    better = solved.residual[1] < solved.residual[0]
    begun = laid(maps, solved.start, solved.maps) if better else list(maps)
    only_albedo = settings.model_copy(update={"iterations1": 0})
    fit = two_phase(
        mesh,
        FitStart(begun),
        FitTargets(targets, solved.unlit, style),
        texels,
        only_albedo,
        seed,
        lambda done: progress(SOLVED_SHARE + (1 - SOLVED_SHARE) * done),
    )
    undone = () if better else ("phase1 was undone: the solved maps explain the views worse than the baked ones.",)
    return replace(
        fit,
        trace=solved.trace | fit.trace,
        kept={"phase1": better} | fit.kept,
        figures={"phase1.residual": solved.residual} | fit.figures,
        notes=(*solved.notes, *undone, *fit.notes),
    )


def solve(
    mesh: Mesh,
    maps: Sequence[Maps],
    lit: LitViews,
    texels: Sequence[Texels],
    settings: FitSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
) -> Solved:
    """Normal, roughness and albedo from the views, at the resolution that the views resolve."""
    by = shrinkage(mesh, texels, lit.views, settings.texels_per_pixel)
    coarse = [t if by == 1 else rasterise(mesh, k, len(t.covered) // by) for k, t in enumerate(texels)]
    start = [shrunk_maps(m, t.covered.shape) for m, t in zip(maps, coarse, strict=True)]
    targets, captures = lit.views, lit.captures()
    chosen = lit_solver(settings, has_soft(captures.lights))
    recovered = recover(mesh, coarse, captures, chosen, seed, lambda done: progress(0.9 * done), start=start)
    fitted = tuple(_where_seen(recovered, start, coarse, k) for k in range(len(start)))
    residual, unlit = _explained(mesh, captures, (start, fitted), targets)
    progress(1.0)
    trace = {f"phase1.{name}": values for name, values in recovered.trace.items()}
    return Solved(tuple(start), fitted, tuple(unlit), residual, trace, recovered.notes)


def laid(maps: Sequence[Maps], start: Sequence[Maps], solved: Sequence[Maps]) -> list[Maps]:
    """`maps` plus the change from `start` to `solved`.

    `start` and `solved` have the solution's coarser resolution; `start` is the shrunk `maps`. Finer detail stays.
    """
    result = []
    for fine, before, after in zip(maps, start, solved, strict=True):
        size, fields = fine.roughness.shape, {}
        for name in DESCRIBED:
            change = (getattr(after, name) - getattr(before, name)).astype(np.float32)
            if change.any():
                moved = getattr(fine, name) + (change if change.shape[:2] == size else resize(change, size))
                fields[name] = _allowed(name, moved)
        result.append(replace(fine, **fields))
    return result


def _allowed(name: str, values: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "h w *c"]:
    if name == "normal":
        values = values * np.array([1, 1, 0], np.float32) + np.maximum(values[..., 2:], LEAST_Z) * np.array([0, 0, 1])
        return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)
    return np.clip(values, ROUGHNESS_FLOOR if name == "roughness" else 0, 1).astype(np.float32)


def _where_seen(recovered: Recovered, start: Sequence[Maps], texels: Sequence[Texels], k: int) -> Maps:
    """The solution; texels that no view sees lit keep the start values."""
    open_ = texels[k].covered & (recovered.seen[k] <= 0)
    fields: dict[str, np.ndarray] = {}
    for name in DESCRIBED:
        solved, before = getattr(recovered.maps[k], name), getattr(start[k], name)
        fields[name] = np.where(open_[..., None] if solved.ndim == 3 else open_, before, solved)
    return replace(recovered.maps[k], **fields)


def _explained(
    mesh: Mesh, captures: Captures, both: tuple[Sequence[Maps], Sequence[Maps]], targets: Sequence[View]
) -> tuple[tuple[float, float], list[View]]:
    """The residuals of two solutions, and the unlit views by the second one."""
    traced, sizes = tracer(mesh), [m.roughness.shape for m in both[0]]
    options = RenderOptions(subsamples=SUBSAMPLES, gradients=False)
    renderer = MaterialRenderer(traced, captures, sizes, options)
    squares = np.zeros((2, 2))
    plain = [rgb for rgb, _ in unlit(traced, both[1], captures.cameras)]
    result = []
    for j, maps in enumerate(both):
        table = renderer.upload(pack(maps))
        for k, view in enumerate(targets):
            mask, lit = captures.load(k)[1], renderer.image(table, k)
            squares[j] += [float(((view.rgb - lit)[mask] ** 2).sum()), float((view.rgb[mask] ** 2).sum())]
            if j == 1:
                result.append(replace(view, rgb=without_light(view, lit, plain[k], mask)))
    before, after = np.sqrt(squares[:, 0] / np.maximum(squares[:, 1], 1e-30))
    return (float(before), float(after)), result


def without_light(
    view: View, lit: Float[np.ndarray, "h w 3"], plain: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """An unlit view: `plain`, the solution without light, plus the view's fine residual to `lit`, the solution under
    light, scaled to plain's brightness by BOUND at most."""
    bright = luminance(lit)
    gain = luminance(plain) / np.maximum(bright, LEAST * max(float(bright.max()), 1e-6))
    rest = np.where(mask[..., None], np.nan_to_num(view.rgb) - lit, 0).astype(np.float32)
    broad = np.stack([blurred(rest[..., c], mask, STROKE * mask.shape[1]) for c in range(3)], axis=-1)
    detail = (rest - broad) * np.clip(gain, 0, BOUND)[..., None]
    return np.maximum(plain + np.where(mask[..., None], detail, 0), 0).astype(np.float32)
