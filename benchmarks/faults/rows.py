"""Faults other than kills: signals, full and read-only disks, what vanishes on the way, native crashes; a row each."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import PROGRAM
from benchmarks.faults.jobs import SMALL, Job, begin, differences, finish, left_over, until
from benchmarks.faults.kills import Whole
from mistyle.core.paths import scenes

# What each job says when it is in the middle.
MIDDLE = {
    "stylize": "paint the surface ...",
    "fit": "fit the material ...",
    "fit --scene": "fit the scene ...",
    "batch": "demo_demo_style_v1: begun",
}
CRASHES = """
import ctypes, os, signal, sys, threading, time
words = sys.orig_argv
if "shard" in words and words[words.index("--index") + 1] == "0" and (ALWAYS or not os.environ.get("MISTYLE_PLAIN")):
    def crash():
        time.sleep(1.5)
        HOW
    threading.Thread(target=crash, daemon=True).start()
"""
HOW = {
    "SIGSEGV": "ctypes.string_at(0)",
    "SIGABRT": "os.abort()",
    "SIGKILL": "os.kill(os.getpid(), signal.SIGKILL)",
}


@dataclass(frozen=True)
class Row:
    """A fault that was tried, on what, what came of it, and what was wrong with that (nothing where it held)."""

    fault: str
    on: str
    outcome: str
    wrong: str = ""


def row(fault: str, on: str, outcome: str, **expected: bool) -> Row:
    """A row that holds where everything expected is so."""
    return Row(
        fault, on, outcome, ", ".join(f"not {name.replace('_', ' ')}" for name, so in expected.items() if not so)
    )


def sentence(words: str) -> str:
    """The last line that mistyle itself said, without the places of this machine."""
    said = [line for line in words.splitlines() if line.startswith("mistyle: ")]
    return re.sub(r"(/[\w.+-]+)+/", "", said[-1][9:])[:160] if said else ""


def clean(words: str) -> bool:
    return "Traceback" not in words and "Exception ignored" not in words


def in_the_middle(job: Job, out: Path) -> tuple[subprocess.Popen, Path]:
    """The job, started, at the moment when it says that it is in the middle."""
    log = out.with_suffix(".log")
    child = begin(job.line(out), log)
    if not until(child, lambda: MIDDLE[job.name] in log.read_text(errors="replace"), pause=0.02):
        raise RuntimeError(f"{job.name} ended without having said {MIDDLE[job.name]!r}")
    time.sleep(4.0 if job.name == "batch" else 0.5)  # its shards are processes that first have to start
    return child, log


def signals(wholes: Mapping[str, Whole], folder: Path) -> Iterator[Row]:
    """SIGTERM and Ctrl-C in the middle, and the same command again."""
    for number, name in enumerate(wholes):
        whole, out = wholes[name], folder / f"term{number}"
        child, log = in_the_middle(whole.job, out)
        child.send_signal(signal.SIGTERM)
        since, code = time.monotonic(), child.wait(60)
        took, words = time.monotonic() - since, log.read_text(errors="replace")
        again, more = finish(whole.job.line(out))
        found = differences(whole.hashes, out) if again == 0 else more[-200:]
        told = f"exit {code} after {took:.1f} s; the same command again ends with {again}, " + (
            found or "the same bytes"
        )
        yield row("SIGTERM", name, told, exit_75=code == 75, clean=clean(words), resumed=not found)
    whole = wholes["stylize"]
    for twice in (False, True):
        child, log = in_the_middle(whole.job, folder / f"int{twice:d}")
        since = time.monotonic()
        child.send_signal(signal.SIGINT)
        if twice:
            time.sleep(0.05)
            child.send_signal(signal.SIGINT)
        code = child.wait(60)
        took, words = time.monotonic() - since, log.read_text(errors="replace")
        told = f"exit {code} after {took:.1f} s, no traceback"
        yield row(
            "Ctrl-C twice" if twice else "Ctrl-C",
            "stylize",
            told,
            exit_130=code in (130, -signal.SIGINT),
            clean=clean(words),
        )
    child, log = in_the_middle(whole.job, folder / "busy")
    code, words = finish(whole.job.line(folder / "busy"))
    first = child.wait(300)
    told = f"the second: exit {code}, {sentence(words)}; the first: exit {first}"
    same = not differences(whole.hashes, folder / "busy")
    yield row("two runs into one folder", "stylize", told, refused=code == 2 and clean(words), first_unharmed=same)


@contextlib.contextmanager
def disk(folder: Path, size: str) -> Iterator[Path]:
    """A small disk of its own (root only: a tmpfs); raises PermissionError where that is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True)
    if done.returncode != 0:
        raise PermissionError("mount")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def full_disks(wholes: Mapping[str, Whole], quick: Mapping[str, tuple[Job, Job]], folder: Path) -> Iterator[Row]:
    """A disk that is full in the middle, then larger; one that is full or read-only where an earlier result lies.

    `quick` holds for each of its jobs the one that made the earlier result and the one that is to replace it.
    """
    for number, (name, whole) in enumerate(wholes.items()):
        with disk(
            folder / f"disk{number}", "64k" if name == "fit --scene" else "3m" if name == "stylize" else "1400k"
        ) as out:
            code, words = finish(whole.job.line(out))
            rest = left_over(out)
            remount(out, "size=200m")
            again, more = finish(whole.job.line(out))
            found = differences(whole.hashes, out) if again == 0 else more[-200:]
            said = "disk is full" in words
            told = f"exit {code}, {sentence(words) or 'named in the summary'}; with room again: " + (
                found or "the same bytes"
            )
            yield row(
                "full disk", name, told, exit_1=code == 1, said=said, clean=clean(words), nothing_left=not rest,
                resumed=not found,
            )  # fmt: skip
    for name, (job, another) in quick.items():
        for fault, options in (("full disk", ""), ("read-only folder", "ro")):
            with disk(folder / f"{name}{options}", "30m") as place:
                out = place / "out"
                finish(job.line(out))
                before = everything(out)
                if options:
                    remount(place, options)
                else:
                    with contextlib.suppress(OSError), open(place / "filler", "wb", buffering=0) as filler:
                        while filler.write(b"\0" * 4096):
                            pass
                code, words = finish(another.line(out))
                intact = everything(out) == before and len(before) > 0
                good = code == (2 if options else 1) and ("cannot be written" if options else "disk is full") in words
                yield row(
                    fault, f"{name}, an earlier result there", f"exit {code}, {sentence(words)}",
                    refused=good, clean=clean(words), earlier_result_intact=intact,
                )  # fmt: skip


