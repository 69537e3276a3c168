"""State of a scene fit: constants, changing values, checkpoints, and validation of its inputs."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mistyle.core.errors import UsageError
from mistyle.render.deferred import pyramid as laplacian
from mistyle.render.live import parameters as scene_keys
from mistyle.render.live.parameters import Parameter
from mistyle.render.mitsuba.device import mi
from mistyle.solver.scene import gauss_newton as scene_newton
from mistyle.solver.scene import gradients as scene_grad
from mistyle.solver.scene.deferred import DeferredRenderer, Unsupported

FEWEST_VIEWS = 3
SOLVERS = ("auto", "adam", "gauss-newton")

# ({key: value}) -> number, on Mitsuba tensors and arrays
Regularizer = Callable[[Mapping[str, Any]], Any]


@dataclass(frozen=True)
class Bad:
    """A NaN or infinite number of a gradient: `texel` is its index in the value of `key` (row, column, …). `sensor` is
    None if a regularizer caused it."""

    key: str
    texel: tuple[int, ...]
    sensor: int | None
    iteration: int


@dataclass(frozen=True)
class FitPlan:
    """The settings that determine the result; with `spp_grad` None the solver chooses."""

    iterations: int
    spp: int
    spp_grad: int | None
    rate: float
    pyramid: bool
    sensors_per_step: int
    seed: int
    solver: str = "auto"


@dataclass(frozen=True)
class SceneProblem:
    """Constants of the fit."""

    scene: Any
    table: Any
    chosen: tuple[Parameter, ...]
    views: tuple[scene_grad.ReferenceView, ...]
    engine: Any
    loss: str | scene_grad.Loss
    losses: tuple[scene_grad.Loss, ...]  # of every camera
    regularizers: tuple[Regularizer, ...]
    free: dict[str, np.ndarray]
    scales: dict[str, float]
    plan: FitPlan
    fast: Any = None  # deferred.DeferredRenderer, if it matches the scene
    newton: bool = False  # Gauss–Newton instead of Adam


@dataclass
class FitState:
    """The changing values, and in `held` the frozen numbers. A checkpoint stores all but `bad`, `lost`, `broken`.

    start   the values before the first step
    tail    sums of the values over the last steps (Adam on noisy gradients: their mean is the result)
    course  means of every parameter (`result.brief`) after each of the last steps
    paces   mean changes in the same steps (`result.pace`)
    """

    iteration: int
    values: dict[str, np.ndarray]
    moments: dict[str, tuple[laplacian.Moments, ...]]
    held: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    tail: dict[str, np.ndarray]
    trace: list[float]
    course: list[np.ndarray] = field(default_factory=list)
    paces: list[np.ndarray] = field(default_factory=list)
    newton: scene_newton.Newton | None = None
    bad: list[Bad] = field(default_factory=list)
    lost: int = 0
    broken: dict[int, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Unknowns:
    """The parameters to fit, by name, and masks of their free numbers (`only`, by name)."""

    keys: str | Sequence[str]
    only: Mapping[str, np.ndarray] | None = None


@dataclass(frozen=True)
class Evidence:
    """The reference pictures with their sensors and masks; None: the scene's sensors, every pixel."""

    references: Any
    sensors: Any = None
    masks: Any = None


@dataclass(frozen=True)
class Objective:
    """The loss (None: depends on the renderer) and the added regularizers."""

    loss: str | scene_grad.Loss | None = None
    regularizers: Sequence[Regularizer] = ()


