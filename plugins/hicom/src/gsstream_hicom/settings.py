"""Settings of HiCoM; the defaults are the published values where a value is known."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gsstream.api import PartConfig


class MotionSettings(PartConfig):
    """Hierarchical coherent motion."""

    levels: int = Field(default=3, ge=1, le=6, description="nested grids; each has cells twice as wide as the next")
    per_cell: float = Field(default=5.0, gt=0, description="Gaussians per cell of the finest grid, on average")
    momentum: float = Field(default=0.6, ge=0, le=1, description="share of the last frame's motion to begin with")
    lr: float = Field(default=0.25, gt=0, le=10, description="step of the fit, pixels per iteration")
    l1_weight: float = Field(default=0.0, ge=0, description="weight of the mean absolute motion, pixels, in the loss")
    step: float = Field(default=0.1, gt=0, le=10, description="quantisation step, pixels")
    measure: Literal["each", "cell"] = Field(
        default="each",
        description="what a step is divided by; each: every number of a cell by its own slope (Adam); cell: all six by "
        "the largest",
    )  # fmt: skip
    change: float = Field(
        default=0.0, ge=0, description="cells in what changed move alone: multiple of the noise of blocks; 0: all cells"
    )
    votes: float = Field(
        default=0.75, ge=0, le=1, description="share of its views in which a Gaussian must lie in what changed"
    )


class BirthSettings(PartConfig):
    """Gaussians that a frame adds. As many of the least opaque leave in the next frame."""

    share: float = Field(default=0.5, ge=0, lt=1, description="share of a frame's passes that they get; 0: no births")
    rounds: int = Field(default=2, ge=1, le=10, description="times that the scene is searched for places")
    gradient: float = Field(
        default=2e-4, gt=0, description="mean screen gradient (half-width units) above which a Gaussian is copied"
    )
    most: int = Field(default=500, ge=0, le=100_000, description="births in one frame at most")
    prune_opacity: float = Field(default=0.01, ge=0, lt=1, description="births below this opacity are not sent, 0 to 1")


class HiCoMConfig(PartConfig):
    """Everything."""

    motion: MotionSettings = Field(default=MotionSettings(), description="cells that move")
    births: BirthSettings = Field(default=BirthSettings(), description="Gaussians that a frame adds")
