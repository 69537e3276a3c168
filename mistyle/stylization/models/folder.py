"""Model folders: search, completeness and hashes, without loading weights or importing torch.

Only safetensors are accepted: a pickle can run code when it is opened.
"""

import functools
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mistyle.core.errors import EnvironmentMissing, InputRefused, MistyleError, UsageError
from mistyle.io.store.atomic import sha256_file
from mistyle.process.weights import header as weights_header
from mistyle.stylization.models.catalogue import MODELS, PublishedModel

LOCK = "mistyle-models.json"
WEIGHTS = ("diffusion_pytorch_model", "model")
PACKAGES = ("diffusers", "transformers", "peft", "accelerate", "safetensors", "huggingface_hub")
PIECES, PIECE = 64, 65536


def need_extra() -> None:
    """EnvironmentMissing, with the install command, where optional packages are missing."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise EnvironmentMissing(
            f"this needs the optional packages {', '.join(missing)}, which are not installed; "
            "run: pip install 'mistyle[diffusion]'"
        )


def get(name: str) -> PublishedModel:
    """The model of this name."""
    if name not in MODELS:
        raise UsageError(f"there is no model '{name}'; choose one of {', '.join(MODELS)}")
    return MODELS[name]


def cache() -> Path:
    """The Hugging Face cache, as huggingface_hub places it."""
    home = os.environ.get("HF_HOME") or os.path.join(os.environ.get("XDG_CACHE_HOME", "~/.cache"), "huggingface")
    return Path(os.environ.get("HF_HUB_CACHE") or os.path.join(home, "hub")).expanduser()


def places(model: PublishedModel, folder: Path | None) -> list[Path]:
    """Search path of a model: the models' folder, then the cache (the pinned revision, then `main`)."""
    candidates = [folder / model.name] if folder else []
    if model.url:
        return candidates
    cached = cache() / f"models--{model.repo.replace('/', '--')}"
    main = cached / "refs" / "main"
    revisions = [model.revision, *([main.read_text().strip()] if main.is_file() else [])]
    return candidates + [cached / "snapshots" / revision for revision in revisions]


def find(name: str, folder: Path | None, loose: Iterable[str] = (), weightless: Iterable[str] = ()) -> Path:
    """The folder of a complete model; EnvironmentMissing names the searched folders and the way to get it.

    `loose` are the single files that are needed; `weightless` the folders that need only a configuration, since their
    weights come from another file.
    """
    model = get(name)
    looked = places(model, folder)
    for place in looked:
        if not place.is_dir():
            continue
        missing = lacking(model, place, loose, weightless)
        if not missing:
            verify(name, place, folder)
            return place
        pickles = [p for p in missing if p.with_suffix(".bin").is_file()]
        if pickles:
            into = folder or Path("MODELS")
            raise EnvironmentMissing(
                f"{pickles[0].with_suffix('.bin')} is a pickle, which can run code when opened; mistyle loads "
                f"safetensors only. Convert it once: mistyle models convert {name} {place} --models {into}"
            )
        if place == looked[0] and folder:
            raise EnvironmentMissing(f"{place} lacks {_relative(missing, place)}; {how_to_get(model, folder)}")
    where = f"neither in {folder / name} nor in {cache()}" if folder else f"not in {cache()}"
    if model.url:
        where = f"not in {folder / name}" if folder else "nowhere, since no --models DIR was given"
    raise EnvironmentMissing(
        f"the model '{name}' ({model.repo}, {model.gigabytes} GB, {model.licence}) was found {where}; "
        f"{how_to_get(model, folder)}"
    )


def file(name: str, folder: Path | None) -> Path:
    """The file of a single-file model (VGG-19, BiRefNet)."""
    loose = get(name).loose
    return find(name, folder, loose) / loose[0]


def how_to_get(model: PublishedModel, folder: Path | None) -> str:
    """The instruction that gets a missing model."""
    into = folder or Path("models")
    if model.url:
        return f"download {model.url} and put it at {into / model.name / model.loose[0]} (--models {into})"
    return f"run: mistyle models fetch {model.name} --models {into} --allow-download (or copy it yourself)"


def _relative(paths: Iterable[Path], place: Path) -> str:
    return ", ".join(p.relative_to(place).as_posix() for p in paths)


def lacking(model: PublishedModel, place: Path, loose: Iterable[str], weightless: Iterable[str] = ()) -> list[Path]:
    """The missing files of a model's folder, by their expected paths."""
    missing = [place / name for name in loose if not (place / name).is_file()]
    for part in model.folders:
        folder = place / part
        if part.startswith("tokenizer"):
            complete = (folder / "vocab.json").is_file() or (folder / "tokenizer.json").is_file()
            missing += [] if complete else [folder / "vocab.json"]
        elif part == "scheduler":
            missing += [] if (folder / "scheduler_config.json").is_file() else [folder / "scheduler_config.json"]
        else:
            missing += [] if (folder / "config.json").is_file() else [folder / "config.json"]
            if part not in weightless and not weights(folder):
                stem = "model" if "encoder" in part else "diffusion_pytorch_model"
                missing.append(folder / f"{stem}.safetensors")
    return missing


