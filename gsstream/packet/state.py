"""The state a stream of packets leads to. Encoder and player step it with the same function."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from gsstream.core.changes import Delta, Displacement, Layout, Scene, apply_delta, lit_background
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet.base import PacketKind, parse_header
from gsstream.packet.delta import decode_delta, decode_empty, next_decoders
from gsstream.packet.key import decode_key
from gsstream.packet.meta import StreamMeta

#: Empty packets after which what moved before is taken to have stopped.
MOST_SKIPPED = 8


@dataclass(frozen=True, slots=True)
class PlayerState:
    """What decoding one more packet needs.

    Arguments:
        frame: frame index.
        scene: the scene of that frame, and what of the frames before it the next packet may refer to.
        meta: that of the last key packet, with the background in the light of this frame.
        decoders: the decoders last sent since then.
        delta: what the packet of this frame changed; None after a key or an empty packet.
        before: the layout that ``delta`` refers to, that of the frame before; None without a delta.
        key_rows: number of Gaussians of the last key packet.
        replaced: the scene of the frame before, which the key packet of this frame replaced; None where this frame has
            another packet, or the player began with it.
        empty: number of empty packets up to this frame.
    """

    frame: int
    scene: Scene
    meta: StreamMeta
    decoders: Mapping[str, FloatArray] = field(default_factory=dict)
    delta: Delta | None = None
    before: Layout | None = None
    key_rows: int = 0
    replaced: Scene | None = None
    empty: int = 0

    @property
    def gaussians(self) -> Gaussians[FloatArray]:
        """The Gaussians of this frame."""
        return self.scene.gaussians

    @property
    def layout(self) -> Layout:
        """How the rows of this frame are stored."""
        return self.scene.layout


def decode_packet(state: PlayerState | None, data: bytes, *, offset: int = 0) -> PlayerState:
    """Return the state after one complete packet. Raises PacketError with the byte offset.

    Arguments:
        state: that of the frame before; a key packet needs none, and is the same scene with one.
        data: the packet.
        offset: its place in the file, for errors.
    """
    header = parse_header(data, offset)
    if header.kind == PacketKind.KEY:
        key = decode_key(data, offset=offset)
        scene = Scene(key.gaussians, key.layout)
        replaced = state.scene if state is not None and header.frame == state.frame + 1 else None
        return PlayerState(header.frame, scene, key.meta, key_rows=len(key.gaussians), replaced=replaced)
    if state is None or header.frame != state.frame + 1:
        had = "none" if state is None else f"frame {state.frame}"
        raise PacketError(f"frame {header.frame} needs the state of the frame before it, got {had}", offset)
    if header.kind == PacketKind.EMPTY:
        decode_empty(data, offset=offset)
        still = replace(state.scene, displacement=None, heading=_heading_on(state))
        number = state.empty + 1
        return replace(state, frame=header.frame, scene=still, delta=None, before=None, replaced=None, empty=number)
    delta = decode_delta(data, state.scene, state.decoders, offset=offset)
    try:
        scene, meta = apply_delta(state.scene, delta), state.meta
        if delta.light is not None:
            meta = replace(meta, background=lit_background(meta.background, delta.light))
    except ShapeError as error:
        raise PacketError(str(error), offset) from error
    if state.empty and scene.displacement is not None:  # the way of several frames
        scene = replace(scene, heading=scene.displacement.times(1 / (state.empty + 1)))
    decoders = next_decoders(state.decoders, delta)
    return PlayerState(
        frame=header.frame,
        scene=scene,
        meta=meta,
        decoders=decoders,
        delta=delta,
        before=state.layout,
        key_rows=state.key_rows,
    )


def _heading_on(state: PlayerState) -> Displacement | None:
    """How far rows will have gone by the frame after an empty packet that follows this state.

    The packet says that nothing changed or that its frame was skipped: what moved has stopped, or is ever farther from
    where the scene has it.
    """
    if state.scene.ahead is None or state.empty >= MOST_SKIPPED:
        return None
    return state.scene.ahead.times((state.empty + 2) / (state.empty + 1))
