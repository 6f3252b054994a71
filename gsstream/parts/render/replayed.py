"""A session on a GPU whose iterations are recorded once and replayed."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import suppress
from typing import Any, NamedTuple, Self

import torch

from gsstream.core.deferred import require
from gsstream.core.errors import ShapeError
from gsstream.parts.render.replay import RecordError, Records, tensors_of
from gsstream.parts.render.session import RenderSession
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.transforms import Pinhole
from gsstream.parts.render.wrt import G, LossAndGrad, Wrt


class SeenView(NamedTuple):
    """One view of a session: what its renderer takes from it, and its target.

    ``pinhole`` is what ``ReplayedSession.numbers`` returns.
    """

    own: Any
    pinhole: torch.Tensor
    target: ViewTarget


class _Asked(NamedTuple):
    seen: SeenView
    wrt: Any


class ReplayedSession(RenderSession):
    """A session that says what a view is made of, and draws a view that it is handed.

    Its ``loss_and_grad`` is the default body, replayed where that can be.
    """

    #: The view that this copy of a session draws, whatever number it is asked for; None: those of the rig.
    fixed: SeenView | None = None

    @property
    @abstractmethod
    def records(self) -> Records | None:
        """Records of what holds as the session is narrowed now; None: nothing can be recorded."""

    @abstractmethod
    def own(self, view: int) -> Any:
        """Return what differs between views, in tensors; what a view needs once is made now."""

    @abstractmethod
    def numbers(self, view: int) -> torch.Tensor:
        """Return [14] float64 on the device: rotation of a camera row by row, offset, focal lengths."""

    @abstractmethod
    def drawing(self, seen: SeenView) -> Self:
        """Return a copy of this session that draws this one view, which is its ``fixed``."""

    def seen(self, view: int, target: ViewTarget) -> SeenView:
        """Return a view and its target, as :meth:`drawing` takes them."""
        return SeenView(self.own(view), self.numbers(view), target)

    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Wrt[G]) -> LossAndGrad[G]:
        name, records = f"gradients by {type(wrt).__name__}", None if self.fixed else self.records
        if records is not None and records.can(name):
            with suppress(RecordError):
                return records.call(name, self._compared, _Asked(self.seen(view, target), wrt))
        _require_finite(wrt)
        return super().loss_and_grad(view, target, wrt)

    def pinhole(self, view: int) -> Pinhole:
        numbers = self.numbers(view) if self.fixed is None else self.fixed.pinhole
        return Pinhole(numbers[:9].reshape(3, 3), numbers[9:12], numbers[12:])

    def _compared(self, asked: _Asked) -> LossAndGrad[Any]:
        return self.drawing(asked.seen).loss_and_grad(0, asked.seen.target, asked.wrt)


def _require_finite(wrt: Wrt[Any]) -> None:
    """A rasteriser of a GPU leaves out rows that are not finite, without a word."""
    by_type: dict[torch.dtype, list[torch.Tensor]] = {}
    for value in tensors_of(wrt):
        if value.is_floating_point() and value.numel():
            by_type.setdefault(value.dtype, []).append(value.detach())
    for values in by_type.values():
        largest = torch.stack(torch._foreach_norm(values, torch.inf))
        require((largest < torch.inf).all(), lambda: ShapeError("rows: expected finite values, got one that is not"))
