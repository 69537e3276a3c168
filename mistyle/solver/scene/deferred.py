"""Noise-free gradients of a live Mitsuba scene by the deferred renderer (`render/deferred/renderer.py`).

All lights must be points or directions, the integrator must render direct light only, and films need a box filter.
The fitted parameters must be maps (or literals) of plain `principled` materials on meshes. Other shapes cast
shadows; pixels that see their materials are masked. Mitsuba does not expose some plugin settings (wrapping, shadowing
of normal maps), so renders of both are compared. If they disagree, `prb` is used and a note gives the reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mistyle.core.camera import MITSUBA_FROM_OPENCV, Camera
from mistyle.core.capture import in_memory
from mistyle.core.image import dilate
from mistyle.core.light import Directional, Point
from mistyle.core.mesh import Mesh
from mistyle.core.rows import evenly
from mistyle.render.deferred.material_table import ALBEDO, COLUMNS, METALLIC, ROUGHNESS, TILT
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live import walk as scene_walk
from mistyle.render.live.parameters import Parameter
from mistyle.render.mitsuba.device import mi
from mistyle.render.mitsuba.draw import Tracer, gbuffer, tracer
from mistyle.solver.scene import gradients as scene_grad

ROLES = {
    "base_color": ALBEDO,
    "normalmap": TILT,
    "roughness": slice(ROUGHNESS, ROUGHNESS + 1),
    "metallic": slice(METALLIC, METALLIC + 1),
}
# Lobes of `principled` that the fast path lacks.
ABSENT = ("anisotropic", "spec_trans", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat")
CHECKS = 3  # cameras whose renders are compared
CHECK_SPP = 64
MANY_PIXELS = 1 << 18  # picture size from which the check takes fewer samples
AGREEMENT = 0.01  # largest relative RMS difference beyond the noise


class Unsupported(Exception):
    """The reason why a scene needs Monte Carlo."""


@dataclass(frozen=True)
class MaterialTexels:
    """One shape's material.

    roles     names of `ROLES` -> (key of `mi.traverse`, stored value: (h, w, c), or (n,) of a literal)
    size      (rows, columns) of its textures
    specular  of `principled`
    """

    roles: dict[str, tuple[str, Float[np.ndarray, "..."]]]
    size: tuple[int, int]
    specular: float


class DeferredRenderer:
    """Renders of the scene as a function of the chosen parameters."""

    def __init__(
        self,
        scene: Any,
        chosen: Sequence[Parameter],
        views: Sequence[scene_grad.ReferenceView],
        loss: str,
        engine: Any,
        subsamples: int = 4,
    ) -> None:
        """Raises Unsupported, with a reason, if renders would differ from the scene's; `subsamples` a pixel."""
        if loss not in scene_grad.LOSSES:
            raise Unsupported("the loss is a custom function.")
        self.loss, self.chosen, self.subsamples = loss, tuple(chosen), subsamples
        reasons = scene_keys.fast_shapes(scene, engine)
        self.materials = _materials(scene, reasons)
        lights = tuple(_light(e) for e in scene.emitters())
        held = {key for m in self.materials if m is not None for key, _ in m.roles.values()}
        missing = next((p for p in chosen if p.key not in held), None)
        if missing is not None:
            raise Unsupported(_missing(scene, missing, reasons))
        kinds = {m.specular for m in self.materials if m is not None}
        if len(kinds) > 1:
            raise Unsupported("its materials differ in `specular`.")
        traced = tracer(_mesh(scene))
        cameras = [_camera(view.sensor, k) for k, view in enumerate(views)]
        masks = [self._valid_pixels(traced, camera, view) for camera, view in zip(cameras, views, strict=True)]
        references = [np.array(view.reference) for view in views]
        captures = in_memory(cameras, [lights] * len(cameras), references, masks)
        self.shares = [max(view.share, 1e-9) for view in views]
        self.renderer = self._best_variant(scene, traced, captures, views, engine, kinds.pop())

    def gradients(self, values: Mapping[str, np.ndarray], k: int) -> tuple[float, dict[str, np.ndarray]]:
        """Noise-free loss of camera k and its gradient by key, like `gradients.gradients`.

        Pixels beside the fitted materials do not contribute to the loss.
        """
        value, gradient = self.renderer.step(self._table(values), [k], self.loss)
        rows = np.array(gradient).reshape(-1, COLUMNS) / np.float32(self.shares[k])
        result = {p.key: np.zeros(p.shape, np.float32) for p in self.chosen}
        start = 0
        for material in self.materials:
            count = 4 if material is None else int(np.prod(material.size))
            part = rows[start : start + count]
            start += count
            for role, (key, _) in material.roles.items() if material is not None else ():
                if key in result:
                    result[key] += _stored_gradient(role, part[:, ROLES[role]], values[key])
        return float(np.array(value)[0]) / self.shares[k], result

    def _table(self, values: Mapping[str, np.ndarray]) -> Float[np.ndarray, "t 8"]:
        parts = []
        for material in self.materials:
            rows = np.zeros((4 if material is None else int(np.prod(material.size)), COLUMNS), np.float32)
            rows[:, ROUGHNESS] = 0.5
            for role, (key, stored) in material.roles.items() if material is not None else ():
                value = values.get(key, stored)
                flat = value.reshape(-1, value.shape[-1]) if value.ndim == 3 else value[None]
                if role == "normalmap":
                    flat = _unit(flat)[:, :2]
                rows[:, ROLES[role]] = flat
            parts.append(rows)
        return np.concatenate(parts)

    def _valid_pixels(self, traced: Tracer, camera: Camera, view: scene_grad.ReferenceView) -> np.ndarray:
        """Valid pixels: those of the mask that neither see nor touch another material."""
        counts = np.array(view.counts)[..., 0].astype(bool)
        foreign = [k for k, material in enumerate(self.materials) if material is None]
        if foreign:
            counts &= ~dilate(np.isin(gbuffer(traced, camera).part, foreign), 1)
        return counts

    def _best_variant(self, scene: Any, traced: Tracer, captures, views, engine, specular: float) -> Any:
        """The renderer that matches the scene best, over Mitsuba's variants of a normal map."""
        sizes = [(2, 2) if m is None else m.size for m in self.materials]
        bumped = any("normalmap" in m.roles for m in self.materials if m is not None)
        looked = evenly(len(views), CHECKS)
        pairs = {k: [_picture(scene, engine, views[k].sensor, 2 * k + j) for j in (0, 1)] for k in looked}

        def renderer(flip: bool, shadowing: bool, subsamples: int, **more: Any) -> MaterialRenderer:
            options = RenderOptions(
                frame="mitsuba",
                subsamples=subsamples,
                flip_invalid=flip,
                shadowing=shadowing,
                specular=specular,
                **more,
            )
            return MaterialRenderer(traced, captures, sizes, options)

        def error(variant: tuple[bool, bool]) -> float:
            # Both renderers antialias edges differently, so the check takes many samples and stores none.
            fine = [64 if np.prod(captures.cameras[k].size) <= MANY_PIXELS else 16 for k in looked]
            exact = renderer(*variant, min(fine), memory=0)
            table = exact.upload(self._table({}))

            def deviation(k: int) -> float:
                image, coverage = exact.image_and_coverage(table, k)
                return _excess_rms(image, pairs[k], captures.load(k)[1], coverage)

            return max(deviation(k) for k in looked)

        variants = [(f, s) for f in (False, True) for s in (False, True)] if bumped else [(False, False)]
        errors = [error(variant) for variant in variants]
        if min(errors) > AGREEMENT:
            raise Unsupported(f"its pictures differ from the scene's by {min(errors):.1%}.")
        return renderer(*variants[int(np.argmin(errors))], self.subsamples)


