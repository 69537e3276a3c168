"""Conversion of a parsed mesh to an asset: working space, normals, one usable set of UVs for every material."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from mistyle.core.asset import TURNED, Asset, Material, Source, UpAxis
from mistyle.core.image import resize
from mistyle.core.mesh import Mesh, surface_of
from mistyle.core.names import distinct
from mistyle.core.rows import distinct_integers
from mistyle.geometry.normals import area_vectors, crease_normals, same_points, usable_normals
from mistyle.geometry.raster import fragments
from mistyle.geometry.retexture import (
    REPEAT,
    Covered,
    carry,
    carry_corners,
    covered_texels,
    texel_weights,
    turn_normals,
)
from mistyle.geometry.similarity import Y_FROM_Z
from mistyle.geometry.unwrap import estimated_seconds, unwrap
from mistyle.geometry.upright import lies_on_its_side
from mistyle.geometry.uvs import Layout, Verdict, arrange, signed_areas
from mistyle.io.meshes.lookups import effective, framed, looked_up, plain_lookups
from mistyle.io.meshes.parsed_mesh import Extent, Raw, RawMap, RawMaterial
from mistyle.io.meshes.polygons import check_positions
from mistyle.io.sandbox.bounds import refuse

# Faces below this area in the unit sphere are degenerate (float32 positions).
NO_AREA = 1e-13
ONE_COLOUR = 1 / 512  # vertex colours that differ by less (linear) are equal
TORN = "faces that share texels have different vertex colours"
MAX_TORN = 0.05  # largest difference (linear) of two faces' vertex colours in one texel
PALETTE = 4  # mean texels a face, below which a texture is a palette
FACE_TEXELS = 64  # of a palette's face after resampling
MAPS_SECONDS = 0.5  # of a material's maps, for the progress
SIDEWAYS = (
    "The mesh seems to lie on its side: it is tallest along z, with its base at the lower end. --up z turns it upright."
)
# Rotations about X that turn a file's upward axis to Y.
Y_FROM: dict[UpAxis, Float[np.ndarray, "3 3"]] = {
    "y": np.eye(3), "z": Y_FROM_Z, "-y": np.diag([1.0, -1.0, -1.0]), "-z": Y_FROM_Z.T,
}  # fmt: skip
UnwrapMode = Literal["keep", "new", "auto"]


@dataclass(frozen=True)
class _Plan:
    """The decision on one material's UVs: rows of its faces, kept layout (None: unwrap), the reason for unwrapping, and
    whether its maps must be resampled to the new or kept UVs."""

    rows: Int[np.ndarray, " n"]
    layout: Layout | None
    reason: str
    carried: bool = True


def extent(raw: Raw, path: Path, uv: UnwrapMode, up: UpAxis, size: int) -> Extent:
    """The size of `prepare`'s result, without unwrapping; refuses the same files."""
    check_positions(raw.positions, path)
    raw = plain_lookups(raw)
    area = np.linalg.norm(area_vectors(raw.positions, raw.faces), axis=1)
    points, unwrapped, sets, own, covered = same_points(raw.positions), 0, 0, 0, []
    for m, material in enumerate(raw.materials):
        plan = _plan(raw, m, points, area, uv, path, [])
        unwrapped += 0 if plan.layout is not None else len(_own(raw, plan.rows))
        tiles = [1001] if plan.layout is None else np.unique(plan.layout.tile).tolist()
        sets += len(tiles)
        if plan.layout is not None:
            covered += [min(1.0, float(np.abs(signed_areas(plan.layout.uvs)).sum()) / len(tiles))] * len(tiles)
        tinted = raw.colours is not None and not _one_colour(raw.colours[plan.rows])
        for maps in (material.load(tile)[0] for tile in tiles):
            sides = {name: _side(entry, raw, plan, size) for name, entry in maps.items()}
            if tinted:
                sides["albedo"] = _tinted_side(sides.get("albedo"), size)
            if raw.alphas is not None and not _one_colour(raw.alphas[plan.rows]):
                sides["opacity"] = _tinted_side(sides.get("opacity"), size)
            channels = {name: 1 if name in ("roughness", "metallic", "opacity") else 3 for name in sides}
            own += sum(4 * height * width * channels[name] for name, (height, width) in sides.items())
    work_from_user = _work_matrix(raw, area > 0, path, up)
    work = raw.positions @ work_from_user[:3, :3].T + work_from_user[:3, 3]
    surface = surface_of(work, raw.faces)
    share = float(np.mean(covered)) if covered else float("nan")
    return Extent(len(raw.faces), unwrapped, sets, own, share, surface, work_from_user)


