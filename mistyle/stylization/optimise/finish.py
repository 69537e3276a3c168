"""Finish of a painted albedo by VGG-19 style losses on many rendered crops (after StyleMesh, Höllein et al. 2022).

Each step views a few surface points frontally, at the painting's own scale. Mitsuba renders the crops without light
(`Film`). The statistics of their features are compared with those of the original painting at the same places
(`finish_style.py`). Pixels are weighted by viewing angle and distance. The gradient moves a Laplacian pyramid of the
texture (`render/deferred/pyramid.py`). The content loss uses the painted albedo's own features, with more weight along
edges of the shape. Changes broader than a stroke, and colours outside the painting's palette, are removed: so neither
colour drift nor light enters the albedo.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.camera import Camera
from mistyle.core.image import linear_from_srgb, srgb_from_linear
from mistyle.core.light import Ambient
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh, face_areas
from mistyle.core.rows import distinct_integers
from mistyle.process import memory
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import pyramid, torch_bridge
from mistyle.render.deferred.torch_bridge import Shader
from mistyle.render.mitsuba.draw import tracer
from mistyle.stylization.optimise import finish_style
from mistyle.stylization.optimise import table as fit_table
from mistyle.stylization.optimise.finish_settings import JUDGED, FinishSettings
from mistyle.stylization.surface.lookup import PaintedSurface

if TYPE_CHECKING:
    import torch

    from mistyle.measure.features import Features

DISTANCE = 4.0  # of a camera from its target, working units
GRAZING, FRONTAL = 0.35, 0.8  # cosines of weight 0 and 1
FAR = 0.2  # relative difference of depth, and so of scale, of weight 0
RIM = 6  # pixels along silhouettes, whose receptive field includes background
TRIES = 16  # candidate points per crop; the least seen is used
EDGE, EDGE_REACH = 0.3, 7  # change of the normal between pixels at an edge of the shape; pixels around it
BROAD = 12.0  # standard deviation in texels of the table beyond which a change is removed
JUDGE = 0x5EED  # seed of the crops that compare before and after
OFF_PALETTE = 0.03  # standard deviation of the painting's colours (sRGB units) along which half of a change stays
FURTHEST = 0.12  # asymptotic bound of an encoded value's change
LONGEST = 1024  # largest long side of the painting, pixels, for its features
LEAST = 1e-6  # lower bound of a squared distance: the root's slope is infinite at 0
LAST_RATE = 0.1  # share of the rate at the end of the cosine schedule


@dataclass(frozen=True)
class PaintedAsset:
    """The painter's result: maps and texels per texture set, and the solution that maps surface to painting.

    `only` masks the texels that may change; None: all.
    """

    mesh: Mesh
    maps: tuple[Maps, ...]
    texels: tuple[Texels, ...]
    solution: PaintedSurface
    only: tuple[Bool[np.ndarray, "_ _"], ...] | None = None


@dataclass(frozen=True)
class StyleFinish:
    """The finished albedo (linear, one per texture set), and its losses.

    trace   style loss of every step: the root of the statistic's distance, times the share of weighted pixels
    style   that loss before and after, on held-out crops
    moved   root mean square change of the covered texels' albedo, sRGB units
    """

    albedo: tuple[Float[np.ndarray, "_ _ 3"], ...]
    trace: tuple[float, ...]
    style: tuple[float, float]
    moved: float


@dataclass(frozen=True)
class Crops:
    """Rendered crops of one step: n squares of one size, with their pixels' texels and places in the painting.

    `counts` are pixel weights (n, 1, s, s), torch; `held` are the content's weights.
    """

    lit: Any
    taps: Any
    places: finish_style.Places
    counts: Any
    on: Any
    held: Any


def finish(
    painted: PaintedAsset,
    features: "Features",
    settings: FinishSettings,
    seed: int,
    progress: Callable[[float], None] = lambda done: None,
    *,
    bridge: Any = "frozen",
) -> StyleFinish:
    """Optimise the albedo of `painted` for `settings.steps` steps, and keep it if the style loss fell.

    The same inputs, settings, seed and thread count give the same bytes.
    """
    with memory.kept():
        run = Finishing(painted, features, settings, seed, bridge)
        before = run.judged()
        for step in range(settings.steps):
            run.step(step)
            progress((step + 1) / settings.steps)
        run.restrain()
        return run.result(before, run.judged())


class Finishing:
    """State of a running finish: texture, Adam's moments and sample counts, which change every step."""

    def __init__(
        self, painted: PaintedAsset, features: "Features", settings: FinishSettings, seed: int, bridge: Any = "frozen"
    ) -> None:
        self.painted, self.settings, self.features = painted, settings, features
        self.rng = np.random.default_rng(seed)
        self.traced = tracer(painted.mesh)
        shrink = texels_per_pixel(painted, settings)
        self.pixel = shrink * texel_side(painted)
        self.painting = finish_style.painting_features(painted.solution, self.pixel, features)
        self.film = Film(settings.crops, settings.crop_size, bridge)
        self.encoded = [replace(m, albedo=srgb_from_linear(m.albedo)) for m in painted.maps]
        self.table = fit_table.build(self.encoded, painted.texels, shrink, painted.only)
        self.moments = [pyramid.start((*size, 3)) for size in self.table.sizes]
        self.seen = np.zeros(len(painted.solution.positions), np.float32)
        self.trace: list[float] = []

    def step(self, number: int) -> None:
        """One gradient step on style and content."""
        import torch

        crops = self.crops(self.rng, self.seen)
        values = self.table.values["albedo"]
        leaf = torch.from_numpy(values[crops.taps.texels]).requires_grad_(True)
        style, content = self.losses(crops, leaf, self.rng)
        (self.settings.style * style + self.settings.content * content).backward()
        self.trace.append(float(style.detach()))
        assert leaf.grad is not None
        gradient = np.zeros_like(values)
        gradient[crops.taps.texels] = leaf.grad.numpy()
        gradient[self.table.still] = 0
        share = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + np.cos(np.pi * number / self.settings.steps))
        pace = self.settings.rate * share, self.settings.coarse
        for rows, size, moments in zip(self.table.parts, self.table.sizes, self.moments, strict=True):
            own = gradient[rows].reshape(*size, 3)
            if own.any():
                change = pyramid.change(moments, own, *pace, damping=self.settings.damping)
                values[rows] = np.clip(values[rows] + change.reshape(-1, 3), 0, 1)

    def losses(
        self, crops: Crops, leaf: "torch.Tensor", rng: np.random.Generator
    ) -> "tuple[torch.Tensor, torch.Tensor]":
        """Style and content losses of crops with encoded texels `leaf`."""
        import torch
        import torch.nn.functional as functional

        from mistyle.measure.losses import style_statistics

        n, size = self.settings.crops, self.settings.crop_size
        target = finish_style.target_features(self.painting, crops.places, n, size)
        # The original albedo first: the film holds one picture at a time until its gradient is computed.
        with torch.no_grad():
            start = torch.from_numpy(self.table.start["albedo"][crops.taps.texels])
            own = self.features(self.shown(crops, start)) if self.settings.content else []
        maps = self.features(self.shown(crops, leaf, moving=True))
        style = content = leaf.new_zeros(())
        for k in range(n):
            crop, counts = slice(k, k + 1), crops.counts[k : k + 1]
            rendered, painted = ([level[crop] for level in levels] for levels in (maps, target))
            distance = style_statistics(rendered, painted, counts, counts, kind=self.settings.statistic, rng=rng)
            # Root, times the weighted share: crops with few pixels or a large distance do not dominate.
            style = style + counts.mean() * (distance + LEAST).sqrt() / n
        # The content loss leaves out the finest features, those of single pixels.
        for a, b in zip(maps[-2:], own[-2:], strict=False):
            held = functional.interpolate(crops.held, size=a.shape[2:], mode="area")
            content = content + ((a - b).square() * held).mean() / b.square().mean().clamp_min(1e-8)
        return style, content

    def shown(self, crops: Crops, texels: "torch.Tensor", moving: bool = False) -> "torch.Tensor":
        """Encoded pictures of the crops (n, 3, s, s); the painting's mean colour off the mesh."""
        import torch

        from mistyle.measure.losses import linear_from_srgb as linear
        from mistyle.measure.losses import srgb_from_linear as encoded

        picture = self.film(crops.lit, torch_bridge.fetch(linear(texels), crops.taps), moving)
        mean = torch.from_numpy(self.painted.solution.painting.mean(axis=(0, 1))).view(1, 3, 1, 1)
        return encoded(picture) * crops.on + mean * (1 - crops.on)

    def crops(self, rng: np.random.Generator, seen: Float[np.ndarray, " n"]) -> Crops:
        """Crops at the least seen of random surface points; `seen` counts views of the painter's samples."""
        import torch

        n, size, solution = self.settings.crops, self.settings.crop_size, self.painted.solution
        cameras = []
        for _ in range(n):
            tries = rng.integers(len(seen), size=TRIES)
            k = tries[np.argmin(seen[tries])]
            seen[k] += 0.5
            frame = solution.tangent[k], solution.normals[k]
            cameras.append(frontal(solution.positions[k], *frame, self.pixel, size))
        surface = deferred.trace(self.traced, cameras)
        axes = (np.repeat([c.world_from_cam[:3, k] for c in cameras], size * size, axis=0) for k in (0, 1))
        places = finish_style.places(self.painting, surface.mask, surface.position, surface.normal, *axes)
        counts = weights(surface, cameras) * places.sure
        seen[distinct_integers(places.sample[counts > 0.5])] += 1

        def image(values: np.ndarray) -> "torch.Tensor":
            return torch.from_numpy(values.astype(np.float32)).reshape(n, 1, size, size)

        on = image(surface.mask)
        lit = deferred.light(self.traced, surface, (Ambient((1.0, 1.0, 1.0)),), shadows=False)
        held = on * (1 + image(shape_edges(surface.normal.reshape(n, size, size, 3))))
        return Crops(lit, torch_bridge.taps(surface, self.table.sizes), places, image(counts), on, held)

    def judged(self) -> float:
        """The style loss of the current texture on held-out crops (seed JUDGE)."""
        import torch

        rng, seen = np.random.default_rng(JUDGE), np.zeros_like(self.seen)
        losses = []
        for _ in range(JUDGED):
            crops = self.crops(rng, seen)
            with torch.no_grad():
                leaf = torch.from_numpy(self.table.values["albedo"][crops.taps.texels])
                losses.append(float(self.losses(crops, leaf, rng)[0]))
        return float(np.mean(losses))

    def restrain(self) -> None:
        """Restrict the albedo's change: remove its mean over a few strokes and colour directions in which the painting
        does not vary (a woodcut stays black and white), then bound it."""
        palette = own_directions(self.painted.solution.painting)
        values, start = self.table.values["albedo"], self.table.start["albedo"]
        for rows, size, where in zip(self.table.parts, self.table.sizes, self.painted.texels, strict=True):
            change = (values[rows] - start[rows]).reshape(*size, 3)
            by = where.covered.shape[0] // size[0]
            inside = np.asarray(where.covered.reshape(size[0], by, size[1], by).any(axis=(1, 3)), np.float32)[..., None]
            mean = cv2.GaussianBlur(np.concatenate([change * inside, inside], axis=2), (0, 0), BROAD)
            broad = mean[..., :3] / np.maximum(mean[..., 3:], 1e-3)
            finer = FURTHEST * np.tanh((change - broad) @ palette / FURTHEST)
            finer = np.where(self.table.still[rows].reshape(size)[..., None], 0, finer)
            values[rows] = np.clip(start[rows] + finer.reshape(-1, 3), 0, 1)

    def result(self, before: float, after: float) -> StyleFinish:
        """The finish with the original albedo plus its change, or unchanged if the loss did not fall."""
        if after >= before:
            # Without a gain on held-out crops the albedo stays unchanged.
            self.table.values["albedo"][:] = self.table.start["albedo"]
        albedos, squares, count = [], 0.0, 0
        laid = fit_table.finished(self.table, self.encoded, self.painted.only)
        for new, old, where in zip(laid, self.encoded, self.painted.texels, strict=True):
            change = (new.albedo - old.albedo)[where.covered]
            squares, count = squares + float(np.square(change, dtype=np.float64).sum()), count + change.size
            albedos.append(linear_from_srgb(new.albedo))
        moved = float(np.sqrt(squares / max(count, 1)))
        return StyleFinish(tuple(albedos), tuple(self.trace), (before, after), moved)


