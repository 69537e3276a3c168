"""One fit of `fit_speed --against`, in the tree on PYTHONPATH: a JSON request on stdin, files into its folder.

The request: `file`, `name`, `uv`, `resolution`, `views`, `pictures` (.npy), `out`, `settings` of the fit, and `stops`,
whether to write the maps after every pass. `out/stops.json` lists per stop its passes and the wall and processor
seconds from pictures in memory to its maps; what it took to write the maps of earlier stops does not count.
`out/NNN.npz` are the maps. Older trees have the same modules of `benchmarks` under other names.
"""

import hashlib
import json
import sys
import time
from pathlib import Path

import numpy as np

try:
    from benchmarks.material_recovery import pictures as drawing
    from benchmarks.material_recovery.ours import ours
    from benchmarks.material_recovery.truth import truth
except ImportError:
    from benchmarks import recovery_pictures as drawing
    from benchmarks.recovery_ours import ours
    from benchmarks.recovery_truth import truth

NAMES = ("albedo", "normal", "roughness", "metallic")


def main() -> None:
    request = json.loads(sys.stdin.read())
    out = Path(request["out"])
    cameras = drawing.fibonacci(request["views"], request["resolution"])
    known = truth(Path(request["file"]), request["name"], cameras[0], request["uv"], True)
    shots, pictures = drawing.one_at_a_time(cameras), list(np.load(request["pictures"]))
    stops = Stops(out)
    chosen = request["settings"] | ({"limits": stops.limits()} if request["stops"] else {})
    stops.begin()
    fitted = ours(known, shots, pictures, "mikkt", **chosen)
    stops.end(fitted.maps)
    result = {"inputs": inputs_hash(known), "stops": stops.rows}
    (out / "stops.json").write_text(json.dumps(result))


class Stops:
    """The clocks, and the rows of `stops.json`. The time after the last pass belongs to every stop."""

    def __init__(self, out: Path) -> None:
        self.out, self.rows = out, []
        self.start, self.lost, self.last = np.zeros(2), np.zeros(2), np.zeros(2)

    def limits(self):
        """Of a recovery whose passes are watched."""
        from mistyle.solver.recover import Limits

        return Limits(watch=self.reached)

    def begin(self) -> None:
        self.start = self.last = clocks()

    def reached(self, reached) -> None:
        """A pass has ended: finish its maps, as a run of so many passes would."""
        before = clocks()
        maps = reached.finished()
        finished = clocks()
        self._keep(maps, reached.done, finished)
        self.last = clocks()
        self.lost = self.lost + (self.last - before)

    def end(self, maps) -> None:
        """The fit has ended."""
        now = clocks()
        tail = now - self.last
        for row in self.rows:
            row["wall"], row["cpu"] = row["wall"] + tail[0], row["cpu"] + tail[1]
        self._keep(maps, len(self.rows), now)

    def _keep(self, maps, done: int, now: np.ndarray) -> None:
        wall, cpu = (now - self.start - self.lost).tolist()
        file = self.out / f"{len(self.rows):03d}.npz"
        np.savez(file, **{f"{name}_{k}": getattr(m, name) for k, m in enumerate(maps) for name in NAMES})
        self.rows.append({"passes": done, "wall": wall, "cpu": cpu, "maps": file.name})


def clocks() -> np.ndarray:
    """Wall and processor seconds."""
    return np.array([time.perf_counter(), time.process_time()])


def inputs_hash(known) -> str:
    """Of mesh, texels and true maps, to compare two trees."""
    found = hashlib.sha256()
    for array in (known.mesh.positions, known.mesh.faces, known.mesh.corner_uvs, known.mesh.corner_normals):
        found.update(np.ascontiguousarray(array).tobytes())
    for maps, texels in zip(known.maps, known.texels, strict=True):
        found.update(texels.covered.tobytes() + b"".join(np.float32(getattr(maps, n)).tobytes() for n in NAMES))
    return found.hexdigest()


if __name__ == "__main__":
    main()
