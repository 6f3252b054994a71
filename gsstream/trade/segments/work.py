"""What is to be done for a recording in segments, settled before any worker starts, and the folder it is done in."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gsstream.core.errors import InputError, OutputError
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.run.output import RUN_FILES, prepare_output
from gsstream.recipe.load import ResolvedRecipe, recipe_hash
from gsstream.source.base import FrameSource
from gsstream.trade.jobs.folder import recording_uri
from gsstream.trade.segments.carry import leap_recipe, open_leap_recipe
from gsstream.trade.segments.drive import KEY_STREAMS, Setting
from gsstream.trade.segments.plan import PLAN, SegmentPlan, make_plan, write_plan


class Wanted(NamedTuple):
    """What a user asks of a run in segments, besides the recipe."""

    source: str
    out: Path
    segments: int
    start: Literal["warm", "open", "anew"]
    key_epochs: int
    first_frame: Path | None
    workers: int | None
    threads: int
    ray: str | None


class SegmentWork(NamedTuple):
    """What is to be done; ``facts`` must be the same to go on with it."""

    plan: SegmentPlan
    setting: Setting
    facts: dict[str, Any]


def make_work(
    wanted: Wanted, first: bytes | None, resolved: ResolvedRecipe, assembly: Assembly, recording: FrameSource
) -> SegmentWork:
    """Cut the recording into segments and settle the recipes of segments and leaps.

    Arguments:
        wanted: segments and how they start.
        resolved: recipe of the run.
        assembly: its live parts.
        recording: that is encoded.
        first: the stream that the first frame of the recording is taken from; None: it is reconstructed.

    Raises InputError for a recording whose end nobody knows, and where there are no gates to open.
    """
    number = recording.info.num_frames
    if number is None:
        raise InputError(f"{wanted.source!r} grows while it is read: nobody knows where its segments end; use 'run'")
    total = min(number, assembly.recipe.frames or number)
    plan = make_plan(total, wanted.segments, wanted.start, first_given=first is not None)
    uri = recording_uri(wanted.source, None)
    setting = Setting(uri, resolved, _carrying(resolved, assembly, wanted), wanted.ray is None)
    facts = {
        "source": uri, "segments": wanted.segments, "frames": total, "start": wanted.start,
        "key_epochs": wanted.key_epochs, "recipe": recipe_hash(assembly.recipe),
        "first_frame": None if first is None else f"{zlib.crc32(first):08x}",
    }  # fmt: skip
    return SegmentWork(plan, setting, facts)


def _carrying(resolved: ResolvedRecipe, assembly: Assembly, wanted: Wanted) -> ResolvedRecipe:
    """The recipe of a leap. Raises InputError where there are no gates to open."""
    if wanted.start != "open":
        return leap_recipe(resolved, wanted.key_epochs, assembly.stepper)
    if not assembly.stepper.reads("gate"):
        raise InputError(
            f"--start open: expected a method made of parts, got the stepper {resolved.recipe.stepper.name!r}, "
            "which has no gates; use warm or anew"
        )
    return open_leap_recipe(resolved, wanted.key_epochs)


def prepare_folder(out: Path, facts: dict[str, Any], first: bytes | None, *, resume: bool, overwrite: bool) -> None:
    """Make sure that ``out`` holds nothing else, or exactly this run; overwriting removes what such a run writes.

    Arguments:
        out: folder of the run.
        facts: that must be the same to go on.
        first: bytes of the stream that frame 0 is taken from, or None.
        resume: go on with what is there.
        overwrite: remove what such a run writes.

    Raises OutputError when the folder holds something else, or a run begun with other facts.
    """
    begun = (out / PLAN).is_file()
    if resume and overwrite:
        raise OutputError("--resume continues the run in the output folder, --overwrite deletes it: give one of them")
    if begun and not resume and not overwrite:
        raise OutputError(
            f"the output folder {out} already holds a run in segments: continue it with --resume, replace it with "
            "--overwrite, or choose another --out"
        )
    if not resume:
        prepare_output(out, overwrite=overwrite)
        for folder in (*out.glob("key-[0-9]*"), *out.glob("segment-[0-9]*")) if begun else ():
            for name in RUN_FILES:
                (folder / name).unlink(missing_ok=True)
        (out / KEY_STREAMS).unlink(missing_ok=True)
    write_plan(out, facts, resume=resume)
    if first is not None:
        (out / KEY_STREAMS).write_bytes(first)