def _side(entry: RawMap, raw: Raw, plan: _Plan, size: int) -> tuple[int, int]:
    """Height and width of a map in the asset: its own, or the square that `_placed` makes."""
    height, width = entry.values.shape[:2]
    if not plan.carried and _is_plain(entry, raw.uvs, plan.rows):
        return height, width
    side = _carried_side(entry, looked_up(entry, raw.uvs, plan.rows), size)
    return side, side


def _tinted_side(albedo: tuple[int, int] | None, size: int) -> tuple[int, int]:
    """Height and width of an albedo with vertex colours in it."""
    side = max((size, *(albedo or ())))
    return side, side


def _one_colour(colours: Float[np.ndarray, "f 3 c"]) -> bool:
    return bool(np.ptp(colours, axis=(0, 1)).max() < ONE_COLOUR)


def prepare(raw: Raw, path: Path, uv: UnwrapMode, up: UpAxis, size: int, progress: Callable[[float], None]) -> Asset:
    """Choose UVs, unwrap where needed, and convert the mesh to the working space. `size` is the atlas size for the
    padding in texels."""
    check_positions(raw.positions, path)
    raw = plain_lookups(raw)
    authored = raw.uvs if raw.authored is None else raw.authored
    area = np.linalg.norm(area_vectors(raw.positions, raw.faces), axis=1)
    work_from_user = _work_matrix(raw, area > 0, path, up)
    work = raw.positions @ work_from_user[:3, :3].T + work_from_user[:3, 3]
    area *= np.linalg.norm(work_from_user[0, :3]) ** 2
    if not (area > NO_AREA).any():
        raise refuse(
            path, f"{len(area)} faces, all without area", "at least one triangle with an area", "Export the mesh again"
        )
    points = same_points(raw.positions)
    notes = list(raw.notes) + ([f"The mesh was turned from {up.upper()}{TURNED}, as requested."] if up != "y" else [])
    if up == "y" and lies_on_its_side(raw.positions, raw.faces):
        notes.append(SIDEWAYS)
    normals = _normals(raw, work, points, work_from_user, notes)
    plans, count, planned = [], len(raw.materials), 0.15 if raw.uvs is None or uv == "new" else 0.5
    for m in range(count):
        plans.append(_plan(raw, m, points, area, uv, path, notes))
        progress(0.1 + (planned - 0.1) * (m + 1) / count)
    share = (1 - planned) * _unwrapping(raw, plans)
    fresh = _unwrap(raw, work, plans, size, lambda done: progress(planned + share * done))
    corner_uvs, part, names, owners = _lay_out(raw, plans, fresh)
    mesh = Mesh(
        positions=work.astype(np.float32),
        faces=raw.faces.astype(np.int32),
        corner_normals=normals,
        corner_uvs=corner_uvs,
        part=part.astype(np.int32),
        parts=names,
    )
    materials = []
    for p, (material, tile) in enumerate(owners):
        part_material, part_notes = _material(
            raw, mesh, p, raw.materials[material], tile, plans[material].carried, size
        )
        materials.append(part_material)
        notes.extend(part_notes)
        progress(planned + share + (1 - planned - share) * (p + 1) / len(owners))
    unchanged = authored is not None and np.array_equal(corner_uvs, authored)
    uv_state = "new" if any(p.layout is None for p in plans) else "kept" if unchanged else "shifted"
    source = Source(
        path=path,
        kind=raw.kind,
        primitives=tuple(_with_part(p, part) for p in raw.primitives),
        user_positions=raw.positions,
        work_from_user=work_from_user,
        old_uvs=None if authored is None else np.nan_to_num(authored).astype(np.float32),
        uv=uv_state,
        notes=tuple(dict.fromkeys(notes)),
    )
    return Asset(name=path.stem, mesh=mesh, materials=tuple(materials), source=source)


