"""Schedule: how many epochs a frame's optimisation makes, and what a bit costs in it."""

from __future__ import annotations

from collections.abc import Callable


class Schedule:
    """Epochs and rate weight of one frame, as the recipe says; one under a budget corrects them as the frame goes on.

    ``epochs`` and ``rd_lambda`` (loss per bit) are read in every epoch. ``chunk``: iterations between two calls of
    ``is_over``; None: those of an epoch.
    """

    chunk: int | None = None

    def __init__(self, epochs: int, rd_lambda: float) -> None:
        self.epochs, self.rd_lambda = epochs, rd_lambda

    def start(self, candidates: int) -> None:
        """Note that the first epoch begins, with so many Gaussians."""

    def is_over(self) -> bool:
        """Say whether the time for another iteration is gone."""
        return False

    def end_epoch(self, done: int) -> None:
        """Note that so many epochs are made."""

    def weigh_bytes(self, done: int, estimate: Callable[[], float]) -> None:
        """Correct the rate weight by what an epoch would have sent; ``estimate`` is called only where that counts."""

    def finish(self) -> None:
        """Note that the optimisation has ended."""
