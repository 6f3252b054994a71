"""Saboteurs of the checks of update rules, losses and optimisers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from gsstream.parts.loss.base import LossTraits
from gsstream.parts.optimiser.adam import ReferenceAdam
from gsstream.parts.residual.layout import AttributeCode, JointLayout
from gsstream.parts.residual.optimiser import ResidualEpoch, ResidualOptimiser
from gsstream.parts.residual.reference import JointResidualOptimiser
from gsstream.testing.examples.update import ExampleUpdate
from gsstream.testing.loss.example import ExampleLoss
from saboteurs.register import spoils

# They are final; only a saboteur may inherit from them, and only behind the type checker's back.
Update: Any = ExampleUpdate
Loss: Any = ExampleLoss
Adam: Any = ReferenceAdam


@spoils("check_update_codes")
class Backwards(Update):
    """Positions go uphill: a negative learning rate."""

    def codes(self) -> Mapping[str, AttributeCode]:
        codes: Mapping[str, AttributeCode] = super().codes()
        return {**codes, "means": replace(codes["means"], lr=-0.1)}


@spoils("check_update_decoders")
class Unseeded(Update):
    """Decoders that are the same whatever the seed."""

    def init_decoders(self, gaussians: Any, generator: torch.Generator) -> dict[str, torch.Tensor]:
        decoders: dict[str, torch.Tensor] = super().init_decoders(gaussians, torch.Generator().manual_seed(1))
        return decoders


@spoils("check_update_closed_loop")
class Loud(Update):
    """Decoders beyond what the packet's float16 can hold."""

    def codes(self) -> Mapping[str, AttributeCode]:
        codes: Mapping[str, AttributeCode] = super().codes()
        return {**codes, "sh0": replace(codes["sh0"], decoder_std=1e6)}


@spoils("check_loss_reference")
class AlwaysSome(Loss):
    """Never less than a tenth of L1, whatever the weight of SSIM."""

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        evaluated: tuple[torch.Tensor, torch.Tensor] = super().evaluate(image, prepared, min(dssim, 0.9), tile_mask)
        return evaluated


@spoils("check_loss_mask")
class EmptyIsAll(Loss):
    """Takes a mask without tiles for no mask."""

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        mask = tile_mask if tile_mask is not None and bool(tile_mask.any()) else None
        evaluated: tuple[torch.Tensor, torch.Tensor] = super().evaluate(image, prepared, dssim, mask)
        return evaluated


@spoils("check_loss_bytes")
class Shifted(Loss):
    """Takes 256 for the byte that means white."""

    traits = LossTraits(takes_bytes=True)

    def prepare(self, target: torch.Tensor) -> Any:
        return super().prepare(target if target.is_floating_point() else target.float() / 256)


@spoils("check_loss_pure")
class Scribbler(Loss):
    """Darkens the image once it has compared it."""

    traits = LossTraits()  # of no other check

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        evaluated: tuple[torch.Tensor, torch.Tensor] = super().evaluate(image, prepared, dssim, tile_mask)
        image.detach().mul_(0.5)
        return evaluated


@spoils("check_optimiser_adam")
class Halved(Adam):
    """Rates by column count half."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        halved = {n: 0.5 * r if isinstance(r, torch.Tensor) and r.dim() == 1 else r for n, r in lrs.items()}
        super().step(values, gradients, states, halved)


@spoils("check_optimiser_rows")
class OneCount(Adam):
    """One count of steps for all rows."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        for name in gradients:
            states[name].steps[:] = states[name].steps.max() if len(states[name].steps) else 0
        super().step(values, gradients, states, lrs)


@spoils("check_optimiser_refuses")
class Forgiving(Adam):
    """Leaves a table out whose gradient is not finite, and says nothing."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        sound = {name: value for name, value in gradients.items() if bool(torch.isfinite(value).all())}
        super().step(values, sound, states, lrs)


@spoils("check_residual_optimiser")
class Hurried(Adam):
    """Its own residual optimiser learns at twice the rates."""

    def residual_optimiser(self, code: JointLayout, *start: Any) -> JointResidualOptimiser:
        return JointResidualOptimiser(replace(code, lrs=2 * code.lrs), *start, self)


Joint: Any = JointResidualOptimiser


class _Thaws(Joint):
    def run(self, epoch: ResidualEpoch) -> list[torch.Tensor]:
        iterations = [now._replace(frozen=None) for now in epoch.iterations]
        losses: list[torch.Tensor] = super().run(replace(epoch, iterations=iterations))
        return losses


@spoils("check_residual_optimiser_run")
class Thawed(Adam):
    """Its own iterations train rows that are to wait."""

    def residual_optimiser(self, code: JointLayout, *start: Any) -> ResidualOptimiser:
        made: ResidualOptimiser = _Thaws(code, *start, self)
        return made
