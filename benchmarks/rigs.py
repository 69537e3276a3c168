"""The paper's fixed 16 views against next-best-view rigs: `python -m benchmarks.rigs [--quick] [--json FILE]`

For each mesh three rigs: `paper` (16 views), `nbv` (as few as it takes, 32 at most) and `nbv16` (16 at most). Figures
`<mesh>.<rig>.views`, `.covered` (share of the atlas's texels that some view sees at a face-on weight of 0.4 or more, by
a ray from every texel to every camera), `.seen` (at any weight), `.overlap` (least overlap of a view with the earlier
one it overlaps most) and `.seconds`, `.seconds.cpu` (choosing the rig; reading and unwrapping are not counted).
`<mesh>.reachable` is the share of texels (of some 40,000 of them) that any of the 500 candidates sees at that weight.
--quick: spot and teapot.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.common import DATA, finish, timed
from mistyle.core.camera import Camera, rig
from mistyle.core.maps import Texels
from mistyle.core.mesh import Mesh
from mistyle.core.settings import RigSettings
from mistyle.geometry.next_best_view import candidate_cameras, overlaps, visit

MESHES = {"spot": "spot", "teapot": "teapot", "bunny": "stanford-bunny", "armadillo": "armadillo"}
QUICK = ("spot", "teapot")
ATLAS = 1024
SETTINGS = RigSettings(kind="nbv")
FEW = 40_000


def main(argv: list[str] | None = None) -> None:
    options = argparse.ArgumentParser(prog="python -m benchmarks.rigs", description=__doc__)
    options.add_argument("--quick", action="store_true", help="spot and teapot only")
    options.add_argument("--json", type=Path, metavar="FILE")
    chosen = options.parse_args(argv)
    figures: dict[str, float] = {}
    for name in QUICK if chosen.quick else MESHES:
        figures |= measure(name, DATA / "meshes" / "plain" / f"{MESHES[name]}.obj")
    finish(figures, chosen.json)


def measure(name: str, path: Path) -> dict[str, float]:
    """All rigs on one mesh."""
    from mistyle.atlas.texels import rasterise
    from mistyle.io.read_mesh import read_mesh
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.render.mitsuba.rigs import face_fronts, next_best_views, sample_surface
    from mistyle.render.mitsuba.visible import face_on

    mesh = read_mesh(path, size=ATLAS).mesh
    texels = [rasterise(mesh, part, ATLAS) for part in range(len(mesh.parts))]
    points = texel_points(mesh, texels, face_fronts(mesh))
    figures: dict[str, float] = {f"{name}.texels": len(points[0])}
    traced = tracer(mesh)
    even = sample_surface(mesh, FEW, seed=1)
    every = candidate_cameras(SETTINGS)
    few = [a[:: max(1, len(a) // FEW)] for a in points]
    figures[f"{name}.reachable"] = float((face_on(traced, every, *few).max(axis=0) >= SETTINGS.facing).mean())

    def note(kind: str, cameras: list[Camera]) -> None:
        weight = face_on(traced, cameras, *points)
        # Texels may lie closer on one part than on another; the overlap is one of areas.
        area = face_on(traced, cameras, even.positions, even.normals, even.fronts)
        overlap = visit(area.sum(axis=1), overlaps(area, SETTINGS.facing), range(len(cameras)))[1][1:]
        figures[f"{name}.{kind}.views"] = len(cameras)
        figures[f"{name}.{kind}.covered"] = float((weight.max(axis=0) >= SETTINGS.facing).mean())
        figures[f"{name}.{kind}.seen"] = float((weight.max(axis=0) > 0).mean())
        figures[f"{name}.{kind}.overlap"] = float(overlap.min()) if len(overlap) else 0.0

    note("paper", rig(RigSettings()))
    for kind, most in (("nbv", 32), ("nbv16", 16)):
        wanted = SETTINGS.model_copy(update={"most_views": most})
        planned = timed(figures, f"{name}.{kind}.seconds", lambda wanted=wanted: next_best_views(mesh, wanted))
        note(kind, list(planned.cameras))
    return figures


def texel_points(mesh: Mesh, texels: list[Texels], fronts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and outer face normals of every covered texel."""
    position = np.concatenate([t.position[t.covered] for t in texels])
    normal = np.concatenate([t.normal[t.covered] for t in texels])
    return position, normal, fronts[np.concatenate([t.face[t.covered] for t in texels])]


if __name__ == "__main__":
    main()
