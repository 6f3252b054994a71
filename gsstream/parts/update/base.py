"""UpdateRule: which attributes change, in which latent space, at which quantisation step.

The interface may change with a minor version. Training applies a residual by ``gsstream.parts.residual.decode``
(torch, with its gradient written out), encoder and player by ``core.changes.apply_residual`` (numpy, from the integers
that are sent); ``check_update_closed_loop`` of the contract kit compares the two.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from enum import Enum

import torch

from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import Part
from gsstream.parts.residual.layout import AttributeCode, width_of

#: Largest magnitude of a symbol: up to it float32, in which symbols are decoded, represents every integer exactly.
MAX_SYMBOL = 1 << 24


class Scope(Enum):
    """Which Gaussians may have a residual in a frame: none, those in what changed, or all."""

    NONE = "none"
    CHANGED = "changed"
    ALL = "all"


class UpdateRule(Part):
    """Which attributes a residual may change, and how: a_t = a_{t-1} + g * (quantised latents) W, on raw attributes.

    Position residuals are measured in the unit of each Gaussian.
    """

    @abstractmethod
    def codes(self) -> Mapping[str, AttributeCode]:
        """Return attribute name -> code; an attribute that is left out never changes."""

    def scope(self, frame: int) -> Scope:
        """Return which Gaussians may have a residual in a frame; it follows from the frame's index and the settings.

        With ``ALL`` a frame in which nothing changed is optimised, too; with ``NONE`` neither confidence nor gate is
        called.
        """
        return Scope.CHANGED

    def init_decoders(self, gaussians: Gaussians[torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Return the decoder [L, D] of every attribute that has one, drawn at the key packet."""
        decoders = {}
        for name, code in self.codes().items():
            width = width_of(getattr(gaussians, name))
            if code.latent and width:
                decoders[name] = torch.randn(code.latent, width, generator=generator) * code.decoder_std
        return decoders


def init_latents(codes: Mapping[str, AttributeCode], base: Gaussians[torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return zero latents [A, L] for the rows of ``base``; attributes of width 0 (no higher SH) are left out."""
    latents = {}
    for name, code in codes.items():
        width = width_of(getattr(base, name))
        if width:
            latents[name] = base.means.new_zeros(len(base), code.latent or width)
    return latents


def scale_steps(codes: Mapping[str, AttributeCode], factor: float) -> Mapping[str, AttributeCode]:
    """Return the same codes with steps ``factor`` times as large."""
    return {name: replace(code, step=code.step * factor) for name, code in codes.items()} if factor != 1 else codes


def quantise_latents(
    codes: Mapping[str, AttributeCode], latents: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Return the [A, L] int32 symbols that the packet carries.

    Raises ShapeError for latents that are not finite or beyond MAX_SYMBOL steps, whose integers would be arbitrary.
    """
    symbols = {}
    for name, value in latents.items():
        scaled = value.detach() / codes[name].step
        rounded = torch.round(scaled)
        bad = ~(rounded.abs() <= MAX_SYMBOL)
        if bool(bad.any()):
            row, channel = bad.nonzero()[0].tolist()
            raise ShapeError(
                f"latents of {name}: expected at most {MAX_SYMBOL} quantisation steps, got "
                f"{float(scaled[row, channel]):g} in row {row}, channel {channel} ({int(bad.sum())} of {bad.numel()} "
                "values); the optimisation has diverged, lower its learning rate"
            )
        symbols[name] = rounded.to(torch.int32)
    return symbols
