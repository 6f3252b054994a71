"""The light is followed: colours of what stands still are compared with the images, and change in closed form.

From one frame to the next the light of a room changes by less than the noise of its cameras: no tile counts as changed,
no Gaussian of a wall takes part, and those that do take part grow over the walls to make up for it. When enough has
added up (:mod:`gsstream.engine.state.drift`), every Gaussian whose gate stayed closed gets the colour change that its
pixels ask for: one step of Jacobi on the squared error, in which a row's diagonal is the light it gives to all pixels,
so that what changes smoothly is met in one step. All change along one colour, sent as one latent more of sh0 with a row
of its own in the decoder, which the next residual is without.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.changes import Delta
from gsstream.core.frame import Frame
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.log import FrameLog
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import packed
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.frame0.refine import shown_by_key
from gsstream.engine.state.drift import EVERY, Lit, drift, looked_at
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.engine.step.gains import camera_offsets, drawn_by_row, new_gains
from gsstream.engine.step.lamp import lit_player
from gsstream.engine.step.light_symbols import with_light
from gsstream.method.packets import delta_packet
from gsstream.method.tools import Tools
from gsstream.packet import EncodedPacket, PlayerState, decode_packet

#: Error of a pixel from which it shows something else than the light, image units.
MOST_ERROR = 0.1
#: Least pixels' worth of light that a row must give to be asked.
LEAST_LIGHT = 4.0
#: Squared error that a bit must save, in mean squared errors of one channel of a pixel, and the factors on it that are
#: tried where a packet must fit into a budget.
PRICE, DEARER = 20.0, (1, 4, 16, 64)


def follows_light(assembly: Assembly) -> bool:
    """Say whether the recipe asks for it and the update rule has latents of colour, as one of which it is sent."""
    code = assembly.update.codes().get("sh0")
    return assembly.recipe.stream.light > 0 and code is not None and code.latent > 0


def look(
    assembly: Assembly, state: StreamState, frame: Frame, images: FrameImages, log: FrameLog
) -> tuple[StreamState, bool]:
    """Compare a frame with the one whose light the colours have: what is known then, and whether they are to follow it.

    It depends on what players had before the frame, on its pictures, and on what the last look said. Nothing is looked
    at where the recipe follows no light.
    """
    if not follows_light(assembly):
        return state, False
    # From where the pictures are: the device gets the pixels that are compared, and only when they are.
    lit = state.lit or looked_at(
        state.previous.index, FrameImages(state.previous.images, torch.device("cpu")), state.gains
    )
    if frame.index % EVERY:
        return replace(state, lit=lit), False
    now = looked_at(frame.index, images, state.gains)
    found = drift(lit, now, assembly.recipe.stream.light)
    # Before the colours follow the light, and the next frames are compared with this one, all cameras are asked.
    if apart := range(len(frame.cameras)) if found.is_due else found.apart:
        scene = state.gaussians.map(lambda value: value.to(images.device))
        gains = new_gains(assembly, scene, frame.cameras, before=lit, now=now, apart=apart)
        if gains is not None and gains is not state.gains:
            log.set(camera_drift=np.round(100 * (gains.astype(np.float64) - 1), 2).tolist())
            state = state.with_gains(gains)
    return replace(state, lit=found.lit), found.is_due


def looked_after(assembly: Assembly, state: StreamState, players: Iterable[PlayerState], tools: Tools) -> StreamState:
    """Return the state at the end of a stream that is resumed, with what looks since its last key packet have come to.

    The packets say when the colours followed the light; the frames that were looked at are read and compared again.

    Arguments:
        players: their states since the last key packet.
    """
    if not follows_light(assembly):
        return state
    found, before = state, None
    for player in players:
        if before is None:
            shown = shown_by_key(player)
            images = FrameImages(packed(tools.recorded(shown).images), assembly.renderer.device)
            found = replace(found, lit=looked_at(shown, images, found.gains))
            before = player
            continue
        if found.lit is not None and player.delta is not None and player.delta.light is not None:
            lamp = player.delta.light
            found, before = replace(found, lit=found.lit.in_light(lamp.factor)), lit_player(before, lamp)
        if player.frame % EVERY == 0:
            frame = tools.recorded(player.frame)
            if frame.epoch_scale:  # a frame that was skipped was not looked at
                images = FrameImages(frame.images, assembly.renderer.device)
                there = replace(assembly, background=before.meta.background)
                found, _ = look(there, replace(found, player=before), frame, images, FrameLog())
                if _decoder_rows(player) > len(state.decoders["sh0"]):
                    found = replace(found, lit=looked_at(player.frame, images, found.gains))
        before = player
    return replace(found, player=state.player)


def _decoder_rows(player: PlayerState) -> int:
    """Rows of the decoder of sh0 in what a packet changes; 0 without."""
    residual = None if player.delta is None else player.delta.residual
    return 0 if residual is None else len(residual.decoders.get("sh0", ()))


class Sent(NamedTuple):
    """What a frame sends.

    Arguments:
        delta: what changes. packet: its packet. player: the state of every player after it.
        lit: the frame whose light the colours then have; None: none was looked at.
    """

    delta: Delta
    packet: EncodedPacket
    player: PlayerState
    lit: Lit | None


def relit(assembly: Assembly, state: StreamState, work: EngineContext, sent: Sent, max_bytes: int | None) -> Sent:
    """Return the frame with the colours of what has not changed brought up to the light of its images.

    A frame in which rows come or go stays as it is, and so does one whose packet would not fit.
    """
    if sent.delta.has_row_edit:
        return sent
    scene = sent.player.gaussians.map(lambda value: torch.from_numpy(value).to(work.gaussians.means.device))
    wanted = wanted_colours(assembly, scene, work)
    for factor in DEARER:
        delta = with_light(
            sent.delta,
            sent.player.layout,
            change=wanted.change,
            worth=wanted.worth,
            price=factor * PRICE * wanted.error,
            decoder=state.decoders["sh0"].cpu().numpy(),
            step=assembly.update.codes()["sh0"].step,
            levels=assembly.gate.num_levels,
        )
        packet = delta_packet(state.player, delta, frame=sent.player.frame)
        if max_bytes is None or len(packet.data) <= max_bytes:
            work.log.set(light_bytes=len(packet.data) - len(sent.packet.data))
            now = sent.lit if delta is sent.delta else looked_at(sent.player.frame, work.images, state.gains)
            return Sent(delta, packet, decode_packet(state.player, packet.data), now)
    return sent


@dataclass(frozen=True)
class Wanted:
    """What the images ask of the colours.

    Arguments:
        change: [N, 3] of sh0.
        worth: [N] squared error of one channel, summed over pixels, per square of a change.
        error: mean squared error of one channel of the pixels that were asked.
        cameras: [V, 3] what each camera shows beyond what most show, image units; no colour is to make up for it.
    """

    change: FloatArray
    worth: FloatArray
    error: float
    cameras: FloatArray


def wanted_colours(assembly: Assembly, scene: Gaussians[torch.Tensor], work: EngineContext) -> Wanted:
    """Render the scene in every training view, and return what its pixels ask of the colours."""
    asked, asked_by_view, light = torch.zeros(len(scene), 3), [], []
    errors = pixels = 0.0
    for view in range(len(work.cameras)):
        drawn, by_row = drawn_by_row(assembly, scene, work.cameras, view)
        exposure = work.photometric.exposure[view] if work.photometric.exposure else None
        error = work.image(view) - (exposure.apply(drawn) if exposure else drawn)
        slow = (error.abs().amax(-1, keepdim=True) < MOST_ERROR).float()
        error = error * slow
        asked_by_row = by_row(exposure.vjp(error) if exposure else error)
        asked += asked_by_row
        asked_by_view.append(asked_by_row.sum(0))
        light.append(by_row(slow.expand(-1, -1, 3))[:, 0])
        errors, pixels = errors + float(error.square().sum()) / 3, pixels + float(slow.sum())
    weights = torch.stack(light)
    total = weights.sum(0)
    cameras = camera_offsets(torch.stack(asked_by_view), asked, weights)
    left = asked - weights.T @ cameras
    change = torch.where(total[:, None] > LEAST_LIGHT, left / total.clamp_min(1e-6)[:, None] / SH0, 0.0)
    return Wanted(change.numpy(), (total * SH0**2).numpy(), errors / max(pixels, 1.0), cameras.numpy())
