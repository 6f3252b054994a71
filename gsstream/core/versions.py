"""One rule for every version number: other major refused, newer minor refused, older minor fine."""

from __future__ import annotations

import re

from gsstream.core.install_hints import page

#: The page that says what became of the kinds and names of older interfaces.
MIGRATE = "howto/migrate.md"
#: Cure for files that were written for an older major version.
NEWER_RECIPE = "write its keys as 'gsstream recipe METHOD' shows them, and set schema_version to that number"


def newer_plugin() -> str:
    """Return the cure for plugins that were written for an older major version, whoever reads it."""
    return f"ask its author for a newer version; if you are, {page(MIGRATE)} says what became of what"


def version_problem(what: str, written: str, spoken: str, cure: str | None = None) -> str | None:
    """Return why a ``what`` written for another "major.minor" cannot be used here, and a cure; None: it can.

    The cure of one that is too old is ``cure``, else that of plugins.
    """
    match = re.fullmatch(r"(\d+)\.(\d+)", written)
    if match is None:
        return f"{what} version is {written!r}; expected 'major.minor', e.g. {spoken!r}"
    major, minor = int(match[1]), int(match[2])
    own_major, own_minor = (int(number) for number in spoken.split("."))
    if (major, minor) > (own_major, own_minor):
        return f"built for {what} {written}, this gsstream speaks {spoken}: upgrade gsstream"
    if major < own_major:
        return f"built for {what} {written}, this gsstream speaks {spoken}: {cure or newer_plugin()}"
    return None
