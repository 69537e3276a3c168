"""Final refinement of a material fit through `prb`: picture and gradient include indirect light.

Earlier stages know direct light only, or subtract an estimate of indirect light. Here every picture is rendered with
all bounces, and Adam on the Laplacian pyramid of every map (`pyramid.py`) continues from the fitted maps. Gradients are
Monte Carlo estimates, so it is slow and the steps are small.
"""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mistyle.core.capture import Captures
from mistyle.core.drjit_arrays import aligned
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.core.rows import evenly
from mistyle.render.deferred import pyramid as laplacian
from mistyle.render.live import parameters as scene_keys
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.emitters import emitters
from mistyle.solver.scene import gradients as scene_grad

SHARE = 0.7  # of the rate that each coarser level of the pyramid has
LAST_RATE = 0.1  # share of the rate at the end
SOLID = 0.999  # least coverage of a valid pixel: the others mix with the background
JUDGES = 8  # pictures whose loss compares result and start
# Normals have a smaller rate: their encoding halves lengths, and their errors matter most.
RATES = {"albedo": 1.0, "normal": 0.3, "roughness": 1.0, "metallic": 1.0}


@dataclass(frozen=True)
class Polished:
    """maps    the given maps if the loss does not fall
    loss    before and after, mean over the compared pictures
    trace   loss of each step
    """

    maps: tuple[Maps, ...]
    loss: tuple[float, float]
    trace: tuple[float, ...]


@dataclass(frozen=True)
class PolishSettings:
    """Settings of the refinement.

    loss      a name of `gradients.LOSSES`
    rate      of Adam, on the albedo (see RATES)
    metallic  whether it moves too
    depth     path segments at most
    spp       samples a pixel for the picture, `spp_grad` for its gradient
    model     of the surface, and the `frame` of its normal maps, as in `scene.object_shapes`
    """

    steps: int
    loss: str = "log_srgb_l1"
    rate: float = 1e-3
    metallic: bool = False
    depth: int = 6
    spp: int = 16
    spp_grad: int = 4
    model: scenery.Model = "principled"
    frame: scenery.Frame = "mikkt"


def polish(
    mesh: Mesh,
    maps: Sequence[Maps],
    captures: Captures,
    settings: PolishSettings,
    seed: int = 0,
    progress: Callable[[float], None] = lambda done: None,
) -> Polished:
    """Adam from `maps`, one picture a step; see the module.

    Pixels are valid inside the picture's mask where the object covers them fully. Bytes are reproducible with one
    thread only: Mitsuba sums texture gradients in varying order. Roughness stays at or above
    `parameters.ROUGHNESS_FLOOR`.
    """
    device.use()
    job = _Job(mesh, maps, captures, settings)
    steps, spp = settings.steps, settings.spp
    judges = evenly(len(captures), JUDGES)
    first = values = job.values()
    before = job.judge(first, judges, spp, seed)
    moments = {p.key: laplacian.start(p.shape) for p in job.chosen}
    trace = []
    for step in range(steps):
        turn, place = divmod(step, len(captures))
        k = int(np.random.default_rng([seed, turn]).permutation(len(captures))[place])
        value, gradient = job.gradient(values, k, (spp, settings.spp_grad), scene_grad.seeds(seed, step))
        falling = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + np.cos(np.pi * step / steps))
        for p, name in zip(job.chosen, job.names, strict=True):
            usable = np.where(np.isfinite(gradient[p.key]), gradient[p.key], 0)
            change = laplacian.change(moments[p.key], usable, settings.rate * RATES[name] * falling, SHARE)
            values = values | {p.key: scene_keys.project(p, values[p.key] + change)}
        trace.append(value)
        progress((step + 1) / steps)
    after = job.judge(values, judges, spp, seed)
    better = after < before
    return Polished(tuple(job.maps(values)) if better else tuple(maps), (before, after), tuple(trace))


