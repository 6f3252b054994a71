"""Which Gaussians come first in a key packet, and which packets of a run have layers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_encoder import REFINING, TINY, WORLD, frames

from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.first_layer import largest_error_mask
from gsstream.packet import EncodedPacket, PacketKind, decode_packet, encode_key, first_layer
from gsstream.packet.base import parse_packet
from gsstream.packet.key import KeyState


@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 7.0, 1e30]), max_size=40), st.floats(0.01, 1))
def test_those_chosen_are_missed_most(errors: list[float], share: float) -> None:
    chosen = largest_error_mask(torch.tensor(errors, dtype=torch.float64), share)
    values = np.array(errors)
    assert chosen.sum() == min(len(errors), max(1, round(share * len(errors))))
    if chosen.any() and not chosen.all():
        assert values[chosen].min() >= values[~chosen].max()
        # Of equal ones those that stand first.
        border = values == values[chosen].min()
        assert np.all(np.diff(chosen[border].astype(int)) <= 0)


def packets(count: int, **settings: Any) -> list[EncodedPacket]:
    with open_recording(WORLD) as source:
        encoder = encoder_for("s2gs-edge", source, {**TINY, **settings})
    return [encoder.encode(frame).packet for frame in frames()[:count]]


def test_frame_0_has_layers_and_shows_what_it_would_without() -> None:
    (layered,) = packets(1, **{"codec.first_layer": 0.4})
    (plain,) = packets(1, **{"codec.first_layer": 1.0})
    ours, theirs = (decode_packet(None, packet.data) for packet in (layered, plain))
    for (name, mine), (_, other) in zip(ours.gaussians.items(), theirs.gaussians.items(), strict=True):
        assert mine.tobytes() == other.tobytes(), name
    found = first_layer(layered.data)
    assert found is not None
    assert len(found.gaussians) == round(0.4 * len(ours.gaussians))
    assert first_layer(plain.data) is None
    # A packet without layers is what it always was.
    state = KeyState(theirs.gaussians, theirs.layout, theirs.meta)
    assert encode_key(state).data == plain.data


def test_the_first_layer_is_opaque_rather_than_faint() -> None:
    """By another reckoning than the images: what nobody sees is not what comes first."""
    (packet,) = packets(1, **{"codec.first_layer": 0.3, "first_frame.shell": False})
    found = first_layer(packet.data)
    assert found is not None
    whole = decode_packet(None, packet.data).gaussians
    assert np.median(found.gaussians.opacities) > np.median(whole.opacities)
    covered = [
        np.exp(np.sort(g.scales, 1)[:, 1:].sum(1)) / (1 + np.exp(-g.opacities)) for g in (found.gaussians, whole)
    ]
    assert np.median(covered[0]) > 1.2 * np.median(covered[1]), "opacity times the area of the two largest sides"


def test_a_refined_key_packet_has_layers_and_a_periodic_one_has_none() -> None:
    refined = packets(5, **{**REFINING, "codec.first_layer": 0.5})
    keys = [packet for packet in refined if packet.kind == PacketKind.KEY]
    assert len(keys) == 2
    assert all(first_layer(packet.data) is not None for packet in keys)
    first, *_, last = packets(3, **{"codec.key_interval": 2, "codec.first_layer": 0.5})
    assert (first.kind, last.kind) == (PacketKind.KEY, PacketKind.KEY)
    assert "rest" in parse_packet(first.data)[1]
    assert "rest" not in parse_packet(last.data)[1]


@pytest.mark.parametrize("share", [0.0, 1.1, -0.5])
def test_shares_that_cannot_be_are_refused(share: float) -> None:
    with pytest.raises(Exception, match="first_layer"):
        packets(1, **{"codec.first_layer": share})