def prepare(
    scene: Any,
    unknowns: Unknowns,
    evidence: Evidence,
    objective: Objective,
    plan: FitPlan,
    integrator: Any = None,
    fast: bool = True,
) -> tuple[SceneProblem, list[str]]:
    """Validate the inputs and assemble the problem; returns it with notes."""
    keys, loss, regularizers = unknowns.keys, objective.loss, objective.regularizers
    counts = [plan.iterations, plan.spp, plan.sensors_per_step, 1 if plan.spp_grad is None else plan.spp_grad]
    if min(counts) < 1 or not plan.rate > 0:
        raise UsageError("iterations, spp, spp_grad and sensors_per_step must be 1 or more, and rate above 0.")
    if isinstance(loss, str) and loss not in scene_grad.NAMES:
        raise UsageError(f"the loss '{loss}' is not known; expected {', '.join(scene_grad.NAMES)}, or a function.")
    if plan.solver not in SOLVERS:
        raise UsageError(f"the solver '{plan.solver}' is not known; expected {', '.join(SOLVERS)}.")
    engine, notes = scene_grad.ad_integrator(scene, integrator)
    chosen = scene_keys.match(scene, [keys] if isinstance(keys, str) else keys, engine)
    views = _views(scene, evidence.sensors, evidence.references, evidence.masks)
    notes = [*notes, *(f"{p.name}: {note}" for p in chosen for note in p.notes)]
    if len(views) < FEWEST_VIEWS:
        notes.append(
            f"{len(views)} view{'s' * (len(views) > 1)} given: with fewer than {FEWEST_VIEWS} the fit is singular, "
            "since different materials look alike."
        )
    table = mi.traverse(scene)
    table.properties = {p.key: table.properties[p.key] for p in chosen}
    free = _free_masks(chosen, unknowns.only or {})
    scales = {p.key: _scale(p, scene_grad.array(table[p.key], p)) for p in chosen}
    quick, why = None, "it was not requested."
    if fast:
        try:
            named = loss or "log_srgb_l1"
            quick = DeferredRenderer(scene, chosen, views, named if isinstance(named, str) else "", engine)
        except Unsupported as reason:
            why = str(reason)
    if loss is None:
        loss = "relative" if quick is None else "log_srgb_l1"
    unsuited = "regularizers came" if regularizers else scene_newton.refusal(chosen, free, views, loss)
    unsuited = "gradients are exact without it" if quick is not None else unsuited
    if plan.solver == "gauss-newton" and unsuited:
        raise UsageError(
            f"the solver 'gauss-newton' cannot do this fit: {unsuited}. Leave it to 'auto', or use 'adam'."
        )
    newton = plan.solver != "adam" and not unsuited
    notes.append(_way(quick, engine, why))
    if quick is None and loss == "log_srgb_l1":
        notes.append(
            "The loss log_srgb_l1 is not linear in the picture: render noise shifts its minimum by several percent at "
            "16 samples a pixel. The loss 'relative' has no such bias."
        )
    losses = tuple(scene_grad.loss_of(loss, view) for view in views)
    constants = (scene, table, chosen, views, engine, loss, losses, tuple(regularizers), free, scales, plan)
    return SceneProblem(*constants, fast=quick, newton=newton), notes


def _way(quick: Any, engine: Any, why: str) -> str:
    if quick is not None:
        return "Gradients were noise-free: direct light of points and directions on plain `principled` materials."
    return f"Gradients came from {str(engine).partition('[')[0]}, not from the fast path: {why}"


def _free_masks(chosen: Sequence[Parameter], only: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Masks of the free numbers."""
    free = {p.key: np.ones(p.shape, bool) for p in chosen}
    for name, mask in only.items():
        for p in scene_keys.choose(chosen, [name]):
            wide = mask[..., None] if np.ndim(mask) == len(p.shape) - 1 else mask
            if np.ndim(wide) != len(p.shape) or any(
                n not in (1, m) for n, m in zip(np.shape(wide), p.shape, strict=True)
            ):
                raise UsageError(f"`only` of {p.name} has the shape {np.shape(mask)}; expected {p.shape}.")
            free[p.key] = np.broadcast_to(wide, p.shape).astype(bool)
    return free


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
        raise UsageError("the scene has no sensor; pass one as `sensors`, or add it to the scene file.")
    if len(references) != len(cameras) or (masks is not None and len(masks) != len(cameras)):
        counted = f"{len(references)} references" + (f" and {len(masks)} masks" if masks is not None else "")
        raise UsageError(f"found {counted} for {len(cameras)} sensors; expected one of each for every sensor.")
    return tuple(
        scene_grad.sight(camera, np.asarray(references[k]), masks[k] if masks is not None else None, _called(camera, k))
        for k, camera in enumerate(cameras)
    )


def _called(camera: Any, k: int) -> str:
    named = camera.id() and not camera.id().startswith(("_", "object_"))
    return f"sensor {k} ('{camera.id()}')" if named else f"sensor {k}"


def _scale(parameter: Parameter, values: np.ndarray) -> float:
    """The rate's unit: 1 for values limited to 0..1, else the magnitude of the numbers."""
    bounds = scene_keys.limits(parameter)
    if parameter.owner == "NormalMap" or (bounds is not None and np.isfinite(bounds[1])):
        return 1.0
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))) or 1.0


