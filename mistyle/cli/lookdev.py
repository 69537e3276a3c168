"""The verbs `mistyle view` and `mistyle lookdev`."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from mistyle.cli.options import add_overwrite_option, examples
from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path


def add_view(verbs: Any) -> None:
    verb = verbs.add_parser(
        "view",
        help="open the report of a finished run",
        **examples(
            """
            mistyle view out/                 in the browser
            mistyle view out/ --print         print its path only
            """
        ),
    )
    verb.add_argument("out", type=Path, metavar="OUT", help="a run folder, or a report's index.html")
    verb.add_argument("--print", dest="only_print", action="store_true", help="print the path, open nothing")
    verb.add_argument("--json", action="store_true", help="one JSON object on stdout, open nothing")
    verb.set_defaults(command=_view)


def add_lookdev(verbs: Any) -> None:
    verb = verbs.add_parser(
        "lookdev",
        help="draw a look-dev sheet of an asset: three lights, five sides, turntables",
        **examples(
            """
            mistyle lookdev out/ -o sheet/                              the asset of a run
            mistyle lookdev helmet.glb -o sheet/ --hdri venice_sunset.hdr
            mistyle lookdev helmet.glb -o sheet/ --turntable 48 --hdri-turn 48
            mistyle lookdev out/ -o sheet/ --size 280 --spp 16           quick and small
            """
        ),
    )
    verb.add_argument("asset", type=Path, metavar="ASSET", help="a mesh file, or a run folder")
    verb.add_argument("-o", "--out", type=Path, required=True, metavar="OUT")
    verb.add_argument("--hdri", type=Path, metavar="FILE", help=".hdr or .exr for the third light (default: a sky)")
    verb.add_argument("--turntable", type=int, metavar="N", help="also N frames of the asset turning, PNG and WebP")
    verb.add_argument("--hdri-turn", type=int, metavar="N", help="also N frames of the third light turning")
    verb.add_argument("--mp4", action="store_true", help="the turntables as mp4 too (needs mistyle[video])")
    verb.add_argument("--size", type=int, metavar="N", help="pixels of the largest pictures of the asset (560)")
    verb.add_argument("--frame", type=int, metavar="N", help="pixels of a turntable's frame (512)")
    verb.add_argument("--spp", type=int, metavar="N", help="samples per pixel (64)")
    verb.add_argument("--seed", type=int, metavar="N", help="every random choice follows from it (0)")
    verb.add_argument("--threads", type=int, metavar="N", help="threads to use (all cores)")
    verb.add_argument("--date", metavar="TEXT", help="the date in the burn-in (that of the asset's file)")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="the paths as one JSON object on stdout")
    verb.set_defaults(command=_lookdev)


def _lookdev(options: argparse.Namespace) -> int:
    from mistyle.deliver.lookdev.job import LookSettings, lookdev
    from mistyle.jobs.progress import Progress
    from mistyle.jobs.settings import validate

    names = LookSettings.model_fields
    chosen = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    settings = validate(chosen, "lookdev", LookSettings)
    progress = Progress()
    files = lookdev(
        options.asset,
        options.out,
        settings,
        progress,
        hdri=options.hdri,
        date=options.date,
        overwrite=options.overwrite,
    )
    record = files | {"notes": progress.notes}
    print(json.dumps(record) if options.json else "\n".join(f"{k:<10} {v}" for k, v in files.items()))
    progress.tell_notes()
    return 0


def report_of(place: Path) -> Path:
    """The absolute path of the page of a run folder (or of its report folder, or of the page). Raises InputRefused."""
    candidates = [place] if place.suffix == ".html" else [place / "report" / "index.html", place / "index.html"]
    for path in candidates:
        if path.is_file():
            return real_path(path)
    raise InputRefused(
        f"{place}: found no report; expected a finished run folder with report/index.html. "
        "`mistyle stylize` and `mistyle fit` write one; rerun an unfinished job to resume it"
    )


def has_display() -> bool:
    """Whether this machine can show a browser window."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or os.environ.get("BROWSER"))


def _view(options: argparse.Namespace) -> int:
    page = report_of(options.out)
    if options.json:
        print(json.dumps({"report": str(page)}))
        return 0
    print(page)
    if options.only_print:
        return 0
    import webbrowser

    if has_display() and webbrowser.open(page.as_uri()):
        return 0
    import socket

    print(
        "no browser on this machine. The report is one self-contained file; copy it to a desktop:\n"
        f"  scp {socket.gethostname()}:{page} .",
        file=sys.stderr,
    )
    return 0
