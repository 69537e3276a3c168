"""Settings that several kinds of job share: reading the mesh, and the pictures of the report."""

from typing import Literal

from pydantic import Field

from mistyle.core.settings import FrozenModel

LEAST_OVERLAP = 0.8  # of the mesh's outline with alpha or masks, below which a camera does not fit


class ReadSettings(FrozenModel):
    """Settings of reading the mesh."""

    uv: Literal["keep", "new", "auto"] = "auto"
    """authored UVs: keep, replace, or replace where unusable"""
    # core/asset.py's UpAxis, whose module loads numpy; settings are read without it.
    up: Literal["y", "z", "-y", "-z"] = "y"
    """the axis of the user's file that points up"""
    max_faces: int = Field(default=5_000_000, ge=1)
    """meshes with more faces are refused"""
    lit: bool = False
    """unlit glTF materials become lit ones in the asset"""


class ReportSettings(FrozenModel):
    """The pictures of the report."""

    detail: Literal["none", "page", "full"] = "full"
    """full: page, turntable frames and a path-traced picture; page: the page and its overview; none: no report"""
    frames: int = Field(default=24, ge=4, le=240)
    """turntable frames"""
    resolution: int = Field(default=448, ge=64, le=4096)
    """pixels of a turntable frame"""
    spp: int = Field(default=8, ge=1, le=4096)
    """samples per pixel of a turntable frame"""
