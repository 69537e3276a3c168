"""The verb `mistyle compare`: pictures against references, or renderers against each other."""

import argparse
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

from mistyle.cli.options import add_overwrite_option, examples, given_defines
from mistyle.core.errors import UsageError
from mistyle.core.paths import real_path


def add_compare(verbs: Any) -> None:
    verb = verbs.add_parser(
        "compare",
        help="measure how renders or renderers differ: metrics, limits, a page",
        **examples(
            """
            mistyle compare reference.exr test.exr -o diff/                 all metrics, every layer, diff/index.html
            mistyle compare frames_old/ frames_new/ -o diff/ --max flip=0.05 --min psnr=35       exit 5 when one fails
            mistyle compare a.exr b.exr c.exr -o diff/ --metrics flip,psnr --crop 200,120,96,64
            mistyle compare --baseline golden/ renders/ -o diff/ --limits compare.toml
            mistyle compare --baseline golden/ renders/ --approve 'shot_01*'
            mistyle compare --render chair.glb --with mitsuba:path --with blender:cycles -o diff/
            """
        ),
    )
    verb.add_argument("pictures", type=Path, nargs="*", metavar="PICTURE", help="REFERENCE TEST…: files, or folders")
    verb.add_argument("-o", "--out", type=Path, metavar="OUT", help="folder for the page and the tables")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="compare.json on stdout, logs on stderr")
    _add_what(verb)
    _add_limits(verb)
    _add_render(verb)
    verb.set_defaults(command=run_compare)


def add_converge(verbs: Any) -> None:
    verb = verbs.add_parser(
        "converge",
        help="measure how fast renderers converge: error over samples and seconds",
        **examples(
            """
            mistyle converge room.xml --with mitsuba:path,mitsuba:direct -o curves/
            mistyle converge chair.glb --with mitsuba:path --with blender:cycles --max-spp 256 -o curves/
            """
        ),
    )
    verb.add_argument(
        "scene", type=Path, metavar="SCENE", help="a Mitsuba XML (trusted like code), a GLB or other mesh"
    )
    verb.add_argument("--with", dest="renderers", action="append", default=[], metavar="A,B", help="as for compare")
    verb.add_argument("-o", "--out", type=Path, metavar="OUT", help="folder for the page and the tables")
    verb.add_argument("--max-spp", type=int, default=64, metavar="N", help="doubles samples up to N (default 64)")
    verb.add_argument("--seeds", type=int, default=4, metavar="N", help="independent renders of each (default 4)")
    verb.add_argument("--reference", type=Path, metavar="FILE.exr", help="the converged picture")
    verb.add_argument(
        "--reference-spp", type=int, metavar="N", help="or samples of the reference render of A (16 x --max-spp)"
    )
    verb.add_argument("--lights", default="studio", metavar="A", help="light of a mesh: studio, key, grazing, FILE.hdr")
    verb.add_argument("--size", type=int, default=256, metavar="N", help="pixels along each side, for a mesh")
    verb.add_argument("--sensor", type=int, default=0, metavar="K", help="sensor of a scene file")
    verb.add_argument(
        "-D", dest="defines", action="append", default=[], metavar="NAME=VALUE", help="as for mitsuba, for a scene file"
    )
    verb.add_argument("--blender", metavar="PYTHON", help="Python with bpy, for blender:cycles")
    verb.add_argument("--threads", type=int, metavar="N", help="threads of blender:cycles (default: all)")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="converge.json on stdout, logs on stderr")
    verb.set_defaults(command=_converge)


def _converge(options: argparse.Namespace) -> int:
    from mistyle.comparison.converge import ConvergeJob, converge
    from mistyle.jobs.progress import Progress

    names = [n.strip() for text in options.renderers for n in _split(text) if n.strip()]
    if not names or options.out is None:
        raise UsageError("converge needs SCENE, --with A,B and -o OUT")
    if options.seeds < 2 or options.max_spp < 2 or options.size < 1:
        raise UsageError("--seeds and --max-spp are 2 at least: intervals and slopes need two points")
    job = ConvergeJob(
        scene=options.scene,
        renderers=tuple(names),
        out=options.out,
        max_spp=options.max_spp,
        seeds=options.seeds,
        size=options.size,
        lights=options.lights,
        sensor=options.sensor,
        defines=given_defines(options.defines),
        reference=options.reference,
        reference_spp=options.reference_spp or 0,
        threads=options.threads or 0,
        blender=options.blender,
        overwrite=options.overwrite,
    )
    progress = Progress()
    _print_curves(options, converge(job, progress))
    progress.tell_notes()
    return 0


