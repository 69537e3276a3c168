"""Model downloads through huggingface_hub, and conversion of a pickled state dict into safetensors."""

import errno
import hashlib
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from mistyle.core.errors import EnvironmentMissing, InputRefused, MistyleError, UsageError
from mistyle.core.paths import real_path
from mistyle.io.store.atomic import atomic_write, sha256_file
from mistyle.process import disk_errors
from mistyle.process.weights import converted
from mistyle.stylization.models import folder as models

PARTIAL = ".partial"


def fetch(name: str, folder: Path, allowed: bool, *, overwrite: bool = False) -> Path:
    """Download a model into `folder/name`, check its hashes and record them in the folder's lock; resumes.

    A file's sha256 must be the pinned one, else the one that the hub states for it. `HF_ENDPOINT`, `HF_TOKEN` and the
    proxies are huggingface_hub's. Raises UsageError unless downloading is allowed, and for a differing file that
    mistyle did not fetch, unless `overwrite`.
    """
    model = models.get(name)
    if model.url:
        raise UsageError(f"'{name}' is not on the hub: {models.how_to_get(model, folder)}")
    if not allowed:
        raise UsageError(
            f"fetching '{name}' downloads about {model.gigabytes} GB from {model.repo} under its licence "
            f"({model.licence}); allow it with --allow-download"
        )
    models.need_extra()
    from huggingface_hub.errors import HfHubHTTPError

    # huggingface_hub has changed its HTTP library more than once; its errors derive from that library's own class.
    transport: Any = next(base for base in HfHubHTTPError.__mro__ if base.__name__ == "HTTPError")
    place = folder / name
    try:
        noted = models.read_lock(folder).get(name, {})
        known = noted.get("files", {})
        own = set(_files(place)) - set(known)  # copied by the user: never removed
        revision = _commit(model, noted.get("revision", ""))
        hashes = _download(model, revision, place, None if overwrite else known) | dict(model.sha256)
    except (transport, OSError) as error:
        if isinstance(error, OSError) and error.errno in (
            *disk_errors.FULL,
            errno.EFBIG,
            *disk_errors.NOT_TO_BE_WRITTEN,
        ):
            raise MistyleError(
                f"{place}: cannot be written ({os.strerror(error.errno or 0)}); '{name}' takes about {model.gigabytes} "
                "GB. Make room or name another folder with --models, and rerun to resume"
            ) from None
        raise EnvironmentMissing(
            f"{model.repo} could not be fetched: {str(error).splitlines()[0]}; check the network (HF_ENDPOINT, proxy, "
            "HF_HUB_OFFLINE; HF_TOKEN where the licence must be accepted) and rerun to resume"
        ) from None
    entries = {path: _checked(place / path, hashes.get(path), fetched=path not in own) for path in _files(place)}
    if not entries:
        raise EnvironmentMissing(f"{model.repo} at {model.revision} holds none of {', '.join(model.patterns)}")
    if list(place.glob("*.bin")) and not models.weights(place):
        convert(place / "diffusion_pytorch_model.bin", place, overwrite=overwrite)
        entries = {path: entries.get(path) or _checked(place / path, None) for path in _files(place)}
    lock = models.read_lock(folder)
    lock[name] = {"repo": model.repo, "revision": revision, "files": entries}
    models.write_lock(folder, lock)
    missing = models.lacking(model, place, model.loose)
    if missing:
        raise EnvironmentMissing(f"{place}: {model.repo} gave no {missing[0].relative_to(place).as_posix()}")
    return place


def adopt(name: str, folder: Path) -> Path:
    """Accept a folder's present weights as the model `name`: their hashes go into the folder's lock.

    Meant for weights other than the published ones. Raises EnvironmentMissing where the folder is not complete.
    """
    model, place = models.get(name), folder / name
    missing = models.lacking(model, place, model.loose) if place.is_dir() else [place]
    if missing:
        raise EnvironmentMissing(f"{missing[0]} is missing; {name} needs {', '.join(model.folders + model.loose)}")
    lock = models.read_lock(folder)
    weights = [path for path in _files(place) if path.endswith(".safetensors") or path in model.loose]
    entries = {path: _checked(place / path, None) for path in weights}
    lock[name] = {"repo": model.repo, "revision": "adopted", "files": entries}
    models.write_lock(folder, lock)
    return place


def _files(place: Path) -> list[str]:
    every = (p.relative_to(place) for p in sorted(place.rglob("*")) if p.is_file())
    return [p.as_posix() for p in every if p.parts[0] != PARTIAL]


def _commit(model: models.PublishedModel, noted: str) -> str:
    """The commit to fetch. A model without a pinned revision keeps the commit of its first download, because the hub's
    `main` may change."""
    from huggingface_hub import HfApi

    if model.revision != "main":
        return model.revision
    return noted if re.fullmatch("[0-9a-f]{40}", noted) else str(HfApi().model_info(model.repo).sha)


