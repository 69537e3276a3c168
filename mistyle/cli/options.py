"""Command line options that several verbs share, and their conversion to settings."""

import argparse
import difflib
import json
import re
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from mistyle.core import names
from mistyle.core.errors import UsageError

PRESET_HELP = (
    "draft: about a minute; standard (default); fine: 4096² and more steps; paper: the paper's method with its "
    "diffusion models (see mistyle models)"
)


NUMBER = re.compile(r"-\.?\d")  # begins a negative number, also one in a list or with a unit; never an option


class VerbParser(argparse.ArgumentParser):
    """A parser, and that of its verbs, whose options take values that begin with a dash. A wrong command line ends with
    a sentence instead of the usage, which is long; with --json also with an object, as every other error does."""

    wants_json = False  # whether the words hold --json

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = with_values(self, sys.argv[1:] if args is None else args)
        self.wants_json = "--json" in words
        found, unknown = super().parse_known_args(words, namespace)
        if unknown and self._subparsers is None:
            self.error(_about_unknown(self, unknown))
        return found, unknown

    def error(self, message: str) -> NoReturn:
        if self.wants_json:
            print(json.dumps({"error": message, "exit_code": 2}))
        self.exit(2, f"{self.prog}: {message} (`{self.prog} --help` lists all)\n")


def with_values(parser: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """The words, with values that begin with a dash behind their options: `--up=-y`.

    argparse takes each such word for an option unless it is a plain number. Here the word after an option of one value
    is that value where it is one of its choices or begins like a number, unless it is an option too.
    """
    known = parser._option_string_actions
    result: list[str] = []
    for word in words:
        option = _option(known, result[-1]) if result and "--" not in result else None
        if option is not None and option.nargs is None and word not in known and _dashed(word, option.choices):
            result[-1] += f"={word}"
        else:
            result.append(word)
    return result


def _about_unknown(parser: argparse.ArgumentParser, words: Sequence[str]) -> str:
    """What is wrong with words that the parser does not know, and the nearest option."""
    name = next((word.partition("=")[0] for word in words if word.startswith("-")), None)
    if name is None:
        return f"found '{' '.join(words)}' beside the arguments that it takes; quote names with spaces"
    near = difflib.get_close_matches(name, list(parser._option_string_actions), n=1, cutoff=0.7)
    settings = "; settings are given with --set" if "--set" in parser._option_string_actions else ""
    return f"there is no option '{name}'" + (f"; did you mean '{near[0]}'?" if near else settings)


def _dashed(word: str, choices: Iterable[Any] | None) -> bool:
    return word.startswith("-") and (word in (choices or ()) or NUMBER.match(word) is not None)


def _option(known: Mapping[str, argparse.Action], word: str) -> argparse.Action | None:
    """The option of this name, or the only one with this beginning; None for other words."""
    alike = {id(action): action for name, action in known.items() if word[:2] == "--" and name.startswith(word)}
    return known.get(word, next(iter(alike.values())) if len(alike) == 1 else None)


def examples(text: str) -> dict[str, Any]:
    return {
        "epilog": "examples:\n" + textwrap.indent(textwrap.dedent(text).strip(), "  "),
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def add_job_options(
    verb: argparse.ArgumentParser,
    presets: Sequence[str] = ("draft", "standard", "fine", "paper"),
    preset_help: str = PRESET_HELP,
) -> None:
    """Options that every job has; None where the user sets nothing."""
    verb.add_argument("--preset", choices=presets, help=preset_help)
    verb.add_argument(
        "--config", type=Path, metavar="JOB.toml", help="settings from a file, as --print-config prints them"
    )
    verb.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="any setting by its dotted name, as --print-config prints them",
    )
    verb.add_argument("--seed", type=int, help="seed of all random choices (default 0)")
    verb.add_argument("--threads", type=int, help="threads; the result depends on them (default: all cores)")
    verb.add_argument("--json", action="store_true", help="one JSON object on stdout, logs on stderr")
    verb.add_argument("--print-config", action="store_true", help="print every setting as TOML and stop")
    add_overwrite_option(verb)


def add_overwrite_option(verb: argparse.ArgumentParser) -> None:
    """The option that allows replacing files of an output folder."""
    verb.add_argument(
        "--overwrite",
        action="store_true",
        help="replace colliding files that mistyle did not write or that were edited; never an input",
    )


def gigabytes(text: str) -> float:
    """'4G', '4GB', '4096M' or '4' in GB (10^9 bytes)."""
    number = text.strip().upper().removesuffix("B")
    factor = {"M": 1e-3, "G": 1.0, "T": 1e3}.get(number[-1:], 1.0)
    try:
        size = float(number.rstrip("MGT")) * factor
    except ValueError:
        size = 0.0
    if not 0 < size < 1e5:
        raise argparse.ArgumentTypeError(f"'{text}' is not a valid memory size; write 4G or 4096M")
    return size


def add_memory_option(verb: argparse.ArgumentParser) -> None:
    """The memory budget of a job."""
    verb.add_argument("--memory", type=gigabytes, metavar="4G", help="memory budget; a job that needs more is refused")


# Option -> dotted setting, for `add_report_option`.
REPORT_OPTIONS = {"report": "report.detail"}


def add_report_option(verb: argparse.ArgumentParser) -> None:
    """The extent of the report."""
    verb.add_argument(
        "--report",
        choices=["none", "page", "full"],
        help="full (default): the page, turntable frames and a path-traced picture; page: the page alone; none",
    )


# Option -> dotted setting, for `add_paint_options`.
PAINT_OPTIONS = {
    "style_slot": "paint.slots",
    "style_mask": "paint.style_mask",
    "protect": "paint.protect",
    "stroke_size": "paint.stroke_size",
    "keep_content": "surface.keep_content",
    "palette_mix": "surface.palette_mix",
    "direction": "surface.direction",
    "direction_map": "paint.direction_map",
}
UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "": 1.0}


