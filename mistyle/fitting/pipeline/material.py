"""`mistyle fit`: a mesh and pictures of it under known or unknown light -> its material, measured on held-out pictures.

Stages are cached as those of `stylize` (stylization/pipeline/stylize.py): rerun a killed job to resume it. The fit
resumes from its last checkpoint.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mistyle.core.asset import Asset
from mistyle.core.camera import Camera
from mistyle.core.capture import Captures, Loaded, in_memory, shrunk_to, subset
from mistyle.core.errors import InputRefused
from mistyle.core.light import Lights, SceneLights, has_soft
from mistyle.core.maps import Texels
from mistyle.core.rows import evenly
from mistyle.fitting.pipeline.budget import check_material, in_files
from mistyle.fitting.pipeline.files import scene, write
from mistyle.fitting.pipeline.first_look import first_asset
from mistyle.fitting.pipeline.job import MATERIAL_STAGES, MaterialJob
from mistyle.fitting.pipeline.outlines import camera_advice, report_placement, upright_note
from mistyle.fitting.pipeline.passes import recovered_maps
from mistyle.fitting.pipeline.photometry import match_exposures
from mistyle.fitting.pipeline.pictures import pixels_of, read_averaged, write_averaged
from mistyle.fitting.pipeline.times import running
from mistyle.fitting.pipeline.unseen import refuse_unseen
from mistyle.fitting.settings.material import MaterialSettings, ReferenceSettings
from mistyle.io.images.textures import part_stems
from mistyle.jobs.edits import asset_stage, tell_edits
from mistyle.jobs.inputs import input_files
from mistyle.jobs.memory_budget import allowed, size_of
from mistyle.jobs.progress import Progress, Report
from mistyle.jobs.stages import Run, claim_run
from mistyle.jobs.start import read, start_engines
from mistyle.process import memory
from mistyle.solver.photometry.record import Photometry
from mistyle.solver.settings import measured_subsamples

if TYPE_CHECKING:
    from mistyle.solver.recover import Recovered

Sparse = Float[np.ndarray, "n 3"] | None  # points of a reconstruction, if it has some

PICTURED = 1600  # pixels along the longer side of the pictures that the report shows, at most
TWICE = 1e9  # bytes of a picture's samples that are kept where two models are rendered from them


@dataclass(frozen=True)
class Placed:
    """Cameras and lights in working space, with notes and figures of the alignment. `overlap` is the IoU of the mesh's
    outline with each picture's alpha or mask (solver/cameras/outline_check.py), NaN where it has none."""

    cameras: tuple[Camera, ...]
    lights: tuple[Lights, ...]
    notes: tuple[str, ...]
    figures: dict[str, float]
    overlap: tuple[float, ...]


@dataclass(frozen=True)
class Measured:
    """The error of the fit in each picture, fitted or held out.

    names, held   the picture's name; whether it was held out
    psnr          of the picture in sRGB (peak 1, over the valid pixels), dB
    worst         the pictures of the report: (index, reference, prediction), linear
    conversion    mean relative difference of the same maps under the other material model
    """

    names: tuple[str, ...]
    held: tuple[bool, ...]
    psnr: tuple[float, ...]
    worst: tuple[tuple[int, Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]], ...]
    conversion: float


@dataclass(frozen=True)
class MadeMaterial:
    """All results of a job, for the report."""

    job: MaterialJob
    asset: Asset
    texels: tuple[Texels, ...]
    captures: Captures
    placed: Placed
    recovered: Any
    measured: Measured
    folder: Path
    photometry: Photometry | None = None


