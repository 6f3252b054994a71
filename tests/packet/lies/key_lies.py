"""Key packets that lie: counts, grids of positions and rotations that cannot be, and meta of no sensible recording."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from lying import PAST, Victim
from packet_scenes import make_key, make_meta

from gsstream.packet import EncodedPacket, encode_key
from gsstream.packet.base import MAX_GAUSSIANS, parse_packet
from gsstream.packet.bits import compress
from gsstream.packet.key import most_gaussians
from gsstream.packet.meta import hash_recipe, meta_to_json
from gsstream.packet.symbols import encode_symbols

MANY = 0xFFFFFFFF
METAS = {
    b"": "Expecting value",
    b"[]": "expected an object, got list",
    b"{}": "the entry 'method' is missing",
    b"[" * 100_000: "more than 100 deep",
    b'{"version": NaN}': "NaN is not a number",
    b"\xff\xfe": "not what was expected",
    b"1" * 5000: "Exceeds the limit",
}


def key_victim() -> Victim:
    """Ten Gaussians in four nodes."""
    packet = encode_key(make_key(np.random.default_rng(3), 10, 4))
    return Victim(None, packet, _key_lies(packet))


def _key_lies(packet: EncodedPacket) -> Iterator[tuple[str, str, bytes, str]]:
    beyond = most_gaussians(len(packet.data) + 20) + 1
    counts = [(MANY, 4, 3), (10, MANY, 3), (10, 4, 255), (MAX_GAUSSIANS + 1, 4, 3), (beyond, 4, 3)]
    for gaussians, nodes, units in counts:
        layout = struct.pack("<IIB", gaussians, nodes, units) + b"\0" * 20
        what = f"layout of {gaussians} Gaussians, {nodes} nodes, {units} units"
        yield what, "layout", layout, f"{what} is beyond the limits"
    yield "units cut short", "layout", struct.pack("<IIB", 10, 4, 3) + b"\0" * 25, PAST
    # Twice the memory that the test allows, in some kilobytes.
    yield "a bomb", "meta", compress(b"\0" * (64 << 20)), "announces"
    for meta, message in METAS.items():
        yield f"meta {meta[:20]!r}", "meta", compress(meta), message
    means = parse_packet(packet.data)[1]["means"].data
    for grid in ((-10, 2, 20), (5, 2, 4), (100, 2, 101)):
        text = f"means: cells of 2^{grid[2]} in steps of 2^{grid[0]} cannot be"
        yield f"grid {grid}", "means", struct.pack("<bbb", *grid) + means[3:], text
    yield "a finer grid", "means", struct.pack("<bbb", -9, 2, -3) + means[3:], "bytes of positions in cells, got"
    for row, message in (
        ([4, 0, 0, 0, 0], "the index of the largest component is outside 0 to 3"),
        ([0, 0, 0, 0, -128], "the largest component is not the largest, or out of range"),
        ([0, 120, 100, 90, -60], "the largest component is not the largest, or out of range"),
        ([0, 1 << 21, 0, 0, 0], "quats: code out of range"),
    ):
        table = np.zeros((10, 5), np.int32)
        table[1] = row
        yield f"quats {row}", "quats", struct.pack("<bB", 7, 4) + encode_symbols(table), message


Changed = Callable[[dict[str, Any]], None]


def put(**values: Any) -> Changed:
    return lambda meta: meta.update(values)


def in_rig(**values: Any) -> Changed:
    return lambda meta: meta["train"].update(values)


def extra(**values: Any) -> Changed:
    return put(extra=values)


def no_cameras(meta: dict[str, Any]) -> None:
    for split in ("train", "test"):
        meta[split] |= {"ids": [], "viewmats": [], "Ks": []}


SINGLE, ABOVE = "expected finite numbers in float32", "expected finite numbers above 0 in float32"
WORLD = {"rotation": [0, 1, 0, -1, 0, 0, 0, 0, 1], "offset": [5e5, 5.2e6, 300], "scale": 2.5}
RANGE, NUMBER = "fps: expected 0.01 to 100000 frames per second, got", "expected a number, got"
WHOLE, SIDE, TEXT = "expected a whole number, got", "expected 1 to 65536 pixels a side", "expected text, got"
NOT_3, SCALED = "extra.origin: expected finite numbers in the shape [3]", "expected finite numbers and a scale above 0"
SKEW, MATRIX = "expected a rotation, got one that is not orthogonal", "extra.exposure.matrix: expected finite numbers"
#: What is lied about, the lies, and what the refusal says of each.
LIES: list[tuple[str, str, Callable[[Any], Changed], tuple[Any, ...]]] = [
    ("fps", RANGE, lambda fps: put(fps=fps), (0, -5, 1e-300, 1e300)),
    ("fps", NUMBER, lambda fps: put(fps=fps), ("30", True, None, [30])),
    ("width", SIDE, lambda width: in_rig(width=width), (0, -1, 65537)),
    ("width", WHOLE, lambda width: in_rig(width=width), (40.9, "30", True)),
    ("sides", "expected at most 134217728 pixels", lambda side: in_rig(width=side, height=side), (65536,)),
    ("near", NUMBER, lambda near: in_rig(near=near), ("0.1",)),
    ("cameras", "there is no camera; expected at least one", lambda _: no_cameras, (None,)),
    ("method", TEXT, lambda method: put(method=method), (3,)),
    ("plugin", TEXT, lambda version: put(plugins={"p": version}), (1,)),
    ("background", NUMBER, lambda colour: put(background=colour), (["0", "0", "0"],)),
    ("source_uri", TEXT, lambda uri: extra(source_uri=uri), (["a"],)),
    ("licence", TEXT, lambda licence: extra(licence=licence), (7,)),
    ("title", TEXT, lambda title: extra(title=title), (["dense"],)),
    ("world", SCALED, lambda scale: put(world={**WORLD, "scale": scale}), (0, -1)),
    ("world", NUMBER, lambda scale: put(world={**WORLD, "scale": scale}), ("1", True)),
    ("world at", "expected 9 and 3 numbers, got 9 and 2", lambda at: put(world={**WORLD, "offset": at}), ([1, 2],)),
    ("world at", NUMBER, lambda at: put(world={**WORLD, "offset": at}), ([1, 2, None],)),
    ("rotation", SKEW, lambda by: put(world={**WORLD, "rotation": by}), ([1] * 9, [-1, 0, 0, 0, 1, 0, 0, 0, 1])),
    ("rotation", NUMBER, lambda by: put(world={**WORLD, "rotation": by}), ([[1, 0, 0], [0, 1, 0], [0, 0, 1]],)),
    ("world", "expected an object, got list", lambda world: put(world=world), ([1],)),
    # As the browser's player reads them, and no other way: what numpy would take for numbers is none.
    ("ids", "expected an array, got str", lambda ids: in_rig(ids=ids), ("ab",)),
    ("viewmats", "expected an array, got", lambda viewmats: in_rig(viewmats=viewmats), ("0" * 32, ["0" * 16] * 2)),
    ("viewmats", NUMBER, lambda viewmats: in_rig(viewmats=viewmats), ([[True] * 16] * 2, [np.eye(4).tolist()] * 2)),
    ("Ks", "expected 2 matrices of 9 numbers", lambda Ks: in_rig(Ks=Ks), ([[1] * 9], [[1] * 8] * 2, [])),
    ("train", "expected an object, got list", lambda train: put(train=train), ([],)),
    # Finite in float64, and not in the float32 of renderers.
    ("background", SINGLE, lambda colour: put(background=colour), ([1e39, 0, 0], [0, -1e300, 0])),
    ("near", ABOVE, lambda near: in_rig(near=near), (1e-300, 1e39)),
    ("focal length", ABOVE, lambda f: in_rig(Ks=[[f, 0, 1, 0, 3e38, 1, 0, 0, 1]] * 2), (1e-46,)),
    ("focal length", SINGLE, lambda f: in_rig(Ks=[[f, 0, 1, 0, 1, 1, 0, 0, 1]] * 2), (1e39,)),
    ("viewmats", SINGLE, lambda x: in_rig(viewmats=[[1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]] * 2), (1e39,)),
    ("world", "the entry 'scale' is missing", lambda turn: put(world={"rotation": turn, "offset": [0] * 3}), ([0],)),
    ("origin", NOT_3, lambda origin: extra(origin=origin), ([0, 0], 3, [0, 0, 1e39])),
    ("origin", "expected numbers in the shape [3]: ", lambda origin: extra(origin=origin), ("abc", [[0], 1, 2])),
    ("exposure", MATRIX, lambda said: extra(exposure=said), (
        {"offset": [[0, 0, 0]] * 3}, {"matrix": [np.eye(3).tolist()], "offset": [[0, 0, 0]]},
    )),
    ("exposure", "expected an object, got list", lambda said: extra(exposure=said), ([1],)),
    ("gains", "extra.gains: expected finite numbers in", lambda said: extra(gains=said), ([[1, 1, 1]], [1, 1])),
    ("gains", "extra.gains: " + ABOVE, lambda said: extra(gains=said), ([[1, 1, 0]] * 2, [[1, -1, 1]] * 2)),
    ("shown", "extra.shown: expected the number of a frame, got", lambda shown: extra(shown=shown), (-1, "1")),
]  # fmt: skip


def meta_victim() -> Victim:
    """A key packet."""
    packet = encode_key(make_key(np.random.default_rng(0)))
    told = ((f"{name} {value!r:.40}", message, of(value)) for name, message, of, values in LIES for value in values)
    return Victim(None, packet, ((name, "meta", compress(meta_with(lie)), message) for name, message, lie in told))


def meta_with(change: Changed) -> bytes:
    """The meta of the tests with a change, and the hash that belongs to it."""
    data = json.loads(meta_to_json(make_meta()))
    change(data)
    data["recipe_hash"] = hash_recipe(data["recipe"])
    return json.dumps(data).encode()
