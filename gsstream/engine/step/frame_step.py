"""One later frame of a method made of parts, top to bottom: (StreamState, Frame) -> Step.

light, what changed -> motion -> confidence, gates -> optimise -> growth -> code -> decode own packet -> next state
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch

from gsstream.core.changes import Delta, Scene, apply_delta, sent_rows
from gsstream.core.deferred import deferred_checks
from gsstream.core.frame import Frame
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.log import FrameLog
from gsstream.core.picture_size import far_weight
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.budget.epoch_scheduler import EpochScheduler
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.drift import EVERY
from gsstream.engine.state.stream_state import Resident, Step, StreamState, next_state, updated
from gsstream.engine.step.compared import find_change, shown_after
from gsstream.engine.step.context import EngineContext
from gsstream.engine.step.lamp import with_lamp
from gsstream.engine.step.light import Sent, look, relit
from gsstream.engine.step.metrics import step_numbers
from gsstream.engine.step.motion import propose_motion
from gsstream.engine.step.optimise import optimise
from gsstream.engine.step.problem import Problem
from gsstream.engine.step.quantise import encode_frame, quantise_residual
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState, decode_packet, encode_empty
from gsstream.parts.growth.none import NoGrowth
from gsstream.parts.render.session import RenderSession
from gsstream.parts.update.base import Scope, scale_steps


def frame_step(assembly: Assembly, state: StreamState, frame: Frame, tools: Tools) -> Step:
    """Advance the stream by one frame. Pure: a failure leaves ``state`` as it was.

    Raises ComponentError when a part fails.
    """
    log, rng, scope = tools.log, tools.rng, assembly.update.scope(frame.index)
    budget = tools.budget if state.refinement is None else tools.budget.at_most(assembly.recipe.stream.epochs)
    if frame.epoch_scale == 0:  # a skipped frame: a source that is behind does not read its images
        return empty_step(state, frame, log)
    with log.phase("change"):
        images, most = FrameImages(frame.images, assembly.renderer.device), budget.max_bytes
        had, (assembly, state, light) = state.player, with_lamp(assembly, state, frame, most, log)
        state = replace(state, pictures=state.pictures_on(images.device))
        found = find_change(assembly.renderer, state, images, threshold=budget.change_threshold)
        state, due = (state, False) if state.lit and frame.index % EVERY else look(assembly, state, frame, images, log)
    share = 1.0 if found.change is None else found.change.share
    if share == 0 and scope is not Scope.ALL and not due and light is None:
        return empty_step(state, frame, log)
    with log.phase("motion"), deferred_checks(assembly.checks is not Checks.STEP):
        motions, scene, work = propose_motion(assembly, state, frame, found=found, tools=tools, images=images)
    with log.phase("confidence"), deferred_checks(assembly.checks is not Checks.STEP):
        rows, logits = select(assembly, work, work.hierarchy, scope)
    with log.phase("optimise"):
        schedule = EpochScheduler(budget, len(frame.cameras), len(rows), frame.epoch_scale)
        problem = Problem(
            layout=scene.layout,
            hierarchy=work.hierarchy,
            rows=rows,
            base=work.gaussians.rows(rows),
            logits=logits,
            decoders=state.decoders,
            session=work.session_for(rows),
            # The larger the picture, the less tiles away from every change weigh (docs/results/extremes.md).
            target=partial(
                (work.everywhere() if scope is Scope.ALL else work).changed_target, far=far_weight(frame.cameras.width)
            ),
            cameras=frame.cameras,
            generator=rng.stream("frame", frame.index),
            codes=scale_steps(assembly.update.codes(), budget.step_scale),
        )
        solution = optimise(assembly, problem, schedule)
        residual = quantise_residual(assembly, problem, solution)
    with log.phase("growth"):
        delta = with_growth(assembly, state, Delta(motions).with_residual(residual), work=work, rng=rng)
    with log.phase("code"):
        trim, delta = assembly.recipe.codec.trim, delta.with_light(light)
        fitted = encode_frame(delta, had, frame.index, solution=solution, trim=trim, max_bytes=most)
        sent = Sent(fitted.delta, fitted.packet, decode_packet(had, fitted.packet.data), state.lit)
    if due:
        with log.phase("optimise/light"):
            sent = relit(assembly, replace(state, player=had), work, sent, max_bytes=most)
    with log.phase("keep"):
        session, resident = keep(work, scene, sent.delta, sent.player)
        shown = shown_after(assembly, state, frame, sent.delta, images)
        kept = replace(shown, session=session, resident=resident, lit=sent.lit)
        after = next_state(assembly.motion, kept, sent.player, rng)
    log.set(changed_tiles=share, **step_numbers(solution, len(rows), session))
    if (schedule.timed or schedule.sized) and (len(rows) or scope is Scope.NONE):
        log.set(budget=schedule.usage(fitted))
    return Step(after, replace(sent.packet, decoded=sent.player), "empty" if sent.delta.is_empty else "delta")


def empty_step(state: StreamState, frame: Frame, log: FrameLog) -> Step:
    """Return the step of a frame in which no tile of any view changed, or that is skipped: an empty packet."""
    with log.phase("code"):
        packet = encode_empty(frame=frame.index)
        player = decode_packet(state.player, packet.data)
    # No part and no renderer is called here, because this step is also made after a part has failed.
    log.set(changed_tiles=0.0, **step_numbers(None, 0, None))
    return Step(replace(state.settled, player=player), replace(packet, decoded=player), "empty")


def with_growth(assembly: Assembly, state: StreamState, delta: Delta, work: EngineContext, rng: Rng) -> Delta:
    """Return the delta with the rows that leave, of which those of the shell stay, and those that join.

    Raises ComponentError when the part fails, or proposes what does not fit the scene.
    """
    if isinstance(assembly.part("growth"), NoGrowth):
        return delta  # the scene after the residual is not needed
    after = apply_delta(state.player.scene, delta)
    rows = assembly.growth.propose(after, work, rng)
    with assembly.use("growth").errors():
        if rows is not None:
            apply_delta(after, Delta((rows,)))  # before rows are left out: a wrong proposal gets an error
            rows = replace(rows, removed=rows.removed[~work.shell_rows.cpu().numpy()[rows.removed]])
    return delta.with_row_edit(rows)


#: Least share of the views a Gaussian projects into in which it must lie in or beside changed tiles. The vote keeps
#: many cameras from making everything a candidate: a wall is behind a moving person in some view, but only what moves
#: lies in changed tiles in most of them (the idea of a visual hull).
CHANGE_VOTES = 0.75
#: The same for both ends of its longest axis: three quarters for them, too, would keep out what is large and moves.
REACH_VOTES = 0.25


class Selected(NamedTuple):
    """Rows [A] int64, ascending, that take part, and logits [M] of the gates."""

    rows: torch.Tensor
    logits: torch.Tensor


def candidates(
    changed: torch.Tensor, open_probability: torch.Tensor, hierarchy: Hierarchy, threshold: float
) -> torch.Tensor:
    """Return the rows [A] int64, ascending, that changed and whose gate may open."""
    return ((open_probability > threshold)[hierarchy.node_of] & changed).nonzero()[:, 0]


def select(assembly: Assembly, work: EngineContext, hierarchy: Hierarchy, scope: Scope) -> Selected:
    """Return what confidence, propagation and gate choose; none of them is called in a frame without a residual.

    A Gaussian takes part when it is seen in a changed tile of some training view, when its centre and both ends of its
    longest axis lie in or beside changed tiles in enough of the views that they project into, and when its gate may
    open. One that reaches beyond what changed stays, since it is seen where nothing changed. Everything else is frozen:
    neither projected nor optimised nor sent.
    """
    if scope is Scope.NONE:
        nothing = work.gaussians.means.new_zeros(0, dtype=torch.int64)
        return Selected(nothing, work.gaussians.means.new_zeros(hierarchy.num_nodes))
    seen = work.everywhere() if scope is Scope.ALL else work
    logits = assembly.gate.init(assembly.propagation.propagate(assembly.confidence.estimate(seen), hierarchy))
    able, threshold = seen.changed_rows(CHANGE_VOTES, REACH_VOTES), assembly.recipe.stream.active_threshold
    return Selected(candidates(able, assembly.gate.open_probability(logits), hierarchy, threshold), logits)


#: Largest share of changed rows at which the renderer's cache of the other rows saves time.
MOST_CHANGED = 0.5


def keep(
    work: EngineContext, scene: Scene, delta: Delta, player: PlayerState
) -> tuple[RenderSession | None, Resident | None]:
    """Return the session of the decoded scene, with what did not change still projected, and the scene on its device.

    Nothing where keeping costs more than it saves: rows came or went, or most of them changed. On a processor the scene
    is the player's own.
    """
    # Where a delta is empty though something moved, not even the motions were sent.
    if delta.has_row_edit or (delta.is_light_at_most and scene.gaussians is not player.gaussians):
        return None, None
    rows = sent_rows(scene.layout, delta.gates(scene.layout))
    if len(rows) > MOST_CHANGED * len(player.gaussians):
        return None, None
    gaussians = updated(work.gaussians, player.gaussians, rows)
    session = work.session.commit(gaussians, torch.from_numpy(rows).to(gaussians.means.device))
    if work.images.device.type == "cpu":
        return session, None
    return session, Resident(gaussians, work.hierarchy)
