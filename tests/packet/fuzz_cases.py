"""Mutations of small streams for the fuzzing job. Most repair the checksums, so that what is behind is reached."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from packet_scenes import decode_all, make_field_packets, make_light_packets, make_moving_packets, make_packets

from gsstream.core.gaussians import Gaussians
from gsstream.packet import EncodedPacket, PacketKind
from gsstream.packet.base import PACKET_HEADER, SECTION_HEADER, SECTION_IDS, build_packet, file_header, parse_packet
from gsstream.packet.bits import compress, decompress
from gsstream.packet.reader import index_body

_LIES = (0, 1, 2, 127, 255, 1 << 15, 0xFFFF, 1 << 20, 4_000_000, 1 << 30, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


@dataclass(frozen=True)
class Base:
    """A sound stream: its bytes, the end of every frame's packet, the scenes it decodes to, and its packets."""

    data: bytes
    ends: tuple[int, ...]
    scenes: tuple[Gaussians, ...]
    packets: tuple[EncodedPacket, ...]


def bases() -> list[Base]:
    """Streams with every kind of packet and change, also without view-dependent colour, of one Gaussian, in layers."""
    settings = [
        {"seed": 21, "frames": 5, "key_at": 3, "number": 8, "nodes": 4, "sh_rest": 0},
        {"seed": 22, "frames": 4, "key_at": 9, "number": 40, "nodes": 12, "sh_rest": 3},
        {"seed": 23, "frames": 3, "key_at": 9, "number": 1, "nodes": 1, "sh_rest": 15},
        {"seed": 24, "frames": 4, "key_at": 9, "number": 300, "nodes": 90, "sh_rest": 0},
        {"seed": 25, "frames": 5, "key_at": 9, "number": 30, "nodes": 9, "sh_rest": 3, "edits": (1, 3)},
        {"seed": 29, "frames": 3, "key_at": 9, "number": 40, "nodes": 9, "sh_rest": 3, "layers": True},
    ]
    moving = [
        {"seed": 26, "number": 30, "nodes": 9, "sh_rest": 0},
        {"seed": 27, "number": 3, "nodes": 2, "sh_rest": 3},
    ]
    packets = [make_packets(**kwargs) for kwargs in settings] + [make_moving_packets(**kwargs) for kwargs in moving]
    packets.append(make_field_packets(seed=28, number=30, nodes=9))
    packets.append(make_light_packets(seed=30, number=30, nodes=9))
    return [_base(some) for some in packets]


def _base(packets: list[EncodedPacket]) -> Base:
    ends = 16 + np.cumsum([len(p.data) for p in packets])
    scenes = tuple(state.gaussians for state in decode_all(packets))
    return Base(_join(packets), tuple(int(end) for end in ends), scenes, tuple(packets))


def _join(packets: Sequence[EncodedPacket | bytes]) -> bytes:
    """A stream file of these packets, its index naming the keys where they are."""
    out, keys, frame = file_header(), [], 0
    for packet in packets:
        data = packet if isinstance(packet, bytes) else packet.data
        kind, _, _, frame, _, _ = PACKET_HEADER.unpack_from(data)
        if kind == PacketKind.KEY:
            keys.append((frame, len(out)))
        out += data
    return out + build_packet(PacketKind.INDEX, frame, [("index", index_body(keys, len(out)))]).data


def mutate(corpus: Sequence[Base], seed: int, number: int) -> tuple[str, bytes, Base]:
    """Case ``number``: the name of the mutation, the mutated file, and the stream it comes from."""
    rng = np.random.default_rng((seed, number))
    base = corpus[int(rng.integers(len(corpus)))]
    name = list(_MUTATIONS)[int(rng.choice(len(_MUTATIONS), p=_WEIGHTS))]
    return name, _MUTATIONS[name](rng, base), base


def _scramble(rng: np.random.Generator, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.geometric(0.5))):
        action, at, span = int(rng.integers(6)), int(rng.integers(len(out) + 1)), int(rng.integers(1, 9))
        if action == 0 and at < len(out):
            out[at] ^= 1 << int(rng.integers(8))
        elif action == 1:
            del out[at : at + span]
        elif action == 2:
            out[at:at] = rng.bytes(span)
        elif action == 3:
            out[at : at + 4] = struct.pack("<I", int(rng.choice(_LIES)))
        elif action == 4 and at < len(out):
            out[at] = int(rng.choice(_LIES[:5]))
        elif action == 5 and out:
            start = int(rng.integers(len(out)))
            out[at:at] = out[start : start + span]
    return bytes(out)


def _cut(rng: np.random.Generator, base: Base) -> bytes:
    return base.data[: int(rng.integers(len(base.data)))]


def _damage(rng: np.random.Generator, base: Base) -> bytes:
    return _scramble(rng, base.data)


def _sections(rng: np.random.Generator, base: Base) -> bytes:
    """The payload of one section changed, everything around it repaired."""
    packets: list[EncodedPacket | bytes] = list(base.packets)
    at = int(rng.integers(len(packets)))
    header, sections = parse_packet(base.packets[at].data)
    if not sections:
        return _damage(rng, base)
    names = list(sections)
    target = names[int(rng.integers(len(names)))]
    for name in ("motion", "field"):
        if name in sections and rng.random() < 0.5:
            target = name
    changed = {n: _payload(rng, n, s.data) if n == target else s.data for n, s in sections.items()}
    if "layers" in changed and target != "layers":
        changed["layers"] = _repaired_layers(changed)
    packets[at] = build_packet(header.kind, header.frame, list(changed.items()))
    return _join(packets)


