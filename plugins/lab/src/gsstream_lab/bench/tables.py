"""Benchmarks as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsstream.evaluation.summary import format_table
from gsstream_lab.bench.timing import cell, headline


def render_table(data: Mapping[str, Any]) -> str:
    """Return the table of ``bench render``: a row per case, ms, least of the repetitions unless it says median."""
    times = ["forward", "backward", "both", "median", "cpu", "floor", "x floor", "cpu x"]
    rows = [["renderer", "rows", "scene", "tiles", "thr", *times]]
    for case in data["cases"]:
        scene = f"{case['gaussians'] / 1000:g}k {case['width']}x{case['height']}"
        rows.append(
            [
                f"{case['renderer']} ({case['level']})",
                "all" if case["path"] == "all rows" else f"{case['rows']}",
                scene,
                f"{case['share']:.0%}",
                str(case["threads"]),
                cell(case["forward_ms"]["min"]),
                cell(case["backward_ms"]["min"]),
                cell(case["total_ms"]["min"]),
                cell(case["total_ms"]["median"]),
                cell(case["total_ms"]["cpu"]),
                cell(case["roofline_ms"]),
                cell(case["ratio"], ".1f"),
                cell(case["ratio_cpu"], ".1f"),
            ]
        )
    isa = f", {data['machine']['isa']}" if data["machine"]["isa"] else ""
    peaks = [
        f"{p['threads']} threads: {p['gflops']:.0f} GFLOP/s, {p['gbytes_per_second']:.1f} GB/s" for p in data["peaks"]
    ]
    notes = [
        headline(data["machine"]) + isa,
        "Peaks: " + ("; ".join(peaks) if peaks else "not measured"),
        "Times in ms, least of the repetitions. kernel: memory at hand, no torch; part: what the engine pays. A number",
        "of rows: only these change, the rest is cached. cpu: processor time of all threads, which other programs",
        "inflate less than the time that passes. Floor: counted work at the peaks (gsstream_lab/bench/floor.py).",
        "cpu x: distance to the floor had the threads run undisturbed (processor time over threads).",
        *(f"Not run: {s['renderer']} at {s['size']}: {s['why']}" for s in data["skipped"]),
    ]
    return format_table(rows) + "\n\n" + "\n".join(notes)


def frame_table(data: Mapping[str, Any]) -> str:
    """Return the table of ``bench frame``: a row per case, seconds, least of the repetitions unless it says median."""
    phases = list(dict.fromkeys(phase for case in data["cases"] for phase in case["phases_ms"]))
    head = ["case", "static", "variant", "changed", "rows", "s", "cpu s", *phases, "bytes", "PSNR", "held", "of dense"]
    rows = [head]
    whole = {
        (case["sweep"], case["static"]): case["total_ms"]["min"] for case in data["cases"] if case["variant"] == "dense"
    }
    for case in data["cases"]:
        least = case["total_ms"]["min"]
        rows.append(
            [
                case["sweep"],
                f"{case['static'] / 1000:g}k",
                case["variant"],
                f"{case['changed_tiles']:.1%}",
                str(case.get("candidate_gaussians", "-")),
                cell(least / 1000, ".4f"),
                cell(case["total_ms"]["cpu"] / 1000, ".4f"),
                *(cell(case["phases_ms"][p]["min"] / 1000 if p in case["phases_ms"] else None, ".4f") for p in phases),
                str(case["bytes"]),
                cell(case["psnr"]),
                cell(case["psnr_if_held"]),
                "1/" + cell(whole[case["sweep"], case["static"]] / least, ".1f"),
            ]
        )
    s = data["settings"]
    notes = [
        headline(data["machine"]),
        f"Method {s['method']}, renderer {s['renderer']}, {s['epochs']} epochs, {s['views']} views of {s['width']}x"
        f"{s['height']}, one torch thread; peak memory of the benchmark {data['peak_memory_mb']:.0f} MB.",
        "dense: every gate open, everything takes part; gated: the recipe's gates; active: only what changed beyond",
        f"{s['change_threshold']:g} sigmas takes part. Seconds, least of the repetitions (cpu: processor time of all",
        "threads). changed: share of tiles in which a pixel differs by more than 3/255. rows: Gaussians that took",
        "part. PSNR: against the frame without noise; held: had nothing been sent.",
    ]
    return format_table(rows) + "\n\n" + "\n".join(notes)
