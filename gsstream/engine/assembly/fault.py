"""The error about a part that failed: slot, part, distribution, place and frame."""

from __future__ import annotations

from importlib.metadata import entry_points, packages_distributions

from gsstream.core.errors import ComponentError
from gsstream.engine.assembly.call_location import Where
from gsstream.spec import ENTRY_POINT_GROUP


def fault(message: str, slot: str, part: object, where: Where | None = None) -> ComponentError:
    """Return the error about a part that failed, or did not do what it must."""
    owner = _distribution(type(part).__module__.partition(".")[0])
    place = where or Where()
    return ComponentError(
        message, slot=slot, part=type(part).__name__, distribution=owner, frame=place.frame, iteration=place.iteration
    )


def _distribution(package: str) -> str:
    """Who ships a top-level package. Entry points first: of an editable install the list of files says nothing."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.dist is not None and point.module.partition(".")[0] == package:
            return point.dist.name
    return packages_distributions().get(package, [package])[0]
