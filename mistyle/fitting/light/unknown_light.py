"""Estimation of an unknown environment map together with a first, coarse material.

The sphere is divided into cells. Their radiances and all texels of a coarse atlas are solved jointly
(`light/solve.py`), first with even cells, then with finer ones where the light is. Pictures may leave two quantities
undetermined; both start from a convention. Initial scale: the 95th percentile of the observed albedo's luminance is
BRIGHT. Initial colour: the light's mean over the sphere is neutral. Highlights resolve both, since they take no colour
from the surface and the material model fixes their strength.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

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
from mistyle.render.deferred.material_table import ALBEDO
from mistyle.render.mitsuba.draw import Tracer
from mistyle.solver import prior as recover_prior
from mistyle.solver.photometry.material import NOISY, all_samples
from mistyle.solver.photometry.record import Gains
from mistyle.solver.settings import RecoverSettings
from mistyle.solver.table import atlas_of, scatter, scatter_to_atlas
from mistyle.solver.texels.observations import ObservationOptions, TexelObservations, coarse_observations

SIDE = 192  # pixels along the longer side of the small pictures
ATLAS = 96  # texels a side of the coarse atlas, all sets together
PICTURES = 48  # at most, evenly chosen
OBSERVATIONS = 30_000  # target number of observations; the time is proportional to it
STEPS = (10, 12)  # joint steps with even cells, and with finer ones
NOISE, RELATIVE = 0.01, 0.03  # standard deviation of a small picture's pixels: the model is coarse
FLOOR = 0.1  # least roughness; smaller values give highlights narrower than the finest cells
BRIGHT = 0.8  # luminance of the 95th percentile of albedo


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
) -> FoundLight:
    """One environment, fixed to the world, for all pictures; `captures.lights` are ignored. `outside` looks for
    a sun too. `gains` are the start of the pictures' gains, which are solved too; None where they are known.

    Needs views from around the object. A surface without highlights determines the light only at low frequencies.
    Direct light and shadows are modelled, interreflection is not. Raises InputRefused where no texel is seen.
    """
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.solver.texels.levenberg_marquardt import Options

    traced = tracer(mesh)
    chosen = np.array(evenly(len(captures), PICTURES))
    noise = (NOISE, RELATIVE) if gains is None else NOISY
    cameras, texels, observed = _observations(traced, captures, settings, chosen, noise)
    samples, own = None, None
    if gains is not None:
        samples = all_samples(observed, cameras, noise)
        own = Gains(gains.gain[chosen], gains.vignetting)
    normal = np.concatenate([t.normal[t.covered] for t in texels])
    options = Options(settings.model, settings.metallic, floor=max(FLOOR, settings.roughness_floor))
    residuals: list[float] = []

    def record(state: State) -> None:
        residuals.append(state.residual)
        progress(min(0.99, len(residuals) / (sum(STEPS) + 1)))

    cells = light_cells.even_cells()
    bundled = light_solve.bundle(traced, observed, normal, cells, options, samples)
    state = _start_state(bundled, own)
    record(state)
    state = light_solve.solve_light_and_texels(bundled, state, _conventional_mean, STEPS[0], record)
    cells, radiance = light_cells.refined(cells, state.radiance)
    sun = outdoors.find_sun(traced, observed, normal) if outside else None
    if sun is not None:
        cells, radiance = outdoors.with_sun(cells, radiance, sun)
    bundled = light_solve.bundle(traced, observed, normal, cells, options, samples)
    values, own = state.values, state.gains
    for _ in range(3):
        radiance = light_solve.light_over(bundled, radiance, values, own)
    state = light_solve.texels_under(bundled, radiance, values, 8, own)
    state = light_solve.solve_light_and_texels(bundled, state, _conventional_mean, STEPS[1], record)
    progress(1.0)
    radiance, beam = state.radiance, None
    if sun is not None:
        cells, radiance, beam = outdoors.without_sun(cells, radiance)
    light = light_cells.environment_of(cells, radiance)
    bright = beam if beam is not None and max(beam.irradiance) > 0 else None
    return FoundLight(
        light, tuple(residuals), _maps(state, observed, texels), bright, _all_gains(state.gains, chosen, len(captures))
    )


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
    values = light_solve.first_values(bundled)
    middle = float(np.median(bundled.observed.observations.rgb))
    radiance = np.full((len(bundled.cells.angle), 3), max(middle, 1e-6))
    radiance = light_solve.light_over(bundled, radiance, values, gains)
    for _ in range(2):
        state = light_solve.texels_under(bundled, radiance, values, 8, gains)
        factor = _factor(bundled, state)
        values, radiance = state.values.copy(), state.radiance / factor
        values[:, ALBEDO] = np.clip(values[:, ALBEDO] * factor, 0, 1)
    return light_solve.texels_under(bundled, radiance, values, 8, gains)


def _factor(bundled: Bundle, state: State) -> Float[np.ndarray, "3"]:
    """The factor that multiplies albedo and divides light to satisfy the convention."""
    mean = bundled.cells.mean(state.radiance)
    colour = mean / max(float(luminance(mean[None])[0]), 1e-9)
    seen = state.values[bundled.observed.seen > 0, ALBEDO]
    bright = float(np.quantile(luminance(seen * colour), 0.95))
    return np.maximum(colour, 1e-3) * BRIGHT / max(bright, 1e-6)


def _conventional_mean(bundled: Bundle, state: State) -> Float[np.ndarray, "3"]:
    """The mean radiance of a state's light under the convention."""
    return bundled.cells.mean(state.radiance) / _factor(bundled, state)


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
