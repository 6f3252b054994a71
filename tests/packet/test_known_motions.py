"""Motions that were encoded before: the same packet, and never that of other motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from packet_scenes import begin, make_delta, make_motions

from gsstream.core.changes import Delta
from gsstream.packet import decode_delta, encode_delta
from gsstream.packet.changes.motion import encode_motions


def test_known_motions_are_not_encoded_again_and_give_the_same_packet() -> None:
    rng = np.random.default_rng(3)
    state = begin(rng)
    moved = make_motions(rng, state.scene, 2)
    delta = Delta((*moved.changes, *make_delta(rng, state.layout).changes))
    known = delta.motions, encode_motions(delta.motions)
    for some in (delta, delta.with_residual(None)):
        wanted = encode_delta(some, state.layout, state.decoders, frame=1)
        assert encode_delta(some, state.layout, state.decoders, frame=1, known=known).data == wanted.data


def test_sections_of_other_motions_are_not_taken() -> None:
    rng = np.random.default_rng(4)
    state = begin(rng)
    delta = make_motions(rng, state.scene, 1)
    other = Delta((replace(delta.motions[0], symbols=delta.motions[0].symbols + 1),))
    known = other.motions, encode_motions(other.motions)
    packet = encode_delta(delta, state.layout, state.decoders, frame=1, known=known)
    found = decode_delta(packet.data, state.scene, state.decoders)
    np.testing.assert_array_equal(found.motions[0].symbols, delta.motions[0].symbols)
    residual = make_delta(rng, state.layout)
    wanted = encode_delta(residual, state.layout, state.decoders, frame=1).data
    assert encode_delta(residual, state.layout, state.decoders, frame=1, known=known).data == wanted
