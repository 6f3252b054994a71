"""A first frame that was made in few iterations goes on being optimised while later frames run (stream.refine_frames).

The fit is that of frame 0, from the first key packet on: densification, pruning and falling rates over all of its
iterations, some in every frame, each on the pictures of that frame. Motions of the stream are applied here, too: a
Gaussian that was split or copied from another one moves with that one. Nothing of it is sent before the last iteration:
then a key packet brings the scene (``engine.keys.keyframes``). So a frame's iterations follow its packet, which does
not wait for them; those of the last frame precede it, because that packet brings what they make.

A recording that is still being written does not wait either: a frame behind which another one waits makes no
iteration, and the frames after it make fewer, so that the refinement takes the time that the stream leaves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.changes import Scene, apply_light
from gsstream.core.changes.rows import gather_rows
from gsstream.core.frame import Frame
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.densify import DensifyStatistics
from gsstream.engine.frame0.axes import quat_conjugate
from gsstream.engine.frame0.optimise import CPU, FirstFrameRun
from gsstream.engine.frame0.pyramid import one_size
from gsstream.engine.state.colour_maps import exposure_from_meta
from gsstream.engine.state.stream_state import Refinement, Step, StreamState
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState
from gsstream.parts.render.activations import quat_multiply_torch, rotation_matrices
from gsstream.parts.render.exposure import Exposure
from gsstream.recipe.model import Recipe, Stream

#: Entry of the meta of every key packet but a stream's first: the frame whose pictures its scene shows.
SHOWN = "shown"
#: Iterations that the first frame of a recording that is still being written makes: how many it has time for is not
#: known yet.
FIRST_PACE = 8


def refine_after_packet(assembly: Assembly, state: StreamState, step: Step, frame: Frame, tools: Tools) -> Step:
    """Return a step whose packet is out with the refinement after its frame, unless iterations preceded the packet."""
    state, stream = with_time_for_keys(assembly.recipe, state, frame), assembly.recipe.stream
    if state.refinement is None or not runs_after_packet(stream, state.refinement, frame):
        return step
    return refine_first_frame(assembly, state, step, frame=frame, tools=tools)


def refine_first_frame(assembly: Assembly, state: StreamState, step: Step, frame: Frame, tools: Tools) -> Step:
    """Return a step whose state has the refinement after this frame.

    ``state`` is that before the frame, of a stream whose first frame is being refined. A frame that is skipped only
    moves what is refined.
    """
    with tools.log.phase("refine"):
        after, before = step.state, state.refinement
        assert before is not None
        # Of cameras as they were at first, whatever they have drifted in so few frames: a resumed run makes it again.
        exposure = exposure_from_meta(state.player.meta)
        found = advance_refinement(
            assembly, before, state.player, after=after.player, frame=frame, exposure=exposure, rng=tools.rng
        )
    tools.log.set(refine_iterations=found.iterations - before.iterations)
    return replace(step, state=replace(after, refinement=found))


def runs_after_packet(stream: Stream, refinement: Refinement, frame: Frame) -> bool:
    """Return whether a frame's iterations of the refinement may follow its packet: the last ones of all may not."""
    return refinement.iterations + iterations_in(stream, refinement, frame) < _iterations(stream)


def iterations_in(stream: Stream, refinement: Refinement, frame: Frame) -> int:
    """Return how many iterations a frame makes."""
    if frame.epoch_scale == 0:
        return 0
    most = min(stream.refine_iterations, _iterations(stream) - refinement.iterations)
    if frame.arrival is None:
        return most
    return 0 if frame.arrival.waiting else min(most, refinement.pace)


