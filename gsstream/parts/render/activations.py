"""Activations: exp, sigmoid and normalise from raw values; the engine has them nowhere else."""

from __future__ import annotations

import torch

from gsstream.core.gaussians import SH0


def activate_scales(scales: torch.Tensor) -> torch.Tensor:
    """Return standard deviations, scene units, given their logarithms."""
    return scales.exp()


def activate_opacities(opacities: torch.Tensor) -> torch.Tensor:
    """Return opacities in (0, 1), given logits."""
    return opacities.sigmoid()


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices [N, 3, 3], given quaternions [N, 4] wxyz of any non-zero norm.

    A norm below 1e-10 is treated as 1e-10, which gives a finite matrix.
    """
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True).clamp_min(1e-10)).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, -1).reshape(-1, 3, 3)


def quat_multiply_torch(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the Hamilton products [n, 4] of quaternions, wxyz."""
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return torch.cat([w * x - (v * u).sum(1, keepdim=True), w * u + x * v + torch.linalg.cross(v, u)], 1)


def rgb_to_sh0(rgb: torch.Tensor) -> torch.Tensor:
    """Return degree-0 coefficients [N, 1, 3], given colours [N, 3] in [0, 1]."""
    return ((rgb - 0.5) / SH0)[:, None]


def logit(p: float) -> float:
    """Return the inverse sigmoid of a probability strictly between 0 and 1."""
    return float(torch.logit(torch.tensor(p, dtype=torch.float64)))
