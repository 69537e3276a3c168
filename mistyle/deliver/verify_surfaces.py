"""Check of `mistyle verify`: a model shows every material of its asset, each with its own maps."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mistyle.core.errors import InputRefused, MistyleError
from mistyle.core.names import folded
from mistyle.deliver.verify_checks import MODELS, Check, row
from mistyle.io.sandbox.bounds import USD

CHECK = "materials and their maps"
MAPS = ("map_kd", "map_pr", "map_pm", "norm")


@dataclass(frozen=True)
class List:
    """The content of an asset's or a delivery's list: texture sets (`named` by it, or guessed from its files), and each
    map's file as (set, map, file)."""

    path: Path
    asset: str
    sets: tuple[str, ...]
    maps: tuple[tuple[str, str, str], ...]
    models: tuple[str, ...]
    named: bool


def surface_checks(files: Sequence[Path], name: Callable[[Path], str]) -> Iterator[Check]:
    """A row for every list of ours, and for every model in a list."""
    lists = [listing for path in files if path.suffix == ".json" and (listing := _list(path)) is not None]
    whole = {listing.asset: listing.sets for listing in lists if listing.path.name == f"{listing.asset}.json"}
    expected: dict[Path, int] = {}
    for listing in lists:
        # A list without sets, of an older program, has only those with remaining files; the asset's own list names all.
        # A list with sets counts as it is: the asset may have changed since that delivery.
        sets = listing.sets if listing.named else max(listing.sets, whole.get(listing.asset, ()), key=len)
        if listing.maps:
            summary = f"{len(sets)} texture sets, {len(listing.maps)} maps"
            yield row(name(listing.path), CHECK, _list_errors(sets, listing.maps), summary)
        for model in listing.models if sets else ():
            path = listing.path.parent / model
            expected[path] = min(len(sets), expected.get(path, len(sets)))  # several lists name one look layer
    for path in files:
        if path in expected:
            yield _model_check(path, name(path), expected[path])


def _list(path: Path) -> List | None:
    from mistyle.io.read import read_json

    try:
        content = read_json(path)
        entries, parts = list(content["files"]), content.get("parts")
        names = [str(entry["file"]) for entry in entries]
        if parts is not None:  # an asset's
            sets = {str(part["name"]): str(part["textures"]) for part in parts}
            maps = [(sets[e["part"]], e["map"], f) for e, f in zip(entries, names, strict=True) if "map" in e]
            names_of_sets = tuple(sets.values())
        else:
            maps = [(str(e["set"]), str(e["map"]), f) for e, f in zip(entries, names, strict=True) if "set" in e]
            names_of_sets = tuple(content.get("sets") or dict.fromkeys(s for s, *_ in maps))
        models = tuple(f for f in names if f.endswith((*MODELS, ".mtlx")))
        named = parts is not None or bool(content.get("sets"))
        return List(path, str(content.get("asset", content["name"])), names_of_sets, tuple(maps), models, named)
    except (InputRefused, KeyError, TypeError, AttributeError):
        return None  # not a list of ours, or a damaged one, which verify_checks.listed_files reports


def _list_errors(sets: Sequence[str], maps: Sequence[tuple[str, str, str]]) -> list[str]:
    """Errors of a list: maps that only some sets have, and files that are listed as two maps."""
    kinds, present = sorted({kind for _, kind, _ in maps}), {(s, kind) for s, kind, _ in maps}
    errors = [f"{s} has no file for its {kind}" for s in sets for kind in kinds if (s, kind) not in present]
    owners: dict[str, tuple[str, str]] = {}
    for s, kind, file in maps:
        first = owners.setdefault(folded(file), (s, kind))
        if first != (s, kind):
            errors.append(f"{file} is {first[1]} of {first[0]} and {kind} of {s}")
    return errors


