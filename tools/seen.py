"""What a stream shows of surfaces that training cameras see, for the results pages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from gsstream.cli.streams import named_recording
from gsstream.engine.run.recording import reopen_recording
from gsstream.evaluation.evaluate import evaluate
from gsstream.evaluation.records import mean
from gsstream.player.playback import Playback
from gsstream.plugins.catalog import load_catalog


def seen_numbers(stream: Path, frames: Sequence[int]) -> dict[str, float]:
    """Return PSNR, dB, on pixels whose surface training cameras see, and on those that changed; decodes the stream.

    Means over the frames after the first, and of each of ``frames`` what changed and is seen. What is not defined, as
    where nothing changed, is left out.
    """
    with Playback(stream) as playback:
        meta = playback.meta
    catalog = load_catalog()
    source = reopen_recording(named_recording(stream, meta, catalog), meta.recipe, catalog)
    try:
        found = evaluate(stream, source)
    finally:
        source.close()
    series = {key: found.series(key) for key in ("psnr_seen", "psnr_changed_seen")}
    numbers = {key: mean(list(values.values())[1:]) for key, values in series.items()}
    numbers |= {f"frame_{frame}": series["psnr_changed_seen"][frame] for frame in frames}
    return {key: float(f"{value:.6g}") for key, value in numbers.items() if math.isfinite(value)}
