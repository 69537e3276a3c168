"""How fast one gradient step of the material fit is, against `mi.render`, in one run on one machine.

One picture of the Avocado (or `--mesh FILE`) under the paper's three directional lights, strong random maps of albedo,
tilt and roughness, squared error in linear radiance; both sides end with the gradients of all maps, no optimiser. The
usual way is `mi.render` with `direct` (one emitter sample, no BSDF sample: the cheapest that it can do here) and with
`prb` of the same depth, unfrozen and frozen. Figures, each the worst over resolutions and integrators:

step_speedup_1spp         seconds of mi.render's step / ours, at one sample a pixel each
step_speedup_equal_error  seconds that mi.render needs for the gradient error of ours at its default samples / ours;
                          error: relative L2 over the texels seen, per map, the map that favours mi.render most, against
                          a gradient with a fine grid of samples; mi.render's error falls with 1 / sqrt(samples) and its
                          time grows with them from where both were measured last (`…_spp`)
exponent_views/…          slope of log(seconds) over log(views, pixels of a view, texels of the table)
lm_texels_per_second      of the per-texel solver; …_differences with a Jacobian by finite differences, …_1_thread
time_to_quality_ratio     our time to the naive loop's final relighting PSNR / that loop's (not with --quick)
…floor_ratio              our seconds / the time it takes only to move the bytes that any such step must read and write

`--against COMMIT` instead compares whole fits with that commit's: `against.py`.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import DATA, finish, parser, peak_gb
from mistyle.core.camera import Camera, orbit
from mistyle.core.capture import Captures, in_memory
from mistyle.core.light import Directional, direction_in_world, lights
from mistyle.core.maps import Maps
from mistyle.core.mesh import Mesh
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions
from mistyle.render.mitsuba import device, draw
from mistyle.render.mitsuba import scene as scenery
from mistyle.solver.settings import RecoverSettings

MESH = "meshes/pbr/Avocado/Avocado.gltf"
MAPS = {"albedo": slice(0, 3), "tilt": slice(3, 5), "roughness": slice(5, 6)}


@dataclass(frozen=True)
class Problem:
    """One object, its cameras, what they should see, and where the maps stand."""

    mesh: Mesh
    traced: draw.Tracer
    captures: Captures
    maps: list[Maps]

    def renderer(self, subsamples: int, **options: Any) -> MaterialRenderer:
        """Ours, in the frame that mi.render knows."""
        chosen = RenderOptions(frame="mitsuba", subsamples=subsamples, **options)
        return MaterialRenderer(self.traced, self.captures, [m.roughness.shape for m in self.maps], chosen)

    def table(self, renderer: MaterialRenderer) -> Any:
        """Where the maps stand, on the device."""
        return renderer.upload(pack(self.maps))


def random_maps(size: int, seed: int) -> Maps:
    rng = np.random.default_rng(seed)
    tilt = np.clip(rng.normal(0, 0.15, (size, size, 2)), -0.6, 0.6)
    normal = np.concatenate([tilt, np.sqrt(1 - (tilt**2).sum(-1, keepdims=True))], axis=-1)
    return Maps(
        albedo=rng.uniform(0.1, 0.9, (size, size, 3)).astype(np.float32),
        normal=normal.astype(np.float32),
        roughness=rng.uniform(0.2, 0.9, (size, size)).astype(np.float32),
        metallic=np.zeros((size, size), np.float32),
        known=np.ones((size, size), bool),
    )


def problem(mesh: Mesh, resolution: int, texture: int, views: int = 1) -> Problem:
    cameras = [orbit(30 + 360 * k / views, 20, distance=4, fov=30, size=(resolution, resolution)) for k in range(views)]
    traced, rig = draw.tracer(mesh), [lights("phase1")] * views
    empty = in_memory(cameras, rig, [np.zeros((resolution, resolution, 3), np.float32)] * views)
    parts = range(len(mesh.parts))
    target = Problem(mesh, traced, empty, [random_maps(texture, 100 + p) for p in parts])
    renderer = target.renderer(1)
    table = target.table(renderer)
    captures = in_memory(cameras, rig, [renderer.image(table, k) for k in range(views)])
    return Problem(mesh, traced, captures, [random_maps(texture, p) for p in parts])


def seconds(step: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a step whose result is waited for; the first calls compile."""
    import drjit as dr

    taken = []
    for _ in range(repeats + 3):
        start = time.perf_counter()
        result = step()
        dr.eval(result)
        dr.sync_thread()
        taken.append(time.perf_counter() - start)
        del result
    return float(np.median(taken[3:]))


