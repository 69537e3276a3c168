"""The verbs `mistyle batch`, `mistyle shard`, `mistyle farm` and `mistyle pack`."""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mistyle.cli.options import (
    DELIVERY_OPTIONS,
    NAME_HELP,
    add_delivery_options,
    add_overwrite_option,
    examples,
    given_settings,
)
from mistyle.process.children import PARENT


def add_batch(verbs: Any) -> None:
    _add_batch(verbs)
    _add_shard(verbs)
    _add_farm(verbs)
    _add_pack(verbs)


def _add_batch(verbs: Any) -> None:
    verb = verbs.add_parser(
        "batch",
        help="run many jobs from a list, a grid or a folder; rerun to resume",
        **examples(
            """
            mistyle batch jobs.toml -o OUT/                        [[job]] and [[grid]] entries; also .yaml
            mistyle batch props/ -o OUT/ --dry-run                 every mesh of the folder with every picture
            mistyle batch jobs.toml -o OUT/ --workers 8 --watch    eight at a time, with a live table
            mistyle batch OUT/                                     resume unfinished jobs, wherever OUT is now
            mistyle batch jobs.toml -o /share/OUT --engine ray --address auto --gpus 0.5
            """
        ),
    )
    verb.add_argument("jobs", type=Path, metavar="JOBS", help="a .toml or .yaml file, a folder, or the OUT of a batch")
    verb.add_argument("-o", "--out", type=Path, metavar="OUT", help="folder of the whole batch")
    _add_machine_options(verb)
    verb.add_argument(
        "--engine", choices=["local", "ray"], default="local", help="processes of this machine, or a Ray cluster"
    )
    verb.add_argument("--address", help="Ray: address of a running cluster, or auto (default: a new one, local)")
    verb.add_argument("--gpus", type=float, default=0.0, metavar="X", help="Ray: GPUs of each job, a share is allowed")
    verb.add_argument(
        "--wait", type=float, default=300.0, metavar="S", help="Ray: seconds without a started job before giving up"
    )
    verb.add_argument("--timeout", type=float, metavar="S", help="stop a job that takes longer")
    verb.add_argument(
        "--only",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="only these jobs of the plan; --only=-b where a name begins with a dash",
    )
    verb.add_argument("--watch", action="store_true", help="a live table instead of a line per job")
    verb.add_argument("--dry-run", action="store_true", help="print the plan with time, disk and memory, and stop")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="the summary as one JSON object on stdout")
    verb.add_argument("--name", type=_pattern, metavar="PATTERN", help=NAME_HELP.format(default=", of every job"))
    add_delivery_options(verb, "OUT/<job>/delivered/<target>")
    verb.set_defaults(command=_batch)


def _pattern(text: str) -> str:
    if "{" not in text:
        raise argparse.ArgumentTypeError(f"'{text}' names all jobs alike; write {{mesh}}, {{style}} or {{v:03}}")
    return text


def _add_machine_options(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--workers", type=int, default=0, metavar="N", help="jobs at a time (default: one per two cores)")
    verb.add_argument(
        "--threads",
        type=int,
        default=0,
        metavar="N",
        help="threads of each job; results depend on them (default: cores / workers)",
    )


def _add_shard(verbs: Any) -> None:
    verb = verbs.add_parser(
        "shard",
        help="run one job of a batch's plan, as farm workers do",
        **examples(
            """
            mistyle shard OUT/plan.json --index 3
            mistyle shard OUT/plan.json --index 0-7,12 --path-map /mnt/show=/vol/show
            """
        ),
    )
    verb.add_argument("plan", type=Path, metavar="PLAN", help="plan.json, or its folder")
    verb.add_argument("--index", required=True, metavar="I", help="number of the shard, from 0; ranges run in order")
    _add_map_option(verb)
    verb.add_argument("--progress", choices=["lines", "openjd"], default="lines", help="openjd: for farms that read it")
    add_overwrite_option(verb)
    verb.set_defaults(command=_shard)


def _add_map_option(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--path-map", action="append", default=[], metavar="FROM=TO", help="this machine's path of a folder of the plan"
    )


def _add_farm(verbs: Any) -> None:
    farm = verbs.add_parser(
        "farm",
        help="write a batch as files for a farm's queue",
        **examples("mistyle farm export jobs.toml -o OUT/ --as openjd"),
    )
    kinds = farm.add_subparsers(dest="farm", metavar="ACTION", required=True)
    verb = kinds.add_parser(
        "export",
        help="Open Job Description bundle, Slurm array script, or command lines",
        **examples(
            """
            mistyle farm export jobs.toml -o OUT/ --as openjd       then: deadline bundle submit OUT/farm
            mistyle farm export jobs.toml -o OUT/ --as sbatch       then: sbatch OUT/farm/mistyle.sbatch
            mistyle farm export jobs.toml -o OUT/ --as commands --path-map /mnt/show=/vol/show
            """
        ),
    )
    verb.add_argument("jobs", type=Path, metavar="JOBS", help="as for mistyle batch")
    verb.add_argument("-o", "--out", type=Path, metavar="OUT", help="folder of the whole batch, seen by all workers")
    verb.add_argument("--as", dest="form", choices=["openjd", "sbatch", "commands"], default="openjd")
    verb.add_argument("--bundle", type=Path, metavar="DIR", help="where the files go (default OUT/farm)")
    verb.add_argument("--program", default="mistyle", help="how a worker calls mistyle (default mistyle)")
    verb.add_argument("--memory", type=float, default=8.0, metavar="GB", help="memory that a task requests")
    verb.add_argument("--gpus", type=int, default=0, metavar="N", help="GPUs that a task requests")
    verb.add_argument("--chunk", type=int, default=1, metavar="N", help="Open Job Description: shards of a task")
    _add_machine_options(verb)
    _add_map_option(verb)
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="the files as one JSON object on stdout")
    verb.add_argument("--name", type=_pattern, metavar="PATTERN", help=NAME_HELP.format(default=", of every job"))
    add_delivery_options(verb, "OUT/<job>/delivered/<target>")
    verb.set_defaults(command=_farm)


