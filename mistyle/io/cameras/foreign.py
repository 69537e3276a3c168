"""Cameras of programs that are not read, recognised so that a refusal names them and the way to cameras that are."""

from pathlib import Path

from mistyle.io.sandbox.bounds import read_bytes

WRITE = "Reconstruct with COLMAP, or write the cameras as a transforms.json"
# By the file's ending: its kind, and the fix.
ENDINGS = {
    ".nvm": ("VisualSFM's cameras", WRITE),
    ".out": ("Bundler's cameras", WRITE),
    ".mvs": ("a scene of OpenMVS", "Hand in the COLMAP model that it was made from"),
}
# By a word near the beginning of a JSON file.
WORDS = {
    b'"sfm_data_version"': ("OpenMVG's cameras", "Convert them (`openMVG_main_openMVG2Colmap`)"),
    b'"shots"': ("OpenSfM's reconstruction", "Convert it (`opensfm export_colmap`)"),
    b"PinholeCameraTrajectory": ("a trajectory of Open3D", WRITE),
    b'"img_name"': ("cameras of Gaussian splatting", "Hand in the COLMAP model that they were trained from"),
}
HEAD = 4096  # bytes of a JSON file that are searched


def foreign_kind(path: Path) -> tuple[str, str] | None:
    """What the file is, and how to get cameras that are read; None for a file that is not recognised."""
    if path.suffix.lower() != ".json":
        return ENDINGS.get(path.suffix.lower())
    head = read_bytes(path, count=HEAD)
    known = b'"frames"' in head  # a transforms.json may hold any other word
    return None if known else next((kind for word, kind in WORDS.items() if word in head), None)


def foreign_files(folder: Path) -> list[Path]:
    """The files of a folder that are recognised, by name."""
    kinds = (".json", *ENDINGS)
    files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in kinds and file.is_file()]
    return [file for file in files if foreign_kind(file) is not None]
