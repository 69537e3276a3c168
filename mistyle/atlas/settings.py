"""User settings of the texture sets."""

from pydantic import BaseModel, ConfigDict, Field


class AtlasSettings(BaseModel):
    """The texture sets that are painted (paper 4.1.4 uses 4096)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int = Field(default=2048, ge=16, le=16384, description="texels along each side of every texture set")
    padding: int = Field(default=16, ge=0, le=1024, description="texels by which islands are extended outwards")