class _Job:
    """The object with its textures, which all scenes share, and one lazily built scene per picture."""

    def __init__(self, mesh: Mesh, maps: Sequence[Maps], captures: Captures, settings: PolishSettings) -> None:
        self.start, self.captures, self.loss = tuple(maps), captures, scene_grad.LOSSES[settings.loss]
        self.shapes = scenery.object_shapes(mesh, maps, model=settings.model, frame=settings.frame)
        engine = {"type": "prb", "max_depth": settings.depth, "rr_depth": settings.depth + 1, "hide_emitters": True}
        self.engine = mi.load_dict(engine)
        self._environments: dict[tuple[int, ...], list[Any]] = {}
        moving = [n for n in RATES if n != "metallic" or settings.metallic]
        parts = [p for p in range(len(maps)) if f"part{p}" in self.shapes]
        places = {scenery.parameters(p)[name]: (p, name) for p in parts for name in moving}
        moved = scene_keys.match(self.scene(0), list(places))
        gc.collect()  # frees that scene: with two scenes alive, Dr.Jit compiles other kernels
        self.places = [places[p.key] for p in moved]
        self.names = [name for _, name in self.places]
        # The parameter is a normal map even if its plugin is one of ours.
        self.chosen = [
            replace(p, owner="NormalMap") if name == "normal" else p for p, name in zip(moved, self.names, strict=True)
        ]

    def scene(self, k: int) -> Any:
        """The scene of picture k."""
        camera = self.captures.cameras[k]
        described = {"type": "scene", "sensor": scenery.sensor_dict(camera, 16), **self.shapes}
        described |= {f"light{j}": light for j, light in enumerate(self._lights(k))}
        return mi.load_dict(described, optimize=False)

    def _lights(self, k: int) -> list[Any]:
        """The lights of picture k. Environment maps are cached; other lights may depend on the camera and load fast."""
        lights, camera = self.captures.lights[k], self.captures.cameras[k]
        key = tuple(map(id, lights))
        if key in self._environments:
            return self._environments[key]
        emitter_dicts = emitters(lights, camera)
        if all(light["type"] == "envmap" for light in emitter_dicts):
            emitter_dicts = self._environments[key] = [mi.load_dict(light) for light in emitter_dicts]
        return emitter_dicts

    def values(self) -> dict[str, np.ndarray]:
        """The start values by key."""
        result = {}
        for p, (part, name) in zip(self.chosen, self.places, strict=True):
            grid = getattr(self.start[part], name)
            grid = grid * 0.5 + 0.5 if name == "normal" else grid
            result[p.key] = scene_keys.project(p, np.asarray(grid, np.float32).reshape(p.shape))
        return result

    def maps(self, values: dict[str, np.ndarray]) -> list[Maps]:
        """The start maps with `values` in place of their own."""
        result = list(self.start)
        for p, (part, name) in zip(self.chosen, self.places, strict=True):
            grid = values[p.key]
            if name == "normal":
                grid = grid * 2 - 1
                grid = grid / np.linalg.norm(grid, axis=-1, keepdims=True)
            grid = grid[..., 0] if name in ("roughness", "metallic") else grid
            result[part] = replace(result[part], **{name: np.ascontiguousarray(grid, np.float32)})
        return result

    def _render_pair(self, scene: Any, k: int, spp: int, seed: int) -> tuple[Any, Any]:
        """The picture and its reference."""
        sensor = scene.sensors()[0]
        shown = scene_grad.picture(scene, self.engine, sensor, spp, seed)
        rgb, mask = self.captures.load(k)
        counts = mask & (np.array(shown)[..., 3] > SOLID)
        clean = np.ascontiguousarray(np.where(counts[..., None], rgb, 0), np.float32)
        wide = mi.TensorXb(aligned(np.broadcast_to(counts[..., None], clean.shape), bool))
        share = max(float(counts.mean()), 1e-9)
        # These weights belong to the relative loss, which this stage does not support.
        return shown, scene_grad.ReferenceView(sensor, mi.TensorXf(aligned(clean)), wide, None, share)

    def gradient(self, values, k: int, spp: tuple[int, int], seeds: tuple[int, int]):
        """Loss of picture k and its gradient by key."""
        scene = self.scene(k)
        table = self._table(scene)
        moving = scene_grad.put(table, self.chosen, values, grad=True)
        shown, view = self._render_pair(scene, k, spp[0], seeds[0])
        value, pixels, _ = scene_grad.compare(shown, view, self.loss)
        self.engine.render_backward(scene, table, pixels, view.sensor, seed=dr.opaque(mi.UInt32, seeds[1]), spp=spp[1])
        return value, {p.key: scene_grad.array(dr.grad(moving[p.key]), p) for p in self.chosen}

    def judge(self, values, pictures: Sequence[int], spp: int, seed: int) -> float:
        """Mean loss of some pictures, with fixed random numbers."""

        def one(k: int) -> float:
            # A function, so that each scene is freed before the next is built.
            scene = self.scene(k)
            scene_grad.put(self._table(scene), self.chosen, values)
            shown, view = self._render_pair(scene, k, 4 * spp, scene_grad.seeds(seed, 2**31 + k)[0])
            return scene_grad.compare(shown, view, self.loss)[0]

        return float(np.mean([one(k) for k in pictures]))

    def _table(self, scene: Any) -> Any:
        table = mi.traverse(scene)
        table.properties = {p.key: table.properties[p.key] for p in self.chosen}
        return table
