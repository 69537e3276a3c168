"""A fit of a scene before it begins and when it is interrupted: what stands still, what moves, what is refused."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mistyle.core.errors import UsageError
from mistyle.render import pyramid as laplacian
from mistyle.render import scene_grad, scene_keys
from mistyle.render.scene_keys import Parameter

FEWEST_VIEWS = 3

# ({key: value}) -> number, on Mitsuba tensors and arrays
Regularizer = Callable[[Mapping[str, Any]], Any]


@dataclass(frozen=True)
class Bad:
    """A number of a gradient that was NaN or infinite: `texel` is its index in the value of `key` (row, column, …).
    `sensor` is None where a regularizer made it."""

    key: str
    texel: tuple[int, ...]
    sensor: int | None
    iteration: int


@dataclass(frozen=True)
class Plan:
    """The settings that decide the result."""

    iterations: int
    spp: int
    spp_grad: int
    rate: float
    pyramid: bool
    sensors_per_step: int
    seed: int


@dataclass(frozen=True)
class Job:
    """What stands still during the fit."""

    scene: Any
    table: Any
    chosen: tuple[Parameter, ...]
    views: tuple[scene_grad.Sight, ...]
    engine: Any
    loss: scene_grad.Loss
    regularizers: tuple[Regularizer, ...]
    free: dict[str, np.ndarray]
    scales: dict[str, float]
    plan: Plan
    fast: Any = None  # scene_fast.Fast, where its pictures are the scene's


@dataclass
class State:
    """What moves, and in `held` which numbers do so no more; all but `bad`, `lost`, `broken` goes into a checkpoint."""

    iteration: int
    values: dict[str, np.ndarray]
    moments: dict[str, tuple[laplacian.Moments, ...]]
    held: dict[str, np.ndarray]
    before: np.ndarray
    trace: list[float]
    bad: list[Bad] = field(default_factory=list)
    lost: int = 0
    broken: dict[int, int] = field(default_factory=dict)


def prepare(scene, keys, sensors, references, masks, only, loss, regularizers, integrator, plan: Plan, fast=True):
    """Check everything and put it together; returns the job and notes."""
    import mitsuba as mi

    if min(plan.iterations, plan.spp, plan.spp_grad, plan.sensors_per_step) < 1 or not plan.rate > 0:
        raise UsageError("iterations, spp, spp_grad and sensors_per_step must be 1 or more, and rate above 0.")
    if isinstance(loss, str) and loss not in scene_grad.LOSSES:
        raise UsageError(f"the loss '{loss}' is not known; expected {', '.join(scene_grad.LOSSES)}, or a function.")
    chosen = scene_keys.match(scene, [keys] if isinstance(keys, str) else keys)
    views = _views(scene, sensors, references, masks)
    engine, notes = scene_grad.ad_integrator(scene, integrator)
    notes = [*notes, *(f"{p.name}: {note}" for p in chosen for note in p.notes)]
    if len(views) < FEWEST_VIEWS:
        notes.append(
            f"{len(views)} view{'s' * (len(views) > 1)} came: with fewer than {FEWEST_VIEWS} the fit is singular, "
            "materials that differ look the same."
        )
    table = mi.traverse(scene)
    table.properties = {p.key: table.properties[p.key] for p in chosen}
    free = {p.key: np.ones(p.shape, bool) for p in chosen}
    for name, mask in (only or {}).items():
        for p in scene_keys.choose(chosen, [name]):
            wide = mask[..., None] if np.ndim(mask) == len(p.shape) - 1 else mask
            if np.ndim(wide) != len(p.shape) or any(
                n not in (1, m) for n, m in zip(np.shape(wide), p.shape, strict=True)
            ):
                raise UsageError(f"`only` of {p.name} has the shape {np.shape(mask)}; expected {p.shape}.")
            free[p.key] = np.broadcast_to(wide, p.shape).astype(bool)
    scales = {p.key: _scale(p, scene_grad.array(table[p.key], p)) for p in chosen}
    function = scene_grad.LOSSES[loss] if isinstance(loss, str) else loss
    quick, why = _fast(scene, chosen, views, loss, engine) if fast else (None, "it was not asked for.")
    notes.append(
        "Gradients came without Monte Carlo: direct light of points and directions on plain `principled` materials."
        if quick is not None
        else f"Gradients came through {str(engine).partition('[')[0]}, not through the fast path: {why}"
    )
    return Job(scene, table, chosen, views, engine, function, tuple(regularizers), free, scales, plan, quick), notes


def _fast(scene, chosen, views, loss, engine) -> tuple[Any, str]:
    """The fast path, or why there is none."""
    from mistyle.render.scene_fast import Fast, NotFast

    try:
        return Fast(scene, chosen, views, loss if isinstance(loss, str) else "", engine), ""
    except NotFast as reason:
        return None, str(reason)


def _views(scene: Any, sensors: Sequence[Any] | None, references: Sequence[np.ndarray], masks: Any):
    own = scene.sensors()
    cameras = []
    for chosen in range(len(own)) if sensors is None else sensors:
        if isinstance(chosen, (int, np.integer)):
            if not 0 <= chosen < len(own):
                raise UsageError(f"sensor {chosen} does not exist; the scene has {len(own)}, counted from 0.")
            chosen = own[chosen]
        cameras.append(chosen)
    if not cameras:
        raise UsageError("the scene has no sensor; give one as `sensors`, or put it into the scene file.")
    if len(references) != len(cameras) or (masks is not None and len(masks) != len(cameras)):
        counted = f"{len(references)} references" + (f" and {len(masks)} masks" if masks is not None else "")
        raise UsageError(f"{counted} came for {len(cameras)} sensors; one of each is expected for every sensor.")
    return tuple(
        scene_grad.sight(camera, np.asarray(references[k]), masks[k] if masks is not None else None, _called(camera, k))
        for k, camera in enumerate(cameras)
    )


def _called(camera: Any, k: int) -> str:
    named = camera.id() and not camera.id().startswith(("_", "object_"))
    return f"sensor {k} ('{camera.id()}')" if named else f"sensor {k}"


def _scale(parameter: Parameter, values: np.ndarray) -> float:
    """The rate's unit: 1 for what is limited to 0..1, else the size of the numbers."""
    bounds = scene_keys.limits(parameter)
    if parameter.owner == "NormalMap" or (bounds is not None and np.isfinite(bounds[1])):
        return 1.0
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))) or 1.0


