"""Key packets every few seconds against joins beside the stream: bytes of the stream, of a join, of a seek.

Usage: python -m tools.web_delivery STREAM [--every SECONDS]

For a stream with one key packet it says, for each place to begin at: what a viewer loads who comes there first with
nothing (from the key; from the key and a join; from a key packet that would stand there), what one loads who has the
key packet already, and what each way adds to the stream that everybody loads. The key packet that would stand there is
coded as the encoder would code it, so its bytes are measured as well.
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np

from gsstream.core.shapes import IntArray
from gsstream.packet import KeyState, decode_packet, encode_key
from gsstream.player.playback import Playback
from gsstream.serve.joins import encode_join, follow


def measure(path: str, every: float) -> dict[str, object]:
    """Return bytes at every place to begin at, of a stream with one key packet.

    Arguments:
        path: the stream.
        every: seconds between places.
    """
    with Playback(path) as playback:
        first, *others = (playback.entry(frame) for frame in playback.frames)
        state = key = decode_packet(None, playback.reader.read(first))
        step = max(1, round(every * key.meta.fps))
        source: IntArray = np.arange(len(key.gaussians), dtype=np.int64)
        deltas, places = 0, []
        for number, entry in enumerate(others, 1):
            state = decode_packet(state, playback.reader.read(entry))
            source = follow(source, state)
            deltas += entry.size
            if number % step:
                continue
            join = len(encode_join(key, state, source))
            fresh = len(encode_key(KeyState(state.gaussians, state.layout, state.meta), frame=entry.frame).data)
            places.append({
                "seconds": round(number / key.meta.fps, 2), "deltas": deltas, "join": join, "key_there": fresh,
                "first_by_deltas": first.size + deltas, "first_by_join": first.size + join, "first_by_key": fresh,
            })  # fmt: skip
    return {"stream": path, "fps": key.meta.fps, "gaussians": len(key.gaussians), "key": first.size, "places": places}


def main() -> int:
    """Print what was measured as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between places")
    given = parser.parse_args()
    print(json.dumps(measure(given.stream, given.every), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
