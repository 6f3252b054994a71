"""Saboteurs of the checks of packets: the real functions, one of them spoilt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.changes import sent_rows
from gsstream.core.errors import PacketError
from gsstream.packet import EncodedPacket, PlayerState, decode_packet, encode_delta
from gsstream.packet.base import parse_header
from gsstream.testing.packet import PacketCodec

Decode = Callable[[PlayerState | None, bytes], PlayerState]


def _after(change: Callable[[PlayerState | None, PlayerState], PlayerState]) -> Decode:
    """Decoding, and then a change of the result, given the state before and after."""
    return lambda state, data: change(state, decode_packet(state, data))


def _mend(words: str) -> Decode:
    """Decoding that keeps the former state at errors with these words."""

    def decode(state: PlayerState | None, data: bytes) -> PlayerState:
        try:
            return decode_packet(state, data)
        except PacketError as error:
            if state is None or words not in str(error):
                raise
            return state

    return decode


def _nudge(after: PlayerState, rows: Any) -> PlayerState:
    means = after.gaussians.means.copy()
    means[rows] = np.nextafter(means[rows], np.float32(np.inf))
    return replace(after, scene=replace(after.scene, gaussians=replace(after.gaussians, means=means)))


def _wrong_symbols(_: PlayerState | None, after: PlayerState) -> PlayerState:
    residual = None if after.delta is None else after.delta.residual
    if after.delta is None or residual is None:
        return after
    symbols = {name: value + 1 for name, value in residual.symbols.items()}
    return replace(after, delta=after.delta.with_residual(replace(residual, symbols=symbols)))


def _drift(which: str) -> Callable[[PlayerState | None, PlayerState], PlayerState]:
    def change(_: PlayerState | None, after: PlayerState) -> PlayerState:
        if after.delta is None:
            return after
        rows = sent_rows(after.layout, after.delta.gates(after.layout))
        return _nudge(after, rows if which == "open" else np.setdiff1d(np.arange(len(after.gaussians)), rows))

    return change


def _scribble(before: PlayerState | None, after: PlayerState) -> PlayerState:
    if before is not None and after.delta is not None:
        before.gaussians.means[0] += 1
    return after


def _grown(*args: Any, **named: Any) -> EncodedPacket:
    packet = encode_delta(*args, **named)
    return replace(packet, sizes={**packet.sizes, "header": packet.sizes["header"] + 1})


def _any_order(state: PlayerState | None, data: bytes) -> PlayerState:
    if state is not None and len(data) > 20 and parse_header(data, 0).frame > state.frame + 1:
        state = replace(state, frame=parse_header(data, 0).frame - 1)
    return decode_packet(state, data)


def _sticky(before: PlayerState | None, after: PlayerState) -> PlayerState:
    return _nudge(after, slice(0, 3)) if before is not None and after.meta is not before.meta else after


def _asleep(before: PlayerState | None, after: PlayerState) -> PlayerState:
    if before is None or after.delta is not None or after.meta is not before.meta:
        return after
    return replace(after, frame=before.frame)


PACKET_SABOTEURS: dict[str, PacketCodec] = {
    "check_packet_round_trip": PacketCodec("symbols are one too large", decode=_after(_wrong_symbols)),
    "check_packet_closed_loop": PacketCodec("open rows are an ulp off", decode=_after(_drift("open"))),
    "check_packet_closed_rows": PacketCodec("closed rows move by an ulp", decode=_after(_drift("closed"))),
    "check_packet_pure": PacketCodec("decoding scribbles in the state before", decode=_after(_scribble)),
    "check_packet_size_is_true": PacketCodec("sizes are a byte off", delta=_grown),
    "check_packet_truncated": PacketCodec("a packet cut short is taken for an empty one", decode=_mend("bytes, got")),
    "check_packet_damage": PacketCodec("a wrong checksum is overlooked", decode=_mend("checksum")),
    "check_packet_order": PacketCodec("frames may be missing", decode=_any_order),
    "check_packet_late_join": PacketCodec("a key packet depends on the past", decode=_after(_sticky)),
    "check_packet_empty": PacketCodec("time stands still at empty packets", decode=_after(_asleep)),
}
