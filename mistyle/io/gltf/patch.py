"""Writer of a user's glTF with new textures and otherwise unchanged content.

Nodes, names, skins, animations, cameras, extras and extensions are copied unchanged, vertex attributes byte by byte.
These change: textures of the painted materials, and TANGENT (MikkTSpace) of the painted primitives; after a
displacement also POSITION and NORMAL (`displaced.py`). Their COLOR_0 is
removed, since viewers would multiply the painting by it (it is part of the albedo). A mesh that was unwrapped anew, or
whose texture coordinates were transformed, gets the next free TEXCOORD set. Where corners of one vertex need different
tangents or texture coordinates, copies of the vertex are appended, so old vertex indices stay valid. The
copies have all attributes (joints, weights, morph targets, custom ones).
"""

import copy
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mistyle import __version__
from mistyle.core.asset import Asset, Primitive
from mistyle.core.errors import MistyleError
from mistyle.io.gltf.alpha import image_bytes
from mistyle.io.gltf.displaced import displaced_buffers
from mistyle.io.gltf.glb import TRIANGLES, Buffers, Builder, Tree, values
from mistyle.io.gltf.infos import shadeless
from mistyle.io.gltf.tidy import drop_unused
from mistyle.io.gltf.vertices import Patch, rewrite, triangles
from mistyle.io.images.textures import Pictures, add_textures, drop_emission, drop_extension, part_stems, set_textures
from mistyle.io.images.write import encode_png
from mistyle.io.read_mesh import load_gltf

# Texture coordinates that were shifted by integers differ in their last bits; a texel of 16384 is 6e-5.
SAME_UV = 1e-5


def patch_tree(asset: Asset, pictures: Sequence[Pictures], *, name: str, provenance: dict) -> Builder:
    """The user's file (asset.source.path, read again) with the new textures, ready to be packed.

    Nodes that share a mesh keep it if they were painted with the same texture coordinates; otherwise each further node
    gets a copy of the mesh. Raises MistyleError when the file has changed since it was read.
    """
    tree, buffers = load_gltf(asset.source.path)
    tree = copy.deepcopy(tree)
    if asset.source.displacement is not None:
        buffers = displaced_buffers(tree, buffers, asset)
    builder = Builder(tree, buffers)
    patches = _with_texcoords(tree, buffers, _separate_nodes(tree, _patches(tree, buffers, asset)))
    repeating = _repeating(tree, buffers, patches)
    faces = rewrite(builder, buffers, patches)
    _drop_colours(tree, patches)
    materials = _set_materials(builder, asset, patches, pictures, repeating, name)
    for patch in patches:
        _divide(builder, patch, faces[patch.mesh, patch.primitive], materials)
    head = tree["asset"]
    extras = head.get("extras")
    note = {"mistyle": provenance | {"source_generator": head.get("generator", "")}}
    head["extras"] = (extras if isinstance(extras, dict) else {}) | note
    head["generator"] = f"mistyle {__version__}"
    drop_unused(builder)
    missing = _embed_images(builder, buffers, asset)
    if missing:
        note["mistyle"]["missing_images"] = missing
    return builder


def _drop_colours(tree: Tree, patches: Sequence[Patch]) -> None:
    """Remove the vertex colours of the painted primitives and of their morph targets."""
    for patch in patches:
        primitive = tree["meshes"][patch.mesh]["primitives"][patch.primitive]
        for group in (primitive["attributes"], *primitive.get("targets", [])):
            group.pop("COLOR_0", None)


