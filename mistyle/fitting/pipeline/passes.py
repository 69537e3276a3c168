"""The stage "recover" of `mistyle fit`: passes within the limits of `--passes` and `--minutes`, checkpoints, and assets
of the maps so far, which the finished asset replaces.

An asset follows the first pass (before it: `first_look.py`); others follow whenever the time since the start has
doubled, and at a stop request. Each has the finished asset's path and is marked by "passes" in `asset/done.json` and
in the GLB's provenance.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mistyle.core.asset import Asset
from mistyle.core.capture import Captures
from mistyle.core.errors import Stopped
from mistyle.core.light import has_soft
from mistyle.core.maps import Texels
from mistyle.core.mesh import surface_of
from mistyle.fitting.pipeline.budget import check_material
from mistyle.fitting.pipeline.files import write
from mistyle.fitting.pipeline.pictures import pixels_of
from mistyle.fitting.pipeline.times import closing_seconds
from mistyle.fitting.settings.material import MaterialSettings
from mistyle.io.store.atomic import digest
from mistyle.jobs import checkpoint
from mistyle.jobs.memory_budget import size_of, with_setting
from mistyle.jobs.progress import StageReport
from mistyle.jobs.run_record import merged_peaks, merged_seconds, write_record
from mistyle.jobs.stages import Run
from mistyle.solver.visible import visible_shares

OFTEN = 2.0  # factor of the time since the start between two assets


def recovered_maps(run: Run, asset: Asset, texels: Sequence[Texels], captures: Captures, after: Sequence[str]) -> Any:
    """The stage's `Recovered`. Its checkpoint does not depend on the limits, so wider ones continue from it."""
    s: MaterialSettings = run.job.settings
    inputs = [s.recover, s.references, s.start, s.seed]
    key = digest([run.base, "recover", inputs, [run.keys[name] for name in after]])
    recovered = run.record(
        "recover", after, [*inputs, s.passes, s.minutes], lambda r: solve(run, asset, texels, captures, key, r)
    )
    if recovered.passes == recovered.planned:
        checkpoint.clear(run.job.out)
    else:
        run.progress.note(
            f"The fit ended after {recovered.passes} of {recovered.planned} passes, as --passes or --minutes asked. "
            f"--passes {recovered.passes} gives the same bytes again; more minutes or passes continue from here."
        )
    return recovered


def solve(run: Run, asset: Asset, texels: Sequence[Texels], captures: Captures, key: str, report: StageReport) -> Any:
    """The fit, with checkpoints in work/ under `key`, so that another job's checkpoint is never resumed."""
    from mistyle.atlas.texels import start_maps
    from mistyle.solver.recover import Checkpoints, Limits, Reached, recover

    job, s = run.job, run.job.settings
    start = None
    if s.start == "own":
        start = [start_maps(m, t, s.atlas.size) for m, t in zip(asset.materials, texels, strict=True)]
    folder, since = checkpoint.place(job.out, key), time.monotonic() - (time.perf_counter() - run.progress.began)
    # The cache of the pictures' samples changes only the time of the fit.
    unaveraged = with_setting(s, "references.average", 1)  # the pictures are averaged already
    bounded = check_material(unaveraged, pixels_of(captures), *size_of(asset))
    last: list[Reached] = []
    written = [since]

    def write_reached(reached: Reached, smooth: bool) -> None:
        write_preliminary(run, asset, texels, (reached.maps(smooth), reached.done, reached.planned), key)
        written[0] = time.monotonic()

    def watch(reached: Reached) -> None:
        last[:] = [reached]
        if reached.done < reached.planned and time.monotonic() - since >= OFTEN * (written[0] - since):
            write_reached(reached, smooth=True)

    deadline = float("inf")
    if s.minutes:
        visible = visible_shares(surface_of(asset.mesh.positions, asset.mesh.faces), captures.cameras, captures.lights)
        closing = closing_seconds(s, pixels_of(captures), texels, has_soft(captures.lights), visible)
        deadline = since + 60 * s.minutes - closing
    checkpoints = Checkpoints(
        lambda arrays: checkpoint.save(folder, arrays), checkpoint.load(folder, run.progress.note)
    )
    limits = Limits(s.passes, deadline, watch, report.begin_at, judged=False)
    report.end_in(deadline - time.monotonic())
    try:
        return recover(
            asset.mesh, texels, captures, bounded.recover, s.seed, report,
            start=start, checkpoints=checkpoints, limits=limits,
        )  # fmt: skip
    except Stopped:
        if not last:
            raise
        write_reached(last[0], smooth=False)
        done, planned = last[0].done, last[0].planned
        raise Stopped(
            f"stopped on request after {done} of {planned} passes; {job.out / 'asset'} holds them; rerun to resume"
        ) from None


def write_preliminary(
    run: Run, asset: Asset, texels: Sequence[Texels], reached: tuple[Any, int, int], key: str
) -> None:
    """Write the asset of `reached` (maps, passes done and planned), and a `run.json` that says so."""
    job, (maps, done, planned) = run.job, reached
    state = f"{done} of {planned} passes"
    place = job.out / "asset" / f"{job.name}.glb"

    def fill(folder: Path) -> None:
        write(folder, job, asset, zip(texels, maps, strict=True), state=state)

    run.preliminary("asset", digest([key, "passes", done]), fill, {"passes": done, "planned": planned})
    record = {
        "name": job.name,
        "asset": str(place),
        "finished": False,
        "passes": {"done": done, "planned": planned},
        "seconds": merged_seconds(job.out / "run.json", run),
        "peaks_gb": merged_peaks(job.out / "run.json", run),
        "notes": list(run.progress.notes),
    }
    write_record(job, record, run.progress)
    run.progress.say(f"  {place}: {state}, {time.perf_counter() - run.progress.began:.0f} s after the start")
