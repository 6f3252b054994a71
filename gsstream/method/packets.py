"""Packets and the players' state after them, in one call each: a method continues from the players' state."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gsstream.core.changes import Delta, Layout
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet import (
    EncodedPacket,
    KeyState,
    KnownMotions,
    PlayerState,
    StreamMeta,
    decode_packet,
    encode_delta,
    encode_empty,
    encode_key,
)


class Sent(NamedTuple):
    """A packet, and the state every player has after it."""

    packet: EncodedPacket
    player: PlayerState


def send_key(gaussians: Gaussians[FloatArray], layout: Layout, meta: StreamMeta, frame: int) -> Sent:
    """Return a key packet, and the state of every player after it. Raises ShapeError when the rows do not fit.

    Arguments:
        gaussians: N rows, raw values, stored node by node.
        layout: nodes and units of the rows.
        meta: what the packet says about the run.
        frame: its index.
    """
    packet = encode_key(KeyState(gaussians.map(np.ascontiguousarray), layout, meta), frame=frame)
    return _decoded(packet, decode_packet(None, packet.data))


def delta_packet(player: PlayerState, delta: Delta, *, frame: int, known: KnownMotions | None = None) -> EncodedPacket:
    """Return the packet of a delta, an empty one when nothing changes. Raises ShapeError as :func:`send_delta` does."""
    if delta.is_empty:
        return encode_empty(frame=frame)
    return encode_delta(delta, player.layout, player.decoders, frame=frame, known=known)


def send_delta(player: PlayerState, delta: Delta) -> Sent:
    """Return the packet of the frame after ``player``, an empty one when nothing changes, and the state after it.

    Decoders of the residual must come from ``quantise_decoders``. Raises ShapeError when the delta does not fit the
    scene.
    """
    packet = delta_packet(player, delta, frame=player.frame + 1)
    return _decoded(packet, decode_packet(player, packet.data))


def _decoded(packet: EncodedPacket, player: PlayerState) -> Sent:
    return Sent(replace(packet, decoded=player), player)
