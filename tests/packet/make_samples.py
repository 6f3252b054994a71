"""Write the stored samples of the current format version. Run once per format version; old samples are never rewritten.

``stream.gss`` has every kind of packet, added and removed Gaussians; ``moving.gss`` has motions: from rest, predicted,
corrected, of groups formed anew, two in a frame, and added Gaussians after one; ``field.gss`` has fields; ``light.gss``
has lights; ``world.gss`` lies in other coordinates than its recording; the key packets of ``layers.gss`` have layers.

Usage: python tests/packet/make_samples.py
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from packet_scenes import (
    decode_all,
    make_field_packets,
    make_light_packets,
    make_moving_packets,
    make_packets,
    make_placed_key,
    write_stream,
)

from gsstream.core.gaussians import Gaussians
from gsstream.packet import FORMAT_VERSION

SAMPLES = Path(__file__).parent / "samples"


def digest(gaussians: Gaussians) -> str:
    """SHA-256 over the arrays in the order of ATTRIBUTES."""
    return hashlib.sha256(b"".join(array.tobytes() for _, array in gaussians.items())).hexdigest()


def main() -> None:
    streams = {
        "stream": make_packets(seed=11, number=30, nodes=9, edits=(3, 6)),
        "moving": make_moving_packets(seed=12, number=30, nodes=9),
        "field": make_field_packets(seed=14, number=30, nodes=9),
        "world": [make_placed_key(seed=13, number=20, nodes=6)],
        "light": make_light_packets(seed=16, number=30, nodes=9),
        "layers": make_packets(seed=15, number=30, nodes=9, layers=True),
    }
    folder = SAMPLES / FORMAT_VERSION
    folder.mkdir(parents=True)
    for name, packets in streams.items():
        write_stream(folder / f"{name}.gss", packets)
    for name, packet in (("key", 0), ("delta", 1), ("empty", 2), ("births", 3)):
        (folder / f"{name}.bin").write_bytes(streams["stream"][packet].data)
    expected = {name: [digest(state.gaussians) for state in decode_all(packets)] for name, packets in streams.items()}
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
