"""What `mistyle fit --dry-run` plans against what happens: `python -m benchmarks.captures --only plan`.

Five jobs, each as a user starts it, with the drafts' preset but for `delta`:

    castle    the façade's photographs, unknown light, --align
    delta     WaterBottle, strong maps, 16 views of 256² x 3 lights one at a time, --metallic, default preset
    sky       Suzanne, strong maps, 16 views of 256² x an environment in three positions
    unknown   Suzanne, strong maps, 24 views of 320² under a sky that the fit does not know
    many      Avocado, strong maps, 100 views of 256² under one light that turns with the camera

    plan_ratio.NAME        seconds over those of --dry-run; ….cpu: processor seconds of two cores over them
    first_asset.NAME       share of the seconds after which `asset` existed
    time_left_jump.NAME    largest ratio of two successive "about N s left" of a stage; and of all: `time_left_jump`
    seconds.NAME

--quick takes eight views of 96², 25 for `many`.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import DATA, PROGRAM, run_mistyle
from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery.pictures import Shot
from benchmarks.material_recovery.truth import ASSETS, find_asset, truth
from mistyle.core.image import srgb_from_linear
from mistyle.core.light import Environment, to_json
from mistyle.io.cameras.camera_files import transforms
from mistyle.io.images.write import write_exr, write_png

DRAFT = ("--preset", "draft")
SKY = "kiara_1_dawn_1k.hdr"
LEFT = re.compile(r"^\s+(.*): \d+ %, about (\d+) s left")


@dataclass(frozen=True)
class Watched:
    """A finished run: seconds, processor seconds, seconds until its asset existed, and the largest jump."""

    seconds: float
    cpu: float
    first_asset: float
    jump: float
    summary: dict[str, Any]


def plans(place: Path, quick: bool, only: Sequence[str] = ()) -> dict[str, float]:
    """The figures of the module; folders of the jobs lie in `place`."""
    figures: dict[str, float] = {}
    for name, make in JOBS.items():
        if only and name not in only:
            continue
        words = ["fit", *make(place / name, quick)]
        plan = run_mistyle(*words, "-o", place / name / "out", "--dry-run")
        ran = watched([*words, "-o", place / name / "out"], place / name / "out")
        figures[f"plan_ratio.{name}"] = ran.seconds / plan["seconds"]
        figures[f"plan_ratio.{name}.cpu"] = ran.cpu / 2 / plan["seconds"]
        figures[f"first_asset.{name}"] = ran.first_asset / ran.seconds
        figures[f"time_left_jump.{name}"] = ran.jump
        figures[f"seconds.{name}"] = ran.seconds
        took = ran.summary["seconds"]
        rows = [f"{row['stage']} {row['seconds']:.1f}/{took.get(row['stage'], 0.0):.1f}" for row in plan["stages"]]
        print(name, plan["seconds"], "planned/took", *rows, file=sys.stderr, flush=True)
    jumps = [value for name, value in figures.items() if name.startswith("time_left_jump.")]
    return figures | {"time_left_jump": max(jumps)}


def watched(words: Sequence[Any], out: Path) -> Watched:
    """Run mistyle and read its progress lines; SystemExit where it fails."""
    start, first, jump, left, tail = time.perf_counter(), None, 0.0, {}, []
    command = [sys.executable, "-c", PROGRAM, *map(str, words), "--json"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stderr is not None and child.stdout is not None
    for line in child.stderr:
        tail = [*tail[-20:], line]
        if first is None and (out / "asset" / "done.json").exists():
            first = time.perf_counter() - start
        if found := LEFT.match(line):
            stage, seconds = found[1], float(found[2])
            if left.get(stage, 0) > 0:
                jump = max(jump, seconds / left[stage])
            left[stage] = seconds
    answer = child.stdout.read()
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        raise SystemExit(f"mistyle {' '.join(map(str, words))} ended with {child.returncode}:\n{''.join(tail)}")
    seconds = time.perf_counter() - start
    summary = json.loads(answer.strip().splitlines()[-1])
    return Watched(seconds, used.ru_utime + used.ru_stime, first or seconds, jump, summary)


def castle(place: Path, quick: bool) -> list[Any]:
    folder = DATA / "photographs" / "castle"
    more = ["--atlas", 256] if quick else []
    return [folder / "scene_mesh.ply", folder, "--align", "--light", "unknown", "--hold-out", 2, *DRAFT, *more]


def delta(place: Path, quick: bool) -> list[Any]:
    shots = drawing.one_at_a_time(drawing.fibonacci(*((8, 96) if quick else (16, 256))))
    return [*written("waterbottle", place / "shots", shots), "--metallic"]


def sky(place: Path, quick: bool) -> list[Any]:
    cameras = drawing.fibonacci(*((8, 96) if quick else (16, 256)))
    return [*written("suzanne", place / "shots", drawing.turned(cameras, DATA / "hdri" / SKY)), *DRAFT]


def unknown(place: Path, quick: bool) -> list[Any]:
    cameras = drawing.fibonacci(*((8, 96) if quick else (24, 320)))
    words = written("suzanne", place / "shots", drawing.turned(cameras, DATA / "hdri" / SKY, 1), encoded=True)
    return [*words, "--light", "unknown", *DRAFT]


def many(place: Path, quick: bool) -> list[Any]:
    shots = drawing.one_at_a_time(drawing.fibonacci(*((25, 96) if quick else (100, 256))))[::3]
    return [*written("avocado", place / "shots", shots), *DRAFT]


JOBS = {"castle": castle, "delta": delta, "sky": sky, "unknown": unknown, "many": many}


def written(name: str, folder: Path, shots: Sequence[Shot], encoded: bool = False) -> list[Any]:
    """Draw an asset with strong maps and write its pictures, masks, cameras and lights; the words of a fit of them.
    `encoded`: 8-bit PNG instead of EXR."""
    folder.mkdir(parents=True, exist_ok=True)
    file = find_asset(name, DATA)
    known = truth(file, name, shots[0].camera, ASSETS[name][1], True)
    pictures = drawing.render(known.mesh, known.maps, shots, frame="mikkt", spp=32)
    files, lights = [], {}
    for shot, picture in zip(shots, pictures, strict=True):
        files.append(f"{shot.camera.name}.{'png' if encoded else 'exr'}")
        if encoded:
            write_png(folder / files[-1], srgb_from_linear(picture[..., :3]))
        else:
            write_exr(folder / files[-1], {c: picture[..., k] for k, c in enumerate("RGB")})
        (folder / "masks").mkdir(exist_ok=True)
        write_png(folder / "masks" / f"{shot.camera.name}.png", (picture[..., 3:] > 0.999).repeat(3, -1) * 1.0)
        lights[shot.camera.name] = shot.lights
    for light in {id(light): light for rig in lights.values() for light in rig}.values():
        if isinstance(light, Environment) and not (folder / light.file).exists():
            shutil.copyfile(DATA / "hdri" / light.file, folder / light.file)
    (folder / "transforms.json").write_text(json.dumps(transforms([shot.camera for shot in shots], files)))
    if not encoded:
        (folder / "lights.json").write_text(json.dumps(to_json((), lights)))
    return [file, folder, "--masks", folder / "masks", "--atlas", len(known.texels[0].covered)]