class Naive:
    """The step through mi.render."""

    def __init__(self, where: Problem, integrator: dict[str, Any]) -> None:
        import mitsuba as mi

        camera = where.captures.cameras[0]
        sensor = scenery.sensor_dict(camera)
        sensor["film"]["pixel_format"] = "rgb"
        sensor["sampler"] = {"type": "independent"}
        described = {"type": "scene", "integrator": integrator, "sensor": sensor}
        for k, light in enumerate(where.captures.lights[0]):
            described[f"light{k}"] = emitter(light, camera)
        described |= scenery.object_shapes(where.mesh, where.maps)
        self.scene = mi.load_dict(described)
        self.parameters = mi.traverse(self.scene)
        parts = range(len(where.mesh.parts))
        self.keys = [key for p in parts for name, key in scenery.parameters(p).items() if name != "metallic"]
        self.parameters.keep(self.keys)
        self.reference = mi.TensorXf(where.captures.load(0)[0])
        self.maps = where.maps
        self.seed = 0
        self._frozen = device.Frozen(self._traced)

    def step(self, spp: int) -> list[Any]:
        """Gradients of the textures; another seed at each call."""
        import drjit as dr
        import mitsuba as mi

        self.seed += 1
        # Leaves and scene must meet anew in each step, as after an optimiser's; or later gradients stay zero.
        for key in self.keys:
            self.parameters[key] = dr.detach(self.parameters[key])
            dr.enable_grad(self.parameters[key])
        self.parameters.update()
        image = mi.render(self.scene, self.parameters, spp=spp, seed=mi.UInt32(self.seed))
        dr.backward(dr.mean(dr.square(image - self.reference)))
        return [dr.grad(self.parameters[key]) for key in self.keys]

    def frozen(self) -> list[Any]:
        """The same at one sample a pixel, its tracing replayed."""
        import drjit as dr
        import mitsuba as mi

        self.seed += 1
        return self._frozen(self.scene, self.reference, dr.opaque(mi.UInt32, self.seed))

    def _traced(self, scene: Any, reference: Any, seed: Any) -> list[Any]:
        import drjit as dr
        import mitsuba as mi

        parameters = mi.traverse(scene)
        parameters.keep(self.keys)
        for key in self.keys:
            dr.enable_grad(parameters[key])
        image = mi.render(scene, parameters, spp=1, seed=seed)
        dr.backward(dr.mean(dr.square(image - reference)))
        return [dr.grad(parameters[key]) for key in self.keys]

    def table(self, spp: int) -> np.ndarray:
        """The gradient by our table (texels, 8)."""
        found = dict(zip(self.keys, (np.array(g, np.float64) for g in self.step(spp)), strict=True))
        rows = []
        for p, m in enumerate(self.maps):
            albedo, normal, roughness = (
                found[scenery.parameters(p)[name]] for name in ("albedo", "normal", "roughness")
            )
            tilt = 0.5 * (normal[..., :2] - normal[..., 2:] * m.normal[..., :2] / m.normal[..., 2:])
            rows.append(np.concatenate([albedo, tilt, roughness], axis=-1).reshape(-1, 6))
        return np.concatenate(rows)


