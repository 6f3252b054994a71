"""The state a stream of packets leads to. Encoder and player step it with the same function."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gsstream.core.delta import Delta, Layout, apply_delta, next_layout
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet.base import PacketKind, parse_header
from gsstream.packet.delta import decode_delta, decode_empty, next_decoders
from gsstream.packet.key import decode_key
from gsstream.packet.meta import StreamMeta


@dataclass(frozen=True, slots=True)
class PlayerState:
    """What decoding one more packet needs.

    Arguments:
        frame: frame index.
        gaussians: the scene of that frame.
        layout: how the scene is stored. meta: that of the last key packet.
        decoders: the decoders last sent since then.
        delta: what the packet of this frame changed; None after a key or an empty packet.
        before: the layout that ``delta`` refers to, that of the frame before; None without a delta.
    """

    frame: int
    gaussians: Gaussians[FloatArray]
    layout: Layout
    meta: StreamMeta
    decoders: Mapping[str, FloatArray]
    delta: Delta | None = None
    before: Layout | None = None


def decode_packet(state: PlayerState | None, data: bytes, *, offset: int = 0) -> PlayerState:
    """The state after one complete packet.

    ``state`` is that of the frame before (a key packet needs none); ``offset`` is the packet's place in the file.
    Raises PacketError with the byte offset.
    """
    header = parse_header(data, offset)
    if header.kind == PacketKind.KEY:
        key = decode_key(data, offset=offset)
        return PlayerState(header.frame, key.gaussians, key.layout, key.meta, {})
    if state is None or header.frame != state.frame + 1:
        had = "none" if state is None else f"frame {state.frame}"
        raise PacketError(f"frame {header.frame} needs the state of the frame before it, got {had}", offset)
    if header.kind == PacketKind.EMPTY:
        decode_empty(data, offset=offset)
        return PlayerState(header.frame, state.gaussians, state.layout, state.meta, state.decoders)
    delta = decode_delta(data, state.layout, state.decoders, offset=offset)
    try:
        gaussians = apply_delta(state.gaussians, state.layout, delta)
        layout = next_layout(state.layout, delta)
    except ShapeError as error:
        raise PacketError(str(error), offset) from error
    decoders = next_decoders(state.decoders, delta)
    return PlayerState(header.frame, gaussians, layout, state.meta, decoders, delta, state.layout)
