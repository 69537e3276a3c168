"""Where the pictures and masks of cameras lie: names of camera files, as files on disk.

A name is taken letter by letter (a percent sign is a letter); backslashes separate folders; a picture's ending may be
left out. Nothing outside the folder of the pictures is opened: a name that leads out of it is refused, unless the user
hands in the folder that holds the picture.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

from mistyle.io.cameras.camera_files import ENDINGS, stem
from mistyle.io.sandbox.bounds import inside, refuse

HAND_IN = "If the pictures are in another folder, hand it in with --pictures DIR"
COPY = "Copy the file into that folder and name it relative to the folder"
ADD = "Add it, or take the view out of the camera file"


def picture_folder(pictures: Path) -> Path:
    """The folder that was handed in for the pictures, if it is one."""
    if not pictures.is_dir():
        raise refuse(pictures, "no folder", "the folder of the pictures (--pictures)", "Check the path")
    return pictures


def images_folder(path: Path, model: Path) -> Path:
    """The folder of a COLMAP model's pictures."""
    places = [p / "images" for p in (path, *path.resolve().parents[:2])]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        raise refuse(model, "no folder 'images' beside the model", "the pictures' folder", HAND_IN)
    return found


def find(folder: Path, name: str, file: Path) -> Path:
    """The picture that the camera file names, with or without its ending; in the folder or below."""
    there = _there(inside(folder, name, file, HAND_IN))
    if there is None:
        raise refuse(folder, f"no picture {name!r}", "one for every camera", f"{ADD}. {HAND_IN}")
    return there


def find_elsewhere(folder: Path, name: str) -> Path:
    """The picture of that name in a folder that was handed in: as it is named, else without its first folders."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "..")]
    for k in range(len(parts)):
        there = _there(folder.joinpath(*parts[k:]))
        if there is not None:
            return inside(folder, "/".join([*parts[k:-1], there.name]), folder, COPY)
    raise refuse(folder, f"no picture {name!r}", "one for every camera", ADD)


def _there(exact: Path) -> Path | None:
    """The file, or the one with a picture's ending after its name."""
    return exact if exact.is_file() else next(iter(_with_endings(exact.parent, [exact.name])), None)


def named_mask(places: Sequence[Path], name: str, file: Path) -> Path:
    """The mask that a frame names, in the first of these folders that has it."""
    fix = "Hand in the masks with --masks DIR"
    there = [found for place in places if (found := _there(inside(place, name, file, fix))) is not None]
    if not there:
        raise refuse(file, f"no mask {name!r}", "the mask that its frame names", fix)
    return there[0]


def check_different(pictures: Mapping[str, Path], folder: Path) -> None:
    """Refuse one picture for two views: names that lost their folders may have become one."""
    first: dict[Path, str] = {}
    for view, picture in pictures.items():
        other = first.setdefault(picture.resolve(), view)
        if other != view:
            found = f"{picture.name} alone for the views '{other}' and '{view}'"
            raise refuse(folder, found, "a picture for every view", "Keep the folders that the camera file names")


def _with_endings(folder: Path, names: Iterable[str]) -> list[Path]:
    endings = [e for ending in ENDINGS for e in (ending, ending.upper())]
    return [file for name in dict.fromkeys(names) for e in endings if (file := folder / f"{name}{e}").is_file()]


def mask_of_view(folder: Path, view: str, picture: Path) -> Path:
    """The mask in the user's folder of masks that has the name of the view or of its picture."""
    names = [view, picture.name, stem(picture.name)]
    there = _with_endings(folder, names) or _with_endings(folder / picture.parent.name, names)
    if not there:
        found = f"no mask for the view '{view}'"
        raise refuse(folder, found, f"{view}.png or {picture.name}.png", "Add it; white where the picture counts")
    return there[0]
