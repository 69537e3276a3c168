"""A plan as files for a farm's own queue: Open Job Description, a Slurm array, or plain command lines.

Every form runs the same shards (`mistyle shard`), which skip what is done, so a job may be submitted again at any time.
"""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from mistyle.files.output import claim, keep_folder, replace_files
from mistyle.files.store import atomic_write
from mistyle.run.batch_plan import PLAN, BatchPlan, write_plan
from mistyle.run.shard import SHARDS, claim_batch

Form = Literal["openjd", "sbatch", "commands"]
BUNDLE = ("template.yaml", "parameter_values.yaml", "asset_references.yaml")
SHARD_GRACE = 60  # seconds between the request to stop and the end


def export(
    plan: BatchPlan,
    folder: Path,
    form: Form,
    *,
    threads: int,
    memory_gb: float = 8.0,
    gpus: int = 0,
    chunk: int = 1,
    program: str = "mistyle",
    maps: Sequence[tuple[str, str]] = (),
) -> list[Path]:
    """Write the plan and what a queue needs into `folder`; returns the files.

    `program` is how a worker calls mistyle; `maps` how workers see this machine's folders; `chunk` how many shards a
    task has at first.
    """
    names = {"openjd": BUNDLE, "sbatch": ("mistyle.sbatch",), "commands": ("commands.txt",)}[form]
    claim_batch(plan)
    claim(folder, names, overwrite=plan.overwrite)
    keep_folder(plan.out, SHARDS)
    write_plan(plan)
    if form == "openjd":
        files = _openjd(plan, threads, memory_gb, gpus, chunk, program, maps)
    elif form == "sbatch":
        files = {"mistyle.sbatch": _sbatch(plan, threads, memory_gb, gpus, program, maps)}
    else:
        lines = [_line(plan, program, str(k), maps) for k in range(len(plan.jobs))]
        files = {"commands.txt": "\n".join(lines) + "\n"}

    def fill(new: Path) -> None:
        for name, text in files.items():
            atomic_write(new / name, text.encode())

    replace_files(folder, "farm", fill, overwrite=plan.overwrite)
    return [folder / name for name in files]


def _line(plan: BatchPlan, program: str, index: str, maps: Sequence[tuple[str, str]]) -> str:
    """One shard as a line for a shell; `index` may be a variable of that shell."""
    from mistyle.run.batch_plan import replaced

    options = [part for source, target in maps for part in ("--path-map", f"{source}={target}")]
    options += ["--overwrite"] * plan.overwrite
    place = replaced(str(plan.out / PLAN), maps)
    return f"{program} shard {shlex.quote(place)} --index {index} {shlex.join(options)}".rstrip()


def _sbatch(plan: BatchPlan, threads: int, memory_gb: float, gpus: int, program: str, maps) -> str:
    from mistyle.run.batch_plan import replaced

    logs = replaced(str(plan.out / "shards"), maps)
    options = [
        f"--job-name=mistyle-{plan.out.name}",
        f"--array=0-{len(plan.jobs) - 1}",
        f"--cpus-per-task={threads}",
        f"--mem={round(memory_gb * 1024)}M",
        *([f"--gres=gpu:{gpus}"] if gpus else []),
        # Asked to stop early enough to write a checkpoint; the array task then counts as failed and may be resubmitted.
        f"--signal=B:TERM@{SHARD_GRACE}",
        "--requeue",
        f"--output={logs}/slurm-%A_%a.log",
    ]
    return "\n".join(
        [
            "#!/bin/bash",
            *(f"#SBATCH {option}" for option in options),
            # `exec`: the signal reaches the shard itself.
            f"exec {_line(plan, program, '${SLURM_ARRAY_TASK_ID}', maps)}",
            "",
        ]
    )


def _openjd(
    plan: BatchPlan, threads: int, memory_gb: float, gpus: int, chunk: int, program: str, maps
) -> dict[str, str]:
    """template.yaml (as JSON, which is YAML), parameter_values.yaml and asset_references.yaml of a job bundle."""
    amounts: list[dict[str, Any]] = [
        {"name": "amount.worker.vcpu", "min": threads},
        {"name": "amount.worker.memory", "min": round(memory_gb * 1024)},
    ]
    if gpus:
        amounts.append({"name": "amount.worker.gpu", "min": gpus})
    options = [part for source, target in maps for part in ("--path-map", f"{source}={target}")]
    options += ["--overwrite"] * plan.overwrite
    words = shlex.split(program)
    arguments = [
        *words[1:],
        "shard",
        "{{Param.Plan}}",
        "--index",
        "{{Task.Param.Index}}",
        "--progress",
        "openjd",
        *options,
    ]
    template = {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": f"mistyle {plan.out.name}"[:128],
        "parameterDefinitions": [
            {
                "name": "Plan",
                "type": "PATH",
                "objectType": "FILE",
                "dataFlow": "IN",
                "description": "plan.json of the batch; its folder receives the results",
            }
        ],
        "steps": [
            {
                "name": "Shards",
                "parameterSpace": {
                    "taskParameterDefinitions": [
                        {
                            "name": "Index",
                            "type": "CHUNK[INT]",
                            "range": f"0-{len(plan.jobs) - 1}",
                            "chunks": {"defaultTaskCount": chunk, "rangeConstraint": "CONTIGUOUS"},
                        }
                    ]
                },
                "hostRequirements": {"amounts": amounts},
                "script": {
                    "actions": {
                        "onRun": {
                            "command": words[0],
                            "args": arguments,
                            "cancelation": {
                                "mode": "NOTIFY_THEN_TERMINATE",
                                "notifyPeriodInSeconds": SHARD_GRACE,
                            },
                        }
                    }
                },
            }
        ],
    }
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
    return {
        "template.yaml": json.dumps(template, indent=1) + "\n",
        "parameter_values.yaml": json.dumps(values, indent=1) + "\n",
        "asset_references.yaml": json.dumps(references, indent=1) + "\n",
    }
