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

#: The sessions of the renderer that an optimiser belongs to; sessions of other renderers are never given to it.
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

    def noise(self) -> torch.Tensor | None:
        """Return the noise [M] of the next iteration, where the logits are; None: the gate part takes none."""

    def sample(self, noise: torch.Tensor | None, frozen: torch.Tensor | None) -> torch.Tensor:
        """Return the gates [A] of the rows, with a graph; those of ``frozen`` rows [A] bool are 0."""

    def step(
        self, gates: torch.Tensor, by_gate: torch.Tensor, position: torch.Tensor, frozen: torch.Tensor | None
    ) -> None:
        """Move the logits by what the images and the penalty say, and keep them in their bounds.

        Arguments:
            gates: [A] as sampled.
            by_gate: [A] gradient of the loss by the gates.
            position: [A, 3] ungated position residual with a graph, into which the penalty's gradient flows.
            frozen: [A] bool rows that cost nothing, because they are not trained yet; None: all rows are trained.
        """


class Iteration(NamedTuple):
    """One iteration: ``view`` and its ``target``, rows that are not trained yet, factor on the learning rates.

    ``frozen`` [A] bool; None: all rows are trained. ``lr_factor`` is a number, or a tensor [] where the rows are.
    """

    view: int
    target: ViewTarget
    frozen: torch.Tensor | None
    lr_factor: float | torch.Tensor


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
        """Return the rest of the pass after so many iterations; ``begin`` goes on counting."""
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
    def backward(self, grad: Gaussians[torch.Tensor], rd_lambda: float | torch.Tensor) -> torch.Tensor:
        """Backpropagate dL/drows to latents, decoders and gates; return dL/dgates [A].

        Arguments:
            grad: dL/drows, shaped like the rows that :meth:`forward` returned last.
            rd_lambda: loss per bit of the latents behind open gates; the number 0: bits cost nothing.
        """

    @abstractmethod
    def step(self, lr_factor: float | torch.Tensor = 1.0) -> None:
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
        return self.run_with(epoch, [epoch.gates.noise() for _ in epoch.iterations])

    def run_with(self, epoch: ResidualEpoch[S], noises: Sequence[torch.Tensor | None]) -> list[torch.Tensor]:
        """Make these iterations with noise that was drawn, and return their losses []."""
        losses = []
        for place, (now, noise) in enumerate(zip(epoch.iterations, noises, strict=True)):
            epoch.begin(place)
            losses.append(self.iterate(epoch.session, epoch.gates, now, noise=noise, rd_lambda=epoch.rd_lambda))
        return losses

    @final
    def iterate(
        self, session: S, gates: Gates, now: Iteration, noise: torch.Tensor | None, rd_lambda: float | torch.Tensor
    ) -> torch.Tensor:
        """Make one iteration and return its loss []. Nothing in it reads a value, so a GPU need not be waited for."""
        opened = gates.sample(noise, now.frozen)
        found = session.loss_and_grad(now.view, now.target, WrtRows(self.forward(opened.detach())))
        by_gate = self.backward(found.grad, rd_lambda)
        gates.step(opened, by_gate, self.position, now.frozen)
        self.step(now.lr_factor)
        return found.loss

    @abstractmethod
    def select_rows(self, rows: torch.Tensor) -> None:
        """Go on with these rows [K] of the A, and with the steps they have taken."""
