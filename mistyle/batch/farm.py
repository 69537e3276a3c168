"""Submission files for a farm's queue: Open Job Description, a Slurm array, or plain command lines.

Every form runs the same shards (`mistyle shard`). Finished shards are skipped, so a job may be submitted again at any
time.
"""

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mistyle.batch.plan import PLAN, BatchPlan, write_plan
from mistyle.batch.shard import SHARDS, claim_batch
from mistyle.io.store.atomic import atomic_write
from mistyle.io.store.output import claim, keep_folder, replace_files

Form = Literal["openjd", "sbatch", "commands"]
BUNDLE = ("template.yaml", "parameter_values.yaml", "asset_references.yaml")
SHARD_GRACE = 60  # seconds between the stop request and the kill


@dataclass(frozen=True)
class ShardNeeds:
    """The resources of each shard, and the worker's command and paths.

    threads, memory_gb, gpus  of one shard
    chunk                     default number of shards per task (Open Job Description)
    program                   the worker's command for mistyle
    maps                      (folder on this machine, folder on the workers)
    """

    threads: int
    memory_gb: float = 8.0
    gpus: int = 0
    chunk: int = 1
    program: str = "mistyle"
    maps: Sequence[tuple[str, str]] = ()


def export(plan: BatchPlan, folder: Path, form: Form, needs: ShardNeeds) -> list[Path]:
    """Write the plan, and the submission files into `folder`; returns these files."""
    names = {"openjd": BUNDLE, "sbatch": ("mistyle.sbatch",), "commands": ("commands.txt",)}[form]
    claim_batch(plan)
    claim(folder, names, overwrite=plan.overwrite)
    keep_folder(plan.out, SHARDS)
    write_plan(plan)
    if form == "openjd":
        files = _openjd(plan, needs)
    elif form == "sbatch":
        files = {"mistyle.sbatch": _sbatch(plan, needs)}
    else:
        lines = [_shell_command(plan, needs, str(k)) for k in range(len(plan.jobs))]
        files = {"commands.txt": "\n".join(lines) + "\n"}

    def fill(new: Path) -> None:
        for name, text in files.items():
            atomic_write(new / name, text.encode())

    replace_files(folder, "farm", fill, overwrite=plan.overwrite)
    return [folder / name for name in files]


def _options(plan: BatchPlan, needs: ShardNeeds) -> list[str]:
    """The common options of all `mistyle shard` commands of the plan."""
    maps = [part for source, target in needs.maps for part in ("--path-map", f"{source}={target}")]
    return [*maps, *["--overwrite"] * plan.overwrite]


def _shell_command(plan: BatchPlan, needs: ShardNeeds, index: str) -> str:
    """The shell command of one shard; `index` may be a shell variable."""
    from mistyle.batch.plan import replaced

    place, options = replaced(str(plan.out / PLAN), needs.maps), shlex.join(_options(plan, needs))
    return f"{needs.program} shard {shlex.quote(place)} --index {index} {options}".rstrip()


def _sbatch(plan: BatchPlan, needs: ShardNeeds) -> str:
    """A batch script of Slurm: an array of shards."""
    from mistyle.batch.plan import replaced

    logs = replaced(str(plan.out / "shards"), needs.maps)
    options = [
        f"--job-name=mistyle-{plan.out.name}",
        f"--array=0-{len(plan.jobs) - 1}",
        f"--cpus-per-task={needs.threads}",
        f"--mem={round(needs.memory_gb * 1024)}M",
        *([f"--gres=gpu:{needs.gpus}"] if needs.gpus else []),
        # SIGTERM leaves time for a checkpoint; the array task then counts as failed and may be resubmitted.
        f"--signal=B:TERM@{SHARD_GRACE}",
        "--requeue",
        f"--output={logs}/slurm-%A_%a.log",
    ]
    return "\n".join(
        [
            "#!/bin/bash",
            *(f"#SBATCH {option}" for option in options),
            # `exec`: the signal reaches the shard itself.
            f"exec {_shell_command(plan, needs, '${SLURM_ARRAY_TASK_ID}')}",
            "",
        ]
    )


def _openjd(plan: BatchPlan, needs: ShardNeeds) -> dict[str, str]:
    """template.yaml (as JSON, which is YAML), parameter_values.yaml and asset_references.yaml of a job bundle."""
    inputs = sorted({str(p) for job in plan.jobs for p in (job.mesh, job.style, job.references) if p is not None})
    folders = [p for p in inputs if Path(p).is_dir()]
    values = {"parameterValues": [{"name": "Plan", "value": str(plan.out / PLAN)}]}
    references = {
        "assetReferences": {
            "inputs": {"filenames": [p for p in inputs if p not in folders], "directories": folders},
            "outputs": {"directories": [str(plan.out)]},
            "referencedPaths": [],
        }
    }
    bundle = zip(BUNDLE, (_job_template(plan, needs), values, references), strict=True)
    return {name: json.dumps(tree, indent=1) + "\n" for name, tree in bundle}


def _job_template(plan: BatchPlan, needs: ShardNeeds) -> dict[str, Any]:
    """The job template (Open Job Description 2023-09): one step, whose tasks are chunks of shards."""
    plan_file = {
        "name": "Plan",
        "type": "PATH",
        "objectType": "FILE",
        "dataFlow": "IN",
        "description": "plan.json of the batch; its folder receives the results",
    }
    index = {
        "name": "Index",
        "type": "CHUNK[INT]",
        "range": f"0-{len(plan.jobs) - 1}",
        "chunks": {"defaultTaskCount": needs.chunk, "rangeConstraint": "CONTIGUOUS"},
    }
    program = shlex.split(needs.program)
    shard = ["shard", "{{Param.Plan}}", "--index", "{{Task.Param.Index}}", "--progress", "openjd"]
    run = {
        "command": program[0],
        "args": [*program[1:], *shard, *_options(plan, needs)],
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": SHARD_GRACE},
    }
    step = {
        "name": "Shards",
        "parameterSpace": {"taskParameterDefinitions": [index]},
        "hostRequirements": {"amounts": _amounts(needs)},
        "script": {"actions": {"onRun": run}},
    }
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": f"mistyle {plan.out.name}"[:128],
        "parameterDefinitions": [plan_file],
        "steps": [step],
    }


def _amounts(needs: ShardNeeds) -> list[dict[str, Any]]:
    """The worker requirements of Open Job Description: cores, MiB of memory, GPUs."""
    amounts: list[dict[str, Any]] = [
        {"name": "amount.worker.vcpu", "min": needs.threads},
        {"name": "amount.worker.memory", "min": round(needs.memory_gb * 1024)},
    ]
    if needs.gpus:
        amounts.append({"name": "amount.worker.gpu", "min": needs.gpus})
    return amounts