def _work_matrix(raw: Raw, has_area: np.ndarray, path: Path, up: UpAxis) -> Float[np.ndarray, "4 4"]:
    """Turns the axis that points up to Y, and maps the bounding sphere to the unit sphere. The sphere is centred on the
    box of vertices of non-degenerate faces."""
    turn = Y_FROM[up]
    used = raw.positions[distinct_integers(raw.faces[has_area] if has_area.any() else raw.faces)] @ turn.T
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    radius = float(np.linalg.norm(used - centre, axis=1).max())
    if radius <= 0:
        raise refuse(path, "vertices that are all at one point", "a shape", "Export the mesh again")
    matrix = np.eye(4)
    matrix[:3, :3] = turn / radius
    matrix[:3, 3] = -centre / radius
    return matrix


def _normals(
    raw: Raw, work: np.ndarray, points: np.ndarray, work_from_user: np.ndarray, notes: list[str]
) -> Float[np.ndarray, "f 3 3"]:
    """The file's corner normals, unit, in working axes; smooth ones with creases where it has none."""
    if raw.normals is None:
        notes.append("The mesh has no normals: smooth ones were computed, with creases at 50 degrees.")
        return crease_normals(work, raw.faces, points)
    fine = usable_normals(raw.normals)
    normals = np.where(fine[..., None], raw.normals, 1).astype(np.float64)
    turn = work_from_user[:3, :3] / np.linalg.norm(work_from_user[0, :3])
    normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)) @ turn.T
    if not fine.all():
        bad = int((~fine).sum())
        notes.append(
            f"{bad} of {fine.size} corner normals are missing, zero or not finite: computed ones replace them."
        )
        normals = np.where(fine[..., None], normals, crease_normals(work, raw.faces, points))
    return normals.astype(np.float32)


def _plan(
    raw: Raw, material: int, points: np.ndarray, area: np.ndarray, uv: UnwrapMode, path: Path, notes: list[str]
) -> _Plan:
    """Keep a material's UVs or unwrap it; records the decision in `notes`. Refuses unusable UVs for `keep`."""
    rows = np.flatnonzero(raw.material == material)
    name = raw.materials[material].name
    own = _own(raw, rows)
    if uv == "new":
        notes.append(f"Material '{name}' was unwrapped anew, as requested.")
        return _Plan(rows, None, "requested")
    layout, reason = _layout(raw, raw.uvs, rows, points, area)
    if raw.materials[material].udim and layout is not None:
        notes.extend(_tile_notes(name, layout, bool(reason) and uv != "keep"))
    if reason and raw.authored is not None:
        authored_layout, refusal = _layout(raw, raw.authored, rows, points, area)
        if not refusal and authored_layout is not None:
            notes.append(
                f"Material '{name}' keeps its UVs as authored and its textures were resampled to them, since with "
                f"their transform {reason}."
            )
            _add_notes(name, authored_layout.verdicts, len(own) < len(rows), notes)
            return _Plan(rows, authored_layout, "")
    if layout is not None and reason == TORN and uv == "keep":
        notes.append(f"Material '{name}': {reason}; each texel takes those of its first face.")
        reason = ""
    if layout is not None and not reason:
        _add_notes(name, layout.verdicts, len(own) < len(rows), notes)
        return _Plan(rows, layout, "", carried=False)
    if uv == "keep":
        found = f"material '{name}' whose UVs cannot be kept ({reason})"
        raise refuse(path, found, "UVs that cover the surface without overlaps", "Use --uv auto or --uv new")
    notes.append(f"Material '{name}' was unwrapped anew, since {reason}.")
    return _Plan(rows, None, reason)