def pace_after(stream: Stream, pace: int, frame: Frame) -> int:
    """Return how many iterations the next frame may make: a quarter more, or half where this one was behind."""
    if frame.arrival is None:
        return pace
    if frame.epoch_scale == 0 or frame.arrival.waiting:
        return max(1, pace // 2)
    return min(stream.refine_iterations, pace + max(1, pace // 4))


def with_time_for_keys(recipe: Recipe, state: StreamState, frame: Frame) -> StreamState:
    """Return the state that a frame goes on from, without a refinement that kept back too many key packets.

    Later key packets wait for the end of a refinement, but not for good: where the machine leaves it no time, the
    second of them ends it, so that players can join.
    """
    every, stream, before = recipe.codec.key_interval, recipe.stream, state.refinement
    if before is None or not every or is_refined(stream, before):
        return state
    late = frame.index - state.key_frame >= 2 * max(every, stream.refine_frames)
    return replace(state, refinement=None) if late else state


def shown_by_key(player: PlayerState) -> int:
    """Return the frame whose pictures the scene of a key packet shows: it may stand for an older one, and says so."""
    return int(player.meta.extra.get(SHOWN, player.frame))


def is_to_be_refined(stream: Stream, player: PlayerState) -> bool:
    """Say whether the scene of the last key packet is to be refined: that of the first frame, where the recipe asks."""
    return stream.refine_frames > 0 and SHOWN not in player.meta.extra


def is_refined(stream: Stream, refinement: Refinement) -> bool:
    """Say whether all iterations are made."""
    return refinement.iterations >= _iterations(stream)


def _iterations(stream: Stream) -> int:
    """All iterations of the refinement."""
    return stream.refine_frames * stream.refine_iterations


def start_refinement(player: PlayerState) -> Refinement:
    """Return the refinement of a first frame, before its first iteration."""
    gaussians = player.gaussians.map(torch.from_numpy)
    count = len(gaussians)
    levels = torch.from_numpy(player.layout.unit_of.astype(np.int64))
    return Refinement(
        gaussians=gaussians,
        levels=levels,
        ancestors=torch.arange(count),
        moments={},
        statistics=DensifyStatistics.zeros(count, CPU),
        iterations=0,
        pace=FIRST_PACE,
    )


def advance_refinement(
    assembly: Assembly,
    refinement: Refinement,
    before: PlayerState,
    after: PlayerState,
    frame: Frame,
    exposure: Exposure | None,
    rng: Rng,
) -> Refinement:
    """Return the refinement after a frame: moved as the stream moved, and optimised on the frame's pictures."""
    stream = assembly.recipe.stream
    last = refinement.iterations + iterations_in(stream, refinement, frame)
    start = replace(
        track_motion(_in_light(refinement, after), before, after), pace=pace_after(stream, refinement.pace, frame)
    )
    if last == start.iterations:
        return start
    generator, assembly = rng.stream("refine", frame.index), replace(assembly, background=after.meta.background)
    pyramid = one_size(_iterations(stream), assembly.recipe.first_frame)
    run = FirstFrameRun(
        start=start.gaussians, levels=start.levels, frame=frame, assembly=assembly, generator=generator, pyramid=pyramid
    )
    run.photometric.exposure = None if exposure is None else exposure.to(run.device)
    run.statistics = start.statistics.to(run.device)
    for name, held in start.moments.items():
        run.table.load_moments(name, held)
    for _ in run.passes(start.iterations + 1, last):
        pass
    moments = {name: {key: value.to(CPU) for key, value in run.table.moments(name).items()} for name in ATTRIBUTES}
    found = run.gaussians().map(lambda value: value.detach().to(CPU))
    ancestors = start.ancestors[run.ancestors.to(CPU)]
    return replace(
        start,
        gaussians=found,
        levels=run.levels.to(CPU),
        ancestors=ancestors,
        moments=moments,
        statistics=run.statistics.to(CPU),
        iterations=last,
    )


def _in_light(refinement: Refinement, after: PlayerState) -> Refinement:
    """The refinement in the light of a frame in which a lamp was switched."""
    if after.delta is None or after.delta.light is None:
        return refinement
    scene = Scene(refinement.gaussians.map(lambda value: value.numpy()), after.layout)
    return replace(refinement, gaussians=apply_light(scene, after.delta.light).gaussians.map(torch.from_numpy))


def track_motion(refinement: Refinement, before: PlayerState, after: PlayerState) -> Refinement:
    """Return the refinement with every Gaussian moved and turned as the one it came from was."""
    row_now = _current_rows(before, after)
    ancestors = refinement.ancestors
    alive = ancestors >= 0
    now = torch.where(alive, row_now[ancestors.clamp_min(0)], -1)
    kept = now >= 0
    was, new = _poses(before.gaussians), _poses(after.gaussians)
    moved = torch.zeros_like(kept)
    for old_table, new_table in zip(was, new, strict=True):
        moved[kept] |= (old_table[ancestors[kept]] != new_table[now[kept]]).any(1)
    rows = moved.nonzero()[:, 0]
    if len(rows) == 0:
        return replace(refinement, ancestors=now)
    old, there = ancestors[rows], now[rows]
    rotation = rotation_matrices(new[1][there]) @ rotation_matrices(was[1][old]).transpose(1, 2)
    g = refinement.gaussians
    means, quats = g.means.clone(), g.quats.clone()
    offset = (rotation @ (g.means[rows] - was[0][old])[..., None])[..., 0]
    means[rows] = new[0][there] + offset
    quats[rows] = quat_multiply_torch(quat_multiply_torch(new[1][there], quat_conjugate(was[1][old])), g.quats[rows])
    return replace(refinement, gaussians=replace(g, means=means, quats=quats), ancestors=now)


def _poses(gaussians: Gaussians[FloatArray]) -> tuple[torch.Tensor, torch.Tensor]:
    quats = torch.from_numpy(gaussians.quats)
    return torch.from_numpy(gaussians.means), quats / quats.norm(dim=1, keepdim=True).clamp_min(1e-12)


def _current_rows(before: PlayerState, after: PlayerState) -> torch.Tensor:
    """[N] int64: where each row of the players' scene is after a frame; -1 for one that has left."""
    count = len(before.gaussians)
    delta = after.delta
    if delta is None or not delta.has_row_edit:
        return torch.arange(count)
    source = gather_rows(before.layout.node_of, delta.added, delta.removed)
    out = torch.full((count,), -1)
    old = torch.from_numpy(source) < count
    out[torch.from_numpy(source)[old]] = old.nonzero()[:, 0]
    return out
