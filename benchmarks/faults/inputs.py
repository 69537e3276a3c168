"""Hostile and damaged input: every reader is handed thousands of files that are wrong somewhere.

    python -m benchmarks.faults.inputs [--quick] [--json FILE]

What must hold for each: it is read, or it is refused (InputRefused, UsageError: exit codes 3 and 2) with one sentence;
no other exception, no crash or hang, never more than 2 GB, and no file written anywhere. A decoder that crashes, hangs
or runs out of memory in the reader process is refused with a sentence too; such inputs are counted apart
(`inputs_contained`), since each is a fault of a library that the border kept from the job. An answer that shows a hole
in a reader of ours ("cannot make sense of") counts as not held.

A tenth of the meshes and settings go through the command line (`--full`), where the exit code and the error output are
what the user has.
"""

import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import arguments, finish, peak_gb
from benchmarks.faults.corpus import Seed, png, seeds, write
from benchmarks.faults.damage import damaged

INPUTS, INPUTS_FULL, COMMANDS = 300, 2400, 24
SECONDS = 20.0  # for one input of a few kilobytes
GIGABYTES = 2.0
CONTAINED = ("its decoder crashed", "its decoder ended", "was not decoded within", "decoding takes more than")
HOLE = "cannot make sense of"


@dataclass(frozen=True)
class Outcome:
    """What became of one input: "read", "refused", "contained", or in one sentence what went wrong."""

    seed: str
    what: str
    sentence: str = ""

    @property
    def held(self) -> bool:
        return self.what in ("read", "refused", "contained")


def _mesh(path: Path) -> None:
    from mistyle.io.read_mesh import read_mesh, read_references

    read_references(path)
    asset = read_mesh(path, uv="keep", max_faces=100_000)
    if asset.source.kind in ("glb", "gltf"):
        _patched(asset)


def _patched(asset: Any) -> None:
    """A glTF that is read is written again with plain textures as well, and read once more: its faces are all there."""
    from mistyle.core.maps import flat_maps
    from mistyle.io.gltf.alpha import cutouts
    from mistyle.io.gltf.write import patch_glb
    from mistyle.io.read_mesh import read_mesh

    parts = len(asset.mesh.parts)
    cutouts(asset)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "patched.glb")
        patch_glb(path, asset, [flat_maps(8)] * parts, [np.ones((8, 8), np.float32)] * parts, name="x")
        again = read_mesh(path, uv="keep", max_faces=100_000)
    if len(again.mesh.faces) != len(asset.mesh.faces):
        raise AssertionError(f"{len(asset.mesh.faces)} faces were read, {len(again.mesh.faces)} were written")


def _picture(path: Path) -> None:
    from mistyle.io.read import read_frame, read_picture, read_size

    read_size(path)
    read_picture(path)
    read_frame(path)


def _exr(path: Path) -> None:
    from mistyle.io.read import read_exr, read_frame, read_radiance

    read_frame(path)
    read_exr(path)
    read_radiance(path)


def _captures(path: Path) -> None:
    from mistyle.io.cameras.captures import read_captures
    from mistyle.io.cameras.sparse_points import sparse_points

    found = read_captures(path, lights="unknown")
    for k in range(len(found)):
        found.load(k)
    sparse_points(path)


def _colmap(path: Path) -> None:
    from mistyle.io.read import read_colmap, read_points

    read_colmap(path)
    read_points(path)


def _settings(path: Path) -> None:
    from mistyle.stylization.settings import resolve

    resolve(None, path, {}, {})


def _jobs(path: Path) -> None:
    from mistyle.batch.jobs_file import read_jobs

    read_jobs(path, 1)


def _limits(path: Path) -> None:
    from mistyle.comparison.limits import read_limits

    read_limits(path, ("flip", "psnr", "angle"))


def _weights(path: Path) -> None:
    from mistyle.process.weights import tensors

    for tensor in tensors(path).values():
        tensor.sum()


def _of(module: str, function: str) -> Callable[[Path], object]:
    from importlib import import_module

    return lambda path: getattr(import_module(f"mistyle.io.{module}"), function)(path)


READERS: dict[str, Callable[[Path], object]] = {
    "mesh": _mesh,
    "picture": _picture,
    "exr": _exr,
    "hdr": _of("read", "read_radiance"),
    "cameras": _of("cameras.camera_files", "read_cameras"),
    "captures": _captures,
    "lights": _of("cameras.views", "read_lights"),
    "colmap": _colmap,
    "settings": _settings,
    "jobs": _jobs,
    "limits": _limits,
    "npy": _of("read", "read_npy"),
    "weights": _weights,
}


def outcome(seed: Seed, files: dict[str, bytes], folder: Path) -> Outcome:
    """Hand the files in and see. `folder` is emptied before."""
    from mistyle.core.errors import InputRefused, UsageError

    write(files, folder)
    before = listing(folder)
    start = time.monotonic()
    what, sentence = "read", ""
    try:
        READERS[seed.kind](folder / seed.entry)
    except (InputRefused, UsageError) as error:
        sentence = str(error)
        what = "contained" if any(words in sentence for words in CONTAINED) else "refused"
        lines = sentence.strip().splitlines()
        if HOLE in sentence:
            what = f"a hole in the reader: {sentence}"
        elif not lines or (len(lines) > 1 and seed.kind not in ("jobs", "limits")) or len(sentence) > 3000:
            what = f"{len(lines)} lines, {len(sentence)} characters instead of a sentence: {sentence[:200]}"
        elif folder.name not in sentence and seed.entry.split(".")[0] not in sentence and "reference" not in sentence:
            what = f"a sentence that names no file: {sentence[:200]}"
    except Exception as error:  # what must never come
        what = f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.monotonic() - start
    if seconds > SECONDS:
        what = f"took {seconds:.0f} s ({what})"
    if listing(folder) != before:
        what = f"files were written beside the input ({what})"
    return Outcome(seed.name, what, sentence)