def _layout(
    raw: Raw, uvs: Float[np.ndarray, "f 3 2"] | None, rows: np.ndarray, points: np.ndarray, area: np.ndarray
) -> tuple[Layout | None, str]:
    """One material's faces laid out at `uvs`, and the reason why they cannot be painted ("": they can)."""
    if uvs is None or not np.isfinite(uvs[rows]).any():
        return None, "it has no UVs"
    own = _own(raw, rows)
    udim = raw.materials[int(raw.material[rows[0]])].udim
    layout = arrange(points[raw.faces[own]], uvs[own], area[own], udim)
    if not layout.usable:
        return layout, "its UVs cannot be painted: " + next(v.reason for v in layout.verdicts if not v.usable)
    return layout, "" if _one_colour_a_texel(raw, own, layout) else TORN


def _one_colour_a_texel(raw: Raw, own: Int[np.ndarray, " n"], layout: Layout) -> bool:
    """Whether faces that share texels agree (nearly) in vertex colours, so that a texture can hold them."""
    if raw.colours is None or max(v.shared + v.overlap for v in layout.verdicts) == 0:
        return True
    colours, size, covered, torn = raw.colours[own], 256, 0, 0
    for tile in np.unique(layout.tile):
        spot = layout.uvs[layout.tile == tile].astype(np.float64) * size
        face, texel = fragments(spot, size)
        at = np.einsum("nk,nkc->nc", texel_weights(spot[face], texel, size), colours[layout.tile == tile][face])
        low, high = np.full((size**2, 3), np.inf), np.full((size**2, 3), -np.inf)
        np.minimum.at(low, texel, at)
        np.maximum.at(high, texel, at)
        covered += int(np.count_nonzero(np.bincount(texel)))
        torn += int(((high - low).max(axis=1) > MAX_TORN).sum())
    return torn <= 0.01 * covered


def _add_notes(name: str, verdicts: tuple[Verdict, ...], instances: bool, notes: list[str]) -> None:
    shared, mirrored = max(v.shared for v in verdicts), max(v.mirrored for v in verdicts)
    if instances:
        notes.append(
            f"Material '{name}' is on several instances of a mesh, which share their texels; the first is painted."
        )
    if shared > 0.005:
        notes.append(
            f"Shells of material '{name}' overlap in UV space and share {shared:.0%} of its texels; the first of them "
            "in the file is painted."
        )
    if mirrored > 0.005:
        notes.append(f"{mirrored:.0%} of the UV area of material '{name}' is mirrored; it was kept as authored.")


def _tile_notes(name: str, layout: Layout, unwrapped: bool) -> list[str]:
    """Sentences about faces that do not lie inside one tile of a material whose textures are tiles."""
    count, tiled = len(layout.tile), (layout.tile != 1001).any()
    if unwrapped and tiled:
        return [f"The textures of material '{name}' are tiles; after its unwrapping only tile 1001 is shown."]
    if layout.astray and not tiled:
        return [
            f"{layout.astray} of {count} faces of material '{name}' lie in no UDIM tile (u 0..10, v 0..10); all faces "
            "show the texture of tile 1001."
        ]
    notes = []
    if layout.beyond:
        notes.append(
            f"{layout.beyond} of {count} faces of material '{name}' reach beyond their UDIM tile; there its texture "
            "repeats."
        )
    if layout.astray:
        notes.append(f"{layout.astray} faces of material '{name}' lie in no UDIM tile; they show the nearest tile.")
    return notes


def _unwrap(
    raw: Raw, work: np.ndarray, plans: list[_Plan], size: int, progress: Callable[[float], None]
) -> dict[int, Float[np.ndarray, "n 3 2"]]:
    """New UVs for the materials that need them, by material, for their own (not instanced) faces."""
    needed = [m for m, plan in enumerate(plans) if plan.layout is None]
    if not needed:
        return {}
    meshes = [(work, raw.faces[_own(raw, plans[m].rows)]) for m in needed]
    return dict(zip(needed, unwrap(meshes, size=size, progress=progress), strict=True))


