"""What the packet format promises, checked on its four functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta, Layout, Residual, apply_delta, sent_rows
from gsstream.core.errors import PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet import (
    EncodedPacket,
    KeyState,
    PlayerState,
    StreamMeta,
    decode_packet,
    encode_delta,
    encode_empty,
    encode_key,
)
from gsstream.testing.cases import fingerprint
from gsstream.testing.registry import check


@dataclass(frozen=True)
class PacketCodec:
    """The functions under test; a saboteur replaces one."""

    name: str = "packet format"
    key: Callable[..., EncodedPacket] = field(default=encode_key, repr=False)
    delta: Callable[..., EncodedPacket] = field(default=encode_delta, repr=False)
    empty: Callable[..., EncodedPacket] = field(default=encode_empty, repr=False)
    decode: Callable[..., PlayerState] = field(default=decode_packet, repr=False)


def tiny_key(seed: int = 0, number: int = 40, nodes: int = 12) -> KeyState:
    """Return a scene of 40 Gaussians in 12 nodes."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> FloatArray:
        return rng.normal(size=shape).astype(np.float32)

    scene = Gaussians(
        means=normal(number, 3),
        quats=normal(number, 4),
        scales=normal(number, 3) - 3,
        opacities=normal(number),
        sh0=normal(number, 1, 3),
        shN=normal(number, 3, 3),
    )
    counts = np.bincount(rng.integers(0, nodes, number), minlength=nodes).astype(np.int32)
    layout = Layout(counts, rng.integers(0, 3, number).astype(np.uint8), np.array([1.0, 0.3, 0.1], np.float32))
    K = np.array([[50.0, 0, 16], [0, 51.0, 12], [0, 0, 1]])
    rig = Cameras(ids=("a", "b"), viewmats=np.tile(np.eye(4), (2, 1, 1)), Ks=np.tile(K, (2, 1, 1)), width=32, height=24)
    meta = StreamMeta(
        method="dense",
        source="contract kit",
        recipe={},
        train=rig.select([0]),
        test=rig.select([1]),
        fps=30.0,
        background=(0.0, 0.0, 0.0),
        plugins={},
    )
    return KeyState(scene, layout, meta)


def tiny_delta(layout: Layout, seed: int = 1) -> Delta:
    """Return a delta in which about half of the nodes are open and three attributes change."""
    rng = np.random.default_rng(seed)
    gates = (rng.random(len(layout.node_counts)) < 0.5) * rng.integers(1, 5, len(layout.node_counts))
    rows = len(sent_rows(layout, gates))
    widths = {"means": 3, "opacities": 1, "sh0": 3}
    symbols = {name: rng.integers(-3, 4, (rows, width)).astype(np.int32) for name, width in widths.items()}
    return Delta((Residual(gates.astype(np.uint8), 4, symbols, dict.fromkeys(widths, 0.02)),))


def _start(codec: PacketCodec) -> tuple[PlayerState, Delta, EncodedPacket]:
    """The state after a key packet, a delta and its packet."""
    state = codec.decode(None, codec.key(tiny_key(), frame=0).data)
    delta = tiny_delta(state.layout)
    return state, delta, codec.delta(delta, state.layout, state.decoders, frame=1)


def _same_rows(what: str, got: Gaussians[FloatArray], expected: Gaussians[FloatArray], rows: np.ndarray) -> None:
    for name, value in expected.items():
        wrong = np.flatnonzero((getattr(got, name)[rows] != value[rows]).reshape(len(rows), -1).any(1))
        assert len(wrong) == 0, (
            f"{what}: {name} of {len(wrong)} of {len(rows)} rows is not bitwise what was expected, first row "
            f"{int(rows[wrong[0]])}: expected {value[rows[wrong[0]]]!r}, got {getattr(got, name)[rows[wrong[0]]]!r}"
        )


def _refused(what: str, attempt: Callable[[], object]) -> None:
    try:
        attempt()
    except PacketError:
        return
    raise AssertionError(f"{what}: was accepted; expected PacketError")


