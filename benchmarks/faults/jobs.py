"""Small jobs of every kind, as processes to be disturbed, and the bytes that they must end with."""

import hashlib
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.paths import scenes

SMALL = {
    "rig.kind": "turntable", "rig.views": 4, "rig.resolution": 128, "draw.spp": 1, "surface.samples": 4000,
    "atlas.size": 256, "fit.iterations1": 6, "fit.iterations2": 6, "fit.crops": 1, "fit.crop_size": 64,
    "report.frames": 4, "report.resolution": 64, "report.spp": 1,
}  # fmt: skip
FIT = {
    "atlas.size": 64, "recover.iterations": 64, "recover.rounds": 1, "recover.solver_iterations": 4,
    "recover.checkpoint": 0.2, "report.frames": 4, "report.resolution": 64, "report.spp": 1,
}  # fmt: skip
ROOM = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective" id="front"><float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="48"/></film></sensor>
  <emitter type="point"><point name="position" x="0" y="1" z="3"/><rgb name="intensity" value="12"/></emitter>
  <shape type="rectangle" id="wall"><bsdf type="diffuse" id="paint">
    <texture type="bitmap" name="reflectance"><string name="filename" value="grey.png"/></texture></bsdf></shape>
</scene>
"""
BATCH = """preset = "draft"
settings = {{ rig = {{ kind = "turntable", views = 3, resolution = 48 }}, draw = {{ spp = 1 }}, threads = 1, \
surface = {{ samples = 1500 }}, atlas = {{ size = 64 }}, fit = {{ refine = "off" }}, \
report = {{ frames = 4, resolution = 64, spp = 1 }} }}
[[grid]]
meshes = ["{mesh}"]
styles = ["{style}"]
variants = [{{ seed = 0 }}, {{ seed = 1 }}]
"""
# These hold times or places, or hashes of files that do.
SKIPPED = ("report", "run.json", "batch.json", "batch.html", "plan.json", "shards", ".mistyle.written")
HIDDEN = (".tmp-", ".old-", ".mistyle.lock", "checkpoint-")


@dataclass(frozen=True)
class Job:
    """A command line with OUT where the folder goes."""

    name: str
    words: tuple[str, ...]

    def line(self, out: Path) -> list[str]:
        return [sys.executable, "-m", "mistyle", *(str(out) if word == "OUT" else word for word in self.words)]


def sets(values: dict[str, Any]) -> list[str]:
    """Settings as options of the command line."""
    return [part for k, v in values.items() for part in ("--set", f"{k}={v}")]


def made(folder: Path, wanted: Sequence[str]) -> dict[str, Job]:
    """Write the inputs of the jobs wanted ("stylize", "fit", "fit --scene", "batch") into a folder."""
    from mistyle.io.images.write import write_png

    mesh, style = scenes() / "demo.obj", scenes() / "demo_style.png"
    folder.mkdir(parents=True, exist_ok=True)
    jobs = {}
    if "stylize" in wanted:
        words = ["stylize", str(mesh), str(style), "-o", "OUT", "--preset", "draft", "--threads", "1", *sets(SMALL)]
        jobs["stylize"] = Job("stylize", tuple(words))
    if "fit" in wanted:
        views = {k: SMALL[k] for k in ("rig.kind", "rig.views", "rig.resolution", "draw.spp")}
        render = Job("render", ("render", str(mesh), "-o", "OUT", "--preset", "draft", "--threads", "1", *sets(views)))
        if not (folder / "shots").is_dir():
            subprocess.run(render.line(folder / "shots"), check=True, capture_output=True)
        words = ["fit", str(mesh), str(folder / "shots"), "-o", "OUT", "--preset", "draft", "--threads", "1"]
        jobs["fit"] = Job("fit", (*words, *sets(FIT)))
    if "fit --scene" in wanted:
        rng = np.random.default_rng(0)
        (folder / "room").mkdir(exist_ok=True)
        write_png(folder / "grey.png", np.full((32, 32, 3), 0.5, np.float32))
        write_png(folder / "room" / "front.png", rng.uniform(0.2, 0.6, (48, 48, 3)).astype(np.float32))
        (folder / "room.xml").write_text(ROOM)
        words = ["fit", "--scene", str(folder / "room.xml"), "--references", str(folder / "room"), "-o", "OUT"]
        words += ["--optimize", "*reflectance*", "--threads", "1", "--iterations", "40"]
        jobs["fit --scene"] = Job("fit --scene", tuple(words))
    if "batch" in wanted:
        (folder / "jobs.toml").write_text(BATCH.format(mesh=mesh.as_posix(), style=style.as_posix()))
        words = ["batch", str(folder / "jobs.toml"), "-o", "OUT", "--workers", "2", "--threads", "1"]
        jobs["batch"] = Job("batch", tuple(words))
    return jobs


def begin(line: Sequence[str], log: Path, **more: Any) -> subprocess.Popen:
    """A process whose words go into a file; a session of its own, so that signals reach it alone."""

    def heard() -> None:
        # A background job of a shell has interrupts ignored, and its children inherit that.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with open(log, "wb") as words:
        more = {"start_new_session": True, "preexec_fn": heard} | more
        return subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=words, stderr=words, **more)


def finish(line: Sequence[str], timeout: float = 300, **more: Any) -> tuple[int, str]:
    """Run to the end: exit code and words."""
    done = subprocess.run(line, capture_output=True, text=True, errors="replace", timeout=timeout, **more)
    return done.returncode, done.stdout + done.stderr


def until(child: subprocess.Popen, seen: Any, timeout: float = 120, pause: float = 0.002) -> bool:
    """Wait until `seen()` holds; False where the process ended before."""
    stop = time.monotonic() + timeout
    while child.poll() is None and time.monotonic() < stop:
        if seen():
            return True
        time.sleep(pause)
    return False


def hashes(out: Path) -> dict[str, str]:
    """Every file that must not depend on when and how often a job was disturbed."""
    found = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        name = path.relative_to(out)
        # A batch holds run folders.
        start = 1 if len(name.parts) > 1 and (out / name.parts[0] / "work").is_dir() else 0
        if not {*name.parts[:1], *name.parts[start : start + 1]} & set(SKIPPED):
            found[name.as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def left_over(out: Path) -> list[str]:
    """What a finished job must not leave behind."""
    return [str(p.relative_to(out)) for p in out.rglob("*") if any(word in p.name for word in HIDDEN)]


def differences(whole: dict[str, str], out: Path) -> str:
    """What differs from the undisturbed job, in words; empty where nothing does."""
    found = hashes(out)
    names = sorted(n for n in whole.keys() | found.keys() if whole.get(n) != found.get(n))
    told = [f"{len(names)} files differ: {', '.join(names[:3])}"] if names else []
    rest = left_over(out)
    return "; ".join(told + ([f"left behind: {', '.join(rest[:3])}"] if rest else []))


def in_session(number: int) -> dict[int, str]:
    """The living processes of a session (the number of its first process) and their command lines; Linux only."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if int(fields[3]) == number and fields[0] not in "ZX":
            found[int(entry.name)] = words
    return found


def shards(child: subprocess.Popen) -> list[int]:
    """The workers of a batch that `begin` started."""
    return [pid for pid, words in in_session(child.pid).items() if " shard " in words]
