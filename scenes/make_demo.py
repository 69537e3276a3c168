"""Make the demo's meshes and paintings: `python scenes/make_demo.py [NAME ...]`, the same bytes each time.
`python scenes/make_demo.py overview` paints the meshes with all four and draws the README's picture (overview.py).

NAME             what it makes

mesh             demo.obj: a young elephant with a bird on its back: distance functions (elephant.py), marching cubes,
                 decimation, Newton steps back onto the surface, normals from the distance function's gradient, xatlas
                 charts turned right-handed
robot            robot.obj: a tin toy robot of closed shells (robot.py), xatlas charts turned right-handed
vase             vase.obj: a vase for the notebook, a profile turned about an axis (vase.py)
style            demo_style.png: an evening over the sea, painted stroke by stroke (sunset.py composes, paint.py paints)
mosaic           demo_mosaic.jpg: two fish in stone and glass (mosaic.py)
hatched          demo_hatched.png: a still life drawn with a pen (hatched.py)
pixel            demo_pixel.png: a castle by the water, cell by cell (pixels.py)

All are made from nothing but these scripts and are dedicated to the public domain (CC0 1.0).
"""

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import elephant  # noqa: E402
import hatched  # noqa: E402
import mosaic  # noqa: E402
import pixels  # noqa: E402
import robot  # noqa: E402
import sculpt  # noqa: E402
import sunset  # noqa: E402
import vase  # noqa: E402

FACES = 15_000
CELL = 0.011
SOFTEN = 0.6
TITLES = {"demo": "a young elephant with a bird on its back", "robot": "a tin toy robot that waves", "vase": "a vase"}


def largest_part(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop inner voids: the connected part with the most faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    _, label = connected_components(graph, directed=False)
    keep = label[faces[:, 0]] == np.bincount(label[faces[:, 0]]).argmax()
    used, index = np.unique(faces[keep], return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def is_closed(faces: np.ndarray) -> bool:
    """Whether every edge has two faces, run through in opposite directions, and the surface is a sphere with dents."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    once = len(np.unique(directed, axis=0)) == len(directed)
    edges = len(np.unique(np.sort(directed, axis=1), axis=0))
    return once and 2 * edges == len(directed) and len(np.unique(faces)) - edges + len(faces) == 2


def vertex_normals(vertices: np.ndarray, faces: np.ndarray, clay: sculpt.Clay) -> np.ndarray:
    """Unit normals from the distance's gradient, which keeps furrows that the triangles cut across; where such a normal
    leans more than 75 degrees from one of its faces, the area-weighted mean of the faces stands in."""
    normals = sculpt.gradient(clay, vertices, CELL / 2)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    mean, lean = np.zeros_like(vertices), np.ones(len(vertices))
    flat = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)
    for k in range(3):
        np.add.at(mean, faces[:, k], cross)
        np.minimum.at(lean, faces[:, k], (flat * normals[faces[:, k]]).sum(1))
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where((lean < np.cos(np.radians(75)))[:, None], mean, normals)


def lens(p: np.ndarray, centre: np.ndarray, radius: float, gain: float, *, inverse: bool = False) -> np.ndarray:
    """Magnify a ball's inside about its centre by `gain` (1 at its rim), or undo that: gives details more triangles."""
    r = np.linspace(0, radius, 513)
    seen = r * (1 + (gain - 1) * (1 - (r / radius) ** 2) ** 2)
    assert (np.diff(seen) > 0).all(), "the lens folds: take a smaller gain"
    offset = p - centre
    distance = np.linalg.norm(offset, axis=1)
    there = np.interp(distance, seen, r) if inverse else np.interp(distance, r, seen)
    scale = np.where(distance < radius, there / np.maximum(distance, 1e-12), 1.0)
    return centre + offset * scale[:, None]


def decimate(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadric decimation to `count` faces under lenses; the gentlest setting that keeps the surface closed is taken."""
    import fast_simplification

    seen = vertices
    for centre, radius, gain in elephant.LENSES:
        seen = lens(seen, centre, radius, gain)
    seen = seen.astype(np.float32)
    for aggression in range(3, 11):
        out, out_faces = fast_simplification.simplify(seen, faces, target_count=count * 4 // 3, agg=aggression)
        out, out_faces = fast_simplification.simplify(out, out_faces, target_count=count, agg=aggression)
        if len(out_faces) <= count and is_closed(out_faces):
            out = out.astype(np.float64)
            for centre, radius, gain in reversed(elephant.LENSES):
                out = lens(out, centre, radius, gain, inverse=True)
            return out, out_faces.astype(np.int64)
    raise RuntimeError(f"no setting of the decimation keeps the surface closed at {count} faces; change FACES a little")


def mend(vertices: np.ndarray, faces: np.ndarray, clay: sculpt.Clay, rounds: int = 8) -> np.ndarray:
    """Vertices of folded and needle-thin triangles are drawn to their neighbours' mean and back onto the surface."""
    for _ in range(rounds):
        corners = vertices[faces]
        sides = np.roll(corners, -1, axis=1) - corners
        sides /= np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-12)
        angles = np.degrees(np.arccos(np.clip(-(sides * np.roll(sides, 1, axis=1)).sum(2), -1, 1)))
        across = np.cross(sides[:, 0], sides[:, 1])
        normals = sculpt.gradient(clay, corners.mean(1), CELL / 2)
        lengths = np.linalg.norm(across, axis=1) * np.linalg.norm(normals, axis=1)
        lean = (across * normals).sum(1) / np.maximum(lengths, 1e-12)
        bad = (angles.min(1) < 5) | (lean < 0.3)
        ill = np.unique(faces[bad])
        total, weight = np.zeros_like(vertices), np.zeros(len(vertices))
        for k in range(3):
            for other in (1, 2):
                np.add.at(total, faces[:, k], corners[:, (k + other) % 3])
                np.add.at(weight, faces[:, k], 1)
        vertices = vertices.copy()
        moved = 0.5 * vertices[ill] + 0.5 * total[ill] / weight[ill, None]
        vertices[ill] = sculpt.settle(clay, moved, CELL)
    return vertices


def sculpture() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3) and unit vertex normals (v, 3) of the demo mesh."""
    clay = sculpt.sample(elephant.elephant, elephant.LOW, elephant.HIGH, CELL, SOFTEN)
    vertices, faces = decimate(*largest_part(*clay.polygonise()), FACES)
    vertices = mend(sculpt.settle(clay, vertices, CELL), faces, clay)
    normals = vertex_normals(vertices, faces, clay)
    return vertices - [0, vertices[:, 1].min(), 0], faces, normals


def obj_text(mesh: tuple[np.ndarray, np.ndarray, np.ndarray], corner_uvs: np.ndarray, names: tuple[str, str]) -> str:
    """Wavefront OBJ with shared positions and normals and one vt per distinct (vertex, uv). `mesh` is positions (v, 3),
    faces (f, 3) and unit normals (v, 3); `names` are the MTL file's stem and the material."""
    vertices, faces, normals = mesh
    corners = np.concatenate([faces.reshape(-1, 1), np.round(corner_uvs.reshape(-1, 2) * 1e5).astype(np.int64)], axis=1)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    lines = [f"# mistyle demo: {TITLES[names[0]]}, by scenes/make_demo.py. CC0 1.0."]
    lines += [f"mtllib {names[0]}.mtl", f"o {names[1]}", f"usemtl {names[1]}"]
    lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    lines += [f"vt {u / 1e5:.5f} {v / 1e5:.5f}" for _, u, v in unique]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals]
    lines += [
        "f " + " ".join(f"{v + 1}/{t + 1}/{v + 1}" for v, t in zip(face, uv, strict=True))
        for face, uv in zip(faces, index.reshape(-1, 3), strict=True)
    ]
    return "\n".join(lines) + "\n"


