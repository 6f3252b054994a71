"""Corrections at key frames: residuals of the Gaussians in error, behind a mask that is learned with them."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import FitContext, Gaussians, Layout, Residual, WrtRows
from gsstream.blocks import rows_backward
from gsstream_comgs.settings import CorrectionSettings

#: Learning rates of frame 0 in 3DGS; centres in units of the extent.
RATES = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 0.05, "sh0": 2.5e-3}


def high_error_rows(work: FitContext, share: float) -> torch.Tensor:
    """Return the rows [A], ascending, that the error of the scene pulls at most.

    The pull is the mean over the views of the screen gradient of the mean absolute error.
    """
    total = torch.zeros(len(work.gaussians))
    for view in range(len(work.cameras)):
        difference = work.previous_render(view) - work.image(view)
        total += work.screen_gradient(view, difference.sign() / difference.numel()).gradient.norm(dim=1)
    number = min(max(1, int(share * len(total))), int((total > 0).sum()))
    return torch.topk(total, number).indices.sort().values


def corrected(
    work: FitContext, layout: Layout, epochs: int, settings: CorrectionSettings, order: np.random.Generator
) -> Residual | None:
    """Return the correction of a key frame; None where nothing is corrected."""
    rows = high_error_rows(work, settings.share)
    if not len(rows):
        return None
    work.narrow(rows)
    base = work.gaussians.rows(rows)
    unit = float(layout.units[0])
    deltas = {name: torch.zeros_like(getattr(base, name), requires_grad=True) for name in RATES}
    logits = torch.ones(len(rows), requires_grad=True)
    adam = torch.optim.Adam([
        *({"params": [deltas[name]], "lr": RATES[name]} for name in RATES),
        {"params": [logits], "lr": settings.mask_lr},
    ])  # fmt: skip
    for _ in range(epochs):
        for view in order.permutation(len(work.cameras)):
            rows_now = _masked(base, deltas, logits, unit)
            rows_backward(rows_now, work.loss_and_grad(int(view), WrtRows(rows_now)).grad)
            torch.autograd.backward(settings.mask_weight * logits.sigmoid().mean())
            adam.step()
            adam.zero_grad()
    return _hardened(layout, rows, deltas, logits, settings)


def _masked(
    base: Gaussians[torch.Tensor], deltas: dict[str, torch.Tensor], logits: torch.Tensor, unit: float
) -> Gaussians[torch.Tensor]:
    """Rows with their corrections; the mask is 0 or 1, and its gradient that of the sigmoid."""
    soft = logits.sigmoid()
    mask = (soft > 0.5).float() + soft - soft.detach()
    values = dict(base.items())
    for name, delta in deltas.items():
        scale = unit if name == "means" else 1.0
        values[name] = values[name] + scale * mask.reshape(-1, *[1] * (delta.ndim - 1)) * delta
    return Gaussians(**values)


def _hardened(
    layout: Layout, rows: torch.Tensor, deltas: dict[str, torch.Tensor], logits: torch.Tensor,
    settings: CorrectionSettings,
) -> Residual | None:  # fmt: skip
    """The integers behind the mask."""
    kept = (logits > 0).numpy()
    symbols, steps = {}, {}
    for name, delta in deltas.items():
        steps[name] = settings.means_step if name == "means" else settings.step
        rounded = torch.round(delta.detach().reshape(len(rows), -1) / steps[name]).to(torch.int32).numpy()
        symbols[name] = np.where(kept[:, None], rounded, 0)
    some = np.concatenate(list(symbols.values()), 1).any(1)
    if not some.any():
        return None
    gates = np.zeros(len(layout.node_counts), np.uint8)
    gates[layout.node_of[rows.numpy()[some]]] = 1
    sent = {name: value[some] for name, value in symbols.items() if value[some].any()}
    return Residual(gates, 1, sent, {name: steps[name] for name in sent})
