"""`mistyle doctor`: present and missing parts of the environment, with the command that installs each.

Runs also without installed packages, since it diagnoses that case.
"""

import json as _json
from collections.abc import Sequence

from mistyle import __version__
from mistyle.process.cores import cores
from mistyle.setup import facts
from mistyle.setup.facts import Row, works

ENVIRONMENT_MISSING = 4


def main(json: bool = False) -> int:
    """Print the table (or one JSON object on stdout); 0 when the main job can run, else 4."""
    rows = facts.rows(cores())
    if json:
        table = [row._asdict() for row in rows]
        print(_json.dumps({"version": __version__, "works": works(rows), "rows": table}, indent=1))
    else:
        _print(rows)
    return 0 if works(rows) else ENVIRONMENT_MISSING


def _print(rows: Sequence[Row]) -> None:
    try:
        _print_rich(rows)
    except ImportError:
        width = max(len(row.name) for row in rows)
        for row in rows:
            print(f"{row.state:<9} {row.name:<{width}}  {row.found}")
    # Below the table, where a terminal does not wrap the commands and they can be copied.
    for title, state in (("To fix", "missing"), ("Optional", "optional")):
        commands = [(row.name.strip(), row.fix) for row in rows if row.state == state and row.fix]
        if commands:
            print(f"\n{title}:")
            for name, fix in commands:
                print(f"  {name}: {fix}")
    print("\nThe main job can run." if works(rows) else "\nThe main job cannot run yet.")


def _print_rich(rows: Sequence[Row]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    colours = {"ok": "green", "missing": "bold red", "optional": "yellow"}
    table = Table(box=box.SIMPLE_HEAD)
    for title in ("", "what", "found"):
        table.add_column(title, overflow="fold")
    for row in rows:
        table.add_row(Text(row.state, style=colours[row.state]), Text(row.name), Text(row.found))
    console = Console()
    console.print(table) if console.is_terminal else Console(width=160).print(table)
