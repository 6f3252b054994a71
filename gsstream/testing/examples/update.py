"""Motion and colour alone: shapes and opacities keep still."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

from pydantic import Field

from gsstream.api import AttributeCode, PartConfig, UpdateRule


@final
class ExampleUpdate(UpdateRule):
    """Positions directly, degree-0 colour through a latent channel and a linear decoder, nothing else."""

    source = "gsstream"

    class Config(PartConfig):
        move: float = Field(default=0.02, gt=0, le=1, description="quantisation step of positions, cells")
        tint: float = Field(default=0.02, gt=0, le=1, description="quantisation step of colour latents, no unit")
        channels: int = Field(default=2, ge=1, le=3, description="latent channels of colour")

    def codes(self) -> Mapping[str, AttributeCode]:
        colour = AttributeCode(
            step=self.config.tint, lr=0.02, latent=self.config.channels, decoder_lr=0.001, decoder_std=0.3
        )
        return {"means": AttributeCode(step=self.config.move, lr=0.1), "sh0": colour}
