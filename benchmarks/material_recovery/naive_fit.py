"""Fit albedo, normal, roughness and metallic textures the usual way: `mi.render`, a loss, Adam. Stands alone.

    python naive_fit.py JOB --seconds 60 --out maps.npz             the plain loop
    python naive_fit.py JOB --seconds 60 --out maps.npz --pyramid   the same on a Laplacian pyramid
    python naive_fit.py JOB --seconds 3600 --out maps.npz --converge    until the loss falls no more

It needs Mitsuba 3.9 and numpy, nothing else. One picture is drawn at random in each step; the textures start grey,
flat, half rough and not metallic. JOB is a folder with `job.json`:

    {"fov": 30,                                 degrees, along x
     "shapes": [{"file": "part0.ply", "texture": 512}],
     "pictures": [{"file": "view000.exr",       linear, float
                   "to_world": [[...], ...],    4 x 4 of a Mitsuba sensor
                   "lights": [{"direction": [x, y, z], "irradiance": [r, g, b]}]}]}

`direction` is the way the light travels, in the world; every picture has the same number of lights. The meshes have
texture coordinates with v = 0 at the textures' first row. The result holds, per shape k, `albedo_k`, `normal_k`
(tangent space, unit), `roughness_k`, `metallic_k` in Mitsuba's row order, and `steps` and `seconds`.
"""

import argparse
import json
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

ROUGHNESS_FLOOR = 0.04  # principled has no gradient below 0.0316
START = {"albedo": (0.5, 0.5, 0.5), "normal": (0.5, 0.5, 1.0), "roughness": (0.5,), "metallic": (0.0,)}
KEYS = {
    "albedo": "bsdf.brdf_0.nested_bsdf.base_color.data",
    "normal": "bsdf.brdf_0.normalmap.data",
    "roughness": "bsdf.brdf_0.nested_bsdf.roughness.data",
    "metallic": "bsdf.brdf_0.nested_bsdf.metallic.data",
}
COARSEST = 8
# What did best of the rates 0.003 to 0.05, 1 and 4 samples, and both integrators, at some hundred steps.
RATE = {False: 0.01, True: 0.003}
# A light from one direction is only met by asking for it.
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
PRB = {"type": "prb", "max_depth": 3}
# Settled: over SWEEPS sweeps through the pictures the mean loss is above SETTLED times that of as many before.
SWEEPS, SETTLED = 8, 0.995
HALVINGS = 5  # of the rate, one each time the loss has settled; at a constant rate the noise of one sample remains


def texture(values):
    return {"type": "bitmap", "data": mi.TensorXf(values), "raw": True, "wrap_mode": "repeat"}


def load_scene(folder, job, integrator):
    """The scene with starting textures, the reference pictures, the sensors."""
    scene = {"type": "scene", "integrator": integrator}
    for k, shape in enumerate(job["shapes"]):
        size = shape["texture"]
        start = {name: np.tile(np.float32(value), (size, size, 1)) for name, value in START.items()}
        principled = {
            "type": "principled",
            "base_color": texture(start["albedo"]),
            "roughness": texture(start["roughness"]),
            "metallic": texture(start["metallic"]),
            "specular": 0.5,
        }
        bumped = {
            "type": "normalmap",
            "normalmap": texture(start["normal"]),
            "flip_invalid_normals": False,
            "use_shadowing_function": False,
            "bsdf": principled,
        }
        bsdf = {"type": "twosided", "bsdf": bumped}
        scene[f"shape{k}"] = {"type": "ply", "filename": str(folder / shape["file"]), "bsdf": bsdf}
    for k in range(len(job["pictures"][0]["lights"])):
        scene[f"light{k}"] = {
            "type": "directional",
            "direction": [0, 0, 1],
            "irradiance": {"type": "rgb", "value": 1.0},
        }
    references = [mi.TensorXf(mi.Bitmap(str(folder / p["file"])))[..., :3] for p in job["pictures"]]
    sensors = []
    for picture, reference in zip(job["pictures"], references, strict=True):
        height, width = reference.shape[:2]
        film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        to_world = mi.ScalarTransform4f(np.array(picture["to_world"]))
        sensors.append(
            mi.load_dict(
                {"type": "perspective", "fov": job["fov"], "fov_axis": "x", "to_world": to_world, "film": film}
            )
        )
    return mi.load_dict(scene), references, sensors


def turn_lights(params, lights):
    """Point the emitters; they are not optimised."""
    for k, light in enumerate(lights):
        direction = np.array(light["direction"], float)
        up = [1, 0, 0] if abs(direction[0]) < 0.9 else [0, 1, 0]
        params[f"light{k}.to_world"] = mi.Transform4f().look_at([0, 0, 0], direction.tolist(), up)
        params[f"light{k}.irradiance.value"] = mi.Color3f(light["irradiance"])