def first(parameter: Parameter, job: Job) -> np.ndarray:
    values = scene_grad.array(job.table[parameter.key], parameter)
    return np.where(job.free[parameter.key], scene_keys.project(parameter, values), values)


def _fingerprint(job: Job) -> str:
    """What must be the same for a checkpoint to fit."""
    loss = getattr(job.loss, "__name__", type(job.loss).__name__)
    films = [list(view.reference.shape) for view in job.views]
    return json.dumps([[(p.name, p.shape) for p in job.chosen], films, loss, len(job.regularizers), asdict(job.plan)])


def checkpoint(state: State, job: Job) -> dict[str, np.ndarray]:
    result = {
        "job": np.array(_fingerprint(job)),
        "iteration": np.array(state.iteration),
        "before": state.before,
        "trace": np.array(state.trace),
    }
    for p in job.chosen:
        result[f"{p.name}/value"] = state.values[p.key].copy()
        result[f"{p.name}/held"] = state.held[p.key].copy()
        for k, level in enumerate(state.moments[p.key]):
            for name in ("first", "second", "steps"):
                result[f"{p.name}/{name}{k}"] = getattr(level, name).copy()
    return result


def restored(saved: Mapping[str, np.ndarray], job: Job) -> State:
    if "job" not in saved or str(saved["job"]) != _fingerprint(job):
        raise UsageError(
            "the checkpoint belongs to another fit: its keys, cameras or settings differ. Start without it, or give "
            "the settings it was made with."
        )
    moments = {}
    for p in job.chosen:
        count = len(laplacian.sizes(p.shape, job.plan.pyramid))
        moments[p.key] = tuple(
            laplacian.Moments(*(np.array(saved[f"{p.name}/{name}{k}"]) for name in ("first", "second", "steps")))
            for k in range(count)
        )
    values = {p.key: np.array(saved[f"{p.name}/value"], np.float32) for p in job.chosen}
    held = {p.key: np.array(saved[f"{p.name}/held"], bool) for p in job.chosen}
    return State(
        int(saved["iteration"]), values, moments, held, np.array(saved["before"]), [float(x) for x in saved["trace"]]
    )