def write_mesh(
    stem: str, material: str, mesh: tuple[np.ndarray, np.ndarray, np.ndarray], uvs: np.ndarray | None = None
) -> None:
    """Write `stem`.obj and `stem`.mtl; a mesh without corner UVs is unwrapped."""
    from mistyle.geometry.unwrap import unwrap

    if uvs is None:
        (uvs,) = unwrap([(mesh[0], mesh[1])])
    (HERE / f"{stem}.obj").write_text(obj_text(mesh, uvs, (stem, material)), encoding="ascii", newline="\n")
    (HERE / f"{stem}.mtl").write_text(f"newmtl {material}\nKd 0.5 0.5 0.5\n", encoding="ascii", newline="\n")


def make_style() -> None:
    """Write demo_style.png; 6 bits a channel are enough for brush strokes and keep the file under 2 MB."""
    from PIL import Image

    picture = np.round(np.round(sunset.painting() / 255 * 63) / 63 * 255).astype(np.uint8)
    Image.fromarray(picture).save(HERE / "demo_style.png", optimize=True)


def make_mosaic() -> None:
    """Write demo_mosaic.jpg."""
    from PIL import Image

    Image.fromarray(mosaic.painting()).save(HERE / "demo_mosaic.jpg", quality=80, optimize=True)


def make_hatched() -> None:
    """Write demo_hatched.png: 12 tones between ink and paper hold a pen drawing."""
    from PIL import Image

    few = Image.fromarray(hatched.painting()).quantize(12, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(HERE / "demo_hatched.png", optimize=True)


def make_pixel() -> None:
    """Write demo_pixel.png, with a palette: every cell keeps its colour exactly."""
    from PIL import Image

    picture = Image.fromarray(pixels.painting())
    picture.quantize(len(pixels.PALETTE), dither=Image.Dither.NONE).save(HERE / "demo_pixel.png", optimize=True)


def make_overview() -> None:
    """Write demo_overview.jpg."""
    import overview

    overview.write(HERE / "demo_overview.jpg")


MAKERS = {
    "mesh": lambda: write_mesh("demo", "elephant", sculpture()),
    "robot": lambda: write_mesh("robot", "robot", robot.robot()),
    "vase": lambda: write_mesh("vase", "vase", *vase.vase()),
    "style": make_style,
    "mosaic": make_mosaic,
    "hatched": make_hatched,
    "pixel": make_pixel,
    "overview": make_overview,
}


if __name__ == "__main__":
    for name in sys.argv[1:] or [name for name in MAKERS if name != "overview"]:
        MAKERS[name]()
