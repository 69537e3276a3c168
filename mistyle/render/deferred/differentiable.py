"""Public differentiable renderer: texture maps in, a noise-free picture out, gradients in torch and Dr.Jit.

It shades the result of `integrator.trace`, traced once per camera: one ray through each pixel's centre, direct light
with exact shadows. The reflectance is Mitsuba's `principled` in closed form (`render/deferred/bsdf.py`), so the picture
equals that of `mi.render` with the `direct` integrator. Without noise, finite differences validate its gradients.
"""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera
from mistyle.core.drjit_arrays import LANES, aligned
from mistyle.core.errors import UsageError
from mistyle.core.light import Ambient, Directional, Light, Lights, Point
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.render.deferred import integrator as deferred
from mistyle.render.deferred import split, torch_bridge
from mistyle.render.deferred.image_samples import FrameKind, own, tangents_of
from mistyle.render.mitsuba.device import dr, mi
from mistyle.render.mitsuba.draw import tracer

# Default values of omitted maps: grey, flat, half rough, not metallic.
NEUTRAL = {"albedo": (0.5, 0.5, 0.5), "normal": (0.0, 0.0, 1.0), "roughness": (0.5,), "metallic": (0.0,)}

# One texture set: a record, or NumPy arrays, torch or Dr.Jit tensors by the names of its maps.
MapSet = Maps | Mapping[str, Any]


def lights_of_cameras(lights: Light | Sequence[Light] | Sequence[Sequence[Light]], count: int) -> tuple[Lights, ...]:
    """One rig for each of `count` cameras, from a light, a rig for all of them, or a rig for each."""
    if isinstance(lights, Light):
        lights = (lights,)
    single = [light for light in lights if isinstance(light, Light)]
    if len(single) == len(lights):
        return (tuple(single),) * count
    rigs = tuple(tuple(rig) for rig in lights if not isinstance(rig, Light))
    if single or len(rigs) != count:
        raise UsageError(f"found {len(rigs)} rigs and {len(single)} lights for {count} cameras; expected one rig for"
                         " all cameras, or one for each")  # fmt: skip
    return rigs


