"""Command line options that several verbs share, and how they become settings."""

import argparse
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PRESET_HELP = "draft: about a minute; standard (default); paper: the paper's own counts"


def examples(text: str) -> dict[str, Any]:
    return {
        "epilog": "examples:\n" + textwrap.indent(textwrap.dedent(text).strip(), "  "),
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def add_job_options(
    verb: argparse.ArgumentParser,
    presets: Sequence[str] = ("draft", "standard", "paper"),
    preset_help: str = PRESET_HELP,
) -> None:
    """Options that every job has; None means: not said here."""
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
    verb.add_argument("--seed", type=int, help="every random choice follows from it (default 0)")
    verb.add_argument("--threads", type=int, help="threads to use; the result depends on it (default: all cores)")
    verb.add_argument("--json", action="store_true", help="one JSON object on stdout, logs on stderr")
    verb.add_argument("--print-config", action="store_true", help="print every setting as TOML and stop")


def add_mesh_options(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--uv",
        choices=["auto", "keep", "new"],
        help="authored UVs: keep, replace, or (auto) replace only where unusable",
    )
    verb.add_argument("--up", choices=["y", "z"], help="the axis of the mesh file that points up (default y)")


def said_settings(options: argparse.Namespace, names: Mapping[str, str]) -> dict[str, Any]:
    """What the command line says of the settings, nested; `names` maps options to dotted settings."""
    from mistyle.run.settings import assignments, merge

    said: dict[str, Any] = {}
    for option, key in names.items():
        value = getattr(options, option, None)
        if value is not None:
            leaf: Any = str(value) if isinstance(value, Path) else value
            for name in reversed(key.split(".")):
                leaf = {name: leaf}
            said = merge(said, leaf)
    return merge(said, assignments(options.set, "--set"))
