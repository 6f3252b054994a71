"""Failures at a seam are wrapped with who, where and when."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import packages_distributions

from gsstream.core.errors import ComponentError, GsstreamError
from gsstream.core.part import Part


@contextmanager
def guarded(slot: str, part: Part, frame: int | None) -> Iterator[None]:
    """Turn whatever a part raises into a ComponentError; errors raised on purpose pass unchanged."""
    try:
        yield
    except GsstreamError:
        raise
    except Exception as error:
        module = type(part).__module__.partition(".")[0]
        distribution = packages_distributions().get(module, [module])[0]
        raise ComponentError(
            f"{type(error).__name__}: {error}",
            slot=slot,
            part=type(part).__name__,
            distribution=distribution,
            frame=frame,
        ) from error
