"""The verb `mistyle fit`: a material for a mesh from pictures, or texture parameters of any Mitsuba scene."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from mistyle.cli.options import (
    DELIVERY_OPTIONS,
    NAME_HELP,
    REPORT_OPTIONS,
    add_delivery_options,
    add_job_options,
    add_memory_option,
    add_mesh_options,
    add_report_option,
    asset_name,
    examples,
    given_defines,
    given_settings,
)
from mistyle.core import names
from mistyle.core.errors import UsageError

# Option of the command line -> dotted setting.
OPTIONS = {
    "seed": "seed",
    "threads": "threads",
    "uv": "read.uv",
    "up": "read.up",
    "lit": "read.lit",
    "atlas": "atlas.size",
    "start": "start",
    "align": "references.align",
    "refine_poses": "references.refine_poses",
    "hold_out": "references.hold_out",
    "hold_out_light": "references.hold_out_light",
    "photometry": "photometry.mode",
    "material": "recover.model",
    "frame": "recover.frame",
    "metallic": "recover.metallic",
    "iterations": "recover.iterations",
    "passes": "passes",
    "minutes": "minutes",
    "memory": "memory",
    **REPORT_OPTIONS,
    **DELIVERY_OPTIONS,
}
LIGHT_HELP = "unknown: estimate the light too; outdoors: an environment and a sun"
SCENE_OPTIONS = {
    name: name for name in ("seed", "threads", "variant", "iterations", "spp", "spp_grad", "loss", "channels")
}


def add_fit(verbs: Any) -> None:
    verb = verbs.add_parser(
        "fit",
        help="recover albedo, normal and roughness from pictures, or parameters of a Mitsuba scene",
        **examples(
            """
            mistyle fit chair.glb photographs/ -o fitted/                    camera.json or transforms.json, lights.json
            mistyle fit chair.glb colmap/ -o fitted/ --align --light unknown  a COLMAP model, unknown light
            mistyle fit helmet.glb renders/ -o fitted/ --uv new --metallic --material gltf
            mistyle fit chair.glb photographs/ -o fitted/ --dry-run          estimated time, memory and disk
            mistyle fit --scene room.xml --list                              parameters of a scene that can be fitted
            mistyle fit --scene room.xml --references shots/ -o out/ --optimize 'chair.*.base_color' wall.bsdf.roughness
            """
        ),
    )
    verb.add_argument("mesh", type=Path, nargs="?", metavar="MESH", help=".obj .ply .stl .off .glb .gltf .usd .usdz")
    verb.add_argument(
        "references",
        type=Path,
        nargs="?",
        metavar="REFERENCES",
        help="a folder with pictures and camera.json, transforms.json, a COLMAP model, Meshroom's cameras.sfm, "
        "Metashape's XML, or RealityScan's CSV or XMP files",
    )
    verb.add_argument("-o", "--out", type=Path, metavar="OUT", help="run folder; rerun to resume")
    verb.add_argument("--dry-run", action="store_true", help="print estimated time, memory and disk, and stop")
    add_job_options(
        verb, ("draft", "standard"), "draft: a texture of 512² and a ninth of the steps; standard (default): 1024²"
    )
    add_memory_option(verb)
    add_mesh_options(verb)
    _add_reference_options(verb)
    _add_material_options(verb)
    _add_scene_options(verb)
    verb.set_defaults(command=run_fit)


def _add_reference_options(verb: argparse.ArgumentParser) -> None:
    group = verb.add_argument_group("the pictures")
    group.add_argument(
        "--lights", type=Path, metavar="FILE", help="a lights.json (default: the one beside the cameras)"
    )
    group.add_argument("--light", choices=["known", "unknown", "outdoors"], default="known", help=LIGHT_HELP)
    group.add_argument(
        "--albedo-of",
        metavar="MASK=VALUE",
        help="scale of an unknown light: MASK, named after a picture, is white where albedo is VALUE (0.18 or r,g,b)",
    )
    group.add_argument("--masks", type=Path, metavar="DIR", help="a mask per picture, by name; white pixels are valid")
    group.add_argument("--exposure", type=Path, metavar="FILE", help="JSON: stops (ev) or factor of each picture")
    group.add_argument(
        "--pictures", type=Path, metavar="DIR", help="folder of the pictures (default: the paths in the cameras' file)"
    )
    group.add_argument(
        "--photometry",
        choices=["none", "exposure", "full"],
        help="solve for exposures, or also white balance, vignetting and veiling light (default: full for 8-bit "
        "pictures without --exposure, else none)",
    )
    group.add_argument(
        "--align", action="store_true", default=None, help="find the similarity from the mesh to the cameras' space"
    )
    group.add_argument("--refine-poses", action="store_true", default=None, help="improve the cameras before fitting")
    group.add_argument("--hold-out", type=int, metavar="N", help="hold N pictures out of the fit and measure them")
    group.add_argument(
        "--hold-out-light", type=int, metavar="K", help="hold the pictures of the K-th light (from 0) out of the fit"
    )


def _add_material_options(verb: argparse.ArgumentParser) -> None:
    group = verb.add_argument_group("the material")
    group.add_argument("--name", help=NAME_HELP.format(default=" (default: the mesh's)"))
    group.add_argument("--atlas", type=int, metavar="N", help="texture size")
    group.add_argument(
        "--material", choices=["principled", "gltf"], help="Mitsuba's principled (default), or glTF's for engines"
    )
    group.add_argument("--frame", choices=["mikkt", "mitsuba"], help="tangent frame of the normal map (default mikkt)")
    group.add_argument("--metallic", action="store_true", default=None, help="fit metalness too")
    group.add_argument("--start", choices=["nothing", "own"], help="own: start from the mesh's own material")
    group.add_argument("--iterations", type=int, metavar="N", help="steps of the gradient stage")
    group.add_argument("--minutes", type=float, metavar="M", help="end the fit after M minutes with its best result")
    group.add_argument("--passes", type=int, metavar="N", help="end the fit after N passes: the same bytes every time")
    group.add_argument("--from", dest="redo_from", metavar="STAGE", help="redo this stage and all after it")
    add_report_option(verb)
    add_delivery_options(verb)


def _add_scene_options(verb: argparse.ArgumentParser) -> None:
    scene = verb.add_argument_group("any Mitsuba scene instead of MESH and REFERENCES")
    scene.add_argument("--scene", type=Path, metavar="SCENE.xml", help="the scene (trusted like code)")
    scene.add_argument(
        "--references", dest="shots", type=Path, metavar="DIR", help="a picture per sensor, by id or order"
    )
    scene.add_argument("--optimize", nargs="+", default=[], metavar="KEY", help="parameters to fit; globs")
    scene.add_argument(
        "--list", action="store_true", help="list the parameters that can be fitted and why others cannot"
    )
    scene.add_argument(
        "--loss",
        choices=["auto", "relative", "log_srgb_l1", "l2"],
        help="relative (default for noisy renders): squared, over the reference's square; free of noise bias",
    )
    scene.add_argument("--spp", type=int, metavar="N", help="samples per pixel of a step's picture (default 16)")
    scene.add_argument(
        "--spp-grad",
        type=int,
        metavar="N",
        help="samples per pixel of the derivative (default 8 for numbers, 1 for textures)",
    )
    scene.add_argument(
        "--channels", metavar="PREFIX|A,B,C", help="channels of EXR references that hold more than R, G, B"
    )
    scene.add_argument("-D", dest="defines", action="append", default=[], metavar="NAME=VALUE", help="as for mitsuba")
    scene.add_argument("-m", dest="variant", metavar="VARIANT", help="as for mitsuba")
    scene.add_argument("-s", dest="sensor", type=int, metavar="INDEX", help="fit to this sensor only")
    scene.add_argument("-t", dest="threads", type=int, metavar="N", help="as --threads")


_ONLY_SCENE = ("optimize", "list", "defines", "sensor", "loss", "spp", "spp_grad", "channels")


def run_fit(options: argparse.Namespace) -> int:
    """Dispatch to the two uses; UsageError if they are mixed."""
    if options.scene is not None:
        if options.mesh is not None:
            raise UsageError("give either MESH and REFERENCES, or --scene SCENE.xml with --references DIR, not both")
        return _fit_scene(options)
    settings = material_settings(options)
    if options.print_config:
        from mistyle.jobs.settings import as_toml

        sys.stdout.write(as_toml(settings))
        return 0
    misplaced = [f"--{name}" for name in _ONLY_SCENE if getattr(options, name)]
    if misplaced:
        raise UsageError(f"{misplaced[0].replace('_', '-')} belongs to --scene SCENE.xml; see mistyle fit --help")
    missing = [n for n in ("mesh", "references", "out") if getattr(options, n) is None]
    if missing:
        arguments = ", ".join("-o OUT" if m == "out" else m.upper() for m in missing)
        raise UsageError(f"fit needs {arguments} (or --scene SCENE.xml); see mistyle fit --help")
    return _fit_mesh(options, settings)


def material_settings(options: argparse.Namespace) -> Any:
    """The resolved settings of `mistyle fit MESH REFERENCES`."""
    from mistyle.fitting.settings.material import MATERIAL_PRESETS, MaterialSettings
    from mistyle.jobs.settings import merge, resolve

    chosen = given_settings(options, OPTIONS)
    if options.light == "outdoors":
        chosen = merge(chosen, {"light": {"sun": True}})
    if options.albedo_of is not None:
        chosen = merge(chosen, {"light": {"albedo": known_albedo(options)[1]}})
    return resolve(options.preset, options.config, chosen, root=MaterialSettings, presets=MATERIAL_PRESETS)


def known_albedo(options: argparse.Namespace) -> tuple[Path, tuple[float, ...]]:
    """Mask and albedo of --albedo-of; UsageError for another form, and under known light."""
    mask, _, value = options.albedo_of.rpartition("=")
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if not mask or len(numbers) not in (1, 3) or not all(0 < number <= 1 for number in numbers):
        raise UsageError(f"--albedo-of {options.albedo_of}: expected MASK=VALUE with one or three numbers up to 1")
    if options.light == "known":
        raise UsageError("--albedo-of needs --light unknown or outdoors: a known light has its scale")
    return Path(mask), numbers * 3 if len(numbers) == 1 else numbers


def _fit_scene(options: argparse.Namespace) -> int:
    """List a scene's parameters, or fit them."""
    from mistyle.fitting.pipeline.scene import SceneJob, describe, fit_scene, list_row, listed, loaded
    from mistyle.fitting.report.scene import row_text
    from mistyle.fitting.settings.scene import SCENE_PRESETS, SceneSettings
    from mistyle.jobs.progress import Progress
    from mistyle.jobs.settings import as_toml, resolve

    if options.report is not None:
        raise UsageError("--report belongs to a fit of MESH and REFERENCES; fit --scene always writes its whole report")
    chosen = given_settings(options, SCENE_OPTIONS)
    settings = resolve(options.preset, options.config, chosen, root=SceneSettings, presets=SCENE_PRESETS)
    defines = given_defines(options.defines)
    if options.print_config:
        sys.stdout.write(as_toml(settings))
        return 0
    if options.list:
        parameters = listed(loaded(options.scene, defines, settings))
        print(json.dumps([list_row(p) for p in parameters]) if options.json else describe(parameters))
        return 0
    missing = [n for n, v in (("--references DIR", options.shots), ("-o OUT", options.out)) if v is None]
    if missing:
        raise UsageError(f"fit --scene needs {' and '.join(missing)}; --list shows the parameters")
    name = names.asset_name(options.name, options.scene.stem)
    arguments = (options.scene, options.shots, options.out, tuple(options.optimize), settings, name, defines)
    progress = Progress()
    summary = fit_scene(SceneJob(*arguments, sensor=options.sensor, overwrite=options.overwrite), progress)
    if options.json:
        print(json.dumps(summary))
    else:
        for row in summary["values"]:
            print(f"{row['name']}: {row_text(row)}", file=sys.stderr)
        for label in filter(summary.get, ("scene", "pictures", "report")):
            print(f"{label:<9} {summary[label]}", file=sys.stderr)
    progress.tell_notes()
    return 0


