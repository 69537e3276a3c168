"""Mitsuba scene files: loading one for a fit, and writing the fitted one with float textures.

Mitsuba's own parser reads the file, with includes, defaults and paths. The written file is the user's own text with the
fitted elements replaced: comments, ids and structure stay.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mistyle.core.errors import InputRefused
from mistyle.core.names import WRITTEN, distinct, safe_name
from mistyle.core.paths import real_path
from mistyle.io import scene_source
from mistyle.process import stopping
from mistyle.render.live import text as scene_text
from mistyle.render.live.parameters import Parameter
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba.device import mi


@dataclass(frozen=True)
class SceneFile:
    """A loaded scene file.

    scene    the live `mi.Scene`, its textures stored as 32-bit floats
    state    the parsed file, from Mitsuba's parser
    path     the file
    defines  the parameters of the load
    notes    sentences about changes while loading
    """

    scene: Any
    state: Any
    path: Path
    defines: dict[str, str]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class WrittenScene:
    """Files of `write_scene`: the scene file (None if no element could be replaced), and every texture by key."""

    xml: Path | None
    textures: dict[str, Path]
    notes: tuple[str, ...]


def load_scene_for_fit(path: Path | str, defines: Mapping[str, Any] | None = None) -> SceneFile:
    """Load a scene file as `mi.load_file(path, **defines)` does, ready for a fit.

    Three things differ. Bitmaps of 8 and 16 bits without a `format` are stored as 32-bit floats, because 8 bits have no
    gradient; the picture stays the same to 2e-7 (8 bits) or half a unit of the 16-bit float that Mitsuba would use.
    Equal materials and meshes are not merged, so ids stay. Elements without an id get one ("sphere1"), and top-level
    textures are named by their users, because Mitsuba names both by an address. The file is trusted: Mitsuba opens all
    files that it names. Raises InputRefused with Mitsuba's message if it cannot be loaded.
    """
    file = Path(path)
    if not file.is_file():
        raise InputRefused(f"{file}: no such scene file.")
    parameters = {name: str(value) for name, value in (defines or {}).items()}
    config = mi.parser.ParserConfig(device.use())
    config.merge_equivalent = config.merge_meshes = False
    try:
        with _relative_to(file), device.file_threads():
            state, converted = _parsed(config, file, parameters)
            # Loading empties the parsed state, and `write_scene` needs it.
            instances = mi.parser.instantiate(config, _parsed(config, file, parameters)[0])
    except RuntimeError as error:
        stopping.check()
        unset = re.search(r"undefined parameter: \$(\w+)", str(error))
        fix = f" Give it a value: -D {unset[1]}=VALUE." if unset else ""
        raise InputRefused(f"{file}: Mitsuba cannot load this scene. {error}{fix}") from error
    scene: Any = instances[0] if isinstance(instances, list) else instances
    if not isinstance(scene, mi.Scene):
        raise InputRefused(f"{file}: holds a {type(scene).__name__}, not a scene.")
    notes = []
    if converted:
        shown = ", ".join(sorted(set(converted))[:5]) + (", …" if len(set(converted)) > 5 else "")
        notes.append(f"{len(converted)} bitmaps were loaded as 32-bit floats, which have gradients ({shown}).")
    return SceneFile(scene, state, file, parameters, tuple(notes))


def _parsed(config: Any, file: Path, defines: dict[str, str]) -> tuple[Any, list[str]]:
    """The parsed and prepared file, and the converted bitmaps."""
    state = mi.parser.parse_file(config, str(file), **defines)
    mi.parser.transform_all(config, state)
    converted = _as_floats(state)
    _assign_ids(state)
    return state, converted


@contextmanager
def _relative_to(file: Path) -> Iterator[None]:
    """Resolve relative paths beside the file, as `mi.load_file` does."""
    resolver = mi.file_resolver()
    inner = mi.FileResolver(resolver)
    inner.prepend(str(real_path(file.parent)))
    mi.set_file_resolver(inner)
    try:
        yield
    finally:
        mi.set_file_resolver(resolver)


def _as_floats(state: Any) -> list[str]:
    """Set 32-bit floats for bitmaps without a format; returns the files."""
    changed = []
    for node in state.nodes:
        if node.props.plugin_name() == "bitmap" and "format" not in node.props and "filename" in node.props:
            node.props["format"] = "variant"
            changed.append(Path(str(node.props["filename"])).name)
    return changed


def _assign_ids(state: Any) -> None:
    """Give the scene's children ids, and remove textures that are reachable through their users."""
    root = state.nodes[0]
    used = {index for node in state.nodes[1:] for _, index in scene_text.children(node)}
    taken = {node.props.id() for node in state.nodes}
    for name, index in scene_text.children(root):
        props = state.nodes[index].props
        if state.nodes[index].type == mi.ObjectType.Texture and index in used:
            del root.props[name]
        elif not props.id():
            number = next(k for k in range(1, len(state.nodes) + 2) if f"{props.plugin_name()}{k}" not in taken)
            taken.add(f"{props.plugin_name()}{number}")
            props.set_id(f"{props.plugin_name()}{number}")


