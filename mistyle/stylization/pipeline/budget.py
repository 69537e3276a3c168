"""Memory models of `stylize`, `render` and `bake`, stage by stage.

The coefficients of PLAIN were fitted to the stages' peaks (`peaks_gb` in `run.json`) of five jobs: `draft_spot`,
`views_64` and `atlas_4096` of `python -m benchmarks.memory --stages`, and two drafts of spot. One of these has an atlas
of 3072², four views and 20,000 samples, the other an atlas of 2048². Memory for one texture set at a time (`one`) comes
from a job with 20 sets of 512².

TILED comes from single stages at 1024² and 2048², its report from 2048² and 4096²; it counts all sets alike. `finish`
was measured on one draft of spot (two crops of 256²); its estimate includes the features of the largest painting.
"""

from collections.abc import Sequence

from mistyle.jobs.memory_budget import Counts, Need, as_drawn, must_tile, shown, within_gb
from mistyle.stylization.settings import Settings

# With every array in memory.
PLAIN = {
    "mesh": Need(0.38, face=5000),
    "texels": Need(0.38, texel=71),
    "views": Need(0.46, texel=39, one=28, viewed=64, view=46.5),
    "surface": Need(0.49, texel=31, one=36, viewed=68, view=45.5, sample=1200),
    "bake": Need(0.59, texel=20, one=82, viewed=82, view=58.5),
    "finish": Need(1.75, texel=100, one=98, vgg=4200),
    "stylized": Need(0.53, texel=56, one=39, viewed=64, view=63.5),
    "fit": Need(0.75, texel=86, one=98, viewed=51, view=107, crop=2000),
    "masks": Need(0.77, texel=49, one=109, viewed=56, view=107),
    "repair": Need(0.69, texel=40, one=160, viewed=55, view=121.5, crop=2000),
    "asset": Need(0.75, texel=53, one=172, viewed=60, view=114),
    "report": Need(0.71, texel=39, one=124, viewed=60, view=114, drawn=72, frame=24),
}
PLAIN = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in PLAIN.items()}
# With large arrays in files: the resident remainder.
TILED = {
    "mesh": Need(0.39, face=5000),
    "texels": Need(0.42, texel=30),
    "views": Need(0.60, texel=10, view=4),
    "surface": Need(0.60, texel=10, view=4, sample=1200),
    "bake": Need(0.95, texel=20, view=4),
    "finish": Need(1.75, texel=100, vgg=4200),
    "stylized": Need(0.65, texel=10, view=4),
    "fit": Need(0.75, texel=30, view=4, crop=2000),
    "masks": Need(0.70, texel=35, view=4),
    "repair": Need(0.75, texel=35, view=4, crop=2000),
    "asset": Need(0.70, texel=30, view=4),
    "report": Need(0.65, texel=5, view=4, drawn=78, frame=24),
}
TILED = {stage: need._replace(own=1 + (stage == "mesh")) for stage, need in TILED.items()}
# `render` and `bake` hold at most one texture set at a time. Fitted to runs with one and twenty materials, with and
# without textures, at atlases of 512² to 2048² and views of 128² to 1024².
RENDER = {
    "mesh": Need(0.38, face=5000, own=2),
    "views": Need(0.44, view=46.5, lane=25, own=3),
}
RENDER_TILED = {
    "mesh": Need(0.38, face=5000, own=2),
    "views": Need(0.45, view=6, lane=25, own=3),
}
BAKE = {
    "mesh": Need(0.38, face=5000, own=2),
    "asset": Need(0.50, texel=150, view=58.5, own=1, packed=12),
}
BAKE_TILED = {
    "mesh": Need(0.38, face=5000, own=2),
    "asset": Need(0.60, texel=60, view=10, own=1, packed=12),
}
# Settings of each verb that save memory when halved.
STYLED = ("atlas.size", "surface.samples", "fit.crop_size")
DRAWN = ("rig.resolution", "draw.spp")
BAKED = ("atlas.size",)


def view_count(settings: Settings) -> int:
    """Number of views; an upper estimate of 16 for rigs from a file or from next-best-view selection."""
    rig = settings.rig
    return {"paper": 16, "turntable": rig.views, "nbv": min(16, rig.most_views)}.get(rig.kind, 16)


def view_pixels(settings: Settings) -> int:
    """Pixels of all views."""
    return view_count(settings) * settings.rig.resolution**2


def counts(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of `stylize` for a mesh's faces, texture sets and bytes of its own maps."""
    crop = 0 if settings.refined == "off" else settings.fit.crops * settings.fit.crop_size**2
    return Counts(
        sets * settings.atlas.size**2,
        view_pixels(settings),
        crop,
        settings.surface.samples,
        faces,
        sets * as_drawn(settings.atlas.size, settings.rig.resolution),
        *shown(settings, sets),
        own=own,
        one=settings.atlas.size**2,
        vgg=0 if settings.finish.method == "off" else settings.finish.crops * settings.finish.crop_size**2,
    )


def rig_pixels(settings: Settings) -> list[int]:
    """Pixels of each view of a rig; reads the camera file of a rig from a file."""
    if settings.rig.kind != "file" or settings.rig.file is None:
        side = settings.rig.resolution**2
        return [side] * (view_pixels(settings) // side)
    from mistyle.io.cameras.camera_files import read_cameras

    return [camera.size[0] * camera.size[1] for camera in read_cameras(settings.rig.file)]


def render_counts(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of `render`, which draws from the file's own maps; the number of sets does not matter."""
    from mistyle.render.mitsuba.scene import passes

    pictures = rig_pixels(settings)
    lanes = max(pictures, default=0) * passes(settings.draw.samples())[1]
    return Counts(0, sum(pictures), face=faces, own=own, lane=lanes)


def bake_counts(pictures: Sequence[int], settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> Counts:
    """The counts of `bake` for `pictures` (pixels each): one texture set at a time, and the PNG files of all sets."""
    texels = settings.atlas.size**2
    return Counts(texels, sum(pictures), face=faces, own=own, packed=sets * texels)


def memory_gb(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> float:
    """Peak memory of `stylize`, GB; see `within_gb`."""
    return within_gb(settings, counts(settings, faces, sets, own), PLAIN, TILED)


def tiles(settings: Settings, faces: int = 0, sets: int = 1, own: int = 0) -> bool:
    """Whether `stylize` must move large arrays to files for its budget. UsageError where that is not enough."""
    return must_tile(settings, lambda s: counts(s, faces, sets, own), PLAIN, TILED, STYLED)
