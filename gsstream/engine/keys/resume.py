"""Continue a stream exactly: everything the encoder needs follows from the stream, the source and the recipe."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from gsstream.core.errors import OutputError, PacketError
from gsstream.core.frame import Frame, packed_frame
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.names import without_places
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import decoded_anchors, memory_across_key, shell_behind
from gsstream.engine.frame0.refine import advance_refinement, is_to_be_refined, shown_by_key, start_refinement
from gsstream.engine.state.colour_maps import exposure_from_meta, gains_from_meta
from gsstream.engine.state.stream_state import Refinement, StreamState, next_state
from gsstream.engine.step.compared import looks_back
from gsstream.input.recordings.base import SourceInfo
from gsstream.method.tools import Tools
from gsstream.packet import PacketKind, PlayerState, StreamMeta, StreamReader, decode_packet
from gsstream.packet.base import FILE_HEADER

#: Keys that may differ when a run is resumed, by section; besides them, ``frames``.
ENDING = {"data": ("bad_image",), "stream": ("on_error",)}


class Ended(NamedTuple):
    """End of a stream: the players' state, the frame whose pictures this scene shows, the last key frame."""

    player: PlayerState
    shown: int
    key_frame: int


def read_end(path: Path, last: int | None = None) -> Ended:
    """Decode a stream to its last sound packet. Raises PacketError when not even the first is sound."""
    player: PlayerState | None = None
    shown = key = 0
    for player, kind in _decoded_states(path, last):
        if kind == PacketKind.KEY:
            key = player.frame
            shown = shown_by_key(player)
        elif player.delta is not None and not player.delta.is_light_at_most:
            shown = player.frame
    if player is None:
        raise PacketError("the first key packet of the stream is damaged", 0)
    return Ended(player, shown, key)


def states_since_key(path: Path, end: Ended) -> Iterator[PlayerState]:
    """Yield the players' state after every packet from the last key packet to the end."""
    for player, _ in _decoded_states(path, end.player.frame):
        if player.frame >= end.key_frame:
            yield player


def _decoded_states(path: Path, last: int | None) -> Iterator[tuple[PlayerState, PacketKind]]:
    """States and kinds of packets up to ``last`` or the first that is not sound."""
    player: PlayerState | None = None
    with StreamReader(path) as reader:
        for entry in reader.frames:
            if last is not None and entry.frame > last:
                return
            try:
                player = decode_packet(player, reader.read(entry), offset=entry.offset)
            except PacketError:
                return
            yield player, entry.kind


def check_stream(assembly: Assembly, path: Path, info: SourceInfo) -> bool:
    """Say whether a stream has a complete frame 0. Raises OutputError for another recipe or recording than its own."""
    if path.stat().st_size < FILE_HEADER.size:
        return False
    with StreamReader(path) as reader:
        if not reader.frames or reader.frames[0].kind != PacketKind.KEY:
            return False
        meta = decode_packet(None, reader.read(reader.frames[0])).meta
    _check_recipe(assembly, meta)
    _check_recording(info, meta)
    return True


def state_after(assembly: Assembly, states: Iterable[PlayerState], rng: Rng) -> StreamState:
    """Return the state after these player states, the first that of a key packet; ``previous`` is not set."""
    state: StreamState | None = None
    for player in states:
        if state is None:
            state = key_state_from_player(assembly, player, rng)
        else:
            state = next_state(assembly.motion, state, player, rng)
    assert state is not None, "a stream without a key packet"
    return state


def earlier_pictures(assembly: Assembly, tools: Tools) -> Frame | None:
    """Return the pictures that the scene showed before the last packet; None where the next frame does not look back.

    It does where that packet changed the scene, and no lamp was switched in it or since the scene last changed.
    """
    shown, earlier, lamps = -1, None, False
    for player in tools.since_key():
        if shown < 0:
            shown = shown_by_key(player)
            continue
        lamps = lamps or (player.delta is not None and player.delta.light is not None)
        if player.delta is None or player.delta.is_light_at_most:
            earlier = None
        else:
            earlier, shown, lamps = None if lamps else shown, player.frame, False
    if earlier is None or not looks_back(assembly):
        return None
    return packed_frame(tools.recorded(earlier))


