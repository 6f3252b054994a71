"""The output folder of a run: never mixes two runs, never deletes what it does not know."""

from __future__ import annotations

from pathlib import Path

from gsstream.core.errors import OutputError

#: Files that say "a run lives here", and that a run may replace.
RUN_FILES = ("stream.gss", "metrics.jsonl", "recipe.yaml")
#: What is made from a finished run; a new run would make it anew or leave a stale one behind.
MADE_FILES = ("contact_sheet.png", "frames.png", "summary.txt", "video.mp4")


def prepare_output(out: Path, *, resume: bool = False, overwrite: bool = False) -> bool:
    """Make sure a run may write to ``out``; create it when missing.

    Arguments:
        resume: continue the run that ``out`` holds.
        overwrite: delete the ``RUN_FILES`` and ``MADE_FILES`` of the run that ``out`` holds; anything else stays, and
            where there is no run, everything does.

    Returns:
        Whether there is a run to continue.

    Raises:
        OutputError: it holds a run and neither is asked for; both are asked for; resume without a run; not a writable
            folder.
    """
    if resume and overwrite:
        raise OutputError("--resume continues the run in the output folder, --overwrite deletes it: give one of them")
    if out.exists() and not out.is_dir():
        raise OutputError(f"the output {out} is a file; expected a folder (it is created when missing)")
    present = [name for name in RUN_FILES if (out / name).exists()]
    if present and not resume and not overwrite:
        raise OutputError(
            f"the output folder {out} already holds a run ({', '.join(present)}): continue it with --resume, "
            "replace it with --overwrite, or choose another --out"
        )
    if resume and "stream.gss" not in present:
        raise OutputError(f"nothing to resume: {out} holds no stream.gss; leave --resume out to start a run there")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in (*RUN_FILES, *MADE_FILES) if overwrite and present else ():
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"the output folder {out} cannot be used: {error}") from error
    return bool(present) and resume
