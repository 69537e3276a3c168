"""The verb `mistyle demo`: `stylize` on the meshes and paintings of `scenes/`."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mistyle.cli.demo_inputs import DEFAULT, MESHES, PAINTINGS, demo_files
from mistyle.cli.options import asset_name, examples
from mistyle.core.errors import UsageError

MakeJob = Callable[..., Any]


def add_demo(verbs: Any, add_options: Callable[[argparse.ArgumentParser], None]) -> argparse.ArgumentParser:
    """`mistyle demo` with the options of `stylize` (`add_options`); its --style names a painting of `scenes/`."""
    verb = verbs.add_parser(
        "demo",
        conflict_handler="resolve",
        help="stylize a mesh with a painting, both included in mistyle",
        **examples(
            f"""
            mistyle demo                                 {PAINTINGS[DEFAULT].mesh} and {DEFAULT}, into mistyle-demo/
            mistyle demo --style pixel                   another painting, on the mesh that suits it
            mistyle demo --style oil --mesh robot        both chosen
            mistyle demo --all -o demos/                 all four, each in a folder, and demos/demo.png
            mistyle demo --style hatched --stroke-scale 1.5 --atlas 1024
            """
        ),
    )
    verb.add_argument("-o", "--out", type=Path, default=Path("mistyle-demo"), help="run folder (default mistyle-demo)")
    add_options(verb)
    descriptions = "; ".join(f"{name}: {painting.words}" for name, painting in PAINTINGS.items())
    verb.add_argument("--style", dest="painting", choices=list(PAINTINGS), help=f"{descriptions} (default {DEFAULT})")
    pairs = ", ".join(f"{p.mesh} for {name}" for name, p in PAINTINGS.items())
    verb.add_argument("--mesh", choices=list(MESHES), help=f"the mesh to paint (default: {pairs})")
    verb.add_argument("--all", action="store_true", help="all four paintings: OUT/STYLE/ for each, and OUT/demo.png")
    return verb


def demo(options: argparse.Namespace, make_job: MakeJob, run_job: Callable[..., int]) -> int:
    """Run the job or jobs of the options. `make_job` and `run_job` take options, mesh, style, preset, name."""
    if not options.all:
        mesh, style = demo_files(options.painting, options.mesh)
        return run_job(options, mesh, style, "demo", asset_name(options, "demo"))
    if options.painting or options.variations:
        option = "--style" if options.painting else "--variations"
        raise UsageError(f"--all runs every painting once; leave out {option}, or --all")
    jobs = []
    for name in PAINTINGS:
        mesh, style = demo_files(name, options.mesh)
        own = argparse.Namespace(**{**vars(options), "out": options.out / name})
        jobs.append(make_job(own, mesh, style, "demo", asset_name(options, "demo", name)))
    return _plans(options, jobs) if options.dry_run else _all(options, jobs)


def _plans(options: argparse.Namespace, jobs: list[Any]) -> int:
    from mistyle.jobs.plan import describe_plan
    from mistyle.stylization.pipeline.plan import plan

    plans = {job.out.name: plan(job) for job in jobs}
    if options.json:
        print(json.dumps(plans, indent=1))
    else:
        print("\n\n".join(f"{name}\n{describe_plan(estimate)}" for name, estimate in plans.items()))
    return 0


def _all(options: argparse.Namespace, jobs: list[Any]) -> int:
    from mistyle.cli.demo_inputs import run_all
    from mistyle.jobs.progress import Progress

    progress = Progress()
    results = run_all(jobs, options.out, progress, overwrite=options.overwrite)
    if options.json:
        print(json.dumps(results))
    else:
        if results["sheet"]:
            print(f"sheet     {results['sheet']}", file=sys.stderr)
        for run in results["runs"]:
            print(f"report    {run['report']}", file=sys.stderr)
    progress.tell_notes()
    return 0