def _patches(tree: Tree, buffers: Buffers, asset: Asset) -> dict[int, list[Patch]]:
    """The patches of every node's primitives, in the file's winding; `texcoord` is the set from which the UVs were
    read."""
    groups: dict[tuple[int, int, int], list[Primitive]] = defaultdict(list)
    for primitive in asset.source.primitives:
        groups[primitive.node, primitive.mesh, primitive.primitive].append(primitive)
    result: dict[int, list[Patch]] = defaultdict(list)
    for (node, mesh, number), entries in groups.items():
        rows = np.arange(entries[0].start, entries[0].stop)  # further ones are instances, with the same texels
        faces = asset.mesh.faces[rows].astype(np.int64) - entries[0].first_vertex
        order = [0, 1, 2]
        try:
            file_faces = triangles(tree, buffers, tree["meshes"][mesh]["primitives"][number])
        except (LookupError, TypeError):
            file_faces = None
        if file_faces is not None and not np.array_equal(faces, file_faces):
            order = [0, 2, 1]
        if file_faces is None or not np.array_equal(faces[:, order], file_faces):
            raise MistyleError(
                f"{asset.source.path}: primitive {number} of mesh {mesh} no longer has the faces that were read; "
                "the file has changed meanwhile, run again from the start"
            )
        uvs, part = asset.mesh.corner_uvs[rows][:, order], asset.mesh.part[rows]
        material = tree["meshes"][mesh]["primitives"][number].get("material", -1)
        result[node].append(Patch(mesh, number, file_faces, uvs, part, material, entries[0].texcoord))
    return result


def _separate_nodes(tree: Tree, patches: dict[int, list[Patch]]) -> list[Patch]:
    """One patch per primitive: nodes of one mesh that were painted differently get copies of the mesh."""
    variants: dict[int, list[list[Patch]]] = defaultdict(list)
    for node, own in patches.items():
        mesh = own[0].mesh
        known = next((v for v in variants[mesh] if _equal(v, own)), None)
        if known is None and variants[mesh]:
            tree["meshes"].append(copy.deepcopy(tree["meshes"][mesh]))
            known = [replace(p, mesh=len(tree["meshes"]) - 1) for p in own]
            variants[mesh].append(known)
        elif known is None:
            variants[mesh].append(own)
            continue
        tree["nodes"][node]["mesh"] = known[0].mesh
    return [p for mesh in sorted(variants) for variant in variants[mesh] for p in variant]


def _equal(a: list[Patch], b: list[Patch]) -> bool:
    same = [x.primitive for x in a] == [x.primitive for x in b]
    return same and all(
        np.array_equal(x.part, y.part) and np.abs(_but_for_tiles(x.uvs - y.uvs)).max(initial=0) < SAME_UV
        for x, y in zip(a, b, strict=True)
    )


def _but_for_tiles(difference: np.ndarray) -> np.ndarray:
    """Differences of corner UVs (f 3 2) modulo the whole tiles by which faces were moved."""
    return difference - np.rint(difference[:, :1])


def _with_texcoords(tree: Tree, buffers: Buffers, patches: list[Patch]) -> list[Patch]:
    """Decide per material whether the file's own set suffices (modulo 1), or the UVs need a new one.

    All textures of a material use one set, so all primitives of a material get a new set if one needs it.
    """
    members: dict[int, list[Patch]] = defaultdict(list)
    for patch in patches:
        members[patch.material].append(patch)
    decided: dict[tuple[int, int], Patch] = {}
    for group in members.values():
        counts = [_sets(tree, p) for p in group]
        keep = len({p.texcoord for p in group}) == 1 and all(_is_kept(tree, buffers, p) for p in group)
        for patch, count in zip(group, counts, strict=True):
            new = patch if keep else replace(patch, texcoord=-1, fresh=tuple(range(count, max(counts) + 1)))
            decided[patch.mesh, patch.primitive] = new
    return [decided[p.mesh, p.primitive] for p in patches]


def _sets(tree: Tree, patch: Patch) -> int:
    attributes = tree["meshes"][patch.mesh]["primitives"][patch.primitive]["attributes"]
    return next(n for n in range(len(attributes) + 1) if f"TEXCOORD_{n}" not in attributes)


def _file_uvs(tree: Tree, buffers: Buffers, patch: Patch) -> np.ndarray | None:
    attributes = tree["meshes"][patch.mesh]["primitives"][patch.primitive]["attributes"]
    index = attributes.get(f"TEXCOORD_{patch.texcoord}")
    return None if index is None else values(tree, buffers, index)[patch.faces]


def _is_kept(tree: Tree, buffers: Buffers, patch: Patch) -> bool:
    own = _file_uvs(tree, buffers, patch)
    if own is None:
        return False
    difference = np.stack([own[..., 0] - patch.uvs[..., 0], 1 - own[..., 1] - patch.uvs[..., 1]], axis=-1)
    return bool(np.abs(_but_for_tiles(difference)).max(initial=0) < SAME_UV)


