"""UV unwrapping with xatlas in a child process; every chart is counter-clockwise."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.errors import InputRefused
from mistyle.core.paths import PACKAGE
from mistyle.core.rows import distinct_integers
from mistyle.geometry import decimated as proxy
from mistyle.geometry.normals import area_vectors, same_points
from mistyle.geometry.uvs import group_rows

# Above this a decimated proxy is unwrapped and its UVs are transferred. xatlas's time grows with the faces' power 1.65
# (bunny, 69,451 faces: 24 s) and its charts follow every bump. Through the proxy the bunny takes 5 s, has 109
# charts instead of 653, and stretches less (mean ratio of the singular values 1.02 instead of 1.05).
PROXY_ABOVE = 20_000
PROXY_FACES = 15_000
XATLAS_SECONDS, XATLAS_FACES, XATLAS_POWER = 24.0, 69_451, 1.65
TRANSFER_SECONDS = 30e-6


def estimated_seconds(faces: int) -> float:
    """Estimated seconds of `unwrap` for a mesh of `faces` faces, on one core of a 2-core machine."""
    direct = min(faces, PROXY_FACES) if faces > PROXY_ABOVE else faces
    transfer = faces * TRANSFER_SECONDS if faces > PROXY_ABOVE else 0.0
    return 1.5 + XATLAS_SECONDS * (direct / XATLAS_FACES) ** XATLAS_POWER + transfer


def unwrap(
    meshes: Sequence[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]],
    *,
    size: int = 2048,
    padding: int | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> list[Float[np.ndarray, "_ 3 2"]]:
    """Corner UVs (v up) for each mesh, each in a unit square of its own.

    Charts lie at least `padding` texels apart in an atlas of size² (default: size / 256, at least 2; less where many
    small charts need more room for padding than for themselves). Charts are never mirrored: every face with an area in
    space has a positive one in UV space. Faces without area get a point. Vertices at equal positions count as one,
    whatever the file's indices; faces that repeat others (double-sided models) get texels of their own. Texel density
    is uniform over a mesh up to xatlas's stretch (5 % on the bunny). Above PROXY_ABOVE faces a decimated copy is
    unwrapped, and each face takes the chart of the copy's nearest face. Equal inputs give equal bytes.

    `progress` receives a share estimated from the elapsed time: xatlas reports none. An interrupt ends the child.
    """
    padding = max(2, size // 256) if padding is None else padding
    jobs = [_clean(positions, faces) for positions, faces in meshes]
    seconds = sum(estimated_seconds(len(faces)) for _, faces in jobs)
    started = time.monotonic()

    def tick() -> None:
        progress(float(1 - np.exp(-1.5 * (time.monotonic() - started) / seconds)))

    copies = [proxy.decimate(p, f, PROXY_FACES) if len(f) > PROXY_ABOVE else (p, f) for p, f in jobs]
    done = _child([dict(positions=p, faces=f) for p, f in copies], size, padding, tick)
    large = [i for i, (_, faces) in enumerate(jobs) if len(faces) > PROXY_ABOVE]
    if large:
        again = []
        for i in large:
            uvs, chart = proxy.transfer(*jobs[i], *copies[i], done[i]["uvs"], done[i]["chart"], tick)
            again.append(dict(positions=jobs[i][0], faces=jobs[i][1], uvs=uvs, chart=chart))
        for i, result in zip(large, _child(again, size, padding, tick), strict=True):
            done[i] = result
    progress(1.0)
    return [result["uvs"].astype(np.float32) for result in done]


def _clean(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices at equal positions, move repeated faces away from their originals, scale to mean face area 1.

    xatlas ends charts at edges with more than two faces, so a double-sided model would fall into single triangles; and
    it drops faces of less than 1e-7 units².
    """
    used = distinct_integers(faces)
    points = same_points(positions[used])
    lookup = np.zeros(len(positions), np.int64)
    lookup[used] = points
    count = int(points.max(initial=-1)) + 1
    coords = np.zeros((count, 3))
    coords[points] = positions[used]
    index = lookup[faces]
    coords -= coords.mean(axis=0) if count else 0
    areas = np.linalg.norm(area_vectors(coords, index), axis=1)
    coords /= np.sqrt(areas.sum() / max(np.count_nonzero(areas), 1)) if areas.any() else 1
    layer = _repeats(index)
    if layer.any():
        step = 4 * np.ptp(coords[:, 0]) + 1
        copies = [coords + np.array([k * step, 0, 0]) for k in range(int(layer.max()) + 1)]
        coords, index = np.concatenate(copies), index + (layer * count)[:, None]
    return coords.astype(np.float32), index.astype(np.int32)


def _repeats(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " f"]:
    """Number of earlier faces with the same three points."""
    corners = np.sort(faces, axis=1)
    group = group_rows(corners[:, 2], corners[:, 1], corners[:, 0])
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(group[order]) != 0]))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    result = np.empty(len(order), np.int64)
    result[order] = rank
    return result


def _child(
    meshes: Sequence[dict[str, np.ndarray]], size: int, padding: int, tick: Callable[[], None]
) -> list[dict[str, np.ndarray]]:
    """Run the worker on the meshes; InputRefused with its last message where it fails."""
    with tempfile.TemporaryDirectory(prefix="mistyle-unwrap-") as folder:
        source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
        arrays = {f"{name}_{i}": array for i, mesh in enumerate(meshes) for name, array in mesh.items()}
        numbers = {"count": len(meshes), "resolution": size, "padding": padding}
        np.savez(source, allow_pickle=False, **(arrays | {k: np.array(v) for k, v in numbers.items()}))
        path = os.pathsep.join(p for p in (str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")) if p)
        command = [sys.executable, "-m", "mistyle.geometry.xatlas_worker", str(source), str(target)]
        child = subprocess.Popen(
            command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        try:
            while True:
                try:
                    stderr = child.communicate(timeout=0.2)[1]
                    break
                except subprocess.TimeoutExpired:
                    tick()
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        if child.returncode != 0 or not target.is_file():
            faces = sum(len(mesh["faces"]) for mesh in meshes)
            last = stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["no message"]
            raise InputRefused(
                f"unwrapping {faces} faces with xatlas ended with code {child.returncode} ({last[0]}); expected UVs. "
                "Give the mesh UVs in a modelling program (Blender: UV > Smart UV Project) and run again"
            )
        with np.load(target, allow_pickle=False) as stored:
            return [dict(uvs=stored[f"uvs_{i}"], chart=stored[f"chart_{i}"]) for i in range(len(meshes))]
