"""Estimation of an unknown environment map together with a first, coarse material.

The sphere is divided into cells. Their radiances and all texels of a coarse atlas are solved jointly
(`light/solve.py`), first with even cells, then with finer ones where the light is. Pictures may leave two quantities
undetermined; both start from a convention. Initial scale: that of the 95th percentile of the observed albedo's
luminance. Initial colour: the light's mean over the sphere is neutral. Highlights resolve both, since they take no
colour from the surface and the material model fixes their strength: the convention holds firmly until the texels'
classes and roughness are known (`light/texel_prior.py`), then loosely.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mistyle.core.asset import Material
from mistyle.core.camera import Camera, resized
from mistyle.core.capture import Captures, evenly_lit, in_memory
from mistyle.core.errors import InputRefused
from mistyle.core.image import luminance
from mistyle.core.light import Directional, Environment, Lights
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import Mesh
from mistyle.core.rows import evenly
from mistyle.fitting.light import cells as light_cells
from mistyle.fitting.light import outdoors
from mistyle.fitting.light import solve as light_solve
from mistyle.fitting.light.solve import Bundle, State
from mistyle.fitting.light.texel_prior import first_mean, metals, with_common_roughness, with_metals
from mistyle.render.deferred.material_table import ALBEDO
from mistyle.render.mitsuba.draw import Tracer, tracer
from mistyle.solver import prior as recover_prior
from mistyle.solver.photometry.material import NOISY, all_samples
from mistyle.solver.photometry.record import Gains
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.table import Atlas, atlas_of, linked, scatter, scatter_to_atlas
from mistyle.solver.texels.levenberg_marquardt import Options
from mistyle.solver.texels.observations import ObservationOptions, TexelObservations, coarse_observations

SIDE = 192  # pixels along the longer side of the small pictures
ATLAS = 96  # texels a side of the coarse atlas, all sets together
PICTURES = 48  # at most, evenly chosen
OBSERVATIONS = 30_000  # target number of observations; the time is proportional to it
STEPS = (10, 12)  # joint steps with even cells, and with finer ones
CLASSINGS = 3  # most decisions which texels are metal, each with joint steps after it
SAME = 0.99  # share of equal classes that ends them
NOISE, RELATIVE = 0.01, 0.03  # standard deviation of a small picture's pixels: the model is coarse
FLOOR = 0.1  # least roughness; smaller values give highlights narrower than the finest cells


@dataclass(frozen=True)
class Convention:
    """The 95th percentile of the albedo's luminance, and the weight per observation of the mean radiance's squared
    relative distance from it."""

    bright: float
    weight: float


# White at first: from lights that are too dim the classes are right, from those that are too bright they are not.
# Then a middling brightness: real base colours lie on both sides of it.
FIRM, LOOSE = Convention(0.8, 0.1), Convention(0.5, 0.01)


@dataclass(frozen=True)
class FoundLight:
    """The light, the relative residual of the small pictures after each step, the coarse materials, the sun where one
    was asked for and is there, and the pictures' gains where they were solved, 0 for pictures that were left out."""

    light: Environment
    residuals: tuple[float, ...]
    maps: tuple[Maps, ...]
    sun: Directional | None = None
    gains: Gains | None = None

    @property
    def lights(self) -> Lights:
        return (self.light,) if self.sun is None else (self.light, self.sun)


