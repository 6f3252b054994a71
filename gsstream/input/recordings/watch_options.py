"""WatchOptions: how a recording is followed while it is being written."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from gsstream.input.recordings.options import options_of_query


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

    @classmethod
    def from_query(cls, query: str) -> WatchOptions:
        """Read ``"timeout=10&behind=drop"``. Raises SourceError naming an unknown or impossible option."""
        return options_of_query(cls, query, "watch source")
