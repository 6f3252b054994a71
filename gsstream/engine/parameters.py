"""Trainable rows with Adam moments that follow topology edits."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from gsstream.core.topology import TopologyEdit

ADAM_EPS = 1e-15  # released code and 3DGS: tiny gradients of tiny Gaussians must still move them


class AdamTable:
    """Named leaf tensors, their learning rates and their Adam moments (fused implementation, betas 0.9 / 0.999)."""

    def __init__(self, values: Mapping[str, torch.Tensor], lrs: Mapping[str, float]) -> None:
        self.leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        self._build({name: lrs[name] for name in self.leaves})

    def _build(self, lrs: Mapping[str, float]) -> None:
        groups = [{"params": [leaf], "lr": lrs[name], "name": name} for name, leaf in self.leaves.items()]
        self._adam = torch.optim.Adam(groups, eps=ADAM_EPS, fused=True) if groups else None

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.leaves[name]

    def set_lr(self, name: str, lr: float) -> None:
        """Change one learning rate."""
        assert self._adam is not None
        next(group for group in self._adam.param_groups if group["name"] == name)["lr"] = lr

    def step(self, gradients: Mapping[str, torch.Tensor] | None = None) -> None:
        """One Adam step from the leaves' gradients, which are then dropped; ``gradients`` are added to them first."""
        for name, gradient in (gradients or {}).items():
            leaf = self.leaves[name]
            leaf.grad = gradient if leaf.grad is None else leaf.grad + gradient
        if self._adam is not None:
            self._adam.step()
            self._adam.zero_grad(set_to_none=True)

    def moments(self, name: str) -> dict[str, torch.Tensor]:
        """Adam state of one leaf; empty before the first step."""
        if self._adam is None:
            return {}
        return {key: value.clone() for key, value in self._adam.state.get(self.leaves[name], {}).items()}

    def load_moments(self, name: str, moments: Mapping[str, torch.Tensor]) -> None:
        """Continue from moments saved by :meth:`moments`; an empty mapping starts fresh."""
        if moments and self._adam is not None:
            self._adam.state[self.leaves[name]] = {k: v.clone() for k, v in moments.items()}

    def edit(self, edit: TopologyEdit, values: Mapping[str, torch.Tensor] | None = None) -> None:
        """Apply a topology edit to every leaf and its moments; ``values`` replaces the edited leaves' contents."""
        assert self._adam is not None
        lrs = {group["name"]: group["lr"] for group in self._adam.param_groups}
        moments = {name: self._adam.state.get(leaf, {}) for name, leaf in self.leaves.items()}
        for name, leaf in self.leaves.items():
            content = leaf.detach()[edit.source] if values is None else values[name]
            self.leaves[name] = content.clone().requires_grad_()
        self._build(lrs)
        for name, leaf in self.leaves.items():
            if moments[name]:
                self._adam.state[leaf] = _edited(moments[name], edit)


def _edited(moments: Mapping[str, torch.Tensor], edit: TopologyEdit) -> dict[str, torch.Tensor]:
    out = {"step": moments["step"]}
    for key in ("exp_avg", "exp_avg_sq"):
        rows = moments[key][edit.source].clone()
        rows[edit.fresh] = 0
        out[key] = rows
    return out
