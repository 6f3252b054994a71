"""ConfidenceEstimator: how sure we are that a Gaussian must change now, as a logit."""

from __future__ import annotations

from abc import abstractmethod

import torch

from gsstream.core.context import FrameContext
from gsstream.core.part import Part


class ConfidenceEstimator(Part):
    """Maps a frame context to one logit per Gaussian.

    Confidence travels as a logit z (p = sigmoid(z)): max-pooling and Gumbel-sigmoid commute with it, so nothing ever
    computes log(p / (1 - p)) and nothing overflows at p = 0 or 1. Logits are finite; identical consecutive frames give
    at most the estimator's declared floor; no ``.grad`` and no graph is left behind.
    """

    @abstractmethod
    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Return logits [N] float32."""
