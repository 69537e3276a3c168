"""Stages of the embedded stylizer: paint the surface once, bake it into the texture, render it from every camera."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mistyle.core.asset import Asset, Picture
from mistyle.core.errors import InputRefused
from mistyle.core.image import linear_from_srgb
from mistyle.core.maps import Maps, Texels
from mistyle.core.mesh import face_areas
from mistyle.core.view import View
from mistyle.geometry.tangents import corner_tangents
from mistyle.jobs.progress import Report
from mistyle.jobs.stages import Run
from mistyle.process import memory
from mistyle.stylization.records import Atlas, Baked
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface.exemplar.reading import StyleReading
from mistyle.stylization.surface.guides.guides import Content
from mistyle.stylization.surface.guides.linefield import DirectionConstraint
from mistyle.stylization.surface.layers import StyleLayers
from mistyle.stylization.surface.lookup import PaintedSurface
from mistyle.stylization.surface.settings import PaintSettings


def paint_pictures(settings: PaintSettings) -> list[Path]:
    """The required pictures of the paint settings."""
    return [path for path in (settings.style_mask, settings.protect, settings.direction_map) if path is not None]


def check_paint(settings: PaintSettings) -> None:
    """InputRefused for missing pictures, before anything is rendered."""
    for path in paint_pictures(settings):
        if not path.is_file():
            raise InputRefused(f"{path}: found nothing; expected a picture. Check the path")


def paint_files(settings: PaintSettings) -> list[Path]:
    """The files in the paint settings; cache keys use their contents, not their names."""
    named = paint_pictures(settings)
    for slot in settings.slots:
        name, _, picture = slot.rpartition("=")
        named += [Path(name), Path(picture)]
    return [path for path in named if path.is_file()]


def paint(
    asset: Asset,
    style: Picture,
    settings: Settings,
    report: Report,
    content: Content | None = None,
    direction: DirectionConstraint | None = None,
) -> PaintedSurface:
    """Paint the surface with one picture; `content`: lightness of its own texture; `direction`: that of strokes."""
    from mistyle.stylization.surface.painter import solve_surface

    return solve_surface(
        asset.mesh, style, settings.surface, settings.seed, progress=report, content=content, direction=direction
    )


def paint_layers(
    asset: Asset,
    style: Picture,
    atlas: Atlas,
    settings: Settings,
    report: Report,
    readings: Sequence[StyleReading] = (),
) -> StyleLayers:
    """Paint the whole surface once with every picture of the style and slots.

    `readings` are the measures of these pictures, if known; others are measured here.
    """
    from mistyle.deliver.colour import read_style
    from mistyle.stylization.surface.exemplar.chosen import resolved
    from mistyle.stylization.surface.layers import content, masked_style, painted_direction, scaled, slot_masks

    surface = scaled(settings.surface, asset, settings.paint.stroke_size)
    paths, masks = slot_masks(asset, atlas.texels, settings.paint.slots)
    pictures = [masked_style(style, settings.paint.style_mask), *(read_style(path, settings.colour) for path in paths)]
    choice = [np.zeros(texels.covered.shape, np.int32) for texels in atlas.texels]
    for number, chosen in enumerate(masks, start=1):
        for texels_of, mask in zip(choice, chosen, strict=True):
            texels_of[mask] = number
    lightness = content(atlas.texels, atlas.start) if surface.keep_content > 0 else None
    direction = painted_direction(settings.paint.direction_map, asset.mesh, atlas.texels)
    solutions = []
    for k, picture in enumerate(pictures):

        def part_done(done: float, k: int = k) -> None:
            report((k + done) / len(pictures))

        own = settings.model_copy(update={"surface": resolved(surface, readings[k]) if readings else surface})
        solutions.append(paint(asset, picture, own, part_done, lightness, direction))
    return StyleLayers(tuple(solutions), tuple(choice))


def texel_side(asset: Asset, part: int, texels: Texels) -> float:
    """Mean side of a texel on the surface, working units; the painting is averaged over it."""
    area = face_areas(asset.mesh)[asset.mesh.part == part].sum()
    return float(np.sqrt(area / max(int(texels.covered.sum()), 1)))


def bake(
    asset: Asset, layers: StyleLayers, atlas: Atlas, views: Sequence[View], settings: Settings, report: Report
) -> Baked:
    """Section 4.1.4 for a painted surface: texels sample the painting directly; views give visibility only."""
    from mistyle.atlas.bake import accepted

    maps, with_relief = raised(asset, layers, atlas, settings)
    seen = []
    for part, texels in enumerate(atlas.texels):
        seen.append(accepted(views, texels, settings.bake, mesh=asset.mesh)[1].reshape(texels.covered.shape))
        report((part + 1) / len(atlas.texels))
    if settings.refined in PAINTERS:
        return Baked(tuple(with_relief), tuple(seen))
    return Baked(tuple(maps), tuple(seen), tuple(with_relief))


PAINTERS = ("off", "albedo")  # values of `refined` that keep the painter's normal and roughness
HEIGHT, GLOSS = 0.15, 1.0  # slope of the painting's relief in the normal map, and share of its gloss in the roughness
LOOKED_UP = 2**20  # texels per look-up batch


def painted(asset: Asset, layers: StyleLayers | PaintedSurface, atlas: Atlas, settings: Settings) -> list[Maps]:
    """The start maps with the painting's colours as albedo, looked up for every covered texel.

    A single solution covers all texture sets.
    """
    return [_laid(asset, layers, atlas, settings, part, (0, 0))[0] for part in range(len(atlas.texels))]


def raised(
    asset: Asset, layers: StyleLayers | PaintedSurface, atlas: Atlas, settings: Settings
) -> tuple[list[Maps], list[Maps]]:
    """The painted maps, and the same with the painting's relief added to their normals and its gloss to their
    roughness."""
    height = relief_slope(settings)
    gloss = GLOSS if settings.paint.gloss is None else settings.paint.gloss
    both = [_laid(asset, layers, atlas, settings, part, (height, gloss)) for part in range(len(atlas.texels))]
    return [flat for flat, _ in both], [bent for _, bent in both]


def _laid(
    asset: Asset,
    layers: StyleLayers | PaintedSurface,
    atlas: Atlas,
    settings: Settings,
    part: int,
    strength: tuple[float, float],
) -> tuple[Maps, Maps]:
    """Painted maps of a texture set without and with relief and gloss of this strength; equal if both are 0.

    Colour and relief share the search for nearest samples, band by band.
    """
    from mistyle.atlas.texels import pad_in_place, sharpen_in_place
    from mistyle.core.image import nearest_fill_in_place
    from mistyle.stylization.surface import lookup
    from mistyle.stylization.surface.layers import PaintRelief, TexelBand, lay_relief, painted_mask, protected

    texels, start, used = atlas.texels[part], atlas.start[part], any(strength)
    side, tangents = texel_side(asset, part, texels), corner_tangents(asset.mesh)
    albedo, bent = memory.zeros(start.albedo.shape), start
    if used:
        bent = replace(start, normal=memory.copied(start.normal), roughness=memory.copied(start.roughness))
    for solution, at in whose(layers, part, texels):
        for rows in pieces(at):
            mask = at[rows]
            place = texels.position[rows][mask], texels.normal[rows][mask]
            near = lookup.neighbours(solution, *place)
            albedo[rows][mask] = linear_from_srgb(lookup.colour(solution, *place, footprint=side, near=near))
            if used:
                relief = PaintRelief(*lookup.relief(solution, *place, footprint=side, near=near))
                lay_relief(bent, TexelBand(texels, rows, mask), relief, *strength, asset.mesh, tangents)
    sharpen_in_place(albedo, texels)
    pad_in_place([albedo], texels, settings.atlas.padding)
    flat, bent = (replace(maps, albedo=albedo, known=texels.covered) for maps in (start, bent))
    chosen = [values for values, share in zip((bent.normal, bent.roughness), strength, strict=True) if share > 0]
    if used:
        nearest_fill_in_place(chosen, texels.covered)
    if settings.paint.protect is not None:
        kept = painted_mask(settings.paint.protect, texels)
        flat, bent = (protected(maps, start, kept) for maps in (flat, bent))
    return flat, bent


def relief_slope(settings: Settings) -> float:
    """Slope (root mean square) of the painting's relief."""
    return HEIGHT if settings.paint.height is None else settings.paint.height


