"""What a recipe (section ``data``) and a URI may say of a recording. Imports nothing heavy, because recipes do not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeVar
from urllib.parse import parse_qsl

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gsstream.core.errors import SourceError, suggest

Options = TypeVar("Options", bound=BaseModel)

Leak = Literal["none", "points", "training"]
SplitName = Literal["reporting", "tuning"]
BadImage = Literal["stop", "repeat", "drop"]


class DataOptions(BaseModel):
    """Section ``data`` of a recipe: the split, and what is done about bad images."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    split: SplitName = Field(
        default="reporting",
        description="which cameras test. reporting: the test cameras, for results; tuning: the test cameras are taken "
        "away altogether and about one in six training cameras takes their place, for choosing settings",
    )
    test_cameras: tuple[str, ...] | None = Field(
        default=None, description="test cameras, by id; null: the recording's own split; []: none"
    )
    train_cameras: tuple[str, ...] | None = Field(
        default=None, description="cameras that train, by id; null: all that do not test"
    )
    train_views: int | None = Field(
        default=None, ge=2, description="keep this many training cameras, far from each other; null: all"
    )
    leak: Leak = Field(
        default="none",
        description="what test cameras may give: none; points: seeds of frame 0 (the paper's released code); "
        "training: they train, too (some published numbers)",
    )
    bad_image: BadImage = Field(
        default="stop",
        description="an image after frame 0 that cannot be read: stop: the run ends with its name; repeat: the "
        "camera's last image stands in; drop: the whole frame becomes an empty packet",
    )

    @property
    def touches_nothing(self) -> bool:
        """Whether the recording passes as it is."""
        return self == DataOptions()


def options_of_query(model: type[Options], query: str, source: str) -> Options:
    """Read ``"key=value&key=value"``. Raises SourceError naming one that is unknown, given twice or out of range."""
    known = ", ".join(model.model_fields)
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise SourceError(f"{source}: expected key=value&key=value, got {query!r}; keys: {known}") from error
    keys = [key for key, _ in pairs]
    for key in keys:
        if key not in model.model_fields:
            raise SourceError(f"{source}: unknown option {key!r}{suggest(key, model.model_fields)}; all: {known}")
        if keys.count(key) > 1:
            raise SourceError(f"{source}: option {key!r} is given more than once in {query!r}")
    return validated(model, dict(pairs), source)


def validated(model: type[Options], values: Mapping[str, Any], source: str) -> Options:
    """Return the options with these values. Raises SourceError naming one that is out of range, and what it means."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        meaning = model.model_fields[name].description
        raise SourceError(f"{source}: option {name!r} = {first['input']!r}: {first['msg']} ({meaning})") from error


class WatchOptions(BaseModel):
    """Options of ``watch:DIR?key=value&...``; times in seconds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ready: Literal["stable", "rename"] = Field(
        default="stable",
        description="when a file counts as written: stable: unchanged for 'settle', or something newer of its camera "
        "exists; rename: as soon as it exists (the writer renames finished files into place)",
    )
    settle: float = Field(default=0.2, ge=0, le=60, description="time a file must stay unchanged (ready=stable)")
    poll: float = Field(default=0.05, gt=0, le=10, description="time between two looks at the folder")
    behind: Literal["block", "drop", "hurry"] = Field(
        default="block",
        description="when more than 'queue' complete frames wait: block: encode every frame, the disk is the queue; "
        "drop: skip to the newest, skipped frames become empty packets; hurry: fewer epochs, in proportion",
    )
    queue: int = Field(default=4, ge=1, le=100_000, description="complete frames that may wait before 'behind' acts")
    min_epoch_scale: float = Field(default=0.2, gt=0, le=1, description="smallest share of the epochs (behind=hurry)")
    missing: Literal["wait", "hold", "drop"] = Field(
        default="wait",
        description="a camera whose image does not come: wait: until 'timeout', then the stream ends; "
        "hold: after 'grace' its last image stands in; drop: after 'grace' the frame becomes an empty packet",
    )
    grace: float = Field(default=2.0, ge=0, le=3600, description="wait for late cameras, counted from the others")
    timeout: float = Field(default=30.0, gt=0, le=86_400, description="nothing came for so long: the recording ends")
    end: str = Field(default="END", min_length=1, description="name of the file that says that nothing more will come")
