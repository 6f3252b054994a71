"""Failures at a seam are wrapped with who, where and when; what comes out of a part is looked at before it is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import entry_points, packages_distributions

import torch

from gsstream.core.errors import ComponentError, GsstreamError
from gsstream.core.part import Part
from gsstream.spec import ENTRY_POINT_GROUP


@contextmanager
def guarded(slot: str, part: Part, frame: int | None, iteration: int | None = None) -> Iterator[None]:
    """Turn whatever a part raises into a ComponentError; errors raised on purpose pass unchanged."""
    try:
        yield
    except GsstreamError:
        raise
    except Exception as error:
        raise fault(f"{type(error).__name__}: {error}", slot, part, frame, iteration) from error


def fault(message: str, slot: str, part: Part, frame: int | None, iteration: int | None = None) -> ComponentError:
    """The error about a part that failed, or did not do what it must."""
    owner = _distribution(type(part).__module__.partition(".")[0])
    name = type(part).__name__
    return ComponentError(message, slot=slot, part=name, distribution=owner, frame=frame, iteration=iteration)


def check_output(
    slot: str,
    part: Part,
    frame: int | None,
    what: str,
    value: object,
    shape: tuple[int, ...],
    limits: tuple[float, float] | None = None,
) -> None:
    """Raise ComponentError unless ``value`` is a finite floating point tensor of this shape, within ``limits``.

    Once per frame and seam: what a part gets wrong is said with its name, before another part stumbles over it.
    """
    if not isinstance(value, torch.Tensor) or not value.dtype.is_floating_point:
        got = str(value.dtype) if isinstance(value, torch.Tensor) else type(value).__name__
        raise fault(f"{what}: expected a floating point tensor, got {got}", slot, part, frame)
    if tuple(value.shape) != shape:
        raise fault(f"{what}: expected shape {list(shape)}, got {list(value.shape)}", slot, part, frame)
    bad = ~torch.isfinite(value)
    where = "finite values"
    if limits is not None:
        bad |= (value < limits[0]) | (value > limits[1])
        where += f" from {limits[0]:g} to {limits[1]:g}"
    if bool(bad.any()):
        index = tuple(bad.nonzero()[0].tolist())
        message = f"{what}: expected {where}, got {float(value[index])!r} at index {list(index)}"
        raise fault(f"{message} ({int(bad.sum())} of {bad.numel()} values)", slot, part, frame)


def check_terms(part: Part, frame: int, iteration: int, terms: Mapping[str, torch.Tensor]) -> None:
    """Raise ComponentError unless every term of a penalty is one finite number."""
    for name, value in terms.items():
        if value.numel() != 1 or not bool(torch.isfinite(value).all()):
            got = float(value) if value.numel() == 1 else f"shape {list(value.shape)}"
            message = f"penalty {name!r}: expected one finite number, got {got}"
            raise fault(message, "regularizer", part, frame, iteration)


def _distribution(package: str) -> str:
    """Who ships a top-level package. Entry points first: of an editable install the list of files says nothing."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.dist is not None and point.module.partition(".")[0] == package:
            return point.dist.name
    return packages_distributions().get(package, [package])[0]