def refinement_after(assembly: Assembly, state: StreamState, tools: Tools) -> Refinement | None:
    """Return the refinement of frame 0 at the end of the stream, recomputed from packets and images since its key."""
    if not is_to_be_refined(assembly.recipe.stream, state.player):
        return None
    found: Refinement | None = None
    before, exposure = state.player, exposure_from_meta(state.player.meta)
    for player in tools.since_key():
        if found is None:
            found = start_refinement(player)
        else:
            frame = tools.recorded(player.frame)
            found = advance_refinement(
                assembly, found, before, after=player, frame=frame, exposure=exposure, rng=tools.rng
            )
        before = player
    return found


def key_state_from_player(assembly: Assembly, player: PlayerState, rng: Rng) -> StreamState:
    """Return the encoder state right after a key packet, from what was decoded (``previous`` is not set)."""
    gaussians = player.gaussians.map(torch.from_numpy)
    decoders = assembly.update.init_decoders(gaussians, rng.stream("decoders", player.frame))
    return StreamState(
        player=player,
        hierarchy=rebuild_hierarchy(assembly, player),
        previous=None,  # type: ignore[arg-type]
        decoders=decoders,
        exposure=exposure_from_meta(player.meta),
        gains=gains_from_meta(player.meta),
        key_frame=player.frame,
        shell=shell_behind(assembly, player),
        motion_memory=memory_across_key(assembly, player),
    )


def rebuild_hierarchy(assembly: Assembly, player: PlayerState) -> Hierarchy:
    """Return the hierarchy that the encoder built: the structure sees the same bits, so it gives the same forest."""
    return assembly.structure.build(player.gaussians.map(torch.from_numpy), decoded_anchors(player))


def _check_recipe(assembly: Assembly, meta: StreamMeta) -> None:
    old, new = dict(meta.recipe), without_places(assembly.recipe.model_dump(mode="json"))
    changed = sorted(
        key for key in new if key != "frames" and _deciding_keys(key, old.get(key)) != _deciding_keys(key, new[key])
    )
    if changed:
        raise OutputError(
            f"the stream was written with another recipe: {', '.join(changed)} differ; resume with the same recipe "
            "(recipe.yaml beside the stream) or start again with --overwrite"
        )


def _deciding_keys(section: str, values: Any) -> Any:
    """Return a section of a recipe without the keys that only decide where a run ends: they change no packet.

    So may the number of frames, which grows, and what is done about pictures that cannot be read and parts that fail.
    """
    left_out = ENDING.get(section, ())
    return {k: v for k, v in values.items() if k not in left_out} if isinstance(values, dict) else values


def _check_recording(info: SourceInfo, meta: StreamMeta) -> None:
    """Raise OutputError for another recording, and for the same one in another place."""
    pairs = (("training", info.train, meta.train), ("test", info.test, meta.test))
    for split, new, old in pairs:
        if new.ids != old.ids or (new.width, new.height) != (old.width, old.height) or not np.allclose(new.Ks, old.Ks):
            raise _another_recording(info, meta, split)
    if not meta.world.is_near(info.world):
        raise OutputError(
            f"the stream lies in other coordinates than {info.name!r} ({info.uri}): the recording was moved since, or "
            "an earlier version wrote the stream in the coordinates of the files; start again with --overwrite"
        )
    for split, new, old in pairs:
        if not np.allclose(new.viewmats, old.viewmats, atol=1e-6):
            raise _another_recording(info, meta, split)


def _another_recording(info: SourceInfo, meta: StreamMeta, split: str) -> OutputError:
    return OutputError(
        f"the stream was made from the recording {meta.source!r} ({meta.extra.get('source_uri', 'unknown')}), "
        f"whose {split} cameras are not those of {info.name!r} ({info.uri}); resume with the same --source"
    )