def weights(folder: Path) -> list[Path]:
    """The weight files of a network: full precision before half, shards where split; empty where none exist."""
    for variant in ("", ".fp16"):
        for stem in WEIGHTS:
            whole = folder / f"{stem}{variant}.safetensors"
            if whole.is_file():
                return [whole]
            index = folder / f"{stem}.safetensors.index{variant}.json"
            if index.is_file():
                names = sorted(set(read_json(index)["weight_map"].values()))
                return [folder / n for n in names] if all((folder / n).is_file() for n in names) else []
    return []


def variant(folder: Path) -> str | None:
    """diffusers' variant name of the files that `weights` chose."""
    files = weights(folder)
    return "fp16" if files and ".fp16" in files[0].name else None


def read_json(path: Path) -> dict[str, Any]:
    """A configuration file, decoded by the reader process."""
    from mistyle.io.read import read_json as read

    try:
        return read(path)
    except InputRefused as error:
        raise InputRefused(f"{error}; fetch the model again") from None


def header(path: Path) -> dict[str, Any]:
    """Names, types and shapes of a safetensors file, and '__metadata__', checked, without reading its tensors."""
    return weights_header(path)[0]


def shapes(paths: Iterable[Path]) -> dict[str, list[int]]:
    """Tensor name -> shape over all files of a network."""
    tables = (header(path) for path in paths)
    return {name: entry["shape"] for table in tables for name, entry in table.items() if name != "__metadata__"}


def fingerprint(files: Iterable[Path]) -> str:
    """Hash of weight files by their sizes and sampled pieces: reading gigabytes whole takes too long."""
    total = hashlib.sha256()
    for path in files:
        size = path.stat().st_size
        total.update(f"{path.name} {size}\n".encode())
        with open(path, "rb") as file:
            for k in range(PIECES):
                file.seek(k * max(size - PIECE, 0) // (PIECES - 1))
                total.update(file.read(PIECE))
    return total.hexdigest()


def read_lock(folder: Path) -> dict[str, Any]:
    """The lock of a models' folder: per model its revision and its files' hashes."""
    path = folder / LOCK
    return read_json(path) if path.is_file() else {}


def verify(name: str, place: Path, folder: Path | None) -> None:
    """Compare a model's files with the lock's hashes, else with the published ones.

    A file in the models' folder is hashed once and recorded in the lock; in the cache, once a process. Files without a
    known hash (see `PublishedModel.sha256`) are accepted. EnvironmentMissing for a mismatch.
    """
    model = MODELS[name]
    ours = folder is not None and place == folder / name
    lock = read_lock(folder) if folder is not None and ours else {}
    noted = lock.get(name, {}).get("files", {})
    changed = False
    for relative in dict.fromkeys([*noted, *model.sha256]):
        path = place / relative
        if not path.is_file():
            continue  # `lacking` has checked the needed files; others may be absent
        stat = path.stat()
        entry = noted.get(relative)
        if entry is not None and (stat.st_size, stat.st_mtime_ns) == (entry["bytes"], entry["mtime_ns"]):
            continue
        digest = _sha256(path, stat.st_size, stat.st_mtime_ns)
        if entry is not None and digest != entry["sha256"]:
            raise EnvironmentMissing(
                f"{path}: sha256 is {digest}, expected {entry['sha256']}, recorded when the file was added; the file "
                f"has changed since. Remove it and {how_to_get(model, folder)}"
            )
        if entry is None and not digest.startswith(model.sha256[relative]):
            raise EnvironmentMissing(
                f"{path}: sha256 is {digest}, expected {model.sha256[relative]} as in {model.repo}. "
                f"Remove it and {how_to_get(model, folder)}; to use these weights anyway, put them into a folder of "
                f"models and run: mistyle models adopt {name} --models {folder or Path('models')}"
            )
        noted[relative] = {"sha256": digest, "bytes": stat.st_size, "mtime_ns": stat.st_mtime_ns}
        changed = True
    if folder is not None and ours and changed:
        lock[name] = {"repo": model.repo, "revision": "copied by hand"} | lock.get(name, {}) | {"files": noted}
        with suppress(MistyleError):  # the next run hashes the files of a read-only folder again
            write_lock(folder, lock)


@functools.lru_cache(maxsize=256)
def _sha256(path: Path, size: int, modified: int) -> str:
    """The sha256 of a file; size and modification time are part of the cache key."""
    return sha256_file(path)


def write_lock(folder: Path, lock: Mapping[str, Any]) -> None:
    from mistyle.io.store.atomic import atomic_write

    atomic_write(folder / LOCK, (json.dumps(lock, indent=1, sort_keys=True) + "\n").encode())
