"""Finds Blender and builds the command that runs a script inside it."""

import os
from collections.abc import Mapping
from pathlib import Path
from shutil import which

BLENDER = "MISTYLE_BLENDER_PYTHON"
OPEN_WORKER = str(Path(__file__).with_name("blender_worker.py"))


def find_blender(program: str | None, environment: Mapping[str, str] = os.environ) -> str | None:
    """A Python with bpy or the program itself: from the option, the environment, or `blender` on the PATH."""
    return program or environment.get(BLENDER) or which("blender")


def blender_command(program: str, script: str) -> list[str]:
    """The command that runs `script` in Blender's Python; the script takes its job file as its last argument."""
    if Path(program).name.lower().startswith("blender"):
        return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", script, "--"]
    return [program, script]
