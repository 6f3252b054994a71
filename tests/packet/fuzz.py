"""Fuzz the reader: damaged, truncated and lying streams end in a PacketError with its byte, or in correct frames.

Usage: python -m tests.packet.fuzz --count 100000 --seed 1 [--memory-mb 256] [--seconds 5] [--chunk 5000]

Every case follows from (seed, number) alone; ``--first N --count 1`` repeats one. Cases run in child processes with an
address-space limit (what is loaded plus ``--memory-mb``) and a time limit for each case; a crash, a hang, too much
memory, a wrong or missing frame, or any other exception is a failure, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

sys.path.insert(0, str(Path(__file__).parent))
from fuzz_cases import Base, bases, mutate

from gsstream.core.errors import PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.packet import first_layer
from gsstream.packet.base import FILE_HEADER
from gsstream.player.playback import Playback


class Failure(Exception):
    """What must never happen, in words."""


def play(path: Path, data: bytes, base: Base) -> str:
    """Play a mutated stream; "played" or "refused". Raises Failure."""
    path.write_bytes(data)
    same = next((i for i, (a, b) in enumerate(zip(data, base.data, strict=False)) if a != b), len(data))
    sound = sum(end <= same for end in base.ends)  # frames that the damage cannot have touched
    seen, error = 0, None
    try:
        # Refused for its memory, a stream says nothing of its format, and another machine refuses others.
        with Playback(path, max_memory=1 << 62) as playback:
            first = playback.frames[0]
            for frame, scene in playback:
                _check(scene, base.scenes[seen] if seen < sound else None, frame)
                if len(scene) != int(playback.player_state(frame).layout.node_counts.sum()):
                    raise Failure(f"frame {frame}: the nodes hold another number of Gaussians than there are")
                if frame != first + seen:
                    raise Failure(f"frame {frame} came where {first + seen} was due")
                seen += 1
            playback.reader.check()
    except PacketError as caught:
        error = caught
    early = first_layer(data[FILE_HEADER.size :])
    if early is not None:
        early.gaussians.validate()
    if seen < sound:
        raise Failure(f"{seen} frames played, {sound} are undamaged: {error}")
    if error is None:
        return "played"
    if error.offset is None or not 0 <= error.offset <= len(data):
        raise Failure(f"offset {error.offset} in a file of {len(data)} bytes: {error}")
    return "refused"


def _check(scene: Gaussians, expected: Gaussians | None, frame: int) -> None:
    if expected is None:
        scene.validate()
        return
    pairs = zip(scene.items(), expected.items(), strict=True)
    if any(a.tobytes() != b.tobytes() for (_, a), (_, b) in pairs):
        raise Failure(f"frame {frame} is undamaged and decodes to something else")


def _child(connection: Connection, seed: int, first: int, last: int, memory: int, seconds: float) -> None:
    """Run cases [first, last) and tell the parent what each came to."""
    corpus = bases()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s.gss"
        play(path, corpus[0].data, corpus[0])  # everything is loaded before the limit is set
        pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (pages + memory, pages + memory))
        signal.signal(signal.SIGALRM, _out_of_time)
        for number in range(first, last):
            kind, data, base = mutate(corpus, seed, number)
            connection.send((number, kind, None))
            signal.setitimer(signal.ITIMER_REAL, seconds)
            try:
                outcome = play(path, data, base)
            except MemoryError:
                outcome = "FAILED: more memory than allowed"
            except Exception as error:  # whatever it is, it is what this job looks for
                outcome = f"FAILED: {type(error).__name__}: {error}"
            signal.setitimer(signal.ITIMER_REAL, 0)
            connection.send((number, kind, outcome))
    connection.close()


def _out_of_time(_signal: int, _frame: FrameType | None) -> None:
    raise Failure("more time than allowed")


def fuzz(
    count: int,
    seed: int,
    *,
    first: int = 0,
    memory_mb: int = 256,
    seconds: float = 5.0,
    chunk: int = 5000,
    quiet: bool = True,
) -> dict[str, object]:
    """Run ``count`` cases from ``first`` on; returns the summary. Children are spawned: they inherit no state."""
    outcomes: Counter[str] = Counter()
    failures: list[dict[str, object]] = []
    started, number, context = time.perf_counter(), first, multiprocessing.get_context("spawn")
    while number < first + count:
        receive, send = context.Pipe(duplex=False)
        last = min(number + chunk, first + count)
        child = context.Process(target=_child, args=(send, seed, number, last, memory_mb << 20, seconds))
        child.start()
        send.close()
        kind, outcome = "start", None
        try:
            # The alarm works inside Python; a call that never returns is ended from here.
            while number < last and receive.poll(60 + 2 * seconds):
                at, kind, outcome = receive.recv()
                if outcome is not None:
                    _count(outcomes, failures, at, kind, outcome)
                    number = at + 1
        except EOFError:
            pass
        if number < last:
            child.kill()
            child.join()
            _count(outcomes, failures, number, kind, f"FAILED: process ended or hung, exit code {child.exitcode}")
            number += 1
        child.join()
        if not quiet:
            took = time.perf_counter() - started
            print(f"{number - first} cases, {len(failures)} failures, {took:.0f} s", flush=True)
    return {
        "count": count,
        "seed": seed,
        "first": first,
        "seconds": round(time.perf_counter() - started, 1),
        "memory_mb": memory_mb,
        "outcomes": dict(sorted(outcomes.items())),
        "failures": failures,
    }


def _count(outcomes: Counter[str], failures: list[dict[str, object]], number: int, kind: str, outcome: str) -> None:
    outcomes[f"{kind}: {outcome.split(':')[0]}"] += 1
    if outcome.startswith("FAILED"):
        failures.append({"number": number, "kind": kind, "outcome": outcome})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="number of cases")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--memory-mb", type=int, default=256, help="beyond what is loaded, for each child")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each case")
    parser.add_argument("--chunk", type=int, default=5000, help="cases of one child process")
    parser.add_argument("--out", type=Path, help="also write the summary to this file")
    arguments = vars(parser.parse_args())
    out = arguments.pop("out")
    # One thread: the address space of idle thread pools is not the reader's.
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    summary = fuzz(**arguments, quiet=False)
    text = json.dumps(summary, indent=1)
    print(text)
    if out is not None:
        out.write_text(text + "\n")
    return 1 if summary["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