class Film:
    """Differentiable unlit pictures: radiance of a matt surface under uniform light over that of a white one.

    A class because its renderer is built once.
    """

    def __init__(self, crops: int, size: int, bridge: Any) -> None:
        self.shape = crops, size
        self.shader = Shader((crops * size, size), gloss=False, bridge=bridge)

    def __call__(self, lit: Any, albedo: "torch.Tensor", moving: bool = False) -> "torch.Tensor":
        """Linear (n, 3, s, s) from the pixels' albedo (n s s, 3); differentiable if `moving`."""
        import torch

        n, size = self.shape
        matt = albedo.new_tensor([0.0, 0.0, 1.0, 1.0, 0.0]).expand(len(albedo), 5)
        white = self.shader(lit, torch.cat([torch.ones_like(albedo), matt], dim=1).detach())
        drawn = self.shader(lit, torch.cat([albedo, matt], dim=1), ("albedo",) if moving else ())
        return (drawn / white.clamp_min(1e-3)).reshape(n, size, size, 3).permute(0, 3, 1, 2)


def texels_per_pixel(painted: PaintedAsset, settings: FinishSettings) -> int:
    """Texels per pixel from the settings, or more where the painting would exceed LONGEST pixels at that scale."""
    solution, shrink = painted.solution, settings.texels_per_pixel
    long = max(solution.painting.shape[:2]) * solution.spacing / max(solution.scale)
    while long > LONGEST * shrink * texel_side(painted):
        shrink *= 2
    return shrink


