"""ConfidenceEstimator: how sure we are that a Gaussian must change now, as a logit."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from gsstream.core.context import FrameContext
from gsstream.core.part import Part, Traits


@dataclass(frozen=True, slots=True)
class ConfidenceTraits(Traits):
    """What a confidence estimator claims.

    Arguments:
        needs_renderer: reads screen gradients from the context.
        floor: largest logit of a Gaussian that no camera sees, or of a static scene.
        finds_motion: ranks what moved above what did not.
        monotone_in_change: a stronger change never lowers the confidence of what changed.
        brightness: largest mean logit of a still scene that becomes brighter by a fiftieth of full scale; None: no
            promise.
    """

    needs_renderer: bool = False
    floor: float = 0.0
    finds_motion: bool = False
    monotone_in_change: bool = False
    brightness: float | None = None


class ConfidenceEstimator(Part):
    """Maps a frame context to one logit per Gaussian.

    Confidence travels as a logit z (p = sigmoid(z)): max-pooling and Gumbel-sigmoid commute with it, so nothing ever
    computes log(p / (1 - p)) and nothing overflows at p = 0 or 1. Logits are finite; identical consecutive frames give
    at most the estimator's declared floor; no ``.grad`` and no graph is left behind.

    A confidence sees two frames and keeps nothing: what needs memory is a motion (``MotionPart.follow``) or a whole
    method (``StreamingMethod``).
    """

    traits: ClassVar[ConfidenceTraits] = ConfidenceTraits()

    def claims(self) -> ConfidenceTraits:
        return self.traits

    @abstractmethod
    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Return logits [N] float32."""
