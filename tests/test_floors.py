"""The shape of the package: floors, doors, circles, who may touch jobs, and the limits of size.

Everything is read from the source by `ast`; nothing is imported. Imports inside functions count like all others.
"""

import ast
import sys
from collections import Counter, defaultdict
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.support.helpers import ROOT

FLOORS = {
    "core": 0,
    "setup": 0,
    "process": 1,
    "geometry": 2,
    "io": 3,
    "measure": 3,
    "render": 4,
    "atlas": 4,
    "solver": 5,
    "jobs": 6,
    "deliver": 7,
    "stylization": 8,
    "fitting": 8,
    "comparison": 8,
    "batch": 9,
    "api": 9,
    "cli": 10,
}
VERBS = ("stylization", "fitting", "comparison")
# The parts of a verb that may touch jobs and deliver; comparison is a job from end to end.
JOB_PARTS = {"pipeline", "report", "settings"}
ALGORITHMS = ("core", "geometry", "measure", "render", "atlas", "solver", "stylization", "fitting")
DOORS = {
    "mitsuba": {"render", "solver", "api"},
    "drjit": {"render", "solver", "stylization/surface", "api"},
    "diffusers": {"stylization"},
    "transformers": {"stylization"},
    "peft": {"stylization"},
    "ray": {"batch"},
    "argparse": {"cli"},
}
# Names of ours that stand for such a library.
STANDS_FOR = {"mistyle.render.mitsuba.device.mi": "mitsuba", "mistyle.render.mitsuba.device.dr": "drjit"}
MOST_FILES, MOST_LINES, MOST_FUNCTION_LINES, MOST_PARAMETERS = 15, 500, 60, 7
# Functions that may be longer, or take more: full public signatures, tables, and kernels that Dr.Jit traces as one.
LONG = {"api.scenes.fit_scene"}
MANY = {
    "api.jobs.fit",
    "api.scenes.fit_scene",
    "deliver.asset_files.write",
    "solver.recover.recover",
    "solver.scene.fit.fit_scene",
    "stylization.optimise.lit_views.lit_phases",
    "stylization.pipeline.retouch.retouch",
    "stylization.pipeline.stylize.refined_stages",
    "stylization.pipeline.stylize.repair",
}
TWICE = 3  # class names that may be used twice
PAPER_LINES = 34_692  # the goal is 27,000


@cache
def parsed(source: str) -> ast.Module:
    """A module's syntax tree, parsed once."""
    return ast.parse(source)


def tree_of(path: Path) -> ast.Module:
    return parsed(path.read_text("utf-8"))


def parts_of(path: Path, root: Path) -> tuple[str, ...]:
    """A module's parts below mistyle; a package's __init__ is the package."""
    parts = path.relative_to(root / "mistyle").with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def modules() -> dict[tuple[str, ...], Path]:
    """Every module of the package by its parts below mistyle."""
    paths = sorted((ROOT / "mistyle").rglob("*.py"))
    assert paths
    return {parts_of(path, ROOT): path for path in paths}


def imported(source: str, package: list[str], *, at_import: bool = False) -> set[str]:
    """Dotted names of all that the module `source` in `package` imports; with `at_import` not those in functions."""
    names: set[str] = set()
    left: list[ast.AST] = [parsed(source)]
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
    folder, place, wrong = where[0], "/".join(where), []
    names = imported(source, ["mistyle", *where[:-1]])
    for name in sorted(names | {STANDS_FOR[name] for name in names & STANDS_FOR.keys()}):
        head, *rest = name.split(".")
        if head in DOORS and not any(place == door or place.startswith(f"{door}/") for door in DOORS[head]):
            wrong.append(f"{place}: {head} may be imported only in {sorted(DOORS[head])}")
        if head != "mistyle" or not rest or rest[0] not in FLOORS or folder not in FLOORS or rest[0] == folder:
            continue
        if FLOORS[rest[0]] >= FLOORS[folder]:
            wrong.append(f"{place} (floor {FLOORS[folder]}) imports {name} (floor {FLOORS[rest[0]]})")
        if rest[0] in ("jobs", "deliver") and folder in ("stylization", "fitting") and where[1] not in JOB_PARTS:
            wrong.append(f"{place}: only {sorted(JOB_PARTS)} of {folder} may import {name}")
    return wrong


def circles(sources: dict[str, tuple[str, bool]]) -> list[str]:
    """The first import circle of modules {dotted name: (source, whether it is a package)}; empty where none is."""
    graph = {}
    for module, (source, is_package) in sources.items():
        package = module if is_package else module.rpartition(".")[0]
        names = imported(source, package.split("."))
        nearest = {name if name in sources else name.rpartition(".")[0] for name in names}
        graph[module] = {name for name in nearest if name in sources and name != module}
    try:
        return [] if list(TopologicalSorter(graph).static_order()) else ["nothing to sort"]
    except CycleError as error:
        return error.args[1]


def functions() -> list[tuple[str, int, int]]:
    """Every function: "package.module.name", its lines, its parameters without self."""
    rows = []
    for where, path in modules().items():
        for node in ast.walk(tree_of(path)):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                count = len(given) - (bool(given) and given[0].arg in ("self", "cls"))
                rows.append((".".join((*where, node.name)), (node.end_lineno or 0) - node.lineno + 1, count))
    return rows


def test_floors_and_doors():
    wrong = [line for where, path in modules().items() if where for line in complaints(where, path.read_text("utf-8"))]
    assert not wrong, "\n".join(wrong)