def everything(out: Path) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}


def vanished(wholes: Mapping[str, Whole], folder: Path) -> Iterator[Row]:
    """The input, and then the output folder, removed in the middle."""
    whole = wholes["stylize"]
    child, log = in_the_middle(whole.job, folder / "gone")
    shutil.rmtree(folder / "gone")
    code = child.wait(300)
    words = log.read_text(errors="replace")
    told, stayed = f"exit {code}, {sentence(words)}", not (folder / "gone").exists()
    yield row("output folder removed", "stylize", told, exit_1=code == 1, clean=clean(words), not_made_again=stayed)
    for name, gone in (("stylize", ".png"), ("fit", "")):
        if name not in wholes:
            continue
        own = folder / f"inputs_{name}"
        words_of = list(wholes[name].job.words)
        place = 2
        given = Path(words_of[place])
        own.mkdir()
        moved = own / given.name
        shutil.copytree(given, moved) if given.is_dir() else shutil.copy(given, moved)
        job = Job(name, (*words_of[:place], str(moved), *words_of[place + 1 :]))
        out = folder / f"vanished_{name}"
        child, log = in_the_middle(job, out)
        aside = moved.rename(moved.with_name(f"aside{gone}"))
        code = child.wait(300)
        words = log.read_text(errors="replace")
        aside.rename(moved)
        again, more = finish(job.line(out))
        found = differences(wholes[name].hashes, out) if again == 0 else more[-200:]
        how = "read before, not missed" if code == 0 else f"exit {code}, {sentence(words)}"
        told = f"{how}; back again: {found or 'the same bytes'}"
        yield row("input removed", name, told, exit_0_or_3=code in (0, 3), clean=clean(words), resumed=not found)


