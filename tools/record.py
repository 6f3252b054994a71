"""Compare what two checkouts encode: bytes of every packet, quality and seconds, in one run on one machine.

Usage: python -m tools.record --before DIR [--after DIR] [--data DIR] [--methods NAME ...] [--worlds NAME ...]
       [--out DIR] [--repeat N]

Both folders are checkouts in which ``make setup`` was run. Each method encodes each recording in either checkout, in
turns, from one frame 0 that the first checkout made; frame 0 itself is compared as the line "frame 0", of s2gs-edge.
Sections ``meta`` and ``layers`` are left out: the first holds the recipe as text, the second its length.
One line per method and recording is printed, and written to OUT/record.jsonl.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

from gsstream.packet import StreamReader
from gsstream.packet.base import PacketKind, parse_packet

METHODS = (
    "s2gs", "s2gs-fast", "s2gs-edge", "s2gs-paper", "dense", "queen",
    "hicom", "recon", "quarc", "stream3dgs", "comgs-s",
)  # fmt: skip
IGNORED = {"meta", "layers"}


class World(NamedTuple):
    """A recording, the options it is run with, and how many frames are compared."""

    source: str
    options: tuple[str, ...]
    frames: int


def worlds(data: Path) -> dict[str, World]:
    """Return the recordings by name; those below ``data`` use the recipe that each checkout ships for them."""
    short = ("--set", "first_frame.max_iterations=600")
    recipes = Path("configs/recordings")
    rendered = ("--recipe", str(recipes / "pickblocks.yaml"), *short)
    real = ("--recipe", str(recipes / "panoptic_basketball.yaml"), *short)
    return {
        "demo": World("demo", ("--set", "first_frame.max_iterations=400"), 6),
        "pickblocks": World(str(data / "pickblocks_cycles_320"), rendered, 11),
        "basketball": World(str(data / "panoptic_basketball_30"), real, 11),
    }


def encode(checkout: Path, method: str, world: World, frames: int, out: Path, first: Path | None) -> str:
    """Run the command line of a checkout; return "" or the last line of what went wrong."""
    command = [
        str(checkout / ".venv/bin/gsstream"), "run", "--method", method, "--source", world.source, "--out", str(out),
        "--frames", str(frames), "--overwrite", "--no-pictures", "--no-video", "--quiet", *world.options,
    ]  # fmt: skip
    if first is not None:
        command += ["--first-frame", str(first)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else (done.stderr.strip() or "no message").splitlines()[-1]


def packets(run: Path) -> list[tuple[PacketKind, dict[str, bytes]]]:
    """Return kind and sections of every packet of a run, without the sections that hold the recipe."""
    with StreamReader(run / "stream.gss") as reader:
        parsed = [parse_packet(reader.read(entry), entry.offset) for entry in reader.frames]
    return [
        (header.kind, {name: part.data for name, part in sections.items() if name not in IGNORED})
        for header, sections in parsed
    ]


def first_difference(before: Path, after: Path) -> str:
    """Say where two runs differ first; empty when all packets are equal."""
    old, new = packets(before), packets(after)
    if len(old) != len(new):
        return f"{len(old)} packets and {len(new)}"
    for frame, ((kind, sections), (other, others)) in enumerate(zip(old, new, strict=True)):
        if kind != other:
            return f"frame {frame}: {kind.name} and {other.name}"
        changed = [name for name in {**sections, **others} if sections.get(name) != others.get(name)]
        if changed:
            return f"frame {frame}: {', '.join(changed)}"
    return ""


def numbers(run: Path, only_first: bool) -> dict[str, float]:
    """Return mean PSNR, KB and the median of the seconds of the later frames, or of frame 0."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    lines = lines[:1] if only_first else lines[1:]
    return {
        "psnr": mean(mean(line["psnr"].values()) for line in lines),
        "kb": mean(sum(line["bytes"].values()) for line in lines) / 1000,
        "seconds": median(sum(line["seconds"].values()) for line in lines),
    }


def compare(options: argparse.Namespace, method: str, name: str, world: World, first: Path | None) -> dict[str, Any]:
    """Encode with both checkouts in turns; return the differences, seconds as the least of the repetitions."""
    label = "frame 0" if first is None else method
    found: dict[str, list[dict[str, float]]] = {"before": [], "after": []}
    runs = {side: options.out / name / label.replace(" ", "-") / side for side in found}
    for _ in range(options.repeat):
        for side in found:
            frames = 1 if first is None else world.frames
            trouble = encode(getattr(options, side), method, world, frames=frames, out=runs[side], first=first)
            if trouble:
                return {"world": name, "method": label, "failed": side, "message": trouble}
            found[side].append(numbers(runs[side], first is None))
    old, new = ({key: min(row[key] for row in found[side]) for key in found[side][0]} for side in found)
    return {
        "world": name,
        "method": label,
        "difference": first_difference(runs["before"], runs["after"]),
        "psnr": [round(old["psnr"], 3), round(new["psnr"], 3)],
        "kb": [round(old["kb"], 3), round(new["kb"], 3)],
        "seconds": [round(old["seconds"], 3), round(new["seconds"], 3)],
        "time_ratio": round(new["seconds"] / old["seconds"], 3),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print a line each, and return 1 when any packet differs or any run fails."""
    parser = argparse.ArgumentParser(prog="python -m tools.record", description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, required=True, help="checkout to compare with")
    parser.add_argument("--after", type=Path, default=Path.cwd(), help="checkout that is compared; default: this one")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the recordings")
    parser.add_argument("--methods", nargs="+", default=METHODS, help="default: all")
    parser.add_argument("--worlds", nargs="+", default=["demo"], help="demo (default), pickblocks, basketball")
    parser.add_argument("--out", type=Path, default=Path("runs/record"), help="folder for the runs")
    parser.add_argument("--repeat", type=int, default=1, help="repetitions, of which the fastest counts")
    options = parser.parse_args(arguments)
    options.out, options.before, options.after = (p.resolve() for p in (options.out, options.before, options.after))
    options.out.mkdir(parents=True, exist_ok=True)
    known, equal = worlds(options.data.resolve()), True
    with (options.out / "record.jsonl").open("a") as log:
        for name in options.worlds:
            start = options.out / name / "frame-0" / "before" / "stream.gss"
            for method in (None, *options.methods):
                first = None if method is None else start
                row = compare(options, method or "s2gs-edge", name, world=known[name], first=first)
                equal &= row.get("difference") == ""
                log.write(json.dumps(row) + "\n")
                log.flush()
                print(_line(row), flush=True)
    return 0 if equal else 1


def _line(row: dict[str, Any]) -> str:
    head = f"{row['world']:11s} {row['method']:11s}"
    if "failed" in row:
        return f"{head} FAILED ({row['failed']}): {row['message']}"
    verdict = "equal" if not row["difference"] else f"DIFFERS {row['difference']}"
    (psnr, psnr_now), (kb, kb_now), (old, new) = row["psnr"], row["kb"], row["seconds"]
    return (
        f"{head} dB {psnr:6.2f} {psnr_now - psnr:+.3f}  KB {kb:7.2f} {100 * (kb_now / kb - 1):+.2f} %  "
        f"s {old:6.3f} x{new / old:.2f}  {verdict}"
    )


if __name__ == "__main__":
    sys.exit(main())
