"""The points of a reconstruction, to which `--align` registers a mesh."""

from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from mistyle.core.paths import real_path
from mistyle.io.cameras.camera_files import applied_transform
from mistyle.io.cameras.captures import source_of
from mistyle.io.cameras.sfm import read_landmarks
from mistyle.io.read import read_json, read_points


def sparse_points(path: Path) -> Float[np.ndarray, "n 3"] | None:
    """The points of a COLMAP model, of an SfMData, or of the PLY that a transforms.json names as nerfstudio does, in
    the cameras' space; None where the references have none."""
    kind, file = source_of(Path(path))
    readers = {"colmap": read_points, "sfm": read_landmarks, "transforms": _named_points}
    points = readers[kind](file) if kind in readers else None
    return points if points is not None and len(points) else None


def _named_points(file: Path) -> Float[np.ndarray, "n 3"] | None:
    """The points of `ply_file_path`, which lie in the space after `applied_transform`; None where no such file lies
    in the folder, under its path there or its name alone."""
    tree, folder = read_json(file), file.parent
    name = str(tree.get("ply_file_path") or "").replace("\\", "/")
    places = [folder / name.lstrip("/"), folder / PurePosixPath(name).name]
    near = [place for place in places if place.is_file() and real_path(place).is_relative_to(real_path(folder))]
    if not near:
        return None
    original = np.linalg.inv(applied_transform(tree, file))
    return read_points(near[0]) @ original[:3, :3].T + original[:3, 3]
