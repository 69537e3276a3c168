"""Every README: blocks parse, commands and options exist, marked blocks run, links and paths resolve.

A block that follows a line `<!-- run -->` is executed. The marked blocks of a README run in order in one folder that
holds `scenes`, with small pictures and textures.
"""

import argparse
import ast
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from mistyle.cli.main import parser
from mistyle.fitting.settings.material import MaterialSettings
from mistyle.fitting.settings.scene import SceneSettings
from mistyle.jobs.settings import known_keys
from mistyle.stylization.settings import Settings
from tests.support.helpers import ROOT

LANGUAGES = {"shell", "python", "toml", "json", "text"}
MARK = "<!-- run -->"
FOLDERS = ("mistyle", "scenes", "tests", "benchmarks")
READMES = sorted([*ROOT.glob("*.md"), *(path for top in FOLDERS for path in (ROOT / top).rglob("*.md"))])
# Settings that keep the executed blocks short.
SMALL = "rig.resolution=64;draw.spp=1;atlas.size=128;surface.samples=1000;fit.refine=off;report.detail=none"


@dataclass(frozen=True)
class Block:
    """A fenced block: the line of its first fence (from 1), its language, its text, and whether it is to be run."""

    line: int
    language: str
    text: str
    run: bool


def blocks(text: str) -> list[Block]:
    """All fenced blocks of a Markdown text, in order."""
    found: list[Block] = []
    start, language, inside = 0, "", []
    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        if not line.startswith("```"):
            inside.append(line)
        elif start:
            marked = start > 1 and lines[start - 2].strip() == MARK
            found.append(Block(start, language, "\n".join(inside), marked))
            start = 0
        else:
            start, language, inside = number, line[3:].strip(), []
    return [*found, Block(start, "unclosed", "", False)] if start else found


def commands(text: str) -> Iterator[list[str]]:
    """The words of every command line of a shell block."""
    for line in text.replace("\\\n", " ").splitlines():
        if words := shlex.split(line, comments=True):
            yield words


def verb_of(words: list[str]) -> list[str] | None:
    """The words after `mistyle` in a command line, or None for another program."""
    if words[0].endswith("mistyle"):
        return words[1:]
    return words[3:] if words[1:3] == ["-m", "mistyle"] else None


def refusal(words: list[str]) -> str | None:
    """Why the command line refuses these words, or None."""
    top = parser()
    stack, seen = [top], set()
    while stack:
        one = stack.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        one.exit_on_error = False
        one.error = _raise
        for action in one._actions:
            if isinstance(action, argparse._SubParsersAction):
                stack += action.choices.values()
    try:
        top.parse_args(words)
    except (argparse.ArgumentError, ValueError) as error:
        return str(error)
    return None


def _raise(message: str) -> None:
    raise ValueError(message)


@cache
def benchmark_source() -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "benchmarks").rglob("*.py")))


def benchmark_problems(words: list[str]) -> Iterator[str]:
    """`python -m benchmarks.NAME` must exist, and its options must stand in the benchmarks' code."""
    name = words[words.index("-m") + 1]
    path = ROOT / name.replace(".", "/")
    if not (path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()):
        yield f"there is no module {name}"
    for word in words:
        if re.fullmatch(r"--[a-z][a-z-]+", word) and f'"{word}"' not in benchmark_source():
            yield f"no benchmark has the option {word}"


def block_problems(block: Block) -> Iterator[str]:
    """What is wrong with a block, apart from what running it would show."""
    try:
        if block.language not in LANGUAGES:
            yield f"a block is '{block.language}', expected one of {sorted(LANGUAGES)}"
        elif block.language == "python":
            ast.parse(block.text)
        elif block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "json":
            json.loads(block.text)
        elif block.language == "shell":
            yield from shell_problems(block.text)
    except (SyntaxError, ValueError) as error:
        yield str(error)
    if block.run and block.language not in ("shell", "python"):
        yield f"a {block.language} block cannot run"


def shell_problems(text: str) -> Iterator[str]:
    checked = subprocess.run(["bash", "-n"], input=text, capture_output=True, text=True)
    if checked.returncode:
        yield checked.stderr
    for words in commands(text):
        arguments = verb_of(words)
        if arguments is not None and (why := refusal(arguments)):
            yield f"{shlex.join(words)}: {why}"
        if "-m" in words and words[words.index("-m") + 1].startswith("benchmarks."):
            yield from benchmark_problems(words)


