"""The checks of `mistyle verify` by independent readers: one row per file and reader."""

import json
import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from mistyle.core.errors import InputRefused, MistyleError
from mistyle.core.paths import real_path
from mistyle.deliver.read_asset import SHARDS, jobs_of_batch
from mistyle.io.sandbox.bounds import USD
from mistyle.io.store.atomic import sha256_file
from mistyle.render.external.blender import BLENDER, OPEN_WORKER, blender_command

Outcome = Literal["passed", "failed", "not checked"]
MODELS = (".glb", ".gltf", *USD, ".obj")
VALIDATE = """
const fs = require('fs'), path = require('path'), validator = require('gltf-validator');
const file = process.argv[1], folder = path.dirname(file);
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
  uri: path.basename(file), maxIssues: 100,
  externalResourceFunction: (uri) => fs.promises.readFile(path.join(folder, decodeURIComponent(uri))),
}).then((report) => console.log(JSON.stringify({ version: validator.version(), issues: report.issues })));
"""


@dataclass(frozen=True)
class Check:
    """One check of a file: its reader, the outcome and the message."""

    file: str
    check: str
    outcome: Outcome
    said: str


def row(file: str, check: str, complaints: Sequence[str], fine: str) -> Check:
    if complaints:
        more = f" (and {len(complaints) - 3} more)" if len(complaints) > 3 else ""
        return Check(file, check, "failed", "; ".join(complaints[:3]) + more)
    return Check(file, check, "passed", fine)


def listed_files(listing: Path, name: str) -> Check | None:
    """The sha256 of all files in a list of ours (of an asset, a delivery, a stage, a batch's job); None for a JSON file
    that is not a list."""
    from mistyle.io.read import read_json

    try:
        content = read_json(listing)
    except InputRefused as error:
        return Check(name, "JSON", "failed", str(error))
    try:
        entries = content["files"]
        pairs = entries.items() if isinstance(entries, dict) else [(e["file"], e.get("sha256")) for e in entries]
        hashes = {str(file): value for file, value in pairs if value is not None}
    except (KeyError, TypeError, AttributeError):
        return None
    errors, base = [], listing.parent
    if base.name == SHARDS and jobs_of_batch(base.parent) is not None:
        base = base.parent  # a batch's markers name files from its folder
    for file, value in hashes.items():
        path = base / file
        if not path.is_file():
            errors.append(f"{file} is missing")
        elif sha256_file(path) != value:
            errors.append(f"{file} has changed")
    return row(name, "sha256 of the files it lists", errors, f"{len(hashes)} files as they were written")


def validator_home() -> Path | str:
    """The node_modules with Khronos' validator, or the reason for its absence. Nothing is downloaded."""
    node = which("node")
    if node is None:
        return "node not found"
    places = [Path(p) for p in os.environ.get("NODE_PATH", "").split(os.pathsep) if p] + [Path("node_modules")]
    cache = Path(os.environ.get("MISTYLE_CACHE") or Path.home() / ".cache" / "mistyle") / "npm"
    places += sorted(cache.glob("*")) if cache.is_dir() else []
    npm = which("npm")
    if npm is not None:
        done = subprocess.run([npm, "root", "-g"], capture_output=True, text=True, timeout=60)
        places += [Path(done.stdout.strip())] if done.returncode == 0 and done.stdout.strip() else []
    modules = next((p for p in places if (p / "gltf-validator").is_dir()), None)
    return real_path(modules) if modules else "node found, gltf-validator not found (npm install -g gltf-validator)"


def gltf(path: Path, name: str) -> Iterator[Check]:
    """Khronos' validator through node."""
    home = validator_home()
    if isinstance(home, str):
        yield Check(name, "Khronos glTF validator", "not checked", home)
        return
    command = ["node", "-e", VALIDATE, str(real_path(path))]
    done = subprocess.run(
        command, env=os.environ | {"NODE_PATH": str(home)}, capture_output=True, text=True, timeout=300
    )
    if done.returncode:
        yield Check(
            name, "Khronos glTF validator", "failed", done.stderr.strip()[-300:] or f"ended with {done.returncode}"
        )
        return
    result = json.loads(done.stdout)
    issues = result["issues"]
    errors = [f"{m['code']} {m.get('pointer', '')}".strip() for m in issues["messages"] if m["severity"] == 0]
    counts = f"{issues['numErrors']} errors, {issues['numWarnings']} warnings, {issues['numInfos']} notes"
    if issues["numErrors"] and not errors:
        errors = [counts]
    yield row(name, f"Khronos glTF validator {result['version']}", errors, counts)


def by_trimesh(path: Path, name: str) -> Iterator[Check]:
    """Faces, finite vertices and UVs by trimesh."""
    import trimesh

    check = f"trimesh {trimesh.__version__}"
    try:
        scene: Any = trimesh.load(path, process=False, force="scene")
        parts = [g for g in scene.geometry.values() if hasattr(g, "faces")]
    except Exception as error:  # any error of a foreign reader is a result of the check
        yield Check(name, check, "failed", f"{type(error).__name__}: {str(error)[:200]}")
        return
    faces = sum(len(part.faces) for part in parts)
    errors = [] if faces else ["no faces"]
    errors += [f"{key} is not finite" for key, g in scene.geometry.items() if not np.isfinite(g.vertices).all()]
    bare = [g for g in parts if getattr(g.visual, "uv", None) is None]
    errors += [f"{len(bare)} meshes without UVs"] if bare else []
    yield row(name, check, errors, f"{len(parts)} meshes, {faces} triangles, UVs on all")


