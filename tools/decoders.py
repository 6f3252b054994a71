"""Four decoders of one format on the same streams: whether their frames are equal to the bit, and what a frame costs.

    python -m tools.decoders agree STREAM [STREAM ...]
    python -m tools.decoders time [STREAM ...] [--rounds 7]

Python is gsstream's own decoder, JavaScript that of its page in node, C that of plugins/c_decoder with -O2, and wasm
the same compiled for WebAssembly, in node; the last is left out where `ziglang` is not installed. ``time`` measures the
streams that are named, and two of 60,000 Gaussians that it makes: each delta moves a tenth of the groups and changes
3,000 rows in four attributes; in the second one 50 rows leave, too. It prints rows for
docs/results/data/decoders.jsonl: milliseconds of processor time a packet, the median over the packets of the least over
the rounds; and what drawing a frame at 640 x 360 and writing a PNG takes after that. ``agree`` prints how many frames
were compared; its exit code is 1 where one differs.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.packet import PacketKind, PlayerState, StreamReader, decode_packet
from gsstream.packet.conformance import play_here, play_with
from gsstream.packet.gates import encode_gates
from gsstream.player.paths import resized
from gsstream.player.playback import Playback
from gsstream.player.render import render, to_bytes
from tools.conformance.moving import motion, section, written
from tools.conformance.residuals import residual
from tools.conformance.tapes import Tape
from tools.decoder_in_c import FOLDER, Library, play

ROOT = Path(__file__).parents[1]
GAUSSIANS, NODES, FRAMES, DRAWN, ROUNDS = 60_000, 6_000, 12, 12, 7


def large_stream(number: int = GAUSSIANS, nodes: int = NODES, frames: int = FRAMES, *, leave: int = 0) -> bytes:
    """Return a stream of many Gaussians whose every delta has a motion, a residual, and ``leave`` rows that leave."""
    tape = Tape().start(1, number, nodes, 3, spread=2.0)
    while len(tape.packets) < frames:
        frame = tape.next
        moved = motion(tape.here.scene, frame, cell=1.0, bins=2, share=0.1)
        changed = residual(tape, frame, ["means", "quats", "opacities", "sh0"], levels=4, share=0.05)
        gone = np.zeros(len(tape.here.gaussians), np.uint8)
        gone[np.random.default_rng(frame).permutation(len(gone))[:leave]] = 1
        rows = [("removed", encode_gates(gone, 1))] if leave else []
        tape.delta([("motion", section(written(moved))), *changed, *rows])
    return tape.bytes()


def wasm_module(folder: Path) -> Path | None:
    """Compile the decoder for WebAssembly into a folder; None where there is no compiler for that."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    if (folder / "build" / "gss.wasm").exists():
        return folder / "build" / "gss.wasm"
    for name in ("src", "Makefile"):
        (folder / name).symlink_to(FOLDER / name)
    command = ["make", "-C", str(folder), "wasm", f"WASM_CC={sys.executable} -m ziglang cc"]
    subprocess.run(command, capture_output=True, timeout=600, check=True)
    return folder / "build" / "gss.wasm"


def node(*words: object) -> str:
    """Return what a script of node prints."""
    done = subprocess.run(["node", *map(str, words)], capture_output=True, text=True, timeout=900, check=True)
    return done.stdout


def agree(paths: Sequence[Path], folder: Path) -> list[str]:
    """Return a line for each stream: how many frames were decoded, by whom, and who differs."""
    library, module = Library(folder), wasm_module(folder)
    dump = ["node", str(FOLDER / "wasm" / "dump.mjs"), str(module)]
    lines = []
    for path in paths:
        outcomes = {"Python": play_here(path).lines}
        outcomes["JavaScript"] = play_with(["node", str(ROOT / "tests" / "conformance" / "javascript.mjs")])(path).lines
        digests, fault = play(library, path.read_bytes())
        with StreamReader(path) as reader:
            first = reader.frames[0].frame
        outcomes["C"] = tuple(f"{i} {digest}" for i, digest in enumerate(digests, first))
        outcomes["C"] += ("refused",) if fault else ()
        if module is not None:
            outcomes["wasm"] = play_with(dump)(path).lines
        other = [name for name, found in outcomes.items() if found != outcomes["Python"]]
        verdict = f"other frames from {', '.join(other)}" if other else "equal"
        lines.append(f"{path}: {len(outcomes['Python'])} frames, {', '.join(outcomes)}: {verdict}")
    return lines


