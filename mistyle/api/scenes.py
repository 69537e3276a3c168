"""Parameters of any live Mitsuba scene, fitted to pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any

from mistyle.api import html
from mistyle.process.cores import single_blas
from mistyle.solver.scene.result import FittedScene


class SceneFit(FittedScene):
    """A `FittedScene` with an HTML display for notebooks."""

    def _repr_html_(self) -> str:
        from mistyle.fitting.report.scene import changes, figures, row_text

        rows = [(row["name"], row_text(row)) for row in changes(self)]
        head = ("parameter", "before → after ± standard error")
        return html.page("Fitted scene", html.table(("figure", "value"), figures(self).items()),
                         html.table(head, rows), notes=self.notes)  # fmt: skip


def fit_scene(
    scene: Any,
    keys: str | Sequence[str],
    sensors: Sequence[Any] | None = None,
    references: Sequence[Any] = (),
    *,
    loss: str | Callable[[Any, Any], Any] | None = None,
    regularizers: Sequence[Callable[[Mapping[str, Any]], Any]] = (),
    callback: Callable[[int, float, Mapping[str, Any]], Any] | None = None,
    iterations: int = 128,
    spp: int = 16,
    spp_grad: int | None = None,
    rate: float = 0.02,
    pyramid: bool = True,
    sensors_per_step: int = 1,
    seed: int = 0,
    solver: str = "auto",
    integrator: Any = None,
    fast: bool = True,
    masks: Sequence[Any] | None = None,
    only: Mapping[str, Any] | None = None,
    channels: str = "",
    save: Callable[[dict[str, Any]], None] | None = None,
    save_every: float = 60.0,
    resume: Mapping[str, Any] | None = None,
    progress: Callable[[float], None] | None = None,
) -> SceneFit:
    """Fit parameters of a live `mi.Scene` so that its renders match pictures of known cameras.

    scene             a live `mi.Scene`; it is modified and then holds the result
    keys              of `mi.traverse`, or globs: "wall.bsdf.*"; `mistyle fit --scene FILE --list` shows them
    sensors           `mi.Sensor`s or indices into the scene's sensors; None: all
    references        one per sensor, of the film's size: linear Rec.709 radiance (h, w, 3), or paths of pictures
    loss              None: "relative", or "log_srgb_l1" where gradients come without Monte Carlo.
                      "relative": (I - R)² over the reference's mean square around the pixel; "l2": (I - R)². Render
                      noise does not move the minimum of these two. "log_srgb_l1": |s(I) - s(R)| with s(x) =
                      sRGB(log(1 + x)); noise moves its minimum by percents. Or a function (picture, reference) ->
                      number on Mitsuba tensors (h, w, 3); masked pixels are equal in both
    regularizers      functions ({key: value}) -> number on Mitsuba tensors and arrays, added to the loss (Adam only)
    callback          (iteration, loss, values) after each step of Adam or round of Gauss–Newton; returns True to stop
    iterations        steps; each renders `sensors_per_step` cameras, all of them once before any repeats
    spp, spp_grad     independent samples per pixel of the picture and of its derivative; spp_grad None: 8 for
                      Gauss–Newton, 1 for Adam
    rate              of Adam, for values in 0..1; values without a range are scaled by their initial root mean square
    pyramid           False: plain Adam on the texels
    seed              every random choice follows from it
    solver            "auto": Gauss–Newton for up to 32 numbers of literals and colours under a squared loss, else Adam;
                      "adam"; "gauss-newton"
    integrator        an `mi.Integrator`, a plugin's name or a dictionary; None: the scene's own if it has gradients,
                      else `prb` (`prbvolpath` in a scene with media) with the depth of the scene's own
    fast              gradients without Monte Carlo where the deferred renderer matches the scene's pictures; see notes
    masks             valid pixels, bool (h, w), one per sensor (None: all)
    only              by key (or name): bool mask of the numbers that may change; all others keep their bytes
    channels          of EXR references by path: a prefix ("image"), or three names with commas
    save, resume      `save` receives a dictionary of arrays every `save_every` seconds, and when the callback stops or
                      aborts the fit. Passed as `resume` with all else unchanged, it continues to the same result (equal
                      bytes with one thread)
    progress          receives the completed share, 0..1

    Returns a `FittedScene`: values before and after by key, their standard errors, residuals with their share of render
    noise, unconverged parameters, and notes. A result worse than its start is undone, with a note. A texel with a NaN
    gradient keeps its last good value from then on, and is reported. Raises UsageError for impossible keys or settings,
    InputRefused for references and for scenes that Mitsuba cannot render.
    """
    from dataclasses import replace
    from pathlib import Path

    from mistyle.fitting.pipeline.scene_references import read_reference
    from mistyle.render.live.parameters import merged
    from mistyle.solver.scene.fit import fit_scene as run

    notes: list[str] = []
    pictures: list[Any] = []
    valid: list[Any] = [None] * len(references) if masks is None else list(masks)
    for k, picture in enumerate(references):
        if isinstance(picture, (str, PathLike)):
            picture, usable, read_notes = read_reference(Path(picture), channels)
            notes += read_notes
            if k < len(valid):
                valid[k] = usable if valid[k] is None else valid[k] & usable
        pictures.append(picture)
    with single_blas():
        fitted = run(
            scene,
            [keys] if isinstance(keys, str) else keys,
            sensors,
            pictures,
            loss=loss,
            regularizers=regularizers,
            callback=callback,
            iterations=iterations,
            spp=spp,
            spp_grad=spp_grad,
            rate=rate,
            pyramid=pyramid,
            sensors_per_step=sensors_per_step,
            seed=seed,
            solver=solver,
            integrator=integrator,
            fast=fast,
            masks=valid,
            only=only,
            save=save,
            save_every=save_every,
            resume=resume,
            progress=progress or (lambda done: None),
        )
    return replace(SceneFit(**vars(fitted)), notes=(*notes, *fitted.notes, *merged(fitted.parameters)))