def write_scene(
    path: Path | str,
    scene: SceneFile | Any,
    fitted: Any,
    write_exr: Callable[..., None],
    write_file: Callable[[Path, bytes], Any] = Path.write_bytes,
) -> WrittenScene:
    """Write the fitted values (a `FittedScene`) as float EXR textures, and the scene file that uses them at `path`.

    The scene file is a copy of the loaded one. The fitted bitmaps' file names and the fitted literals' values are
    replaced, also in copies of included files. `<default>`s hold the values of the load, and a `<path>` leads to the
    folder of the original with its meshes and other files. A mesh with fitted attributes is written as PLY. The file
    needs no mistyle. It is loaded and its values are compared with the fitted ones; a parameter whose values differ
    is left out, and a note gives the reason. From a live `mi.Scene` only textures are written. `write_exr` is that of
    `io/images/write.py`, `write_file` may be `atomic_write` of `io/store/atomic.py`.
    """
    out = Path(path)
    out.parent.mkdir(parents=True, exist_ok=True)
    textures: dict[str, Path] = {}
    room = max(WRITTEN - len(f"{out.stem}_.exr".encode()), 16)
    stems = distinct([safe_name(p.name.removesuffix(".data"), room) for p in fitted.parameters], limit=room)
    live = scene.scene if isinstance(scene, SceneFile) else scene
    for p, stem in zip(fitted.parameters, stems, strict=True):
        textures |= _write_value(out, stem, p, fitted.values[p.key], write_exr, live)
    if not isinstance(scene, SceneFile):
        return WrittenScene(None, textures, ("The scene does not come from a file: only its textures were written.",))
    sources = [Path(str(file)).read_bytes() for file in scene.state.files]
    table, files = mi.traverse(live), dict[Path, bytes]()
    found = {p: scene_text.edits_of(scene.state, sources, p, table, textures.get(p.key)) for p in fitted.parameters}
    notes = {p: edits for p, edits in found.items() if isinstance(edits, str)}
    included: list[str] = []

    def attempt(chosen: Sequence[Parameter]) -> str:
        """Write the scene file with the values of these parameters, if any; the first difference when it is loaded."""
        for file in files:
            file.unlink(missing_ok=True)
        files.clear()
        edits: dict[int, list[scene_source.Edit]] = {0: []}
        for p in chosen:
            edits.setdefault(found[p][0], []).extend(found[p][1])  # pyright: ignore[reportArgumentType]
        included[:] = _rewrite_includes(scene, sources, edits, out, files.__setitem__)
        edits[0] += scene_source.surroundings(sources[0], scene.path, scene.defines, out)
        files[out] = scene_source.spliced(sources[0], edits[0])
        for file, text in files.items() if chosen else ():
            write_file(file, text)
        return _differences(out, fitted, chosen) if chosen else ""

    kept, wrong = _accepted(attempt, [p for p in fitted.parameters if p not in notes])
    notes |= wrong
    said = [f"{p.name} is not in {out.name}: {why} run.json and the report have its value." for p, why in notes.items()]
    if not kept:
        return WrittenScene(None, textures, tuple(said))
    if real_path(out.parent) != real_path(scene.path.parent):
        included.append(f"{out.name} reads its other files from {scene.path.parent}.")
    return WrittenScene(out, textures, (*said, *included))


