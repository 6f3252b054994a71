"""Settings of QuARC-GS; the defaults are the published values where a value is known."""

from __future__ import annotations

from gsstream_recon.settings import ReConConfig
from pydantic import Field

from gsstream.api import PartConfig


class GateSettings(PartConfig):
    """Where Gaussians may be born."""

    views: int = Field(default=4, ge=1, description="training cameras, spread over the rig, whose change counts")
    score: float = Field(
        default=0.5, ge=0, lt=1, description="least change score g / (g + median) of a place; 0: everywhere"
    )
    per_cell: int = Field(default=4, ge=1, description="births in a cell of a grid at most")
    pixels: float = Field(default=6.0, gt=0, le=1000, description="side of these cells, pixels")


class QuARCConfig(ReConConfig):
    """Everything."""

    gate: GateSettings = Field(default=GateSettings(), description="where they may be born")
