"""The shape of the package: lower floors never import upper ones, heavy libraries have one door each, no cycles."""

import ast
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from helpers import ROOT

FLOORS = {
    "core": 0,
    "files": 1,
    "render": 1,
    "measure": 1,
    "surface": 1,
    "stages": 2,
    "backends": 3,
    "run": 4,
    "api": 5,
}
DOORS = {
    "mitsuba": {"render"},
    "drjit": {"render", "surface"},
    "diffusers": {"backends"},
    "transformers": {"backends"},
    "peft": {"backends"},
    "ray": {"run"},
}
# What runs before anything is installed; every floor may ask it things.
BARE = {"__init__", "__main__", "bootstrap", "environment", "facts", "install", "llvm"}


def imported(source: str, package: list[str], *, at_import: bool = False) -> set[str]:
    """Dotted names of all that the module `source` in `package` imports; with `at_import` not those in functions."""
    names: set[str] = set()
    left: list[ast.AST] = [ast.parse(source)]
    while left:
        node = left.pop()
        if at_import and isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            stem = [*above, *(node.module.split(".") if node.module else [])]
            names |= {".".join([*stem, alias.name]) for alias in node.names}
        left.extend(ast.iter_child_nodes(node))
    return names


def complaints(where: tuple[str, ...], source: str) -> list[str]:
    """What module `where` (its parts below mistyle, without .py) imports although it must not."""
    folder = where[0] if len(where) > 1 else ""
    wrong = []
    for name in sorted(imported(source, ["mistyle", *where[:-1]])):
        head, *rest = name.split(".")
        if head in DOORS and folder not in DOORS[head]:
            wrong.append(f"{'/'.join(where)}: {head} may be imported only in {sorted(DOORS[head])}")
        if head == "mistyle" and rest and rest[0] in FLOORS and folder and rest[0] != folder:
            if FLOORS[rest[0]] >= FLOORS[folder]:
                wrong.append(f"{'/'.join(where)} (floor {FLOORS[folder]}) imports {name} (floor {FLOORS[rest[0]]})")
    return wrong


def modules() -> dict[tuple[str, ...], Path]:
    """Every module of the package by its parts below mistyle."""
    paths = sorted((ROOT / "mistyle").rglob("*.py"))
    assert paths
    return {path.relative_to(ROOT / "mistyle").with_suffix("").parts: path for path in paths}


def test_floors_and_doors():
    wrong = [line for where, path in modules().items() for line in complaints(where, path.read_text("utf-8"))]
    assert not wrong, "\n".join(wrong)


def test_every_folder_stands_on_a_floor():
    assert {where[0] for where in modules() if len(where) > 1} <= set(FLOORS)
    assert {where[0] for where in modules() if len(where) == 1} <= BARE


@pytest.mark.parametrize("name", sorted(BARE))
def test_what_runs_first_needs_the_standard_library_only(name):
    source = (ROOT / "mistyle" / f"{name}.py").read_text("utf-8")
    heads = {other.split(".")[0] for other in imported(source, ["mistyle"], at_import=name == "__init__")}
    assert heads <= {*sys.stdlib_module_names, "mistyle"}


def test_no_import_cycles():
    """CycleError names the modules. Imports inside functions run later and are left out."""
    there = {".".join(("mistyle", *where)).removesuffix(".__init__"): path for where, path in modules().items()}
    graph = {}
    for module, path in there.items():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        names = imported(path.read_text("utf-8"), package.split("."), at_import=True)
        nearest = {name if name in there else name.rpartition(".")[0] for name in names}
        graph[module] = {name for name in nearest if name in there and name != module}
    assert list(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize(
    ("where", "source"),
    [
        (("core", "mesh"), "from mistyle.render.mitsuba import draw"),
        (("core", "mesh"), "def f():\n    from ..render.draw import draw_views"),
        (("files", "views"), "import mistyle.stylization.surface.lookup"),
        (("stages", "fit"), "from mistyle import backends"),
        (("stages", "fit"), "import mitsuba as mi"),
        (("measure", "losses"), "import drjit.auto as dr"),
        (("run", "cli"), "from diffusers import UNet2DModel"),
    ],
)
def test_the_rules_can_be_broken(where, source):
    assert complaints(where, source)


def test_what_is_allowed_passes():
    source = "import numpy\nimport drjit\nfrom mistyle import __version__, bootstrap\nfrom .guides import tone\n"
    assert not complaints(("surface", "samples"), source + "from mistyle.core.mesh import Mesh\n")
