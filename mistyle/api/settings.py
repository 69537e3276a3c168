"""Typed keyword settings of the verbs: one mapping per stage, as `--print-config` prints them."""

from collections.abc import Mapping
from typing import Any, Literal, TypedDict

Stage = Mapping[str, Any]
Variant = Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"]


class StylizeSettings(TypedDict, total=False):
    """Settings of `stylize` and `bake`; `mistyle stylize --print-config` lists those of each stage."""

    seed: int
    threads: int
    memory: float
    variant: Variant
    stylizer: Literal["embedded", "embedded-view", "diffusion"]
    inpainter: Literal["fill", "paint3d"]
    read: Stage
    rig: Stage
    draw: Stage
    surface: Stage
    paint: Stage
    sweep: Stage
    atlas: Stage
    bake: Stage
    displace: Stage
    finish: Stage
    fit: Stage
    repair: Stage
    report: Stage
    deliver: Stage
    colour: Stage
    models: Stage
    train: Stage
    diffusion: Stage
    paint3d: Stage


class FitSettings(TypedDict, total=False):
    """Settings of `fit`; `mistyle fit --print-config` lists those of each stage."""

    seed: int
    threads: int
    memory: float
    passes: int
    minutes: float
    variant: Variant
    start: Literal["nothing", "own"]
    read: Stage
    references: Stage
    photometry: Stage
    light: Stage
    atlas: Stage
    recover: Stage
    report: Stage
    deliver: Stage
    colour: Stage


class LookdevSettings(TypedDict, total=False):
    """Settings of `lookdev`: pixels and samples of its pictures, and frames of each turntable."""

    size: int
    spp: int
    seed: int
    mp4: bool
    turntable: int
    hdri_turn: int
    frame: int
    threads: int
    variant: str