def _unwrapping(raw: Raw, plans: list[_Plan]) -> float:
    """The share of unwrapping in the time of unwrapping and of the materials' maps."""
    seconds = sum(estimated_seconds(len(_own(raw, plan.rows))) for plan in plans if plan.layout is None)
    return seconds / (seconds + MAPS_SECONDS * len(plans))


def _own(raw: Raw, rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    return rows if raw.twin is None else rows[raw.twin[rows] == rows]


def _lay_out(
    raw: Raw, plans: list[_Plan], fresh: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], list[tuple[int, int]]]:
    """Corner UVs, part of every face, part names, and the (material, tile) of every part."""
    count = len(raw.faces)
    uvs, part = np.zeros((count, 3, 2), np.float32), np.zeros(count, np.int64)
    names: list[str] = []
    owners: list[tuple[int, int]] = []
    for m, plan in enumerate(plans):
        own = _own(raw, plan.rows)
        tile = np.full(len(own), 1001) if plan.layout is None else plan.layout.tile
        uvs[own] = fresh[m] if plan.layout is None else plan.layout.uvs
        numbers = np.unique(tile)
        part[own] = len(names) + np.searchsorted(numbers, tile)
        for n in numbers:
            names.append(raw.materials[m].name if len(numbers) == 1 else f"{raw.materials[m].name}.{n}")
            owners.append((m, int(n)))
    if raw.twin is not None:
        uvs, part = _copy_to_instances(raw, uvs), part[raw.twin]
    return uvs, part, tuple(distinct(names, key=str)), owners


def _copy_to_instances(raw: Raw, uvs: Float[np.ndarray, "f 3 2"]) -> Float[np.ndarray, "f 3 2"]:
    """Instances take their first instance's UVs; the corners of a mirrored one are in another order."""
    assert raw.twin is not None
    first = np.zeros(len(raw.faces), np.int64)
    for p in raw.primitives:
        first[p.start : p.stop] = p.first_vertex
    local = raw.faces - first[:, None]
    turned = (local[raw.twin] != local).any(axis=1)
    copied = uvs[raw.twin]
    copied[turned] = copied[turned][:, [0, 2, 1]]
    return copied


def _with_part(primitive, part: Int[np.ndarray, " f"]):
    parts = np.unique(part[primitive.start : primitive.stop])
    return replace(primitive, part=int(parts[0]) if len(parts) == 1 else -1)


def _material(
    raw: Raw, mesh: Mesh, part: int, source: RawMaterial, tile: int, all_carried: bool, size: int
) -> tuple[Material, list[str]]:
    """The maps of a part's `source` in its working UVs, resampled where the file's lookup differs; and notes."""
    maps, load_notes = source.load(tile)
    notes = list(load_notes)
    rows = np.flatnonzero(mesh.part == part)
    plain = {name for name, entry in maps.items() if not all_carried and _is_plain(entry, raw.uvs, rows)}
    covered = lru_cache(1)(partial(covered_texels, mesh.corner_uvs[rows]))  # the maps of a part often have one size
    done = {
        name: entry.finished().values if name in plain else _placed(name, entry, raw, mesh, rows, size, covered)
        for name, entry in maps.items()
    }
    carried = sorted(name for name, values in done.items() if values is not None and name not in plain)
    if carried and not all_carried:
        notes.append(
            f"The {' and '.join(carried)} of material '{source.name}' have texture coordinates of their own and were "
            "resampled to those of its other textures."
        )
    albedo, factor = done.get("albedo"), np.array(source.albedo_factor, np.float32)
    if raw.colours is not None and (raw.colours[rows] != 1).any():
        albedo, factor = _tinted(albedo, factor, raw.colours[rows], mesh.corner_uvs[rows], size)
        notes.append(f"The vertex colours of material '{source.name}' were taken into its albedo.")
    opacity, shading = done.get("opacity"), source.shading
    if raw.alphas is not None and (raw.alphas[rows] != 1).any():
        planes = None if opacity is None else opacity[..., None]
        planes, scale = _tinted(planes, np.ones(1, np.float32), raw.alphas[rows], mesh.corner_uvs[rows], size)
        opacity = None if planes is None else planes[..., 0]
        shading = replace(shading, opacity=shading.opacity * float(scale[0]))
    for name in [n for n, values in done.items() if values is None]:
        notes.append(
            f"The {name} map of material '{source.name}' was left out: its faces have no UVs to look it up at."
        )
    result = Material(
        name=mesh.parts[part],
        albedo=albedo,
        normal=done.get("normal"),
        roughness=done.get("roughness"),
        metallic=done.get("metallic"),
        albedo_factor=factor,
        roughness_factor=float(source.roughness_factor),
        metallic_factor=float(source.metallic_factor),
        opacity=opacity,
        emission=done.get("emission"),
        specular=done.get("specular"),
        shading=shading,
    )
    return result, notes


