"""Key packets whose meta is refused, each for one rule."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from gsstream.packet.bits import compress
from tools.conformance.lying_keys import base, lie
from tools.conformance.tapes import Vector, meta_json, plain_frame, refusing

EYE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]
PINHOLE = [40, 0, 16, 0, 40, 16, 0, 0, 1]


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield from _frames()
    yield from _metas()
    yield from _cameras()


def _frames() -> Iterator[Vector]:
    text = meta_json()
    frame, packed = plain_frame(text), compress(text)
    skippable = struct.pack("<II", 0x184D2A50, 4) + b"abcd"
    sized = struct.pack("<I", len(text) + 1)
    wrong = frame[:5] + sized + frame[9:]
    reserved = frame[:9] + (len(text) << 3 | 7).to_bytes(3, "little") + text
    frames = {
        "twice": (frame * 2, "3.2-1"),
        "a-byte-behind": (frame + b"\0", "3.2-1"),
        "skippable-before": (skippable + frame, "3.2-1"),
        "skippable-behind": (frame + skippable, "3.2-1"),
        "none": (b"", "3.2-1 1.3-6"),
        "not-compressed": (text, "3.2-1"),
        "cut": (frame[:-1], "3.2-1 3.2-3"),
        "size-not-said": (b"\x28\xb5\x2f\xfd\x00\x58" + frame[9:], "3.2-2"),
        "dictionary": (b"\x28\xb5\x2f\xfd\xa1\x07" + frame[5:], "3.2-2"),
        "size-wrong": (wrong, "3.2-3"),
        "size-above-a-mebibyte": (
            plain_frame(b" " * ((1 << 17) - 1))[:5] + struct.pack("<I", (1 << 20) + 1) + b"\1\0\0",
            "3.2-3 1.8-1",
        ),
        "block-of-no-type": (reserved, "3.2-3"),
        "compressed-cut": (packed[:-9], "3.2-3"),
        "dictionary-of-4-bytes": (b"\x28\xb5\x2f\xfd\xa3\0\0\0\1" + frame[5:], "3.2-2"),
    }
    for name, (data, rules) in frames.items():
        yield refusing(f"meta-frame-{name}", "meta", rules, lie({**base(0), "meta": data}))


def told(text: bytes) -> bytes:
    """Return a stream with a key packet whose meta is this text."""
    return lie({**base(0), "meta": plain_frame(text)})


def without(name: str) -> bytes:
    """Return a meta that lacks an entry."""
    return meta_json(lambda meta: meta.pop(name) and None)


def put(change: dict[str, Any]) -> bytes:
    """Return a meta with other entries."""
    return meta_json(lambda meta: meta.update(change))


def in_train(change: dict[str, Any]) -> bytes:
    """Return a meta whose training cameras have other entries."""
    return meta_json(lambda meta: meta["train"].update(change))


def _metas() -> Iterator[Vector]:
    sound = meta_json()
    texts = {
        "byte-order-mark": (b"\xef\xbb\xbf" + sound, "3.2-4"),
        "utf-16": (sound.decode().encode("utf-16"), "3.2-4"),
        "not-utf-8": (sound.replace(b"conformance", b"conform\xffnce"), "3.2-4"),
        "an-array": (b"[" + sound + b"]", "3.2-4"),
        "a-comma-too-many": (sound.replace(b"}", b",}", 1), "3.2-4"),
        "nan": (sound.replace(b"30.0", b"NaN"), "3.2-4"),
        "cut": (sound[:-1], "3.2-4"),
        "empty": (b"", "3.2-4"),
        "101-deep": (sound.replace(b'"extra":{}', b'"extra":{"a":' + b"[" * 99 + b"]" * 99 + b"}"), "3.2-5 1.8-1"),
        "50000-deep": (b"[" * 50000, "3.2-5 1.8-1"),
    }
    for name, (text, rules) in texts.items():
        yield refusing(f"meta-{name}", "meta", rules, told(text))
    for name in ("fps", "background", "train", "test"):
        yield refusing(f"meta-without-{name}", "meta", "3.2-6", told(without(name)))
    values: list[tuple[str, str, dict[str, Any]]] = [
        ("fps-true", "3.2-6", {"fps": True}),
        ("fps-a-text", "3.2-6", {"fps": "30"}),
        ("fps-null", "3.2-6", {"fps": None}),
        ("fps-too-low", "3.2-7", {"fps": 0.0099}),
        ("fps-too-high", "3.2-7", {"fps": 100001}),
        ("fps-below-0", "3.2-7", {"fps": -30}),
        ("background-of-two", "3.2-6", {"background": [0, 0]}),
        ("background-a-text", "3.2-6", {"background": "abc"}),
        ("background-of-texts", "3.2-6", {"background": ["0", "0", "0"]}),
        ("background-too-large", "3.2-8", {"background": [0, 1e39, 0]}),
        ("train-an-array", "3.2-6", {"train": []}),
        ("test-null", "3.2-6", {"test": None}),
        ("world-an-array", "3.4-1", {"world": [1]}),
        ("world-null", "3.4-1", {"world": None}),
        ("world-scale-0", "3.4-1", {"world": {**WORLD, "scale": 0}}),
        ("world-scale-a-text", "3.4-1", {"world": {**WORLD, "scale": "1"}}),
        ("world-without-offset", "3.4-1", {"world": {"rotation": WORLD["rotation"], "scale": 1}}),
        ("world-rotation-of-rows", "3.4-1", {"world": {**WORLD, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}}),
        ("world-rotation-scaled", "3.4-1", {"world": {**WORLD, "rotation": [1.00001, 0, 0, 0, 1, 0, 0, 0, 1]}}),
        ("world-rotation-mirrored", "3.4-1", {"world": {**WORLD, "rotation": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}}),
    ]
    for name, rule, change in values:
        yield refusing(f"meta-{name}", "meta", rule, told(put(change)))
    yield refusing(
        "meta-background-infinite", "meta", "3.2-8", told(sound.replace(b'"background":[0.0', b'"background":[1e999'))
    )
    yield refusing("meta-fps-infinite", "meta", "3.2-7", told(sound.replace(b"30.0", b"1e999")))


WORLD: dict[str, Any] = {"rotation": [0, 1, 0, -1, 0, 0, 0, 0, 1], "offset": [5, 6, 7], "scale": 2}


def _turned(*changes: tuple[int, float]) -> list[float]:
    pose: list[float] = list(EYE)
    for at, value in changes:
        pose[at] = value
    return pose


def _lens(*changes: tuple[int, float]) -> list[float]:
    K: list[float] = list(PINHOLE)
    for at, value in changes:
        K[at] = value
    return K


#: Name of the fault, the rule that it breaks, and entries of ``train`` that have it.
RIGS: list[tuple[str, str, dict[str, Any]]] = [
    ("ids-a-text", "3.3-1", {"ids": "c"}),
    ("ids-of-numbers", "3.3-1", {"ids": [1]}),
    ("ids-missing-one", "3.3-1", {"ids": []}),
    ("ids-twice", "3.3-1", {"ids": ["a", "a"], "viewmats": [EYE] * 2, "Ks": [PINHOLE] * 2}),
    ("viewmats-too-few", "3.3-1", {"viewmats": []}),
    ("Ks-too-many", "3.3-1", {"Ks": [PINHOLE] * 2}),
    ("viewmats-of-rows", "3.3-1", {"viewmats": [np.reshape(EYE, (4, 4)).tolist()]}),
    ("viewmats-flat", "3.3-1", {"viewmats": EYE}),
    ("viewmats-of-texts", "3.3-1", {"viewmats": ["1" * 16]}),
    ("viewmats-of-booleans", "3.3-1", {"viewmats": [[bool(v) for v in EYE]]}),
    ("Ks-of-8", "3.3-1", {"Ks": [PINHOLE[:8]]}),
    ("id-empty", "3.3-2", {"ids": [""]}),
    ("id-slash", "3.3-2", {"ids": ["a/b"]}),
    ("id-backslash", "3.3-2", {"ids": ["a\\b"]}),
    ("id-colon", "3.3-2", {"ids": ["c:"]}),
    ("id-control", "3.3-2", {"ids": ["a\nb"]}),
    ("id-control-c1", "3.3-2", {"ids": ["a\x85"]}),
    ("id-line-separator", "3.3-2", {"ids": ["a\u2028b"]}),
    ("id-half-pair", "3.3-2", {"ids": ["a\ud800"]}),
    ("id-dots", "3.3-2", {"ids": [".."]}),
    ("id-dot-at-its-end", "3.3-2", {"ids": ["cam."]}),
    ("id-space-at-its-end", "3.3-2", {"ids": ["cam "]}),
    ("id-device", "3.3-2", {"ids": ["CoN.txt"]}),
    ("id-port", "3.3-2", {"ids": ["lpt9"]}),
    ("id-121-bytes", "3.3-2", {"ids": ["a" * 121]}),
    ("id-122-bytes-of-61-letters", "3.3-2", {"ids": ["ü" * 61]}),
    ("width-0", "3.3-3", {"width": 0}),
    ("width-65537", "3.3-3", {"width": 65537}),
    ("width-half", "3.3-3", {"width": 32.5}),
    ("width-above-64-bits", "3.3-3", {"width": 1 << 80}),
    ("height-a-text", "3.3-1", {"height": "32"}),
    ("height-true", "3.3-1", {"height": True}),
    ("pixels", "3.3-3", {"width": 65536, "height": 2049}),
    ("near-0", "3.3-4", {"near": 0}),
    ("near-below-0", "3.3-4", {"near": -1}),
    ("near-a-text", "3.3-1", {"near": "1"}),
    ("near-below-float32", "3.3-4", {"near": 1e-300}),
    ("near-above-float32", "3.3-4", {"near": 1e39}),
    ("viewmat-above-float32", "3.3-5", {"viewmats": [_turned((3, 1e39))]}),
    ("viewmat-scaled", "3.3-5", {"viewmats": [_turned((0, 1.01))]}),
    ("viewmat-mirrored", "3.3-5", {"viewmats": [_turned((0, -1))]}),
    ("viewmat-last-row", "3.3-5", {"viewmats": [_turned((12, 0.1))]}),
    ("K-focal-0", "3.3-6", {"Ks": [_lens((0, 0))]}),
    ("K-focal-below-0", "3.3-6", {"Ks": [_lens((4, -40))]}),
    ("K-focal-below-float32", "3.3-6", {"Ks": [_lens((0, 1e-46), (4, 3e38))]}),
    ("K-above-float32", "3.3-6", {"Ks": [_lens((2, 1e39))]}),
    ("K-skew", "3.3-6", {"Ks": [_lens((1, 0.1))]}),
    ("K-last-row", "3.3-6", {"Ks": [_lens((8, 2))]}),
    ("K-not-invertible", "3.3-6", {"Ks": [_lens((0, 1e-8), (4, 1e-8))]}),
    ("K-a-little-too-small", "3.3-6", {"Ks": [_lens((0, 1e-6), (4, 0.999998e-6))]}),
]


def _cameras() -> Iterator[Vector]:
    for name, rule, change in RIGS:
        text = in_train(change)
        yield refusing(f"cameras-{name}", "meta cameras", rule, told(text))
    none = meta_json(lambda meta: meta["train"].update(ids=[], viewmats=[], Ks=[]))
    yield refusing("cameras-none", "meta cameras", "3.3-1", told(none))
    test = meta_json(lambda meta: meta["test"].update(width=0))
    yield refusing("cameras-test-width-0", "meta cameras", "3.3-3", told(test))
