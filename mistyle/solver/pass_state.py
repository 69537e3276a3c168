"""The state of a recovery between two passes, and its arrays in a checkpoint."""

import json
from dataclasses import dataclass, field, fields

import numpy as np

from mistyle.render.deferred.material_table import MaterialTable
from mistyle.solver.context import DirectCaptures, FitContext
from mistyle.solver.journal import Arrays, inside
from mistyle.solver.texels.records import Solution
from mistyle.solver.texels.solve import TexelEstimate


@dataclass(frozen=True)
class PassState:
    """After `done` passes.

    direct    the references without their estimated indirect light
    solution  of the per-texel solver, while its passes last
    estimate  its result at the atlas's resolution, after them
    table     after passes on whole pictures; `settled` once they have ended and been accepted or undone
    over      whether joint steps were undone, so that none follow
    """

    direct: DirectCaptures
    done: int = 0
    solution: Solution | None = None
    estimate: TexelEstimate | None = None
    table: MaterialTable | None = field(default=None, repr=False)
    settled: bool = False
    over: bool = False


def arrays_of(state: PassState, context: FitContext) -> Arrays:
    """The arrays from which `state_from` restores the state, with notes and trace of the context."""
    words = {name: getattr(state, name) for name in ("done", "settled", "over")}
    text = json.dumps(words | {"notes": context.notes, "trace": context.trace})
    flat: Arrays = {"words": np.frombuffer(text.encode(), np.uint8).copy()}
    flat |= {f"indirect.{k}": light for k, light in state.direct.indirect.items()}
    for name in ("solution", "estimate"):
        record = getattr(state, name)
        if record is not None:
            flat |= {f"{name}.{f.name}": np.asarray(getattr(record, f.name)) for f in fields(record)}
    return flat if state.table is None else flat | {"table": state.table}


def state_from(arrays: Arrays, context: FitContext) -> PassState:
    """The state of `arrays_of`; notes and trace return into the context."""
    words = json.loads(arrays["words"].tobytes())
    context.notes[:] = words["notes"]
    context.trace.clear()
    context.trace.update(words["trace"])
    direct = DirectCaptures(context.captures)
    for name, light in arrays.items():
        if name.startswith("indirect."):
            direct = direct.with_indirect(int(name.split(".")[1]), light)
    records = {name: inside(arrays, f"{name}.") for name in ("solution", "estimate")}
    solution = Solution(**records["solution"]) if records["solution"] else None
    estimate = None
    if records["estimate"]:
        solved = bool(records["estimate"].pop("solved"))
        estimate = TexelEstimate(**records["estimate"], solved=solved)
    own = {name: words[name] for name in ("done", "settled", "over")}
    return PassState(direct, solution=solution, estimate=estimate, table=arrays.get("table"), **own)
