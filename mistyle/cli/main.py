"""The command line. Heavy modules are imported only when a command runs, so that --help answers at once.

Exit codes: 0 done, 1 a job failed, 2 usage or settings, 3 input refused, 4 environment missing, 5 a quality gate
failed, 75 stopped and resumable, 130 interrupted.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mistyle import __version__
from mistyle.cli import exits
from mistyle.cli.batch import add_batch
from mistyle.cli.compare import add_compare, add_converge
from mistyle.cli.demo import add_demo, demo
from mistyle.cli.export import add_export, add_verify
from mistyle.cli.fit import add_fit
from mistyle.cli.lookdev import add_lookdev, add_view
from mistyle.cli.models import GENERATIVE_OPTIONS, add_generative_options, add_models
from mistyle.cli.options import (
    DELIVERY_OPTIONS,
    NAME_HELP,
    PAINT_OPTIONS,
    REPORT_OPTIONS,
    SHAPE_OPTIONS,
    VerbParser,
    add_delivery_options,
    add_job_options,
    add_memory_option,
    add_mesh_options,
    add_paint_options,
    add_report_option,
    add_shape_options,
    asset_name,
    examples,
    given_settings,
)
from mistyle.cli.train import add_train
from mistyle.core.errors import UsageError

Command = Callable[[argparse.Namespace], int]


# The main verbs in the order of --help; the other verbs follow under "more".
USED = ("demo", "stylize", "fit", "render", "bake", "compare", "lookdev", "batch", "export", "view")


class _TwoGroups(argparse.RawDescriptionHelpFormatter):
    """Lists the verbs of USED, then the others under "more"."""

    def _iter_indented_subactions(self, action: argparse.Action) -> Iterator[argparse.Action]:
        rank = {verb: k for k, verb in enumerate(USED)}
        yield from sorted(super()._iter_indented_subactions(action), key=lambda verb: rank.get(verb.dest, len(USED)))

    def _format_action(self, action: argparse.Action) -> str:
        text = super()._format_action(action)
        first, _, rest = text.partition("COMMAND\n")
        if not isinstance(action, argparse._SubParsersAction) or not rest:
            return text
        lines = rest.splitlines(keepends=True)
        more = max(k for k, line in enumerate(lines) if line.split()[:1] == [USED[-1]]) + 1
        return "".join([*lines[:more], "\nmore:\n", *lines[more:]])


def parser() -> argparse.ArgumentParser:
    """Every verb with its options and examples."""
    top = VerbParser(
        prog="mistyle",
        description="One mesh and one style picture in; the same mesh with stylized, physically based textures out.",
        epilog="examples:\n"
        "  python3 -m mistyle demo                                 sets up and stylizes an included mesh\n"
        "  mistyle stylize bunny.obj starry_night.jpg -o out/      writes asset, textures and report\n"
        "  mistyle stylize --help                                  options and examples of a verb\n\n"
        "mistyle doctor lists present and missing parts of the environment, with the commands that install them.",
        formatter_class=_TwoGroups,
    )
    top.add_argument("--version", action="version", version=f"mistyle {__version__}")
    verbs = top.add_subparsers(dest="verb", metavar="COMMAND", required=True, title="commands")
    _add_stylize(verbs)
    _add_demo(verbs)
    _add_render(verbs)
    _add_bake(verbs)
    add_fit(verbs)
    add_train(verbs)
    add_models(verbs)
    add_compare(verbs)
    add_converge(verbs)
    add_batch(verbs)
    add_export(verbs)
    add_view(verbs)
    add_lookdev(verbs)
    add_verify(verbs)
    # Without help: the footer names it.
    doctor = verbs.add_parser(
        "doctor",
        description="Lists present and missing parts of the environment, with the commands that install them.",
        **examples("mistyle doctor --json"),
    )
    doctor.add_argument("--json", action="store_true", help="one JSON object on stdout")
    doctor.set_defaults(command=_doctor)
    test = verbs.add_parser(
        "test",
        help="set up and run the test suite; arguments go to pytest",
        **examples("python3 -m mistyle test tests/cli/test_cli.py -x"),
    )
    test.add_argument("arguments", nargs="*", help="passed on to pytest")
    test.set_defaults(command=_test)
    return top


def _add_view_options(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--rig", help="paper (16 views), nbv (as few as the mesh needs), turntable, or a camera.json / transforms.json"
    )
    verb.add_argument("--resolution", type=int, metavar="N", help="pixels along each side of a view")
    verb.add_argument("--spp", type=int, metavar="N", help="samples per pixel of the rendered views")
    verb.add_argument(
        "--scene", type=Path, help="a Mitsuba scene; the mesh replaces its shape 'object' (trusted like code)"
    )
    verb.add_argument(
        "--paper-files", action="store_true", default=None, help="also write 8-bit depth maps and Canny edges"
    )


def _add_style_options(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--name", help=NAME_HELP.format(default=" (default MESH_STYLE)"))
    verb.add_argument(
        "--stylizer",
        choices=["embedded", "embedded-view", "diffusion"],
        help="embedded (default) paints the surface once; embedded-view paints view after view from earlier "
        "ones; diffusion does the same with SDXL (needs models)",
    )
    verb.add_argument("--atlas", type=int, metavar="N", help="texture size")
    verb.add_argument(
        "--samples", type=int, metavar="N", help="surface samples of the stylizer; more samples give finer strokes"
    )
    verb.add_argument(
        "--stroke-scale", type=float, metavar="X", help="size of the strokes on the surface, 1 is the default"
    )
    verb.add_argument(
        "--form",
        type=float,
        metavar="X",
        help="0 to 1: paint sky light and openness into the albedo, for hand-painted looks (default 0: no light)",
    )
    add_paint_options(verb)
    add_generative_options(verb)
    verb.add_argument(
        "--finish",
        choices=["off", "vgg"],
        help="vgg: after painting, move the albedo by style losses of VGG-19 on many rendered crops (needs --vgg; "
        "default off)",
    )
    verb.add_argument(
        "--refine",
        choices=["auto", "off", "normal-roughness", "albedo", "all"],
        help="maps that the differentiable fit may change (auto: all; for the embedded stylizer the albedo, in drafts "
        "none)",
    )
    verb.add_argument("--metallic", choices=["keep", "zero", "fit"], help="keep, zero or fit the asset's metalness")
    verb.add_argument(
        "--vgg",
        type=Path,
        metavar="FILE",
        help="VGG-19 weights (.safetensors or .pth) for the style losses of finish and fit",
    )
    add_shape_options(verb)
    verb.add_argument("--from", dest="redo_from", metavar="STAGE", help="redo this stage and all after it")
    verb.add_argument(
        "--preview",
        action="store_true",
        help="only paint, without fit and repair: four views and the maps on OUT/preview/preview.png; the same "
        "command without it resumes from there",
    )
    verb.add_argument(
        "--variations", type=int, metavar="N", help="only paint N seeds and stroke sizes on one contact sheet"
    )
    _add_dry_run(verb)
    add_memory_option(verb)
    add_report_option(verb)
    add_delivery_options(verb)


def _add_dry_run(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--dry-run", action="store_true", help="print estimated time, memory and disk, and stop")


def _add_stylize(verbs: Any) -> None:
    verb = verbs.add_parser(
        "stylize",
        help="paint a mesh in the style of a picture: asset, textures and report",
        **examples(
            """
            mistyle stylize bunny.obj starry_night.jpg -o out/
            mistyle stylize chair.glb great_wave.jpg -o out/ --preset draft --atlas 1024
            mistyle stylize spot.obj great_wave.jpg -o out/ --preview
            mistyle stylize spot.obj great_wave.jpg -o out/ --variations 4
            mistyle stylize chair.glb great_wave.jpg -o out/ --style seat=gold.jpg --stroke-size 3cm
            mistyle stylize helmet.glb woodcut.jpg -o out/ --uv keep --metallic keep --refine normal-roughness
            mistyle stylize bunny.obj starry_night.jpg -o out/ --from fit --set fit.iterations2=100
            mistyle stylize chair.usda wave.jpg -o out/ --formats glb,usd --target houdini
            mistyle stylize chair.glb wave.jpg -o out/ --target unreal,blender --name '{mesh}_{style}_v{v:03}'
            mistyle stylize bunny.obj starry_night.jpg -o out/ --displace 10%     after drawing a tuft in out/stylized/
            mistyle stylize bunny.obj starry_night.jpg -o out/ --report none
            mistyle stylize --preset paper --print-config > job.toml
            """
        ),
    )
    verb.add_argument("mesh", type=Path, nargs="?", metavar="MESH", help=".obj .ply .stl .off .glb .gltf .usd .usdz")
    verb.add_argument("style", type=Path, nargs="?", metavar="STYLE", help="any picture")
    verb.add_argument("-o", "--out", type=Path, metavar="OUT", help="run folder; rerun to resume")
    add_job_options(verb)
    add_mesh_options(verb)
    _add_view_options(verb)
    _add_style_options(verb)
    verb.set_defaults(command=_stylize)


def _add_demo(verbs: Any) -> None:
    def add_options(verb: argparse.ArgumentParser) -> None:
        add_job_options(verb)
        add_mesh_options(verb)
        _add_view_options(verb)
        _add_style_options(verb)

    add_demo(verbs, add_options).set_defaults(command=_demo)


def _add_render(verbs: Any) -> None:
    verb = verbs.add_parser(
        "render",
        help="render views of a mesh: layered EXR, PNG, camera and light files",
        **examples(
            """
            mistyle render bunny.obj -o views/
            mistyle render bunny.obj -o turn/ --rig turntable --resolution 512 --spp 64
            mistyle render chair.glb -o views/ --rig nbv --set rig.most_views=16
            mistyle render chair.glb -o views/ --rig transforms.json --paper-files
            mistyle render chair.glb -o flat/ --unlit
            """
        ),
    )
    verb.add_argument("mesh", type=Path, nargs="?", metavar="MESH")
    verb.add_argument("-o", "--out", type=Path, metavar="DIR")
    add_job_options(verb)
    add_mesh_options(verb)
    _add_view_options(verb)
    verb.add_argument("--unlit", action="store_true", help="views of the albedo without light, for painting and `bake`")
    _add_dry_run(verb)
    add_memory_option(verb)
    verb.set_defaults(command=_render)


def _add_bake(verbs: Any) -> None:
    verb = verbs.add_parser(
        "bake",
        help="project pictures of known cameras onto the texture: their colours become the albedo",
        **examples(
            """
            mistyle bake bunny.obj views/ -o baked/
            mistyle bake bunny.obj edited_views/ -o baked/ --atlas 4096
            """
        ),
    )
    verb.add_argument("mesh", type=Path, nargs="?", metavar="MESH")
    verb.add_argument("views", type=Path, nargs="?", metavar="VIEWS_DIR", help="camera.json and one picture per view")
    verb.add_argument("-o", "--out", type=Path, metavar="OUT")
    verb.add_argument("--atlas", type=int, metavar="N", help="texture size")
    verb.add_argument("--name", help="name of the asset (default: the mesh's)")
    add_job_options(verb)
    add_mesh_options(verb)
    _add_dry_run(verb)
    add_memory_option(verb)
    verb.set_defaults(command=_bake)


# Option of the command line -> dotted setting.
OPTIONS = {
    "seed": "seed",
    "threads": "threads",
    "memory": "memory",
    "uv": "read.uv",
    "up": "read.up",
    "lit": "read.lit",
    "resolution": "rig.resolution",
    "spp": "draw.spp",
    "scene": "draw.scene",
    "paper_files": "draw.paper_files",
    "atlas": "atlas.size",
    "stylizer": "stylizer",
    "samples": "surface.samples",
    "stroke_scale": "surface.stroke_scale",
    "form": "surface.form",
    **PAINT_OPTIONS,
    **GENERATIVE_OPTIONS,
    **DELIVERY_OPTIONS,
    **REPORT_OPTIONS,
    "finish": "finish.method",
    **SHAPE_OPTIONS,
    "refine": "fit.refine",
    "metallic": "fit.metallic",
    "vgg": "fit.features",
}


def _settings(options: argparse.Namespace, preset: str | None = None) -> Any:
    """The resolved settings of a command."""
    from mistyle.jobs.settings import merge
    from mistyle.stylization.settings import resolve

    return resolve(options.preset or preset, options.config, merge(_rig(options), given_settings(options, OPTIONS)))


def _rig(options: argparse.Namespace) -> dict[str, Any]:
    rig = getattr(options, "rig", None)
    if rig is None:
        return {}
    if rig in ("paper", "nbv", "turntable"):
        return {"rig": {"kind": rig}}
    return {"rig": {"kind": "file", "file": rig}}


def _stylize(options: argparse.Namespace) -> int:
    if options.print_config:
        return _print_config(options)
    _require(options, "mesh", "style", "out")
    return _run_job(options, options.mesh, options.style, None)


def _require(options: argparse.Namespace, *names: str) -> None:
    """UsageError for missing arguments, which only --print-config does not need."""
    missing = [name for name in names if getattr(options, name) is None]
    if missing:
        arguments = ", ".join("-o OUT" if m == "out" else m.upper() for m in missing)
        raise UsageError(f"{options.verb} needs {arguments}; see mistyle {options.verb} --help")


def _print_plan(options: argparse.Namespace, estimate: dict[str, Any]) -> int:
    from mistyle.jobs.plan import describe_plan

    print(json.dumps(estimate, indent=1) if options.json else describe_plan(estimate))
    return 0


def _demo(options: argparse.Namespace) -> int:
    return _print_config(options) if options.print_config else demo(options, _job, _run_job)


def _print_config(options: argparse.Namespace) -> int:
    from mistyle.jobs.settings import as_toml

    sys.stdout.write(as_toml(_settings(options)))
    return 0


def _job(options: argparse.Namespace, mesh: Path, style: Path, preset: str | None, name: str | None = None) -> Any:
    from mistyle.stylization.pipeline.job import Job

    settings = _settings(options, preset)
    title = name or asset_name(options, mesh.stem, style.stem)
    return Job(mesh, style, options.out, settings, title, options.redo_from, options.overwrite)


def _run_job(options: argparse.Namespace, mesh: Path, style: Path, preset: str | None, name: str | None = None) -> int:
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.pipeline.plan import plan
    from mistyle.stylization.pipeline.stylize import stylize

    job = _job(options, mesh, style, preset, name)
    settings = job.settings
    if options.dry_run:
        return _print_plan(options, plan(job))
    progress = Progress()
    if options.preview and options.variations:
        raise UsageError("--preview and --variations exclude each other; --variations shows several paintings")
    if options.preview:
        from mistyle.stylization.pipeline.preview import preview

        result = preview(job, progress)
        print(json.dumps(result) if options.json else f"preview   {result['preview']}")
        progress.tell_notes()
        return 0
    if options.variations:
        from mistyle.stylization.pipeline.variations import sheet

        result = sheet(mesh, style, options.out, settings, options.variations, progress, overwrite=options.overwrite)
        print(
            json.dumps(result) if options.json else "\n".join([f"sheet     {result['sheet']}", *result["variations"]])
        )
        progress.tell_notes()
        return 0
    summary = stylize(job, progress)
    if options.json:
        print(json.dumps(summary))
    else:
        for label in ("asset", "textures", "report", "picture", "views", "stylized"):
            if label in summary:
                print(f"{label:<9} {summary[label]}", file=sys.stderr)
    progress.tell_notes()
    return 0


def _render(options: argparse.Namespace) -> int:
    if options.print_config:
        return _print_config(options)
    _require(options, "mesh", "out")
    settings = _settings(options)
    if options.dry_run:
        from mistyle.stylization.pipeline.plan import plan_render
        from mistyle.stylization.pipeline.single_stages import claim_views

        claim_views(options.mesh, options.out, settings, options.overwrite)
        return _print_plan(options, plan_render(options.mesh, options.out, settings))
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.pipeline.single_stages import render_views

    progress = Progress()
    written = render_views(
        options.mesh, options.out, settings, progress, overwrite=options.overwrite, unlit=options.unlit
    )
    record = {"views": [str(p) for p in written], "notes": progress.notes}
    print(json.dumps(record) if options.json else f"views     {options.out}")
    progress.tell_notes()
    return 0


def _bake(options: argparse.Namespace) -> int:
    if options.print_config:
        return _print_config(options)
    _require(options, "mesh", "views", "out")
    settings, title = _settings(options), asset_name(options, options.mesh.stem)
    if options.dry_run:
        from mistyle.stylization.pipeline.plan import plan_bake
        from mistyle.stylization.pipeline.single_stages import claim_baked

        claim_baked(options.mesh, options.views, options.out, title, options.overwrite)
        return _print_plan(options, plan_bake(options.mesh, options.views, options.out, settings, title))
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.pipeline.single_stages import bake_views

    progress = Progress()
    summary = bake_views(
        options.mesh, options.views, options.out, settings, title, progress, overwrite=options.overwrite
    )
    print(json.dumps(summary) if options.json else f"asset     {summary['asset']}")
    progress.tell_notes()
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from mistyle.cli import doctor

    return doctor.main(json=options.json)


def _test(options: argparse.Namespace) -> int:
    raise UsageError("run the tests as `python3 -m mistyle test` from a clone of the repository")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; every expected failure becomes one sentence on stderr."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if not words:
        parser().print_help()
        return UsageError.exit_code
    options = parser().parse_args(words)
    return exits.run(options.command, options)
