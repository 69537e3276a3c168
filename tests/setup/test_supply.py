"""What we stand on and let in: pins, weights, no code from strangers, pages that run nothing, sockets of our own."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from mistyle.core.paths import PACKAGE
from mistyle.stylization.models.catalogue import MODELS
from tests.support.helpers import ROOT

PROGRAM = sorted(PACKAGE.rglob("*.py"))
EVIL = "<img src=x onerror=alert(1)>'\"&{{7*7}}</script><script>alert(2)</script>"


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def keyword(call: ast.Call, name: str) -> object:
    found = next((k.value for k in call.keywords if k.arg == name), None)
    return found.value if isinstance(found, ast.Constant) else found


def complaints(source: str) -> list[str]:
    """What in a program could run, or be made to run, what a file brought along."""
    tree = ast.parse(source)
    found = []
    for node in ast.walk(tree):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        for name in names:
            if name.split(".")[0] in {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}:
                found.append(f"imports {name}")
    for name, call in calls(tree):
        last = name.rpartition(".")[2]
        if name in {"eval", "exec", "compile", "__import__", "builtins.eval", "builtins.exec"}:
            found.append(f"calls {name}")
        if name == "os.system" or keyword(call, "shell") not in (None, False):
            found.append(f"{name} through a shell")
        if name == "torch.load" and keyword(call, "weights_only") is not True:
            found.append("torch.load without weights_only=True")
        if keyword(call, "trust_remote_code") not in (None, False) or last in {"load_state_dict_from_url", "hub_load"}:
            found.append(f"{name} runs or fetches code of others")
        if name.endswith("np.load") and keyword(call, "allow_pickle") is not False:
            found.append("np.load that may unpickle")
        if last == "full_load" or (re.fullmatch(r"(yaml|library)\.(unsafe_)?load(_all)?", name) and len(call.args) < 2):
            found.append(f"{name} without a safe loader")
        if name.startswith("torch.hub"):
            found.append(name)
    return found


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from dill import loads",
        "eval(text)",
        "torch.load(path)",
        "torch.load(path, weights_only=flag)",
        "AutoModel.from_pretrained(name, trust_remote_code=True)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "subprocess.run(line, shell=True)",
        "yaml.load(text)",
        "torch.hub.load('a/b', 'c')",
    ],
)
def test_the_search_finds_what_it_looks_for(line):
    assert complaints(line)


def test_nothing_that_a_file_brings_along_is_run():
    found = {str(p.relative_to(PACKAGE)): complaints(p.read_text(encoding="utf-8")) for p in PROGRAM}
    assert {name: what for name, what in found.items() if what} == {}


def test_networks_are_loaded_from_files_that_are_there():
    """No loader of networks may go to a hub, nor take anything but safetensors."""
    seen = []
    for path in (PACKAGE / "stylization").rglob("*.py"):
        for name, call in calls(ast.parse(path.read_text(encoding="utf-8"))):
            if name.endswith("from_pretrained") and "Tokenizer" not in name and "Scheduler" not in name:
                seen.append((path.name, ast.unparse(call)))
    networks = [text for name, text in seen if "scheduler" not in text]
    assert networks
    for text in networks:
        assert "local_files_only=True" in text and "use_safetensors=True" in text, text


# Published as a pickle only, at no revision that anybody's lock file names: it is opened in a child that can load
# tensors and nothing else, converted once, and what came is hashed then. The list must not grow.
LOOSE_MODELS = {"position"}


def test_every_model_is_pinned():
    assert LOOSE_MODELS == {m.name for m in MODELS.values() if m.revision == "main"}
    for model in MODELS.values():
        if model.name in LOOSE_MODELS:
            continue
        if model.url:  # put in its place by hand: its hash, as far as it is known, is what holds it
            assert model.url.startswith("https://") and model.licence
            assert all(re.fullmatch(r"[0-9a-f]{8}|[0-9a-f]{64}", digest) for digest in model.sha256.values())
            continue
        assert re.fullmatch(r"[0-9a-f]{40}", model.revision), f"{model.name}: {model.revision} can move"
        assert model.licence
        assert all(re.fullmatch(r"[0-9a-f]{64}", digest) for digest in model.sha256.values())
        assert not [
            p for p in model.patterns if p.endswith((".py", ".bin", ".pt", ".pth", ".ckpt", ".pkl", ".msgpack"))
        ]


def pins() -> dict[str, str]:
    lines = (PACKAGE / "constraints.txt").read_text().splitlines()
    named = [line.split("#")[0].strip() for line in lines]
    found = dict(line.split("==") for line in named if line)
    return {canonicalize_name(name): version for name, version in found.items()}


# Extras that neither the set-up nor the tests install: an ffmpeg under the GPL, which a user adds by hand.
BY_HAND = {"video"}


def asked() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {name: lines for name, lines in project["optional-dependencies"].items() if name not in BY_HAND}
    return [Requirement(line) for line in [*project["dependencies"], *(r for lines in extras.values() for r in lines)]]


def test_every_dependency_has_a_range_and_an_exact_pin_inside_it():
    exact = pins()
    assert len(exact) > 80
    for requirement in asked():
        version = exact[canonicalize_name(requirement.name)]
        assert requirement.specifier and requirement.specifier.contains(version), f"{requirement}: pinned at {version}"


def test_what_these_tests_run_with_is_what_is_pinned():
    for requirement in asked():
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            continue  # an extra that is not installed here
        assert version.split("+")[0] == pins()[canonicalize_name(requirement.name)], requirement.name


def needed(name: str, seen: set[str]) -> set[str]:
    """A distribution and all that it asks for on this machine, by name."""
    if name in seen:
        return seen
    seen.add(name)
    try:
        lines = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return seen
    for line in lines:
        requirement = Requirement(line)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            needed(canonicalize_name(requirement.name), seen)
    return seen


def test_what_the_dependencies_ask_for_is_pinned_too():
    seen: set[str] = set()
    for requirement in asked():
        needed(canonicalize_name(requirement.name), seen)
    assert seen - set(pins()) == set()


def templates() -> list[Path]:
    found = sorted(PACKAGE.rglob("*.j2"))
    assert {p.name for p in found} >= {"report.html.j2", "compare.html.j2", "converge.html.j2", "batch.html.j2"}
    return found


def test_every_page_forbids_connections_and_escapes_by_default():
    for template in templates():
        text = template.read_text(encoding="utf-8")
        policy = re.search(r'Content-Security-Policy"\s+content="([^"]*)"', text)
        assert policy, f"{template.name} has no policy"
        assert policy[1].startswith("default-src 'none'") or policy[1] == "{{ policy }}", template.name
        assert "unsafe-inline' script" not in policy[1] and "http:" not in policy[1] and "https:" not in policy[1]
        # Only files and constants of our own may go in unescaped.
        assert set(re.findall(r"\{\{\s*([\w.]+)\s*\|\s*safe", text)) <= {"style", "script"}, template.name
        assert not re.search(r"\son\w+\s*=", re.sub(r"\{[%{].*?[%}]\}", "", text)), f"{template.name} has a handler"
    made = 0
    for path in PROGRAM:
        for name, call in calls(ast.parse(path.read_text(encoding="utf-8"))):
            if name.endswith("Environment") and ("loader" in {k.arg for k in call.keywords}):
                made += 1
                assert keyword(call, "autoescape") is True, f"{path.name}: {ast.unparse(call)}"
    assert made == 1


def test_the_page_of_converge_shows_names_as_they_are():
    from mistyle.comparison.converge import METRICS, page

    values = {metric: [(0.1, 0.01), (0.05, 0.01)] for metric in METRICS}
    row = {"renderer": EVIL, "spp": [1, 2], "seconds": [(0.1, 0.01), (0.2, 0.01)], **values}
    row["slope"] = {metric: (-1.0, 0.1) for metric in METRICS}
    record = {
        "scene": EVIL,
        "shot": EVIL,
        "reference": EVIL,
        "renderers": {EVIL: EVIL},
        "curves": [row],
        "efficiency": {EVIL: {"ratio": 1.0, "low": 0.9, "high": 1.1}},
        "first": EVIL,
        "definitions": {EVIL: EVIL},
        "versions": {EVIL: EVIL},
    }
    text = page(record)
    assert "<img src=x" not in text and "<script" not in text and "&lt;img src=x" in text and "{{7*7}}" in text


RAY = """
import json, sys
import psutil
from mistyle.batch import engines

def look(library, *rest):
    here = psutil.Process()
    for process in [here, *here.children(recursive=True)]:
        try:
            for socket in process.net_connections(kind="inet"):
                if socket.status == psutil.CONN_LISTEN:
                    heard.add(socket.laddr.ip)
        except psutil.Error:
            continue
    return []

heard = set()
engines._on_ray = look
engines.ray(None, [], engines.RayCluster(threads=1), lambda index, ended: None)
import os
print(json.dumps([sorted(heard), os.environ.get("RAY_AUTH_MODE")]))
"""


def test_rays_own_cluster_listens_on_the_loopback_address_with_a_token():
    import json

    pytest.importorskip("ray")
    pytest.importorskip("psutil")
    done = subprocess.run([sys.executable, "-c", RAY], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    heard, mode = json.loads(done.stdout.splitlines()[-1])
    assert heard and {address.removeprefix("::ffff:") for address in heard} == {"127.0.0.1"}
    assert mode == "token"