def _is_plain(entry: RawMap, uvs: Float[np.ndarray, "f 3 2"] | None, rows: np.ndarray) -> bool:
    """Whether a map's lookup is the mesh's UVs with repeat wrapping."""
    if entry.uvs is not None or entry.transform is not None:
        return False
    lookup = None if entry.wrap == REPEAT else looked_up(entry, uvs, rows)
    return lookup is None or effective(entry.wrap, lookup) == REPEAT


def _tinted(
    albedo: Float[np.ndarray, "h w c"] | None,
    factor: Float[np.ndarray, " c"],
    colours: Float[np.ndarray, "f 3 c"],
    uvs: Float[np.ndarray, "f 3 2"],
    size: int,
) -> tuple[Float[np.ndarray, "h2 w2 c"] | None, Float[np.ndarray, " c"]]:
    """Albedo (or opacity) and its factor, multiplied by the colours of the faces' corners. A uniform
    colour goes into the factor, others into a texture of `size` texels a side, or more where the albedo has more."""
    if _one_colour(colours):
        return albedo, factor * (colours.min(axis=(0, 1)) + colours.max(axis=(0, 1))) / 2
    shape = _tinted_side(None if albedo is None else albedo.shape[:2], size)
    tint = carry_corners(colours, uvs, shape[0])
    if albedo is not None:
        tint *= resize(albedo, shape, "repeat")
    return tint, factor


def _placed(
    name: str,
    entry: RawMap,
    raw: Raw,
    mesh: Mesh,
    rows: np.ndarray,
    size: int,
    covered: Callable[[int], Covered],
) -> np.ndarray | None:
    """One map resampled to the part's working UVs, which cover the texels `covered(side)` of a square; None without
    lookup coordinates."""
    lookup = looked_up(entry, raw.uvs, rows)
    if lookup is None:
        return None
    wrap = effective(entry.wrap, lookup)
    entry = (framed(entry) if name == "normal" else entry).finished()
    lookup = np.clip(np.nan_to_num(lookup), -1e6, 1e6)
    side = _carried_side(entry, lookup, size)
    values, face = carry(entry.values, lookup, mesh.corner_uvs[rows], side, wrap, covered(side))
    if name == "normal":
        values = turn_normals(values, face, mesh.positions, mesh.faces[rows], lookup, mesh.corner_uvs[rows])
    return values


def _carried_side(entry: RawMap, lookup: Float[np.ndarray, "f 3 2"] | None, size: int) -> int:
    """Texels a side of a resampled map, `size` at most: as many as it has. Where it repeats, it keeps its density on
    the surface. A palette, with a texel or less a face, gets enough for the faces. The new UVs are assumed to cover
    half of their square, since memory is estimated before they exist."""
    height, width = entry.values.shape[:2]
    side = max(height, width)
    if lookup is None or side >= size or (entry.values == entry.values[:1, :1]).all():
        return min(size, side)
    seen = float(np.abs(signed_areas(np.nan_to_num(lookup))).sum()) * height * width
    needed = 2 * max(seen, FACE_TEXELS * len(lookup) if seen < PALETTE * len(lookup) else 0.0)
    return min(size, max(side, int(np.ceil(np.sqrt(min(needed, float(size) ** 2))))))
