"""Settings of ReCon-GS; the defaults are the published values where a value is known."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gsstream.api import PartConfig


class MotionSettings(PartConfig):
    """Motion by anchors on several levels."""

    per_anchor: float = Field(default=24.0, ge=1, description="Gaussians per anchor of the finest level")
    levels: int = Field(default=3, ge=1, le=6, description="levels of anchors, whose motions add up")
    ratio: float = Field(default=3.0, ge=1, le=100, description="anchors of a level per anchor of the next coarser one")
    every: int = Field(default=2, ge=1, description="frames after which anchors are drawn anew")
    neighbours: int = Field(default=3, ge=1, le=100, description="old anchors from which a new one inherits")
    momentum: float = Field(default=0.6, ge=0, le=1, description="share of the last frame's motion to begin with")
    lr: float = Field(default=0.25, gt=0, le=10, description="step of the fit on each level, pixels per iteration")
    l1_weight: float = Field(default=0.0, ge=0, description="weight of the mean absolute motion, pixels, in the loss")
    measure: Literal["each", "anchor"] = Field(
        default="each",
        description="what a step is divided by; each: every number of an anchor by its own gradient (Adam); anchor: "
        "all six by the largest",
    )  # fmt: skip
    change: float = Field(
        default=0.0, ge=0, description="cells in what changed move alone: multiple of the noise of blocks; 0: all cells"
    )
    votes: float = Field(
        default=0.75, ge=0, le=1, description="share of its views in which a Gaussian must lie in what changed"
    )
    pixels: float = Field(
        default=6.0, gt=0, le=1000, description="side of the cells that follow anchors, pixels; their motion is sent"
    )
    step: float = Field(default=0.1, gt=0, le=10, description="quantisation step of shifts, pixels")
    rotation_step: float = Field(default=0.01, gt=0, le=1, description="quantisation step of turns, tan(angle / 2)")
    rounded: bool = Field(default=False, description="round every anchor's motion to these steps while it is fitted")


class BirthSettings(PartConfig):
    """Gaussians that a frame adds. As many of the least opaque leave in the next frame."""

    share: float = Field(default=0.5, ge=0, lt=1, description="share of a frame's passes that they get; 0: no births")
    rounds: int = Field(default=2, ge=1, le=10, description="times that the scene is searched for places")
    gradient: float = Field(
        default=2e-4, gt=0, description="mean screen gradient (half-width units) above which a Gaussian is copied"
    )
    most: int = Field(default=500, ge=0, le=100_000, description="births in one frame at most")
    prune_opacity: float = Field(default=0.01, ge=0, lt=1, description="births below this opacity are not sent, 0 to 1")


class ReConConfig(PartConfig):
    """Everything."""

    motion: MotionSettings = Field(default=MotionSettings(), description="anchors and what follows them")
    births: BirthSettings = Field(default=BirthSettings(), description="Gaussians that a frame adds")
