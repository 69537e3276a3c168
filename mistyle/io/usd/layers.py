"""Dependencies of a USD file, checked before composition: every layer and package in the folders that it may name."""

import posixpath
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path
from mistyle.io.sandbox.asset_folders import MeshFolders, mesh_folders, remedy
from mistyle.io.sandbox.bounds import MAX_FILE_BYTES, USD, refuse

MAX_LAYERS = 2_000
MAX_ENTRIES = 20_000
MATERIALX = ".mtlx"
HERE, FLATTEN = "Copy it into the mesh's folder", "flatten the stage (usdcat --flatten)"
COPY = f"{HERE}, or {FLATTEN}"


@dataclass(frozen=True)
class PackagedFile:
    """A file, or a file inside a package (`inner`, its path there)."""

    file: Path
    inner: str = ""

    def __str__(self) -> str:
        return f"{self.file}[{self.inner}]" if self.inner else str(self.file)


@dataclass(frozen=True)
class CheckedLayers:
    """The files of a stage's layers and packages, the folders that they may name, and the references to MaterialX
    documents: (layer, name in it, document). `notes` tell which documents may not be opened."""

    files: list[Path]
    folders: MeshFolders
    documents: list[tuple[PackagedFile, str, PackagedFile | None]]
    notes: list[str]


def place_of(layer: Any) -> PackagedFile:
    """The file, or the file in a package, of an opened layer."""
    outer, bracket, inner = str(layer.identifier).partition("[")
    return _inside(PackagedFile(real_path(Path(outer)), inner.removesuffix("]") if bracket else ""))


def _inside(place: PackagedFile) -> PackagedFile:
    """A package's root layer: the first file in it."""
    if place.inner or place.file.suffix.lower() != ".usdz":
        return place
    with zipfile.ZipFile(place.file) as package:
        return PackagedFile(place.file, package.namelist()[0])


def locate(folders: MeshFolders, anchor: PackagedFile, reference: str) -> PackagedFile:
    """The file that a layer at `anchor` names. Raises InputRefused where it is outside `folders` or not a plain file
    name."""
    problem = f"a reference to {reference[:120]!r}"
    name = reference.replace("\\", "/")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name) or name.startswith(("//", "`")) or not name or "\0" in name:
        raise refuse(anchor.file, problem, "a relative file name (nothing is fetched)", COPY)
    outer, bracket, inner = name.partition("[")
    inner = inner.removesuffix("]")
    if anchor.inner:
        whole = posixpath.normpath(posixpath.join(posixpath.dirname(anchor.inner), outer))
        if whole.startswith(("/", "..")) or bracket:
            raise refuse(anchor.file, problem, "a file inside the package", "Package the asset again")
        return PackagedFile(anchor.file, whole)
    try:
        target = real_path(anchor.file.parent / outer)
    except OSError as error:  # a loop of links
        raise refuse(anchor.file, problem, "a file name", COPY) from error
    if not folders.hold(target):
        raise refuse(anchor.file, problem, folders.expected, remedy(folders.mesh, target, HERE, [FLATTEN]))
    return PackagedFile(target, inner if bracket else "")


def usd_folders(path: Path) -> MeshFolders:
    """The folders that a stage may name: USD resolves a link to a file before it reads names from it."""
    return mesh_folders(real_path(path))


def check_layers(pxr: Any, path: Path) -> CheckedLayers:
    """Open the file and all layers that it is composed of, one by one, each only after its name and size passed.

    Refused: names that lead out of the folders or to a network, layers of other formats, and compressed or nested
    packages. Also refused: value clips (USD would open them later), and too many or too large files. MaterialX
    documents are located and not opened.
    """
    start = PackagedFile(real_path(path))
    pending, seen = [start], {str(start)}
    files: dict[Path, int] = {}
    checked = CheckedLayers([], usd_folders(path), [], [])
    while pending:
        layer = pending.pop()
        if layer.file not in files:
            files[layer.file] = _size(layer, path)
        if len(seen) > MAX_LAYERS or sum(files.values()) > MAX_FILE_BYTES:
            total = f"{len(seen)} layers of {sum(files.values()) / 2**20:.0f} MiB"
            raise refuse(path, total, f"at most {MAX_LAYERS} and {MAX_FILE_BYTES >> 20} MiB", "Flatten the stage")
        for reference in _named(pxr, layer, path):
            if reference.lower().rstrip("]").endswith(MATERIALX):
                checked.documents.append((layer, reference, _document(checked, _inside(layer), reference)))
                continue
            dependency = locate(checked.folders, _inside(layer), reference)
            if Path(dependency.inner or dependency.file).suffix.lower() not in USD:
                raise refuse(path, f"a layer {reference[:120]!r}", f"layers of kind {' '.join(USD)}", COPY)
            if dependency.inner and dependency.inner.lower().endswith(".usdz"):
                raise refuse(path, f"a package in a package ({reference[:120]!r})", "one package", "Package it again")
            if str(dependency) not in seen:
                seen.add(str(dependency))
                pending.append(dependency)
    checked.files.extend(files)
    return checked