def _download(
    model: models.PublishedModel, revision: str, place: Path, known: Mapping[str, Any] | None
) -> dict[str, str]:
    """Fetch the missing files; returns the sha256 that the hub states for its large files.

    A file of another size is replaced if it is `known`, i.e. in the folder's lock (None: all are). UsageError else.

    Partial files stay in `place/.partial` when the connection breaks (huggingface_hub's own downloads restart in
    every process).
    """
    from huggingface_hub import HfApi, get_hf_file_metadata, hf_hub_url
    from huggingface_hub.file_download import http_get
    from huggingface_hub.utils import build_hf_headers, filter_repo_objects

    every = HfApi().list_repo_files(model.repo, revision=revision)
    stated, partial = {}, place / PARTIAL
    for path in filter_repo_objects(every, allow_patterns=list(model.patterns)):
        target = _inside(place, path)
        url = hf_hub_url(model.repo, path, revision=revision)
        remote = get_hf_file_metadata(url)
        tag = remote.etag or ""
        if re.fullmatch("[0-9a-f]{64}", tag):
            stated[path] = tag
        if target.is_file() and target.stat().st_size == remote.size:
            continue
        if target.exists() and known is not None and path not in known:
            raise UsageError(
                f"{target}: found {target.stat().st_size} bytes that mistyle did not fetch, expected {remote.size} of "
                f"{model.repo}. Move the file away, keep it with `mistyle models adopt`, or replace it with --overwrite"
            )
        headers = build_hf_headers()
        if urlparse(remote.location).netloc != urlparse(url).netloc:
            url = remote.location  # a signed address on another host, which must not receive the token
            headers.pop("authorization", None)
        part = partial / hashlib.sha256(f"{path}\n{tag}".encode()).hexdigest()[:24]
        part.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "r+b" if part.is_file() else "wb") as file:
            have = file.seek(0, os.SEEK_END)
            http_get(url, file, resume_size=have, headers=headers, expected_size=remote.size)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(part, target)
    shutil.rmtree(partial, ignore_errors=True)
    return stated


def _inside(place: Path, path: str) -> Path:
    """The local path of a repository's file; EnvironmentMissing for paths outside the folder."""
    target = place / path
    if not real_path(target).is_relative_to(real_path(place)):
        raise EnvironmentMissing(f"the repository names a file '{path}' outside its own folder; it was not fetched")
    return target


def _checked(path: Path, expected: str | None, fetched: bool = False) -> dict[str, Any]:
    """A file's entry for the lock. A file of another hash is refused, and removed if it was `fetched`."""
    digest = sha256_file(path)
    if expected is not None and digest != expected:
        if fetched:
            path.unlink()
        action = "the file was removed. Rerun" if fetched else "the file was copied by hand. Move it away and rerun"
        raise EnvironmentMissing(
            f"{path}: sha256 is {digest}, expected {expected}; {action} the same command. If the hash stays wrong, the "
            "published file has changed"
        )
    stat = path.stat()
    return {"sha256": digest, "bytes": stat.st_size, "mtime_ns": stat.st_mtime_ns}


def convert(pickle: Path, into: Path, *, overwrite: bool = False) -> Path:
    """Write a pickled state dict as safetensors into the folder `into`, with a copy of its config.json.

    A child process opens the pickle with `weights_only=True`: only tensors, no code. Anything else is refused.
    UsageError where another file would be replaced, unless `overwrite`.
    """
    from safetensors.torch import save_file

    if not pickle.is_file():
        raise InputRefused(f"{pickle}: found nothing, expected a pickled state dict (.bin)")
    target = into / "diffusion_pytorch_model.safetensors"
    if not overwrite:
        _refuse_others(pickle, target)
    tensors = converted(pickle)
    atomic_write(target, lambda path: save_file(tensors, path, {"format": "pt"}))
    config = pickle.with_name("config.json")
    if config.is_file() and config.parent != into:
        atomic_write(into / "config.json", config.read_bytes())
    return target


def _refuse_others(pickle: Path, target: Path) -> None:
    """UsageError for existing weights, or a differing configuration, at a conversion's output paths."""
    config, written = pickle.with_name("config.json"), target.with_name("config.json")
    differs = config.is_file() and written.is_file() and config.read_bytes() != written.read_bytes()
    for path in (target,) * target.exists() + (written,) * differs:
        raise UsageError(f"{path}: this file exists and would be replaced. Move it away, or add --overwrite")


def listing(folder: Path | None) -> list[dict[str, Any]]:
    """One row per model, as `mistyle models` prints it."""
    rows = []
    lock = models.read_lock(folder) if folder else {}
    for model in models.MODELS.values():
        place = next((p for p in models.places(model, folder) if p.is_dir()), None)
        missing = models.lacking(model, place, model.loose if model.url else ()) if place else []
        locked = lock.get(model.name, {}).get("files", {})
        hashes = {k: v["sha256"] for k, v in locked.items() if k.endswith(".safetensors")}
        rows.append(
            {
                "name": model.name,
                "repo": model.repo,
                "revision": model.revision,
                "sha256": hashes | dict(model.sha256),
                "gigabytes": model.gigabytes,
                "licence": model.licence,
                "purpose": model.purpose,
                "url": model.url,
                "folders": [f or "." for f in model.folders] + list(model.loose),
                "found": str(place) if place and not missing else None,
            }
        )
    return rows