class Renderer:
    """Pictures of known cameras under known lights as a differentiable function of the material.

    Not supported: environment maps and spherical Gaussians, indirect light, antialiasing, gradients by geometry, camera
    or light. Ambient light is unoccluded and summed over 16 directions (errors up to 0.03 of its radiance).

        renderer = Renderer(mesh, cameras, lights)
        albedo = torch.full((128, 128, 3), 0.5, requires_grad=True)
        loss = (renderer.image({"albedo": albedo}, 0) - photograph).square().mean()
        loss.backward()
    """

    def __init__(
        self,
        mesh: Mesh | Asset,
        cameras: Camera | Sequence[Camera],
        lights: Light | Sequence[Light] | Sequence[Sequence[Light]],
        *,
        shadows: bool = True,
        frame: FrameKind = "mikkt",
    ) -> None:
        """Trace `mesh` (with UVs, in working space) from every camera; the cameras may differ in size.

        lights   directional, point and ambient lights: one rig for all cameras, or one for each
        shadows  whether the mesh shadows itself
        frame    of the normal map: MikkTSpace as glTF and the fits have it, or "mitsuba": dp/du of each face

        Raises UsageError for other kinds of light.
        """
        self.mesh = mesh.mesh if isinstance(mesh, Asset) else mesh
        self.cameras = (cameras,) if isinstance(cameras, Camera) else tuple(cameras)
        self.lights = lights_of_cameras(lights, len(self.cameras))
        unsupported = {
            type(x).__name__ for rig in self.lights for x in rig if not isinstance(x, Directional | Point | Ambient)
        }
        if unsupported:
            raise UsageError(
                f"Renderer: found {', '.join(sorted(unsupported))}; expected Directional, Point and Ambient lights. "
                "render_views supports the others, without gradients."
            )
        traced, tangents = tracer(self.mesh), tangents_of(self.mesh, frame)
        self._surfaces = [deferred.trace(traced, [camera], tangents) for camera in self.cameras]
        self._lit = [
            deferred.light(traced, surface, rig, shadows=shadows)
            for surface, rig in zip(self._surfaces, self.lights, strict=True)
        ]
        self._taps: dict[Any, torch_bridge.Taps] = {}
        self._wrapped: dict[int, Any] = {}

    def __len__(self) -> int:
        return len(self.cameras)

    def mask(self, camera: int = 0) -> Bool[np.ndarray, "h w"]:
        """Mask of pixels whose centres see the mesh."""
        return self._surfaces[camera].mask.reshape(self.cameras[camera].size)

    def image(self, maps: MapSet | Sequence[MapSet], camera: int = 0) -> Any:
        """The picture (h, w, 3) of camera number `camera`: linear Rec.709 radiance, black beside the mesh.

        `maps` is one set per texture set of the mesh (a single one where it has one): a `Maps` record, or a mapping
        with any of

            albedo     (r, c, 3)  linear Rec.709, 0..1
            normal     (r, c, 3)  tangent space, +Y, any length > 0; z > 0
            roughness  (r, c)     perceptual, 0..1; no gradient below 0.032
            metallic   (r, c)     0..1

        Row 0 is v = 1; values are fetched bilinearly, textures repeat, nothing is clamped. An omitted map is neutral
        (0.5, flat, 0.5, 0). The picture has the maps' type: NumPy arrays give a NumPy array, torch tensors a torch
        tensor (float32, on the CPU) through `dr.wrap`, Dr.Jit tensors an `mi.TensorXf` with its own AD. Arrays and
        tensors of one kind may be mixed. Torch's gradients have the same bytes in every run; Dr.Jit's are summed
        atomically, in any order. Raises ValueError for maps of wrong shapes and unknown names.
        """
        sets = [maps] if isinstance(maps, Maps | Mapping) else list(maps)
        if len(sets) != len(self.mesh.parts):
            raise ValueError(f"{len(sets)} sets of maps came for {len(self.mesh.parts)} texture sets")
        tables = [_maps_of(one) for one in sets]
        values = [value for table in tables for value in table.values()]
        sizes = tuple(_size(table) for table in tables)
        where = self._where(camera, sizes)
        if any(_is_torch(value) for value in values):
            return self._torch_image(tables, sizes, where, camera)
        if any(_is_drjit(value) for value in values):
            return self._drjit_image(tables, sizes, where, camera)
        table = np.concatenate([_numpy_table(t, size) for t, size in zip(tables, sizes, strict=True)])
        return self._plain_image(torch_bridge.bilinear(table, where), camera)

    def _where(self, camera: int, sizes: tuple[tuple[int, int], ...]) -> torch_bridge.Taps:
        if (camera, sizes) not in self._taps:
            self._taps[camera, sizes] = torch_bridge.taps(self._surfaces[camera], sizes)
        return self._taps[camera, sizes]

    def _plain_image(self, pixels: Float[np.ndarray, "n 8"], camera: int) -> Float[np.ndarray, "h w 3"]:
        packed = own(mi.Float, np.ascontiguousarray(pixels, np.float32).ravel())
        return np.array(split.radiance(self._lit[camera], packed)).reshape(*self.cameras[camera].size, 3)

    def _torch_image(self, tables: Sequence[Mapping[str, Any]], sizes, where: torch_bridge.Taps, camera: int) -> Any:
        """The fetch as a sparse product, whose gradient has a fixed order, then shading of each pixel."""
        import torch

        def column(table: Mapping[str, Any], name: str, size: tuple[int, int]) -> Any:
            value = table[name]
            flat = value if _is_torch(value) else torch.from_numpy(np.ascontiguousarray(value, np.float32))
            return flat.to("cpu", torch.float32).reshape(size[0] * size[1], -1)

        rows = [
            torch.cat([column(table, name, size) for name in torch_bridge.CHANNELS], dim=1)
            for table, size in zip(tables, sizes, strict=True)
        ]
        pixels = torch_bridge.fetch(torch.cat(rows)[torch.from_numpy(where.texels)], where)
        if not pixels.requires_grad:
            return torch.from_numpy(self._plain_image(pixels.numpy(), camera))
        if camera not in self._wrapped:
            lit, shape = self._lit[camera], (*self.cameras[camera].size, 3)
            self._wrapped[camera] = dr.wrap(source="torch", target="drjit")(
                lambda packed: mi.TensorXf(split.radiance(lit, packed.array), shape)
            )
        # Dr.Jit reads torch's memory beyond its end (core/drjit_arrays.py).
        padded = torch.nn.functional.pad(pixels.reshape(-1), (0, LANES))[: pixels.numel()]
        return self._wrapped[camera](padded).clone()

    def _drjit_image(self, tables: Sequence[Mapping[str, Any]], sizes, where: torch_bridge.Taps, camera: int) -> Any:
        """The fetch by gathers, one channel at a time."""
        on, count = self._surfaces[camera].mask, len(self._surfaces[camera].mask)
        texel, weight = np.zeros((count, 4), np.uint32), np.zeros((count, 4), np.float32)
        texel[on] = where.texels[where.matrix.indices].reshape(-1, 4)
        weight[on] = where.matrix.data.reshape(-1, 4)
        texels = [mi.UInt32(aligned(column, np.uint32)) for column in texel.T]
        weights = [mi.Float(aligned(column)) for column in weight.T]
        values = []
        for name, channels in torch_bridge.CHANNELS.items():
            flat = [_drjit_map(table[name]) for table in tables]
            whole = flat[0] if len(flat) == 1 else dr.concat(flat)
            for k in range(channels):
                taps = [dr.gather(mi.Float, whole, t * channels + k) * w for t, w in zip(texels, weights, strict=True)]
                values.append(taps[0] + taps[1] + taps[2] + taps[3])
        image = split.radiance(self._lit[camera], dr.ravel(mi.ArrayXf(values)))
        return mi.TensorXf(image, (*self.cameras[camera].size, 3))


