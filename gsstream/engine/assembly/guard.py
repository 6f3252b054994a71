"""Failures at a seam are wrapped with who, where and when (what comes out of a part: ``engine.assembly.checks``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points, packages_distributions

from gsstream.core.errors import ComponentError, GsstreamError, InputError, ShapeError
from gsstream.core.part import Part
from gsstream.spec import ENTRY_POINT_GROUP


@contextmanager
def guarded(slot: str, part: Part, frame: int | None, iteration: int | None = None) -> Iterator[None]:
    """Turn whatever a part raises into a ComponentError; errors raised on purpose pass unchanged.

    What a part refuses of another's gets the same place (slot, part, frame, iteration): a ShapeError, and of a renderer
    every InputError, since it is given nothing but arrays.
    """
    try:
        yield
    except GsstreamError as error:
        if isinstance(error, ShapeError) or (slot == "renderer" and isinstance(error, InputError)):
            raise fault(str(error), slot, part, frame, iteration) from error
        raise
    except Exception as error:
        raise fault(f"{type(error).__name__}: {error}", slot, part, frame, iteration) from error


def fault(message: str, slot: str, part: object, frame: int | None, iteration: int | None = None) -> ComponentError:
    """The error about a part that failed, or did not do what it must."""
    owner = _distribution(type(part).__module__.partition(".")[0])
    name = type(part).__name__
    return ComponentError(message, slot=slot, part=name, distribution=owner, frame=frame, iteration=iteration)


def _distribution(package: str) -> str:
    """Who ships a top-level package. Entry points first: of an editable install the list of files says nothing."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.dist is not None and point.module.partition(".")[0] == package:
            return point.dist.name
    return packages_distributions().get(package, [package])[0]
