"""Validation of untrusted glTF: container, JSON, references and sizes are checked before use."""

import base64
import binascii
import json
import struct
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mistyle.io.gltf.glb import Buffers
from mistyle.io.gltf.schema import Document, JsonBuffer
from mistyle.io.sandbox import bounds
from mistyle.io.sandbox.bounds import MAX_DEPTH, MAX_JSON_BYTES, beside, read_bytes, read_part, refuse

AGAIN = "Export the file again"
DECOMPRESS = (
    "Write it without compression: open it in Blender and export glTF with Compression off, or export an "
    "uncompressed file from the program that made it"
)
# Extensions that may be required: they do not change the vertices or their storage, or the reader handles them.
READABLE = {
    *("KHR_texture_transform", "KHR_mesh_quantization", "KHR_materials_unlit", "KHR_lights_punctual"),
    *("KHR_materials_variants", "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_specular"),
    *("KHR_materials_ior", "KHR_materials_transmission", "KHR_materials_volume", "KHR_materials_emissive_strength"),
    *("KHR_materials_anisotropy", "KHR_materials_iridescence", "KHR_materials_dispersion", "KHR_animation_pointer"),
    *("KHR_materials_pbrSpecularGlossiness", "KHR_node_visibility", "KHR_xmp_json_ld", "EXT_lights_image_based"),
    *("EXT_texture_webp", "EXT_texture_avif", "KHR_texture_basisu"),
}
COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"}


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file of at most MAX_JSON_BYTES, nested at most MAX_DEPTH deep, without NaN or Infinity."""
    return parse_json(read_bytes(path, MAX_JSON_BYTES), path)


def parse_json(data: bytes, path: Path) -> dict[str, Any]:
    """The bounded JSON object in `data`; `path` names the file in refusals."""

    def constant(name: str) -> float:
        raise ValueError(f"{name} is not a JSON number")

    try:
        tree = json.loads(data.decode("utf-8-sig"), parse_constant=constant)
    except RecursionError as error:
        raise refuse(path, "JSON nested without end", f"at most {MAX_DEPTH} levels", AGAIN) from error
    except ValueError as error:
        raise refuse(
            path, f"no JSON ({error})", "a JSON text", "The file is damaged or something else; check it"
        ) from error
    if not isinstance(tree, dict):
        raise refuse(path, f"a JSON {type(tree).__name__}", "a JSON object", "Check that it is the right file")
    _check_depth(tree, path)
    return tree


def _check_depth(tree: Any, path: Path) -> None:
    """Refuses nesting beyond MAX_DEPTH, and numbers that no double or 64-bit integer holds (1e999 is infinity)."""
    level = [tree]
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for item in level:
            for child in item.values() if isinstance(item, dict) else item:
                if isinstance(child, dict | list):
                    below.append(child)
                elif isinstance(child, float) and not isfinite(child):
                    raise refuse(path, "a number beyond what a double holds", "finite numbers", AGAIN)
                elif isinstance(child, int) and not -(2**63) <= child < 2**64:
                    raise refuse(path, "a whole number of more than 64 bits", "finite numbers", AGAIN)
        level = below
        if not level:
            return
    raise refuse(path, f"JSON nested deeper than {MAX_DEPTH} levels", f"at most {MAX_DEPTH}", AGAIN)


def load_gltf(path: Path, say: Callable[[str], None] = lambda note: None) -> tuple[dict[str, Any], Buffers]:
    """The JSON and the buffers of a .glb or .gltf file, checked.

    Checks: types and ranges of the fields in use; indices; buffer lengths against the extent of accessors and views;
    the node graph (a forest); required extensions.

    Buffers come from the file, from data URIs or from files in the folder of `path` or below; no network is used.
    Compressed copies of uncompressed data are removed from the JSON. `say` receives notes on them, and on properties
    that other readers may refuse. Raises InputRefused with the reason.
    """
    path = Path(path)
    binary = None
    if read_bytes(path, count=4) == b"glTF":
        tree, binary = _unpack(path, say)
    else:
        data = read_bytes(path)
        if len(data) > MAX_JSON_BYTES:
            raise refuse(
                path, f"{len(data) >> 20} MiB of JSON", f"at most {MAX_JSON_BYTES >> 20} MiB", "Export it as .glb"
            )
        tree = parse_json(data, path)
    if any(isinstance(tree.get(name), dict) for name in ("accessors", "buffers", "meshes")):
        raise refuse(path, "glTF 1.0", "glTF 2.0", "Convert it (npx gltf-pipeline -i IN.gltf -o OUT.gltf)")
    document = _validated(tree, path)
    if not document.asset.version.startswith("2."):
        raise refuse(path, f"glTF version {document.asset.version[:20]}", "2.0", "Convert it to glTF 2.0")
    packed = sorted(COMPRESSED & (set(document.extensionsRequired) | set(document.extensionsUsed)))
    unknown = sorted(set(document.extensionsRequired) - READABLE)
    if packed and not COMPRESSED & set(document.extensionsRequired) and _is_plain(tree, document):
        _forget_compression(tree)
        say(f"The compressed copy of its data ({', '.join(packed)}) was left out; the plain one was read.")
    elif packed:
        raise refuse(path, f"compressed data ({', '.join(packed)})", "plain glTF buffers", DECOMPRESS)
    if unknown:
        raise refuse(path, f"required extensions {', '.join(unknown)[:200]}", "core glTF 2.0", "Export it without them")
    _check_indices(document, path)
    _check_nodes(document, path)
    total = sum(buffer.byteLength for buffer in document.buffers)
    if total > bounds.MAX_FILE_BYTES:
        raise refuse(
            path, f"buffers of {total >> 20} MiB", f"at most {bounds.MAX_FILE_BYTES >> 20} MiB", "Reduce the mesh"
        )
    buffers = [_buffer(buffer, binary if i == 0 else None, path) for i, buffer in enumerate(document.buffers)]
    _check_reach(document, path)
    _check_sparse(document, buffers, path)
    return tree, buffers


def _is_plain(tree: dict[str, Any], d: Document) -> bool:
    """Whether all compressed data exist uncompressed as well."""
    for mesh in d.meshes:
        for primitive in mesh.primitives:
            if COMPRESSED & set(primitive.extensions):
                used = [*primitive.attributes.values(), *([] if primitive.indices is None else [primitive.indices])]
                known = [d.accessors[i] for i in used if 0 <= i < len(d.accessors)]
                if any(a.bufferView is None and a.sparse is None for a in known):
                    return False
    # A compressed view decodes into a buffer of its own, which may be absent from the file.
    views = [v for v in tree.get("bufferViews", []) if COMPRESSED & set(_extensions(v))]
    buffers = [d.buffers[v["buffer"]] for v in views if v["buffer"] < len(d.buffers)]
    return all(b.uri is not None or b is d.buffers[0] for b in buffers)


def _extensions(item: dict[str, Any]) -> dict[str, Any]:
    extensions = item.get("extensions")
    return extensions if isinstance(extensions, dict) else {}


def _forget_compression(tree: dict[str, Any]) -> None:
    primitives = [p for mesh in tree.get("meshes", []) for p in mesh["primitives"]]
    for item in [*primitives, *tree.get("bufferViews", []), *tree.get("buffers", [])]:
        if COMPRESSED & set(_extensions(item)):
            item["extensions"] = {k: v for k, v in item["extensions"].items() if k not in COMPRESSED}
            if not item["extensions"]:
                del item["extensions"]
    tree["extensionsUsed"] = [name for name in tree["extensionsUsed"] if name not in COMPRESSED]
    if not tree["extensionsUsed"]:
        del tree["extensionsUsed"]


def _validated(tree: dict[str, Any], path: Path) -> Document:
    try:
        return Document.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(step) for step in first["loc"]) or "the top"
        raise refuse(path, f"at {where}: {first['msg'][:160]}", "glTF 2.0 as specified", AGAIN) from error


def _unpack(path: Path, say: Callable[[str], None]) -> tuple[dict[str, Any], memoryview | None]:
    """JSON and binary chunk of a .glb (glTF 2.0, chapter 4), each read into its own memory."""
    size, head = path.stat().st_size, read_part(path, 0, 12)
    if size < 20:
        raise refuse(
            path, f"a .glb of {size} bytes", "at least a header and a JSON chunk", "The file is cut off; copy it again"
        )
    version, total = struct.unpack_from("<II", head, 4)
    if version != 2:
        raise refuse(path, f".glb version {version}", "version 2", "Convert it to glTF 2.0")
    if total > size:
        raise refuse(path, f"{size} bytes", f"{total} by its header", "The file is cut off; copy it again")
    chunks, at = [], 12
    while at + 8 <= total and len(chunks) < 2:
        length, kind = struct.unpack("<I4s", read_part(path, at, 8))
        if at + 8 + length > total:
            raise refuse(
                path,
                f"a chunk of {length} bytes at {at}",
                f"at most {total - at - 8}",
                "The file is damaged; copy it again",
            )
        chunks.append((kind, read_part(path, at + 8, length)))
        at += 8 + length
    if not chunks or chunks[0][0] != b"JSON":
        raise refuse(path, "a .glb that does not begin with JSON", "a JSON chunk", AGAIN)
    if len(chunks[0][1]) > MAX_JSON_BYTES:
        raise refuse(path, f"{len(chunks[0][1]) >> 20} MiB of JSON", f"at most {MAX_JSON_BYTES >> 20} MiB", AGAIN)
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    text = bytes(chunks[0][1])
    if text.endswith(b"\0"):
        say("The JSON of the .glb is padded with zero bytes, which strict readers refuse; glTF demands spaces.")
    return parse_json(text.rstrip(b"\0"), path), binary


def _buffer(buffer: JsonBuffer, binary: bytes | memoryview | None, path: Path) -> bytes | memoryview:
    if buffer.uri is None:
        if binary is None:
            raise refuse(path, "a buffer without bytes", "a binary chunk or a file", AGAIN)
        data: bytes | memoryview = binary
    elif buffer.uri.startswith("data:"):
        data = data_uri(buffer.uri, path)
    else:
        data = read_bytes(beside(path, buffer.uri))
    if len(data) < buffer.byteLength:
        raise refuse(
            path, f"a buffer of {len(data)} bytes", f"{buffer.byteLength}", "The file is cut off; copy it again"
        )
    return data[: buffer.byteLength]


def data_uri(uri: str, path: Path) -> bytes:
    """The bytes of a base64 data URI."""
    head, _, body = uri.partition(",")
    if not head.endswith(";base64"):
        raise refuse(path, f"a data URI {head[:60]!r}", "base64", AGAIN)
    try:
        return base64.b64decode(body, validate=True)
    except (binascii.Error, ValueError) as error:
        raise refuse(path, f"a data URI that is not base64 ({error})", "base64", AGAIN) from error


def _check_indices(d: Document, path: Path) -> None:
    """Refuse indices out of range."""

    def check(label: str, index: int | None, items: list[Any]) -> None:
        if index is not None and not 0 <= index < len(items):
            raise refuse(
                path, f"{label} {index}", f"0 to {len(items) - 1}" if items else "none, since the list is empty", AGAIN
            )

    for view in d.bufferViews:
        check("buffer", view.buffer, d.buffers)
    for accessor in d.accessors:
        check("buffer view", accessor.bufferView, d.bufferViews)
        if accessor.sparse:
            check("buffer view", accessor.sparse.indices.bufferView, d.bufferViews)
            check("buffer view", accessor.sparse.values.bufferView, d.bufferViews)
    for mesh in d.meshes:
        for primitive in mesh.primitives:
            check("material", primitive.material, d.materials)
            targets = [i for target in primitive.targets for i in target.values()]
            for index in [primitive.indices, *primitive.attributes.values(), *targets]:
                check("accessor", index, d.accessors)
            counts = {d.accessors[i].count for i in primitive.attributes.values()}
            if len(counts) > 1:
                raise refuse(
                    path, f"a primitive whose attributes have {sorted(counts)} elements", "one number for all", AGAIN
                )
    for node in d.nodes:
        check("mesh", node.mesh, d.meshes)
        check("skin", node.skin, d.skins)
    for skin in d.skins:
        check("accessor", skin.inverseBindMatrices, d.accessors)
        for joint in skin.joints:
            check("node", joint, d.nodes)
    check("scene", d.scene, d.scenes)
    for texture in d.textures:
        check("image", texture.source, d.images)
        check("sampler", texture.sampler, d.samplers)
    for image in d.images:
        check("buffer view", image.bufferView, d.bufferViews)
    for m in d.materials:
        pbr = m.pbrMetallicRoughness
        infos = [
            m.normalTexture,
            m.emissiveTexture,
            *((pbr.baseColorTexture, pbr.metallicRoughnessTexture) if pbr else ()),
        ]
        for info in infos:
            check("texture", info.index if info else None, d.textures)


def _check_nodes(d: Document, path: Path) -> None:
    """The node graph is a forest of bounded depth (glTF 2.0, 3.5.2: no cycles, one parent at most)."""
    parent = [-1] * len(d.nodes)
    for i, node in enumerate(d.nodes):
        for child in node.children:
            if not 0 <= child < len(d.nodes):
                raise refuse(path, f"node {i} with child {child}", f"0 to {len(d.nodes) - 1}", AGAIN)
            if parent[child] >= 0 or child == i:
                raise refuse(path, f"node {child} below two nodes or below itself", "a tree of nodes", AGAIN)
            parent[child] = i
    level = [i for i, p in enumerate(parent) if p < 0]
    seen = depth = 0
    while level:
        seen, depth = seen + len(level), depth + 1
        if depth > MAX_DEPTH:
            raise refuse(path, f"nodes nested deeper than {MAX_DEPTH}", f"at most {MAX_DEPTH}", "Flatten the hierarchy")
        level = [child for i in level for child in d.nodes[i].children]
    if seen < len(d.nodes):
        raise refuse(path, "a cycle in the node graph", "a tree of nodes", AGAIN)
    for scene in d.scenes:
        if any(not 0 <= i < len(d.nodes) for i in scene.nodes):
            raise refuse(path, "a scene with a missing node", f"0 to {len(d.nodes) - 1}", AGAIN)


_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def _check_reach(d: Document, path: Path) -> None:
    """Views lie inside their buffers, accessors inside their views; types are known."""
    for i, view in enumerate(d.bufferViews):
        end, length = view.byteOffset + view.byteLength, d.buffers[view.buffer].byteLength
        if end > length:
            raise refuse(path, f"buffer view {i} up to byte {end}", f"at most {length}, the buffer's length", AGAIN)
    for i, accessor in enumerate(d.accessors):
        if accessor.componentType not in _BYTES or accessor.type not in _COMPONENTS:
            raise refuse(
                path, f"accessor {i} of {accessor.type[:20]} {accessor.componentType}", "a type of glTF 2.0", AGAIN
            )
        size = _BYTES[accessor.componentType] * _COMPONENTS[accessor.type]
        if accessor.bufferView is not None:
            view = d.bufferViews[accessor.bufferView]
            end = accessor.byteOffset + (view.byteStride or size) * (accessor.count - 1) + size
            if end > view.byteLength:
                raise refuse(path, f"accessor {i} up to byte {end} of its view", f"at most {view.byteLength}", AGAIN)
        if accessor.sparse:
            kind = accessor.sparse.indices.componentType
            if kind not in (5121, 5123, 5125):
                raise refuse(path, f"sparse indices of type {kind}", "unsigned integers", AGAIN)
            for part, step in ((accessor.sparse.indices, _BYTES[kind]), (accessor.sparse.values, size)):
                end = part.byteOffset + step * accessor.sparse.count
                if end > d.bufferViews[part.bufferView].byteLength:
                    raise refuse(
                        path, f"sparse values of accessor {i} up to byte {end}", "as many as its view holds", AGAIN
                    )


def _check_sparse(d: Document, buffers: Buffers, path: Path) -> None:
    """Sparse values replace elements that exist."""
    for i, accessor in enumerate(d.accessors):
        if accessor.sparse is None:
            continue
        places, view = accessor.sparse.indices, d.bufferViews[accessor.sparse.indices.bufferView]
        kind = np.dtype({1: "u1", 2: "<u2", 4: "<u4"}[_BYTES[places.componentType]])
        start = view.byteOffset + places.byteOffset
        index = np.frombuffer(buffers[view.buffer], kind, accessor.sparse.count, start)
        if index.max() >= accessor.count:
            problem = f"accessor {i} with a sparse value for element {index.max()}"
            raise refuse(path, problem, f"0 to {accessor.count - 1}", AGAIN)
