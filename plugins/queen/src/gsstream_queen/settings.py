"""Settings of attributes, gates, mask and densification. Defaults are the published values."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from gsstream.api import PartConfig


class PositionPolicy(PartConfig):
    """Centres: a direct residual behind a gate per Gaussian."""

    policy: Literal["gated", "direct", "frozen"] = Field(
        default="gated", description="gated: published; direct: without gates; frozen: centres never move"
    )
    step: float = Field(
        default=1e-4, gt=0, le=1, description="quantisation step, rig extents, to 1 (published: float32)"
    )
    lr: float = Field(default=1.6e-4, ge=0, le=1, description="Adam learning rate, rig extents per iteration, to 1")


class LatentPolicy(PartConfig):
    """One attribute behind integer latents and a linear decoder."""

    policy: Literal["latent", "frozen"] = Field(default="latent", description="latent: coded; frozen: never changes")
    latent: int = Field(ge=1, le=64, description="latent channels per Gaussian, 1 to 64")
    lr: float = Field(ge=0, le=10, description="Adam learning rate of the latents, symbols per iteration, to 10")


class ChangeSettings(PartConfig):
    """The view-space gradient difference, and its threshold above which a Gaussian is dynamic."""

    loss: Literal["mse", "l2norm"] = Field(
        default="mse", description="E; mse: published; l2norm: mean Euclidean distance of pixel colours"
    )
    aggregate: Literal["mean-vector", "sum-of-norms"] = Field(
        default="mean-vector", description="over views; mean-vector: norm of the mean gradient, published"
    )
    dynamic: float = Field(
        default=3.5e-6,
        ge=0,
        le=1e6,
        description="difference above which a Gaussian is dynamic, to 1e6; in the units of loss and aggregate",
    )


class GateSettings(PartConfig):
    """Hard-concrete gates (Louizos et al. 2018), without noise."""

    temperature: float = Field(default=0.3, ge=0.01, le=10, description="temperature, 0.01 to 10")
    lr: float = Field(default=0.1, ge=0, le=10, description="Adam learning rate of the logits, to 10")
    l0: float = Field(default=0.01, ge=0, le=100, description="weight of the probability to be open, to 100")
    l0_over: Literal["sum", "mean"] = Field(
        default="sum", description="of the probabilities of all Gaussians; sum: published; mean: their sum divided by N"
    )


class MaskSettings(PartConfig):
    """The first iterations of a frame compare only the tiles that changed."""

    share: float = Field(default=0.3, ge=0, le=1, description="share of a frame's iterations that are masked, 0 to 1")


class GrowthSettings(PartConfig):
    """Masked densification: dynamic Gaussians with a large screen gradient are cloned or split."""

    every: int = Field(default=2, ge=0, le=1000, description="epochs between two densifications, to 1000; 0: none")
    start: float = Field(default=0.04, ge=0, le=1, description="share of the epochs before the first one, 0 to 1")
    stop: float = Field(default=0.8, ge=0, le=1, description="share of the epochs after which there is none, 0 to 1")
    grad_threshold: float = Field(
        default=1.25e-3,
        gt=0,
        le=10,
        description="mean screen gradient above which a Gaussian is densified, half image widths, to 10",
    )
    max_added: int = Field(default=1000, ge=0, le=1_000_000, description="most Gaussians that a frame adds, to 1000000")
    prune_opacity: float = Field(
        default=0.005, ge=0, lt=1, description="dynamic and new Gaussians below this opacity leave, 0 to 1 (3DGS)"
    )


class QueenConfig(PartConfig):
    """All settings of the method."""

    means: PositionPolicy = Field(default=PositionPolicy(), description="centres")
    quats: LatentPolicy = Field(default=LatentPolicy(latent=6, lr=0.025), description="raw quaternions")
    scales: LatentPolicy = Field(default=LatentPolicy(latent=8, lr=0.01), description="log sizes")
    opacities: LatentPolicy = Field(
        default=LatentPolicy(latent=3, lr=0.05),
        description="opacity logits",
    )
    sh0: LatentPolicy = Field(default=LatentPolicy(latent=8, lr=0.0125), description="degree-0 colour")
    shN: LatentPolicy = Field(default=LatentPolicy(latent=4, lr=0.000625), description="higher colour")
    gate: GateSettings = Field(default=GateSettings(), description="gates of positions")
    mask: MaskSettings = Field(default=MaskSettings(), description="masked first part of a frame")
    growth: GrowthSettings = Field(default=GrowthSettings(), description="masked densification")
    change: ChangeSettings = Field(default=ChangeSettings(), description="what changed")
    sigma: float = Field(
        default=0.0,
        ge=0,
        le=1e6,
        description="weight of the mean standard deviation of the latents' channels, symbols, to 1e6; published, but "
        "its value is not known to us",
    )
    rate: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="weight of the latents' bits per training pixel, as stream.rd_lambda (ours), to 10",
    )
    rows: Literal["all", "dynamic"] = Field(
        default="all", description="which Gaussians are trained; all: published; dynamic: only those"
    )

    @model_validator(mode="after")
    def _order(self) -> QueenConfig:
        if self.growth.start > self.growth.stop:
            raise ValueError(
                f"growth: expected start <= stop, got {self.growth.start} and {self.growth.stop}; "
                "every: 0 switches it off"
            )
        return self

    def latents(self) -> dict[str, LatentPolicy]:
        """Attribute -> policy of those that are coded as latents."""
        known = {name: getattr(self, name) for name in ("quats", "scales", "opacities", "sh0", "shN")}
        return {name: policy for name, policy in known.items() if policy.policy == "latent" and policy.lr > 0}
