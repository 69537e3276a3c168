"""Light crosses surfaces by their opacity: pictures agree with Mitsuba's `volpath` and with closed forms."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mistyle.core.light import Ambient, Directional
from mistyle.io.read_mesh import read_mesh
from mistyle.render.lookdev import scenes as lookdev
from mistyle.render.mitsuba import appearance, device
from mistyle.render.mitsuba.device import mi
from tests.io.gltf.test_read_gltf import square
from tests.render.mitsuba.test_appearance import drawn, middle, pbr, rgba

DEPTH, SIZE, CELL, RENDERS, SPP = 6, 32, 8, 8, 128
OPACITIES = {"clear": 0.0, "half": 0.5, "opaque": 1.0, "cut out": None}
MOST_SIGMAS = 4.3  # of 16 regions: exceeded by chance in one of 3,500 pictures


def grey(value: float) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}}


def rectangle(place: Any, bsdf: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf, **more}


def chequered() -> dict[str, Any]:
    rows, columns = np.mgrid[:32, :32] // 4
    data = np.ascontiguousarray(((rows + columns) % 2).astype(np.float32)[..., None])
    return {"type": "bitmap", "data": mi.TensorXf(data), "raw": True, "filter_type": "nearest"}


def card(opacity: float | None, height: float, shift: float = 0.0) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([shift, shift / 2, height]) @ mi.ScalarTransform4f().scale(0.8)
    masked = {"type": "mask", "opacity": chequered() if opacity is None else opacity, "nested": grey(0.6)}
    return rectangle(place, masked)


def lamp(kind: str) -> dict[str, Any]:
    to = mi.ScalarTransform4f
    if kind == "delta":
        return {"type": "directional", "direction": [0.2, 0.3, -1], "irradiance": 3.0}
    if kind == "area":
        place = to().look_at(origin=[1, -1, 3], target=[0, 0, 0], up=[0, 1, 0]) @ to().scale(0.4)
        return rectangle(place, grey(0.0), emitter={"type": "area", "radiance": 20.0})
    radiance = np.full((32, 64, 3), 0.3, np.float32)
    radiance[8:11, 20:24] = 60  # a small bright lamp, which BSDF samples rarely find
    return {"type": "envmap", "bitmap": mi.Bitmap(radiance), "to_world": to().rotate([1, 0, 0], 90)}


def room(light: dict[str, Any], cards: list[dict[str, Any]]) -> Any:
    """A floor and a glossy wall, cards over the floor, seen from above at an angle."""
    to = mi.ScalarTransform4f
    gloss = {"type": "principled", "roughness": 0.3, "metallic": 0.8}
    wall = to().look_at(origin=[0, 1.5, 1], target=[0, 0, 1], up=[0, 0, 1]) @ to().scale([2, 1, 1])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = to().look_at(origin=[0, -5, 3.5], target=[0, 0, 0.5], up=[0, 0, 1])
    described = {
        "type": "scene",
        "floor": rectangle(to().scale(3), grey(0.6)),
        "wall": rectangle(wall, {"type": "twosided", "bsdf": gloss}),
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "light": light,
    }
    return mi.load_dict(described | {f"card{k}": each for k, each in enumerate(cards)})


def regions(scene: Any, integrator: Any, first: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean of every region over independent renders, and the variance of that mean; last, those of the picture."""
    pictures = [mi.render(scene, integrator=integrator, spp=SPP, seed=first + k) for k in range(RENDERS)]
    cells = np.array(pictures, np.float64)[..., :3].mean(axis=-1).reshape(RENDERS, SIZE // CELL, CELL, -1, CELL)
    means = cells.mean(axis=(2, 4)).reshape(RENDERS, -1)
    means = np.concatenate([means, means.mean(axis=1, keepdims=True)], axis=1)
    # Variances of pixels add up: they are better estimates than those of a few renders' means.
    spread = cells.var(axis=0, ddof=1).mean(axis=(1, 3)).reshape(-1) / CELL**2
    return means.mean(axis=0), np.append(spread, spread.mean() / len(spread)) / RENDERS


@pytest.mark.parametrize("opacity", OPACITIES)
@pytest.mark.parametrize("kind", ["delta", "environment", "area"])
def test_shadows_agree_with_volpath(kind: str, opacity: str) -> None:
    device.use()
    cards = [card(OPACITIES[opacity], 0.6), card(0.3, 0.8, 0.3)]
    scene = room(lamp(kind), cards)
    reference = {"type": "volpath", "max_depth": DEPTH, "rr_depth": 1000, "hide_emitters": True}
    expected, noise = regions(scene, mi.load_dict(reference), 0)
    found, more = regions(scene, appearance.classes(mi.variant())["Path"](DEPTH, True), 1000)
    assert np.abs((found - expected) / np.sqrt(noise + more)).max() < MOST_SIGMAS
    assert found[-1] == pytest.approx(expected[-1], rel=0.01)
    # Emitter sampling finds the light behind the cards: the noise is that of volpath.
    assert more[-1] < 1.3 * noise[-1]


@pytest.mark.parametrize(("count", "share"), [(1, 0.75), (3, 0.75**3), (appearance.PASSED + 1, 0)])
def test_a_delta_light_crosses_cards_by_their_opacity(count: int, share: float) -> None:
    """Beside the cards the floor has its albedo times E cos / π, behind them the transmitted share of it."""
    device.use()
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 3.0}
    scene = room(sun, [card(0.25, 0.5 + 0.01 * k) for k in range(count)])
    integrator = appearance.classes(mi.variant())["Path"](2, True)
    rays = mi.Ray3f(mi.Point3f([0, -2], [0, -2], 0.4), mi.Vector3f(0, 0, -1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 2)
    radiance = np.array(integrator.sample(scene, sampler, rays)[0])
    open_floor = 0.6 * 3 / np.pi
    assert radiance[0] == pytest.approx([open_floor * share, open_floor], rel=1e-5)


def table_and_screen(folder: Path, screen: dict[str, Any]) -> Any:
    """Two parallel squares, one half a unit before the other with the material `screen`, as a glTF file's asset."""
    from PIL import Image

    file = square(material=0)
    front = {**file.tree["meshes"][0]["primitives"][0], "material": 1}
    file.tree["meshes"].append({"primitives": [front]})
    file.tree["nodes"].append({"mesh": 1, "translation": [0, 0, 0.5]})
    file.tree["scenes"][0]["nodes"] = [0, 1]
    Image.fromarray(rgba((255, 255, 255, 0), (255, 255, 255, 0))).save(folder / "a.png")
    file.tree |= {"textures": [{"source": 0}], "images": [{"uri": "a.png"}]}
    file.tree["materials"] = [{"pbrMetallicRoughness": pbr()}, screen]
    return read_mesh(file.save(folder / "a.gltf"), size=64)


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
def test_a_transparent_part_of_a_file_casts_no_shadow(mode: str, tmp_path: Path) -> None:
    """What alpha 0 covers looks as if nothing were before it, under a hard key light and its ambient light."""
    screen = {"alphaMode": mode, "pbrMetallicRoughness": pbr(baseColorTexture={"index": 0})}
    light = (Directional((0.0, 0.0, 1.0), (2.5, 2.5, 2.5)), Ambient((0.15, 0.15, 0.15)))
    behind = middle(drawn(table_and_screen(tmp_path, screen), light, spp=256))
    alone = square(material=0)
    alone.tree["materials"] = [{"pbrMetallicRoughness": pbr()}]
    bare = middle(drawn(read_mesh(alone.save(tmp_path / "b.gltf"), size=64), light, spp=256))
    assert behind[3] == 1 and behind[:3] == pytest.approx(bare[:3], rel=0.01)


def test_opaque_emission_keeps_plain_shadow_rays(tmp_path: Path) -> None:
    """Assets without alpha do not pay for the march."""
    glowing = {"emissiveFactor": [1, 1, 1], "pbrMetallicRoughness": pbr()}
    shapes = lookdev.asset_shapes(table_and_screen(tmp_path, glowing))
    assert appearance.needs_path(shapes) and not appearance.integrator(DEPTH, shapes).alpha
    clear = {"alphaMode": "BLEND", "pbrMetallicRoughness": pbr(baseColorFactor=[1, 1, 1, 0.5])}
    assert appearance.integrator(DEPTH, lookdev.asset_shapes(table_and_screen(tmp_path, clear))).alpha
