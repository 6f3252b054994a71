"""Confidence from a network that sees the two frames: the changed share of a Gaussian's pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import (
    ConfidenceEstimator,
    ConfidenceTraits,
    FrameContext,
    PartConfig,
    PluginUnavailable,
    check_finite,
)
from gsstream_onnx_confidence.network import run_network


@final
class OnnxConfidence(ConfidenceEstimator):
    """p = mean over the views that see a Gaussian's centre of the network's change there; z = logit p.

    A flow of f pixels counts as a change of 1 - exp(-|f| / ``pixels``). Views whose two images are the same bits are
    not shown to the network and count as unchanged. The mean is a vote: a wall behind a moving hand is in
    changed pixels in some views only. Occlusion is not considered.

    Raises PluginUnavailable on construction when no file is given.
    """

    source = "gsstream"

    class Config(PartConfig):
        path: str = Field(default="", description="the ONNX file; see the plugin's README for its inputs and outputs")
        output: Literal["change", "flow"] = Field(
            default="change", description="change: probabilities [1, 1, H, W]; flow: pixels [1, 2, H, W]"
        )
        pixels: float = Field(default=1.0, gt=0, le=100, description="(flow) length that counts as a change of 0.63")
        floor: float = Field(
            default=-math.log(1000.0),
            ge=-50,
            le=0,
            description="smallest logit, and that of Gaussians no view sees; the largest is its negative",
        )

    def __init__(self, config: PartConfig | None = None) -> None:
        super().__init__(config)
        if not self.config.path:
            raise PluginUnavailable(
                "confidence 'onnx': expected the path of an ONNX file, got none; set confidence.params.path=FILE in a "
                "run, or give --set path=FILE to gsstream check"
            )

    def denials(self) -> Mapping[str, str]:
        return {"check_device": "the network runs on the processor, so images of a GPU are copied to it"}

    def claims(self) -> ConfidenceTraits:
        return replace(self.traits, floor=self.config.floor)

    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Logits [N] float32 in [floor, -floor]."""
        check_finite("means", context.gaussians.means)
        means = context.gaussians.means.detach().double().cpu()
        total = torch.zeros(len(means), dtype=torch.float64)
        count = torch.zeros(len(means), dtype=torch.float64)
        for view in range(len(context.cameras)):
            x, y, seen = _pixels(context, view, means)
            count += seen
            change = self._change(context, view)
            if change is not None:
                total[seen] += change[y[seen], x[seen]]
        share = (total / count.clamp_min(1)).clamp(0, 1)
        # The documented bounds of the logit: a network may be certain, a gate must be able to change its mind.
        logits = torch.logit(share).clamp(self.config.floor, -self.config.floor).float()
        return logits.to(context.gaussians.means.device)

    def _change(self, context: FrameContext, view: int) -> torch.Tensor | None:
        """[H, W] float64 in [0, 1]; None where nothing changed."""
        previous, current = context.previous_image(view), context.image(view)
        check_finite(f"image of view {view} before", previous)
        check_finite(f"image of view {view}", current)
        if torch.equal(previous, current):
            return None
        pair = (np.asarray(image.detach().cpu().numpy(), np.float32) for image in (previous, current))
        found = torch.from_numpy(run_network(self.config.path, self.config.output, *pair)).double()
        if self.config.output == "flow":
            return 1 - torch.exp(-found.norm(dim=0) / self.config.pixels)
        return found[0]


def _pixels(context: FrameContext, view: int, means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Column and row of the pixel each centre falls on, [N] int64, and whether it is in the image, [N] bool."""
    cameras = context.cameras
    pose, K = torch.from_numpy(cameras.viewmats[view]), torch.from_numpy(cameras.Ks[view])
    local = means @ pose[:3, :3].T + pose[:3, 3]
    front = local[:, 2] > cameras.near_plane
    depth = torch.where(front, local[:, 2], torch.ones_like(local[:, 2]))
    flat = (local @ K.T)[:, :2] / depth[:, None]
    seen = front & (flat >= 0).all(1) & (flat[:, 0] < cameras.width) & (flat[:, 1] < cameras.height)
    at = torch.where(seen[:, None], flat, torch.zeros_like(flat)).long()
    return at[:, 0], at[:, 1], seen
