"""Nine small Mitsuba scenes whose parameters are known: each as a dictionary for `mi.load_dict`, true or at its start.

References and fits use the same scene with other values. Names are those of the parameters that are fitted.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mistyle.render.mitsuba import device

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """`make(values, size)` is the scene with these values by parameter name; `true` and `start` are such values.

    images  what is fitted are textures or attributes: judged in dB, over the numbers that cameras see
    """

    name: str
    make: Callable[[Values, int], Any]
    true: Values
    start: Values
    images: bool = False


def rgb(values: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in values]}


def bitmap(values: np.ndarray, **more: Any) -> dict[str, Any]:
    import mitsuba as mi

    device.use()
    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(values, np.float32)), "raw": True, **more}


def camera(origin: Any, target: Any, size: int, fov: float = 40.0) -> dict[str, Any]:
    import mitsuba as mi

    device.use()
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": to_world, "film": film}


def placed(*, at: Any = (0, 0, 0), scale: float = 1.0, turn: float = 0.0) -> Any:
    import mitsuba as mi

    device.use()
    return mi.ScalarTransform4f().translate(list(at)).rotate([1, 0, 0], turn).scale(scale)


def room(size: int, **more: Any) -> Any:
    """A floor and a lamp, whose light comes back from surfaces too, and one camera unless `more` has others."""
    import mitsuba as mi

    device.use()
    base = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "floor": {
            "type": "rectangle",
            "to_world": placed(at=(0, -1, 0), scale=4, turn=-90),
            "bsdf": {"type": "diffuse"},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": placed(at=(0, 3, 0), turn=90),
            "emitter": {"type": "area", "radiance": rgb([9, 9, 9])},
        },
        "sky": {"type": "constant", "radiance": rgb([0.3, 0.35, 0.4])},
    }
    if not any(name.startswith("cam") for name in more):
        more["cam"] = camera((0, 1.2, 5), (0, -0.1, 0), size)
    return mi.load_dict(base | more, optimize=False)


def smooth(shape: tuple[int, int, int], low: float, high: float, seed: int) -> np.ndarray:
    """A random texture without high frequencies."""
    import cv2

    coarse = np.random.default_rng(seed).random((max(shape[0] // 4, 2), max(shape[1] // 4, 2), shape[2]))
    fine = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC).reshape(shape)
    return np.clip(low + (high - low) * fine, low, high).astype(np.float32)


def cornell(values: Values, size: int) -> Any:
    import mitsuba as mi

    device.use()
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": size, "height": size}
    box["integrator"] = {"type": "path", "max_depth": 6}
    for name in ("white", "green", "red"):
        box[name]["reflectance"] = rgb(values[f"{name}.reflectance.value"])
    return mi.load_dict(box, optimize=False)


def dielectric(values: Values, size: int) -> Any:
    bsdf = {
        "type": "roughdielectric",
        "distribution": "ggx",
        "alpha": float(values["ball.bsdf.alpha.value"][0]),
        "specular_transmittance": rgb(values["ball.bsdf.specular_transmittance.value"]),
    }
    return room(size, ball={"type": "sphere", "radius": 0.9, "bsdf": bsdf})


TRUE_PAINT = smooth((16, 16, 3), 0.1, 0.8, 1)
PLACES = ((0.0, 1.2, 5.0), (3.0, 1.0, 3.5), (-3.0, 1.0, 3.5), (0.0, 3.5, 3.0))


def principled(values: Values, size: int) -> Any:
    paint = bitmap(values["wall.bsdf.brdf_0.base_color.data"], wrap_mode="clamp")
    bsdf = {"type": "twosided", "bsdf": {"type": "principled", "base_color": paint, "roughness": 0.4}}
    wall = {"type": "rectangle", "bsdf": bsdf}
    views = {f"cam{k}": camera(place, (0, 0, 0), size, 28) for k, place in enumerate(PLACES)}
    return room(size, wall=wall, **views)


TRUE_SKY = smooth((8, 16, 3), 0.2, 1.0, 2)


def sky(values: Values, size: int) -> Any:
    import mitsuba as mi

    device.use()
    shown = np.asarray(values["sky.data"], np.float32)
    # Mitsuba adds a column at either end of what it is given.
    light = {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(shown[:, 1:-1] if shown.shape[1] == 18 else shown)),
    }
    sides = ((0, 0, 1), (1, 0, 0.001), (0, 0, -1), (-1, 0, 0.001), (0.001, 1, 0.01), (0.001, -1, 0.01))
    views = {f"cam{k}": camera((0, 0, 0), side, size, 95) for k, side in enumerate(sides)}
    ball = {"type": "sphere", "center": [0.0, -0.6, 2.0], "radius": 0.5, "bsdf": {"type": "diffuse"}}
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 3}, "sky": light, "ball": ball}
    return mi.load_dict(scene | views, optimize=False)


def instances(values: Values, size: int) -> Any:
    bsdf = {"type": "diffuse", "reflectance": rgb(values["group.shape.bsdf.reflectance.value"])}
    group = {"type": "shapegroup", "shape": {"type": "sphere", "radius": 0.6, "bsdf": bsdf}}
    ref = {"type": "ref", "id": "group"}
    copies = {
        f"copy{k}": {"type": "instance", "shapegroup": ref, "to_world": placed(at=(x, -0.4, 0))}
        for k, x in enumerate((-1.3, 0, 1.3))
    }
    return room(size, group=group, **copies)


def mask(values: Values, size: int) -> Any:
    inner = {"type": "diffuse", "reflectance": rgb(values["wall.bsdf.nested_bsdf.brdf_0.reflectance.value"])}
    inner = {"type": "twosided", "bsdf": inner}
    return room(size, wall={"type": "rectangle", "bsdf": {"type": "mask", "opacity": 0.8, "nested": inner}})


SIDE = 7  # vertices of the mesh with an attribute
TRUE_VERTICES = smooth((SIDE, SIDE, 3), 0.1, 0.8, 3).reshape(-1)


def attribute(values: Values, size: int) -> Any:
    import mitsuba as mi

    device.use()
    props = mi.Properties()
    texture = {"type": "mesh_attribute", "name": "vertex_paint"}
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}})
    rows, columns = np.mgrid[:SIDE, :SIDE].reshape(2, -1)
    place = np.stack([columns / (SIDE - 1) * 2 - 1, rows / (SIDE - 1) * 2 - 1, 0 * rows], axis=1)
    first = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + 1, first + SIDE + 1], 1), np.stack([first, first + SIDE + 1, first + SIDE], 1)]
    )
    mesh = mi.Mesh("wall", SIDE * SIDE, len(faces), props=props)
    table: Any = mi.traverse(mesh)
    table["vertex_positions"], table["faces"] = (
        mi.Float(place.ravel().astype(np.float32)),
        mi.UInt32(faces.ravel().astype(np.uint32)),
    )
    table.update()
    mesh.add_attribute("vertex_paint", 3, [float(v) for v in values["wall.vertex_paint"]])
    mesh.set_id("wall")
    return room(size, wall=mesh, cam=camera((0, 0.6, 4), (0, 0, 0), size, 38))


def custom(values: Values, size: int) -> Any:
    paint = rgb(values["wall.bsdf.paint.value"])
    return room(size, wall={"type": "rectangle", "bsdf": {"type": registered(), "paint": paint}})


def registered() -> str:
    """A BSDF of one's own: diffuse, its reflectance the square root of a texture. Registered once."""
    import drjit as dr
    import mitsuba as mi

    device.use()
    door: Any = mi

    class Root(door.BSDF):
        def __init__(self, props: Any) -> None:
            door.BSDF.__init__(self, props)
            given = props["paint"]
            # Mitsuba hands a plain colour over as three numbers.
            self.paint = given if isinstance(given, mi.Texture) else mi.load_dict(rgb(given))
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flags], flags

        def traverse(self, callback: Any) -> None:
            callback.put("paint", self.paint, mi.ParamFlags.Differentiable)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            sample = door.BSDFSample3f()
            sample.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            sample.pdf = mi.warp.square_to_cosine_hemisphere_pdf(sample.wo)
            sample.eta = 1.0
            sample.sampled_type = door.UInt32(+mi.BSDFFlags.DiffuseReflection)
            sample.sampled_component = door.UInt32(0)
            return sample, dr.sqrt(self.paint.eval(si, active)) & (active & (si.wi.z > 0))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            up = active & (si.wi.z > 0) & (wo.z > 0)
            return dr.sqrt(self.paint.eval(si, active)) * dr.inv_pi * wo.z & up

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    name = "root_diffuse_of_a_benchmark"
    try:
        mi.register_bsdf(name, Root)
    except RuntimeError as error:
        if "already" not in str(error):
            raise
    return name