def fit_material(job: MaterialJob, progress: Progress) -> dict[str, Any]:
    """Read, place, fit, measure and write; returns the written paths and the figures of `run.json`.

    Raises a MistyleError for every error that a user can fix; finished stages stay.
    """
    from mistyle.deliver.colour import in_working_space
    from mistyle.deliver.export import check, deliver
    from mistyle.fitting.report.material import material_report, write_summary
    from mistyle.io.cameras.captures import read_shots
    from mistyle.io.cameras.reading_notes import reading_notes
    from mistyle.io.cameras.sparse_points import sparse_points
    from mistyle.jobs.run_record import old_report

    files = input_files(job.mesh)
    s = job.settings
    claim_run(job, MATERIAL_STAGES, inputs_of(job))
    check(s)
    captures = references_of(job)
    needed = running(s, has_soft(captures.lights) or job.lights == "unknown", s.atlas.size**2)
    check_material(needed, pixels_of(captures))
    shots = read_shots(job.references, masks=job.masks, exposure=job.exposure, pictures=job.pictures)
    captures = in_working_space(captures, shots, s.colour)
    files_at = job.out / "work" if in_files(needed, pixels_of(captures)) else None
    with Run(job, progress, MATERIAL_STAGES) as run, memory.within(1e9 * allowed(s).gb, files_at):
        start_engines(s)
        asset = run.record(
            "mesh", [], [list(files), s.read, s.atlas.size], lambda r: read(job.mesh, s.read, s.atlas.size, r)
        )
        check_material(needed, pixels_of(captures), *size_of(asset))
        texels = run.record("texels", ["mesh"], [s.atlas], lambda r: lay_out(asset, s, r))
        sparse = sparse_points(job.references) if s.references.align else None
        seen = camera_inputs(job, captures, shots, sparse)
        placed = run.record("cameras", ["mesh"], seen, lambda r: place(job, asset, captures, shots, r, sparse))
        placed = replace(placed, notes=(*reading_notes(job.references, shots), *placed.notes))
        report_placement(placed, progress)
        whole = replace(captures, cameras=placed.cameras, lights=placed.lights)
        fitted, _ = hold_out(whole, s.references)
        refuse_unseen(job, asset, subset(whole, fitted))
        first_asset(run, asset, texels, subset(whole, fitted))
        captures, placed, photometry = explained_pictures(run, asset, texels, (whole, placed), shots)
        after = ["texels", "pictures", *(["light"] if job.lights == "unknown" else [])]
        recovered = recovered_maps(run, asset, texels, subset(captures, fitted), after)
        measured = run.record("measure", ["recover"], [], lambda r: measure(asset, recovered, captures, s, r))
        complete = recovered.passes == recovered.planned
        state = "" if complete else f"{recovered.passes} of {recovered.planned} passes"
        sets = list(zip(texels, recovered.maps, strict=True))
        folder, edited = asset_stage(run, ["recover"], lambda f, e, r: write(f, job, asset, sets, r, e, state))
        tell_edits(run)
        maps = edited(part_stems(job.name, asset.mesh.parts), recovered.maps)[0]
        recovered = replace(recovered, maps=tuple(maps))
        shown = replace(captures, cameras=whole.cameras)
        run.stage("scene", ["asset"], [job.name], lambda f, r: scene(f, job, asset, texels, recovered, shown))
        results = MadeMaterial(job, asset, texels, captures, placed, recovered, measured, folder, photometry)
        told = photometry.notes if photometry is not None else ()
        progress.note(*asset.source.notes, *placed.notes, *told, *recovered.notes, *old_report(job))
        progress.note(*one_light(job.name, captures))
        if s.report.detail != "none":
            inputs = [s.report, job.name]
            run.stage("report", ["asset", "measure"], inputs, lambda f, r: material_report(f, results, progress, r))
        return deliver(job, progress) | write_summary(results, run)


def camera_inputs(job: MaterialJob, captures: Captures, shots: Sequence[Any], sparse: Sparse) -> list[Any]:
    """What the placed cameras and the pictures depend on, beside the mesh."""
    from mistyle.deliver.colour import key_of

    s = job.settings
    pictures = [path for shot in shots for path in (shot.picture, shot.mask) if path is not None]
    seen_as = [[shot.pixels for shot in shots], [vars(c) for c in captures.cameras], captures.lights]
    return [pictures, *seen_as, sparse, s.references, s.seed, key_of(s.colour)]


def explained_pictures(
    run: Run, asset: Asset, texels: Sequence[Texels], whole: tuple[Captures, Placed], shots: Sequence[Any]
) -> tuple[Captures, Placed, Photometry | None]:
    """The pictures at the resolution of the texels, with their light, less their exposures; `placed` with notes about
    them; and their photometry."""
    captures, photometry, light = match_exposures(run, asset, whole[0], shots)
    captures, placed = average_pictures(run, texels, captures, whole[1])
    if run.job.lights == "unknown":
        captures = with_light(run, asset, captures, light)
    return captures, placed, photometry


def inputs_of(job: MaterialJob) -> list[Path]:
    """Every input file and folder of the job."""
    lights = job.lights if isinstance(job.lights, Path) else None
    paths = (job.references, lights, job.masks, job.exposure, job.pictures, job.albedo_of)
    return [*input_files(job.mesh), *(path for path in paths if path is not None)]


