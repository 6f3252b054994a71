"""Streams that are refused for their container or their coder, each for one rule."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

from tools.conformance.coding import Model, bits, column, constant, head, parts, run_gates, table, words
from tools.conformance.residuals import attribute
from tools.conformance.tapes import DELTA, EMPTY, INDEX, Tape, Vector, file_of, header, packet, refusing, seal

OPEN = run_gates([4], 1)


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _headers()
    yield from _packets()
    yield from _sections()
    yield from _order()
    yield from _indices()
    yield from _bits()
    yield from _models()
    yield from _gates()


def begun(rest: int = 3, frames: int = 2) -> Tape:
    """Return a stream of some sound frames, 6 rows in 4 nodes."""
    tape = Tape().start(400, 6, 4, rest)
    while tape.next < frames:
        tape.delta([("gates", OPEN), ("opacities", attribute([[1], [0], [-1], [2], [0], [3]], 0.25))])
    return tape


def _headers() -> Iterator[Vector]:
    sound = begun().bytes()
    starts = {
        "file-empty": (b"", "1.1-1"),
        "file-of-15-bytes": (sound[:15], "1.1-1"),
        "file-of-another-format": (b"\x89PNG\r\n\x1a\n" + sound[8:], "1.1-1"),
        "file-header-damaged": (sound[:12] + bytes([sound[12] ^ 1]) + sound[13:], "1.1-2"),
        "file-version-1.1": (header(1, 1) + sound[16:], "1.1-3"),
        "file-version-3.0": (header(3, 0) + sound[16:], "1.1-3"),
        "file-version-2.5": (header(2, 5) + sound[16:], "1.1-4"),
        "file-without-packets": (sound[:16], "1.4-4"),
        "file-with-half-a-key-packet": (sound[:300], "1.4-4"),
    }
    for name, (data, rule) in starts.items():
        yield refusing(name, "container versions" if "version" in name else "container", rule, data)


def _packets() -> Iterator[Vector]:
    tape = begun()
    good = packet(DELTA, 2, [("gates", OPEN)])
    body = good[16:]
    longer = good[:8] + struct.pack("<I", 1000) + good[12:]
    packets = {
        "packet-header-damaged": (good[:4] + b"\7" + good[5:], "1.2-1 1.6-2"),
        "packet-length-damaged": (longer, "1.2-1 1.6-2"),
        "packet-check-damaged": (good[:2] + bytes([good[2] ^ 4]) + good[3:], "1.2-1"),
        "packet-type-0": (seal(0, 2, body, 1), "1.2-2"),
        "packet-type-5": (seal(5, 2, body, 1), "1.2-2"),
        "packet-17-sections": (seal(DELTA, 2, bytes(85), 17), "1.2-3"),
        "packet-too-short-for-its-sections": (seal(DELTA, 2, body[:9], 2), "1.2-3"),
        "packet-body-above-2-30": (seal(DELTA, 2, b"", 1, length=(1 << 30) + 1), "1.2-3 1.8-1"),
        "packet-body-damaged": (good[:-1] + bytes([good[-1] ^ 1]), "1.2-4 1.6-2"),
    }
    for name, (data, rules) in packets.items():
        yield refusing(name, "container", f"{rules} 0.1-2", file_of([*tape.packets, data]))
    damaged = bytearray(begun(frames=5).bytes())
    damaged[len(begun().bytes()) + 20] ^= 255
    yield refusing("packet-damaged-with-sound-ones-behind", "container", "1.2-4 1.6-2 0.1-2", bytes(damaged))


def _sections() -> Iterator[Vector]:
    gates = struct.pack("<BI", 3, len(OPEN)) + OPEN
    bodies = {
        "section-past-its-packet": (struct.pack("<BI", 3, len(OPEN) + 1) + OPEN, 1, "1.3-1"),
        "section-longest-length": (struct.pack("<BI", 3, 0xFFFFFFFF) + OPEN, 1, "1.3-1 1.8-1"),
        "section-header-past-its-packet": (gates + bytes(4), 2, "1.3-1"),
        "section-bytes-after-the-last": (gates + b"\0", 1, "1.3-2"),
        "section-none-and-bytes": (gates, 0, "1.3-2"),
        "section-twice": (gates * 2, 2, "1.3-3"),
    }
    for name, (body, sections, rules) in bodies.items():
        yield refusing(name, "container", rules, begun().lie(seal(DELTA, 2, body, sections)))
    for number in (0, 14, 15, 22, 255):
        tape = begun().refused([("gates", OPEN), (number, b"")])
        yield refusing(f"section-unknown-{number}", "container versions", "1.3-4", tape)
    yield refusing(
        "empty-packet-with-a-section",
        "empty-packet container",
        "1.3-5",
        begun().lie(packet(EMPTY, 2, [("gates", OPEN)])),
    )
    yield refusing(
        "empty-packet-with-bytes", "empty-packet container", "1.3-5 1.3-2", begun().lie(seal(EMPTY, 2, b"\0", 0))
    )


def _order() -> Iterator[Vector]:
    gates: Sequence[tuple[str, bytes]] = [("gates", OPEN)]
    other = Tape().start(401, 3, 2, frame=3).packets
    for name, first in (
        ("delta", packet(DELTA, 0, gates)),
        ("empty", packet(EMPTY, 0, [])),
        ("index", packet(INDEX, 0, [("index", struct.pack("<Q4s", 16, b"GSSX"))])),
    ):
        yield refusing(f"order-{name}-first", "container", "1.4-1", file_of([first, *begun().packets]))
    for name, data in {
        "order-frame-left-out": packet(DELTA, 3, gates),
        "order-frame-twice": packet(DELTA, 1, gates),
        "order-empty-left-out": packet(EMPTY, 7, []),
        "order-key-left-out": other[0],
    }.items():
        yield refusing(name, "container", "1.4-2 4.2-1 4.8-1", begun().lie(data))
    last = Tape().start(402, 3, 2, frame=0xFFFFFFFF).lie(packet(EMPTY, 0, []))
    yield refusing("order-frame-after-the-largest", "container", "1.4-2 4.8-1", last)
    whole = begun().bytes(index=True)
    for name, more in (("packet", packet(EMPTY, 2, [])), ("index", whole[len(begun().bytes()) :])):
        yield refusing(f"order-{name}-after-the-index", "container index", "1.4-3", whole + more)


def _indices() -> Iterator[Vector]:
    tape = begun()
    data = tape.bytes()
    at = len(data)
    entry, end = struct.pack("<IQ", 0, 16), struct.pack("<Q4s", at, b"GSSX")
    indices: dict[str, tuple[bytes, str]] = {
        "index-of-another-frame": (packet(INDEX, 2, [("index", entry + end)]), "1.5-1"),
        "index-one-byte-more": (packet(INDEX, 1, [("index", b"\0" + entry + end)]), "1.5-2"),
        "index-shorter-than-its-end": (packet(INDEX, 1, [("index", end[4:])]), "1.5-2"),
        "index-with-another-section": (packet(INDEX, 1, [("index", entry + end), ("gates", b"")]), "1.5-2"),
        "index-without-its-section": (packet(INDEX, 1, []), "1.5-2"),
        "index-of-another-place": (
            packet(INDEX, 1, [("index", entry + struct.pack("<Q4s", at + 1, b"GSSX"))]),
            "1.5-3",
        ),
        "index-without-its-last-four-bytes": (
            packet(INDEX, 1, [("index", entry + struct.pack("<Q4s", at, b"GSSY"))]),
            "1.5-3",
        ),
        "index-key-at-another-place": (packet(INDEX, 1, [("index", struct.pack("<IQ", 0, 17) + end)]), "1.5-4"),
        "index-key-of-another-frame": (packet(INDEX, 1, [("index", struct.pack("<IQ", 1, 16) + end)]), "1.5-4"),
        "index-key-missing": (packet(INDEX, 1, [("index", end)]), "1.5-4"),
        "index-key-too-many": (packet(INDEX, 1, [("index", entry * 2 + end)]), "1.5-4"),
    }
    for name, (last, rules) in indices.items():
        yield refusing(name, "index container", rules, data + last)


def coded(payload: bytes, name: str = "opacities", channels: int = 1) -> Tape:
    """Return a stream whose last packet has these symbols for its six rows."""
    section = struct.pack("<BBf", 0, channels, 0.5) + payload
    return begun().refused([("gates", OPEN), (name, section)])


def _bits() -> Iterator[Vector]:
    values, model = [0, 1, 1, 0, 2, 0], Model(0, [3, 2, 1])
    top, tail = head([values], [model]), words([values], [model])
    tables = {
        "bits-head-cut": (parts(top[:-2], tail), "2.1-1"),
        "bits-head-empty": (parts(b"", tail), "2.1-1"),
        "bits-36-zeros": (parts(bits(("bits", 0, 1), ("bits", 0, 36), ("bits", 1, 1), ("bits", 0, 36)), tail), "2.1-2"),
        "bits-only-zeros": (parts(bytes(40), tail), "2.1-2"),
        "bits-a-byte-behind": (parts(top + b"\0", tail), "2.1-3 2.7-2"),
        "bits-padding-of-ones": (
            parts(bits(("bits", 0, 1), ("signed", 7), ("gamma", 0), ("bits", 0, 1), ("bits", 3, 2)), b""),
            "2.1-3 2.7-2",
        ),
        "parts-length-of-six-bytes": (b"\x80\x80\x80\x80\x80\x00" + tail, "2.2-1"),
        "parts-longer-than-what-is-left": (bytes([99]) + top + tail, "2.2-2"),
        "parts-longest-length": (b"\xff\xff\xff\xff\x7f" + top + tail, "2.2-2"),
        "parts-length-cut": (b"\x80", "2.2-2"),
        "symbols-missing": (b"", "2.2-2 1.3-6"),
        "words-not-of-four-bytes": (parts(top, tail + b"\1"), "2.6-1"),
        "words-last-is-0": (parts(top, tail + bytes(4)), "2.6-2"),
        "words-too-many": (parts(top, b"\1\0\0\0" + tail), "2.6-3"),
        "words-for-more-symbols": (parts(top, words([values * 20], [model])), "2.6-3"),
        "words-of-a-constant": (parts(head([[1] * 6], [Model(1, [1])]), b"\1\0\0\0"), "2.6-3"),
    }
    for name, (payload, rules) in tables.items():
        yield refusing(name, "coder", rules, coded(payload))
    rows = constant(1, 1)
    tape = begun().refused([("gates", run_gates([4], 0)), ("opacities", struct.pack("<BBf", 0, 1, 0.5) + rows)])
    yield refusing("symbols-of-no-rows", "coder", "2.3-1 1.3-6", tape)


def _models() -> Iterator[Vector]:
    def made(*fields: tuple[str, int] | tuple[str, int, int]) -> bytes:
        return parts(bits(("bits", 0, 1), *fields), b"")

    two = (("signed", 0), ("gamma", 1), ("bits", 0, 1))
    tables = {
        "model-16385-bins": (
            made(("signed", 0), ("gamma", 16384), ("bits", 0, 1), *[("signed", 0)] * 16385),
            "2.4-1 1.8-1",
        ),
        "model-most-bins-of-gamma": (made(("signed", 0), ("gamma", (1 << 35) - 2), ("bits", 0, 1)), "2.4-1 1.8-1"),
        "model-low-below-32-bits": (made(("signed", -(1 << 31) - 1), ("gamma", 0), ("bits", 0, 1)), "2.4-2"),
        "model-bins-above-32-bits": (made(("signed", (1 << 31) - 1), *two[1:], ("signed", 1), ("signed", 0)), "2.4-2"),
        "model-count-of-33-bits": (made(*two, ("signed", 33), ("bits", 0, 2), ("signed", -33)), "2.4-3"),
        "model-count-of-minus-1-bits": (made(*two, ("signed", 1), ("signed", -2)), "2.4-3"),
        "model-without-counts": (made(*two, ("signed", 0), ("signed", 0)), "2.4-4"),
    }
    for name, (payload, rules) in tables.items():
        yield refusing(name, "coder", rules, coded(payload))
    big, least = (1 << 31) - 1, -(1 << 31)
    above, below = Model(big - 1, [1, 5], True), Model(least + 1, [1, 5], True)
    yield refusing("escape-above-32-bits", "coder", "2.7-1", coded(table([[big + 1] * 6], [above])))
    yield refusing("escape-below-32-bits", "coder", "2.7-1", coded(table([[least - 1] * 6], [below])))
    some = Model(0, [1, 5], True)
    longer = parts(head([[3] * 7], [some]), words([[3] * 6], [some]))
    yield refusing("escapes-too-many", "coder", "2.7-2 2.1-3", coded(longer))
    fewer = parts(head([[3] * 2], [some]), words([[3] * 6], [some]))
    yield refusing("escapes-too-few", "coder", "2.1-1", coded(fewer))


def _gates() -> Iterator[Vector]:
    def said(
        *fields: tuple[str, int] | tuple[str, int, int], tokens: tuple[bytes, bytes] = (b"", b""), levels: bytes = b""
    ) -> bytes:
        return parts(bits(*fields), *tokens, levels)

    one = ("gamma", 0)
    gates = {
        "gates-256-levels": (said(("gamma", 255), ("gamma", 1), ("bits", 1, 1), levels=constant(1, 4)), "2.8-1 1.8-1"),
        "gates-more-runs-than-entries": (run_gates([1] * 5, 0), "2.8-2"),
        "gates-many-runs": (said(one, ("gamma", 1 << 30), ("bits", 1, 1)), "2.8-2 1.8-1"),
        "gates-no-run": (said(one, ("gamma", 0), ("bits", 1, 1)), "2.8-2"),
        "gates-token-72": (
            said(one, ("gamma", 2), ("bits", 1, 1), ("bits", 0, 32), tokens=(column([72]), b"")),
            "2.8-3",
        ),
        "gates-token-below-0": (said(one, ("gamma", 2), ("bits", 1, 1), tokens=(column([-1]), b"")), "2.8-3"),
        "gates-runs-leave-nothing": (said(one, ("gamma", 2), ("bits", 1, 1), tokens=(column([3]), b"")), "2.8-4"),
        "gates-run-longest": (
            said(one, ("gamma", 2), ("bits", 1, 1), ("bits", 1, 30), tokens=(column([70]), b"")),
            "2.8-4",
        ),
        "gates-level-0": (run_gates([4], 1, 3, [1, 2, 0, 3]), "2.8-5"),
        "gates-level-too-high": (run_gates([4], 1, 3, [1, 2, 4, 3]), "2.8-5"),
        "gates-padding-of-ones": (said(one, ("gamma", 1), ("bits", 1, 1), ("bits", 1, 3)), "2.8-6 2.1-3"),
        "gates-extra-bits-missing": (
            said(one, ("gamma", 2), ("bits", 1, 1), tokens=(column([60]), b"")),
            "2.8-6 2.1-1",
        ),
        "gates-levels-of-one-level": (said(one, ("gamma", 1), ("bits", 1, 1), levels=constant(1, 4)), "2.3-1 2.8-6"),
        "gates-levels-missing": (said(("gamma", 2), ("gamma", 1), ("bits", 1, 1)), "2.2-2"),
        "gates-without-parts": (b"\xa8", "2.2-2 1.3-6"),
    }
    for name, (payload, rules) in gates.items():
        yield refusing(name, "gates", rules, begun().refused([("gates", payload)]))
    empty = Tape().start(410, 0, 0, 0, units=())
    yield refusing("gates-a-run-of-no-entries", "gates empty-scene", "2.8-2", empty.refused([("gates", OPEN)]))
    for name in ("removed",):
        marks = run_gates([1, 5], 1, 2, [1])
        yield refusing(f"gates-two-levels-of-{name}", "gates rows", "2.8-7", begun().refused([(name, marks)]))