def usd(path: Path, name: str) -> Iterator[Check]:
    """USD's own validators, and whether every texture exists."""
    try:
        from mistyle.io.usd.write import complaints, heard, library

        pxr = library()
    except MistyleError as error:
        yield Check(name, "UsdValidation", "not checked", str(error))
        return
    with heard(pxr) as warnings:
        try:
            stage = pxr.Usd.Stage.Open(str(path))
            errors = [str(error).strip().splitlines()[0] for error in stage.GetCompositionErrors()] + complaints(path)
        except pxr.Tf.ErrorException as error:
            yield Check(name, "UsdValidation", "failed", str(error).strip().splitlines()[-1][:300])
            return
    named = [p.GetAttribute("inputs:file").Get() for p in stage.Traverse() if p.HasAttribute("inputs:file")]
    errors += [f"{asset.path} is not there" for asset in named if asset and not asset.resolvedPath]
    meshes = sum(p.IsA(pxr.UsdGeom.Mesh) for p in stage.Traverse())
    version = ".".join(map(str, pxr.Usd.GetVersion()[1:]))
    warned = [f"USD warns: {text[:300]}" for text in dict.fromkeys(warnings)]
    fine = "; ".join([f"no errors; {meshes} meshes, {len(named)} textures resolved", *warned[:3]])
    yield row(name, f"UsdValidation {version}", errors, fine)


def materialx(path: Path, name: str) -> Iterator[Check]:
    """MaterialX's own validation, a definition for every node, and whether its images exist."""
    try:
        mx: Any = import_module("MaterialX")
    except ImportError:
        yield Check(name, "MaterialX", "not checked", "MaterialX not found (pip install 'mistyle[usd]')")
        return
    check = f"MaterialX {mx.getVersionString()}"
    document, nodes = mx.createDocument(), mx.createDocument()
    try:
        mx.readFromXmlFile(document, str(path))
    except mx.Exception as error:
        yield Check(name, check, "failed", str(error)[:300])
        return
    own = [n for n in document.traverseTree() if n.isA(mx.Node)]
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), nodes)
    document.setDataLibrary(nodes)
    valid, message = document.validate()
    errors = [] if valid else [message.strip()[:200]]
    errors += [f"{n.getNamePath()} has no definition" for n in own if n.getNodeDef() is None]
    files = [n.getInput("file").getValueString() for n in own if n.getCategory() == "image"]
    errors += [f"{file} is not there" for file in files if not (path.parent / file).is_file()]
    surfaces = sum(n.getType() == "surfaceshader" for n in own)
    yield row(name, check, errors, f"valid; {surfaces} surfaces, {len(files)} images there")


def png(paths: Sequence[Path], name: str) -> Iterator[Check]:
    """Every PNG decoded by Pillow."""
    import PIL
    from PIL import Image

    errors = []
    for path in paths:
        try:
            with Image.open(path) as picture:
                picture.load()
        except (OSError, SyntaxError, ValueError) as error:
            errors.append(f"{path.name}: {str(error)[:100]}")
    yield row(name, f"Pillow {PIL.__version__}", errors, f"{len(paths)} PNG decoded")


def exr(paths: Sequence[Path], name: str) -> Iterator[Check]:
    """Every EXR decoded by OpenImageIO, with its colour space."""
    try:
        import OpenImageIO as oiio  # pyright: ignore[reportMissingImports]
    except ImportError:
        yield Check(name, "OpenImageIO", "not checked", "OpenImageIO not found (pip install openimageio)")
        return
    errors, spaces = [], set()
    for path in paths:
        source = oiio.ImageInput.open(str(path))
        if source is None or source.read_image() is None:
            errors.append(f"{path.name}: {oiio.geterror()[:100]}")
        else:
            spaces.add(str(source.spec().getattribute("colorInteropID") or "no colour space"))
    summary = f"{len(paths)} EXR decoded: {', '.join(sorted(spaces))}"
    yield row(name, f"OpenImageIO {oiio.VERSION_STRING}", errors, summary)


def by_blender(paths: Sequence[Path], names: Sequence[str], blender: str | None) -> Iterator[Check]:
    """Every model opened by Blender's importers: it has meshes, and no image is missing."""
    if blender is None:
        reason = f"Blender not found (name it with --blender or {BLENDER})"
        yield from (Check(name, "Blender", "not checked", reason) for name in names)
        return
    from mistyle.render.external.render_files import run_job

    try:
        with TemporaryDirectory(prefix="mistyle-") as folder:
            job = {"files": [str(real_path(p)) for p in paths]}
            done = run_job(blender_command(blender, OPEN_WORKER), Path(folder) / "job.json", job, "blender")
    except MistyleError as error:
        yield from (Check(name, "Blender", "failed", str(error)[-300:]) for name in names)
        return
    for name, result in zip(names, done["found"], strict=True):
        errors = [result["error"]] if "error" in result else []
        errors += [] if errors or result["meshes"] and result["triangles"] else ["no mesh was imported"]
        errors += [f"image {image} is missing" for image in result.get("missing", [])]
        fine = "" if errors else "{meshes} meshes, {triangles} triangles, {materials} materials, {images} images"
        yield row(name, f"Blender {done['blender']}", errors, fine.format(**result))


# File extension -> readers of a model.
READERS: dict[str, tuple[Callable[[Path, str], Iterator[Check]], ...]] = {
    **dict.fromkeys((".glb", ".gltf"), (gltf, by_trimesh)),
    ".obj": (by_trimesh,),
    **dict.fromkeys(USD, (usd,)),
    ".mtlx": (materialx,),
}