def test_every_folder_stands_on_a_floor():
    assert {where[0] for where in modules() if len(where) > 1} <= set(FLOORS)
    assert {where[0] for where in modules() if len(where) == 1} <= {"__main__", *FLOORS}


@pytest.mark.parametrize("where", sorted(w for w in modules() if w[:1] in ((), ("__main__",), ("setup",))), ids=str)
def test_what_runs_first_needs_the_standard_library_only(where):
    source = modules()[where].read_text("utf-8")
    heads = {other.split(".")[0] for other in imported(source, ["mistyle"], at_import=not where)}
    assert heads <= {*sys.stdlib_module_names, "mistyle"}


def test_no_import_circles():
    """`mistyle/__init__.py` is exempt: its functions import what they run, and everything may ask for the version."""
    there = {
        ".".join(("mistyle", *where)): (path.read_text("utf-8"), path.name == "__init__.py")
        for where, path in modules().items()
        if where
    }
    assert not circles(there)


def test_folders_and_files_keep_their_size():
    files = Counter(path.parent for path in modules().values() if path.name != "__init__.py")
    wrong = [f"{folder}: {n} files, at most {MOST_FILES}" for folder, n in files.items() if n > MOST_FILES]
    for where, path in modules().items():
        lines = path.read_text("utf-8").count("\n")
        wrong += [f"{'/'.join(where)}: {lines} lines, at most {MOST_LINES}"] if lines > MOST_LINES else []
    assert not wrong, "\n".join(wrong)


def test_functions_keep_their_size():
    rows = functions()
    long = {name for name, lines, _ in rows if lines > MOST_FUNCTION_LINES}
    many = {name for name, _, count in rows if count > MOST_PARAMETERS}
    assert long == LONG, f"longer than {MOST_FUNCTION_LINES} lines: {long - LONG}; listed without need: {LONG - long}"
    assert many == MANY, f"more than {MOST_PARAMETERS} parameters: {many - MANY}; listed without need: {MANY - many}"
    assert len(MANY) <= 20


def test_class_names_are_used_once():
    places = defaultdict(list)
    for where, path in modules().items():
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef):
                places[node.name].append("/".join(where))
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert len(twice) <= TWICE, twice


def test_the_paper_is_readable_without_the_jobs():
    """The algorithms, without their pipelines, reports and settings, import nothing of jobs and above."""
    lines, wrong = 0, []
    for where, path in modules().items():
        if not where or where[0] not in ALGORITHMS or (where[0] in VERBS and where[1:2] and where[1] in JOB_PARTS):
            continue
        source = path.read_text("utf-8")
        lines += source.count("\n")
        for name in imported(source, ["mistyle", *where[:-1]]):
            if name.split(".")[:2] in [["mistyle", above] for above in ("jobs", "deliver", "batch", "cli")]:
                wrong.append(f"{'/'.join(where)} imports {name}")
    assert not wrong, "\n".join(wrong)
    assert lines <= PAPER_LINES, f"{lines} lines of algorithms, at most {PAPER_LINES}"


def test_compare_needs_few_modules():
    """What the first comparison of a stranger loads: the modules that `compare` reaches, functions included."""
    there = {".".join(("mistyle", *where)): path for where, path in modules().items() if where}
    reached, left = set(), ["mistyle.comparison.pipeline"]
    while left:
        module = left.pop()
        if module in reached:
            continue
        reached.add(module)
        path = there[module]
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        for name in imported(path.read_text("utf-8"), package.split(".")):
            near = name if name in there else name.rpartition(".")[0]
            left += [near] if near in there else []
    files = {module for module in reached if there[module].name != "__init__.py"}
    assert len(files) <= 45, sorted(files)


@pytest.mark.parametrize(
    ("where", "source"),
    [
        (("core", "mesh"), "from mistyle.render.mitsuba import draw"),
        (("core", "mesh"), "def f():\n    from ..render.mitsuba.draw import draw_views"),
        (("io", "cameras", "views"), "import mistyle.stylization.surface.lookup"),
        (("atlas", "texels"), "from mistyle.render.mitsuba import draw"),
        (("stylization", "optimise", "phase"), "from mistyle.fitting.light import solve"),
        (("stylization", "optimise", "phase"), "def f():\n    from mistyle.jobs.progress import Progress"),
        (("fitting", "light", "solve"), "from mistyle.deliver import asset"),
        (("jobs", "stages"), "import mitsuba as mi"),
        (("stylization", "mvst", "warp"), "import drjit.auto as dr"),
        (("stylization", "optimise", "phase"), "from mistyle.render.mitsuba.device import mi"),
        (("cli", "main"), "from diffusers import UNet2DModel"),
        (("comparison", "converge"), "import argparse"),
    ],
)
def test_the_rules_can_be_broken(where, source):
    assert complaints(where, source)


def test_a_circle_through_a_function_is_seen():
    inside = "def f():\n    from mistyle.core import b"
    assert circles({"mistyle.core.a": (inside, False), "mistyle.core.b": ("from mistyle.core.a import x", False)})
    assert not circles({"mistyle.core.a": (inside, False), "mistyle.core.b": ("import numpy", False)})


def test_what_is_allowed_passes():
    source = "import numpy\nimport drjit\nfrom mistyle import __version__\nfrom .guides import tone\n"
    assert not complaints(("stylization", "surface", "samples"), source + "from mistyle.core.mesh import Mesh\n")
    assert not complaints(("fitting", "pipeline", "material"), "from mistyle.jobs.progress import Progress\n")
