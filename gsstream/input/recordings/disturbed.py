"""``disturbed:KEY=VALUE,...:URI``: a recording that is disturbed on purpose, for experiments and tests.

::

    gsstream run --source disturbed:noise_sigma=20,seed=1:demo ...
    gsstream run --source disturbed:lost_cameras=cam03@10-20+cam05@3-4,lost_as=black:FOLDER ...
    gsstream run --source disturbed:time_offset=cam03@2:FOLDER ...

A stream names the whole URI as its recording, so that evaluating and resuming see the same disturbed images.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from gsstream.core.errors import SourceError, suggest
from gsstream.input.recordings.base import FrameSource, SourceInfo
from gsstream.input.recordings.options import DataOptions, Disturbances, validated
from gsstream.input.recordings.transformed import TransformedSource

_KEYS = ("seed", *Disturbances.model_fields)
_PER_CAMERA = ("lost_cameras", "time_offset")


def parse_disturbances(text: str) -> tuple[Disturbances, int]:
    """Read options and seed from ``"KEY=VALUE,..."``.

    Raises SourceError naming an unknown key or an impossible value.
    """
    values: dict[str, Any] = {}
    for part in text.split(",") if text else ():
        key, equals, value = part.partition("=")
        if not equals or key not in _KEYS:
            near = suggest(key, _KEYS) if equals else ""
            raise SourceError(f"disturbed source: expected KEY=VALUE,..., got {part!r}{near}; keys: {', '.join(_KEYS)}")
        if key in values:
            raise SourceError(f"disturbed source: {key!r} is given twice")
        values[key] = tuple(value.split("+")) if key in _PER_CAMERA else value
    seed = str(values.pop("seed", "0"))
    if not re.fullmatch(r"\d{1,9}", seed):
        raise SourceError(f"disturbed source: seed: expected a whole number from 0, got {seed!r}")
    return validated(Disturbances, values, "disturbed source"), int(seed)


class DisturbedSource(TransformedSource):
    """A recording under disturbances that its own URI names."""

    def __init__(self, source: FrameSource, disturbances: Disturbances, seed: int, uri: str) -> None:
        super().__init__(source, DataOptions(), disturbances, seed)
        self._uri = uri

    @property
    def info(self) -> SourceInfo:
        """That of the recording, under the URI that brings the disturbances back."""
        return replace(self._info, uri=self._uri)