def _repaired_layers(payloads: Mapping[str, bytes]) -> bytes:
    """What section layers must say of the sections behind it, so that their damage reaches their decoders."""
    shown = [(name, payloads[name]) for name in payloads if name not in ("layers", "layout", "rest")]
    body = b"".join(SECTION_HEADER.pack(SECTION_IDS[name], len(data)) + data for name, data in shown)
    return payloads["layers"][:4] + struct.pack("<II", len(body), zlib.crc32(body))


def _payload(rng: np.random.Generator, name: str, data: bytes) -> bytes:
    # Compressed text is opened first: a flipped bit in a zstandard frame would never reach the reader of the text.
    if name == "meta" and rng.random() < 0.8:
        return compress(_scramble(rng, decompress(data, 1 << 24)))
    if name == "motion" and rng.random() < 0.5:
        return _heads(rng, data)
    if name == "field" and rng.random() < 0.5:
        return _shapes(rng, data)
    return _scramble(rng, data) if rng.random() < 0.95 else rng.bytes(int(rng.integers(40)))


def _heads(rng: np.random.Generator, data: bytes) -> bytes:
    """Flags, bins and steps of the first motion replaced by others that could be, and by some that could not."""
    at = 1 if data[0] == 1 else 1 + next(i for i, byte in enumerate(data[1:], 1) if byte < 128)
    steps = rng.choice([0.0, 1e-30, 0.01, 1.0, 1e8, 1e9, -1.0, np.nan, np.inf], 3, p=[0.02, *[0.23] * 4, *[0.015] * 4])
    head = struct.pack("<BBfff", int(rng.integers(5)), int(rng.integers(18)), *steps.tolist())
    for start, end in ((0, 1), (1, 2), (2, 6), (6, 10), (10, 14)):
        if rng.random() < 0.4:
            data = data[: at + start] + head[start:end] + data[at + end :]
    return data


def _shapes(rng: np.random.Generator, data: bytes) -> bytes:
    """Numbers of a field's shape replaced by others, most of which could be."""
    wholes, fields = list(data[:6]), list(struct.unpack_from("<HIII8f", data, 6))
    at = int(rng.integers(18))
    if at < 6:
        wholes[at] = int(rng.choice([1, 2, 3, 4, 8, 16, 20, 128]))
    elif at < 10:
        fields[at - 6] = int(rng.choice([1, 7, 16, 1024, 1 << 15]))
    else:
        fields[at - 6] = float(rng.choice([-1e30, -1.0, 0.0, 1e-30, 1.0, 1.5, 4.0, 1e8, 3e38, np.nan, np.inf]))
    return bytes(wholes) + struct.pack("<HIII8f", *fields) + data[52:]


def _lying_sections(rng: np.random.Generator, base: Base) -> bytes:
    """Numbers, counts and lengths of sections changed under correct checksums."""
    packets: list[EncodedPacket | bytes] = list(base.packets)
    at = int(rng.integers(len(packets)))
    data = base.packets[at].data
    kind, count, _, frame, _, _ = PACKET_HEADER.unpack_from(data)
    body = bytearray(data[PACKET_HEADER.size :])
    where = 0
    for _ in range(int(rng.integers(count)) if count else 0):
        where += 5 + int.from_bytes(body[where + 1 : where + 5], "little")
    if body and rng.random() < 0.7:
        body[where + 1 : where + 5] = struct.pack("<I", int(rng.choice(_LIES)))
    elif body:
        body[where] = int(rng.integers(256))
    if rng.random() < 0.3:
        count = int(rng.integers(256))
    packets[at] = _seal(kind, count, frame, len(body), bytes(body))
    return _join(packets)


def _lying_header(rng: np.random.Generator, base: Base) -> bytes:
    """Type, frame or length of a packet changed under a correct header check."""
    packets: list[EncodedPacket | bytes] = list(base.packets)
    at = int(rng.integers(len(packets)))
    data = base.packets[at].data
    kind, count, _, frame, length, _ = PACKET_HEADER.unpack_from(data)
    what = int(rng.integers(3))
    kind = int(rng.integers(6)) if what == 0 else kind
    frame = int(rng.choice(_LIES)) if what == 1 else frame
    length = int(rng.choice(_LIES)) if what == 2 else length
    packets[at] = _seal(kind, count, frame, length, data[PACKET_HEADER.size :])
    return _join(packets)


def _order(rng: np.random.Generator, base: Base) -> bytes:
    """Packets left out, doubled, exchanged, or taken from another scene with the frame index this one needs."""
    packets: list[EncodedPacket | bytes] = list(base.packets)
    at, other = int(rng.integers(len(packets))), int(rng.integers(len(packets)))
    action = int(rng.integers(3))
    if action == 0:
        del packets[at]
    elif action == 1:
        packets.insert(other, packets[at])
    else:
        header, sections = parse_packet(base.packets[at].data)
        packets[other] = build_packet(header.kind, other, [(n, s.data) for n, s in sections.items()])
    return _join(packets) if packets else file_header()


def _seal(kind: int, count: int, frame: int, length: int, body: bytes) -> bytes:
    checksum = zlib.crc32(body, zlib.crc32(struct.pack("<BBII", kind, count, frame, length)))
    check = zlib.crc32(struct.pack("<BBIII", kind, count, frame, length, checksum)) & 0xFFFF
    return PACKET_HEADER.pack(kind, count, check, frame, length, checksum) + body


_MUTATIONS: dict[str, Callable[[np.random.Generator, Base], bytes]] = {
    "cut": _cut,
    "damage": _damage,
    "sections": _sections,
    "lying sections": _lying_sections,
    "lying header": _lying_header,
    "order": _order,
}
_WEIGHTS = (0.05, 0.1, 0.65, 0.1, 0.05, 0.05)
