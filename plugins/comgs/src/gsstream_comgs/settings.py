"""Settings of ComGS; the defaults are the published values where a value is known."""

from __future__ import annotations

from pydantic import Field

from gsstream.api import PartConfig


class MotionSettings(PartConfig):
    """Key points and what they move."""

    keypoints: int = Field(default=200, ge=1, le=10_000, description="key points in a frame at most")
    change: float = Field(
        default=6.0, ge=0, description="key points move what changed alone: multiple of the noise of blocks; 0: all"
    )
    votes: float = Field(
        default=0.75, ge=0, le=1, description="share of its views in which a Gaussian must lie in what changed"
    )
    lr: float = Field(default=0.25, gt=0, le=10, description="step of shifts and turns, pixels per iteration")
    lr_influence: float = Field(default=0.02, gt=0, le=1, description="step of influences: log size, quaternion")
    pixels: float = Field(
        default=6.0, gt=0, le=1000, description="side of the cells as whose rigid motions the field is sent, pixels"
    )
    step: float = Field(default=0.1, gt=0, le=10, description="quantisation step, pixels")


class CorrectionSettings(PartConfig):
    """Corrections at key frames."""

    every: int = Field(default=10, ge=1, description="frames from one to the next (paper: 10 for -s, 2 for -l)")
    passes: float = Field(
        default=6.7, gt=0, le=100, description="passes, times those of another frame (paper: 1,000 : 150 iterations)"
    )
    share: float = Field(
        default=0.3, gt=0, le=1, description="share of the Gaussians that may be corrected: those in the largest error"
    )
    mask_weight: float = Field(default=1e-3, ge=0, description="weight of the mean of the mask in the loss")
    mask_lr: float = Field(default=0.05, gt=0, le=10, description="Adam learning rate of the mask's logits")
    means_step: float = Field(default=2e-4, gt=0, description="quantisation step of centres, fraction of the extent")
    step: float = Field(default=0.02, gt=0, description="quantisation step of all other attributes, raw values")


class ComGSConfig(PartConfig):
    """Everything."""

    motion: MotionSettings = Field(default=MotionSettings(), description="key points and what they move")
    correction: CorrectionSettings = Field(default=CorrectionSettings(), description="key frames")
