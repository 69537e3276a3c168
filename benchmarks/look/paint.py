"""Paints meshes at this tree and at another commit, for `benchmarks.look`; what was painted once is kept.

A cache folder holds `trees/COMMIT` (the other commit's files), `painted/TREE/NAME.glb`, and pictures of those. TREE is
a hash of the program's own files: after an edit everything is painted anew, and after a commit nothing is.
"""

import hashlib
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.common import DATA, ROOT

WORKER = Path(__file__).with_name("worker.py")
# The paint alone: no fit, and no more views and pictures than a job must have.
PAINT_ONLY = (
    *("--refine", "off", "--resolution", "64", "--spp", "1"),
    *("--set", "report.frames=4", "--set", "report.resolution=64", "--set", "report.spp=1"),
)


@dataclass(frozen=True)
class Tree:
    """A source tree: where it lies, its commit ("HEAD" for this one) and a hash of the program's files."""

    name: str
    folder: Path
    digest: str


@dataclass(frozen=True)
class Piece:
    """One painting on one mesh: names for the key, files for the job. `options` are the job's further arguments."""

    style: str
    mesh: str
    preset: str
    style_file: Path
    mesh_file: Path
    options: tuple[str, ...] = PAINT_ONLY

    @property
    def label(self) -> str:
        """A file name that differs where the job differs."""
        job = "\n".join([sha256(self.style_file), sha256(self.mesh_file), self.preset, *self.options])
        return f"{self.style}-{self.mesh}-{self.preset}-{hashlib.sha256(job.encode()).hexdigest()[:8]}"


def sha256(path: Path) -> str:
    """Of a file, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def program_hash(folder: Path) -> str:
    """Of what decides a job's bytes in a tree: the package's Python files and the scenes."""
    found = hashlib.sha256()
    for part, pattern in (("mistyle", "*.py"), ("scenes", "*.xml")):
        for path in sorted((folder / part).rglob(pattern)):
            found.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


def this_tree() -> Tree:
    """The tree that this file belongs to, with what is not committed yet."""
    return Tree("HEAD", ROOT, program_hash(ROOT))


def tree_at(commit: str, cache: Path) -> Tree:
    """The files of a commit of this repository, laid into the cache. SystemExit where there is no such commit."""
    named = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}"], cwd=ROOT, capture_output=True, text=True
    )
    if named.returncode != 0:
        raise SystemExit(f"--against {commit}: this repository has no such commit; `git fetch` it or name another")
    full = named.stdout.strip()
    folder = cache / "trees" / full
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        packed = subprocess.run(["git", "archive", full], cwd=ROOT, capture_output=True, check=True).stdout
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            tarfile.open(fileobj=io.BytesIO(packed)).extractall(scratch, filter="data")
            os.rename(scratch, folder)
            Path(scratch).mkdir()  # for its own removal
    return Tree(full[:12], folder, program_hash(folder))


def finished(piece: Piece, weights: Path) -> Piece:
    """The piece with its painting finished by VGG-19."""
    return replace(piece, options=(*piece.options, "--finish", "vgg", "--vgg", str(weights)))


def environment(tree: Tree) -> dict[str, str]:
    """For a child that runs a tree with this interpreter's packages and this process's LLVM."""
    return dict(os.environ) | {"PYTHONPATH": str(tree.folder), "MISTYLE_DATA": str(DATA)}


def place_of(tree: Tree, piece: Piece, cache: Path) -> Path:
    """Where the GLB of a piece is kept."""
    return cache / "painted" / tree.digest / f"{piece.label}.glb"


def painted(tree: Tree, pieces: Sequence[Piece], cache: Path) -> list[Path]:
    """The GLB of every piece, painted where the cache has none; one process paints all of them, one after another."""
    places = [place_of(tree, piece, cache) for piece in pieces]
    each = dict(zip(places, pieces, strict=True))
    missing = [(piece, place) for place, piece in each.items() if not place.exists()]
    if missing:
        places[0].parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            jobs = [job(piece, place, Path(scratch) / "run") for piece, place in missing]
            for (before, _), (piece, _), later in zip(missing, missing[1:], jobs[1:], strict=False):
                # The same painting with further options: its job goes on in the run folder of the one before.
                later["goes_on"] = before.options == piece.options[: len(before.options)] and (
                    (before.style, before.mesh, before.preset) == (piece.style, piece.mesh, piece.preset)
                )
            run_jobs(tree, jobs, Path(scratch))
    return places


def job(piece: Piece, place: Path, out: Path) -> dict[str, object]:
    """A job of the worker."""
    arguments = ["stylize", str(piece.mesh_file), str(piece.style_file), "-o", str(out), "--name", "look"]
    return {
        "arguments": [*arguments, "--preset", piece.preset, *piece.options],
        "out": str(out),
        "keep": str(place),
    }


def run_jobs(tree: Tree, jobs: Sequence[dict[str, object]], folder: Path) -> None:
    """Run the worker in a tree; its progress goes to a log of which the end is shown where it fails."""
    log = folder / "log"
    with log.open("w") as progress:
        worker = subprocess.Popen(
            [sys.executable, "-P", str(WORKER)],
            cwd=folder,
            env=environment(tree),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=progress,
            text=True,
        )
        assert worker.stdin is not None and worker.stdout is not None
        worker.stdin.write(json.dumps(list(jobs)))
        worker.stdin.close()
        for number, line in enumerate(worker.stdout, start=1):
            print(f"painted at {tree.name}, {number} of {len(jobs)}: {Path(line.strip()).stem}", file=sys.stderr)
    if worker.wait() != 0:
        raise SystemExit(f"painting at {tree.name} failed:\n{log.read_text()[-2000:]}")


def about(glb: Path) -> dict[str, float | None]:
    """What is known of a kept GLB: `pixel`, one of the painting's on the surface, in working units (None where its run
    did not say), and `cpu`, processor seconds of its job."""
    return json.loads(glb.with_name(glb.name + ".json").read_text())
