"""How long `mistyle compare` takes: `python -m benchmarks.compare [--quick] [--json FILE]`.

seconds_1024, seconds_4k   one pair of EXR files with every metric (no LPIPS), page and pictures written
seconds_4k_flip_psnr       the same 4K pair with --metrics flip,psnr
gb_4k                      peak memory of the 4K pair
peak_gb_1000_frames        peak memory of a folder of 4K frames, by a streamed run of FRAMES of them: what a frame needs
                           is let go before the next one, and what stays (a row, a thumbnail on disk) is extrapolated
seconds_4k_frame           seconds a frame there, --metrics psnr,relmse
…cpu                       processor seconds of the same, which other people's work on the machine does not change
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.common import arguments, finish

FRAMES = (4, 12)


def main() -> None:
    chosen = arguments(__doc__)
    small, large = ((270, 480), (540, 960)) if chosen.quick else ((1024, 1024), (2160, 3840))
    figures: dict[str, float] = {}
    with TemporaryDirectory() as folder:
        work = Path(folder)
        for name, size in (("1024", small), ("4k", large)):
            a, b = work / f"{name}_a.exr", work / f"{name}_b.exr"
            write_pair(a, b, size)
            taken = run([a, b, "-o", work / f"out_{name}"])
            figures |= {f"seconds_{name}": taken.wall, f"seconds_{name}.cpu": taken.cpu, f"gb_{name}": taken.gb}
        subset = [work / "4k_a.exr", work / "4k_b.exr", "-o", work / "out_subset", "--metrics", "flip,psnr"]
        taken = run(subset)
        figures |= {"seconds_4k_flip_psnr": taken.wall, "seconds_4k_flip_psnr.cpu": taken.cpu}
        figures |= streamed(work, large)
    finish(figures, chosen.json)


def streamed(work: Path, size: tuple[int, int]) -> dict[str, float]:
    """Folders of links to one pair: reading, comparing and writing are those of as many files."""
    found = []
    for count in FRAMES:
        for side in ("a", "b"):
            folder = work / f"frames{count}_{side}"
            folder.mkdir()
            for k in range(count):
                os.link(work / f"4k_{side}.exr", folder / f"frame.{k:04d}.exr")
        left, right = work / f"frames{count}_a", work / f"frames{count}_b"
        out = ["-o", work / f"out_{count}", "--metrics", "psnr,relmse", "--show", "2"]
        found.append(run([left, right, *out]))
    few, many = found
    more = FRAMES[1] - FRAMES[0]
    return {
        "peak_gb_12_frames": many.gb,
        "peak_gb_1000_frames": many.gb + max(0.0, (many.gb - few.gb) / more) * (1000 - FRAMES[1]),
        "seconds_4k_frame": (many.wall - few.wall) / more,
        "seconds_4k_frame.cpu": (many.cpu - few.cpu) / more,
    }


def write_pair(a: Path, b: Path, size: tuple[int, int]) -> None:
    """A smooth picture with highlights beyond 1, and the same with noise as of a few samples; half floats."""
    from mistyle.io.images.write import write_exr

    rng = np.random.default_rng(0)
    y, x = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32) / max(size)
    base = np.stack([0.2 + 0.6 * x, 0.3 + 0.4 * y, 0.5 + 0 * x], axis=-1)
    base += 8 * np.exp(-((x - 0.4) ** 2 + (y - 0.3) ** 2) / 0.001)[..., None]
    noisy = np.clip(base * (1 + 0.1 * rng.standard_normal(base.shape, np.float32)), 0, None)
    for path, picture in ((a, base), (b, noisy)):
        write_exr(path, dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)), half=True)


@dataclass(frozen=True)
class Taken:
    """Wall and processor seconds, and peak memory with that of the second process for FLIP on top."""

    wall: float
    cpu: float
    gb: float


def run(words: Sequence[object]) -> Taken:
    """The command in a process of its own."""
    code = (
        "import sys; from mistyle.cli.main import main; from benchmarks.compare import peak; rc = main(sys.argv[1:]); "
    )
    code += "print('PEAK', peak(), file=sys.stderr); sys.exit(rc)"
    start, before = time.perf_counter(), os.times()
    command = [sys.executable, "-c", code, "compare", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    wall, after = time.perf_counter() - start, os.times()
    if done.returncode != 0:
        raise SystemExit(done.stderr[-2000:])
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    taken = Taken(wall, cpu, float(done.stderr.split("PEAK")[-1]))
    print(f"{taken.wall:.1f} s, {taken.cpu:.1f} s of processors, {taken.gb:.2f} GB: {words[0]}", file=sys.stderr)
    return taken


def peak() -> float:
    import resource

    both = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(both) * (1 if sys.platform == "darwin" else 1024) / 1e9


if __name__ == "__main__":
    main()