def references_of(job: MaterialJob) -> Captures:
    """The job's pictures; cameras, lights and headers are read now, pixels on demand, one picture at a time."""
    from mistyle.io.cameras.captures import read_captures

    captures = read_captures(
        job.references,
        lights=job.lights,
        masks=job.masks,
        exposure=job.exposure,
        pictures=job.pictures,
        saturation=job.settings.references.saturation,
    )
    refuse_scene_lights(captures, job.references)
    return captures


def refuse_scene_lights(captures: Captures, references: Path) -> None:
    """InputRefused for a light that only a Mitsuba scene file describes: the solver has no model of it."""
    for camera, rig in zip(captures.cameras, captures.lights, strict=True):
        named = next((light for light in rig if isinstance(light, SceneLights)), None)
        if named is not None:
            raise InputRefused(
                f"{references}: found the picture '{camera.name}' lit by the scene file {named.file}, expected lights "
                "that lights.json describes (directional, point, environment, ...). Write one and hand it in with "
                "--lights, use --light unknown, or fit the scene itself with --scene."
            )


def lay_out(asset: Asset, settings: MaterialSettings, report: Report) -> tuple[Texels, ...]:
    """Every texture set, rasterised."""
    from mistyle.atlas.texels import rasterise

    result = []
    for part in range(len(asset.mesh.parts)):
        result.append(rasterise(asset.mesh, part, settings.atlas.size))
        report((part + 1) / len(asset.mesh.parts))
    return tuple(result)


def place(
    job: MaterialJob, asset: Asset, captures: Captures, shots: Sequence[Any], report: Report, sparse: Sparse = None
) -> Placed:
    """The cameras in working space: unchanged, converted from the mesh's units, or aligned (to the points
    `sparse` of a reconstruction, if given) and refined on request; and the overlap of outlines and masks."""
    from mistyle.geometry.similarity import Y_FROM_Z, moved, upright
    from mistyle.io.cameras.captures import camera_space, outline_of, silhouette
    from mistyle.io.cameras.reading_notes import matte_note
    from mistyle.solver.cameras.align import align_by_masks, align_by_points, refine_poses
    from mistyle.solver.cameras.outline_check import check_outlines, overlap_notes

    chosen = job.settings.references
    captures = upright(captures) if chosen.up == "z" else captures
    masks, notes, inner, figures = None, list[str](), list[float](), dict[str, float]()
    if chosen.align or chosen.refine_poses:
        try:
            masks = [silhouette(shot, inner.append) for shot in shots]
        except InputRefused:
            if sparse is None or chosen.refine_poses or job.masks is not None:
                raise
            notes.append("The pictures have no masks: the mesh was aligned to the reconstruction's points alone.")
    if chosen.align:
        rng = np.random.default_rng(job.settings.seed)
        if sparse is not None:
            points = sparse @ Y_FROM_Z.T if chosen.up == "z" else sparse
            aligned = align_by_points(asset.mesh, points, captures.cameras, masks, rng)
        else:
            aligned = align_by_masks(asset.mesh, captures.cameras, masks or (), rng)
        captures = moved(captures, aligned.work_from_cams)
        if len(aligned.after):
            figures |= {"align_px": float(np.nanmean(aligned.after))}
    elif camera_space(job.references) == "own":
        captures = moved(captures, asset.source.work_from_user)
    report(0.3)
    outlines = (outline_of(shot, inner.append) for shot in shots) if masks is None else masks
    if chosen.refine_poses:
        refined = refine_poses(
            asset.mesh, captures.cameras, masks or (), progress=lambda done: report(0.3 + 0.5 * done)
        )
        captures = replace(captures, cameras=refined.cameras)
        before, after = (float(np.nanmean(each)) for each in (refined.before, refined.after))
        figures |= {"pose_px_before": before, "pose_px_after": after}
    origin = asset.source.work_from_user[:3, 3]
    overlaps = check_outlines(asset.mesh, captures.cameras, outlines, lambda done: report(0.8 + 0.2 * done), origin)
    ours = camera_space(job.references) == "working" and not chosen.align
    names = [camera.name for camera in captures.cameras]
    warnings = overlap_notes(names, overlaps, chosen.overlap, camera_advice(chosen, overlaps), trusted=ours)
    if np.isfinite(overlaps.overlap).any():
        mean, least = float(np.nanmean(overlaps.overlap)), float(np.nanmin(overlaps.overlap))
        figures |= {"outline_overlap": mean, "outline_overlap_least": least}
    tags = [shot.orientation[0] if shot.pixels == "stored" else 1 for shot in shots]
    sure = not ours and not any(text.startswith("Warning:") for text in warnings)
    turn = asset.source.work_from_user[:3, :3]
    up = upright_note(captures.cameras, tags, turn, job.settings.read.up) if sure else ()
    every = (*notes, *warnings, *matte_note(inner), *up)
    return Placed(captures.cameras, captures.lights, every, figures, overlaps.overlap)


