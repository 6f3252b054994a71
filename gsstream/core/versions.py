"""One rule for every version number: other major refused, newer minor refused, older minor fine."""

from __future__ import annotations

import re

#: Cure for plugins and files that were written for an older major version.
NEWER_PLUGIN = "ask its author for a newer version"
NEWER_RECIPE = "write its keys as 'gsstream recipe METHOD' shows them, and set schema_version to that number"


def version_problem(what: str, written: str, spoken: str, cure: str = NEWER_PLUGIN) -> str | None:
    """Return why a ``what`` written for another "major.minor" cannot be used here, and ``cure``; None: it can."""
    match = re.fullmatch(r"(\d+)\.(\d+)", written)
    if match is None:
        return f"{what} version is {written!r}; expected 'major.minor', e.g. {spoken!r}"
    major, minor = int(match[1]), int(match[2])
    own_major, own_minor = (int(number) for number in spoken.split("."))
    if (major, minor) > (own_major, own_minor):
        return f"built for {what} {written}, this gsstream speaks {spoken}: upgrade gsstream"
    if major < own_major:
        return f"built for {what} {written}, this gsstream speaks {spoken}: {cure}"
    return None
