"""Saboteurs of the checks of update rules, and of what a renderer brings: its loss and its row optimiser."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch

from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.render.loss import ReferenceLoss
from gsstream.parts.residual.layout import AttributeCode, JointLayout
from gsstream.parts.residual.optimiser import ResidualEpoch, ResidualOptimiser
from gsstream.parts.residual.reference import JointResidualOptimiser
from gsstream.testing.examples.update import ExampleUpdate
from saboteurs.register import spoils

# They are final; only a saboteur may inherit from them, and only behind the type checker's back.
Update: Any = ExampleUpdate
Reference: Any = ReferenceRenderer
Loss: Any = ReferenceLoss
Adam: Any = ReferenceAdam


def brought(check: str) -> Callable[[type], type]:
    """Enter a renderer with this loss, or this row optimiser, as the saboteur of a check."""

    def enter(cls: type) -> type:
        name = "loss" if issubclass(cls, ReferenceLoss) else "optimiser"
        body = {name: property(lambda _: cls()), "__doc__": cls.__doc__, "__module__": __name__}
        globals()[f"Brings{cls.__name__}"] = spoils(check)(type(f"Brings{cls.__name__}", (Reference,), body))
        return cls

    return enter


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


@brought("check_loss_reference")
class AlwaysSome(Loss):
    """Never less than a tenth of L1, whatever the weight of SSIM."""

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        evaluated: tuple[torch.Tensor, torch.Tensor] = super().evaluate(image, prepared, min(dssim, 0.9), tile_mask)
        return evaluated


@brought("check_loss_mask")
class MeanOfMarked(Loss):
    """Divides by the number of marked tiles, not by that of all."""

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        value, gradient = super().evaluate(image, prepared, dssim, tile_mask)
        marked = 1.0 if tile_mask is None else max(float(tile_mask.float().mean()), 1 / tile_mask.numel())
        return value / marked, gradient


@brought("check_loss_bytes")
class Shifted(Loss):
    """Takes 256 for the byte that means white."""

    def prepare(self, target: torch.Tensor) -> Any:
        return super().prepare(target if target.is_floating_point() else target.float() / 256)


@brought("check_loss_pure")
class Scribbler(Loss):
    """Darkens the image once it has compared it."""

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        evaluated: tuple[torch.Tensor, torch.Tensor] = super().evaluate(image, prepared, dssim, tile_mask)
        image.detach().mul_(0.5)
        return evaluated


@brought("check_optimiser_adam")
class Halved(Adam):
    """Rates by column count half."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        halved = {n: 0.5 * r if isinstance(r, torch.Tensor) and r.dim() == 1 else r for n, r in lrs.items()}
        super().step(values, gradients, states, halved)


@brought("check_optimiser_ahead")
class Behind(Adam):
    """Goes by the mean so far where it should look ahead."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        super().step(values, gradients, {n: replace(state, ahead=False) for n, state in states.items()}, lrs)


@brought("check_optimiser_rows")
class OneCount(Adam):
    """One count of steps for all rows."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        for name in gradients:
            states[name].steps[:] = states[name].steps.max() if len(states[name].steps) else 0
        super().step(values, gradients, states, lrs)


@brought("check_optimiser_refuses")
class Forgiving(Adam):
    """Leaves a table out whose gradient is not finite, and says nothing."""

    def step(self, values: Any, gradients: Any, states: Any, lrs: Any) -> None:
        sound = {name: value for name, value in gradients.items() if bool(torch.isfinite(value).all())}
        super().step(values, sound, states, lrs)


@brought("check_residual_optimiser")
class Hurried(Adam):
    """Its own residual optimiser learns at twice the rates."""

    def residual_optimiser(self, code: JointLayout, *start: Any) -> JointResidualOptimiser:
        return JointResidualOptimiser(replace(code, lrs=2 * code.lrs), *start, self)


Joint: Any = JointResidualOptimiser


class _Thaws(Joint):
    def run(self, epoch: ResidualEpoch[Any]) -> list[torch.Tensor]:
        iterations = [now._replace(frozen=None) for now in epoch.iterations]
        losses: list[torch.Tensor] = super().run(replace(epoch, iterations=iterations))
        return losses


@brought("check_residual_optimiser_run")
class Thawed(Adam):
    """Its own iterations train rows that are to wait."""

    def residual_optimiser(self, code: JointLayout, *start: Any) -> ResidualOptimiser[Any]:
        made: ResidualOptimiser[Any] = _Thaws(code, *start, self)
        return made