def _picture(scene: Any, engine: Any, sensor: Any, seed: int) -> np.ndarray:
    return np.array(scene_grad.picture(scene, engine, sensor, CHECK_SPP, seed))[..., :3]


def _excess_rms(ours: np.ndarray, pair: Sequence[np.ndarray], counts: np.ndarray, coverage: np.ndarray) -> float:
    """RMS difference of two renderers beyond the noise of one, relative to the picture's RMS."""
    at = counts & (coverage > 0.999)
    if not at.any():
        return 0.0
    mean, noise = (pair[0] + pair[1])[at] / 2, np.square(pair[0] - pair[1], dtype=np.float64)[at].mean() / 4
    squared_error = np.square(mean - ours[at], dtype=np.float64).mean()
    # Both also contain noise of sample positions within the pixel; twice the noise covers that.
    return float(np.sqrt(max(squared_error - 2 * noise, 0) / max(np.square(mean, dtype=np.float64).mean(), 1e-30)))


def _unit(stored: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    normal = stored * 2 - 1
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def _stored_gradient(role: str, gradient: Float[np.ndarray, "n c"], value: np.ndarray) -> np.ndarray:
    """The gradient by stored values: literals sum over all texels, encoded normals go through n = unit(2 t - 1)."""
    if role == "normalmap":
        flat = value.reshape(-1, 3)
        length = np.maximum(np.linalg.norm(flat * 2 - 1, axis=-1, keepdims=True), 1e-12)
        normal = _unit(flat)
        along = (gradient * normal[:, :2]).sum(axis=-1, keepdims=True) * normal
        full = np.concatenate([gradient, np.zeros_like(gradient[:, :1])], axis=1)
        gradient = 2 * (full - along) / length
    if value.ndim == 3:
        return gradient.reshape(value.shape)
    total = gradient.sum(axis=0)
    return total if total.shape == value.shape else total.sum(keepdims=True)


def _missing(scene: Any, parameter: Parameter, reasons: Mapping[str, str | None]) -> str:
    first_reason = next((f"{name}: {reason}" for name, reason in reasons.items() if reason is not None), None)
    return first_reason or f"{parameter.name} is not a map of a plain `principled` on a mesh."


def _materials(scene: Any, reasons: Mapping[str, str | None]) -> list[MaterialTexels | None]:
    """One per shape; None where the fast path cannot shade it."""
    keys: dict[Any, str] = {}
    for key, (_, _, node, _) in mi.traverse(scene).properties.items():
        if key.endswith((".data", ".value")):
            keys.setdefault(node, key)
    held = scene_walk.children(scene)
    result = []
    for shape in scene.shapes():
        # A rectangle counts as a mesh but exposes no vertices.
        if "vertex_positions" not in mi.traverse(shape).keys():
            raise Unsupported(f"{shape.id()} is not a mesh ({shape.class_name()}).")
        plain = reasons.get(shape.id()) is None
        result.append(_material(shape, held, keys) if plain else None)
    if all(material is None for material in result):
        raise Unsupported(next(reason for reason in reasons.values() if reason is not None))
    return result


def _material(shape: Any, held: Mapping[Any, list], keys: Mapping[Any, str]) -> MaterialTexels:
    roles: dict[str, tuple[str, np.ndarray]] = {}
    bsdf: Any = shape.bsdf()
    while bsdf.class_name() != "Principled":
        inner = [child for _, child in held[bsdf] if isinstance(child, mi.BSDF)]
        for name, child in held[bsdf]:
            if name == "normalmap":
                roles[name] = _stored(child, keys)
        bsdf = inner[0]
    for name, child in held[bsdf]:
        if name in ROLES:
            roles[name] = _stored(child, keys)
        elif name in ABSENT and np.any(np.array(_stored(child, keys)[1])):
            raise Unsupported(f"the material of {shape.id()} has {name}.")
    sizes = {value.shape[:2] for _, value in roles.values() if value.ndim == 3}
    if len(sizes) > 1:
        raise Unsupported(f"the textures of {shape.id()} differ in size.")
    table = mi.traverse(bsdf)
    own = next((table[key] for key in table.keys() if key == "specular"), None)
    if own is None:
        raise Unsupported(f"the material of {shape.id()} is given by eta, not by specular.")
    size = next(iter(sizes), (2, 2))
    return MaterialTexels(roles, (int(size[0]), int(size[1])), float(np.array(own).ravel()[0]))


def _stored(texture: Any, keys: Mapping[Any, str]) -> tuple[str, np.ndarray]:
    table = mi.traverse(texture)
    if "to_uv" in table.keys() and not np.allclose(np.array(table["to_uv"].matrix).squeeze(), np.eye(3), atol=1e-6):
        raise Unsupported("a texture is transformed (to_uv).")
    name = next((n for n in ("data", "value") if n in table.keys()), None)
    if name is None or texture not in keys:
        raise Unsupported(f"a texture is {texture.class_name()}.")
    value = np.array(table[name], dtype=np.float32)
    return keys[texture], value if name == "data" else value.reshape(-1)


def _light(emitter: Any) -> Directional | Point:
    table = mi.traverse(emitter)
    name = {"DirectionalEmitter": "irradiance", "PointLight": "intensity"}.get(emitter.class_name())
    if name is None or f"{name}.value" not in table.keys():
        raise Unsupported(f"a light is {emitter.class_name()}.")
    colour = np.array(table[f"{name}.value"], dtype=float).ravel()
    red, green, blue = (float(c) for c in (colour if len(colour) == 3 else np.repeat(colour[:1], 3)))
    if name == "intensity":
        x, y, z = (float(v) for v in np.array(table["position"], dtype=float).ravel())
        return Point((x, y, z), (red, green, blue))
    along = np.array(table["to_world"].matrix, dtype=float).squeeze()[:3, 2]
    x, y, z = (float(v) for v in -along / np.linalg.norm(along))
    return Directional((x, y, z), (red, green, blue))


def _camera(sensor: Any, k: int) -> Camera:
    film: Any = sensor.film()
    columns, rows = (int(n) for n in film.size())
    table = mi.traverse(sensor)
    if sensor.class_name() != "PerspectiveCamera" or tuple(film.crop_size()) != tuple(film.size()):
        raise Unsupported(f"sensor {k} is {sensor.class_name()}, or its film is cropped.")
    if film.rfilter().class_name() != "BoxFilter":
        raise Unsupported(f"the film of sensor {k} has {film.rfilter().class_name()}; expected the box filter.")
    number = {
        name: float(np.array(table[name]).ravel()[0]) if name in table.keys() else 0.0
        for name in ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
    }
    world_from_cam = np.array(table["to_world"].matrix, dtype=float).squeeze() @ np.linalg.inv(MITSUBA_FROM_OPENCV)
    world_from_cam[:3, :3] /= np.linalg.norm(world_from_cam[:3, :3], axis=0)
    focal = columns / (2 * np.tan(np.radians(number["x_fov"]) / 2))
    centre = (
        columns * (0.5 - number["principal_point_offset_x"]),
        rows * (0.5 - number["principal_point_offset_y"]),
    )
    return Camera(world_from_cam, float(focal), centre, (rows, columns), f"sensor{k}")


def _mesh(scene: Any) -> Mesh:
    """All shapes as one mesh in the scene's units, one part each."""
    positions, faces, normals, uvs, part, names = [], [], [], [], [], []
    count = 0
    for k, shape in enumerate(scene.shapes()):
        table = mi.traverse(shape)
        vertices = np.array(table["vertex_positions"], dtype=np.float32).reshape(-1, 3)
        face = np.array(table["faces"]).reshape(-1, 3).astype(np.int32)
        own = np.array(table["vertex_normals"], dtype=np.float32).reshape(-1, 3)
        uv = np.array(table["vertex_texcoords"], dtype=np.float32).reshape(-1, 2)
        corners = vertices[face]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
        positions.append(vertices)
        faces.append(face + count)
        normals.append(own[face] if len(own) else np.repeat(flat[:, None], 3, axis=1).astype(np.float32))
        # Mitsuba's texture row 0 is v = 0, ours v = 1.
        uvs.append(
            np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)[face] if len(uv) else np.zeros((len(face), 3, 2), np.float32)
        )
        part.append(np.full(len(face), k, np.int32))
        names.append(shape.id())
        count += len(vertices)
    return Mesh(
        np.concatenate(positions),
        np.concatenate(faces),
        np.concatenate(normals),
        np.concatenate(uvs),
        np.concatenate(part),
        tuple(names),
    )