INCLUDE = '<scene version="3.0.0"><bsdf type="diffuse" id="paint"><rgb name="reflectance" value="{}"/></bsdf></scene>'
HOUSE = """<scene version="3.0.0"><default name="size" value="64"/>
<integrator type="path"><integer name="max_depth" value="5"/></integrator>
<sensor type="perspective" id="cam"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,1.2,5" target="0,-0.1,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/>
<string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
<emitter type="constant" id="sky"><rgb name="radiance" value="0.5"/></emitter>
<include filename="paint.xml"/>
<shape type="sphere" id="ball"><float name="radius" value="0.9"/><ref id="paint"/></shape>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/>
<translate y="-1"/></transform><bsdf type="diffuse"/></shape>
</scene>"""

GREY = np.array([0.5, 0.5, 0.5], np.float32)


def cases() -> list[Case]:
    """The scenes that are made from dictionaries: all but the one with an include."""
    box = {
        "white": [0.885809, 0.698859, 0.666422],
        "green": [0.105421, 0.37798, 0.076425],
        "red": [0.570068, 0.0430135, 0.0443706],
    }
    box = {f"{name}.reflectance.value": np.array(v) for name, v in box.items()}
    glass = {
        "ball.bsdf.alpha.value": np.array([0.3]),
        "ball.bsdf.specular_transmittance.value": np.array([0.9, 0.6, 0.3]),
    }
    behind = "wall.bsdf.nested_bsdf.brdf_0.reflectance.value"
    return [
        Case("cornell_box", cornell, box, dict.fromkeys(box, GREY)),
        Case(
            "rough_dielectric",
            dielectric,
            glass,
            {**dict.fromkeys(glass, GREY), "ball.bsdf.alpha.value": np.array([0.15])},
        ),
        Case("principled_bitmap", principled, *_images("wall.bsdf.brdf_0.base_color.data", TRUE_PAINT), images=True),
        Case("environment", sky, *_images("sky.data", TRUE_SKY), images=True),
        Case("instances", instances, *_colour("group.shape.bsdf.reflectance.value", (0.2, 0.7, 0.3))),
        Case("mask", mask, *_colour(behind, (0.7, 0.3, 0.15))),
        Case("mesh_attribute", attribute, *_images("wall.vertex_paint", TRUE_VERTICES), images=True),
        Case("custom_bsdf", custom, *_colour("wall.bsdf.paint.value", (0.6, 0.3, 0.1))),
    ]


def _colour(name: str, true: Any) -> tuple[Values, Values]:
    return {name: np.array(true)}, {name: GREY}


def _images(name: str, true: np.ndarray) -> tuple[Values, Values]:
    return {name: true}, {name: np.full_like(true, 0.5)}
