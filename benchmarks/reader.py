"""What the border costs: how soon the reader process is ready, and what it adds to reading large files.

    python -m benchmarks.reader [--quick] [--json FILE]

The same decoding is timed in this process (the plain twin: the task itself, called directly) and through the reader
process, in turns, RUNS times each, and more often as long as that takes less than ENOUGH seconds; what counts is the
median over the turns of one time over the other, since such machines change their speed all the time. Files of more
than 50 MB (--quick: a tenth): an OBJ, a GLB, an EXR of four channels (smooth with grain; as half, ZIP, and as float32),
a PNG of 8 bits. What follows decoding (normals, UV checks: `read_mesh`; a picture as floats) is the same for both and
not timed. The direct read of an EXR takes one thread, as OpenEXR has it by default, and so does that of a GLB; the
reader process takes up to four, and keeps freed memory for the next file. `overhead_X` is reader / direct - 1,
`direct_X` the seconds of the fastest direct read; `cpu_overhead_X` compares the processor time of both processes.
"""

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import arguments, finish
from benchmarks.faults.corpus import glb, gltf_parts

RUNS, MOST, ENOUGH = 9, 41, 20.0


def start_seconds(path: Path) -> float:
    """From nothing to the answer about a small file; the median of RUNS children."""
    from mistyle.io.read import read_size
    from mistyle.io.sandbox import reader_process

    found = []
    for _ in range(RUNS):
        reader_process.stop()
        start = time.perf_counter()
        read_size(path)
        found.append(time.perf_counter() - start)
    return statistics.median(found)


def grid(side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wavy sheet: positions, UVs, faces."""
    u, v = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    positions = np.stack([u, v, 0.1 * np.sin(9 * u) * np.cos(7 * v)], axis=-1).reshape(-1, 3).astype(np.float32)
    k = np.arange(side * side).reshape(side, side)
    a, b, c, d = (x.reshape(-1) for x in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return positions, np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), faces


def files(folder: Path, share: float) -> dict[str, Path]:
    """The large files; `share` of their sizes."""
    from mistyle.io.images.write import write_exr, write_png

    positions, uvs, faces = grid(int(640 * share**0.5))
    rows = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in positions] + [f"vt {u:.6f} {v:.6f}" for u, v in uvs]
    rows += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (faces + 1).tolist()]
    (folder / "a.obj").write_text("\n".join(rows) + "\n")
    positions, uvs, faces = grid(int(980 * share**0.5))
    tree, data = sheet(positions, uvs, faces)
    (folder / "a.glb").write_bytes(glb(tree, data))
    side = int(2300 * share**0.5)
    write_exr(folder / "a.exr", dict(zip("RGBA", grainy(side, 4), strict=True)))
    wide = int(3300 * share**0.5)
    write_exr(folder / "half.exr", dict(zip("RGBA", grainy(wide, 4), strict=True)), half=True)
    high = int(5000 * share**0.5)
    write_png(folder / "a.png", np.moveaxis(np.clip(grainy(high, 3) / 2, 0, 1), 0, -1))
    return {name: folder / name for name in ("a.obj", "a.glb", "a.exr", "half.exr", "a.png")}


def grainy(side: int, channels: int) -> np.ndarray:
    """Pictures (channels, side, side) as renderers leave them: smooth, with grain."""
    y, x = np.mgrid[:side, :side].astype(np.float32) / side
    rng = np.random.default_rng(0)
    smooth = [1 + np.sin(5 * x + k) * np.cos(3 * y - k) for k in range(channels)]
    return np.stack([s * (1 + 0.1 * rng.standard_normal((side, side), np.float32)) for s in smooth])


def sheet(positions: np.ndarray, uvs: np.ndarray, faces: np.ndarray) -> tuple[dict[str, Any], bytes]:
    """The corpus's glTF with these vertices in the place of its own."""
    tree, data = gltf_parts()
    picture = tree["bufferViews"][4]
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (len(positions), 1))
    texture = data[picture["byteOffset"] : picture["byteOffset"] + picture["byteLength"]]
    blobs = [positions.tobytes(), normals.tobytes(), uvs.tobytes(), faces.astype("<u4").tobytes(), texture]
    at, views = 0, []
    for blob in blobs:
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(blob)})
        at += len(blob)
    for accessor in tree["accessors"][:3]:
        accessor["count"] = len(positions)
    tree["accessors"][3] |= {"componentType": 5125, "count": faces.size}
    tree |= {"bufferViews": views, "buffers": [{"byteLength": at}], "nodes": [{"mesh": 0}]}
    return tree, b"".join(blobs)


