"""Later key packets: the frames that become key packets, and the contents of these packets.

A key packet takes the place of the frame's delta packet: it holds the scene after the frame's optimisation, put on the
grids of a key packet and grouped anew, and the encoder goes on from it as any player does.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from gsstream.core.frame import Frame, packed_frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import decoded_anchors, key_meta, key_state, make_layout, sort_into_nodes
from gsstream.engine.frame0.first_layer import first_layer_mask
from gsstream.engine.frame0.rd_quantise import rd_quantise
from gsstream.engine.frame0.refine import SHOWN, is_refined
from gsstream.engine.state.colour_maps import first_exposure
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.engine.step.metrics import log_packet
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState, StreamMeta, quantise_key

#: Why a frame became a key packet: the refined first frame is ready.
REFINED = "refined"
#: Share of the light of before below which no key packet is made: its grid would leave little of the colours, and the
#: encoder would forget what the room looks like in the light.
DARK = 1 / 8


def key_packet_if_due(assembly: Assembly, step: Step, frame: Frame, tools: Tools, before: PlayerState) -> Step:
    """Return ``step``, or when a key packet is due at this frame, the step that writes one instead.

    A key packet that the budget refuses, whose frame is skipped or that falls into the dark stays due: the next frame
    tries again. ``before``: what players have after the frame before.
    """
    reason, state = _due(assembly, step), step.state
    if reason is None:
        return step
    # A skipped frame stays an empty packet: it must not fail, and a key packet would take the time that skipping saves.
    if frame.epoch_scale == 0:
        refused: str | None = "the frame is skipped"
    elif state.lit is not None and min(state.lit.lamps) < DARK:
        refused = "the light is off"
    else:
        refused = tools.key_refusal(len(state.gaussians))
    if refused is not None:
        return _postponed(step, reason, refused, tools)
    if state.lamps:  # a key packet does not say in whose light an older picture is
        state = replace(state, previous=packed_frame(frame), lamps=())
    # A refined scene was fitted to the pictures of this frame; another may show older ones.
    assembly = replace(assembly, background=state.player.meta.background)  # a lamp may have been switched in this frame
    made, shown = (refined_key_step, frame) if reason == REFINED else (reencode_as_key, state.previous)
    with tools.log.phase("key"):
        after = made(assembly, state, frame, meta=tools.meta(frame), rng=tools.rng, before=before)
    max_bytes = tools.budget.max_bytes
    if max_bytes is not None and len(after.packet.data) > max_bytes:
        return _postponed(step, reason, f"{len(after.packet.data)} bytes where {max_bytes} are allowed", tools)
    log_packet(tools.log, state.player, step.packet)  # what changed in the frame: the key packet does not say it
    tools.log.set(key_reason=reason)
    return Step(replace(after.state, previous=shown), after.packet, "key")


def _due(assembly: Assembly, step: Step) -> str | None:
    """Why the frame is to become a key packet; None: it is not.

    It is not asked of frames whose iterations of a refinement follow their packets (``engine.run.parts_method``).
    """
    every, state = assembly.recipe.codec.key_interval, step.state
    if step.status == "key":
        return None
    if state.refinement is not None:  # a periodic one would end the refinement, and waits while that has time
        return REFINED if is_refined(assembly.recipe.stream, state.refinement) else None
    return "period" if every and state.player.frame - state.key_frame >= every else None


def _postponed(step: Step, reason: str, refused: str, tools: Tools) -> Step:
    tools.log.set(key_postponed=f"{reason}: {refused}")
    return step


def refined_key_step(
    assembly: Assembly, state: StreamState, frame: Frame, meta: StreamMeta, rng: Rng, before: PlayerState
) -> Step:
    """Return the refined first frame, as it is now, as a key packet, and the state that follows from its bytes."""
    found = state.refinement
    assert found is not None
    cheaper = rd_quantise(assembly, found.gaussians, frame, exposure=state.exposure, rng=rng)
    gaussians = quantise_key(cheaper.map(lambda t: t.numpy())).map(torch.from_numpy)
    return _key_step(
        assembly,
        state,
        gaussians,
        levels=found.levels,
        frame=frame,
        shown=frame.index,
        meta=meta,
        rng=rng,
        before=before,
        layered=True,
    )


def reencode_as_key(
    assembly: Assembly, state: StreamState, frame: Frame, meta: StreamMeta, rng: Rng, before: PlayerState
) -> Step:
    """Return the current decoded scene as a key packet, and the state that follows from its bytes."""
    gaussians = quantise_key(state.player.gaussians).map(torch.from_numpy)
    levels = decoded_anchors(state.player).levels
    return _key_step(
        assembly,
        state,
        gaussians,
        levels=levels,
        frame=frame,
        shown=state.previous.index,
        meta=meta,
        rng=rng,
        before=before,
    )


def _key_step(
    assembly: Assembly,
    state: StreamState,
    gaussians: Gaussians[torch.Tensor],
    levels: torch.Tensor,
    frame: Frame,
    shown: int,
    meta: StreamMeta,
    rng: Rng,
    before: PlayerState,
    *,
    layered: bool = False,
) -> Step:
    """Return the key packet of Gaussians of these levels, on the packet's grids, fitted to the pictures of ``shown``.

    A periodic one has no layers: a player that continues needs none, and to find them would cost the frame time.
    """
    anchors = decoded_anchors(state.player)
    hierarchy, levels, gaussians = sort_into_nodes(assembly, gaussians, levels, anchors)
    layout = make_layout(hierarchy, levels, anchors)
    # A resumed run must compare the next frame with the picture that this scene shows, which may be the picture of an
    # older frame.
    meta = replace(meta, extra={**meta.extra, SHOWN: shown}, background=assembly.background)
    first = first_layer_mask(assembly, gaussians, frame, exposure=state.exposure, rng=rng) if layered else None
    meta = key_meta(meta, first_exposure(state.player.meta), anchors.origin, state.gains)
    after, packet = key_state(
        assembly, gaussians, layout, hierarchy=hierarchy, frame=frame, meta=meta, rng=rng, first=first, before=before
    )
    return Step(after, packet, "key")
