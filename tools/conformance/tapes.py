"""Streams, packet by packet: sound ones by the encoder of this repository, and sections replaced by any bytes."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta, Layout
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.packet import KeyState, PlayerState, StreamMeta, decode_packet, encode_delta, encode_key
from gsstream.packet.base import MAGIC, SECTION_IDS, parse_packet
from gsstream.packet.meta import meta_to_json

Sections = dict[str, bytes]
KEY, DELTA, EMPTY, INDEX = 1, 2, 3, 4


@dataclass(frozen=True)
class Vector:
    """A stream of the suite.

    Arguments:
        name: name of its file.
        features: what it needs of a decoder, the one it is there for first.
        rules: identifiers of docs/spec that it tests.
        data: the file.
        refused: whether a reader refuses it, after the frames that it can play.
    """

    name: str
    features: tuple[str, ...]
    rules: tuple[str, ...]
    data: bytes
    refused: bool = False


def seal(kind: int, frame: int, body: bytes, sections: int, **lies: int) -> bytes:
    """Return a packet with both checksums; ``lies`` replace fields before they are made."""
    said = {"kind": kind, "sections": sections, "frame": frame, "length": len(body), **lies}
    fields = (said["kind"], said["sections"], said["frame"], said["length"])
    checksum = zlib.crc32(body, zlib.crc32(struct.pack("<BBII", *fields)))
    check = zlib.crc32(struct.pack("<BBIII", *fields, checksum)) & 0xFFFF
    return struct.pack("<BBHIII", *fields[:2], check, *fields[2:], checksum) + body


def packet(kind: int, frame: int, sections: Sequence[tuple[str | int, bytes]]) -> bytes:
    """Return a packet of named or numbered sections."""
    numbers = [(SECTION_IDS[name] if isinstance(name, str) else name, data) for name, data in sections]
    return seal(kind, frame, b"".join(struct.pack("<BI", n, len(data)) + data for n, data in numbers), len(numbers))


def header(major: int = 2, minor: int = 4) -> bytes:
    """Return the header of a file."""
    start = struct.pack("<8sHH", MAGIC, major, minor)
    return start + struct.pack("<I", zlib.crc32(start))


def rig(number: int = 1, side: int = 32) -> Cameras:
    """Return cameras that look along z from some way back."""
    viewmats = np.tile(np.eye(4), (number, 1, 1))
    viewmats[:, 2, 3] = 4 + np.arange(number)
    K = np.array([[40.0, 0, side / 2], [0, 40.0, side / 2], [0, 0, 1]])
    return Cameras(tuple(f"c{i}" for i in range(number)), viewmats, np.tile(K, (number, 1, 1)), side, side, 0.25)


def meta_json(change: Callable[[dict[str, Any]], None] = lambda _: None) -> bytes:
    """Return the meta of the vectors as JSON, changed."""
    meta = StreamMeta("none", "conformance", {}, rig(1), rig(0), 30.0, conventions={}, version="0")
    value = json.loads(meta_to_json(meta))
    change(value)
    return json.dumps(value, separators=(",", ":")).encode()


def plain_frame(content: bytes) -> bytes:
    """Return a Zstandard frame of one block that is not compressed: the same bytes with every library."""
    return (
        b"\x28\xb5\x2f\xfd\xa0"
        + struct.pack("<I", len(content))
        + (len(content) << 3 | 1).to_bytes(3, "little")
        + content
    )


def scene(seed: int, number: int, rest: int = 0, spread: float = 1.0) -> Gaussians[FloatArray]:
    """Return Gaussians with ``rest`` coefficients of higher degrees."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=(spread * rng.normal(size=(number, 3))).astype(np.float32),
        quats=rng.normal(size=(number, 4)).astype(np.float32),
        scales=(rng.normal(size=(number, 3)) - 2).astype(np.float32),
        opacities=(2 * rng.normal(size=number)).astype(np.float32),
        sh0=rng.normal(size=(number, 1, 3)).astype(np.float32),
        shN=(0.2 * rng.normal(size=(number, rest, 3))).astype(np.float32),
    )


def layout(seed: int, number: int, nodes: int, units: Sequence[float] = (1.0, 0.3, 0.1)) -> Layout:
    """Return a layout of random nodes, of which some may be empty, and units."""
    rng = np.random.default_rng(seed + 1000)
    counts = np.bincount(rng.integers(0, max(nodes, 1), number), minlength=nodes).astype(np.int32)
    unit_of = rng.integers(0, max(len(units), 1), number).astype(np.uint8)
    return Layout(counts, unit_of, np.array(units, np.float32))


