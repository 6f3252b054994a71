"""Continue a stream exactly: everything the encoder needs follows from the stream, the source and the recipe."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gsstream.core.errors import OutputError, PacketError
from gsstream.core.frame import Frame
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import decoded_anchors, exposure_from_meta
from gsstream.engine.keys.keyframes import with_key_quality
from gsstream.engine.state.rows import follow
from gsstream.engine.state.stream_state import StreamState
from gsstream.packet import PacketKind, PlayerState, StreamMeta, StreamReader, decode_packet
from gsstream.packet.base import FILE_HEADER
from gsstream.source.base import FrameSource, SourceInfo


def resume_state(
    parts: Assembly, path: Path, source: FrameSource, rng: Rng, near: float, last: int | None = None
) -> StreamState | None:
    """Encoder state after the last complete packet of a stream; None when not even frame 0 is complete.

    Arguments:
        last: go on after this frame, whatever the stream holds beyond it.

    Raises OutputError when the recipe or the recording is not the one the stream was written with, or when the recipe
    carries state that a stream does not hold (gate moments across frames).
    """
    if parts.recipe.gate_training.optimiser == "persistent":
        raise OutputError(
            "gate_training.optimiser = 'persistent' carries Adam moments that no stream holds: such a run cannot be "
            "resumed; start it again with --overwrite"
        )
    # Before the replay: other parts would fail over a stream that is not theirs, and say something else.
    if not check_stream(parts, path, source.info) or (last is not None and last < 0):
        return None
    with StreamReader(path) as reader:
        state = _replay(parts, reader, rng, last)
        shown = [e for e in reader.frames if e.kind != PacketKind.EMPTY and e.frame <= state.player.frame][-1]
        key = decode_packet(None, reader.read(reader.frames[state.key_frame - reader.frames[0].frame]))

    def training(index: int) -> Frame:
        frame = source.frame(index, "train")
        return replace(frame, cameras=replace(frame.cameras, near=near))

    # A key packet says which picture its scene shows: it may stand for an older one.
    index = shown.frame if shown.kind != PacketKind.KEY else int(state.player.meta.extra.get("shown", shown.frame))
    at_key = with_key_quality(parts, replace(state, player=key), training(state.key_frame))
    return replace(state, previous=training(index), key_quality=at_key.key_quality)


def check_stream(parts: Assembly, path: Path, info: SourceInfo) -> bool:
    """Whether a stream has a complete frame 0 to go on from.

    Raises OutputError when the recipe or the recording is not the one it was written with.
    """
    if path.stat().st_size < FILE_HEADER.size:
        return False
    with StreamReader(path) as reader:
        if not reader.frames or reader.frames[0].kind != PacketKind.KEY:
            return False
        meta = decode_packet(None, reader.read(reader.frames[0])).meta
    _check_recipe(parts, meta)
    _check_recording(info, meta)
    return True


def replay(reader: StreamReader) -> PlayerState:
    """What every player has after the last complete packet."""
    player: PlayerState | None = None
    for entry in reader.frames:
        try:
            player = decode_packet(player, reader.read(entry), offset=entry.offset)
        except PacketError:
            break
    if player is None:
        raise PacketError("the first key packet of the stream is damaged", 0)
    return player


def _replay(parts: Assembly, reader: StreamReader, rng: Rng, last: int | None) -> StreamState:
    """Decode all packets; rebuild what the key packet implies at every key packet."""
    player: PlayerState | None = None
    state: StreamState | None = None
    for entry in reader.frames:
        if last is not None and entry.frame > last:
            break
        try:
            player = decode_packet(player, reader.read(entry), offset=entry.offset)
        except PacketError:
            break
        if entry.kind == PacketKind.KEY:
            state = key_state_from_player(parts, player, rng)
        else:
            assert state is not None
            state = follow(state, player)
    if state is None:
        raise PacketError("the first key packet of the stream is damaged", 0)
    return state


def key_state_from_player(parts: Assembly, player: PlayerState, rng: Rng) -> StreamState:
    """The encoder state right after a key packet, from the decoded packet alone (``previous`` is not set)."""
    gaussians = player.gaussians.map(torch.from_numpy)
    decoders = parts.update.init_decoders(gaussians, rng.stream("decoders", player.frame))
    return StreamState(
        player=player,
        hierarchy=rebuild_hierarchy(parts, player),
        previous=None,  # type: ignore[arg-type]
        decoders=decoders,
        exposure=exposure_from_meta(player.meta),
        key_frame=player.frame,
    )


def rebuild_hierarchy(parts: Assembly, player: PlayerState) -> Hierarchy:
    """The hierarchy the encoder built: the structure sees the same bits, so it gives the same forest."""
    return parts.structure.build(player.gaussians.map(torch.from_numpy), decoded_anchors(player))


def _check_recipe(parts: Assembly, meta: StreamMeta) -> None:
    old, new = dict(meta.recipe), parts.recipe.model_dump(mode="json")
    # The number of frames may grow: it decides where a run ends, not what its packets hold.
    changed = sorted(key for key in new if key != "frames" and old.get(key) != new[key])
    if changed:
        raise OutputError(
            f"the stream was written with another recipe: {', '.join(changed)} differ; resume with the same recipe "
            "(recipe.yaml beside the stream) or start again with --overwrite"
        )


def _check_recording(info: SourceInfo, meta: StreamMeta) -> None:
    for split, new, old in (("training", info.train, meta.train), ("test", info.test, meta.test)):
        same = new.ids == old.ids and (new.width, new.height) == (old.width, old.height)
        if not same or not np.allclose(new.viewmats, old.viewmats, atol=1e-6) or not np.allclose(new.Ks, old.Ks):
            raise OutputError(
                f"the stream was made from the recording {meta.source!r} ({meta.extra.get('source_uri', 'unknown')}), "
                f"whose {split} cameras are not those of {info.name!r} ({info.uri}); resume with the same --source"
            )
