"""Write the stored samples of the current format version. Run once per format version; old samples are never rewritten.

Usage: python tests/packet/make_samples.py
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from packet_scenes import decode_all, make_packets, write_stream

from gsstream.core.gaussians import Gaussians
from gsstream.packet import FORMAT_VERSION

SAMPLES = Path(__file__).parent / "samples"


def digest(gaussians: Gaussians) -> str:
    """SHA-256 over the arrays in the order of ATTRIBUTES."""
    return hashlib.sha256(b"".join(array.tobytes() for _, array in gaussians.items())).hexdigest()


def main() -> None:
    packets = make_packets(seed=11, number=30, nodes=9, edits=(3, 6))
    folder = SAMPLES / FORMAT_VERSION
    folder.mkdir(parents=True)
    write_stream(folder / "stream.gss", packets)
    for name, packet in (("key", 0), ("delta", 1), ("empty", 2), ("births", 3)):
        (folder / f"{name}.bin").write_bytes(packets[packet].data)
    expected = [digest(state.gaussians) for state in decode_all(packets)]
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
