"""One rule for every version number: other major refused, newer minor refused, older minor fine."""

from __future__ import annotations

import re


def version_problem(what: str, written: str, spoken: str) -> str | None:
    """Say why something written for another version cannot be used here; None when it can.

    Arguments:
        what: the noun of the sentence, e.g. ``"component API"``.
        written: "major.minor" declared by the plugin or file.
        spoken: "major.minor" of this gsstream.
    """
    match = re.fullmatch(r"(\d+)\.(\d+)", written)
    if match is None:
        return f"{what} version is {written!r}; expected 'major.minor', e.g. {spoken!r}"
    major, minor = int(match[1]), int(match[2])
    own_major, own_minor = (int(number) for number in spoken.split("."))
    if (major, minor) > (own_major, own_minor):
        return f"built for {what} {written}, this gsstream speaks {spoken}: upgrade gsstream"
    if major < own_major:
        return f"built for {what} {written}, this gsstream speaks {spoken}: ask its author for a newer version"
    return None