def native(wholes: Mapping[str, Whole], folder: Path) -> Iterator[Row]:
    """One shard of a batch that a library ends: once, and again on the plain path."""
    whole = wholes["batch"]
    for how, always in (("SIGSEGV", False), ("SIGABRT", True), ("SIGKILL", False)):
        hook, out = folder / f"hook{how}", folder / f"native{how}"
        hook.mkdir()
        (hook / "sitecustomize.py").write_text(CRASHES.replace("HOW", HOW[how]).replace("ALWAYS", str(always)))
        paths = os.pathsep.join(p for p in (str(hook), os.environ.get("PYTHONPATH", "")) if p)
        code, words = finish([*whole.job.line(out), "--json"], env=os.environ | {"PYTHONPATH": paths})
        summary: dict[str, Any] = json.loads(words[words.index('{"out"') :].splitlines()[0])
        first, other = summary["rows"]
        if always:
            told = f"exit {code}; {first['error']}; the other shard: {other['state']}"
            good = first["state"] == "failed" and how in first["error"] and other["state"] == "done" and code == 1
            yield row(f"{how}, on the plain path too", "one shard of a batch", told, reported=good)
            yield _retried(whole, out)
        else:
            found = differences(whole.hashes, out)
            log = (out / "shards" / f"{first['name']}.log").read_text(errors="replace")
            told = f"exit {code}; done on the plain path with {found or 'the same bytes'}"
            noted = "once more, on the plain path" in log and (how == "SIGKILL" or "Fatal Python error" in log)
            yield row(how, "one shard of a batch", told, done=code == 0 and not found, in_its_log=noted)


# The command line on a machine (or in a control group) that says it has so much memory.
POOR = f"from mistyle.process import memory; memory.limit = lambda: MOST; {PROGRAM}"
MATERIALS, MOST = 200, 1.5  # of the mesh; GB


def out_of_memory(folder: Path) -> Iterator[Row]:
    """A mesh of many materials where there is little memory: done within it, or refused in words before it begins."""
    mesh, views = squares(folder / "materials", MATERIALS), folder / "materials" / "views"
    small = ["--preset", "draft", "--threads", "1", *(f"--set={k}={SMALL[k]}" for k in ("rig.kind", "rig.views"))]
    jobs = {
        "render": (["render", str(mesh), *small], True),
        "render, views of 8192²": (["render", str(mesh), *small, "--resolution=8192"], False),
        "bake": (["bake", str(mesh), str(views), *small, "--atlas=64"], True),
        "bake, an atlas of 8192²": (["bake", str(mesh), str(views), *small, "--atlas=8192"], False),
        "stylize": (["stylize", str(mesh), str(scenes() / "demo_style.png"), *small], False),
    }
    asked, poor = f"--memory {MOST:g}G", f"a machine of {MOST:g} GB"
    for name, (words, fits) in jobs.items():
        for kind in (asked, poor):
            line = [sys.executable, "-c", PROGRAM, *words, "--memory", f"{MOST}G"]
            if kind == poor:
                line = [sys.executable, "-c", POOR.replace("MOST", f"{1e9 * MOST:.0f}"), *words]
            out = views if name == "render" and kind == asked else folder / f"poor{len(name)}{kind == poor:d}"
            code, words_said, peak = measured([*line, "-o", str(out)], folder / "poor.log")
            if fits:
                told = f"exit {code}, {peak:.2f} GB at most"
                yield row(f"{kind}, {MATERIALS} materials", name, told, done=code == 0, kept=peak < MOST)
            else:
                said = "the job needs" in words_said and "give it --memory" in words_said
                told = f"exit {code}, {sentence(words_said)}"
                yield row(
                    f"{kind}, {MATERIALS} materials", name, told, refused=code == 2 and said, clean=clean(words_said),
                    nothing_made=not out.exists(),
                )  # fmt: skip


