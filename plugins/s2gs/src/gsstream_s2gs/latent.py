"""Latent residuals: integers behind compact linear decoders."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

from pydantic import Field, model_validator

from gsstream.api import AttributeCode, PartConfig, UpdateRule

#: Attribute -> Adam learning rate of its decoder, raw units per iteration.
DECODER_LRS = {"quats": 1e-3, "scales": 1e-4, "opacities": 1e-4, "sh0": 1e-3, "shN": 1e-4}


class OffsetCode(PartConfig):
    """Position residual, coded directly."""

    step: float = Field(default=0.02, gt=0, le=10, description="quantisation step, cells of the anchor, up to 10")
    lr: float = Field(default=0.05, ge=0, le=10, description="Adam learning rate, cells per iteration; 0 freezes")


class LatentCode(PartConfig):
    """One attribute's latents and decoder."""

    latent: int = Field(ge=1, le=64, description="latent channels per Gaussian, 1 to 64")
    lr: float = Field(ge=0, le=10, description="Adam learning rate, latent units per iteration; 0 freezes")
    decoder_std: float = Field(
        gt=0, le=10, description="standard deviation of the decoder's initial entries, raw units per latent unit"
    )
    step: float = Field(
        default=1.0, gt=0, le=64, description="quantisation step of the latents; larger: fewer bits, coarser change"
    )


@final
class LatentResidual(UpdateRule):
    """a_t = a_{t-1} + g * (round(latents) W), positions without a decoder (paper: latents "following QUEEN").

    Sizes are the released ones: rotation 6 -> 4, size 8 -> 3, opacity 1 -> 1, colour 4 -> 3, higher colour 4 -> all.
    Decoders have no bias, so a Gaussian behind a closed gate keeps its bits (the released biases move every Gaussian in
    every frame). Rounding is real in the forward pass (the released code rounds only when it counts bits).

    Quantisation: latents are rounded to multiples of ``step`` while they are trained (straight-through), and the packet
    carries the multiples. A step changes how coarse a change is and nothing else: rates and scales are per latent unit.

    Rates and initial scales are ours, because the released ones cannot work with real rounding: at 0.001 to 0.0025 per
    iteration a latent does not reach 0.5, the first symbol, within a frame, and a released colour decoder (1e-4) turns
    one symbol into 3e-5 of colour, invisible in 8 bits. Here:

    * ``lr`` 0.1 to 1 symbol per iteration, so that a residual can move by several symbols within one pass over a rig.
      Measured on a real rig: at 0.025 to 0.05 the same gates lose 1.3 dB on moving pixels.
    * ``decoder_std``: one symbol is about half the smallest visible change: 0.01 in sh0 (0.7 of 255 grey levels), 0.005
      in a unit quaternion (half a degree), 0.01 in log size (1 %), 0.1 in the opacity logit (2.5 % at half opacity).
    * Higher colour moves more slowly: it costs most bits and explains least between two frames.
    """

    source = "S2GS, latents following QUEEN (Girish et al. 2024)"

    class Config(PartConfig):
        means: OffsetCode = Field(default=OffsetCode(), description="centres, in cells of the anchor")
        quats: LatentCode = Field(
            default=LatentCode(latent=6, lr=0.1, decoder_std=0.005),
            description="raw quaternion entries, no unit",
        )
        scales: LatentCode = Field(
            default=LatentCode(latent=8, lr=0.2, decoder_std=0.01),
            description="log standard deviations",
        )
        opacities: LatentCode = Field(
            default=LatentCode(latent=1, lr=1.0, decoder_std=0.1), description="opacity logits"
        )
        sh0: LatentCode = Field(
            default=LatentCode(latent=4, lr=0.2, decoder_std=0.01),
            description="degree-0 colour coefficients",
        )
        shN: LatentCode = Field(
            default=LatentCode(latent=4, lr=0.03, decoder_std=0.003),
            description="higher colour coefficients; absent at degree 0",
        )

        @model_validator(mode="before")
        @classmethod
        def _complete(cls, data: Any) -> Any:
            """``sh0: {lr: 0.05}`` changes one number and keeps the attribute's other defaults."""
            if not isinstance(data, dict):
                return data
            known = {name: field.default for name, field in cls.model_fields.items()}
            return {
                name: {**known[name].model_dump(), **value} if name in known and isinstance(value, dict) else value
                for name, value in data.items()
            }

    def codes(self) -> Mapping[str, AttributeCode]:
        """Attribute -> code; an attribute with ``lr`` 0 never changes."""
        entries = {"means": AttributeCode(step=self.config.means.step, lr=self.config.means.lr)}
        for name in DECODER_LRS:
            code: LatentCode = getattr(self.config, name)
            entries[name] = AttributeCode(
                step=code.step,
                lr=code.lr,
                latent=code.latent,
                decoder_lr=DECODER_LRS[name],
                decoder_std=code.decoder_std,
            )
        return {name: code for name, code in entries.items() if code.lr > 0}