def find_light(
    mesh: Mesh,
    captures: Captures,
    settings: RecoverSettings,
    progress: Callable[[float], None] = lambda done: None,
    *,
    outside: bool = False,
    gains: Gains | None = None,
    materials: Sequence[Material] = (),
) -> FoundLight:
    """One environment, fixed to the world, for all pictures; `captures.lights` are ignored. `outside` looks for
    a sun too. `gains` are the start of the pictures' gains, which are solved too; None where they are known. The
    metallic of `materials`, 0 without any, holds unless the settings fit it.

    Needs views from around the object. A surface without highlights determines the light only at low frequencies.
    Direct light and shadows are modelled, interreflection is not: on concave surfaces the light comes out too bright.
    Raises InputRefused where no texel is seen.
    """
    traced = tracer(mesh)
    chosen = np.array(evenly(len(captures), PICTURES))
    noise = (NOISE, RELATIVE) if gains is None else NOISY
    cameras, texels, observed = _observations(traced, captures, settings, chosen, noise)
    samples = None if gains is None else all_samples(observed, cameras, noise)
    own = None if gains is None else Gains(gains.gain[chosen], gains.vignetting)
    normal = np.concatenate([t.normal[t.covered] for t in texels])
    options = Options(settings.model, settings.metallic, floor=max(FLOOR, settings.roughness_floor))
    residuals: list[float] = []
    most = 1 + STEPS[0] * (1 + CLASSINGS * settings.metallic) + 2 * STEPS[1]

    def record(state: State) -> None:
        residuals.append(state.residual)
        progress(min(0.99, len(residuals) / most))

    def solved(bundled: Bundle, state: State, convention: Convention, steps: int) -> State:
        def mean(bundled: Bundle, state: State) -> Float[np.ndarray, "3"]:
            return bundled.cells.mean(state.radiance) / _factor(bundled, state, convention.bright)

        return light_solve.solve_light_and_texels(bundled, state, mean, convention.weight, steps, record)

    cells, mean = light_cells.even_cells(), first_mean(texels, () if settings.metallic else materials)
    bundled = light_solve.bundle(traced, observed, normal, cells, options, mean, samples)
    state = _start_state(bundled, own)
    record(state)
    state = solved(bundled, state, FIRM, STEPS[0])
    if settings.metallic:
        bundled, state = _classed(bundled, state, linked(mesh, texels), solved)
    bundled, state = with_common_roughness(bundled, state)
    sun = outdoors.find_sun(traced, observed, normal) if outside else None
    cells, radiance = outdoors.with_sun(*light_cells.refined(cells, state.radiance), sun)
    bundled = light_solve.bundle(traced, observed, normal, cells, options, bundled.mean, samples)
    state = _relit(bundled, state, radiance)
    state = solved(bundled, state, LOOSE, STEPS[1])
    state = solved(*with_common_roughness(bundled, state), LOOSE, STEPS[1])
    progress(1.0)
    light, beam = _lights_of(cells, state.radiance, sun)
    gained = _all_gains(state.gains, chosen, len(captures))
    return FoundLight(light, tuple(residuals), _maps(state, observed, texels), beam, gained)


def _classed(
    bundled: Bundle, state: State, atlas: Atlas, solve: Callable[[Bundle, State, Convention, int], State]
) -> tuple[Bundle, State]:
    """Texels and light with the classes decided anew until they stay; `atlas` has links."""
    metal = np.zeros(len(bundled.mean), bool)
    for _ in range(CLASSINGS):
        before, metal = metal, metals(bundled, state, atlas)
        if (metal == before).mean() > SAME:
            break
        bundled, state = with_metals(bundled, state, metal)
        state = solve(bundled, state, FIRM, STEPS[0])
    return bundled, state


def _relit(bundled: Bundle, state: State, radiance: light_cells.Radiance) -> State:
    """The texels of `state` under other cells, whose radiance starts as given."""
    for _ in range(3):
        radiance = light_solve.light_over(bundled, radiance, state.values, state.gains)
    return light_solve.texels_under(bundled, radiance, state.values, light_solve.INNER, state.gains)


def _lights_of(
    cells: light_cells.LightCells, radiance: light_cells.Radiance, sun: outdoors.Sun | None
) -> tuple[Environment, Directional | None]:
    """The environment, and the sun where it was found and shines."""
    beam = None
    if sun is not None:
        cells, radiance, beam = outdoors.without_sun(cells, radiance)
    return light_cells.environment_of(cells, radiance), beam if beam and max(beam.irradiance) > 0 else None


def _all_gains(gains: Gains | None, chosen: Int[np.ndarray, " k"], count: int) -> Gains | None:
    """The gains of the chosen pictures among all, with mean 0; 0 for the others."""
    if gains is None:
        return None
    every = np.zeros((count, 3))
    every[chosen] = gains.gain - gains.gain.mean(axis=0)
    return Gains(every, gains.vignetting)