def _repeating(tree: Tree, buffers: Buffers, patches: list[Patch]) -> set[int]:
    """Parts whose texture coordinates in the file leave the unit square."""
    result = set()
    for patch in patches:
        own = _file_uvs(tree, buffers, patch) if patch.texcoord >= 0 else patch.uvs
        outside = ((own < 0) | (own > 1)).any(axis=(1, 2)) if own is not None else np.zeros(0, bool)
        result |= set(patch.part[outside].tolist())
    return result


def _set_materials(
    builder: Builder, asset: Asset, patches: list[Patch], pictures: Sequence[Pictures], repeating: set[int], name: str
) -> dict[tuple[int, int], int]:
    """Give the painted materials new textures; returns (material in the file, part) to index of the new material.

    A material keeps its index unless unpainted primitives (lines, meshes outside the scene) use it too. Then, and for
    every further texture set of a UDIM material, a copy is appended.
    """
    tree, stems = builder.tree, part_stems(name, asset.mesh.parts)
    painted = {(p.mesh, p.primitive) for p in patches}
    unpainted = {
        primitive.get("material", -1)
        for m, mesh in enumerate(tree["meshes"])
        for n, primitive in enumerate(mesh["primitives"])
        if (m, n) not in painted
    }
    originals = copy.deepcopy(tree.get("materials", []))
    textures: dict[int, dict[str, int]] = {}
    indices: dict[tuple[int, int], int] = {}
    for patch in patches:
        for part in np.unique(patch.part).tolist():
            if (patch.material, part) in indices:
                continue
            if part not in textures:
                textures[part] = add_textures(builder, pictures[part], stems[part], repeat=part in repeating)
            material = copy.deepcopy(originals[patch.material]) if patch.material >= 0 else {}
            if shadeless(material):
                drop_emission(material)
            if asset.source.lit:
                drop_extension(material, "KHR_materials_unlit")
            set_textures(material, textures[part], patch.fresh[-1] if patch.fresh else patch.texcoord)
            further = any(m == patch.material for m, _ in indices)
            if patch.material < 0 or further:
                material["name"] = asset.materials[part].name
            if patch.material < 0 or further or patch.material in unpainted:
                indices[patch.material, part] = builder.put("materials", material)
            else:
                indices[patch.material, part] = patch.material
                tree["materials"][patch.material] = material
    return indices


def _divide(builder: Builder, patch: Patch, faces: np.ndarray, materials: dict[tuple[int, int], int]) -> None:
    """Set a primitive's material; one with faces in several texture sets becomes several, as glTF has no UDIM."""
    primitives = builder.tree["meshes"][patch.mesh]["primitives"]
    primitive = primitives[patch.primitive]
    first, *rest = np.unique(patch.part).tolist()
    primitive["material"] = materials[patch.material, first]
    for part in rest:
        copied = copy.deepcopy(primitive) | {"material": materials[patch.material, part], "mode": TRIANGLES}
        copied["indices"] = builder.indices(faces[patch.part == part])
        primitives.append(copied)
    if rest:
        primitive |= {"indices": builder.indices(faces[patch.part == first]), "mode": TRIANGLES}


def _embed_images(builder: Builder, buffers: Buffers, asset: Asset) -> list[str]:
    """Embed the remaining images that lie beside the file. Returns the names of missing ones, which a white pixel
    replaces (equal to no texture)."""
    missing = []
    for image in builder.tree.get("images", []):
        if "uri" in image:
            data = image_bytes(image, builder.tree, buffers, asset.source.path)
            if data is None:
                missing.append(str(image["uri"])[:200])
                data = encode_png(np.ones((1, 1, 3), np.float32))
            del image["uri"]
            image["mimeType"] = _mime(data)
            image["bufferView"] = builder.view(data)
    return missing


def _mime(data: bytes) -> str:
    if data.startswith(b"\x89PNG"):
        return "image/png"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "image/webp"
    if data[4:12] == b"ftypavif":
        return "image/avif"
    return "image/ktx2" if data.startswith(b"\xabKTX 20") else "image/jpeg"
