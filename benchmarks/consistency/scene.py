"""What `benchmarks.consistency` compares on: a mesh, a painting, its views, and what the guides ask for in each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import DATA
from mistyle.core.asset import Asset, Picture
from mistyle.core.camera import Camera, orbit
from mistyle.core.image import resize, srgb_from_linear
from mistyle.core.maps import Maps, Texels, flat_maps
from mistyle.core.settings import RigSettings
from mistyle.core.view import View
from mistyle.io.store.records import load_record, save_record
from mistyle.stylization.settings import Settings, resolve
from mistyle.stylization.surface.exemplar import exemplar as styles

WEIGHTS = DATA / "weights"
VGG = WEIGHTS / "vgg19_normalised_relu3_1.pth"
LPIPS = (WEIGHTS / "squeezenet1_1_torchvision_fp16.npz", WEIGHTS / "lpips_v0.1_squeeze_heads.pth")

# Six of the paper's 16, in its visiting order: four neighbours on the ring, one from above, one from below. Pairs of
# them are 30 and 45 degrees apart (short range) and 54 to 90 (long range).
ANGLES = ((30, 0), (60, 0), (30, 45), (30, -45), (90, 0), (120, 0))


@dataclass(frozen=True)
class Scene:
    """A mesh, a painting and views; pictures are sRGB-encoded 0..1, one per view.

    views     geometry, and the bare mesh under the paper's lights
    clay      that picture, encoded
    colour    large-area colours that the guides ask for, on the mesh
    detail    dark and light strokes that the guides ask for, -1.6..1.6, 0 off the mesh
    painting  the style picture at the size at which the stylizer shows it in the views
    """

    asset: Asset
    texels: tuple[Texels, ...]
    style: Picture
    settings: Settings
    views: tuple[View, ...]
    clay: tuple[np.ndarray, ...]
    colour: tuple[np.ndarray, ...]
    detail: tuple[np.ndarray, ...]
    painting: np.ndarray
    opaque: np.ndarray


def load(folder: Path) -> Scene:
    """The scene that `make` left."""
    kept = load_record(folder / "scene")
    return Scene(**kept | {"settings": Settings.model_validate_json(kept["settings"])})


def cameras(resolution: int) -> list[Camera]:
    """The judged views."""
    rig = RigSettings(resolution=resolution)
    size = (resolution, resolution)
    return [orbit(a, e, distance=rig.distance, fov=rig.fov, size=size) for a, e in ANGLES]


def make(folder: Path, mesh: Path, style: Path, resolution: int, samples: int, atlas: int) -> Scene:
    """Read, draw and guide; the scene is left in `folder` for the rows, which run in processes of their own."""
    from mistyle.atlas.texels import rasterise
    from mistyle.io.read import read_picture
    from mistyle.io.read_mesh import read_mesh
    from mistyle.jobs.start import start_engines
    from mistyle.render.mitsuba.draw import draw_views
    from mistyle.stylization.surface.exemplar.chosen import settled
    from mistyle.stylization.surface.settings import SurfaceSettings

    layers = {"surface": {"samples": samples}, "atlas": {"size": atlas}, "rig": {"resolution": resolution}}
    settings = resolve(None, None, layers)
    start_engines(settings)
    asset, picture = read_mesh(mesh, size=atlas), read_picture(style)
    surface = SurfaceSettings(**settled(picture.rgb, picture.alpha, settings.surface).model_dump())
    settings = settings.model_copy(update={"surface": surface})
    views = draw_views(asset.mesh, None, cameras(resolution), "paper_views", 8, settings.seed)
    colour, detail, painting = guided(asset, picture, settings, views)
    scene = Scene(
        asset=asset,
        texels=tuple(rasterise(asset.mesh, part, atlas) for part in range(len(asset.mesh.parts))),
        style=picture,
        settings=settings,
        views=tuple(views),
        clay=tuple(encoded(view) for view in views),
        colour=tuple(colour),
        detail=tuple(detail),
        painting=painting.rgb,
        opaque=painting.opaque,
    )
    folder.mkdir(parents=True, exist_ok=True)
    save_record(folder / "scene", vars(scene) | {"settings": settings.model_dump_json()})
    return scene


def guided(asset: Asset, picture: Picture, settings: Settings, views: Sequence[View]):
    """Colour and detail guide of every view's pixels, and the painting at the size at which views show it."""
    from mistyle.stylization.surface.kernels import module
    from mistyle.stylization.surface.painter import open_sky
    from mistyle.stylization.surface.synthesis import SurfaceFields, finest_size, mesh_guides

    dj, fields = module(), SurfaceFields(open_sky(asset.mesh, settings.seed))
    chosen = settings.surface
    base = mesh_guides(asset.mesh, picture, fields, chosen, settings.seed, dj)
    points, guide, painting = base.levels[-1].points, base.guides[-1], base.picture
    colour, detail = [], []
    for view in views:
        index, weight = nearest_samples(points, view)
        lab = np.einsum("nk,nkc->nc", weight, guide.colour[index])
        colour.append(on_mesh(view, cv2.cvtColor((100 * lab)[None].astype(np.float32), cv2.COLOR_Lab2RGB)[0]))
        detail.append(on_mesh(view, (weight * guide.detail[index]).sum(axis=1)))
    long = max(painting.rgb.shape[:2])
    camera = views[0].camera
    # Pixels of the view per pixel of the painting: a sample spacing shows one pixel of the painting at `finest_size`.
    factor = points.spacing / (long / finest_size(chosen)) * camera.focal / settings.rig.distance
    size = styles.long_side(painting.rgb.shape, long * factor)
    shown = styles.StyleImage(resize(painting.rgb, size), resize(painting.opaque.astype(np.float32), size) > 0.99)
    return colour, detail, shown


def nearest_samples(points, view: View) -> tuple[np.ndarray, np.ndarray]:
    """The four samples nearest to each pixel on the mesh (position and normal), and their weights."""
    from scipy.spatial import KDTree

    from mistyle.core.camera import pixel_centres, world_from_px
    from mistyle.stylization.surface.samples import lifted

    px = pixel_centres(view.camera.size)[view.mask]
    place = world_from_px(view.camera, px, view.depth[view.mask].astype(np.float64))
    tree = KDTree(lifted(points.positions, points.normals, points.spacing))
    distance, index = tree.query(lifted(place, view.normal[view.mask], points.spacing), k=4, workers=2)
    weight = 1 / (distance + 0.3 * points.spacing)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.asarray(index), weight.astype(np.float32)


def on_mesh(view: View, values: np.ndarray) -> np.ndarray:
    """Values of the pixels on the mesh as a picture, zero elsewhere."""
    result = np.zeros((*view.mask.shape, *values.shape[1:]), np.float32)
    result[view.mask] = np.clip(values, -2, 2)
    return result


def encoded(view: View) -> np.ndarray:
    """The view's picture without the background that its rim pixels hold, encoded; zero off the mesh."""
    rgb = view.rgb / np.clip(view.coverage, 0.1, 1)[..., None]
    return np.where(view.mask[..., None], srgb_from_linear(rgb), 0).astype(np.float32)


def blank_maps(scene: Scene, albedo: Sequence[np.ndarray]) -> list[Maps]:
    """Flat maps with these albedos (linear)."""
    return [replace(flat_maps(a.shape[0]), albedo=a) for a in albedo]