def texel_side(painted: PaintedAsset) -> float:
    """The mean side of a texel on the surface, working units, over all texture sets."""
    covered = sum(int(where.covered.sum()) for where in painted.texels)
    return float(np.sqrt(face_areas(painted.mesh).sum() / max(covered, 1)))


def own_directions(painting: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3 3"]:
    """A symmetric matrix that keeps colour differences along which the painting varies, and shrinks others to 0."""
    spread = np.cov(painting.reshape(-1, 3).T.astype(np.float64))
    return (spread @ np.linalg.inv(spread + OFF_PALETTE**2 * np.eye(3))).astype(np.float32)


def frontal(
    position: Float[np.ndarray, "3"],
    tangent: Float[np.ndarray, "3"],
    normal: Float[np.ndarray, "3"],
    pixel: float,
    size: int,
) -> Camera:
    """A camera that looks at a surface point along its normal, `tangent` to the right, `pixel` units a pixel there."""
    across = tangent - (tangent @ normal) * normal
    across = across / max(float(np.linalg.norm(across)), 1e-9)
    world = np.eye(4)
    world[:3, :3] = np.stack([across, np.cross(across, normal), -normal], axis=1)
    world[:3, 3] = position + DISTANCE * normal
    return Camera(world, DISTANCE / pixel, (size / 2, size / 2), (size, size))


def weights(surface: Any, cameras: Sequence[Camera]) -> Float[np.ndarray, " n"]:
    """Weight of each pixel by viewing angle and distance; zero along silhouettes."""
    n, (height, width) = len(cameras), cameras[0].size
    angle = np.clip((surface.facing - GRAZING) / (FRONTAL - GRAZING), 0, 1)
    each = zip(np.split(surface.position, n), cameras, strict=True)
    depth = np.concatenate([(p - c.position) @ c.world_from_cam[:3, 2] for p, c in each])
    near = np.clip(2 - 2 * np.abs(depth / DISTANCE - 1) / FAR, 0, 1)
    weight = (angle * near * surface.mask).reshape(n, height, width).astype(np.float32)
    kernel = np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
    inside = [cv2.erode((one > 0).astype(np.uint8), kernel) for one in weight]
    return (weight * np.stack(inside)).reshape(-1)


def shape_edges(normals: Float[np.ndarray, "n h w 3"]) -> Float[np.ndarray, "n h w"]:
    """Edge strength 0..1 of the shape around a pixel, by the change of its normal between neighbours."""
    turn = np.zeros(normals.shape[:3], np.float32)
    turn[:, :, 1:] += np.linalg.norm(np.diff(normals, axis=2), axis=3)
    turn[:, 1:] += np.linalg.norm(np.diff(normals, axis=1), axis=3)
    kernel = np.ones((EDGE_REACH, EDGE_REACH), np.uint8)
    return np.stack([cv2.dilate(np.clip(one / EDGE, 0, 1), kernel) for one in turn])
