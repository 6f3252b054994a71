"""A recipe for a budget: a few named recipes and knobs on a few frames, and the best of those that fit.

A pilot is a sweep of one scene (:mod:`gsstream_lab.sweep.drive`): resumable, one frame 0 for all, decoded frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError
from gsstream.evaluation.records import mean, mean_of_views
from gsstream.evaluation.summary import format_table
from gsstream.recipe.budget import Budget
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.save import to_yaml
from gsstream_lab.sweep.config import FirstFrame, Scene, SweepConfig, Variant
from gsstream_lab.sweep.drive import FIRST_FRAMES, first_frame_file, write_whole
from gsstream_lab.sweep.plan import Plan
from gsstream_lab.sweep.table import TableWriter

#: Methods that are tried where they are installed and none is named.
METHODS = ("dense", "s2gs-edge", "s2gs-fast", "s2gs")
#: A recipe fits when this share of its frames does.
FITS = 0.95
#: Differences of quality below this are ties, which fewer bytes decide, dB.
TIE = 0.02


@dataclass(frozen=True, slots=True)
class Trial:
    """What a candidate did on the pilot's frames, the first left out."""

    name: str
    #: psnr, moving: dB, means.
    psnr: float = math.nan
    moving: float = math.nan
    sizes: tuple[int, ...] = ()  # bytes
    seconds: tuple[float, ...] = ()  # by the budget's clock
    memory: float = math.nan  # largest of all, bytes
    inside: int = 0  # frames inside every limit
    error: str | None = None  # why there is nothing else

    @property
    def frames(self) -> int:
        return len(self.sizes)

    @property
    def fits(self) -> bool:
        return self.frames > 0 and self.inside >= FITS * self.frames

    @property
    def quality(self) -> float:
        """PSNR on moving pixels; on the whole picture where nothing moves."""
        return self.moving if math.isfinite(self.moving) else self.psnr


def candidates(methods: Sequence[str], budget: Budget) -> list[Variant]:
    """Return what is tried: each method as it is, with a knob or two for what is limited, with the controller."""
    limits = {f"budget.{name}": value for name, value in budget.model_dump(exclude_defaults=True).items()}
    out = []
    for method in methods:
        knobs: list[tuple[str, dict[str, Any]]] = [("", {})]
        if budget.size is not None:
            knobs += [("+rate-1e-3", {"stream.rd_lambda": 1e-3}), ("+rate-3e-3", {"stream.rd_lambda": 3e-3})]
        if budget.time is not None:
            knobs += [("+epochs-4", {"stream.epochs": 4}), ("+change-12", {"stream.change_threshold": 12.0})]
        if budget.limits_frames:
            knobs.append(("+budget", limits))
        memory = {} if budget.memory is None else {"budget.memory": budget.memory}
        out += [Variant(name=f"{method}{name}", method=method, set={**memory, **values}) for name, values in knobs]
    return out


def pilot(scene: Scene, methods: Sequence[str], budget: Budget, seed: int) -> SweepConfig:
    """Return the sweep that tries them."""
    return SweepConfig(
        name="tune",
        description="pilot of gsstream tune",
        scenes=[scene],
        seeds=[seed],
        variants=candidates(methods, budget),
        first_frame=FirstFrame(share="scene"),
    )


def give_first_frame(plan: Plan, out: Path, stream: Path) -> None:
    """Let the pilot take frame 0 over from a stream. Raises InputError when ``out`` has another one already."""
    content = stream.read_bytes()
    (out / FIRST_FRAMES).mkdir(parents=True, exist_ok=True)
    table = TableWriter(out)
    for key in plan.firsts:
        file = first_frame_file(out, key)
        if file.is_file() and file.read_bytes() != content:
            raise InputError(f"{out} holds a pilot from another frame 0 than {stream}; choose another --out")
        write_whole(file, content)
        if key not in table.data.first_frames:
            table.append("first_frame", {"id": key, "status": "done", "given": str(stream), "frames": []})


