"""What a run starts from: a recording by its URI, those of plugins included, and frame 0 of another stream."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gsstream.core.errors import STRANGERS, GsstreamError, PacketError, PluginUnavailable, RecipeError
from gsstream.discovery.catalog import Catalog
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.transformed import transformed
from gsstream.packet import PlayerState, StreamReader, decode_packet
from gsstream.recipe.model import Recipe


def open_recording(uri: str, recipe: Recipe, catalog: Catalog) -> Source:
    """Open ``uri`` at the scale, with the split and through the transforms that a recipe asks for.

    Cameras and points come in coordinates that the cameras define; ``info.world`` leads back to those of the files.

    Arguments:
        recipe: its scale and section ``data``.
        catalog: catalogue of the sources that are installed.
        uri: "demo", "synthetic:...", a folder, or "NAME:..." where NAME is a part of the kind "source".

    Raises:
        SourceError: the recording cannot be read, or the recipe's ``data`` section names cameras it does not have.
        PluginUnavailable: the source's plugin cannot be loaded or failed to open the recording.
    """
    return _open(uri, recipe.scale, recipe.data, catalog)


def reopen_recording(uri: str, recipe: Mapping[str, Any], catalog: Catalog) -> Source:
    """Open ``uri`` as the run did whose recipe a stream carries. Raises RecipeError for unknown data options."""
    try:
        data = DataOptions.model_validate_json(json.dumps(recipe.get("data", {})))
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        raise RecipeError(
            f"the stream's recipe: data.{key}: {error.errors()[0]['msg']}; the stream is of another "
            "version of gsstream: open its recording with that one"
        ) from error
    return _open(uri, float(recipe.get("scale", 1.0)), data, catalog)


def _open(uri: str, scale: float, data: DataOptions, catalog: Catalog) -> Source:
    source = open_plain(uri, scale, catalog)
    try:
        return CanonicalSource(transformed(source, data), recording_similarity(source))
    except BaseException:
        source.close()
        raise


def open_plain(uri: str, scale: float, catalog: Catalog) -> Source:
    """Open ``uri`` as it is, in the coordinates of its files: by a plugin's source when the scheme names one."""
    scheme = uri.partition(":")[0]
    entry = catalog.entries.get(("source", scheme))
    if entry is None or entry.plugin == "builtin":
        return open_source(uri, scale)
    factory = catalog.resolve("source", scheme)
    try:
        source: Source = factory(uri, scale)
        if not isinstance(source, Source):
            raise TypeError(f"expected a gsstream.api.Source, got {type(source).__name__}")
    except GsstreamError:
        raise
    except STRANGERS as error:  # third-party code: reported with its owner's name
        raise PluginUnavailable(f"source {scheme!r} (from {entry.origin}) could not open {uri!r}: {error}") from error
    return source


def read_first_frame(path: Path) -> PlayerState:
    """Return the decoded first frame of a stream.

    Raises SourceError when there is no such file, PacketError when its first packet is missing or damaged.
    """
    with StreamReader(path) as reader:
        if not reader.frames:
            raise reader.damage or PacketError(f"{path} holds no complete packet yet", reader.end)
        entry = reader.frames[0]
        return decode_packet(None, reader.read(entry), offset=entry.offset)