def average_pictures(run: Run, texels: Sequence[Texels], captures: Captures, placed: Placed) -> tuple[Captures, Placed]:
    """The captures at about the resolution of the texels, and `placed` with notes about them."""
    average = run.job.settings.references.average
    folder = run.stage(
        "pictures", ["texels", "exposures"], [], lambda f, r: write_averaged(f, texels, captures, average, r)
    )
    averaged, notes = read_averaged(folder, captures)
    return averaged, replace(placed, notes=(*placed.notes, *notes))


def with_light(run: Run, asset: Asset, captures: Captures, found: Any = None) -> Captures:
    """The captures with an environment that is estimated together with a first material; `found` if it is known."""
    from mistyle.fitting.light.unknown_light import find_light

    s: MaterialSettings = run.job.settings
    card = [run.job.albedo_of] if run.job.albedo_of is not None else []

    def solved(report: Report) -> Any:
        first = found or find_light(
            asset.mesh, captures, s.recover, report, outside=s.light.sun, materials=asset.materials
        )
        return with_known_albedo(run, asset, captures, first)

    estimate = run.record("light", ["pictures"], [s.recover, s.light, card], solved)
    if s.light.sun and estimate.sun is None:
        run.progress.note("No direction of a sun explains the shading: the light is an environment alone.")
    run.progress.note(*scale_notes(run.job))
    return replace(captures, lights=tuple(estimate.lights for _ in captures.cameras))


def scale_notes(job: MaterialJob) -> tuple[str, ...]:
    """A note where nothing fixes the scale and colour of a light that is solved."""
    if job.lights != "unknown" or (job.albedo_of is not None and job.settings.light.albedo is not None):
        return ()
    return (
        "The pictures hardly determine an unknown light's scale and colour, so all albedo may be too dark, too bright "
        "or tinted: --albedo-of MASK=VALUE fixes both by a surface of known albedo, such as a grey card.",
    )


def with_known_albedo(run: Run, asset: Asset, captures: Captures, found: Any) -> Any:
    """The light in the scale of the surface that --albedo-of names; unchanged without one."""
    from mistyle.fitting.light.gauge import gauged
    from mistyle.io.cameras.camera_files import stem
    from mistyle.io.read import read_picture
    from mistyle.solver.photometry.record import at_size

    mask, albedo = run.job.albedo_of, run.job.settings.light.albedo
    if mask is None or albedo is None:
        return found
    named = [camera for camera in captures.cameras if camera.name == stem(mask.name)]
    if not named:
        names = ", ".join(camera.name for camera in captures.cameras[:3])
        raise InputRefused(f"{mask}: found no picture of that name, expected one of {names}, ... Rename the mask.")
    surface = at_size(read_picture(mask, "stored").rgb.mean(axis=-1) > 0.5, named[0].size)
    found, factor = gauged(asset.mesh, found, named[0], surface, albedo)
    run.progress.note(f"The known albedo of {mask.name} scaled all albedos by {', '.join(f'{v:.3g}' for v in factor)}.")
    return found


def lights_in_order(lights: Sequence[Lights]) -> list[int]:
    """The index of each picture's light, by order of first appearance."""
    seen: list[Lights] = []
    result = []
    for rig in lights:
        if rig not in seen:
            seen.append(rig)
        result.append(seen.index(rig))
    return result


def one_light(name: str, captures: Captures) -> tuple[str, ...]:
    """A note where the pictures had several lights: the scene file holds the first one's."""
    count = 1 + max(lights_in_order(captures.lights))
    moving = len(captures) > 1 and any(getattr(light, "frame", "world") == "camera" for light in captures.lights[0])
    if count == 1 and not moving:
        return ()
    rest = f"the pictures had {count}" if count > 1 else "it moved with the camera"
    return (f"scene/{name}.xml has the light of the first picture; {rest}, so the other pictures cannot all be "
            "rendered from it.",)  # fmt: skip