def trial_of(name: str, row: Mapping[str, Any], budget: Budget) -> Trial:
    """Return a cell's line of the sweep's table, held against the budget."""
    if row["status"] != "done":
        return Trial(name, error=str(row.get("error", "it was not run")))
    later = [frame for frame in row["frames"] if frame["frame"] > 0]
    sizes = tuple(sum(frame["bytes"].values()) for frame in later)
    seconds = tuple(float(sum(f["seconds"].values())) for f in later)
    memory = [1e6 * frame["peak_memory_mb"] for frame in later]
    limits = (budget.size or math.inf, budget.time or math.inf, budget.memory or math.inf)
    costs = zip(sizes, seconds, memory, strict=True)
    inside = sum(all(cost <= limit for cost, limit in zip(frame, limits, strict=True)) for frame in costs)
    whole, moving = (mean_of_views(later, name) for name in ("psnr", "psnr_moving"))
    return Trial(name=name, psnr=whole, moving=moving, sizes=sizes, seconds=seconds, memory=max(memory), inside=inside)


def choose(trials: Sequence[Trial]) -> Trial | None:
    """Return the best of those that fit; of equals the one with fewer bytes; None when nothing fits.

    Raises InputError when nothing was measured: a recording without test cameras has no quality to choose by.
    """
    fitting = [trial for trial in trials if trial.fits]
    if any(not math.isfinite(trial.quality) for trial in fitting):
        raise InputError(
            "nothing to choose by: no test cameras; leave --set data.split=reporting out, or hold cameras out with "
            "--set 'data.test_cameras=[NAME, ...]'"
        )
    if not fitting:
        return None
    best = max(trial.quality for trial in fitting)
    return min((t for t in fitting if t.quality >= best - TIE), key=lambda t: sum(t.sizes))


def nearest(trials: Sequence[Trial]) -> Trial | None:
    """Return, of what does not fit, the one with most frames inside, then with fewest bytes."""
    tried = [trial for trial in trials if trial.frames]
    return max(tried, key=lambda t: (t.inside / t.frames, -sum(t.sizes)), default=None)


def tune_table(trials: Sequence[Trial], chosen: Trial | None) -> str:
    """Return one row per candidate, the best first; "-" where nothing was measured."""
    head = ["recipe", "inside", "PSNR", "moving", "KB/frame", "most KB", "s/frame", "most s", "peak MB", ""]
    rows = [head]
    order = sorted(trials, key=lambda t: (not t.fits, -t.quality if math.isfinite(t.quality) else math.inf))
    for trial in order:
        if trial.error is not None:
            rows.append([trial.name, *["-"] * 8, "failed"])
            continue
        kb, sec = [size / 1000 for size in trial.sizes], trial.seconds
        numbers = [trial.psnr, trial.moving, mean(kb), max(kb), mean(sec), max(sec), trial.memory / 1e6]
        forms = ["{:.2f}", "{:.2f}", "{:.1f}", "{:.1f}", "{:.2f}", "{:.2f}", "{:.0f}"]
        cells = [form.format(n) if math.isfinite(n) else "-" for n, form in zip(numbers, forms, strict=True)]
        rows.append([trial.name, f"{trial.inside}/{trial.frames}", *cells, "<- chosen" if trial is chosen else ""])
    failed = [f"{trial.name} failed: {trial.error}" for trial in trials if trial.error is not None]
    return "\n".join([format_table(rows), *failed])


def tuned_recipe(resolved: ResolvedRecipe) -> str:
    """Return the chosen recipe as ``gsstream run --recipe`` takes it.

    It is whole, without the pilot's number of frames, and trains on all training cameras: the tuning split was there to
    choose.
    """
    data = resolved.recipe.data.model_copy(update={"split": "reporting"})
    recipe = resolved.recipe.model_copy(update={"frames": None, "data": data})
    return to_yaml(ResolvedRecipe(recipe, resolved.origins))