def python_times(path: Path, rounds: int) -> list[float]:
    """Return the least milliseconds of each frame's packet, gsstream's own decoder."""
    with StreamReader(path) as reader:
        packets = [(entry.offset, reader.read(entry)) for entry in reader.frames]
    least = [float("inf")] * len(packets)
    for _ in range(rounds):
        state: PlayerState | None = None
        for i, (offset, data) in enumerate(packets):
            before = time.process_time()
            state = decode_packet(state, data, offset=offset)
            least[i] = min(least[i], 1000 * (time.process_time() - before))
    return least


def c_times(library: Library, path: Path, rounds: int) -> list[float]:
    """Return the same of the decoder in C; ctypes takes a microsecond of each."""
    least: list[float] = []
    for _ in range(rounds):
        took = []
        with library.open(path.read_bytes()) as stream:
            before = time.process_time()
            while stream.next():
                took.append(1000 * (time.process_time() - before))
                before = time.process_time()
        least = [min(pair) for pair in zip(least or took, took, strict=True)]
    return least


def draw_times(path: Path, rounds: int) -> list[float]:
    """Return the least milliseconds of drawing some frames from one camera at 640 x 360 and packing them as PNG."""
    with Playback(path) as playback:
        camera = resized(playback.cameras("train"), 640, 360)
        scenes = [playback.state_at(frame) for frame in playback.frames[1:DRAWN]]
    least = [float("inf")] * len(scenes)
    for _ in range(rounds):
        for i, scene in enumerate(scenes):
            before = time.process_time()
            picture = to_bytes(render(scene, camera, 0, (0.0, 0.0, 0.0)))
            Image.fromarray(picture).save(io.BytesIO(), "PNG")
            least[i] = min(least[i], 1000 * (time.process_time() - before))
    return least


def measured(path: Path, folder: Path, rounds: int) -> list[dict[str, Any]]:
    """Return a row for the key packets and one for the deltas of a stream."""
    module = wasm_module(folder)
    times = {"python_ms": python_times(path, rounds)}
    packets = json.loads(node(ROOT / "tools" / "web_speed.mjs", path, rounds))["packets"]
    times["javascript_ms"] = [packet["leastCpu"] for packet in packets]
    times["c_ms"] = c_times(Library(folder), path, rounds)
    if module is not None:
        times["wasm_ms"] = json.loads(node(ROOT / "tools" / "wasm_speed.mjs", module, path, rounds))
    with StreamReader(path) as reader:
        kinds = [entry.kind for entry in reader.frames]
        rows = len(decode_packet(None, reader.read(reader.frames[0])).gaussians)
    found = []
    for kind, name in ((PacketKind.KEY, "key"), (PacketKind.DELTA, "delta")):
        chosen = [i for i, each in enumerate(kinds) if each == kind]
        numbers = {who: round(statistics.median(took[i] for i in chosen), 3) for who, took in times.items()}
        row = {"stream": path.parent.name, "Gaussians": rows, "packet": name, "packets": len(chosen), **numbers}
        found.append({**row, "c_most_ms": round(max(times["c_ms"][i] for i in chosen), 3)})
    found[-1]["draw_ms"] = round(statistics.median(draw_times(path, rounds)), 1)
    return found


def main() -> int:
    """Run the job; the exit code is 1 where decoders differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=("agree", "time"))
    parser.add_argument("streams", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    said = parser.parse_intermixed_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if said.job == "agree":
            lines = agree(said.streams, folder)
            print(*lines, sep="\n")
            return int(any("other frames" in line for line in lines))
        made = {"synthetic": 0, "synthetic, rows leave": 50}
        for title, leave in made.items():
            (folder / title).mkdir()
            (folder / title / "stream.gss").write_bytes(large_stream(leave=leave))
        for path in (*said.streams, *(folder / title / "stream.gss" for title in made)):
            for row in measured(path, folder, said.rounds):
                print(json.dumps(row))
    return 0


if __name__ == "__main__":
    sys.exit(main())
