"""Later key packets: when a frame becomes one, and what it holds. Ours.

A key packet takes the place of the frame's delta packet: it holds the scene after the frame's optimisation, put on the
grids of a key packet and grouped anew, and the encoder goes on from it as any player does.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import arrange, decoded_anchors, key_state, make_layout
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.metrics import psnr
from gsstream.packet import StreamMeta, quantise_key


def refresh(
    parts: Assembly, step: Step, frame: Frame, meta: Callable[[Cameras], StreamMeta], rng: Rng,
    refusal: Callable[[int], str | None] = lambda _: None, max_bytes: int | None = None,
) -> Step:  # fmt: skip
    """``step``, or when the recipe asks for a key packet at this frame, the step that writes one instead of it.

    Arguments:
        meta: what a key packet tells about the run.
        refusal: number of Gaussians -> why a key packet cannot be paid for, or None. max_bytes: the largest allowed.

    A key packet that is refused stays due: the next frame tries again. Pure, like a frame step.
    """
    if step.status == "key":
        return replace(step, state=with_key_quality(parts, step.state, frame))
    quality = training_psnr(parts, step.state, frame) if parts.recipe.codec.key_error_growth > 0 else None
    reason = key_reason(parts, step, quality)
    if reason is None:
        return step
    refused = refusal(len(step.state.gaussians))
    if refused is not None:
        return _postponed(step, reason, refused)
    started = time.perf_counter()
    state, after = step.state, decoded_again(parts, step.state, frame, meta(frame.cameras), rng)
    if max_bytes is not None and len(after.packet.data) > max_bytes:
        return _postponed(step, reason, f"{len(after.packet.data)} bytes where {max_bytes} are allowed")
    # The scene goes on showing what it showed: a key packet after still frames is no new picture.
    after = replace(after, state=replace(after.state, previous=state.previous))
    metrics = {**step.metrics, **after.metrics, "key_reason": reason}
    metrics["seconds"] = {**metrics["seconds"], "key": time.perf_counter() - started}
    return Step(with_key_quality(parts, after.state, frame), after.packet, "key", metrics)


def _postponed(step: Step, reason: str, refused: str) -> Step:
    return replace(step, metrics={**step.metrics, "key_postponed": f"{reason}: {refused}"})


def key_reason(parts: Assembly, step: Step, quality: float | None) -> str | None:
    """Why this frame is to be a key packet; None when it is not.

    Arguments:
        quality: PSNR of the decoded frame on the training views, when the recipe asks for it, dB.
    """
    codec, state = parts.recipe.codec, step.state
    if codec.key_every and state.player.frame - state.key_frame >= codec.key_every:
        return "period"
    share = step.metrics["active_gaussians"] / max(1, step.metrics["num_gaussians"])
    if 0 < codec.key_change <= share:
        return "change"
    if quality is not None and state.key_quality is not None:
        return "error" if state.key_quality - quality >= codec.key_error_growth else None
    return None


def decoded_again(parts: Assembly, state: StreamState, frame: Frame, meta: StreamMeta, rng: Rng) -> Step:
    """The current decoded scene as a key packet, and the state that follows from its bytes."""
    player = state.player
    gaussians = quantise_key(player.gaussians).map(torch.from_numpy)
    anchors = decoded_anchors(player)
    hierarchy, levels, gaussians = arrange(parts, gaussians, anchors.levels, anchors)
    layout = make_layout(hierarchy, levels, anchors)
    # A resumed run must compare the next frame with the picture this scene shows, which may be an older one.
    meta = replace(meta, extra={**meta.extra, "shown": state.previous.index})
    after, packet = key_state(
        parts, gaussians, layout, hierarchy, frame, meta, state.exposure, anchors.origin, rng
    )
    metrics = {"bytes": dict(packet.sizes), "num_gaussians": len(gaussians), "num_gates": len(layout.node_counts)}
    return Step(after, packet, "key", metrics)


def with_key_quality(parts: Assembly, state: StreamState, frame: Frame) -> StreamState:
    """The state after a key packet, with what its error will be compared to; ``frame`` is that packet's."""
    wanted = parts.recipe.codec.key_error_growth > 0
    return replace(state, key_quality=training_psnr(parts, state, frame) if wanted else None)


def training_psnr(parts: Assembly, state: StreamState, frame: Frame) -> float:
    """Mean PSNR of the decoded scene over the training views, dB, each seen through its camera's colour map."""
    values = []
    for view, truth in enumerate(frame.images):
        with torch.no_grad():
            image = parts.renderer.render(state.gaussians, frame.cameras, view, parts.recipe.background).image
        image = state.exposure.apply(view, image) if state.exposure else image
        values.append(psnr(np.clip(image.numpy(), 0, 1), truth))
    return float(np.mean(values))
