"""The fast path of scene fits: the same pictures and gradients as the scene's own integrator, or a reason why not."""

from typing import Any

import numpy as np
import pytest

from mistyle.core.drjit_arrays import aligned
from mistyle.render.live import parameters as scene_keys
from mistyle.render.mitsuba import device
from mistyle.solver.scene import fit as scene_fit
from mistyle.solver.scene import gradients as scene_grad
from mistyle.solver.scene import state as scene_job
from mistyle.solver.scene.deferred import DeferredRenderer, Unsupported
from tests.solver.test_scene_fit import bitmap, smooth

KEYS = ["wall.bsdf.base_color.data", "wall.bsdf.roughness.data", "wall.bsdf.normalmap.data", "ball.bsdf.base_color"]
SIZE = 16


def tilts(seed):
    xy = 0.3 * (smooth(SIZE, 2, -1, 1, seed))
    return np.concatenate([xy, np.sqrt(1 - (xy**2).sum(-1, keepdims=True))], axis=-1) * 0.5 + 0.5


def grid(rows=5):
    """A bent square with uvs, facing +Z."""
    import mitsuba as mi

    x, y = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, rows))
    z = 0.25 * np.cos(1.5 * x) * np.cos(1.5 * y)
    positions = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    uv = np.stack([(x + 1.1) / 2.2, (y + 1.1) / 2.2], axis=-1).reshape(-1, 2)
    quad = np.arange(rows * rows).reshape(rows, rows)
    a, b, c, d = quad[:-1, :-1].ravel(), quad[:-1, 1:].ravel(), quad[1:, 1:].ravel(), quad[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    normals = np.zeros_like(positions)
    for face in faces:
        normals[face] += np.cross(positions[face[1]] - positions[face[0]], positions[face[2]] - positions[face[0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return positions, normals, uv, faces, mi


def mesh(name, bsdf, scale=1.0, shift=(0.0, 0.0, 0.0), side=1) -> Any:
    positions, normals, uv, faces, mi = grid()
    positions, normals = (a * (1, side, side) for a in (positions, normals))  # -1: half a turn about x
    props: Any = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh(name, len(positions), len(faces), props=props, has_vertex_normals=True, has_vertex_texcoords=True)
    table = mi.traverse(shape)
    table["vertex_positions"] = mi.Float((positions * scale + np.array(shift)).astype(np.float32).ravel())
    table["vertex_normals"] = mi.Float(aligned(normals).ravel())
    table["vertex_texcoords"] = mi.Float(aligned(uv).ravel())
    table["faces"] = mi.UInt32(aligned(faces, np.uint32).ravel())
    table.update()
    return shape


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def world(colour, rough, normal, ball=(0.3, 0.5, 0.2), *, depth=2, lamp=None, other=None, behind=False, **bump) -> Any:
    import mitsuba as mi

    device.use()
    texture = {"wrap_mode": "repeat"}
    wall = {
        "type": "twosided",
        "bsdf": {
            "type": "normalmap",
            "normalmap": bitmap(normal, **texture),
            "bsdf": {
                "type": "principled",
                "base_color": bitmap(colour, **texture),
                "roughness": bitmap(rough, **texture),
            },
            **bump,
        },
    }
    plain = other or {"type": "principled", "base_color": rgb(*ball), "roughness": 0.4}
    if not behind:
        plain = {"type": "twosided", "bsdf": plain}
    scene = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": depth},
        "lamp": lamp
        or {"type": "point", "position": [0.4, 0.5, 2.5], "intensity": {"type": "rgb", "value": [9, 8, 7]}},
        "sun": {
            "type": "directional",
            "direction": [-0.5, -0.2, -1],
            "irradiance": {"type": "rgb", "value": [1, 1, 2]},
        },
        "wall": mesh("wall", wall),
        "ball": mesh("ball", plain, 0.25, (0.2, 0.1, 0.6), -1 if behind else 1),
    }
    for k, (x, y) in enumerate(((0.0, 0.0), (1.2, 0.3), (-1.0, -0.7))):
        scene[f"cam{k}"] = {
            "type": "perspective",
            "fov": 34,
            "to_world": mi.ScalarTransform4f().look_at([x, y, 4], [0, 0, 0], [0, 1, 0]),
            "sampler": {"type": "multijitter"},
            "film": {"type": "hdrfilm", "width": 40, "height": 32, "pixel_format": "rgb", "rfilter": {"type": "box"}},
        }
    return mi.load_dict(scene, optimize=False)


def start(**more) -> Any:
    return world(
        np.full((SIZE, SIZE, 3), 0.5), np.full((SIZE, SIZE, 1), 0.5), np.full((SIZE, SIZE, 3), (0.5, 0.5, 1)), **more
    )


TRUTH = (smooth(SIZE, 3, 0.1, 0.8, 1), smooth(SIZE, 1, 0.3, 0.7, 2), tilts(3))


@pytest.fixture(scope="module")
def references():
    import mitsuba as mi

    device.use()
    scene, drawn = world(*TRUTH, (0.7, 0.2, 0.1)), mi
    render: Any = drawn.render
    return [np.array(render(scene, sensor=s, spp=256, seed=50 + k)) for k, s in enumerate(scene.sensors())]


def sights(scene, references):
    return [scene_grad.sight(s, r, None, "x") for s, r in zip(scene.sensors(), references, strict=True)]


@pytest.mark.parametrize("bump", [{}, {"use_shadowing_function": False, "flip_invalid_normals": False}])
def test_gradients_are_those_of_the_scene(references, bump):
    """Loss and gradients of every map and literal, against `prb` with many samples; both settings of a normal map."""
    scene = world(smooth(SIZE, 3, 0.2, 0.7, 5), smooth(SIZE, 1, 0.3, 0.7, 6), tilts(7), **bump)
    chosen = scene_keys.match(scene, KEYS)
    views = sights(scene, references)
    engine = scene_grad.ad_integrator(scene)[0]
    fast = DeferredRenderer(scene, chosen, views, "l2", engine, subsamples=64)
    import mitsuba as mi

    table = mi.traverse(scene)
    values = {p.key: scene_grad.array(table[p.key], p) for p in chosen}
    for k in range(2):
        loss, ours = fast.gradients(values, k)
        rounds = [
            scene_grad.gradients(
                scene_grad.LiveScene(scene, table, chosen, engine),
                values,
                views[k],
                scene_grad.l2,
                (256, 256),
                (2 * j + 1, 2 * j + 2),
            )
            for j in range(2)
        ]
        assert loss == pytest.approx(np.mean([r[0] for r in rounds]), rel=0.02)
        for p in chosen:
            pair = [r[1][p.key] for r in rounds]
            noise = np.square(pair[0] - pair[1]).sum() / 4
            wrong = np.square(ours[p.key] - (pair[0] + pair[1]) / 2).sum()
            # Where an edge or a shadow cuts a pixel, 64 places in it are not 512.
            assert wrong < 2 * noise + 0.02**2 * np.square(pair[0] + pair[1]).sum() / 4, (p.name, k)


def test_a_fit_takes_it_and_finds_the_maps(references):
    scene = start()
    fitted = scene_fit.fit_scene(scene, KEYS, references=references, iterations=60, rate=0.05)
    assert any("were noise-free" in note for note in fitted.notes)
    assert min(r.psnr[1] - r.psnr[0] for r in fitted.residuals) > 6
    colour = next(v for k, v in fitted.values.items() if "ball" in k)
    np.testing.assert_allclose(colour, (0.7, 0.2, 0.1), atol=0.05)
    again = scene_fit.fit_scene(start(), KEYS, references=references, iterations=60, rate=0.05)
    assert all(np.array_equal(fitted.values[k], again.values[k]) for k in fitted.values)


def test_other_materials_are_left_out_of_the_pictures(references):
    """A diffuse shape stands before the wall: its pixels do not count, its shadow does."""
    scene = start(other={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.1, 0.1]}})
    chosen = scene_keys.match(scene, KEYS[:1])
    fast = DeferredRenderer(scene, chosen, sights(scene, references), "l2", scene_grad.ad_integrator(scene)[0])
    counted = [fast.renderer.captures.load(k)[1].mean() for k in range(3)]
    assert max(counted) < 0.98 and min(counted) > 0.5


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"depth": 4}, "max_depth"),
        ({"lamp": {"type": "constant", "radiance": 0.5}}, "neither a point nor a direction"),
    ],
)
def test_where_it_does_not_hold_the_reason_is_told(references, changed, words):
    scene = start(**changed)
    plan = scene_job.FitPlan(1, 1, 1, 0.01, True, 1, 0)
    evidence, objective = scene_job.Evidence(references), scene_job.Objective("l2")
    job, notes = scene_job.prepare(scene, scene_job.Unknowns(KEYS[:1]), evidence, objective, plan)
    assert job.fast is None
    assert any(words in note for note in notes)


def test_a_scene_that_is_shaded_otherwise_is_found_out(references):
    """Another lobe, and a material without a back: neither may be fitted by the wrong picture."""
    scene = start(other={"type": "principled", "base_color": {"type": "rgb", "value": [0.3, 0.5, 0.2]}, "sheen": 0.8})
    chosen = scene_keys.match(scene, KEYS[:1])
    with pytest.raises(Unsupported, match="sheen"):
        DeferredRenderer(scene, chosen, sights(scene, references), "l2", scene_grad.ad_integrator(scene)[0])
    scene = start(other={"type": "principled", "base_color": rgb(0.3, 0.5, 0.2)}, behind=True)
    with pytest.raises(Unsupported, match="differ from the scene's by"):
        DeferredRenderer(scene, chosen, sights(scene, references), "l2", scene_grad.ad_integrator(scene)[0])
