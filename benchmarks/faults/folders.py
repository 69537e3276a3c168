"""Rows of benchmarks/faults: strangers' files in the output folder of every verb that writes."""

import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.faults.jobs import Job, finish
from benchmarks.faults.kills import Whole
from benchmarks.faults.rows import Row, clean, row, sentence
from mistyle.core.paths import scenes

# What stands in the way of each verb: a stranger's file, or with '/' a folder that holds one.
COVERED = {
    "stylize": "views/", "fit": "scene/", "fit --scene": "run.json", "batch": "plan.json", "farm": "plan.json",
    "demo": "asset/", "render": "camera.json", "bake": "demo.glb", "variations": "variations.png",
    "compare": "index.html", "converge": "converge.json", "export": "demo_demo_style.glb", "lookdev": "lookdev.png",
    "verify": "verify.json", "pack": "install.sh",
}  # fmt: skip
QUICK = ("render", "compare", "export", "verify", "farm")


def strangers(wholes: Mapping[str, Whole], folder: Path) -> Iterator[Row]:
    """A stranger's file where each verb writes: refused, nothing touched. Elsewhere in the folder: done, it stays."""
    for name, job in jobs(wholes, folder).items():
        out = folder / f"foreign {name.replace(' ', '')}"
        beside(out)
        planted = out / (f"{COVERED[name]}mine.txt" if COVERED[name].endswith("/") else COVERED[name])
        planted.parent.mkdir(parents=True, exist_ok=True)
        planted.write_text("mine")
        before = state(out)
        code, words = finish(job.line(out))
        told = f"exit {code}, {sentence(words)}"
        yield row(
            "a stranger's file in the way", name, told, refused=code == 2, named=COVERED[name].rstrip("/") in words,
            clean=clean(words), untouched=state(out) == before,
        )  # fmt: skip
        if name not in QUICK:
            continue
        shutil.rmtree(out)
        beside(out)
        before = state(out)
        code, words = finish(job.line(out))
        after = state(out)
        kept = all(after.get(file) == value for file, value in before.items())
        yield row("a folder of a stranger's", name, f"exit {code}", done=code == 0, clean=clean(words), untouched=kept)


def jobs(wholes: Mapping[str, Whole], folder: Path) -> dict[str, Job]:
    """Every verb that writes, with the inputs that the rows have made."""
    mesh, style = str(scenes() / "demo.obj"), str(scenes() / "demo_style.png")
    inputs, run = folder / "inputs", str(folder / "whole0")
    lines = {name: whole.job.words for name, whole in wholes.items()}
    lines |= {
        "demo": ("demo", "-o", "OUT"),
        "render": ("render", mesh, "-o", "OUT", "--rig", "turntable", "--set", "rig.views=2", "--resolution", "64"),
        "bake": ("bake", mesh, str(inputs / "shots"), "-o", "OUT"),
        "variations": ("stylize", mesh, style, "-o", "OUT", "--variations", "2"),
        "compare": ("compare", style, style, "-o", "OUT", "--metrics", "psnr"),
        "converge": ("converge", str(inputs / "room.xml"), "--with", "mitsuba:path", "-o", "OUT"),
        "export": ("export", run, "-o", "OUT"),
        "lookdev": ("lookdev", mesh, "-o", "OUT"),
        "verify": ("verify", run, "-o", "OUT", "--no-render"),
        "pack": ("pack", "-o", "OUT"),
        "farm": ("farm", "export", str(inputs / "jobs.toml"), "-o", "OUT"),
    }
    return {name: Job(name, tuple(words)) for name, words in lines.items()}


def beside(out: Path) -> None:
    """Files, links and empty folders of a stranger's."""
    (out / "photographs" / "empty").mkdir(parents=True)
    for name in ("IMG_0001.JPG", "photographs/IMG_0002.JPG", "notes.txt"):
        (out / name).write_text(f"mine: {name}")
        os.utime(out / name, (1_000_000_000, 1_000_000_000))
    (out / "link").symlink_to("notes.txt")


def state(out: Path) -> dict[str, object]:
    """Every name with its bytes, time or link."""
    found: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        else:
            found[name] = "folder" if path.is_dir() else (path.read_bytes(), path.stat().st_mtime_ns)
    return found
