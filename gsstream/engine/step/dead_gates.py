"""Gates that nothing can move any more: counted, so that a setting which kills them is seen."""

from __future__ import annotations

import torch

from gsstream.parts.gate.base import GateSampler

#: Spacing of float32 below 1: a smaller gradient changes no gate by a logit's step.
RESOLUTION = 2.0**-24


def count_dead_gates(gate: GateSampler, logits: torch.Tensor) -> int:
    """Count the gates with these logits [M] that neither the images nor the price can move.

    Of a dead gate the derivatives of the deterministic gate and of the open probability are below RESOLUTION.
    """
    leaf = logits.detach().clone().requires_grad_()
    with torch.enable_grad():
        outputs = [value for value in (gate.sample(leaf, None), gate.open_probability(leaf)) if value.requires_grad]
        grads = [torch.autograd.grad(value.sum(), leaf)[0].abs() for value in outputs]
    if not grads:
        return 0
    return int((torch.stack(grads).amax(0) < RESOLUTION).sum())