def _maps_of(one: MapSet) -> dict[str, Any]:
    """All maps by name, neutral ones for those that are omitted; at least one with consistent shapes is given."""
    named = vars(one) if isinstance(one, Maps) else dict(one)
    unknown = sorted(set(named) - {*NEUTRAL, "known"})
    maps = {name: named[name] for name in NEUTRAL if name in named}
    if unknown or not maps:
        raise ValueError(f"maps are called {', '.join(map(repr, unknown)) or 'nothing'}; expected {', '.join(NEUTRAL)}")
    size = _size(maps)
    for name, value in maps.items():
        shape, channels = tuple(value.shape), len(NEUTRAL[name])
        if shape not in {(*size, channels), size if channels == 1 else None}:
            raise ValueError(f"{name} has the shape {shape}; expected {(*size, 3) if channels == 3 else size}")
    neutral = {name: np.broadcast_to(np.float32(value), (*size, len(value))) for name, value in NEUTRAL.items()}
    return neutral | maps


def _size(maps: Mapping[str, Any]) -> tuple[int, int]:
    rows, columns = next(iter(maps.values())).shape[:2]
    return int(rows), int(columns)


def _is_torch(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _is_drjit(value: Any) -> bool:
    return bool(dr.is_tensor_v(value))


def _numpy_table(maps: Mapping[str, Any], size: tuple[int, int]) -> Float[np.ndarray, "t 8"]:
    count = size[0] * size[1]
    return np.concatenate([maps[name].reshape(count, -1) for name in torch_bridge.CHANNELS], axis=1, dtype=np.float32)


def _drjit_map(value: Any) -> Any:
    """The flat values of one map."""
    return value.array if _is_drjit(value) else mi.Float(aligned(np.asarray(value, np.float32).ravel()))