def length(text: str) -> float:
    """'3cm', '30mm', '0.03m' in metres; a bare number is in the mesh's own units, which count as metres."""
    number = text.rstrip("cm")
    unit = text[len(number) :]
    try:
        return float(number) * UNITS[unit]
    except (ValueError, KeyError):
        raise argparse.ArgumentTypeError(f"'{text}' is not a length; write 3cm, 30mm, 0.03m or a bare number") from None


def add_paint_options(verb: argparse.ArgumentParser) -> None:
    """Options of the paint: pictures per part, masks, stroke size and direction."""
    verb.add_argument(
        "--style",
        dest="style_slot",
        action="append",
        metavar="SLOT=PICTURE",
        help="another picture for a material of the mesh, or for the light parts of a mask in its UVs (repeatable)",
    )
    verb.add_argument(
        "--style-mask", type=Path, metavar="MASK", help="use only the parts of the style where this picture is light"
    )
    verb.add_argument(
        "--protect", type=Path, metavar="MASK", help="picture in the mesh's UVs: light parts keep their own material"
    )
    verb.add_argument(
        "--stroke-size",
        type=length,
        metavar="3cm",
        help="width of a stroke (a 32nd of the picture) on the mesh, equal for a set of props",
    )
    verb.add_argument(
        "--keep-content", type=float, metavar="0..1", help="weight of the mesh's own texture in light and dark"
    )
    verb.add_argument(
        "--palette-mix",
        type=float,
        metavar="0..1",
        help="1: rare colours of the picture cover as much area as common ones",
    )
    verb.add_argument(
        "--direction", choices=["curvature", "up", "around"], help="direction of strokes (default: the form)"
    )
    verb.add_argument(
        "--direction-map",
        type=Path,
        metavar="PICTURE",
        help="painted directions in the mesh's UVs, red along u and green along v (a flow map); grey: by the form",
    )


