"""The base of all records that users write (settings, jobs, sheets), and the settings of the views' cameras."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class FrozenModel(BaseModel):
    """Read once and never changed; unknown names are refused. A field's docstring is its description."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class RigSettings(FrozenModel):
    """Camera positions of the views (paper 4.1.1)."""

    kind: Literal["paper", "turntable", "nbv", "file"] = "paper"
    """'nbv': as few views as the mesh needs (next best view)"""
    file: Path | None = None
    """for kind 'file': a camera.json or transforms.json in working units"""
    views: int = Field(default=16, ge=1, le=256)
    """number of turntable views; the paper's rig always has 16"""
    distance: float = Field(default=4.0, gt=1.0)
    """camera distance; the mesh has bounding-sphere radius 1"""
    fov: float = Field(default=30.0, gt=1.0, lt=120.0)
    """vertical and horizontal field of view, degrees"""
    resolution: int = Field(default=1024, ge=16, le=8192)
    """pixels along each side"""
    most_views: int = Field(default=32, ge=1, le=256)
    """for kind 'nbv': the most views"""
    facing: float = Field(default=0.4, gt=0.0, lt=1.0)
    """for kind 'nbv': every surface point needs a view at this cosine or more"""
    overlap: float = Field(default=0.4, ge=0.0, lt=1.0)
    """for kind 'nbv': the least overlap of neighbouring views, a share of their points"""
    candidates: int = Field(default=500, ge=4, le=4096)
    """for kind 'nbv': cameras to choose from"""