def _document(checked: CheckedLayers, layer: PackagedFile, reference: str) -> PackagedFile | None:
    """The MaterialX document that a layer names; None, with a note, where it may not be opened."""
    try:
        return locate(checked.folders, layer, reference)
    except InputRefused as error:
        checked.notes.append(f"MaterialX document {reference} was left out with its materials: {error}")
        return None


def _named(pxr: Any, place: PackagedFile, path: Path) -> Iterator[str]:
    """The layers that the layer at `place` names, in every variant."""
    try:
        layer = pxr.Sdf.Layer.FindOrOpen(str(place))
    except pxr.Tf.ErrorException as error:
        raise refuse(
            path, f"a layer that USD cannot read ({usd_message(error)})", "a USD file", "Export it again"
        ) from None
    if layer is None:
        raise refuse(path, f"no USD layer at {str(place)[-120:]}", "a USD file", "Export it again")
    clips: list[Any] = []
    layer.Traverse("/", lambda p: clips.append(p) if _has_clips(layer, p) else None)
    if clips:
        raise refuse(path, f"value clips at {clips[0]}", "values in the layers themselves", "Export a single frame")
    names = layer.GetCompositionAssetDependencies()
    yield from (name for name in names if name and not pxr.Sdf.Layer.IsAnonymousLayerIdentifier(name))


def _has_clips(layer: Any, path: Any) -> bool:
    prim = layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None
    return prim is not None and (prim.HasInfo("clips") or prim.HasInfo("clipSets"))


def _size(place: PackagedFile, path: Path) -> int:
    if not place.file.is_file():
        raise refuse(path, f"no file at {place.file}, which it depends on", "all its layers", "Copy the whole asset")
    size = place.file.stat().st_size
    if size > MAX_FILE_BYTES:
        raise refuse(path, f"{size >> 20} MiB", f"at most {MAX_FILE_BYTES >> 20} MiB", "Reduce the file")
    if place.file.suffix.lower() == ".usdz":
        _check_package(place.file, size)
    return size


def _check_package(path: Path, size: int) -> None:
    """A USDZ package by its specification: a ZIP of uncompressed files, all inside it."""
    again = "Package it again (usdzip)"
    try:
        with zipfile.ZipFile(path) as package:
            entries = package.infolist()
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError, RuntimeError) as error:
        raise refuse(path, f"no package that can be opened ({str(error)[:100]})", "a .usdz file", again) from error
    if not 0 < len(entries) <= MAX_ENTRIES:
        raise refuse(path, f"{len(entries)} files in the package", f"1 to {MAX_ENTRIES}", again)
    for entry in entries:
        name = entry.filename
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size or entry.flag_bits & 1:
            raise refuse(path, f"a compressed or encrypted file ({name[:80]!r})", "files stored as they are", again)
        if name.startswith(("/", "\\")) or ".." in re.split(r"[/\\]", name) or ":" in name:
            raise refuse(path, f"a file named {name[:80]!r}", "names inside the package", again)
        if name.lower().endswith(".usdz"):
            raise refuse(path, f"a package in a package ({name[:80]!r})", "one package", again)
    if sum(entry.file_size for entry in entries) > size:
        raise refuse(path, "files that lie on top of each other in the package", "each in its own place", again)


def textures_named(pxr: Any, checked: CheckedLayers) -> list[Path]:
    """The other files in its folders that layers name, with UDIM tiles expanded: mostly textures."""
    result: set[Path] = set()
    for file in checked.files:
        if file.suffix.lower() == ".usdz":
            continue
        for name in {n for kind in pxr.UsdUtils.ExtractExternalReferences(str(file)) for n in kind}:
            try:
                result.update(tiles_of(locate(checked.folders, PackagedFile(file), name).file))
            except InputRefused:
                continue
    return sorted(result - set(checked.files))


def tiles_of(target: Path) -> list[Path]:
    """A texture's existing files: one, or the tiles of a name with <UDIM>."""
    tiles = target.parent.glob(target.name.replace("<UDIM>", "1???")) if "<UDIM>" in target.name else [target]
    return [tile for tile in tiles if tile.is_file()]


def usd_message(error: Exception) -> str:
    """USD's error message, without its source location."""
    messages = re.findall(r": '(.*?)'?\s*$", str(error), flags=re.MULTILINE)
    return (messages[0] if messages else str(error).strip().splitlines()[-1])[:160]


def bytes_of(place: PackagedFile, limit: int) -> bytes | None:
    """The content of a texture; None where it is missing."""
    from mistyle.io.sandbox.bounds import read_bytes

    if not place.inner:
        return read_bytes(place.file, limit) if place.file.is_file() else None
    with zipfile.ZipFile(place.file) as package:
        if place.inner not in package.namelist():
            return None
        if package.getinfo(place.inner).file_size > limit:
            raise refuse(place.file, f"a large {place.inner}", f"at most {limit >> 20} MiB", "Scale it down")
        return package.read(place.inner)