def key_sections(
    gaussians: Gaussians[FloatArray], stored: Layout, *, first: BoolArray | None = None, meta: bytes | None = None
) -> Sections:
    """Return the sections of a key packet, in their order."""
    about = StreamMeta("none", "conformance", {}, rig(1), rig(0), 30.0, conventions={}, version="0")
    made = parse_packet(encode_key(KeyState(gaussians, stored, about), first=first).data)[1]
    found = {name: section.data for name, section in made.items()}
    return layered({**found, "meta": plain_frame(meta_json()) if meta is None else meta})


def layered(sections: Sections) -> Sections:
    """Mend what section layers says of the sections behind it, if there is one."""
    if "layers" not in sections:
        return sections
    seen = ("meta", *ATTRIBUTES)
    body = b"".join(struct.pack("<BI", SECTION_IDS[n], len(sections[n])) + sections[n] for n in seen if n in sections)
    return {**sections, "layers": sections["layers"][:4] + struct.pack("<II", len(body), zlib.crc32(body))}


@dataclass
class Tape:
    """A stream that is being made, with the state that its packets lead to."""

    packets: list[bytes] = field(default_factory=list)
    state: PlayerState | None = None

    @property
    def here(self) -> PlayerState:
        assert self.state is not None, "a tape begins with a key packet"
        return self.state

    @property
    def next(self) -> int:
        return 0 if self.state is None else self.state.frame + 1

    def add(self, data: bytes) -> Tape:
        """Add a sound packet of a frame."""
        self.state = decode_packet(self.state, data)
        self.packets.append(data)
        return self

    def lie(self, data: bytes) -> Tape:
        """Add a packet that no reader plays."""
        self.packets.append(data)
        return self

    def key(self, sections: Mapping[str, bytes], frame: int | None = None) -> Tape:
        return self.add(packet(KEY, self.next if frame is None else frame, list(sections.items())))

    def start(self, seed: int, number: int = 6, nodes: int = 4, rest: int = 0, **said: Any) -> Tape:
        """Add a key packet of a random scene; ``said``: units, spread, and what :func:`key_sections` takes."""
        units, spread = said.pop("units", (1.0, 0.3, 0.1)), said.pop("spread", 1.0)
        frame = said.pop("frame", None)
        stored = layout(seed, number, nodes, units)
        return self.key(key_sections(scene(seed, number, rest, spread), stored, **said), frame)

    def change(self, delta: Delta) -> Tape:
        made = encode_delta(delta, self.here.layout, self.here.decoders, frame=self.next)
        return self.add(made.data)

    def delta(self, sections: Sequence[tuple[str | int, bytes]] | Mapping[str, bytes]) -> Tape:
        return self.add(packet(DELTA, self.next, _list(sections)))

    def empty(self) -> Tape:
        return self.add(packet(EMPTY, self.next, []))

    def refused(self, sections: Sequence[tuple[str | int, bytes]] | Mapping[str, bytes]) -> Tape:
        """Add a delta packet that no reader plays."""
        return self.lie(packet(DELTA, self.next, _list(sections)))

    def bytes(self, *, index: bool = False, minor: int = 4) -> bytes:
        """Return the file."""
        return file_of(self.packets, index=index, minor=minor)


def _list(sections: Sequence[tuple[str | int, bytes]] | Mapping[str, bytes]) -> list[tuple[str | int, bytes]]:
    return list(sections.items()) if isinstance(sections, Mapping) else list(sections)


def file_of(packets: Sequence[bytes], *, index: bool = False, minor: int = 4) -> bytes:
    """Return a file of packets."""
    out, keys, frame = header(minor=minor), b"", 0
    for data in packets:
        frame = struct.unpack_from("<I", data, 4)[0]
        keys += struct.pack("<IQ", frame, len(out)) if data[0] == KEY else b""
        out += data
    return out + (packet(INDEX, frame, [("index", keys + struct.pack("<Q4s", len(out), b"GSSX"))]) if index else b"")


def playing(name: str, features: str, rules: str, tape: Tape | bytes, **said: Any) -> Vector:
    """Return a vector that is played. Features and rules are words; rules without their R-."""
    return _vector(name, features, rules, tape, said, refused=False)


def refusing(name: str, features: str, rules: str, tape: Tape | bytes, **said: Any) -> Vector:
    """Return a vector that is refused."""
    return _vector(name, features, rules, tape, said, refused=True)


def _vector(name: str, features: str, rules: str, tape: Tape | bytes, said: Any, *, refused: bool) -> Vector:
    data = tape if isinstance(tape, bytes) else tape.bytes(**said)
    return Vector(name, tuple(features.split()), tuple(f"R-{rule}" for rule in rules.split()), data, refused)


def with_scene(state: PlayerState, gaussians: Gaussians[FloatArray]) -> PlayerState:
    """Return a state with another scene."""
    return replace(state, scene=replace(state.scene, gaussians=gaussians))
