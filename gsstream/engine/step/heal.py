"""Healing: what stands still and is not yet right is mended, the worst first.

A frame learns only where pictures change, so what frame 0 got wrong stays wrong, and so does what a moving body has
laid bare. The memory of still pixels (``engine.still``) knows these places better than any picture: its noise falls
with the number of pictures. Where the render differs from it by more than that noise, the scene is unfinished there.
"""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import unpacked
from gsstream.engine.step.active.candidates import changed_rows
from gsstream.engine.step.active.change import Change, tile_sums
from gsstream.engine.step.context import FrameView
from gsstream.engine.still.blocks import BLOCK, block_means
from gsstream.engine.still.memory import LEAST_COUNT, StillMemory
from gsstream.recipe.model import Stream

#: Multiple of the noise of a block's mean that is still no error.
TOLERANCE = 3.0
#: Least share of the views a Gaussian projects into in which it must lie in or beside an unfinished tile.
VOTES = 0.5
#: Logit from which a gate that is to mend something starts: as likely open as shut.
START = 0.0


def remembered(stream: Stream, memory: StillMemory | None, previous: Frame, frame: Frame) -> StillMemory | None:
    """Return the memory of still pixels after a frame; None where the recipe asks for none. Skipped frames add nothing.

    Arguments:
        stream: section ``stream`` of the recipe.
        memory: after the frame before; None: the frame before is the first.
        previous: that frame. frame: this one.
    """
    if not stream.remember:
        return None
    if frame.effort == 0:
        return memory
    return (memory or StillMemory.start(unpacked(previous.images))).after(frame.images)


def mended_rows(view: FrameView, memory: StillMemory, share: float) -> torch.Tensor:
    """Return [N] bool: Gaussians that several views see in the worst unfinished tiles.

    Arguments:
        view: the frame, seen from the scene that is to be mended.
        memory: after this frame.
        share: largest share of the tiles of all views that is opened, 0 to 1.
    """
    scores = np.stack([_unfinished(view, memory, place) for place in range(len(view.cameras))])
    most = int(share * scores.size)
    worst = np.partition(scores.ravel(), -most)[-most] if most else np.inf
    tiles = torch.from_numpy((scores > 0) & (scores >= worst))
    change = Change(tiles, view.cameras.height, view.cameras.width)
    return changed_rows(change, view.gaussians.means, view.cameras, view.session, VOTES)


def _unfinished(view: FrameView, memory: StillMemory, place: int) -> FloatArray:
    """[rows, columns] of tiles of one view: squared error beyond the noise of the memory, summed over still blocks."""
    count = memory.count[place]
    off = block_means(view.shown(view.gaussians, place).numpy() - memory.values(place))
    # A block is as still as its youngest pixel; counts are equal within a block, but for the border.
    number = count[::BLOCK, ::BLOCK].astype(np.float64)
    noise = memory.sigma[place] / (BLOCK * np.sqrt(number))
    excess = np.maximum(np.abs(off).max(-1) - TOLERANCE * noise, 0)
    return tile_sums(np.where(number >= LEAST_COUNT, excess**2, 0.0))


def raised(logits: torch.Tensor, rows: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
    """Return the logits [M] with the gates of some rows no more shut than undecided.

    Arguments:
        logits: [M] initial gate logits.
        rows: [N] bool, Gaussians that are to be mended.
        hierarchy: node of each Gaussian.
    """
    out = logits.clone()
    nodes = torch.unique(hierarchy.node_of[rows])
    out[nodes] = out[nodes].clamp_min(START)
    return out
