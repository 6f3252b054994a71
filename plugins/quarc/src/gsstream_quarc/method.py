"""QuARC-GS (arXiv 2608.18285) as a method of its own, on the anchors of ReCon-GS."""

from __future__ import annotations

from typing import final

from gsstream_recon.method import AnchoredMethod

from gsstream.blocks import CopyFilter
from gsstream_quarc.births import ChangeFilter
from gsstream_quarc.settings import QuARCConfig


@final
class QuARC(AnchoredMethod):
    """Moves Gaussians by anchors whose motions are integers, and adds some where something changed (QuARC-GS, 2026).

    The anchors are those of ReCon-GS. Their motions are rounded while they are fitted, with the gradient of what is not
    rounded, so that most of them are zero and what is fitted is what is sent. Gaussians are copied only where four
    fixed views changed since the frame before, and at most four in a cell of a grid.
    Where this differs from what is published, and why: README of this plugin.
    """

    source = "QuARC-GS (arXiv 2608.18285)"

    Config = QuARCConfig

    def admission(self, kept: int) -> CopyFilter:
        return ChangeFilter(self.config.gate, kept)