def pieces(at: np.ndarray) -> Iterator[slice]:
    """Bands of rows with about LOOKED_UP chosen texels each."""
    from mistyle.atlas.texels import bands

    share = max(float(at.mean()), 1e-3)
    return (rows for rows in bands(at.shape[0], at.shape[1], round(LOOKED_UP / share)) if at[rows].any())


def whose(layers: StyleLayers | PaintedSurface, part: int, texels: Texels) -> list[tuple[PaintedSurface, np.ndarray]]:
    """Each solution with its mask of covered texels in a texture set."""
    if isinstance(layers, PaintedSurface):
        return [(layers, texels.covered)]
    return [(one, texels.covered & (layers.choice[part] == k)) for k, one in enumerate(layers.solutions)]


def surface_stage(
    run: Run, asset: Asset, style: Picture, atlas: Atlas, readings: Sequence[StyleReading] = ()
) -> StyleLayers:
    """The stage "surface": the painting, before it is baked. `readings` are the measures of the style's pictures."""
    s, seed = run.job.settings, run.job.settings.seed
    inputs = [style.rgb, style.alpha, s.surface, s.paint, paint_files(s.paint), seed]
    return run.record("surface", ["texels"], inputs, lambda r: paint_layers(asset, style, atlas, s, r, readings))


def stylized_stage(run: Run, asset: Asset, baked: Baked, views: Sequence[View], after: str) -> list[View]:
    """The stylized views, rendered from the painted texture and so consistent; `after` is the stage that wrote it."""
    from mistyle.io.cameras.views import read_views, write_views

    def write(folder: Path, report: Report) -> None:
        drawn = unlit_views(asset, baked.maps, views, report)
        write_views(folder, drawn, (), paper_files=False)

    return read_views(run.stage("stylized", [after, "views"], [], write))


def unlit_views(asset: Asset, maps: Sequence[Maps], views: Sequence[View], report: Report) -> list[View]:
    """Each view with its rgb replaced by the albedo seen there, premultiplied."""
    from mistyle.render.mitsuba.unlit import unlit

    drawn = unlit(asset.mesh, maps, [view.camera for view in views], progress=report)
    return [replace(view, rgb=rgb, coverage=share) for view, (rgb, share) in zip(views, drawn, strict=True)]


def with_geometry(asset: Asset, views: Sequence[View]) -> list[View]:
    """Pictures with the mesh's own depth, normals, UVs and parts, and their mask cut to the mesh."""
    from mistyle.render.mitsuba.draw import gbuffer, tracer

    traced = tracer(asset.mesh)
    result = []
    for view in views:
        hits = gbuffer(traced, view.camera)
        result.append(
            replace(view, depth=hits.depth, normal=hits.normal, uv=hits.uv, part=hits.part, mask=hits.mask & view.mask)
        )
    return result