def prose(text: str) -> str:
    """A Markdown text without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)


@cache
def settings() -> frozenset[str]:
    return frozenset(key for root in (Settings, MaterialSettings, SceneSettings) for key in known_keys(root))


@cache
def verbs() -> frozenset[str]:
    actions = parser()._actions
    return frozenset(name for a in actions if isinstance(a, argparse._SubParsersAction) for name in a.choices)


def resolves(name: str) -> bool:
    """Whether a dotted name leads to a module, or to a name that its module or package mentions."""
    at, parts = ROOT / "mistyle", name.split(".")[1:]
    while parts and (at / parts[0]).is_dir():
        at = at / parts.pop(0)
    if parts and (at / f"{parts[0]}.py").is_file():
        at = at / f"{parts.pop(0)}.py"
    source = at / "__init__.py" if at.is_dir() else at
    return (
        not parts or source.is_file() and re.search(rf"\b{parts[0]}\b", source.read_text(encoding="utf-8")) is not None
    )


def inline_problems(text: str) -> Iterator[str]:
    """Commands, settings and files that the prose names in backticks."""
    tables = {key.partition(".")[0] for key in settings() if "." in key}
    for code in re.findall(r"`([^`]+)`", prose(text)):
        words = re.sub(r"\s+", " ", code).replace("\\|", "|").split(" ")
        if words[0] == "mistyle" and len(words) > 1 and words[1].isalpha() and words[1].islower():
            if words[1] not in verbs():
                yield f"`{code}`: there is no verb {words[1]}"
        if words[:2] == ["python", "-m"] and words[2].startswith("benchmarks."):
            yield from (f"`{code}`: {problem}" for problem in benchmark_problems(words))
        for key in re.findall(r"(?:^|--set )([a-z]\w*\.[a-z]\w*(?:\.\w+)?)(?==|$)", code):
            if key.partition(".")[0] in tables and not key.endswith(".py") and key not in settings():
                yield f"`{code}`: there is no setting {key}"
        for name in re.findall(r"(?<![\w./])mistyle(?:\.[a-zA-Z_]\w*)+", code):
            if not resolves(name):
                yield f"`{code}`: {name} does not exist"
        named = re.fullmatch(r"((?:mistyle|tests|benchmarks|scenes)/[\w/.-]+\.\w+)", code)
        if named and not (ROOT / code).exists():
            yield f"`{code}`: no such file"


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives to the headings of a Markdown text."""
    headings = re.findall(r"^#+ (.*)$", prose(text), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def link_problems(path: Path, text: str) -> Iterator[str]:
    """Relative links whose file, or whose heading, does not exist."""
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (path.parent / name).resolve() if name else path
        if not file.is_file():
            yield f"link {target}: no such file"
        elif anchor and anchor not in anchors(file.read_text(encoding="utf-8")):
            yield f"link {target}: no such heading"


def problems(path: Path, text: str) -> list[str]:
    """Everything that is wrong with one README; a changelog also names what is gone."""
    found = [f"line {block.line}: {problem}" for block in blocks(text) for problem in block_problems(block)]
    named = [] if path.name == "CHANGELOG.md" else inline_problems(text)
    return [*found, *named, *link_problems(path, text)]


def ids(paths: Iterable[Path]) -> list[str]:
    return [str(path.relative_to(ROOT)) for path in paths]


@pytest.mark.parametrize("path", READMES, ids=ids(READMES))
def test_a_readme_is_sound(path):
    assert problems(path, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("```python\nprint(\n```", "never closed"),
        ("```toml\na =\n```", "Invalid value"),
        ('```json\n{"a": 1 | 2}\n```', "delimiter"),
        ("```shell\nif true\n```", "syntax error"),
        ("```\nplain\n```", "expected one of"),
        ("```shell\nls", "unclosed"),
        (f"{MARK}\n```json\n{{}}\n```", "cannot run"),
        ("```shell\nmistyle stylise a.obj b.png -o out/\n```", "stylise"),
        ("```shell\nmistyle stylize a.obj b.png -o out/ --no-such   # why\n```", "--no-such"),
        ("```shell\npython3 -m mistyle bake a.obj views/ \\\n  --preset coarse\n```", "coarse"),
        ("```shell\npython -m benchmarks.absent\n```", "benchmarks.absent"),
        ("`python -m benchmarks.look --no-such`", "--no-such"),
        ("`mistyle stilize`", "no verb stilize"),
        ("`--set fit.crop=1`", "no setting fit.crop"),
        ("`repair.outliers`", "no setting repair.outliers"),
        ("`tests/test_absent.py`", "no such file"),
        ("[a](absent.md)", "no such file"),
        ("[a](README.md#no-such-chapter)", "no such heading"),
    ],
)
def test_a_broken_readme_is_found(text, problem):
    found = problems(ROOT / "README.md", text)
    assert any(problem in one for one in found), found


def test_sound_text_has_no_problems():
    text = "```shell\nmistyle bake a.obj views/ -o out/   # back\n```\n`fit.crops` [b](README.md#licence) <https://a.b>"
    assert problems(ROOT / "README.md", text) == []


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("mistyle.stylize", True),
        ("mistyle.core.errors", True),
        ("mistyle.core.errors.MistyleError", True),
        ("mistyle.core.absent", False),
        ("mistyle.core.errors.Absent", False),
        ("mistyle.absent.errors", False),
    ],
)
def test_dotted_names_resolve(name, there):
    assert resolves(name) == there


def test_the_first_page_is_short():
    assert 8_000 < len((ROOT / "README.md").read_bytes()) < 12_288


RUN = [path for path in READMES if MARK in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", RUN, ids=ids(RUN))
def test_marked_blocks_run(path, tmp_path):
    text = path.read_text(encoding="utf-8")
    (tmp_path / "bin").mkdir()
    shim = tmp_path / "bin" / "mistyle"
    shim.write_text(f"#!{sys.executable}\nimport sys\nfrom {parser.__module__} import main\nsys.exit(main())\n")
    shim.chmod(0o755)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    search = os.pathsep.join([str(shim.parent), os.environ["PATH"]])
    own = os.environ | {"PATH": search, "PYTHONPATH": str(ROOT), "MISTYLE_SET": SMALL}
    chosen = [block for block in blocks(text) if block.run]
    assert len(chosen) == text.splitlines().count(MARK)
    for block in chosen:
        line = ["bash", "-euc", block.text] if block.language == "shell" else [sys.executable, "-c", block.text]
        ended = subprocess.run(line, cwd=tmp_path, env=own, capture_output=True, text=True)
        assert ended.returncode == 0, f"line {block.line}: {ended.stderr[-2000:]}"
