"""Loss: a value and its gradient with respect to the rendered image, without an autograd graph."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from gsstream.core.part import Part, Traits


@dataclass(frozen=True, slots=True)
class LossTraits(Traits):
    """What a loss claims.

    Arguments:
        takes_bytes: ``prepare`` also takes images of uint8, of which 255 is 1.0, and compares with them as with the
            same image in float32, bit for bit. For other losses images are made float32 first, in four times the
            memory.
    """

    takes_bytes: bool = False


class Loss(Part):
    """A per-image loss. ``prepare`` is called once per target and frame, ``evaluate`` once per iteration."""

    traits: ClassVar[LossTraits] = LossTraits()

    def claims(self) -> LossTraits:
        return self.traits

    @abstractmethod
    def prepare(self, target: torch.Tensor) -> Any:
        """Precompute what depends only on the target [H, W, 3] float32 in [0, 1]; opaque to the engine."""

    @abstractmethod
    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of ``image`` [H, W, 3] as a tensor [], on the CPU float64, and its gradient [H, W, 3].

        Arguments:
            image: [H, W, 3] rendered.
            prepared: what :meth:`prepare` returned of the target.
            dssim: weight w of 1 - SSIM, 0 to 1.
            tile_mask: [ceil(H / 16), ceil(W / 16)] bool, tiles to evaluate; None: all. The sum runs over these tiles
                and their neighbours, whose SSIM windows overlap them, divided by the number of pixels of the image.
                In these tiles the gradient is that of the whole loss; elsewhere it is 0. ``image`` must be valid in
                the neighbours too.
        """