# Option -> dotted setting, for `add_shape_options`.
SHAPE_OPTIONS = {"displace": "displace.most", "height_map": "displace.height_map"}


def add_shape_options(verb: argparse.ArgumentParser) -> None:
    """Options of the shape: displaced vertices and the height map."""
    verb.add_argument(
        "--displace",
        metavar="2%",
        help="let vertices follow the outlines of edited or stylized views, by at most this share of the mesh's radius "
        "(default 0: the mesh stays unchanged)",
    )
    verb.add_argument(
        "--height-map",
        action="store_true",
        default=None,
        help="also write the painting's relief as a height map: 16-bit PNG, EXR, displacement in USD and MaterialX",
    )


# Option -> dotted setting, for `add_delivery_options`.
DELIVERY_OPTIONS = {
    "formats": "deliver.formats",
    "target": "deliver.target",
    "texture_name": "deliver.textures",
    "metres_per_unit": "deliver.metres_per_unit",
    "colorspace": "colour.space",
}


def add_delivery_options(verb: argparse.ArgumentParser, where: str = "OUT/delivered/<target>") -> None:
    """Formats, targets and colour space of the files for other programs."""
    group = verb.add_argument_group("for other programs", f"any of these writes files into {where}")
    group.add_argument("--formats", action="append", metavar="F,F", help="glb,usd,mtlx,obj,maps (default maps,glb)")
    group.add_argument(
        "--target", action="append", metavar="T,T", help="blender (default),unreal,unity-urp,unity-hdrp,houdini,arnold"
    )
    group.add_argument(
        "--texture-name", metavar="PATTERN", help="texture files: {asset} {map} {udim} {ext} are filled in"
    )
    group.add_argument("--metres-per-unit", type=float, metavar="X", help="metresPerUnit of USD (default 1)")
    group.add_argument(
        "--colorspace",
        metavar="NAME",
        help="linear space of EXR pictures in and EXR textures out, by its name in $OCIO or OpenColorIO's own config "
        "(default: linear Rec.709)",
    )


NAME_HELP = (
    "name of the asset{default}; with fields, such as '{{mesh}}_{{style}}_v{{v:03}}', the name of delivered files: "
    "{{v}} counts up and never overwrites a delivery"
)


def asset_name(options: argparse.Namespace, *parts: str) -> str:
    """The asset's name: --name unless that is a pattern of delivered files, else the joined parts."""
    name = getattr(options, "name", None)
    return names.asset_name(None if not name or "{" in name else name, *parts)


def add_mesh_options(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--uv",
        choices=["auto", "keep", "new"],
        help="authored UVs: keep, replace, or (auto) replace only where unusable",
    )
    axes = ["y", "z", "-y", "-z"]
    verb.add_argument("--up", choices=axes, help="the up axis of the mesh file (default y; -y: Y down)")
    verb.add_argument("--lit", action="store_const", const=True, help="turn unlit glTF materials into lit ones")


def given_settings(options: argparse.Namespace, names: Mapping[str, str]) -> dict[str, Any]:
    """The settings of the command line, nested; `names` maps options to dotted settings."""
    from mistyle.jobs.settings import assignments, merge

    result: dict[str, Any] = {}
    for option, key in names.items():
        value = getattr(options, option, None)
        if value is not None:
            leaf: Any = str(value) if isinstance(value, Path) else value
            for name in reversed(key.split(".")):
                leaf = {name: leaf}
            result = merge(result, leaf)
    name = getattr(options, "name", None)
    if name and "{" in name and "formats" in names:
        result = merge(result, {"deliver": {"name": name}})
    return merge(result, assignments(getattr(options, "set", []), "--set"))


def given_defines(pairs: Sequence[str]) -> dict[str, str]:
    """The NAME=VALUE pairs of -D. Raises UsageError."""
    result = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise UsageError(f"-D {pair}: expected NAME=VALUE, as for the mitsuba command")
        result[name] = value
    return result
