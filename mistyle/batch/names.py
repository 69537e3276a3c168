"""Names of the jobs of a batch: after their meshes and styles, never after their place in the list.

A job's name is its folder and its series of versions. It must stay when other jobs come and go, or another mesh would
continue the series. So jobs of equal names are told apart by what tells their files apart, and a job keeps the name
that it has in the plan of the batch's folder.
"""

import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mistyle.core.names import ASSET, FILE_NAME, cut, distinct, folded, safe_name

OWN = ("batch.html", "batch.json", "farm", "plan.json", "shards")  # what a batch itself writes beside its jobs
DIGEST = 6  # hexadecimal digits of a name that nothing else tells apart


@dataclass(frozen=True)
class JobSource:
    """What a job is named after.

    second  the style picture; for a fit `fit` in the folder of references
    rest    words of a grid's preset and variant
    chosen  the user's own name
    """

    mesh: Path
    second: Path
    rest: tuple[str, ...] = ()
    chosen: str | None = None

    def files(self) -> tuple[str, str]:
        """Both files without links, which identify them however they are spelled."""
        return os.path.realpath(self.mesh), os.path.realpath(self.second)

    def plain(self) -> str:
        """The name without regard to other jobs."""
        return _safe(self.chosen or "_".join([self.mesh.stem, self.second.stem, *self.rest]))


Before = Mapping[tuple[str, str], Sequence[str]]
"""The names in the plan of the batch's folder, by `JobSource.files`."""


def job_names(sources: Sequence[JobSource], base: Path, before: Before | None = None) -> list[str]:
    """Distinct names of the jobs, safe as names of folders.

    The user's names come first, then those of the plan `before`, then plain names. Jobs of equal plain names get the
    folder or the ending that tells their files apart; where that fails, a digest of their paths relative to `base`.
    Only jobs of the same files and equal names get -2, -3, … in their order.
    """
    plain = [source.plain() for source in sources]
    names, rank = list(plain), [0 if source.chosen else 2 for source in sources]
    for group in _groups(range(len(sources)), lambda k: folded(plain[k])):
        if len({sources[k].files() for k in group}) > 1:
            told = _told_apart([sources[k] for k in group])
            for k, name in zip(group, told, strict=True):
                if not sources[k].chosen:
                    names[k], rank[k] = name, 3
    chosen = {folded(plain[k]) for k, source in enumerate(sources) if source.chosen}
    for k, name in _kept(sources, before or {}).items():
        if folded(name) not in chosen:
            names[k], rank[k] = name, 1
    for group in _groups(range(len(sources)), lambda k: folded(names[k])):
        for k in _to_be_marked(group, sources, rank):
            text = "\n".join([os.path.relpath(p, base) for p in (sources[k].mesh, sources[k].second)])
            digest = hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:DIGEST]
            names[k] = f"{cut(names[k], ASSET - DIGEST - 1)}-{digest}"
    return distinct(names, limit=ASSET, joint="-")


def why_not(name: str, others: Collection[str]) -> str:
    """Why a job of a batch cannot have this name; "" where it can. `others` are the batch's names, `folded`."""
    if folded(name) in OWN:
        return f"'{name}' is the name of a file or folder that the batch itself writes. Choose another name"
    stem = folded(name).removesuffix(".failed")
    if stem != folded(name) and stem in others:  # shards/<name>.failed.json is the mark of a failure
        return f"'{name}' is how the batch marks a failure of its job '{name[: len(stem)]}'. Choose another name"
    return ""


def _to_be_marked(group: Sequence[int], sources: Sequence[JobSource], rank: Sequence[int]) -> list[int]:
    """The jobs of equal names that yield: all but those of the first rank, and these too where only folders or endings
    name them."""
    if len({sources[k].files() for k in group}) < 2:
        return []
    first = min(rank[k] for k in group)
    return [k for k in group if rank[k] > first or first == 3]


def _told_apart(sources: Sequence[JobSource]) -> list[str]:
    """Names with the folder or the ending of the meshes, of the styles, or of both: whichever is enough."""
    pairs = {source.files() for source in sources}
    meshes, seconds = _labels([s.mesh for s in sources]), _labels([s.second for s in sources])
    by_mesh = len({mesh for mesh, _ in pairs}) == len(pairs)
    by_second = not by_mesh and len({second for _, second in pairs}) == len(pairs)
    result = []
    for source in sources:
        mesh = source.mesh.stem if by_second else meshes[source.mesh]
        second = source.second.stem if by_mesh else seconds[source.second]
        result.append(_safe("_".join([mesh, second, *source.rest])))
    return result


def _labels(paths: Iterable[Path]) -> dict[Path, str]:
    """Each file's stem with what tells it apart from the others: the nearest folders that differ, and its ending."""
    every = list(dict.fromkeys(paths))
    folders = {path: tuple(reversed(Path(os.path.normpath(path)).parent.parts)) for path in every}
    words = _differing(set(folders.values()))
    endings = defaultdict(set)
    for path in every:
        endings[folders[path]].add(folded(path.suffix))
    result = {}
    for path in every:
        ending = [path.suffix[1:]] if path.suffix and len(endings[folders[path]]) > 1 else []
        result[path] = "_".join([*words[folders[path]], path.stem, *ending])
    return result


def _differing(folders: set[tuple[str, ...]]) -> dict[tuple[str, ...], list[str]]:
    """The words that tell folders (nearest part first) apart: as few of the nearest parts as suffice, outermost first,
    without parts that all have in common."""
    deepest = max(map(len, folders))
    near = {folder: (*folder, *[""] * (deepest - len(folder))) for folder in folders}
    count = next(k for k in range(deepest + 1) if len({near[folder][:k] for folder in folders}) == len(folders))
    levels = [k for k in reversed(range(count)) if len({near[folder][k] for folder in folders}) > 1]
    return {folder: [near[folder][k] for k in levels if near[folder][k]] for folder in folders}


def _kept(sources: Sequence[JobSource], before: Before) -> dict[int, str]:
    """The jobs that the plan before has too, with their names in it."""
    left = {files: list(names) for files, names in before.items()}
    result = {}
    for k, source in enumerate(sources):
        names = [] if source.chosen else left.get(source.files(), [])
        name = next(filter(_form(source), names), None)
        if name is not None:
            names.remove(name)
            result[k] = name
    return result


def _form(source: JobSource) -> Callable[[str], object]:
    """Whether a name is one that this job may have had: its own words, with any that told it apart."""

    def word(path: Path) -> str:
        ending = f"(_{re.escape(folded(path.suffix[1:]))})?" if path.suffix else ""
        return re.escape(folded(safe_name(path.stem, FILE_NAME, "-"))) + ending

    rest = "".join(re.escape(folded(f"_{text}")) for text in source.rest)
    pattern = rf"(.+_)?{word(source.mesh)}_(.+_)?{word(source.second)}{rest}(-\d+|-[0-9a-f]{{{DIGEST}}})?"
    return lambda name: re.fullmatch(pattern, folded(name))


def _groups(items: Iterable[int], key: Callable[[int], Hashable]) -> list[list[int]]:
    """The items of equal keys, in their order."""
    result: dict[Hashable, list[int]] = defaultdict(list)
    for item in items:
        result[key(item)].append(item)
    return list(result.values())


def _safe(text: str) -> str:
    return safe_name(text, filler="-")
