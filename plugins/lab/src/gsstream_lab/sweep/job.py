"""One cell in a worker process: data in, data out. A worker writes nothing that outlives it."""

from __future__ import annotations

import contextlib
import hashlib
import os
import statistics
import tempfile
import time
import traceback
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsstream.core.errors import STRANGERS
from gsstream.recipe.load import ResolvedRecipe
from gsstream_lab.sweep.config import Measure

if TYPE_CHECKING:
    from gsstream.engine.assembly.assemble import Assembly
    from gsstream.evaluation.evaluate import Evaluation
    from gsstream.input.recordings.base import Source

#: Fields of a record that say which view it is about; all others are numbers, extra metrics included.
_PLACE = ("frame", "camera", "extra")
_FPS_WARM_UP, _FPS_RENDERS = 5, 30


@dataclass(frozen=True, slots=True)
class Job:
    """What a worker is sent."""

    id: str  # of the cell or frame 0
    uri: str  # the recording, as this worker opens it
    resolved: ResolvedRecipe
    first_frame: bytes | None = None  # bytes of a stream whose frame 0 is taken over, or None
    measure: Measure | None = None  # what to measure; None for a frame 0 that is only to be shared
    work: str | None = None  # folder for temporary files, or None for the system's
    alone: bool = False  # whether no other cell runs beside it, so that the machine's energy is its own
    memory: int = 0  # bytes that a cluster keeps free for it; 0: nobody knows


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a worker sends back."""

    id: str
    #: Per frame: what the run wrote down, and what was measured on the decoded frame.
    frames: tuple[Mapping[str, Any], ...] = ()
    #: The recipe with every part's settings written out, and its ``recipe_hash``.
    recipe: Mapping[str, Any] = field(default_factory=dict)
    recipe_hash: str = ""
    stream: bytes = b""  # the bytes of the stream
    #: Facts that stay; ``run``: facts of this run (date, load, seconds, noise of cameras, pictures/second).
    machine: Mapping[str, Any] = field(default_factory=dict)
    run: Mapping[str, Any] = field(default_factory=dict)
    #: error, details: why there is nothing else, and the traceback.
    error: str | None = None
    details: str = ""


def run_job(job: Job) -> Outcome:
    """Run a cell here; whatever goes wrong becomes part of the outcome, so that the sweep goes on."""
    try:
        with tempfile.TemporaryDirectory(dir=job.work, prefix="cell-") as folder:
            return _run(job, Path(folder))
    except STRANGERS as error:  # the seam of a sweep: one bad cell is a record, not the end
        return Outcome(job.id, error=f"{type(error).__name__}: {error}", details=traceback.format_exc())


def _run(job: Job, folder: Path) -> Outcome:
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.engine.run.metrics_log import read_metrics
    from gsstream.engine.run.recording import open_recording, read_first_frame
    from gsstream.engine.run.session import METRICS, STREAM, run
    from gsstream.recipe.load import recipe_hash
    from gsstream_lab.energy import EnergyMeter, FrameEnergy

    started, catalog = time.perf_counter(), load_catalog()
    parts = assemble(job.resolved, catalog)
    first = None
    if job.first_frame is not None:
        (folder / "first.gss").write_bytes(job.first_frame)
        first = read_first_frame(folder / "first.gss")
    recording = open_recording(job.uri, parts.recipe, catalog)
    import gsstream_lab.jobs.warm  # noqa: F401  # what torch imports late is not part of any frame's time

    try:
        with EnergyMeter() if job.alone else contextlib.nullcontext() as meter:
            listener = None if meter is None else FrameEnergy(meter)
            result = run(parts, recording, folder, quiet=True, measure=False, first_frame=first, listener=listener)
        if result.interrupted:
            raise InterruptedError("the run was interrupted; the sweep's next start makes this cell again")
        frames = [line for _, line in read_metrics(folder / METRICS)]
        facts: dict[str, Any] = {}
        if job.measure is not None:
            facts = _measure(job.measure, folder / STREAM, recording, frames)
    finally:
        recording.close()
    machine, when = _machine(parts)
    facts |= {**when, "cell_seconds": time.perf_counter() - started, "threads": os.environ.get("GSSTREAM_THREADS")}
    return Outcome(
        id=job.id,
        frames=tuple(frames),
        recipe=parts.recipe.model_dump(mode="json"),
        recipe_hash=recipe_hash(parts.recipe),
        stream=(folder / STREAM).read_bytes(),
        machine=machine,
        run=facts,
    )


def _measure(measure: Measure, stream: Path, recording: Source, frames: list[dict[str, Any]]) -> dict[str, Any]:
    """Measure decoded frames; their values go into ``frames``. Returns facts about the whole stream."""
    from gsstream.evaluation.evaluate import evaluate
    from gsstream.metrics import SSIM_VARIANT, OnnxLpips
    from gsstream_lab.extras import VARIANTS, extras

    if len(recording.info.test) == 0:
        return {"not_measured": "the recording has no test cameras"}
    wanted = ["flicker", *(name for name in ("ms_ssim", "flip") if getattr(measure, name))]
    lpips = None if measure.lpips_onnx is None else OnnxLpips(Path(measure.lpips_onnx), None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the run has said already that nothing fast renders here
        evaluation = evaluate(stream, recording, lpips=lpips, extras=extras(wanted))
    for frame in frames:
        frame |= frame_values(evaluation, int(frame["frame"]), lpips is not None)
    facts: dict[str, Any] = {"ssim_variant": SSIM_VARIANT, "renderer": evaluation.renderer}
    facts["extra_variants"] = {name: VARIANTS[name] for name in wanted}
    facts["sigmas"] = dict(evaluation.sigmas)
    if lpips is not None:
        facts["lpips_variant"] = lpips.variant
    if measure.fps:
        facts["fps"] = frames_per_second(stream)
    return facts


def frame_values(evaluation: Evaluation, frame: int, lpips: bool) -> dict[str, dict[str, float | None]]:
    """Return quantity -> camera -> value of one frame; None where it is not defined."""
    from gsstream.evaluation.records import finite_or_none

    views = [view for view in evaluation.views if view.frame == frame]
    names = [name for name in views[0].__slots__ if name not in _PLACE and (lpips or "lpips" not in name)]
    values = {name: {view.camera: finite_or_none(getattr(view, name)) for view in views} for name in names}
    return values | {name: {view.camera: finite_or_none(view.extra[name]) for view in views} for name in views[0].extra}


def frames_per_second(stream: Path) -> float:
    """Measure pictures per second of the last frame and first test camera.

    It is the median of 30 renders after 5 that do not count.
    """
    from gsstream.player.playback import Playback
    from gsstream.player.render import render

    with Playback(stream) as playback:
        scene, meta = playback.state_at(playback.frames[-1]), playback.meta
        seconds = []
        for _ in range(_FPS_WARM_UP + _FPS_RENDERS):
            started = time.perf_counter()
            render(scene, meta.test, 0, meta.background)
            seconds.append(time.perf_counter() - started)
    return 1 / statistics.median(seconds[_FPS_WARM_UP:])


def _machine(parts: Assembly) -> tuple[dict[str, Any], dict[str, Any]]:
    """(what stays, what changes from run to run) of the machine and the code."""
    from importlib.metadata import version

    from gsstream_lab.jobs.machine import machine_facts

    facts = machine_facts()
    when = {name: facts.pop(name) for name in ("date", "load_average")}
    distributions = sorted({"gsstream", *parts.distributions})
    facts["distributions"] = {name: version(name) for name in distributions}
    facts["code"] = _code_hash(parts)
    return facts, when


def _code_hash(parts: Assembly) -> str:
    """Hash of the sources in use: tells two states of a checkout apart that have the same version."""
    import importlib

    used = (
        parts.structure,
        parts.confidence,
        parts.propagation,
        parts.gate,
        parts.regularizer,
        parts.update,
        parts.renderer,
    )
    digest = hashlib.sha256()
    for name in sorted({"gsstream", *(type(part).__module__.partition(".")[0] for part in used)}):
        for folder in importlib.import_module(name).__path__:
            files = (p for p in Path(folder).rglob("*") if p.suffix in (".py", ".so", ".pyd", ".yaml"))
            for path in sorted(files):
                digest.update(str(path.relative_to(folder)).encode())
                with contextlib.suppress(FileNotFoundError):
                    digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
