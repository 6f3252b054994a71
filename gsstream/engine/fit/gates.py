"""The gates of one frame's candidates while they are trained."""

from __future__ import annotations

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.gate.base import GateSampler
from gsstream.parts.regularizer.base import Regularizer
from gsstream.parts.render.backward import backward
from gsstream.parts.residual.adam_state import AdamState


class TrainedGates:
    """Logits of the gates that have candidates (``rows`` [A]) behind them, moved by images and penalty."""

    def __init__(
        self,
        gate: GateSampler,
        regularizer: Regularizer,
        optimiser: RowOptimiser,
        lr: float,
        logits: torch.Tensor,
        hierarchy: Hierarchy,
        rows: torch.Tensor,
        generator: torch.Generator,
    ) -> None:
        self.gate, self.regularizer, self._optimiser, self.lr = gate, regularizer, optimiser, lr
        self.num_gaussians, self._generator, self._all = hierarchy.num_gaussians, generator, logits
        self._nodes, node_of = torch.unique(hierarchy.node_of[rows], return_inverse=True)
        self.hierarchy = _roots(node_of, len(self._nodes))
        self.logits = logits.detach()[self._nodes].requires_grad_()
        self.state = AdamState.start(self.logits, ahead=True)
        self._ahead: list[torch.Tensor | None] = []

    @property
    def node_of(self) -> torch.Tensor:
        return self.hierarchy.node_of

    def draw_ahead(self, iterations: int) -> None:
        """Draw the noise of several iterations where the logits are on a GPU, so that all of it is copied at once."""
        if self.logits.device.type == "cpu":
            return
        drawn = [self._noise() for _ in range(iterations)]
        some = [noise for noise in drawn if noise is not None]
        self._ahead = list(torch.stack(some).to(self.logits.device)) if len(some) == iterations else drawn

    def _noise(self) -> torch.Tensor | None:
        return self.gate.noise(self.hierarchy.num_nodes, self._generator)

    def noise(self) -> torch.Tensor | None:
        return self._ahead.pop(0) if self._ahead else self._noise()

    def sample(self, noise: torch.Tensor | None, frozen: torch.Tensor | None) -> torch.Tensor:
        # Selected and not indexed: on a GPU the gradient of an index sorts, that of a selection adds.
        per_row = self.gate.sample(self.logits, noise).index_select(0, self.node_of)
        return per_row if frozen is None else per_row * ~frozen

    def step(
        self, gates: torch.Tensor, by_gate: torch.Tensor, position: torch.Tensor, frozen: torch.Tensor | None
    ) -> None:
        probability, hierarchy = self.gate.open_probability(self.logits), self.hierarchy
        if frozen is not None:  # images do not reach these rows yet: the price alone would close their gates for good
            hierarchy, position = hierarchy.rows(~frozen), position[~frozen]
        # A term on the residual has a gradient by it, too; that stays on the leaf until the latents step.
        penalty = self.regularizer.penalty(probability, position, hierarchy, self.num_gaussians)
        roots = [(gates, by_gate), *((term, torch.ones_like(term)) for term in penalty.values())]
        trained = [(root, gradient) for root, gradient in roots if root.requires_grad]
        if not trained:
            return
        backward(*zip(*trained, strict=True))
        gradient, self.logits.grad = self.logits.grad, None
        if gradient is not None:
            self._optimiser.step({"": self.logits}, {"": gradient}, {"": self.state}, {"": self.lr})
        self.logits.data.copy_(self.gate.bound(self.logits.detach()))

    def opened(self) -> torch.Tensor:
        """Return [M] bool: gates that would be sent open now."""
        return torch.round(self.gate.sample(self.logits.detach(), None) * self.gate.num_levels) > 0

    def select_rows(self, rows: torch.Tensor) -> None:
        """Go on with these rows [K] of the candidates, and with the gates that they have."""
        self._all = self.all_logits()
        nodes, node_of = torch.unique(self.node_of[rows], return_inverse=True)
        self._nodes, self.hierarchy = self._nodes[nodes], _roots(node_of, len(nodes))
        self.logits, self.state = self.logits.detach()[nodes].requires_grad_(), self.state.rows(nodes)

    def all_logits(self) -> torch.Tensor:
        """Return the logits of all gates of the scene, with the current values of those that are trained."""
        return self._all.index_copy(0, self._nodes, self.logits.detach())


def _roots(node_of: torch.Tensor, number: int) -> Hierarchy:
    """``number`` roots and nothing else: sampling does not look at parents."""
    roots = torch.arange(number, device=node_of.device)
    return Hierarchy(node_of, roots, torch.zeros_like(roots))