def emitter(light: Directional, camera: Camera) -> dict[str, Any]:
    away = -direction_in_world(light, camera)
    irradiance = {"type": "rgb", "value": list(light.irradiance)}
    return {"type": "directional", "direction": away.tolist(), "irradiance": irradiance}


INTEGRATORS: dict[str, dict[str, Any]] = {
    "direct": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
    "prb": {"type": "prb", "max_depth": 2},
}


def errors(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Relative L2 of each map's gradient over the texels that are seen."""
    seen = np.abs(exact[:, :6]).max(axis=1) > 0
    return np.array(
        [np.linalg.norm((found - exact)[seen][:, c]) / np.linalg.norm(exact[seen][:, c]) for c in MAPS.values()]
    )


def steps(figures: dict[str, float], mesh: Mesh, quick: bool) -> None:
    """One gradient step at two resolutions."""
    device.use()
    speedups, at_equal_error, repeats = [], [], 5 if quick else 15
    for size in (128, 256) if quick else (512, 1024):
        where = problem(mesh, size, size)
        one, usual = where.renderer(1), where.renderer(RecoverSettings().subsamples)
        table = where.table(one)
        ours_1 = seconds(lambda s=one, t=table: s.step(t, [0], "l2"), repeats)
        ours_usual = seconds(lambda s=usual, t=table: s.step(t, [0], "l2"), repeats)
        figures |= {f"ours_1spp_{size}_seconds": ours_1, f"ours_default_{size}_seconds": ours_usual}
        figures[f"ours_1spp_{size}_floor_ratio"] = ours_1 / floor(one)
        figures[f"ours_default_{size}_floor_ratio"] = ours_usual / floor(usual)
        grid = 256 if quick else 1024
        exact = np.array(where.renderer(grid, memory=0).step(table, [0], "l2")[1], np.float64)[:, :6]
        mine = errors(np.array(usual.step(table, [0], "l2")[1], np.float64)[:, :6], exact)
        figures |= {f"ours_default_{size}_error_{name}": e for name, e in zip(MAPS, mine, strict=True)}
        figures[f"ours_{size}_peak_gb"] = peak_gb()
        for name, integrator in INTEGRATORS.items():
            naive = Naive(where, integrator)
            taken = figures[f"{name}_{size}_seconds"] = seconds(lambda n=naive: n.step(1), repeats)
            figures[f"{name}_{size}_frozen_seconds"] = seconds(Naive(where, integrator).frozen, repeats)
            speedups.append(taken / ours_1)
            for spp in (1, 4, 16):
                theirs = errors(naive.table(spp), exact)
                figures |= {f"{name}_{size}_error_{m}_{spp}spp": e for m, e in zip(MAPS, theirs, strict=True)}
            cost = figures[f"{name}_{size}_16spp_seconds"] = seconds(lambda n=naive: n.step(16), max(3, repeats // 3))
            needed = 16 * (theirs / mine).min() ** 2
            figures[f"{name}_{size}_spp_for_equal_error"] = needed
            at_equal_error.append(max(taken, cost * needed / 16) / ours_usual)
            del naive
    figures["step_speedup_1spp"] = min(speedups)
    figures["step_speedup_equal_error"] = min(at_equal_error)


def floor(ours: MaterialRenderer) -> float:
    """Seconds to move what a step must move once: hits, references, the texels seen, and the whole gradient."""
    blocks = list(ours.blocks(0))
    texels = sum(b.hits.counts[2] for b in blocks)
    return (sum(b.bytes for b in blocks) + 32 * texels + 32 * ours.texels) / bandwidth()


def bandwidth() -> float:
    """Bytes per second, reading and writing 128 MB each with all threads; the best of ten."""
    import drjit as dr
    import mitsuba as mi

    source, best = mi.Float(np.ones(1 << 25, np.float32)), 0.0
    for _ in range(10):
        start = time.perf_counter()
        moved = source + 1
        dr.eval(moved)
        dr.sync_thread()
        best = max(best, 2 * source.numpy().nbytes / (time.perf_counter() - start))
    return best


def growth(figures: dict[str, float], mesh: Mesh, quick: bool) -> None:
    """How the time of a step grows with the number of views, their pixels and the table."""
    device.use()
    base, repeats = (128, 5) if quick else (512, 9)
    series: dict[str, list[tuple[int, Problem, Sequence[int]]]] = {"views": [], "pixels": [], "texels": []}
    views = problem(mesh, base, base, 8)
    for n in (1, 2, 4, 8):
        series["views"].append((n, views, range(n)))
    for side in (base // 2, base, base * 2):
        series["pixels"].append((side**2, problem(mesh, side, base), [0]))
    for side in (base // 2, base, base * 2, base * 4):
        series["texels"].append((side**2, problem(mesh, base, side), [0]))
    for name, points in series.items():
        counts, taken = [], []
        for count, where, chosen in points:
            ours = where.renderer(RecoverSettings().subsamples)
            table = where.table(ours)
            taken.append(seconds(lambda s=ours, t=table, c=chosen: s.step(t, c, "l2"), repeats))
            counts.append(count)
            figures[f"ours_{name}_{count}_seconds"] = taken[-1]
        figures[f"exponent_{name}"] = float(np.polyfit(np.log(counts), np.log(taken), 1)[0])


def transposes(figures: dict[str, float], mesh: Mesh, quick: bool) -> None:
    """From derivatives of samples to the gradient of texels, every way; `shading._to_texels` is the one that is used.

    gather        each texel sums what its samples wrote, by the stored transpose (deterministic)
    atomic        each sample adds packets of eight to its four texels; _sorted: samples in the order of their texels
    scipy         the transpose as a sparse matrix times the eight columns, one thread, waited for (deterministic)
    texel_space   no transpose at all: every texel is shaded where it lies; the whole of that shading, to be set
                  against gather plus `shading`; it is another picture than the camera's. Not run: the seconds of
                  `shading` scaled by texels that are read over samples
    """
    import drjit as dr
    import mitsuba as mi
    import scipy.sparse as sparse

    from mistyle.render.deferred import kernels

    device.use()
    size, repeats = (128, 5) if quick else (512, 15)
    where = problem(mesh, size, size)
    ours = where.renderer(1)
    table = where.table(ours)
    (block,) = ours.blocks(0)
    h = block.hits
    samples, n = h.samples, h.counts[0]
    width, rows = dr.width(samples.texel), 8 * ours.texels
    rng = np.random.default_rng(0)
    packed = mi.Float(rng.normal(size=8 * width).astype(np.float32)) + dr.opaque(mi.Float, 0)
    adjoint = mi.TensorXf(rng.normal(size=(size, size, 3)).astype(np.float32))
    order = np.argsort(np.array(samples.texel)[:n], kind="stable")
    order = mi.UInt32(np.concatenate([order, np.arange(n, width)]).astype(np.uint32)) + dr.opaque(mi.UInt32, 0)
    dr.eval(packed, order)
    corner = mi.Int32(samples.texel)
    right, down = (dr.gather(mi.Int32, s, mi.UInt32(samples.step)) for s in ours._steps)
    places = [mi.UInt32(corner + a + b) for a in (mi.Int32(0), right) for b in (mi.Int32(0), down)]
    weights = [a * b for a in (1 - samples.x, samples.x) for b in (1 - samples.y, samples.y)]
    dr.eval(places, weights)

    def gather(table, packed, transpose):
        return kernels._to_texels(table, packed, transpose)

    def atomic(gradient, packed, places, weights, order):
        values = dr.gather(mi.ArrayXf, packed, order, shape=(8, width))
        for place, weight in zip(places, weights, strict=True):
            at = dr.gather(mi.UInt32, place, order)
            dr.scatter_add(gradient, values * dr.gather(mi.Float, weight, order), at)
        return gradient

    def alone(textures, samples, lights, at):
        return kernels._derivatives(ours._terms, textures, samples, lights, at)

    def empty():
        gradient = dr.zeros(mi.Float, rows)
        dr.make_opaque(gradient)
        return gradient

    frozen, natural = device.Frozen(gather), dr.arange(mi.UInt32, width)
    dr.make_opaque(natural)

    def by_texel():
        gradient = empty()
        kernels.add_rows(gradient, frozen(table, packed, h.transpose), h.transpose)
        return gradient

    figures["transpose_gather_seconds"] = seconds(by_texel, repeats)
    for name, how in (("atomic", natural), ("atomic_sorted", order)):
        scattered = device.Frozen(atomic)
        figures[f"transpose_{name}_seconds"] = seconds(
            lambda f=scattered, o=how: f(empty(), packed, places, weights, o), repeats
        )
    columns = np.stack([np.array(p)[:n] for p in places], axis=1)
    values = np.stack([np.array(w)[:n] for w in weights], axis=1)
    matrix = sparse.csr_matrix((values.ravel(), columns.ravel(), np.arange(0, 4 * n + 1, 4)), shape=(n, ours.texels)).T
    matrix, dense = matrix.tocsr(), np.array(packed).reshape(-1, 8)[:n]
    figures["transpose_scipy_seconds"] = seconds(lambda: mi.Float((matrix @ dense).ravel()), repeats)
    shaded = device.Frozen(alone)
    at = dr.gather(mi.Vector4f, mi.Float(adjoint.array), samples.slot)
    dr.eval(at)
    textures = ours._textures(table)
    figures["transpose_shading_seconds"] = seconds(lambda: shaded(textures, samples, block.lights, at), repeats)
    figures["transpose_texel_space_seconds"] = figures["transpose_shading_seconds"] * h.counts[2] / n


def solver(figures: dict[str, float], mesh: Mesh, quick: bool) -> None:
    """Texels per second of the per-texel solver: on all threads and on one, and by finite differences."""
    import drjit as dr

    from benchmarks.fit_speed.texels import throughput

    device.use()
    texels, every = (8192 if quick else 65536), dr.thread_count()
    figures["lm_texels_per_second"] = throughput(texels)
    figures["lm_texels_per_second_differences"] = throughput(texels, differences=True)
    device.use(threads=1)
    figures["lm_texels_per_second_1_thread"] = throughput(texels)
    device.use(threads=every)


def quality(figures: dict[str, float], mesh: Mesh, quick: bool) -> None:
    """Time to the naive loop's final relighting PSNR; not in a quick run, which would measure fixed costs."""
    from benchmarks.fit_speed.quality import figures as named
    from benchmarks.fit_speed.quality import time_to_quality

    if not quick:
        hdri = DATA / "hdri" / "studio_small_03_1k.hdr"
        figures |= named(time_to_quality(DATA / MESH, hdri, seconds=120, resolution=512))


MEASUREMENTS: tuple[Callable[[dict[str, float], Mesh, bool], None], ...] = (steps, transposes, growth, solver, quality)


def main(argv: list[str] | None = None) -> None:
    own = parser(__doc__ or "")
    own.add_argument("--mesh", type=Path, default=DATA / MESH)
    own.add_argument("--skip", nargs="+", default=[], choices=[m.__name__ for m in MEASUREMENTS])
    own.add_argument("--against", metavar="COMMIT", help="compare whole fits with those of this commit")
    chosen = own.parse_args(argv)
    if chosen.against:
        from benchmarks.fit_speed.against import against

        finish(against(chosen.against, chosen.quick), chosen.json)
        return
    from mistyle.io.read_mesh import read_mesh

    mesh = read_mesh(chosen.mesh).mesh
    figures: dict[str, float] = {}
    for measure in MEASUREMENTS:
        if measure.__name__ not in chosen.skip:
            measure(figures, mesh, chosen.quick)
    finish(figures, chosen.json)


if __name__ == "__main__":
    main()
