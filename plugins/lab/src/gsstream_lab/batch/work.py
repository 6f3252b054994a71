"""One recording in a worker: data in, results at a place or, where that is a folder of the caller, back to him."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from gsstream.core.errors import STRANGERS
from gsstream.recipe.load import ResolvedRecipe

#: The file that says that a result is whole; written last.
NOTE = "job.json"
#: Seconds that a worker waits for a store that does not answer.
PATIENCE = 120.0


@dataclass(frozen=True, slots=True)
class BatchJob:
    """What a worker is sent."""

    id: str
    uri: str  # the recording, as this worker opens it
    resolved: ResolvedRecipe
    folder: str  # where the results lie at their place
    to: str | None  # address of the place; None: the results are returned
    work: str | None = None  # folder for temporary files, or None for the system's
    memory: int = 0  # bytes that a cluster keeps free for it; 0: nobody knows


@dataclass(frozen=True, slots=True)
class BatchOutcome:
    """What a worker sends back."""

    id: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)  # name -> bytes, where they are not brought already
    error: str | None = None
    details: str = ""


def run_batch_job(job: BatchJob) -> BatchOutcome:
    """Encode a recording; whatever goes wrong becomes part of the outcome, so that the others go on."""
    try:
        with tempfile.TemporaryDirectory(dir=job.work, prefix="batch-") as folder:
            return _run(job, Path(folder))
    except STRANGERS as error:  # the seam of a batch: one bad recording is a record, not the end
        return BatchOutcome(job.id, error=f"{type(error).__name__}: {error}", details=traceback.format_exc())


def _run(job: BatchJob, folder: Path) -> BatchOutcome:
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.engine.run.output import RUN_FILES
    from gsstream.engine.run.recording import open_recording
    from gsstream.engine.run.session import run
    from gsstream.store.troubles import patiently

    began, catalog = time.perf_counter(), load_catalog()
    parts = assemble(job.resolved, catalog)
    recording = patiently(lambda: open_recording(job.uri, parts.recipe, catalog), PATIENCE)
    try:
        result = run(parts, recording, folder, quiet=True)
    finally:
        recording.close()
    if result.interrupted:
        raise InterruptedError("the run was interrupted; the next start of the batch makes it again")
    files = {f"{job.folder}/{name}": (folder / name).read_bytes() for name in RUN_FILES}
    facts = _facts(job, folder, time.perf_counter() - began)
    files[f"{job.folder}/{NOTE}"] = (json.dumps(facts, indent=1) + "\n").encode()
    if job.to is None:
        return BatchOutcome(job.id, facts, files)
    bring(files, job.to)
    return BatchOutcome(job.id, facts)


def bring(files: Mapping[str, bytes], to: str) -> None:
    """Put the files of a result to its place, the note last: without that there is no result."""
    from gsstream.store.place import place_at
    from gsstream.store.troubles import patiently

    place = place_at(to)
    for name, data in files.items():
        patiently(partial(place.put, name, data), PATIENCE)


def _facts(job: BatchJob, folder: Path, seconds: float) -> dict[str, Any]:
    """What the note says: which job, and what came of it."""
    from gsstream.engine.run.metrics_log import read_metrics
    from gsstream.evaluation.records import mean
    from gsstream.input.recordings.origin import public_uri
    from gsstream.metrics import peak_memory_mb
    from gsstream.recipe.load import recipe_hash

    stream = (folder / "stream.gss").read_bytes()
    lines = [line for _, line in read_metrics(folder / "metrics.jsonl")]
    quality = [line["psnr"] for line in lines if isinstance(line.get("psnr"), int | float)]
    return {
        "job": job.id,
        "recording": public_uri(job.uri),
        "recipe": recipe_hash(job.resolved.recipe),
        "frames": len(lines),
        "bytes": len(stream),
        "sha256": hashlib.sha256(stream).hexdigest(),
        "psnr": mean(quality) if quality else None,
        "seconds": round(seconds, 3),
        "peak_mb": round(peak_memory_mb(), 1),
    }
