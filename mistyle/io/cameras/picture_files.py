"""Paths of the pictures and masks that camera files name.

Names are literal (a percent sign is a letter); backslashes separate folders; a picture's ending may be omitted or be
another. Only files in the folder of the pictures are opened: the end of a name that leads out of it is looked up there.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.core.paths import real_path
from mistyle.io.cameras.camera_files import ENDINGS, stem
from mistyle.io.sandbox.bounds import inside, refuse

HAND_IN = "If the pictures are in another folder, hand it in with --pictures DIR"
COPY = "Copy the file into that folder and name it relative to the folder"
ADD = "Add it, or take the view out of the camera file"


def picture_folder(pictures: Path) -> Path:
    """The user's folder of pictures; refused where it is not a folder."""
    if not pictures.is_dir():
        raise refuse(pictures, "no folder", "the folder of the pictures (--pictures)", "Check the path")
    return pictures


def images_folder(path: Path, model: Path) -> Path:
    """The folder of a COLMAP model's pictures."""
    places = [p / "images" for p in (path, *real_path(path).parents[:2])]
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        raise refuse(model, "no folder 'images' beside the model", "the pictures' folder", HAND_IN)
    return folder


def find(folder: Path, name: str, file: Path) -> Path | None:
    """The picture that the camera file names, in the folder or below: by its whole name, else by the end of it; None
    where there is none. Files that were made elsewhere name pictures by where they lay there."""
    try:
        whole = inside(folder, name, file, HAND_IN)
    except InputRefused:
        picture = find_by_end(folder, name)
        if picture is None:
            raise
        return picture
    return _existing(whole) or find_by_end(folder, name)


def find_by_end(folder: Path, name: str) -> Path | None:
    """The picture of that name in the folder, its first folders dropped until one exists; else None."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "..")]
    for k in range(len(parts)):
        picture = _existing(folder.joinpath(*parts[k:]))
        if picture is not None:
            return inside(folder, "/".join([*parts[k:-1], picture.name]), folder, COPY)
    return None


def _existing(exact: Path) -> Path | None:
    """The file; or the one with a picture's ending after its name; or the only one with another picture's ending, as
    programs write that remove the background."""
    if exact.is_file():
        return exact
    longer = _with_endings(exact.parent, [exact.name])
    other = _with_endings(exact.parent, [stem(exact.name)])
    return longer[0] if longer else other[0] if len(other) == 1 else None


def as_named(picture: Path, name: str) -> bool:
    """Whether a camera file names this picture so: with its folders, with or without its ending."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part != "."]
    return picture.parts[-len(parts) : -1] == tuple(parts[:-1]) and picture.name in (parts[-1], *_endings_of(parts[-1]))


def _endings_of(name: str) -> list[str]:
    return [f"{name}{e}" for ending in ENDINGS for e in (ending, ending.upper())]


def by_spelling(table: Mapping[str, Any], spelled: Mapping[str, str], where: object) -> dict[str, Any]:
    """The user's `table` of views under the names of the camera file, which `spelled` has by our own names. The user
    may write either, with or without a picture's ending; names of no view stay. Refused: two names of one view."""
    whole = {_plain(name): name for name in spelled.values()}
    short = [stem(name) for name in whole]
    alike = {stem(plain): name for plain, name in whole.items() if short.count(stem(plain)) == 1}
    ways = alike | {ours: name for ours, name in spelled.items()} | whole
    result: dict[str, Any] = {}
    first: dict[str, str] = {}
    for key, value in table.items():
        plain = _plain(key)
        name = ways.get(plain) or ways.get(stem(plain)) or key
        if first.setdefault(name, key) != key:
            found = f"{first[name]!r} and {key!r} for the view {name!r}"
            raise refuse(Path(str(where)), found, "one entry for each view", "Leave one of them out")
        result[name] = value
    return result


def _plain(name: str) -> str:
    return str(PurePosixPath(name.replace("\\", "/")))


def named_mask(places: Sequence[Path], name: str, file: Path) -> Path:
    """The mask that a frame names, in the first of these folders that has it."""
    fix = "Hand in the masks with --masks DIR"
    masks = [mask for place in places if (mask := _existing(inside(place, name, file, fix))) is not None]
    if not masks:
        raise refuse(file, f"no mask {name!r}", "the mask that its frame names", fix)
    return masks[0]


def check_different(pictures: Mapping[str, Path], folder: Path) -> None:
    """Refuse one picture for two views: names without their folders may coincide."""
    first: dict[Path, str] = {}
    for view, picture in pictures.items():
        first_view = first.setdefault(real_path(picture), view)
        if first_view != view:
            found = f"{picture.name} alone for the views '{first_view}' and '{view}'"
            raise refuse(folder, found, "a picture for every view", "Keep the folders that the camera file names")


def _with_endings(folder: Path, names: Iterable[str]) -> list[Path]:
    return [file for name in dict.fromkeys(names) for each in _endings_of(name) if (file := folder / each).is_file()]


def mask_of_view(folder: Path, view: str, picture: Path) -> Path:
    """The mask with the name of the view or of its picture, in the user's folder of masks."""
    names = [view, picture.name, stem(picture.name)]
    masks = _with_endings(folder, names) or _with_endings(folder / picture.parent.name, names)
    if not masks:
        problem = f"no mask for the view '{view}'"
        raise refuse(folder, problem, f"{view}.png or {picture.name}.png", "Add it; white where the picture counts")
    return masks[0]
