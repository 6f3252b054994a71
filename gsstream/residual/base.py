"""UpdateRule: which attributes change, in which latent space, at which quantisation step.

An internal seam, not yet a public component kind. The training forward pass here and ``core.delta.apply_delta`` (the
transmitted truth, numpy) compute the same map; a test holds them together.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import Part

#: Largest magnitude of a symbol: the last up to which float32, in which symbols are decoded, tells neighbours apart.
MAX_SYMBOL = 1 << 24


@dataclass(frozen=True, slots=True)
class AttributeCode:
    """How the residual of one attribute is represented.

    Arguments:
        step: quantisation step in latent units (position: fraction of the anchor's cell).
        lr: Adam learning rate of the latents, latent units per iteration.
        latent: number of latent channels; 0 means identity (one latent per feature, no decoder).
        decoder_lr: Adam learning rate of the linear decoder.
        decoder_std: standard deviation of the decoder's initial entries.
    """

    step: float
    lr: float
    latent: int = 0
    decoder_lr: float = 0.0
    decoder_std: float = 0.0


class UpdateRule(Part):
    """a_t = a_{t-1} + g * (quantised latents) W, on raw attributes; position residuals in units of the cell."""

    @abstractmethod
    def codes(self) -> Mapping[str, AttributeCode]:
        """Attribute name -> code; an attribute left out never changes."""

    def init_decoders(self, gaussians: Gaussians[torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
        """[L, D] decoder of every attribute that has one, drawn at the key packet."""
        decoders = {}
        for name, code in self.codes().items():
            width = _width(gaussians, name)
            if code.latent and width:
                decoders[name] = torch.randn(code.latent, width, generator=generator) * code.decoder_std
        return decoders


def _width(gaussians: Gaussians[torch.Tensor], name: str) -> int:
    value: torch.Tensor = getattr(gaussians, name)
    return int(value[0].numel()) if len(value) else int(torch.tensor(value.shape[1:]).prod())


def init_latents(rule: UpdateRule, base: Gaussians[torch.Tensor]) -> dict[str, torch.Tensor]:
    """Zero latents [A, L] for the rows of ``base``; attributes of width 0 (no higher SH) are left out."""
    return {
        name: torch.zeros(len(base), code.latent or _width(base, name))
        for name, code in rule.codes().items()
        if _width(base, name)
    }


def quantise(latents: torch.Tensor, step: float) -> torch.Tensor:
    """Round to multiples of ``step`` with a straight-through gradient (ours; the released code never rounds here).

    The value is exactly symbol * step, as the decoder has it: latents - latents is 0, whereas latents plus the rounding
    error would be an ulp off.
    """
    return torch.round(latents.detach() / step) * step + (latents - latents.detach())


class Change(NamedTuple):
    """One attribute's ungated residual: quantised latents [A, L] and what they decode to [A, D]."""

    latents: torch.Tensor
    decoded: torch.Tensor


def decode_changes(
    rule: UpdateRule, latents: Mapping[str, torch.Tensor], decoders: Mapping[str, torch.Tensor]
) -> dict[str, Change]:
    """Attribute -> quantised and decoded residual."""
    codes = rule.codes()
    quantised = {name: quantise(latent, codes[name].step) for name, latent in latents.items()}
    return {name: Change(q, q @ decoders[name] if name in decoders else q) for name, q in quantised.items()}


def add_changes(
    base: Gaussians[torch.Tensor], changes: Mapping[str, Change], gates: torch.Tensor, units: torch.Tensor
) -> Gaussians[torch.Tensor]:
    """a_t = a_{t-1} + g * change; position changes are in cells, ``units`` [A] scene units."""
    changed = dict(base.items())
    for name, change in changes.items():
        scale = gates * units if name == "means" else gates
        value = changed[name]
        changed[name] = value + (change.decoded * scale[:, None]).reshape(value.shape)
    return Gaussians(**changed)


def apply_residual(
    rule: UpdateRule,
    base: Gaussians[torch.Tensor],
    gates: torch.Tensor,
    latents: Mapping[str, torch.Tensor],
    decoders: Mapping[str, torch.Tensor],
    units: torch.Tensor,
) -> Gaussians[torch.Tensor]:
    """Gated, quantised, decoded residual on the A rows of ``base``; differentiable.

    Arguments:
        gates: [A] in [0, 1].
        latents: attribute -> [A, L].
        decoders: attribute -> [L, D].
        units: [A] cell of each anchor, scene units.
    """
    return add_changes(base, decode_changes(rule, latents, decoders), gates, units)


def coarser(codes: Mapping[str, AttributeCode], factor: float) -> Mapping[str, AttributeCode]:
    """The same codes with steps ``factor`` times as large."""
    return {name: replace(code, step=code.step * factor) for name, code in codes.items()} if factor != 1 else codes


def symbols(codes: Mapping[str, AttributeCode], latents: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """[A, L] int32 symbols that the packet carries.

    Raises ShapeError for latents that are not finite or beyond MAX_SYMBOL steps, whose integers would be arbitrary.
    """
    return {name: _integers(name, value.detach() / codes[name].step) for name, value in latents.items()}


def _integers(name: str, scaled: torch.Tensor) -> torch.Tensor:
    rounded = torch.round(scaled)
    bad = ~(rounded.abs() <= MAX_SYMBOL)
    if bool(bad.any()):
        row, channel = bad.nonzero()[0].tolist()
        raise ShapeError(
            f"latents of {name}: expected at most {MAX_SYMBOL} quantisation steps, got {float(scaled[row, channel]):g} "
            f"in row {row}, channel {channel} ({int(bad.sum())} of {bad.numel()} values); the optimisation has "
            "diverged, lower its learning rate"
        )
    return rounded.to(torch.int32)