def _observations(
    traced: Tracer,
    captures: Captures,
    settings: RecoverSettings,
    chosen: Int[np.ndarray, " k"],
    noise: tuple[float, float],
) -> tuple[tuple[Camera, ...], list[Texels], TexelObservations]:
    """Cameras of the chosen pictures, downsampled, and the texels' observations on a coarse atlas, as fine as
    OBSERVATIONS allows; `noise` are the arguments of their `observation_std`."""
    from mistyle.render.deferred.image_samples import tangents_of

    cameras, pictures, masks = zip(*(_downsampled(captures, int(k)) for k in chosen), strict=True)
    lit = evenly_lit(in_memory(cameras, [()] * len(cameras), pictures, masks))
    options = ObservationOptions(settings.facing, *noise, skies=False, move=0)
    tangents = tangents_of(traced.mesh, settings.frame)
    texels, observed = coarse_observations(traced, lit, tangents, options, ATLAS, OBSERVATIONS)
    if not (observed.seen >= recover_prior.LEAST_SEEN).any():
        raise InputRefused(
            f"found no place of the mesh that {recover_prior.LEAST_SEEN} of the pictures show, expected pictures from "
            "around it. Check the masks and the cameras (--align if their units differ from the mesh's)."
        )
    return cameras, texels, observed


def _start_state(bundled: Bundle, gains: Gains | None = None) -> State:
    """The start state: light for grey texels, then texels under that light, scaled to the convention."""
    values = bundled.mean
    middle = float(np.median(bundled.observed.observations.rgb))
    radiance = np.full((len(bundled.cells.angle), 3), max(middle, 1e-6))
    radiance = light_solve.light_over(bundled, radiance, values, gains)
    for _ in range(2):
        state = light_solve.texels_under(bundled, radiance, values, light_solve.INNER, gains)
        factor = _factor(bundled, state, FIRM.bright)
        values, radiance = state.values.copy(), state.radiance / factor
        values[:, ALBEDO] = np.clip(values[:, ALBEDO] * factor, 0, 1)
    return light_solve.texels_under(bundled, radiance, values, light_solve.INNER, gains)


def _factor(bundled: Bundle, state: State, bright: float) -> Float[np.ndarray, "3"]:
    """The factor that multiplies albedo and divides light to satisfy a convention."""
    mean = bundled.cells.mean(state.radiance)
    colour = mean / max(float(luminance(mean[None])[0]), 1e-9)
    seen = state.values[bundled.observed.seen > 0, ALBEDO]
    found = float(np.quantile(luminance(seen * colour), 0.95))
    return np.maximum(colour, 1e-3) * bright / max(found, 1e-6)


def _maps(state: State, observed: TexelObservations, texels: Sequence[Texels]) -> tuple[Maps, ...]:
    from mistyle.render.deferred.material_table import unpack

    atlas = atlas_of(texels)
    known = scatter(observed.seen > 0, observed, atlas, False)
    maps = unpack(scatter_to_atlas(state.values, observed, atlas), atlas.sizes)
    return tuple(replace(m, known=known[p].reshape(m.known.shape)) for m, p in zip(maps, atlas.parts, strict=True))


def _downsampled(captures: Captures, k: int) -> tuple[Camera, Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Picture k downsampled to SIDE pixels by means of valid pixels; a result needs more than 90 % valid pixels."""
    rgb, mask = captures.load(k)
    height, width = mask.shape
    times = max(1, -(-max(height, width) // SIDE))
    high, wide = height // times, width // times
    cells = (high, times, wide, times)
    inside = mask[: high * times, : wide * times]
    weight = inside.reshape(cells).sum(axis=(1, 3)).astype(np.float32)
    values = np.where(inside[..., None], rgb[: high * times, : wide * times], 0)
    total = values.reshape(*cells, 3).sum(axis=(1, 3))
    # Incomplete blocks at the right and lower border are cropped; the principal point does not move.
    whole = replace(captures.cameras[k], size=(high * times, wide * times))
    valid = weight > 0.9 * times * times
    return resized(whole, (high, wide)), (total / np.maximum(weight, 1)[..., None]).astype(np.float32), valid
