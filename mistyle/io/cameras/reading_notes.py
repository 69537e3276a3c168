"""Notes on how the references of a fit were read: what was guessed, ignored or left out."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from mistyle.core.asset import RAW
from mistyle.core.paths import real_path
from mistyle.io.cameras.captures import BELOW, WHOLE, CapturedPicture, home_of, least_alpha, source_of, tables_in
from mistyle.io.cameras.colmap import find_model, models_below
from mistyle.io.cameras.picture_files import as_named
from mistyle.io.cameras.realityscan_files import OPTIONAL, POSE, columns_of
from mistyle.io.read import read_json


def reading_notes(path: Path, shots: Sequence[CapturedPicture]) -> tuple[str, ...]:
    """Sentences about the interpretation of the pictures and cameras of `read_shots`."""
    notes = []
    tagged = [sum(shot.orientation[k] > 1 for shot in shots) for k in (0, 1)]
    if any(tagged):
        done = (
            "It was ignored: only camera.json describes upright pictures, all others the pixels as they are stored."
            if shots[0].pixels == "stored"
            else "They were turned upright: camera.json describes upright pictures."
        )
        notes.append(
            f"Files with an EXIF orientation: {tagged[0]} pictures, {tagged[1]} masks (of {len(shots)} views). {done}"
        )
    raw = sum(shot.picture.suffix.lower() in RAW for shot in shots)
    if raw:
        notes.append(f"{raw} RAW pictures were developed linearly, with the white balance of daylight.")
    unused = home_of(Path(path)) / "masks"
    if unused.is_dir() and not any(shot.mask for shot in shots):
        notes.append(f"The folder {unused} was not used; --masks {unused} hands it in.")
    kind, file = source_of(Path(path))
    if kind != "camera.json":
        notes += [*_other_names(shots), *_left_out(shots), *_other_cameras(kind, file, Path(path))]
    if kind == "realityscan" and file.is_file():
        notes += _other_columns(file)
    if kind == "transforms":
        frames = len(read_json(file)["frames"])
        if frames > len(shots):
            notes.append(f"{frames - len(shots)} of {frames} views of {file.name} have no picture and were left out.")
        applied = [key for key in ("applied_transform", "applied_scale") if read_json(file).get(key) is not None]
        if applied:
            notes.append(
                f"{' and '.join(applied)} of {file.name} were inverted: the cameras are in the space of the "
                "reconstruction. A mesh in nerfstudio's own space needs --align."
            )
    return tuple(notes)


def _other_names(shots: Sequence[CapturedPicture]) -> list[str]:
    """A sentence about pictures whose path or ending is not the camera file's."""
    other = [shot for shot in shots if shot.named and not as_named(shot.picture, shot.named)]
    if not other:
        return []
    example = f"{other[0].picture.name} for {other[0].named}"
    return [f"{len(other)} of {len(shots)} pictures were found by the end of their names ({example})."]


def _left_out(shots: Sequence[CapturedPicture]) -> list[str]:
    """A sentence for each folder with pictures that no camera names: a reconstruction leaves some out."""
    used = {real_path(path) for shot in shots for path in (shot.picture, shot.mask) if path is not None}
    kinds = defaultdict(set)
    for path in used:
        kinds[path.parent].add(path.suffix.lower())
    result = []
    for folder, endings in kinds.items():
        rest = sorted(
            f.name for f in folder.iterdir() if f.suffix.lower() in endings and f.is_file() and real_path(f) not in used
        )
        if rest:
            result.append(f"{len(rest)} pictures in {folder} have no camera and were left out, such as {rest[0]}.")
    return result


def _other_columns(file: Path) -> list[str]:
    """Sentences about the columns of RealityScan's table that were not read, and those of the lens that it lacks."""
    columns = columns_of(file)
    other = [name for name in columns if name not in (*POSE, *OPTIONAL)]
    lacking = [name for name in OPTIONAL if name not in columns]
    result = [f"Columns of {file.name} that were not read: {', '.join(other)[:200]}."] if other else []
    return result + ([f"{file.name} has no columns {', '.join(lacking)}: they count as 0."] if lacking else [])


def _other_cameras(kind: str, file: Path, path: Path) -> list[str]:
    """Sentences about cameras beside those of `file` that were not read."""
    result = []
    if kind == "colmap" and path != file:
        sizes = models_below(file.parent)
        if len(sizes) > 1:
            listed = ", ".join(f"{folder.name} ({count} pictures)" for folder, count in sizes)
            result.append(f"{file.parent} holds {len(sizes)} models: {listed}. The largest, {file.name}, was read.")
    if kind in ("metashape", "realityscan") and path != file and file.is_file():
        others = [other.name for other in tables_in(file.parent) if other != file]
        result += [f"{file.name} was read, and not {' nor '.join(others)}."] if others else []
    if kind == "transforms":
        others = [f.name for f in sorted(file.parent.glob("transforms_*.json")) if f != file]
        model = find_model(file.parent)
        others += [] if model is None else [f"the COLMAP model {model}"]
        if others:
            result.append(f"{file.name} was read, and not {' nor '.join(others)}.")
    return result


def matte_note(inner: Sequence[float]) -> tuple[str, ...]:
    """A sentence about the mattes among the alphas with these medians; none without any."""
    mattes = [value for value in inner if least_alpha(value) < WHOLE]
    if not mattes:
        return ()
    return (
        f"The alpha of {len(mattes)} pictures stays below 1 inside the object (medians {min(mattes):.3f} to "
        f"{max(mattes):.3f}), as mattes of background removers do: pixels count down to {BELOW:g} below the median.",
    )