def begun(job: SceneProblem) -> FitState:
    """The state before the first step."""
    stored = {p.key: scene_grad.array(job.table[p.key], p) for p in job.chosen}
    values = {p.key: np.where(job.free[p.key], scene_keys.project(p, stored[p.key]), stored[p.key]) for p in job.chosen}
    moments = {p.key: laplacian.start(p.shape, job.plan.pyramid) for p in job.chosen}
    held = {p.key: np.zeros(p.shape, bool) for p in job.chosen}
    tail = {p.key: np.zeros(p.shape) for p in job.chosen}
    newton = scene_newton.Newton(scene_newton.gathered(job, values)) if job.newton else None
    return FitState(0, values, moments, held, dict(values), tail, [], newton=newton)


def _fingerprint(job: SceneProblem) -> str:
    """The identity of a fit that a checkpoint must match."""
    loss = job.loss if isinstance(job.loss, str) else getattr(job.loss, "__name__", type(job.loss).__name__)
    films = [list(view.reference.shape) for view in job.views]
    return json.dumps([[(p.name, p.shape) for p in job.chosen], films, loss, len(job.regularizers), asdict(job.plan)])


def checkpoint(state: FitState, job: SceneProblem) -> dict[str, np.ndarray]:
    result = {
        "job": np.array(_fingerprint(job)),
        "iteration": np.array(state.iteration),
        "trace": np.array(state.trace),
        "course": np.array(state.course, np.float64),
        "paces": np.array(state.paces, np.float64),
    }
    for p in job.chosen:
        for name in ("values", "start", "tail", "held"):
            result[f"{p.name}/{name}"] = getattr(state, name)[p.key].copy()
        for k, level in enumerate(state.moments[p.key]):
            for name in ("first", "second", "steps"):
                result[f"{p.name}/{name}{k}"] = getattr(level, name).copy()
    if state.newton is not None:
        result |= {f"newton/{name}": value for name, value in scene_newton.saved(state.newton).items()}
    return result


def restored(saved: Mapping[str, np.ndarray], job: SceneProblem) -> FitState:
    if "job" not in saved or str(saved["job"]) != _fingerprint(job):
        raise UsageError(
            "the checkpoint belongs to another fit: its keys, cameras or settings differ. Start without it, or use "
            "the settings of its fit."
        )
    moments = {}
    for p in job.chosen:
        count = len(laplacian.sizes(p.shape, job.plan.pyramid))
        moments[p.key] = tuple(
            laplacian.Moments(*(np.array(saved[f"{p.name}/{name}{k}"]) for name in ("first", "second", "steps")))
            for k in range(count)
        )
    kinds: Any = {"values": np.float32, "held": bool, "start": np.float32, "tail": np.float64}
    held: Any = {
        name: {p.key: np.array(saved[f"{p.name}/{name}"], kind) for p in job.chosen} for name, kind in kinds.items()
    }
    newton = {k.removeprefix("newton/"): v for k, v in saved.items() if k.startswith("newton/")}
    return FitState(
        int(saved["iteration"]),
        moments=moments,
        trace=[float(x) for x in saved["trace"]],
        course=list(np.array(saved["course"])),
        paces=list(np.array(saved["paces"])),
        newton=scene_newton.brought_back(newton) if newton else None,
        **held,
    )