def _split(text: str) -> list[str]:
    """A,B split at commas; a command (with '=') stays whole, since it may contain commas."""
    return [text] if "=" in text else text.split(",")


def _print_curves(options: argparse.Namespace, record: dict[str, Any]) -> None:
    """Print the errors, slopes and efficiencies of every renderer."""
    from mistyle.comparison.converge import METRICS, without_nan

    if options.json:
        print(json.dumps(without_nan(record)))
        return
    for row in record["curves"]:
        print(f"{row['renderer']}  (against {record['reference']})")
        for k, spp in enumerate(row["spp"]):
            cells = "  ".join(f"{m} {row[m][k][0]:.4g} ± {row[m][k][1]:.2g}" for m in METRICS)
            print(f"  {spp:>6} spp  {row['seconds'][k][0]:8.3f} s  {cells}")
        print("  slopes  " + "  ".join(f"{m} {v[0]:.3f} ± {v[1]:.2g}" for m, v in row["slope"].items()))
    for name, ratio in record["efficiency"].items():
        print(
            f"{name}: {ratio['ratio']:.3g} ({ratio['low']:.3g} to {ratio['high']:.3g}) times as efficient as the first"
        )
    print(f"page      {options.out / 'index.html'}")


def _add_what(verb: argparse.ArgumentParser) -> None:
    group = verb.add_argument_group("pictures and metrics")
    group.add_argument("--metrics", metavar="A,B", help="only these (default: all; --list-metrics defines them)")
    group.add_argument("--list-metrics", action="store_true", help="every metric with its definition, and stop")
    group.add_argument("--layer", action="append", default=[], metavar="NAME", help="only this layer; may be repeated")
    group.add_argument("--mask", metavar="alpha|FILE", help="pixels to compare: the reference's alpha, or a picture")
    group.add_argument(
        "--window", choices=["display", "overlap"], default="display", help="overlap: where both have data"
    )
    group.add_argument(
        "--protocol", choices=["stanford-orb", "tensoir", "idiff"], help="the metrics of that evaluation code instead"
    )
    group.add_argument("--ppd", type=float, metavar="N", help="pixels per degree for FLIP (default 67.02)")
    group.add_argument("--peak", type=float, default=1.0, metavar="X", help="peak of the linear PSNR (default 1)")
    group.add_argument(
        "--exposures", metavar="FIRST,LAST,N", help="stops for HDR-FLIP (default: derived from the reference)"
    )
    group.add_argument(
        "--lpips", nargs=2, type=Path, metavar=("BACKBONE", "HEADS"), help="weights of LPIPS-squeeze v0.1"
    )
    group.add_argument("--show", type=int, default=48, metavar="N", help="pictures of the N worst rows (default 48)")
    group.add_argument("--crop", metavar="X,Y,W,H", help="also draw the inset figure: inset.png, inset.pdf")


def _add_limits(verb: argparse.ArgumentParser) -> None:
    limits = verb.add_argument_group("limits; a failed one ends with exit code 5")
    limits.add_argument("--max", action="append", default=[], metavar="METRIC=X", help="at most X")
    limits.add_argument("--min", action="append", default=[], metavar="METRIC=X", help="at least X")
    limits.add_argument("--limits", type=Path, metavar="compare.toml", help="limits from a file, also per image")
    limits.add_argument("--allow-nonfinite", action="store_true", help="NaN and infinite pixels do not fail the gate")
    limits.add_argument(
        "--allow-missing",
        action="store_true",
        help="pictures that only one folder has, and layers that only the reference has, do not fail the gate",
    )
    limits.add_argument("--baseline", type=Path, metavar="DIR", help="the approved pictures, instead of REFERENCE")
    limits.add_argument("--approve", action="append", default=[], metavar="NAME", help="copy TEST's NAME into DIR")


def _add_render(verb: argparse.ArgumentParser) -> None:
    render = verb.add_argument_group("renderers instead of pictures")
    render.add_argument(
        "--render", type=Path, metavar="FILE", help="a mesh, a run folder of ours, or a Mitsuba XML (trusted)"
    )
    render.add_argument(
        "--with",
        dest="renderers",
        action="append",
        default=[],
        metavar="A",
        help="mitsuba:path, mitsuba:direct, mitsuba@VENV:path, blender:cycles, NAME='command {scene} {out}'; the first "
        "is the reference",
    )
    render.add_argument("--lights", default="studio", metavar="A,B", help="studio, key, grazing, FILE.hdr")
    render.add_argument("--spp", type=int, default=64, metavar="N", help="samples per pixel (default 64)")
    render.add_argument("--size", type=int, default=256, metavar="N", help="pixels along each side (default 256)")
    render.add_argument("--seeds", type=int, default=8, metavar="N", help="independent renders for the z-test")
    render.add_argument("--blender", metavar="PYTHON", help="Python with bpy, for blender:cycles")
    render.add_argument("--threads", type=int, metavar="N", help="threads of blender:cycles (default: all)")
    render.add_argument("--views", type=int, default=1, metavar="N", help="cameras around the asset (default 1)")