def hold_out(captures: Captures, settings: ReferenceSettings) -> tuple[list[int], list[int]]:
    """(fitted, held out): held out are evenly chosen pictures and those of `hold_out_light`. InputRefused for all."""
    count, number = len(captures), lights_in_order(captures.lights)
    held = {k for k in range(count) if number[k] == settings.hold_out_light}
    rest = [k for k in range(count) if k not in held]
    evenly = (len(rest) // 12 if len(rest) >= 24 else 0) if settings.hold_out < 0 else settings.hold_out
    # Multiples of the golden ratio: even steps could select the same light of every view.
    order = np.argsort(np.arange(len(rest)) * 0.6180339887498949 % 1)
    held |= {rest[int(k)] for k in order[:evenly]}
    fitted = [k for k in range(count) if k not in held]
    if not fitted:
        raise InputRefused(f"all {count} references would be held out, none is left for the fit; hold out fewer")
    return fitted, sorted(held)


def measure(
    asset: Asset, recovered: "Recovered", captures: Captures, settings: MaterialSettings, report: Report
) -> Measured:
    """Predict every picture from the fitted maps and compare the two. Predictions have the indirect light that was
    subtracted from the pictures."""
    from mistyle.core.image import srgb_from_linear
    from mistyle.measure.metrics import psnr
    from mistyle.render.deferred.material_table import pack
    from mistyle.render.mitsuba.device import give_back
    from mistyle.render.mitsuba.draw import tracer
    from mistyle.solver.indirect import Indirect, enlarged
    from mistyle.solver.schedule import MEASURED_PATHS

    chosen, maps = settings.recover, recovered.maps
    traced, table, sizes = tracer(asset.mesh), pack(maps), [m.roughness.shape for m in maps]
    indirect = Indirect(asset.mesh, maps, model=chosen.model, frame=chosen.frame) if recovered.indirect else None
    second_model = "gltf" if chosen.model == "principled" else "principled"
    _, held = hold_out(captures, settings.references)
    errors: list[float] = []
    shown: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    converted: list[float] = []
    shown_pictures = sorted({*held[:4], *evenly(len(captures), 4)})
    for k in range(len(captures)):
        first = renderer_of(traced, subset(captures, [k]), sizes, chosen, TWICE if k in shown_pictures else 0)
        rendered = [first.image_and_coverage(table, 0)]
        if k in shown_pictures:
            rendered.append(first.with_model(second_model).image_and_coverage(table, 0))
        rgb, valid = captures.load(k)
        valid = valid & (rendered[0][1] > 0.999)
        predicted = rendered[0][0]
        if indirect is not None:
            light = indirect.pictures(captures.cameras[k], [captures.lights[k]], MEASURED_PATHS, settings.seed + k)[0][
                0
            ]
            predicted = predicted + enlarged(light, captures.cameras[k].size)
        if valid.any():
            errors.append(psnr(srgb_from_linear(rgb[valid]), srgb_from_linear(predicted[valid])))
        else:
            errors.append(float("nan"))
        if k in shown_pictures:
            shown[k] = _small(captures.cameras[k], (rgb, valid), predicted)
            scale = float(rendered[0][0][valid].mean()) if valid.any() else 0.0
            if scale > 0:
                converted.append(float(np.abs(rendered[1][0] - rendered[0][0])[valid].mean()) / scale)
        del first
        report((k + 1) / len(captures))
    give_back()
    return Measured(
        names=tuple(camera.name for camera in captures.cameras),
        held=tuple(k in set(held) for k in range(len(captures))),
        psnr=tuple(errors),
        worst=tuple((k, *pair) for k, pair in shown.items()),
        conversion=float(np.mean(converted)) if converted else float("nan"),
    )


def _small(camera: Camera, reference: Loaded, predicted: Float[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray]:
    """A reference, 0 at its invalid pixels, and its prediction, both averaged to at most PICTURED pixels a side."""
    pair = in_memory([camera] * 2, [()] * 2, [reference[0], predicted], [reference[1]] * 2)
    (rgb, valid), (drawn, _) = map(shrunk_to(pair, PICTURED).load, (0, 1))
    return np.where(valid[..., None], rgb, 0).astype(np.float32), drawn


def renderer_of(traced: Any, captures: Captures, sizes: Any, chosen: Any, memory: float) -> Any:
    """The renderer of the one picture of `captures`; it keeps at most `memory` bytes of the picture's samples."""
    from mistyle.render.deferred.renderer import MaterialRenderer, RenderOptions

    height, width = captures.cameras[0].size
    subsamples = measured_subsamples(chosen, has_soft(captures.lights), height * width)
    options = RenderOptions(
        chosen.model, chosen.frame, subsamples, memory=memory, directions=chosen.soft_measured, gradients=False
    )
    return MaterialRenderer(traced, captures, sizes, options)
