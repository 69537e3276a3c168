"""Optimisation loop of one fit phase: crops, render, loss, gradient, Adam step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.camera import Camera, zoom
from mistyle.core.image import luminance
from mistyle.core.light import Directional, Lights, direction_in_world
from mistyle.core.maps import place_of
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import torch_bridge
from mistyle.render.deferred.torch_bridge import Shader
from mistyle.stylization.optimise import table as fit_table
from mistyle.stylization.optimise.settings import FitSettings
from mistyle.stylization.optimise.table import FitTable

if TYPE_CHECKING:
    import torch

    from mistyle.measure.losses import Crop

CLAY = 0.25  # constant albedo of phase 1's clay render: dark enough for visible highlights
GRAZING = 0.2  # pixels with a smaller cosine are left out
LAST_RATE = 0.1  # share of the learning rate at the end of a phase's cosine schedule


@dataclass(frozen=True)
class CropBatch:
    """One step's rendered crops and their targets: n crops of s x s pixels (torch).

    `render` is linear, `target` sRGB, both (n, 3, s, s). `plain` is the render with the unpainted surface's normals and
    roughness, if the phase needs it. `mask` is (n, 1, s, s), 0 or 1; world position and normal (n, 3, s, s). `light`
    (n, 3) is the direction to each crop's light or to the mean of its lights, None under ambient light. `zoomed` is
    crop pixels per pixel of the view.
    """

    render: Any
    plain: Any
    target: Any
    mask: Any
    position: Any
    normal: Any
    light: Any
    zoomed: float


# (batch, features, generator) -> weighted losses by name
Loss = Callable[[CropBatch, Callable[[Any], list[Any]], np.random.Generator], "dict[str, torch.Tensor]"]


@dataclass(frozen=True)
class SceneContext:
    """Constants of the fit; `targets` are (4, h, w): sRGB, and the mask of pixels wholly inside."""

    traced: Any
    tangents: Float[np.ndarray, "f 3 4"]
    cameras: tuple[Camera, ...]
    targets: tuple[Any, ...]
    masks: tuple[Bool[np.ndarray, "h w"], ...]
    features: Callable[[Any], list[Any]]


@dataclass(frozen=True)
class Phase:
    """Definition of an optimisation phase: lights, learning rates, total-variation weights, steps and loss."""

    name: str
    lights: Lights
    one_by_one: bool  # each crop under one light, in turn
    clay: bool  # render with constant albedo, for comparison with a relief's shading; so without shadows
    gloss: bool
    rates: Mapping[str, float]
    variation: Mapping[str, float]
    iterations: int
    loss: Loss


class PhaseRunner:
    """State of a running phase: its losses, and the last steps' accumulated albedo gradients."""

    def __init__(
        self, scene: SceneContext, table: FitTable, phase: Phase, settings: FitSettings, rng: np.random.Generator
    ) -> None:
        self.scene, self.table, self.phase, self.settings, self.rng = scene, table, phase, settings, rng
        self.shader = shader(settings, phase.gloss)
        self.trace: dict[str, list[float]] = {}
        self.order: list[int] = []
        self.beam = 0
        self.struggle = np.zeros(len(table.still), np.float32)
        self.touched = np.zeros(len(table.still), np.float32)
        self.pulled = np.zeros((len(table.still), 3), np.float32)
        # Adam begins anew: each phase has another objective.
        table.first, table.second, table.steps, table.squares = {}, {}, {}, {}

    def step(self, iteration: int) -> str:
        """One step of Adam; on a NaN or infinite value no texel moves, and the returned note names the texel."""
        crops = self._crops()
        texels, pure, looks, crop_of = self._gradients(crops)
        gradients, near = dict(pure), fit_table.pairs(self.table, texels)
        for name, weight in self.phase.variation.items():
            value, slope = fit_table.variation(self.table, name, near)
            self._note(f"tv_{name}", weight * value)
            gradients[name] = gradients[name] + np.float32(weight) * slope * fit_table.nonzero(gradients[name])[:, None]
        invalid = self._not_a_number(texels, gradients)
        if invalid:
            name, row = invalid
            return self._stopped(iteration, name, int(texels[row]), crops[crop_of(row)])
        if "albedo" in gradients and self.phase.iterations - iteration <= self.settings.struggle_window:
            self.struggle[texels] += np.abs(pure["albedo"]) @ np.full(3, 1 / 3, np.float32)
            self.touched[texels] += looks
            self.pulled[texels] += pure["albedo"]
        share = iteration / max(self.phase.iterations, 1)
        decay = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + np.cos(np.pi * share))
        for name, gradient in gradients.items():
            fit_table.step(self.table, name, texels, gradient, self.phase.rates[name] * decay)
        return ""

    def _crops(self) -> "list[Crop]":
        """Crops of the views in turn, in a new random order each round."""
        from mistyle.measure.losses import sample_crops

        settings = self.settings
        while len(self.order) < settings.crops:
            self.order += self.rng.permutation(len(self.scene.cameras)).tolist()
        views, self.order = self.order[: settings.crops], self.order[settings.crops :]
        return sample_crops(
            self.rng, self.scene.masks, settings.crops, settings.crop_size, settings.crop_scale, views=views
        )

    def _gradients(
        self, crops: "Sequence[Crop]"
    ) -> tuple[Int[np.ndarray, " t"], dict[str, np.ndarray], Float[np.ndarray, " t"], Callable[[int], int]]:
        """Touched texels; the loss's gradient for each optimised map; samples per texel (sum of the bilinear weights of
        valid pixels); and a function from a texel to the crop that saw it."""
        import torch

        from mistyle.measure.losses import crop_picture

        size, count = self.settings.crop_size, self.settings.crops
        cameras = [zoom(self.scene.cameras[c.view], c.x, c.y, c.width, (size, size)) for c in crops]
        surface = deferred.trace(self.scene.traced, cameras, self.scene.tangents)
        lit, towards = self._light(surface)
        where = torch_bridge.taps(surface, self.table.sizes)

        def picture(values: Mapping[str, np.ndarray], moving: Mapping[str, float]) -> tuple[Any, dict[str, Any]]:
            leaves = {n: torch.from_numpy(v[where.texels]).requires_grad_(n in moving) for n, v in values.items()}
            pixels = torch_bridge.fetch(materials(leaves, self.phase.clay), where)
            names = tuple("normal" if name == "tilt" else name for name in moving)
            return self.shader(lit, pixels, names).reshape(count, size, size, 3).permute(0, 3, 1, 2), leaves

        plain = picture(self.table.plain, {})[0] if self.phase.clay else None
        render, leaves = picture(self.table.values, self.phase.rates)
        target = torch.stack([crop_picture(self.scene.targets[c.view], c, size) for c in crops])

        def image(values: np.ndarray) -> "torch.Tensor":
            return torch.from_numpy(values).reshape(count, size, size, -1).permute(0, 3, 1, 2)

        mask = (image(np.abs(surface.facing) > GRAZING) & (target[:, 3:] > 0.999)).float()
        position, normal = image(surface.position), image(surface.normal)
        batch = CropBatch(render, plain, target[:, :3], mask, position, normal, towards, size / crops[0].width)
        losses = self.phase.loss(batch, self.scene.features, self.rng)
        for name, value in losses.items():
            self._note(name, float(value.detach()))
        torch.stack(list(losses.values())).sum().backward()
        gradients = {}
        for name in self.phase.rates:
            grad = leaves[name].grad
            gradients[name] = np.zeros(leaves[name].shape, np.float32) if grad is None else grad.numpy()
        looks = where.matrix.T @ mask.numpy().ravel()
        return where.texels, gradients, looks, lambda row: int(where.matrix[:, [row]].nonzero()[0][0]) // (size * size)

    def _light(self, surface: Any) -> "tuple[Any, torch.Tensor | None]":
        import torch

        beams = [light for light in self.phase.lights if isinstance(light, Directional)]
        if not self.phase.one_by_one:
            lit = deferred.light(self.scene.traced, surface, self.phase.lights, shadows=not self.phase.clay)
            rows = [beams] * len(surface.cameras)
        else:
            first, self.beam = self.beam, self.beam + len(surface.cameras)
            alone = [beams[k % len(beams)] for k in range(first, self.beam)]
            lit, rows = deferred.light_rows(self.scene.traced, surface, [alone], None, False), [[b] for b in alone]
        if not beams:
            return lit, None
        towards = [_mean_direction(row, camera) for row, camera in zip(rows, surface.cameras, strict=True)]
        return lit, torch.from_numpy(np.stack(towards))

    def _note(self, name: str, value: float) -> None:
        self.trace.setdefault(name, []).append(value)

    def _not_a_number(
        self, texels: Int[np.ndarray, " t"], gradients: Mapping[str, np.ndarray]
    ) -> tuple[str, int] | None:
        """The map and row of the first texel with a non-finite gradient or value, else None.

        Mitsuba gives a non-finite texel a zero gradient, so a non-finite loss also checks the values.
        """
        broken = not all(np.isfinite(values[-1]) for values in self.trace.values())
        looked_at = {name: self.table.values[name][texels] for name in self.table.values} if broken else {}
        for tables in (looked_at, gradients):
            for name, values in tables.items():
                if not np.isfinite(values.sum(dtype=np.float64)):
                    return name, int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        return (next(iter(gradients)), 0) if broken else None

    def _stopped(self, iteration: int, name: str, texel: int, crop: "Crop") -> str:
        part, row, column = place_of(texel, self.table.sizes)
        shape = "x".join(map(str, self.table.sizes[part]))
        view = self.scene.cameras[crop.view].name
        return (
            f"{self.phase.name} stopped before step {iteration + 1}: {name} or its gradient is not a number at texel "
            f"(row {row}, column {column} of {shape}) of texture set {part}, seen in view {view}; "
            "the maps are those of the last good step."
        )


def _mean_direction(beams: Sequence[Directional], camera: Camera) -> Float[np.ndarray, "3"]:
    """Direction of the single light that shades a matt surface like all of these, up to intensity."""
    strength = luminance(np.array([beam.irradiance for beam in beams], np.float32))
    total = strength @ np.stack([direction_in_world(beam, camera) for beam in beams])
    return (total / np.linalg.norm(total)).astype(np.float32)


def shader(settings: FitSettings, gloss: bool) -> Any:
    """The shader for one step's crops, stacked vertically."""
    return Shader((settings.crops * settings.crop_size, settings.crop_size), gloss=gloss, bridge=settings.bridge)


def materials(leaves: "Mapping[str, torch.Tensor]", clay: bool = False) -> "torch.Tensor":
    """Texel values in the shader's column layout: tilt becomes a unit normal, clay a constant albedo."""
    import torch

    tilt = leaves["tilt"]
    z = (1 - tilt.square().sum(dim=1, keepdim=True)).clamp_min(1e-4).sqrt()
    albedo = torch.full_like(leaves["albedo"], CLAY) if clay else leaves["albedo"]
    return torch.cat([albedo, tilt, z, leaves["roughness"], leaves["metallic"]], dim=1)