def _fit_mesh(options: argparse.Namespace, settings: Any) -> int:
    from mistyle.fitting.pipeline.job import MaterialJob
    from mistyle.fitting.pipeline.material import fit_material
    from mistyle.fitting.pipeline.plan import plan_material
    from mistyle.jobs.plan import describe_plan
    from mistyle.jobs.progress import Progress

    job = MaterialJob(
        options.mesh,
        options.references,
        options.out,
        settings,
        asset_name(options, options.mesh.stem),
        options.lights if options.light == "known" else "unknown",
        options.masks,
        options.exposure,
        options.pictures,
        redo_from=options.redo_from,
        overwrite=options.overwrite,
        albedo_of=None if options.albedo_of is None else known_albedo(options)[0],
    )
    if options.dry_run:
        estimate = plan_material(job)
        print(json.dumps(estimate, indent=1) if options.json else describe_plan(estimate))
        return 0
    progress = Progress()
    summary = fit_material(job, progress)
    if options.json:
        print(json.dumps(summary))
    else:
        for label in ("asset", "textures", "scene", "report", "picture"):
            if label in summary:
                print(f"{label:<9} {summary[label]}", file=sys.stderr)
        print(f"{'passes':<9} {summary['passes']['done']} of {summary['passes']['planned']}", file=sys.stderr)
        for name, value in summary["figures"].items():
            print(f"{name:<17} {value:.4g}", file=sys.stderr)
    progress.tell_notes()
    return 0