def listing(folder: Path) -> list[tuple[str, int]]:
    return sorted((str(p.relative_to(folder)), p.stat().st_size) for p in folder.rglob("*") if p.is_file())


def peak_reader_gb() -> float:
    """The most memory that the reader process has held, in GB."""
    from mistyle.io.sandbox.reader_process import peak_bytes

    return peak_bytes() / 1e9


def unwrapped(count: int, folder: Path, report: Callable[[str], None]) -> list[Outcome]:
    """Damaged meshes that get new texture coordinates: finite, in the unit square, one a corner; or refused."""
    from mistyle.core.errors import MistyleError
    from mistyle.io.read_mesh import read_mesh

    chosen = [seed for seed in seeds() if seed.kind == "mesh"]
    found = []
    for k in range(count):
        seed = chosen[k % len(chosen)]
        write(damaged(seed, random.Random(2 * 10**6 + k).randrange), folder)
        what, sentence = "read", ""
        try:
            mesh = read_mesh(folder / seed.entry, uv="new", size=256, max_faces=100_000).mesh
            uvs = mesh.corner_uvs
            if uvs.shape != (len(mesh.faces), 3, 2) or not np.isfinite(uvs).all() or uvs.min() < 0 or uvs.max() > 1:
                what = f"texture coordinates of {uvs.shape} from {uvs.min()} to {uvs.max()}"
        except MistyleError as error:
            what, sentence = "refused", str(error)
        except Exception as error:  # what must never come
            what = f"{type(error).__name__}: {str(error)[:200]}"
        found.append(Outcome(f"unwrap {seed.name}", what, sentence))
        if not found[-1].held:
            report(f"  unwrap {k} {seed.name}: {what}")
    return found


def commands(count: int, folder: Path, report: Callable[[str], None]) -> list[Outcome]:
    """Damaged meshes through the command line: exit code 0, 2 or 3, one line of error, no traceback, no output."""
    chosen = [seed for seed in seeds() if seed.kind == "mesh"]
    found = []
    for k in range(count):
        seed = chosen[k % len(chosen)]
        write(damaged(seed, random.Random(10**6 + k).randrange), folder / "in")
        line = [sys.executable, "-m", "mistyle", "stylize", str(folder / "in" / seed.entry), str(folder / "style.png")]
        line += ["-o", str(folder / "out"), "--uv", "keep", "--dry-run"]
        done = subprocess.run(line, capture_output=True, text=True, errors="replace", timeout=120)
        said = done.stderr.strip()
        what = {0: "read", 2: "refused", 3: "refused"}.get(
            done.returncode, f"exit code {done.returncode}: {said[-300:]}"
        )
        if "Traceback" in said:
            what = f"a traceback: {said[-300:]}"
        elif (folder / "out").exists():
            what = "wrote into the output folder although nothing was to be done"
        found.append(Outcome(f"command {seed.name}", what, said))
        if what not in ("read", "refused"):
            report(f"  command {k} {seed.name}: {what}")
    return found


def run(full: bool, report: Callable[[str], None] = print) -> dict[str, float]:
    """Try them all; `report` hears what did not hold. Figures: inputs, inputs_held and how many of each outcome."""
    chosen = seeds()
    count = INPUTS_FULL if full else INPUTS
    found: list[Outcome] = []
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mistyle-inputs-") as place:
        folder, temporary = Path(place, "given"), Path(place, "tmp")
        temporary.mkdir()
        watched = [Path.cwd(), temporary]
        old = os.environ.get("TMPDIR")
        os.environ["TMPDIR"] = str(temporary)
        tempfile.tempdir = None
        before = [sorted(os.listdir(p)) for p in watched]
        try:
            for k in range(count):
                seed = chosen[k % len(chosen)]
                files = seed.files if k < len(chosen) else damaged(seed, random.Random(k).randrange)
                result = outcome(seed, files, folder)
                found.append(result)
                if not result.held:
                    report(f"  input {k} {seed.name}: {result.what} {result.sentence[:300]}")
            if full:
                (Path(place) / "run").mkdir()
                Path(place, "run", "style.png").write_bytes(png())
                found += commands(COMMANDS, Path(place, "run"), report)
                found += unwrapped(COMMANDS, Path(place, "unwrap"), report)
        finally:
            os.environ.pop("TMPDIR") if old is None else os.environ.__setitem__("TMPDIR", old)
            tempfile.tempdir = None
        after = [sorted(os.listdir(p)) for p in watched]
    held = sum(result.held for result in found)
    if after[1] != before[1]:
        report(f"  left in the temporary folder: {set(after[1]) - set(before[1])}")
        held = 0
    memory = max(peak_gb(), peak_reader_gb())
    if memory > GIGABYTES:
        report(f"  {memory:.2f} GB were held at once")
        held = 0
    counts = Counter(result.what if result.held else "broken" for result in found)
    return {
        "inputs": len(found),
        "inputs_held": held,
        "inputs_read": counts["read"],
        "inputs_refused": counts["refused"],
        "inputs_contained": counts["contained"],
        "inputs_formats": len(chosen),
        "inputs_gb": memory,
        "inputs_seconds": time.monotonic() - start,
    }


def main(argv: list[str] | None = None) -> None:
    options = arguments(__doc__ or "", argv)
    finish(run(not options.quick), options.json)


if __name__ == "__main__":
    main()