def run_compare(options: argparse.Namespace) -> int:
    """Dispatch to pictures, approvals and renderers."""
    if options.list_metrics:
        return _list()
    if options.render is not None:
        if options.pictures:
            raise UsageError("give either pictures or --render FILE --with A --with B, not both")
        return _compare_renders(options)
    if options.approve:
        return _approve(options)
    job = job_of(options)
    from mistyle.comparison.pipeline import compare
    from mistyle.jobs.progress import Progress

    return print_record(options, compare(job, Progress()))


def _compare_renders(options: argparse.Namespace) -> int:
    if len(options.renderers) < 2:
        raise UsageError("--render needs two renderers: --with A --with B; the first one is the reference")
    if options.out is None:
        raise UsageError("compare needs -o OUT")
    if min(options.spp, options.size, options.seeds, options.views) < 1:
        raise UsageError("--spp, --size, --seeds and --views are 1 at least")
    from mistyle.comparison.renderers import RenderJob, compare_renders
    from mistyle.jobs.progress import Progress

    job = RenderJob(
        file=options.render,
        renderers=tuple(options.renderers),
        out=options.out,
        lights=tuple(name for name in options.lights.split(",") if name),
        spp=options.spp,
        size=options.size,
        seeds=options.seeds,
        views=options.views,
        threads=options.threads or 0,
        blender=options.blender,
        overwrite=options.overwrite,
    )
    return print_record(options, compare_renders(job, partial(job_of, options), Progress()))


def _list() -> int:
    from mistyle.measure.pictures.metrics import METRICS, Viewing, definitions
    from mistyle.measure.pictures.protocols import PROTOCOLS

    for name, text in definitions(Viewing(), list(METRICS)).items():
        print(f"{name} ({METRICS[name].better} is better): {text}\n")
    for name, text in PROTOCOLS.items():
        print(f"--protocol {name}: {text}\n")
    return 0


def _approve(options: argparse.Namespace) -> int:
    if options.baseline is None or len(options.pictures) != 1:
        raise UsageError("--approve NAME needs --baseline DIR and one folder of new pictures")
    from mistyle.comparison.baseline import approve

    names = approve(options.baseline, options.pictures[0], options.approve, overwrite=options.overwrite)
    print(json.dumps({"approved": names}) if options.json else "\n".join(f"approved {name}" for name in names))
    return 0


def job_of(options: argparse.Namespace, reference: Path | None = None, tests: tuple[Path, ...] = ()) -> Any:
    """The job of the command line; `reference` and `tests` replace the pictures of the command line."""
    from mistyle.comparison.limits import checked, parse, read_limits
    from mistyle.comparison.records import CompareJob
    from mistyle.measure.pictures.metrics import COLOUR, DATA, METRICS

    if reference is None:
        reference, tests = _pictures_of(options)
    if options.out is None:
        raise UsageError("compare needs -o OUT")
    metrics = COLOUR + DATA
    if options.metrics:
        metrics = tuple(checked(n.strip(), list(METRICS), "--metrics") for n in options.metrics.split(",") if n.strip())
    known = _protocol_names(options.protocol) if options.protocol else [n for n in metrics if _measured(n, options)]
    file = _limits_file(options, reference)
    general, specific = read_limits(file, known) if file is not None else ([], [])
    from_options = [parse(text, "max", known) for text in options.max] + [
        parse(text, "min", known) for text in options.min
    ]
    safe(options.out, [reference, *tests])
    return CompareJob(
        reference=reference,
        tests=tests,
        out=options.out,
        metrics=metrics,
        layers=tuple(options.layer),
        window=options.window,
        mask=options.mask,
        viewing=_viewing(options),
        protocol=options.protocol,
        limits=(*general, *from_options, *specific),
        allow_nonfinite=options.allow_nonfinite,
        allow_missing=options.allow_missing,
        pictures=options.show,
        crop=_crop(options.crop),
        overwrite=options.overwrite,
    )


