"""Vectors of Zstandard frames, put together block by block: what libraries write seldom, or never for a small text."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from tools.conformance.lying_keys import base, lie
from tools.conformance.tapes import Tape, Vector, meta_json, playing, refusing

RAW, SAME, PACKED = 0, 1, 2
#: How the three codes of sequences are stored: one symbol each; as in the block before.
ONE_SYMBOL, AS_BEFORE = b"\x54", b"\xfc"


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    for name, data in _sound().items():
        tape = Tape().key({**base(0), "meta": data})
        yield playing(f"meta-frame-{name}", "meta zstandard", "3.2-1 3.2-2 3.2-3", tape)
    for name, data in _faulty().items():
        yield refusing(f"meta-frame-{name}", "meta zstandard", "3.2-3", lie({**base(0), "meta": data}))


def block(kind: int, content: bytes, size: int | None = None, *, last: bool = False) -> bytes:
    """Return a block; ``size``: what its header says, where that is not the length of its content."""
    head = (len(content) if size is None else size) << 3 | kind << 1 | last
    return head.to_bytes(3, "little") + content


def frame(size: int, *blocks: bytes, window: int | None = None) -> bytes:
    """Return a frame of so many bytes of content; ``window``: its descriptor, None: one segment."""
    flag = 0xA0 if window is None else 0x80
    said = b"" if window is None else bytes([window])
    return b"\x28\xb5\x2f\xfd" + bytes([flag]) + said + struct.pack("<I", size) + b"".join(blocks)


def literals(text: bytes, *, kind: int = RAW, count: int | None = None, wide: int = 0) -> bytes:
    """Return raw literals, or one that is repeated; ``wide``: bytes of the head, 0: as few as suffice."""
    number = len(text) if count is None else count
    wide = wide or (1 if number < 32 else 2 if number < 4096 else 3)
    if wide == 1:
        return bytes([number << 3 | kind]) + text
    return (number << 4 | (1 if wide == 2 else 3) << 2 | kind).to_bytes(wide, "little") + text


def tree_of_ascii() -> bytes:
    """Return a Huffman tree, its weights stored as they are: 128 symbols of 7 bits, of which the last is implied."""
    return bytes([127 + 127]) + b"\x11" * 63 + b"\x10"


def coded(text: bytes) -> bytes:
    """Return text as one stream of that tree: 7 bits each, written from the end."""
    value = 1
    for byte in text:
        value = value << 7 | byte
    return value.to_bytes((value.bit_length() + 7) // 8, "little")


def huffman(text: bytes, *, tree: bool) -> bytes:
    """Return coded literals in one stream, with their tree or with that of the block before."""
    body = (tree_of_ascii() if tree else b"") + coded(text)
    return (len(body) << 14 | len(text) << 4 | (2 if tree else 3)).to_bytes(3, "little") + body


def huffman_of_four(text: bytes) -> bytes:
    """Return coded literals in four streams, with their tree."""
    each = -(-len(text) // 4)
    streams = [coded(text[i * each : (i + 1) * each]) for i in range(4)]
    body = tree_of_ascii() + struct.pack("<3H", *map(len, streams[:3])) + b"".join(streams)
    return (len(body) << 14 | len(text) << 4 | 1 << 2 | 2).to_bytes(3, "little") + body


def sequences(number: int, modes: bytes, codes: bytes, extra: str) -> bytes:
    """Return sequences; ``codes``: of literals, offset and match where they are sent; ``extra``: all their bits."""
    value = int("1" + extra, 2)
    return bytes([number]) + modes + codes + value.to_bytes((value.bit_length() + 7) // 8, "little")


def _sound() -> dict[str, bytes]:
    text = meta_json()
    start, end, none = text[:-1] + b',"k":[', b"0]}", b"\0"
    spaces = block(SAME, b" ", 900)
    size = len(text)
    pairs = block(PACKED, literals(b"[1],[2],[3],") + sequences(3, ONE_SYMBOL, bytes([4, 2, 1]), "111111"))
    again = block(PACKED, literals(b"[4],[5],") + sequences(2, AS_BEFORE, b"", "1111"))
    latest = block(PACKED, literals(b"[6],") + sequences(1, ONE_SYMBOL, bytes([4, 0, 1]), ""))
    further = block(PACKED, literals(b"[7],") + sequences(1, ONE_SYMBOL, bytes([4, 3, 5]), "011"))
    second = block(PACKED, literals(b"") + sequences(1, ONE_SYMBOL, bytes([0, 0, 1]), ""))
    third = block(PACKED, literals(b"[8],") + sequences(1, ONE_SYMBOL, bytes([4, 1, 1]), "1"))
    copies = block(RAW, start) + pairs + again + latest + further + second + third + block(RAW, end, last=True)
    # Each of eight elements of four bytes, one as often as it is copied.
    elements = len(start) + 4 * (6 + 4 + 2 + 3 + 1 + 2) + len(end)
    half = size // 2
    return {
        "window": frame(size + 900, block(RAW, text), spaces, block(RAW, b"", last=True), window=0),
        "window-of-eighths": frame(size, block(RAW, text, last=True), window=0x0F),
        "literals-raw": frame(size, block(PACKED, literals(text) + none, last=True), window=0),
        "literals-raw-of-three-heads": frame(
            size,
            block(PACKED, literals(text[:9]) + none),
            block(PACKED, literals(text[9:50], wide=2) + none),
            block(PACKED, literals(text[50:], wide=3) + none, last=True),
        ),
        "literals-repeated": frame(
            size + 1000,
            block(RAW, text),
            block(PACKED, literals(b" ", kind=SAME, count=30) + none),
            block(PACKED, literals(b"\n", kind=SAME, count=70) + none),
            block(PACKED, literals(b"\t", kind=SAME, count=900, wide=3) + none, last=True),
        ),
        "weights-stored": frame(size, block(PACKED, huffman(text, tree=True) + none, last=True), window=0),
        "weights-of-the-block-before": frame(
            size,
            block(PACKED, huffman(text[:half], tree=True) + none),
            block(PACKED, huffman(text[half:], tree=False) + none, last=True),
        ),
        "four-streams": frame(size, block(PACKED, huffman_of_four(text) + none, last=True), window=0),
        "codes-of-one-symbol": frame(elements, copies),
    }


def _faulty() -> dict[str, bytes]:
    text = meta_json()
    size, half = len(text), len(text) // 2
    four = literals(b"    ")

    def then(content: bytes, more: int) -> bytes:
        return frame(size + more, block(RAW, text), block(PACKED, content, last=True))

    return {
        "literals-code-beyond-the-last": then(four + sequences(1, ONE_SYMBOL, bytes([36, 2, 1]), "11"), 8),
        "offset-code-beyond-the-last": then(four + sequences(1, ONE_SYMBOL, bytes([4, 40, 1]), "1" * 40), 8),
        "match-code-beyond-the-last": then(four + sequences(1, ONE_SYMBOL, bytes([4, 2, 53]), "11"), 8),
        "codes-of-no-block-before": then(four + sequences(1, AS_BEFORE, b"", "11"), 8),
        "tree-of-no-block-before": frame(size, block(PACKED, huffman(text, tree=False) + b"\0", last=True), window=0),
        "copy-from-before-the-start": then(four + sequences(1, ONE_SYMBOL, bytes([4, 12, 1]), "1" * 12), 8),
        "more-literals-than-there-are": then(four + sequences(1, ONE_SYMBOL, bytes([9, 2, 1]), "11"), 13),
        "bits-left-over": then(four + sequences(1, ONE_SYMBOL, bytes([4, 2, 1]), "11000000000"), 8),
        "bits-too-few": then(four + sequences(1, ONE_SYMBOL, bytes([4, 9, 1]), "11"), 8),
        "codes-cut": then(four + b"\1" + ONE_SYMBOL + b"\4", 8),
        "literals-cut": then(literals(b"   ", count=9), 9),
        "bytes-behind-no-sequences": then(four + b"\0\0", 4),
        "more-than-is-said": frame(half, block(RAW, text, last=True)),
        "less-than-is-said": frame(size + 1, block(RAW, text, last=True)),
        "no-last-block": frame(size, block(RAW, text)),
    }