def _model_check(path: Path, name: str, expected: int) -> Check:
    """Whether a model has at least `expected` materials on its faces, and no two maps share a file."""
    reader = _usd if path.suffix.lower() in USD else SURFACES[path.suffix.lower()]
    try:
        materials = reader(path)
    except MistyleError as error:
        return Check(name, CHECK, "not checked", str(error))
    except (OSError, ValueError, LookupError, TypeError, ElementTree.ParseError) as error:
        return Check(name, CHECK, "failed", f"{type(error).__name__}: {str(error)[:200]}")
    errors = [] if len(materials) >= expected else [f"{len(materials)} materials on its faces, expected {expected}"]
    errors += [f"{material} names no map" for material, maps in materials.items() if not maps]
    owners: dict[str, list[str]] = {}
    for material, maps in materials.items():
        for file in maps:
            owners.setdefault(folded(file), []).append(material)
    if reader is not _gltf:
        shared = {file: " and ".join(dict.fromkeys(of)) for file, of in owners.items() if len(of) > 1}
        errors += [f"{file} is several maps of {of}" for file, of in shared.items()]
    elif len(owners) < expected:  # materials of other scenes in the user's file may share images
        errors.append(f"{len(owners)} base colour images, expected {expected}")
    return row(name, CHECK, errors, f"{len(materials)} materials, {len(owners)} maps of their own")


def _gltf(path: Path) -> dict[str, list[str]]:
    """The base colour images of the materials on triangles; other maps may share one image."""
    data = path.read_bytes()
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data[:4] == b"glTF" else data
    tree: dict[str, Any] = json.loads(text)
    used = {p["material"] for m in tree["meshes"] for p in m["primitives"] if "material" in p and p.get("mode", 4) > 3}
    result = {}
    for k in sorted(used):
        texture_info = tree["materials"][k].get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if texture_info is not None:
            texture = tree["textures"][texture_info["index"]]
            result[f"material {k}"] = [f"image {texture.get('source', texture)}"]
    return result


def _obj(path: Path) -> dict[str, list[str]]:
    """The materials that faces use, with the map files of their library."""
    used, current, libraries = set(), "", []
    with open(path, encoding="utf-8") as file:
        for line in file:
            if line.startswith("f "):
                used.add(current)
            elif line.startswith(("usemtl ", "mtllib ")):
                keyword, rest = line.split(None, 1)
                current, libraries = (rest.strip(), libraries) if keyword == "usemtl" else (current, [*libraries, rest])
    known: dict[str, list[str]] = {}
    for library in libraries:
        name = ""
        for line in (path.parent / library.strip()).read_text(encoding="utf-8").splitlines():
            keyword, _, rest = line.strip().partition(" ")
            if keyword == "newmtl":
                name = rest.strip()
            elif keyword.lower() in MAPS:
                known.setdefault(name, []).append(rest.strip())
    return {name: known.get(name, []) for name in sorted(used)}


def _materialx(path: Path) -> dict[str, list[str]]:
    """The images in the node graph of every material's surface and displacement."""
    root, place = ElementTree.parse(path).getroot(), "image/input[@name='file']"
    graphs = {g.get("name"): [i.get("value", "") for i in g.iterfind(place)] for g in root.iterfind("nodegraph")}
    shaders = [*root.iterfind("open_pbr_surface"), *root.iterfind("displacement")]
    surfaces = {s.get("name"): [i.get("nodegraph") for i in s if i.get("nodegraph")] for s in shaders}
    result = {}
    for material in root.iterfind("surfacematerial"):
        names = [g for i in material for g in surfaces[i.get("nodename")]]
        result[str(material.get("name"))] = [file for g in dict.fromkeys(names) for file in graphs[g]]
    return result


def _usd(path: Path) -> dict[str, list[str]]:
    """The textures of every material bound to faces."""
    from mistyle.io.usd.write import heard, library

    pxr = library()
    api, textures = pxr.UsdShade.MaterialBindingAPI, {}
    with heard(pxr):
        try:
            stage = pxr.Usd.Stage.Open(str(path))
        except pxr.Tf.ErrorException as error:
            raise ValueError(str(error).strip().splitlines()[-1]) from None
        for prim in stage.Traverse():
            if not prim.IsA(pxr.UsdGeom.Mesh):
                continue
            subsets = [s for s in api(prim).GetMaterialBindSubsets() if s.GetIndicesAttr().Get()]
            for bound in [s.GetPrim() for s in subsets] or [prim]:
                material = api(bound).ComputeBoundMaterial()[0]
                if material:
                    below = pxr.Usd.PrimRange(material.GetPrim())
                    named = [p.GetAttribute("inputs:file").Get() for p in below if p.HasAttribute("inputs:file")]
                    textures[str(material.GetPath())] = [asset.path for asset in named if asset]
    return textures


SURFACES: Mapping[str, Callable[[Path], dict[str, list[str]]]] = {
    ".glb": _gltf,
    ".gltf": _gltf,
    ".obj": _obj,
    ".mtlx": _materialx,
}
