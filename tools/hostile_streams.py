"""The worst memory that streams of at most 16 KB take: of `gsstream info`, `gsstream play`, and the page's decoder.

    python -m tools.hostile_streams

Each stream is given to processes of their own, without a limit but gsstream's; and all streams of
tests/conformance/refuse to one process of each decoder. Prints rows for the table of docs/results/decoders.md: peaks of
resident memory in MB, and what info and play say. The exit code is 1 where a process ended in a traceback.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsstream.packet.bits import compress
from tools.conformance.coding import constant, parts
from tools.conformance.keys import flat
from tools.conformance.tapes import KEY, Sections, file_of, key_sections, layout, meta_json, packet, plain_frame, scene

ROOT = Path(__file__).parents[1]
REFUSED = ROOT / "tests" / "conformance" / "refuse"
MOST = 16_384
#: A small process, since a child counts the memory of the one that started it as its own.
MEASURE = """
import json, resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
print(json.dumps([done.returncode, peak, done.stdout]))
"""
COMMAND = "from gsstream.cli.main import main; main()"
ALL = """
import sys
from pathlib import Path
from gsstream.packet.conformance import play_here
assert all(play_here(Path(path)).code for path in sys.argv[1:])
"""


def rows(number: int, rest: int, side: int = 32, scale: int = -32) -> Sections:
    """Return the sections of a key packet of equal Gaussians behind each other, as few bytes as it can have."""
    stored = struct.pack("<IIB", number, 1, 1) + struct.pack("<f", 1) + parts(constant(number, 1), constant(0, number))
    sections = {**key_sections(scene(0, 0), layout(0, 0, 0, ())), **flat(number), "layout": stored}
    sections["scales"] = struct.pack("<bB", 4, 3) + constant(scale, number, 3)
    if rest:
        sections["shN"] = struct.pack("<bB", 7, 3 * rest) + constant(1, number, 3 * rest)

    def larger(meta: dict[str, Any]) -> None:
        K = [side, 0, side / 2, 0, side, side / 2, 0, 0, 1]
        for split in ("train", "test"):
            meta[split] |= {"width": side, "height": side, "Ks": [K for _ in meta[split]["Ks"]]}

    return {**sections, "meta": plain_frame(meta_json(larger))}


def stream(*keys: Sections) -> bytes:
    """Return a file of key packets."""
    return file_of([packet(KEY, frame, list(sections.items())) for frame, sections in enumerate(keys)])


def filled(number: Callable[[int], int], rest: int, **said: int) -> bytes:
    """Return a stream of 16 KB with as many rows as a packet of that size may announce."""
    size = MOST - 16
    sections = rows(number(size), rest, **said)
    room = size - len(stream(sections)) + 16
    text = meta_json(lambda meta: meta.update(extra={"fill": ""}))
    text = text.replace(b'"fill":""', b'"fill":"' + b"x" * max(0, room - 60) + b'"')
    return stream({**sections, "meta": plain_frame(text)})


def told(text: bytes, times: int = 1) -> bytes:
    """Return a stream of key packets whose meta is this text."""
    return stream(*[{**rows(1, 0), "meta": compress(text)}] * times)


STREAMS: dict[str, Callable[[], bytes]] = {
    "a scene of one Gaussian": lambda: stream(rows(1, 0)),
    "65,536 Gaussians over all of 640 x 640": lambda: stream(rows(65_536, 0, 640, 16)),
    "65,536 Gaussians over all of 2048 x 2048": lambda: stream(rows(65_536, 0, 2048, 16)),
    "65,536 Gaussians of degree 3": lambda: stream(rows(65_536, 15)),
    "1,100,000 Gaussians, the most of 16 KB": lambda: filled(lambda size: 65_536 + 64 * (size - 200), 0),
    "1,100,000 Gaussians of degree 3": lambda: filled(lambda size: 65_536 + 64 * (size - 200), 15),
    "11,000,000 Gaussians announced": lambda: stream(rows(11_000_000, 15)),
    "meta of a mebibyte of brackets": lambda: told(b"[" * (1 << 20)),
    "meta of a mebibyte of empty objects, twice": lambda: told(
        meta_json(lambda meta: meta.update(extra={"a": "X"})).replace(b'"X"', b"[" + b"{}," * 340_000 + b"{}]"), 2
    ),
    "meta of 16 MiB of brackets": lambda: told(b"[" * (16 << 20)),
}


def measured(*command: str) -> tuple[int, float, str]:
    """Return the exit code, the peak of memory in MB and the output of a command."""
    run = [sys.executable, "-c", MEASURE, *command]
    done = subprocess.run(run, stdout=subprocess.PIPE, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True)
    code, memory, text = json.loads(done.stdout)
    return code, memory, text


def page(streams: Sequence[bytes], folder: Path) -> float:
    """Return the peak of memory in MB of the page's decoder in node, whatever it makes of the streams."""
    (folder / "all").write_bytes(b"".join(struct.pack("<I", len(data)) + data for data in streams))
    play = str(ROOT / "tests" / "web" / "play.mjs")
    subprocess.run(["node", play, str(folder / "all"), str(folder / "results")], check=True)
    return float(json.loads((folder / "results").read_text())["megabytes"])


def row_of(name: str, data: bytes, folder: Path) -> dict[str, Any]:
    """Return the row of a stream. Raises RuntimeError where a command ends in a traceback."""
    path = folder / "stream.gss"
    path.write_bytes(data)
    found: dict[str, Any] = {"what": name, "bytes": len(data)}
    for kind, more in (("info", []), ("play", ["--out", str(folder / "pictures")])):
        code, memory, text = measured(sys.executable, "-c", COMMAND, kind, str(path), *more)
        if "Traceback" in text:
            raise RuntimeError(f"{kind} of {name}: {text}")
        found[kind] = f"{memory:.0f}{', refused' if code else ''}"
    return {**found, "page": f"{page([data], folder):.0f}"}


def main() -> int:
    """Run the job."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, make in STREAMS.items():
            print(json.dumps(row_of(name, make(), folder)), flush=True)
        paths = sorted(REFUSED.glob("*.gss"))
        code, memory, text = measured(sys.executable, "-c", ALL, *map(str, paths))
        if code:
            print(text, file=sys.stderr)
        many = page([path.read_bytes() for path in paths], folder)
        what = f"{len(paths)} streams of the suite that are refused, in one process"
        print(json.dumps({"what": what, "bytes": "-", "info": "-", "play": f"{memory:.0f}", "page": f"{many:.0f}"}))
    return code


if __name__ == "__main__":
    sys.exit(main())
