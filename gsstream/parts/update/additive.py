"""Additive residual: every attribute changes directly, quantised."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

from pydantic import Field

from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.part import PartConfig
from gsstream.parts.residual.layout import AttributeCode
from gsstream.parts.update.base import Scope, UpdateRule


class DirectCode(PartConfig):
    """Step and learning rate of one attribute."""

    step: float = Field(gt=0, description="quantisation step, raw units (means: fraction of the anchor's cell)")
    lr: float = Field(ge=0, description="Adam learning rate, same units per iteration; 0 freezes the attribute")


@final
class Additive(UpdateRule):
    """Adds the residual as it is: theta_t = theta_{t-1} + g * delta in raw parameter space."""

    source = "gsstream"

    class Config(PartConfig):
        means: DirectCode = Field(default=DirectCode(step=0.02, lr=0.1), description="centres, in cells")
        quats: DirectCode = Field(default=DirectCode(step=0.01, lr=0.005), description="raw quaternion entries")
        scales: DirectCode = Field(default=DirectCode(step=0.02, lr=0.02), description="log scales")
        opacities: DirectCode = Field(default=DirectCode(step=0.1, lr=0.15), description="opacity logits")
        sh0: DirectCode = Field(default=DirectCode(step=0.02, lr=0.02), description="degree-0 colour coefficients")
        shN: DirectCode = Field(default=DirectCode(step=0.01, lr=0.0005), description="higher colour coefficients")
        every: int = Field(
            default=1,
            ge=1,
            description="frames from one residual to the next, which above 1 is of all Gaussians; 1: of what changed",
        )

    def scope(self, frame: int) -> Scope:
        if self.config.every == 1:
            return Scope.CHANGED
        return Scope.ALL if frame % self.config.every == 0 else Scope.NONE

    def codes(self) -> Mapping[str, AttributeCode]:
        entries = {name: getattr(self.config, name) for name in ATTRIBUTES}
        return {name: AttributeCode(step=c.step, lr=c.lr) for name, c in entries.items() if c.lr > 0}