def _add_pack(verbs: Any) -> None:
    verb = verbs.add_parser(
        "pack",
        help="write a folder that installs mistyle without a network",
        **examples(
            """
            mistyle pack -o mistyle-offline/                   then, on the other machine: ./install.sh /opt/mistyle
            mistyle pack -o mistyle-offline/ --extras ray farm
            """
        ),
    )
    verb.add_argument("-o", "--out", type=Path, required=True, metavar="DIR")
    verb.add_argument("--extras", nargs="+", default=[], metavar="NAME", help="optional dependencies to include")
    add_overwrite_option(verb)
    verb.set_defaults(command=_pack)


def _pack(options: argparse.Namespace) -> int:
    from mistyle.batch.pack import pack
    from mistyle.jobs.progress import Progress

    folder = pack(options.out, options.extras, Progress(), overwrite=options.overwrite)
    print(f"packed: {folder} (install with {folder / 'install.sh'} TARGET)", file=sys.stderr)
    return 0


def _batch(options: argparse.Namespace) -> int:
    from mistyle.batch.pipeline import Choices, describe, describe_dry_run, dry_run, run_batch, say

    choices = Choices(
        engine=options.engine,
        workers=options.workers,
        threads=options.threads,
        address=options.address,
        gpus=options.gpus,
        wait=options.wait,
        timeout=options.timeout,
        only=tuple(options.only),
        watch=options.watch and sys.stderr.isatty(),
    )
    plan = _plan(options, choices)
    if options.dry_run:
        estimate = dry_run(plan, choices)
        print(json.dumps(estimate) if options.json else describe_dry_run(estimate))
        return 0
    summary = run_batch(plan, choices)
    if options.json:
        print(json.dumps(summary))
    say(describe(summary))
    return 1 if summary["failed"] or summary["open"] and not choices.only else 0


def _plan(options: argparse.Namespace, choices: Any) -> Any:
    """The plan of JOBS with the command line's options; its notes are printed, since they come before the work."""
    from mistyle.batch.pipeline import opening_notes, planned, say
    from mistyle.batch.plan import with_delivery

    base = replace(planned(options.jobs, options.out, choices), overwrite=options.overwrite)
    plan = with_delivery(base, given_settings(options, DELIVERY_OPTIONS))
    for note in opening_notes(plan):
        say(f"note      {note}")
    return plan


def _shard(options: argparse.Namespace) -> int:
    from mistyle.batch.plan import indices, path_maps, read_plan
    from mistyle.batch.shard import FarmProgress, run_shard, stages_of
    from mistyle.jobs.progress import Progress

    plan = replace(read_plan(options.plan, path_maps(options.path_map)), overwrite=options.overwrite)
    chosen: Sequence[int] = indices(options.index, len(plan.jobs))
    if len(chosen) > 1:
        return _run_range(options, chosen)
    for index in chosen:
        farm = options.progress == "openjd"
        progress = FarmProgress(len(stages_of(plan.jobs[index]))) if farm else Progress()
        progress.note(*run_shard(plan, index, progress)["notes"])
        progress.tell_notes()
    return 0


def _run_range(options: argparse.Namespace, chosen: Sequence[int]) -> int:
    """Run each shard of a range as a separate process, one after another; a failing shard does not stop the rest."""
    from mistyle.batch.engines import stopped

    worst = 0
    maps = [part for pair in options.path_map for part in ("--path-map", pair)]
    maps += ["--overwrite"] * options.overwrite
    for index in chosen:
        command = [sys.executable, "-m", "mistyle", "shard", str(options.plan), "--index", str(index)]
        own = os.environ | {PARENT: str(os.getpid())}
        child = subprocess.Popen([*command, "--progress", options.progress, *maps], env=own)
        try:
            code = child.wait()
        except BaseException:
            stopped(child)
            raise
        worst = max(worst, code if code >= 0 else 1)
    return worst


def _farm(options: argparse.Namespace) -> int:
    from mistyle.batch.farm import ShardNeeds, export
    from mistyle.batch.pipeline import Choices, say, threads_each
    from mistyle.batch.plan import path_maps

    choices = Choices(workers=options.workers, threads=options.threads)
    plan = _plan(options, choices)
    needs = ShardNeeds(
        threads_each(choices),
        options.memory,
        options.gpus,
        options.chunk,
        options.program,
        path_maps(options.path_map),
    )
    files = export(plan, options.bundle or plan.out / "farm", options.form, needs)
    if options.json:
        print(json.dumps({"files": [str(p) for p in files], "shards": len(plan.jobs)}))
    else:
        say("\n".join(str(p) for p in files))
    return 0
