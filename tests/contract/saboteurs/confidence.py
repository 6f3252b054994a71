"""Saboteurs of the checks of confidence estimators."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.testing.examples.confidence import ExampleConfidence
from saboteurs.register import spoils

Confidence: Any = ExampleConfidence
LINE = 20


def _largest_change(context: Any) -> float:
    views = range(len(context.cameras))
    return max((float((context.image(v) - context.previous_image(v)).abs().max()) for v in views), default=0.0)


@spoils("check_confidence_range")
class Double(Confidence):
    """Double precision for a line."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return logits.double() if len(logits) == LINE else logits


@spoils("check_confidence_static_frame")
class Alarmist(Confidence):
    """More than the floor where nothing changed, like the printed formula, which gives p = 0.5."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return logits + 0.5 * (len(context.cameras) > 0 and _largest_change(context) == 0)


@spoils("check_confidence_unseen")
class Guesser(Confidence):
    """Half sure about Gaussians that nobody sees."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return torch.where(context.gaussians.means[:, 1].detach() > 5, torch.zeros_like(logits), logits)


@spoils("check_confidence_view_order")
class LastViewCounts(Confidence):
    """What the last camera sees counts most."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        if len(context.cameras) == 0:
            return logits
        last = len(context.cameras) - 1
        change = context.image(last) - context.previous_image(last)
        return logits - 0.2 * float(change.abs().mean())


@spoils("check_confidence_finds_motion")
class Asleep(Confidence):
    """Suspects nothing."""

    def estimate(self, context: Any) -> torch.Tensor:
        return torch.full_like(context.gaussians.opacities, float(self.config.floor))


@spoils("check_confidence_monotone_in_change")
class Timid(Confidence):
    """The larger the change, the less sure."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return torch.where(logits > self.config.floor, logits - 2 * _largest_change(context), logits)


@spoils("check_confidence_no_grad_left")
class Tracked(Confidence):
    """The result hangs on the graph of the means."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return logits + 0.0 * context.gaussians.means.sum() if context.gaussians.means.requires_grad else logits


@spoils("check_confidence_no_cameras")
class Blind(Confidence):
    """Half sure about everything when there is no camera."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return logits if len(context.cameras) else torch.zeros_like(logits)


@spoils("check_confidence_extreme_images")
class Dazzled(Confidence):
    """NaN at a cut from black to white."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return torch.full_like(logits, torch.nan) if _largest_change(context) == 1.0 else logits


@spoils("check_confidence_brightness")
class Startled(Confidence):
    """Sure about everything once the light changes by the same amount everywhere."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        if len(context.cameras) == 0:
            return logits
        change = context.image(0) - context.previous_image(0)
        even = float(change.min()) > 0.01 and float(change.max()) < 0.5
        return logits + 9.0 * even
