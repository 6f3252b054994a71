"""Hold the browser's decoder, and that in C where there is a compiler, against Python's on damaged and lying streams.

Usage: python tests/web/decoder_fuzz.py --count 20000 --seed 1

Every case must end in a PacketError with a byte inside the file, or in the very frames that Python plays; none may hang
or take memory without bound. Cases are those of tests/packet/fuzz.py and follow from (seed, number) alone.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1] / "packet"))
sys.path.insert(0, str(Path(__file__).parents[2]))
from fuzz_cases import Base, bases, mutate
from moving_scenes import moving_packets
from node_runs import play_in_node

from gsstream.core.errors import PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.packet import first_layer
from gsstream.packet.base import FILE_HEADER, file_header
from gsstream.player.playback import Playback
from tools.decoder_in_c import Library, compiler
from tools.decoder_in_c import play as play_in_c

SECONDS = 5.0
#: What Python says of a meta that the browser reads only in part.
META = re.compile("meta: ")
#: Such a zstandard frame is faulty by RFC 8878, section 4.2.2; libzstd, which Python reads with, plays some of them.
FAULTY_FRAME = "Huffman-coded literals do not end with their bits"
#: Node itself needs about 60 MB; the rest is the bytes of a chunk and what their decoding takes.
MEGABYTES = 400


class Outcome(NamedTuple):
    """What Python makes of a stream."""

    digests: list[str]
    error: PacketError | None
    early: str | None = None


def play_in_python(path: Path, data: bytes) -> Outcome:
    """Digests of the frames until the end or the error, and of the first layer of the first packet."""
    path.write_bytes(data)
    found = first_layer(data[FILE_HEADER.size :])
    early = None if found is None else digest(found.gaussians)
    digests: list[str] = []
    try:
        # Refused for its memory, a stream says nothing of its format, and another machine refuses others.
        with Playback(path, max_memory=1 << 62) as playback:
            for _, scene in playback:
                digests.append(digest(scene))
            playback.reader.check()
    except PacketError as error:
        return Outcome(digests, error, early)
    return Outcome(digests, None, early)


def digest(scene: Gaussians) -> str:
    """SHA-256 of all attributes."""
    return hashlib.sha256(b"".join(array.tobytes() for _, array in scene.items())).hexdigest()


def disagreement(ours: Outcome, theirs: dict[str, Any], size: int) -> str | None:
    """Why the two outcomes do not go together; None when they do."""
    error = theirs["error"]
    if error is not None and not (error["expected"] and error["offset"] is not None and 0 <= error["offset"] <= size):
        return f"not an error of the format with a byte inside the file: {error}"
    if theirs["milliseconds"] > 1000 * SECONDS:
        return f"took {theirs['milliseconds'] / 1000:.1f} s"
    shared = min(len(ours.digests), len(theirs["digests"]))
    if ours.digests[:shared] != theirs["digests"][:shared]:
        return "other frames than Python's"
    faulty = error is not None and FAULTY_FRAME in error["message"]
    if ours.early != theirs["early"] and (ours.early or not META.match(str(ours.error))) and not faulty:
        return f"the first layer is {theirs['early']}, Python's {ours.early}"
    # The player does not read the recipe and other text of meta, so it may play what Python refuses for it.
    lenient = META.match(str(ours.error)) is not None
    if error is None and ours.error is not None and not lenient:
        return f"played although Python says: {ours.error}"
    if error is not None and FAULTY_FRAME in error["message"]:
        return None
    if error is not None and ours.error is None:
        return f"refused although Python plays it: {error}"
    if len(theirs["digests"]) != len(ours.digests) and not lenient:
        return f"{len(theirs['digests'])} frames, Python has {len(ours.digests)}: {error}, {ours.error}"
    return None


def in_c(library: Library, data: bytes, ours: Outcome, theirs: dict[str, Any]) -> str | None:
    """Why the decoder in C goes with neither Python nor the browser; None where it does."""
    digests, fault = play_in_c(library, data, MEGABYTES << 20)
    said = None if fault is None else {"message": fault.message, "offset": fault.byte, "expected": bool(fault.rule)}
    if fault is not None and theirs["error"] and FAULTY_FRAME in theirs["error"]["message"]:
        said = theirs["error"]  # both read the format's meta to the letter, which nobody has to
    found = {"digests": digests, "error": said, "milliseconds": 0, "early": ours.early}
    why = disagreement(ours, found, len(data))
    return why and f"C: {why}"


def fuzz(count: int, seed: int, *, first: int = 0, chunk: int = 2000) -> tuple[Counter[str], list[str]]:
    """Outcomes by kind of mutation, and what went wrong."""
    corpus = [*bases(), *(_moving(seed) for seed in (1, 2, 3))]
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        library = Library(Path(folder)) if compiler() else None
        for start in range(first, first + count, chunk):
            numbers = range(start, min(start + chunk, first + count))
            cases = [mutate(corpus, seed, number) for number in numbers]
            found = play_in_node([data for _, data, _ in cases], Path(folder), timeout=60 + len(cases) * SECONDS)
            if found["megabytes"] > MEGABYTES:
                failures.append(f"cases from {start}: {found['megabytes']:.0f} MB")
            for number, (kind, data, _), theirs in zip(numbers, cases, found["streams"], strict=True):
                ours = play_in_python(Path(folder) / "s.gss", data)
                why = disagreement(ours, theirs, len(data))
                if why is None and library is not None:
                    why = in_c(library, data, ours, theirs)
                outcomes[f"{kind}: {'refused' if theirs['error'] else 'played'}"] += 1
                if why is not None:
                    failures.append(f"case {number} ({kind}): {why}")
    return outcomes, failures


def _moving(seed: int) -> Base:
    """A stream with motions in the form that the mutations take; what it decodes to is not needed here."""
    packets = moving_packets(seed, frames=6, number=(30, 100, 300)[seed % 3], key_at=9)
    data = file_header() + b"".join(packet.data for packet in packets)
    return Base(data, (), (), tuple(packets))


def main() -> int:
    """Run the job; the exit code is 1 when a case failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000, help="number of cases")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    arguments = parser.parse_args()
    outcomes, failures = fuzz(arguments.count, arguments.seed, first=arguments.first)
    print(*(f"{name}: {number}" for name, number in sorted(outcomes.items())), sep="\n")
    print(*failures, f"{arguments.count} cases, {len(failures)} failures", sep="\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