def processor_seconds() -> float:
    """Processor time of this process and of the reader process (Linux: in hundredths of a second)."""
    from mistyle.io.sandbox import reader_process

    reader = reader_process._reader
    stat = Path(f"/proc/{reader.process.pid}/stat") if reader is not None else None
    fields = stat.read_text().rpartition(")")[2].split() if stat is not None and stat.is_file() else ["0"] * 13
    ticks = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
    return time.process_time() + (int(fields[11]) + int(fields[12])) / ticks


def compared(direct: Callable[[], Any], through: Callable[[], Any]) -> tuple[float, float, float]:
    """The fastest direct read in seconds, and what the other adds to its wall time and to its processor time."""
    wall: tuple[list[float], list[float]] = ([], [])
    work_done: tuple[list[float], list[float]] = ([], [])
    begun = time.perf_counter()
    while len(wall[0]) < RUNS or len(wall[0]) < MOST and time.perf_counter() - begun < ENOUGH:
        for k, work in enumerate((direct, through)):
            start, before = time.perf_counter(), processor_seconds()
            result = work()
            wall[k].append(time.perf_counter() - start)
            work_done[k].append(processor_seconds() - before)
            del result
    added = statistics.median(b / a for a, b in zip(*wall, strict=True)) - 1
    # Processor time is told in hundredths of a second: only sums are long enough.
    return min(wall[0]), added, sum(work_done[1]) / max(sum(work_done[0]), 0.01) - 1


def run(quick: bool) -> dict[str, float]:
    from mistyle.io.images.write import write_png
    from mistyle.io.meshes.parsed_mesh import spelled
    from mistyle.io.read import read_exr
    from mistyle.io.read_mesh import MESHES
    from mistyle.io.sandbox import reader_tasks
    from mistyle.io.sandbox.reader_process import ask

    with tempfile.TemporaryDirectory(prefix="mistyle-reader-") as folder:
        there = files(Path(folder), 0.1 if quick else 1.0)
        small = Path(folder) / "small.png"
        write_png(small, np.zeros((16, 16, 3)))
        figures = {"start_seconds": start_seconds(small)}

        def decoded(path: Path) -> Any:
            return spelled(reader_tasks.mesh(path, MESHES[path.suffix], 5_000_000))

        def exr(path: Path) -> Any:
            return {name: np.asarray(plane, np.float32) for name, plane in reader_tasks.exr(path).items()}

        def sent(path: Path) -> Any:
            return spelled(ask("mesh", path, MESHES[path.suffix], 5_000_000))

        cases: dict[str, tuple[Path, Callable[[Path], Any], Callable[[Path], Any]]] = {
            "obj": (there["a.obj"], decoded, sent),
            "glb": (there["a.glb"], decoded, sent),
            "exr": (there["a.exr"], exr, read_exr),
            "exr_half": (there["half.exr"], exr, read_exr),
            "png": (there["a.png"], reader_tasks.picture, lambda path: ask("picture", path)),
        }
        for name, (path, direct, through) in cases.items():
            one, wall, cpu = compared(lambda d=direct, p=path: d(p), lambda t=through, p=path: t(p))
            figures |= {f"mb_{name}": path.stat().st_size / 1e6, f"direct_{name}": one}
            figures |= {f"overhead_{name}": wall, f"cpu_overhead_{name}": cpu}
    return figures


def main(argv: list[str] | None = None) -> None:
    options = arguments(__doc__ or "", argv)
    finish(run(options.quick), options.json)


if __name__ == "__main__":
    main()
