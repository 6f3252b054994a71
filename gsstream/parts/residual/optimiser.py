"""ResidualOptimiser: latents, decoders and gates of one frame, trained side by side, some iterations in one call."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, final

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.render.session import RenderSession
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.wrt import WrtRows
from gsstream.parts.residual.adam_state import AdamState

#: The sessions of the renderer that an optimiser belongs to: those of other renderers do not reach it.
S = TypeVar("S", bound=RenderSession)


class Gates(Protocol):
    """The trainable gates of the A rows: M logits; row a uses logit ``node_of[a]`` ([A] int64).

    ``gate`` and ``regularizer`` are the parts, ``num_gaussians`` is N, the divisor of a mean penalty. An optimiser with
    closed forms of both parts may update ``logits`` and ``state`` in place by itself.
    """

    @property
    def gate(self) -> Any: ...

    @property
    def regularizer(self) -> Any: ...

    @property
    def logits(self) -> torch.Tensor: ...

    @property
    def state(self) -> AdamState: ...

    @property
    def lr(self) -> float: ...

    @property
    def node_of(self) -> torch.Tensor: ...

    @property
    def num_gaussians(self) -> int: ...

    def sample(self, frozen: torch.Tensor | None) -> torch.Tensor:
        """Return the gates [A] of the rows, with a graph; those of ``frozen`` rows [A] bool are 0."""

    def step(
        self, gates: torch.Tensor, by_gate: torch.Tensor, position: torch.Tensor, frozen: torch.Tensor | None
    ) -> None:
        """Move the logits by what the images and the penalty say, and keep them in their bounds.

        Arguments:
            gates: [A] as sampled.
            by_gate: [A] gradient of the loss by them.
            position: [A, 3] ungated position residual with a graph, into which the penalty's gradient flows.
            frozen: [A] bool rows that cost nothing, because they are not trained yet; None: all rows are trained.
        """


class Iteration(NamedTuple):
    """One iteration: ``view`` and its ``target``, rows that are not trained yet, factor on the learning rates.

    ``frozen`` [A] bool; None: all rows are trained.
    """

    view: int
    target: ViewTarget
    frozen: torch.Tensor | None
    lr_factor: float


@final
@dataclass(frozen=True, slots=True, eq=False)
class ResidualEpoch(Generic[S]):
    """Some iterations of a frame's residual, in the order in which they are made.

    Arguments:
        session: narrowed to the A rows.
        iterations: in their order.
        gates: of the rows.
        rd_lambda: loss per bit of latents behind open gates.
        begin: called with the position of each iteration before it is made, so that an error can name it.
    """

    session: S
    iterations: Sequence[Iteration]
    gates: Gates
    rd_lambda: float
    begin: Callable[[int], None] = lambda _: None

    def after(self, made: int) -> ResidualEpoch[S]:
        """Return what is left after so many iterations; ``begin`` counts on."""
        begin = self.begin
        return replace(self, iterations=self.iterations[made:], begin=lambda place: begin(made + place))


class ResidualOptimiser(ABC, Generic[S]):
    """The residual of A rows in one frame's optimisation: latents behind linear decoders, gated, trained by Adam.

    It is ``gsstream.parts.residual.decode`` (rounding counts as the identity), the rate of
    ``gsstream.parts.residual.rate`` and ``RowOptimiser.step``, up to rounding. In every iteration ``forward``,
    ``backward`` and ``step`` are called in this order.
    """

    @property
    @abstractmethod
    def latents(self) -> torch.Tensor:
        """[A, L] leaf that requires grad: what waits in its ``grad`` is added to the gradient of the next step."""

    @property
    @abstractmethod
    def position(self) -> torch.Tensor:
        """[A, 3] the latents of positions, a view of ``latents`` with its graph; zeros where positions never change."""

    @property
    @abstractmethod
    def matrix(self) -> torch.Tensor:
        """[L, D] decoders as they are now."""

    @property
    @abstractmethod
    def curvature(self) -> torch.Tensor:
        """[A, L] running mean of the squared gradient of the latents."""

    @abstractmethod
    def forward(self, gates: torch.Tensor) -> Gaussians[torch.Tensor]:
        """Return the A rows with their residual behind ``gates`` [A], contiguous, without a graph."""

    @abstractmethod
    def backward(self, grad: Gaussians[torch.Tensor], rd_lambda: float) -> torch.Tensor:
        """Backpropagate dL/drows to latents, decoders and gates; return dL/dgates [A].

        Arguments:
            grad: dL/drows, shaped like the rows that :meth:`forward` returned last.
            rd_lambda: loss per bit of the latents behind open gates; 0: bits cost nothing.
        """

    @abstractmethod
    def step(self, lr_factor: float = 1.0) -> None:
        """Make one Adam step from the last :meth:`backward`, plus the gradient in ``latents.grad``.

        Arguments:
            lr_factor: on the learning rates of latents and decoders in this step, >= 0.

        Raises ShapeError where a gradient is not finite.
        """

    def run(self, epoch: ResidualEpoch[S]) -> list[torch.Tensor]:
        """Make these iterations and return their losses [].

        This body is the truth. An optimiser may override it with one that does the same in one call, up to rounding,
        and calls this one for the iterations that it does not cover, among them one in which it finds a fault.
        """
        losses = []
        for place, now in enumerate(epoch.iterations):
            epoch.begin(place)
            gates = epoch.gates.sample(now.frozen)
            found = epoch.session.loss_and_grad(now.view, now.target, WrtRows(self.forward(gates.detach())))
            by_gate = self.backward(found.grad, epoch.rd_lambda)
            epoch.gates.step(gates, by_gate, self.position, now.frozen)
            self.step(now.lr_factor)
            losses.append(found.loss)
        return losses

    @abstractmethod
    def select_rows(self, rows: torch.Tensor) -> None:
        """Go on with these rows [K] of the A, and with the steps they have taken."""