def levels_of(size):
    sizes = [size]
    while sizes[-1] > COARSEST:
        sizes.append(sizes[-1] // 2)
    return sizes


def admissible(name, values):
    """The nearest values that a texture may hold."""
    if name == "normal":
        n = dr.unravel(mi.Vector3f, values.array) * 2 - 1
        n.z = dr.maximum(n.z, 0.1)
        return mi.TensorXf(dr.ravel(dr.normalize(n) * 0.5 + 0.5), values.shape)
    return dr.clip(values, ROUGHNESS_FLOOR if name == "roughness" else 0, 1)


def settled(losses, pictures):
    """Whether the losses of single steps (one picture each) have settled."""
    size = SWEEPS * pictures
    if len(losses) < 2 * size or len(losses) % pictures:
        return False
    return np.mean(losses[-size:]) > SETTLED * np.mean(losses[-2 * size : -size])


def fit(folder, seconds, pyramid=False, rate=None, samples=1, integrator=None, seed=0, progress=None, converge=False):
    """Optimise for `seconds` (loading and one step that compiles the kernels are not counted), with `converge` until
    the loss has settled at the smallest rate, if that is earlier; returns the arrays."""
    rate = rate or RATE[pyramid]
    folder = Path(folder)
    job = json.loads((folder / "job.json").read_text())
    scene, references, sensors = load_scene(folder, job, integrator or DIRECT)
    params = mi.traverse(scene)
    names = {(k, n): f"shape{k}.{key}" for k in range(len(job["shapes"])) for n, key in KEYS.items()}
    optimiser = mi.ad.Adam(lr=rate, beta_2=0.99, mask_updates=True)
    for (k, name), key in names.items():
        if pyramid:
            for s in levels_of(job["shapes"][k]["texture"])[:-1]:
                optimiser[f"{key}@{s}"] = dr.zeros(mi.TensorXf, (s, s, len(START[name])))
            coarse = np.tile(np.float32(START[name]), (COARSEST, COARSEST, 1))
            optimiser[f"{key}@{levels_of(job['shapes'][k]['texture'])[-1]}"] = mi.TensorXf(coarse)
        else:
            optimiser[key] = params[key]

    def textures():
        for (k, name), key in names.items():
            if pyramid:
                size = job["shapes"][k]["texture"]
                total = optimiser[f"{key}@{size}"]
                for s in levels_of(size)[1:]:
                    total = total + dr.resample(
                        optimiser[f"{key}@{s}"], (size, size, len(START[name])), filter="linear"
                    )
                # The sum may leave the range; the gradient must still bring it back.
                params[key] = dr.replace_grad(admissible(name, dr.detach(total)), total)
            else:
                optimiser[key] = admissible(name, dr.detach(optimiser[key]))
                params[key] = optimiser[key]

    rng = np.random.default_rng(seed)
    order, step, start, losses, halved = [], 0, time.perf_counter(), [], 0
    while halved <= HALVINGS and (step < 1 or time.perf_counter() - start < seconds):
        order = order or rng.permutation(len(references)).tolist()
        k = order.pop()
        textures()
        turn_lights(params, job["pictures"][k]["lights"])
        params.update()
        picture = mi.render(scene, params, sensor=sensors[k], spp=samples, seed=step)
        loss = dr.mean(dr.abs(picture - references[k]), axis=None)
        dr.backward(loss)
        optimiser.step()
        if step == 0:
            dr.eval(*(optimiser[key] for key in optimiser.keys()))
            dr.sync_thread()
            start = time.perf_counter()
        step += 1
        if converge:
            losses.append(float(loss.array[0]))
            if settled(losses, len(references)):
                halved, losses = halved + 1, []
                optimiser.set_learning_rate(rate / 2**halved)
        if progress:
            progress(min(1.0, (time.perf_counter() - start) / seconds))
    dr.eval(*(optimiser[key] for key in optimiser.keys()))
    dr.sync_thread()
    took = time.perf_counter() - start
    with dr.suspend_grad():
        textures()
    result = {"steps": step - 1, "seconds": took, "converged": halved > HALVINGS}
    for (k, name), key in names.items():
        values = np.array(params[key])
        if name == "normal":
            values = values * 2 - 1
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        result[f"{name}_{k}"] = values if values.shape[-1] == 3 else values[..., 0]
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", type=Path)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--out", type=Path, default=Path("maps.npz"))
    parser.add_argument("--pyramid", action="store_true", help="optimise a Laplacian pyramid of every texture")
    parser.add_argument("--rate", type=float, help="Adam's learning rate (0.01; pyramid 0.003)")
    parser.add_argument("--samples", type=int, default=1, help="samples a pixel and step")
    parser.add_argument("--integrator", choices=["direct", "prb"], default="direct", help="prb: with interreflection")
    parser.add_argument("--converge", action="store_true", help="halve the rate where the loss falls no more, and end")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    integrator = DIRECT if options.integrator == "direct" else PRB
    found = fit(
        options.job, options.seconds, options.pyramid, options.rate, options.samples, integrator,
        converge=options.converge,
    )  # fmt: skip
    np.savez(options.out, **found)
    print(f"{found['steps']} steps in {found['seconds']:.1f} s -> {options.out}")


if __name__ == "__main__":
    main()