def _accepted(
    attempt: Callable[[Sequence[Parameter]], str], chosen: Sequence[Parameter]
) -> tuple[Sequence[Parameter], dict[Parameter, str]]:
    """The parameters whose values a scene file holds, all together or else those that it holds alone, and the
    reasons against the others. The last attempt is that of the accepted ones."""
    wrong: dict[Parameter, str] = {}
    while why := attempt(chosen):
        alone = {p: attempt([p]) for p in chosen} if len(chosen) > 1 and not wrong else dict.fromkeys(chosen, why)
        bad = {p: reason for p, reason in alone.items() if reason} or dict.fromkeys(chosen, why)
        wrong, chosen = wrong | bad, [p for p in chosen if p not in bad]
    return chosen, wrong


def _rewrite_includes(
    scene: SceneFile,
    sources: Sequence[bytes],
    edits: dict[int, list[scene_source.Edit]],
    out: Path,
    write_file: Callable[[Path, bytes], Any],
) -> list[str]:
    """Write included files with fitted values beside the scene, innermost first, and include those instead."""
    notes = []
    for k in range(len(sources) - 1, 0, -1):
        if not edits.get(k):
            continue
        included = Path(str(scene.state.files[k]))
        new = out.with_name(f"{out.stem}_{k}_{included.name}")
        for parent in range(len(sources)):
            change = scene_source.include_edit(sources[parent], included, scene.defines, new.name)
            if change and parent != k:
                edits.setdefault(parent, []).extend(change)
                write_file(new, scene_source.spliced(sources[k], edits[k]))
                notes.append(f"{out.name} includes {new.name}, a copy of {included.name} with the fitted values.")
                break
    return notes


def _write_value(
    out: Path, stem: str, p: Parameter, values: np.ndarray, write_exr: Callable[..., None], scene: Any
) -> dict[str, Path]:
    """Write an image as EXR, or a mesh's attribute as PLY in world space; numbers and colours need no file."""
    if p.kind == "texture" and values.ndim == 3 and values.shape[2] <= 4:
        file = out.with_name(f"{out.stem}_{stem}.exr")
        # Mitsuba repeats a column of an environment map at either end.
        shown = np.ascontiguousarray(values[:, 1:-1, :3]) if p.owner == "EnvironmentMapEmitter" else values
        names = "Y" if shown.shape[2] == 1 else "RGBA"[: shown.shape[2]]
        data = {"colorInteropID": "data"} if p.owner == "NormalMap" or shown.shape[2] == 1 else None
        write_exr(file, {name: shown[..., k] for k, name in enumerate(names)}, attributes=data)
        return {p.key: file}
    if p.kind == "value":
        return {}
    if p.kind == "attribute":
        file = out.with_name(f"{out.stem}_{stem}.ply")
        node = mi.traverse(scene).properties[p.key][2]
        with device.file_threads():
            node.write_ply(str(file))
        return {p.key: file}
    file = out.with_name(f"{out.stem}_{stem}.npy")
    np.save(file, values)
    return {p.key: file}


def _differences(out: Path, fitted: Any, chosen: Sequence[Parameter]) -> str:
    """Load the written file; the first difference, or an empty string."""
    try:
        loaded = load_scene_for_fit(out)
    except InputRefused as error:
        return f"Mitsuba does not load the file with it ({' '.join(str(error).split())})."
    table = mi.traverse(loaded.scene)
    for p in chosen:
        if p.key not in table:
            return f"the file with it has no {p.key}."
        value, expected = np.array(table[p.key], dtype=np.float32).ravel(), fitted.values[p.key].ravel()
        # A light's single number comes back as a grey colour.
        if len(expected) not in (1, len(value)) or not np.allclose(value, expected, rtol=1e-6, atol=1e-7):
            return "the file with it holds another value."
    return ""