def squares(folder: Path, count: int) -> Path:
    """An OBJ of so many squares side by side, each with a material of its own."""
    lines, library = ["mtllib squares.mtl"], []
    for k in range(count):
        x, y = k % 16, k // 16
        lines += [f"v {x + a} {y + b} 0" for a, b in ((0, 0), (0.9, 0), (0.9, 0.9), (0, 0.9))]
        lines += ["vt 0.1 0.1", "vt 0.9 0.1", "vt 0.9 0.9", "vt 0.1 0.9", f"usemtl m{k}"]
        lines.append("f " + " ".join(f"{4 * k + c}/{4 * k + c}" for c in range(1, 5)))
        library.append(f"newmtl m{k}\nKd {k / count:.4f} 0.5 {1 - k / count:.4f}")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "squares.mtl").write_text("\n".join(library))
    (folder / "squares.obj").write_text("\n".join(lines) + "\n")
    return folder / "squares.obj"


def measured(line: list[str], log: Path) -> tuple[int, str, float]:
    """Run to the end: exit code, words, and the most GB of main memory that the process held."""
    child = begin(line, log)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    return child.returncode, log.read_text(errors="replace"), used.ru_maxrss * 1024 / 1e9


def plain(wholes: Mapping[str, Whole], folder: Path) -> Iterator[Row]:
    """What a second try runs on: nothing recorded, an empty kernel cache. It must make the same files."""
    for name in ("stylize", "fit"):
        if name in wholes:
            out = folder / f"plain_{name}"
            more = {"MISTYLE_PLAIN": "1", "DRJIT_CACHE_DIR": str(folder / f"kernels_{name}")}
            code, words = finish(wholes[name].job.line(out), env=os.environ | more)
            found = differences(wholes[name].hashes, out) if code == 0 else words[-200:]
            yield row("the plain path", name, f"exit {code}; {found or 'the same bytes'}", the_same=not found)


def _retried(whole: Whole, out: Path) -> Row:
    code, words = finish(whole.job.line(out))
    found = differences(whole.hashes, out)
    return row("the crash is gone", "the same batch again", f"exit {code}; {found or 'the same bytes'}", done=not found)


def folders(wholes: Mapping[str, Whole], folder: Path) -> Iterator[Row]:
    """A stranger's files in the output folder of every verb (benchmarks/faults/folders.py)."""
    from benchmarks.faults.folders import strangers

    return strangers(wholes, folder)


def run(wholes: Mapping[str, Whole], quick: Mapping[str, tuple[Job, Job]], folder: Path) -> list[Row]:
    """Every row, said on stderr as it comes; what cannot be tried here is said too.

    Everything is made in `folder`, where the undisturbed jobs lie: a scene file names its textures relative to itself.
    """
    kinds: dict[str, Callable[[], Iterator[Row]]] = {
        "signals": lambda: signals(wholes, folder),
        "disks": lambda: full_disks(wholes, quick, folder),
        "vanished": lambda: vanished(wholes, folder),
        "native": lambda: native(wholes, folder),
        "plain": lambda: plain(wholes, folder),
        "folders": lambda: folders(wholes, folder),
        "memory": lambda: out_of_memory(folder),
    }
    rows = []
    for name, kind in kinds.items():
        try:
            for found in kind():
                rows.append(found)
                print(f"{found.fault}, {found.on}: {found.wrong or 'held'}", file=sys.stderr, flush=True)
        except PermissionError:
            print(f"{name}: left out, a disk of its own can be mounted by root only", file=sys.stderr)
    return rows
