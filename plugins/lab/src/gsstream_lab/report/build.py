"""A sweep's folder -> the blocks of its report. Every number and figure comes from the table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from gsstream_lab.report.document import Block, Picture, Table
from gsstream_lab.report.figures import curve_groups, frame_curves, measured_costs, measured_goods, pareto_figure
from gsstream_lab.report.fronts import Effect, effects, knee, pareto_front
from gsstream_lab.report.groups import Group, SweepData, seed_noise, waited
from gsstream_lab.report.paper import beside_ours, paper_table
from gsstream_lab.report.quantities import BY_KEY, QUALITIES, cell
from gsstream_lab.report.rate_curves import curve_blocks

_NOT_MEASURED = {"joules": "energy"}
_MEANS = (
    "All quality is of frames that the same player decoded from packets. Means are over test cameras, then over the "
    "frames after the first; seconds are wall time, CPU s the time of the process. Moving pixels differ from frame "
    "0 by more than noise, changed ones by more than 0.1. KB are 1,000 bytes of packets, key packets apart."
)
_TEST_CAMERAS = {
    "reporting": "The test cameras are those of the recording (reporting split): choose no setting by this page.",
    "tuning": "The test cameras are training cameras left out (tuning split); the recording's own have no part in it. "
    "What is best here is a choice, not a result: measure it with --split reporting.",
}

_WAITED = (
    "The machine had other work: frames took more than 1.5 times the processor time they used. So seconds (wall) are "
    "in the table of all recipes alone, neither in a front nor in a figure of costs; compare CPU s."
)


def build_report(data: SweepData, shown: Mapping[str, Sequence[Block]]) -> list[Block]:
    """Return all blocks, in reading order."""
    blocks: list[Block] = [data.config["description"]] if data.config["description"] else []
    blocks += _where_it_ran(data)
    for scene in data.scenes:
        blocks += [*_scene(data, scene), *shown.get(scene, ())]
    if data.failed:
        rows = [["run", "reason"], *([label, reason.splitlines()[0]] for label, reason in data.failed.items())]
        blocks += ["## Failed", Table("Runs that failed", rows)]
    return blocks


def _where_it_ran(data: SweepData) -> list[Block]:
    """Return what ran where, by which cameras it was measured, and what was not measured."""
    runs = [run for group in data.groups for run in group.runs]
    rows = {run.id: run.row for run in runs}
    machines = {row["machine"] for row in rows.values()}
    lines = []
    for key in sorted(machines):
        facts = data.table.machines[key]["facts"]
        versions = ", ".join(f"{name} {version}" for name, version in facts["distributions"].items())
        gpu = f", {facts['gpu']}" if facts["gpu"] else ""
        mine = [row for row in rows.values() if row["machine"] == key]
        loads = [row["load_average"] for row in mine if row["load_average"] is not None]
        load = f", load {min(loads):.1f} to {max(loads):.1f}" if loads else ""
        dates = f"{min(row['date'] for row in mine)} to {max(row['date'] for row in mine)}"
        workers = ", ".join(sorted({f"{row['workers']} x {row['threads']}" for row in mine}))
        lines.append(
            [
                facts["processor"],
                f"{facts['processors_usable']}{gpu}",
                f"{workers}{load}",
                dates,
                f"Python {facts['python']}, torch {facts['torch']}, {versions}",
                facts["code"],
            ]
        )
    head = ["machine", "processors", "workers x threads", "when", "versions", "code"]
    count = f"{len(rows)} finished runs of {len(rows) + len(data.failed) + len(data.missing)}"
    notes = [f"{count}: {len(data.failed)} failed, {len(data.missing)} not run."]
    variants = sorted({row["ssim_variant"] for row in rows.values() if "ssim_variant" in row})
    notes.append(f"{_MEANS} {'; '.join(variants)}.")
    notes.append(_TEST_CAMERAS[data.config.get("split", "reporting")])
    missing = [name for key, name in _NOT_MEASURED.items() if not any(math.isfinite(g.mean(key)) for g in data.groups)]
    if missing:
        notes.append(f"Not measured: {', '.join(missing)} (no counter on this machine, or several workers shared it).")
    if waited(data.groups):
        notes.append(_WAITED)
    if not one_machine([data.table.machines[key]["facts"] for key in machines]):
        notes.append("The runs are of several machines or states of the code: their seconds do not compare.")
    return [" ".join(notes), Table("Where it ran", [head, *lines])]


def _scene(data: SweepData, scene: str) -> list[Block]:
    groups = data.of(scene)
    blocks: list[Block] = [f"## {scene}", _noise(groups)]
    if measured_goods(groups):
        blocks.append(
            Picture(
                f"{scene}-pareto.png",
                pareto_figure(groups, f"{scene}: quality against cost"),
                f"Quality against cost on {scene}, one point per recipe",
            )
        )
    blocks += [_fronts(groups), _all_runs(groups, data.measured())]
    found = effects(groups, [*QUALITIES, *measured_costs(groups)])
    if found:
        blocks += [_knobs(found, groups), _READING]
    blocks += curve_blocks(groups, scene)
    for name, rows in data.config.get("paper_tables", {}).items():
        blocks.append(beside_ours(paper_table(name), groups, scene, rows))
    curves = curve_groups(groups)
    blocks.append(
        Picture(
            f"{scene}-frames.png",
            frame_curves(curves, f"{scene}, seed {curves[0].runs[0].seed}"),
            f"Quality, bytes and seconds of every frame on {scene}{_some(curves, groups)}",
        )
    )
    return blocks


def one_machine(facts: Sequence[Mapping[str, Any]]) -> bool:
    """Say whether runs were made on one machine in one state.

    Runs with other plugins list other distributions; they compare as long as those that both have are the same.
    """
    for name in {name for one in facts for name in one} - {"distributions"}:
        if any(one.get(name) != facts[0].get(name) for one in facts):
            return False
    versions: dict[str, str] = {}
    return all(versions.setdefault(n, v) == v for one in facts for n, v in one["distributions"].items())


def _listed(names: Sequence[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more if names else "none"


def _some(curves: Sequence[Group], groups: Sequence[Group]) -> str:
    """A remark when the figure leaves recipes out; else empty."""
    return "" if len(curves) == len(groups) else f": {len(curves)} of {len(groups)} recipes, the others would hide them"


def _noise(groups: Sequence[Group]) -> str:
    frames = sorted({len(run.records) for group in groups for run in group.runs})
    held_out = ", ".join(sorted({name for group in groups for run in group.runs for name in run.records[0].psnr}))
    length = f"{' or '.join(map(str, frames))} frames, test cameras: {held_out or 'none'}. "
    noise = {key: seed_noise(groups, key) for key in (*QUALITIES, "kb")}
    if not math.isfinite(noise["psnr"]):
        return length + "One seed each: which differences are noise is not known, and nothing is called a tie."
    several = sum(len(group.runs) > 1 for group in groups)
    return length + (
        f"Noise between seeds (standard deviation, {several} recipes with several seeds): {noise['psnr']:.3f} dB, "
        f"{noise['psnr_moving']:.3f} dB on moving pixels, {noise['kb']:.2f} KB/frame. A difference within two standard "
        "errors of it is called a tie. Where frame 0 is shared over seeds, its own noise is not in these numbers."
    )


def _fronts(groups: Sequence[Group]) -> Table:
    """Who is on which front, and where the variants as they are stand."""
    rows = [["quality", "cost", "front, cheapest first (knee in brackets)", "not on it"]]
    for good in QUALITIES:
        for cost in measured_costs(groups):
            points = [(group.mean(cost), group.mean(good)) for group in groups]
            front = pareto_front(points)
            at = knee([points[i] for i in front])
            names = [f"[{groups[i].label}]" if n == at else groups[i].label for n, i in enumerate(front)]
            off = [groups[i].label for i in range(len(groups)) if i not in front]
            title = "whole image" if good == "psnr" else "moving pixels"
            rows.append([title, BY_KEY[cost].title, " < ".join(names), _listed(off)])
    return Table("Pareto fronts", rows)


def _all_runs(groups: Sequence[Group], keys: Sequence[str]) -> Table:
    """A row for each group, a column for each quantity."""
    rows = [["recipe", "seeds", *(BY_KEY[key].title for key in keys)]]
    for group in groups:
        cells = [cell(key, group.mean(key), group.spread(key)) for key in keys]
        rows.append([group.label, str(len(group.runs)), *cells])
    return Table("All recipes, mean ± standard deviation over seeds", rows)


_READING = (
    "Each row changes one knob of the recipe in the column 'from'. dB per KB and dB per second are given where quality "
    "and cost move the same way beyond the noise: what one more KB buys, or what saving one costs. '~' marks a tie. "
    "Percentages are of the recipe it was changed from."
)


def _knobs(found: Sequence[Effect], groups: Sequence[Group]) -> Table:
    """What each knob buys: quality on moving pixels and on the whole image, bytes and seconds."""
    costs = [key for key in ("kb", "cpu_seconds", "seconds") if key in measured_costs(groups)][:2]
    head = ["knob", "from", "PSNR, dB", "moving, dB"]
    for cost in costs:
        unit = "KB" if cost == "kb" else "s"
        head += [BY_KEY[cost].title, "", f"dB per {unit}", f"moving per {unit}"]
    rows = [[*head, "moving against KB"]]
    for effect in found:
        row = [effect.knob, effect.base.label, *(_delta(effect, good) for good in QUALITIES)]
        for cost in costs:
            share = 100 * effect.deltas[cost] / effect.base.mean(cost)
            row += [_delta(effect, cost), f"{share:+.0f} %", *(_ratio(effect.per(good, cost)) for good in QUALITIES)]
        rows.append([*row, effect.verdict("psnr_moving", "kb")])
    return Table("What a knob buys", rows)


def _delta(effect: Effect, key: str) -> str:
    form = BY_KEY[key].form.lstrip("+")
    return f"{'~' if effect.ties[key] else ''}{effect.deltas[key]:+{form}}"


def _ratio(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"
