"""Joins: a state in the middle of a segment, reached from its key packet and a file beside the stream, bit for bit."""

from __future__ import annotations

import hashlib
import json
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from join_oracle import decode_join
from moving_scenes import make_gaussians, moving_packets
from node_runs import HERE, NODE, needs_node, node

from gsstream.core.changes import AddedGaussians, Delta, Motion, RowEdit, groups_for
from gsstream.core.errors import PacketError
from gsstream.packet import PlayerState, decode_packet, encode_delta
from gsstream.player.rows import track_rows
from gsstream.serve.joins import encode_join


def digest(state: PlayerState) -> str:
    return hashlib.sha256(b"".join(a.tobytes() for _, a in state.gaussians.items())).hexdigest()


def joins_of(packets):
    """(packets of a segment, states after each, joins after each but the first)."""
    state = key = decode_packet(None, packets[0].data)
    source, states, joins = np.arange(len(key.gaussians)), [key], []
    for packet in packets[1:]:
        state = decode_packet(state, packet.data)
        source = track_rows(source, state)
        joins.append(encode_join(key, state, source))
        states.append(state)
    return packets, states, joins


@pytest.fixture(scope="module", params=[(0, 1), (3, 40), (15, 300)], ids=str)
def joined(request):
    sh_rest, number = request.param
    found = joins_of(moving_packets(seed=sh_rest + 1, frames=14, key_at=99, number=number, sh_rest=sh_rest))
    assert len(found[2]) == 13
    assert len({state.meta.background for state in found[1]}) > 2
    return found


def test_a_join_leads_to_the_state_of_its_frame_and_on_to_the_next(joined):
    packets, states, joins = joined
    for frame, join in enumerate(joins, 1):
        state = decode_join(states[0], join)
        assert state.frame == frame
        for packet, expected in zip(packets[frame:], states[frame:], strict=True):
            assert digest(state) == digest(expected)
            assert state.meta.background == expected.meta.background
            if packet is not packets[-1]:
                state = decode_packet(state, packets[state.frame + 1].data)


@needs_node
def test_the_browser_reaches_the_same_bits_from_every_join(joined, tmp_path):
    packets, states, joins = joined
    parts = [p.data for p in packets] + joins
    (tmp_path / "parts.bin").write_bytes(b"".join(struct.pack("<I", len(part)) + part for part in parts))
    done = subprocess.run(
        [str(NODE), str(HERE / "join.mjs"), str(tmp_path / "parts.bin"), str(len(packets))],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    digests = [digest(state) for state in states]
    assert json.loads(done.stdout) == [digests[frame:] for frame in range(1, len(states))]


def test_damaged_joins_are_refused(joined):
    _, states, joins = joined
    rng = np.random.default_rng(0)
    for at in [0, 5, 9, *rng.integers(20, len(joins[5]), 20)]:
        data = bytearray(joins[5])
        data[at] ^= 1
        with pytest.raises(PacketError):
            decode_join(states[0], bytes(data))
    with pytest.raises(PacketError):
        decode_join(states[0], joins[5][:-3])
    with pytest.raises(PacketError):
        decode_join(states[1], joins[5])


@needs_node
def test_a_scene_without_an_old_row_forgets_its_groups(tmp_path):
    """Regression: the browser kept the groups of rows that had all left, and read the next motion by them."""
    packets = moving_packets(seed=2, frames=1, number=6, nodes=3)
    state = decode_packet(None, packets[0].data)
    rng = np.random.default_rng(1)

    def motion(state):
        groups = groups_for(state.scene, 0.5, 1, regroup=False)
        symbols = rng.integers(-9, 9, (groups.count, 6)).astype(np.int32)
        return Motion(0.5, 1, np.ones(groups.count, np.uint8), symbols, 2.0**-7, 2.0**-9, True, False)

    nodes = len(state.layout.node_counts)
    where = np.sort(rng.integers(0, nodes, 9))
    added = AddedGaussians(make_gaussians(rng, 9, 3), where, np.zeros(9, np.uint8), np.zeros(0, np.int64))
    for change in (motion, lambda s: RowEdit(added, np.arange(len(s.gaussians))), motion):
        packet = encode_delta(Delta((change(state),)), state.layout, state.decoders, frame=state.frame + 1)
        packets.append(packet)
        state = decode_packet(state, packet.data)
    _, states, joins = joins_of(packets)
    (tmp_path / "parts.bin").write_bytes(
        b"".join(struct.pack("<I", len(p)) + p for p in [*(p.data for p in packets), *joins])
    )
    command = [str(NODE), str(Path(HERE) / "join.mjs"), str(tmp_path / "parts.bin"), "4"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    digests = [digest(s) for s in states]
    assert json.loads(done.stdout) == [digests[1:], digests[2:], digests[3:]]


@needs_node
def test_without_its_join_a_frame_waits_for_every_piece_from_the_key_packet_on(tmp_path):
    """The last piece may be there before the others, and only when all are there is the stream cut short."""
    code = """
    const { PacketBuffer } = await load("buffer.js");
    const segments = [0, 5, 10].map((first) => ({ first, last: first + 4, join: first ? {} : null }));
    const buffer = new PacketBuffer(segments, () => {});
    buffer.parts[2].join.state = "failed";
    return given.map((states) => {
      buffer.parts.forEach((part, i) => Object.assign(part, { state: states[i], error: { message: "gone" } }));
      return buffer.failure(12, null)?.message ?? null;
    });
    """
    states = [["absent", "absent", "done"], ["done", "loading", "done"], ["failed", "absent", "done"], ["done"] * 3]
    assert node(code, states, tmp_path) == [None, None, "gone", "The stream is cut short here."]
