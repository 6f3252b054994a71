"""Settings of 3DGStream; the defaults are the published values where a value is known."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gsstream.api import PartConfig


class CacheSettings(PartConfig):
    """The neural transformation cache: a hash grid behind a small network."""

    levels: int = Field(default=16, ge=1, le=16, description="resolutions of the hash grid")
    entries: int = Field(default=15, ge=4, le=20, description="log2 of the entries of a resolution")
    features: int = Field(default=4, ge=1, le=8, description="numbers of an entry")
    base: int = Field(default=16, ge=2, le=1024, description="cells along an axis at the coarsest resolution")
    growth: float = Field(default=2.0, ge=1, le=4, description="ratio from one resolution to the next")
    width: int = Field(default=64, ge=4, le=128, description="neurons of each of the two hidden layers")
    lr: float = Field(default=2e-3, gt=0, le=1, description="Adam learning rate of all weights")
    reach: float = Field(default=0.1, gt=0, description="shift of one unit of the network, fraction of the extent")
    box: float = Field(
        default=0.02, ge=0, lt=0.5, description="share of the Gaussians left out at both ends of each axis of the box"
    )
    change: float = Field(
        default=6.0, ge=0, description="what changed moves alone: multiple of the noise of blocks; 0: all in the box"
    )
    votes: float = Field(
        default=0.75, ge=0, le=1, description="share of its views in which a Gaussian must lie in what changed"
    )
    sent: Literal["field", "cells"] = Field(
        default="field", description="field: the weights, as published; cells: rigid motions of cells, far fewer bytes"
    )
    entry_step: float = Field(default=0.05, gt=0, le=1, description="quantisation step of the grid's entries")
    weight_step: float = Field(default=0.02, gt=0, le=1, description="quantisation step of the network's weights")
    rounded: float = Field(
        default=0.5, ge=0, le=1, description="share of the passes, the last, that learn with rounded weights"
    )
    pixels: float = Field(
        default=6.0, gt=0, le=1000, description="sent as cells: side of a cell, pixels"
    )
    step: float = Field(default=0.1, gt=0, le=10, description="sent as cells: quantisation step, pixels")


class BirthSettings(PartConfig):
    """Gaussians that live for one frame."""

    share: float = Field(default=0.4, ge=0, lt=1, description="share of a frame's passes that they get; 0: none")
    rounds: int = Field(default=2, ge=1, le=10, description="times that the scene is searched for places")
    gradient: float = Field(
        default=1.5e-4, gt=0, description="mean screen gradient (half-width units) above which a Gaussian is copied"
    )
    most: int = Field(default=500, ge=0, le=100_000, description="births in one frame at most")
    prune_opacity: float = Field(default=0.01, ge=0, lt=1, description="births below this opacity are not sent, 0 to 1")


class Stream3DGSConfig(PartConfig):
    """Everything."""

    cache: CacheSettings = Field(default=CacheSettings(), description="what moves Gaussians")
    births: BirthSettings = Field(default=BirthSettings(), description="what a frame adds for itself")
