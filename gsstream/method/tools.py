"""What the engine lends to a method. Protocols: the engine implements them, methods only call."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch

from gsstream.core.changes import Layout
from gsstream.core.context import FrameWork
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet import PlayerState, StreamMeta

if TYPE_CHECKING:
    from gsstream.core.frame import Frame
    from gsstream.core.rng import Rng
    from gsstream.render.base import Renderer, RenderSession


@dataclass(frozen=True)
class FirstFrame:
    """Frame 0 as the engine reconstructs it, or as another stream has it (``--first-frame``).

    Arguments:
        gaussians: the scene, with the values that a key packet holds.
        layout: one node per Gaussian and one unit; a method may send another.
        meta: what the key packet says about the run, colour maps of the training cameras included.
        metrics: iterations and seconds.
    """

    gaussians: Gaussians[FloatArray]
    layout: Layout
    meta: StreamMeta
    metrics: Mapping[str, Any]


class FrameTools(FrameWork, Protocol):
    """One frame as a method works on it: what parts see of it, and the render session itself."""

    @property
    def session(self) -> RenderSession:
        """Opened on the scene of the frame before: ``narrow`` to the rows that may change, then ``render`` them."""

    def on(self, gaussians: Gaussians[torch.Tensor]) -> FrameTools:
        """Return the same frame, to be worked on from another scene, which gets a session of its own.

        A session holds a render for every camera that was asked for, as long as something holds it.
        """

    def backward(self, view: int, image: torch.Tensor, tile_mask: torch.Tensor | None = None) -> float:
        """Judge a rendered view against what its camera recorded, and pull the loss back into its graph.

        Arguments:
            view: index of a training camera.
            image: [H, W, 3] rendered, with a graph.
            tile_mask: [ceil(H / 16), ceil(W / 16)] bool, tiles that count; None: all.

        Returns:
            The loss, (1 - w) L1 + w (1 - SSIM).
        """


class Tools(Protocol):
    """What a method may use. Nothing here keeps state between frames."""

    @property
    def rng(self) -> Rng:
        """Random streams by name and frame; draw from nothing else."""

    @property
    def renderer(self) -> Renderer: ...

    @property
    def background(self) -> tuple[float, float, float]: ...

    def epochs(self, frame: Frame) -> int:
        """Return how many passes over the training cameras a later frame is worth.

        This is ``stream.epochs`` (list it in ``heeds``), or less when a live run has fallen behind.
        """

    def first_frame(self, frame: Frame) -> FirstFrame:
        """Reconstruct frame 0 by the recipe's ``first_frame``, or take it over from another stream."""

    def since_key(self) -> Iterator[PlayerState]:
        """Yield, while a stream is resumed, what players have after every packet from the last key packet on, in order.
        """

    def open(self, player: PlayerState, previous: Frame, frame: Frame) -> FrameTools:
        """Begin work on a frame.

        Arguments:
            player: what every player has before it.
            previous: the images that this scene shows.
            frame: training images of the frame.
        """