def _pictures_of(options: argparse.Namespace) -> tuple[Path, tuple[Path, ...]]:
    pictures = list(options.pictures)
    if options.baseline is not None:
        if not pictures:
            raise UsageError("--baseline DIR needs the new pictures: mistyle compare --baseline DIR TEST -o OUT")
        return options.baseline, tuple(pictures)
    if len(pictures) < 2:
        raise UsageError("compare needs REFERENCE and TEST; see mistyle compare --help")
    return pictures[0], tuple(pictures[1:])


def _protocol_names(protocol: str) -> list[str]:
    return {
        "stanford-orb": ["psnr_h", "psnr_l", "ssim"],
        "tensoir": ["psnr", "ssim"],
        "idiff": ["mean_error", "rms_error", "peak_snr", "max_error", "over"],
    }[protocol]


def _measured(name: str, options: argparse.Namespace) -> bool:
    return name != "lpips" or options.lpips is not None


def _limits_file(options: argparse.Namespace, reference: Path) -> Path | None:
    """--limits, or a compare.toml in the reference's folder."""
    if options.limits is not None:
        return options.limits
    beside = reference / "compare.toml"
    return beside if beside.is_file() else None


def safe(out: Path, inputs: list[Path]) -> None:
    """UsageError where OUT contains an input: the next comparison would read this one's pictures as inputs."""
    for path in inputs:
        if real_path(path).is_relative_to(real_path(out)):
            raise UsageError(f"-o {out}: holds the input {path}; choose another folder")


def _viewing(options: argparse.Namespace) -> Any:
    from mistyle.measure.pictures.metrics import PPD, Viewing

    if options.ppd is not None and not 1 <= options.ppd <= 1000:
        raise UsageError(f"--ppd {options.ppd}: expected 1 to 1000 pixels per degree")
    if not options.peak > 0:
        raise UsageError(f"--peak {options.peak}: expected a number above 0")
    viewing = Viewing(options.ppd or PPD, options.peak, _exposures(options.exposures))
    if options.lpips is None:
        return viewing
    from dataclasses import replace

    from mistyle.measure.lpips import load_lpips

    text = f"SqueezeNet 1.1 backbone, v0.1 heads ({options.lpips[0].name}, {options.lpips[1].name}), mean over the mask"
    return replace(viewing, lpips=load_lpips(*options.lpips), lpips_text=text)


def _exposures(text: str | None) -> tuple[float, float, int] | None:
    if text is None:
        return None
    try:
        first, last, count = (float(v) for v in text.split(","))
    except ValueError:
        first, last, count = 0.0, 0.0, 0.0
    if not (-32 <= first <= last <= 32 and 2 <= count <= 64 and count == int(count)):
        raise UsageError(f"--exposures {text}: expected FIRST,LAST,N in stops, N from 2 to 64; for example -2,3,6")
    return first, last, int(count)


def _crop(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        x, y, width, height = (int(v) for v in text.split(","))
    except ValueError:
        raise UsageError(f"--crop {text}: expected X,Y,WIDTH,HEIGHT in pixels") from None
    return x, y, width, height


def print_record(options: argparse.Namespace, record: dict[str, Any]) -> int:
    """Print the record and return the exit code: 5 if a limit failed."""
    if options.json:
        print(json.dumps(record))
    else:
        _print(record, options.out)
    for text in record["notes"]:
        print(f"note      {text}", file=sys.stderr)
    for text in record["failures"][:20]:
        print(f"mistyle: failed: {text}", file=sys.stderr)
    if len(record["failures"]) > 20:
        print(f"mistyle: and {len(record['failures']) - 20} more failures in compare.json", file=sys.stderr)
    return 0 if record["passed"] else 5


def _print(record: dict[str, Any], out: Path) -> None:
    for part in record["summary"]:
        if not part["values"]:
            continue
        print(f"{part['test']} [{part['layer']}], {part['images']} image(s), {part['failed']} failed")
        for name, value in part["values"].items():
            mean, worst = (
                v if isinstance(v, str) else "n/a" if v is None else f"{v:.5g}" for v in _mean_and_worst(value)
            )
            several = f"   worst {worst}" if part["images"] > 1 else ""
            print(f"  {name:<12} {mean:>10}{several}")
    print("definitions of the metrics:")
    for name, text in record["definitions"].items():
        print(f"  {name}: {text}")
    print(f"page      {out / 'index.html'}\ntables    {out / 'compare.csv'}, compare.json, junit.xml")


def _mean_and_worst(value: dict[str, Any]) -> tuple[Any, Any]:
    return value["mean"], value["worst"]
