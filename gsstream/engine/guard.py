"""Failures at a seam are wrapped with who, where and when."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points, packages_distributions

from gsstream.core.errors import ComponentError, GsstreamError
from gsstream.core.part import Part
from gsstream.spec import ENTRY_POINT_GROUP


@contextmanager
def guarded(slot: str, part: Part, frame: int | None) -> Iterator[None]:
    """Turn whatever a part raises into a ComponentError; errors raised on purpose pass unchanged."""
    try:
        yield
    except GsstreamError:
        raise
    except Exception as error:
        raise fault(f"{type(error).__name__}: {error}", slot, part, frame) from error


def fault(message: str, slot: str, part: Part, frame: int | None) -> ComponentError:
    """The error about a part that failed, or did not do what it must."""
    owner = _distribution(type(part).__module__.partition(".")[0])
    return ComponentError(message, slot=slot, part=type(part).__name__, distribution=owner, frame=frame)


def _distribution(package: str) -> str:
    """Who ships a top-level package. Entry points first: of an editable install the list of files says nothing."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.dist is not None and point.module.partition(".")[0] == package:
            return point.dist.name
    return packages_distributions().get(package, [package])[0]