@check("packet")
def check_packet_round_trip(codec: PacketCodec) -> None:
    """A delta comes back with the gates, levels and symbols it was written with."""
    state, delta, packet = _start(codec)
    played, wrote = codec.decode(state, packet.data).delta, delta.residual
    assert played is not None, "the decoded state holds no delta"
    got = played.residual
    assert got is not None, "the decoded delta holds no residual"
    assert wrote is not None
    assert np.array_equal(got.gates, wrote.gates), f"gates: expected {wrote.gates}, got {got.gates}"
    assert got.num_levels == wrote.num_levels, f"levels: expected {wrote.num_levels}, got {got.num_levels}"
    for name, value in wrote.symbols.items():
        wrong = int((got.symbols[name] != value).sum())
        assert wrong == 0, f"symbols of {name}: {wrong} of {value.size} differ"


@check("packet")
def check_packet_closed_loop(codec: PacketCodec) -> None:
    """Rows behind open gates become bitwise what the encoder computes."""
    state, delta, packet = _start(codec)
    expected = apply_delta(state.scene, delta).gaussians
    rows = sent_rows(state.layout, delta.gates(state.layout))
    _same_rows("open rows", codec.decode(state, packet.data).gaussians, expected, rows)


@check("packet")
def check_packet_closed_rows(codec: PacketCodec) -> None:
    """Rows behind closed gates keep every bit."""
    state, delta, packet = _start(codec)
    before = state.gaussians.map(np.copy)
    closed = np.setdiff1d(np.arange(len(before)), sent_rows(state.layout, delta.gates(state.layout)))
    _same_rows("closed rows", codec.decode(state, packet.data).gaussians, before, closed)


@check("packet")
def check_packet_pure(codec: PacketCodec) -> None:
    """Decoding changes neither the state it starts from nor its second result."""
    state, _, packet = _start(codec)
    before = fingerprint(state)
    first = codec.decode(state, packet.data)
    assert fingerprint(state) == before, "decoding changed the state before"
    assert fingerprint(codec.decode(state, packet.data)) == fingerprint(first), "decoding twice gives two results"


@check("packet")
def check_packet_size_is_true(codec: PacketCodec) -> None:
    """The reported sizes add up to the bytes of the packet."""
    _, _, delta = _start(codec)
    for what, packet in (("key", codec.key(tiny_key())), ("delta", delta), ("empty", codec.empty(frame=1))):
        total = sum(packet.sizes.values())
        assert total == len(packet.data), f"{what} packet: says {total} bytes, has {len(packet.data)}"


@check("packet")
def check_packet_truncated(codec: PacketCodec) -> None:
    """A packet cut anywhere is refused: never a partial frame."""
    state, _, packet = _start(codec)
    for length in range(0, len(packet.data), 5):
        _refused(f"{length} of {len(packet.data)} bytes", partial(codec.decode, state, packet.data[:length]))


@check("packet")
def check_packet_damage(codec: PacketCodec) -> None:
    """A packet with any byte changed is refused."""
    state, _, packet = _start(codec)
    for place in range(0, len(packet.data), 3):
        data = bytearray(packet.data)
        data[place] ^= 0x40
        _refused(f"byte {place} of {len(data)} changed", partial(codec.decode, state, bytes(data)))


@check("packet")
def check_packet_order(codec: PacketCodec) -> None:
    """A delta without the frame before it is refused."""
    state, delta, packet = _start(codec)
    _refused("a delta without a state", partial(codec.decode, None, packet.data))
    later = codec.delta(delta, state.layout, state.decoders, frame=3)
    _refused("frame 3 after frame 0", partial(codec.decode, state, later.data))


@check("packet")
def check_packet_late_join(codec: PacketCodec) -> None:
    """Playing from a later key packet gives what playing from the start gives."""
    state, _, packet = _start(codec)
    key = codec.key(tiny_key(seed=5), frame=2)
    played, joined = codec.decode(codec.decode(state, packet.data), key.data), codec.decode(None, key.data)
    _same_rows("late join", joined.gaussians, played.gaussians, np.arange(len(played.gaussians)))


@check("packet")
def check_packet_empty(codec: PacketCodec) -> None:
    """An empty packet moves time on and nothing else."""
    state, _, _ = _start(codec)
    after = codec.decode(state, codec.empty(frame=1).data)
    assert after.frame == 1, f"frame: expected 1, got {after.frame}"
    _same_rows("empty packet", after.gaussians, state.gaussians, np.arange(len(state.gaussians)))
