"""Frame 0: points -> anchors -> optimised Gaussians -> key packet -> the state every later frame starts from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Layout
from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.first_layer import first_layer_mask
from gsstream.engine.frame0.optimise import initial_gaussians, optimise_first_frame, sort_by_node
from gsstream.engine.frame0.rd_quantise import rd_quantise
from gsstream.engine.frame0.shell import with_shell
from gsstream.engine.state.colour_maps import GAINS, exposure_from_meta, exposure_to_meta, gains_from_meta
from gsstream.engine.state.stream_state import Step, StreamState
from gsstream.input.seeds.shell import Shell, find_shell
from gsstream.input.seeds.thinning import thin_points
from gsstream.method.tools import Tools
from gsstream.packet import EncodedPacket, KeyState, PlayerState, StreamMeta, decode_packet, encode_key, quantise_key
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.structure.base import Anchors

#: What key packets say of the scene itself, which later ones say, too: colour maps of the cameras, origin of its grid.
CARRIED = ("exposure", "origin")


def begin(assembly: Assembly, frame: Frame, tools: Tools) -> Step:
    """Reconstruct frame 0 and write it as a key packet.

    Its seeds (``tools.points``) are never derived from test cameras; the fitted exposure is added to ``tools.meta``.
    """
    check_cameras(frame.cameras, 1, "a frame")
    log, rng = tools.log, tools.rng
    with log.phase("seed"):
        anchors = seed_anchors(assembly, tools.points(frame), frame)
    with log.phase("optimise"):
        start, levels = initial_gaussians(anchors, assembly.recipe.first_frame), anchors.levels
        if assembly.recipe.first_frame.shell:
            start, levels = with_shell(start, levels, frame)
        found = optimise_first_frame(start, levels, frame, assembly=assembly, rng=rng, progress=tools.progress)
    with log.phase("code"):
        # Positions are float32 in the packet too, so the hierarchy of the decoded scene is the one built here.
        cheaper = rd_quantise(assembly, found.gaussians, frame, exposure=found.exposure, rng=rng)
        decoded = quantise_key(cheaper.map(lambda t: t.numpy())).map(torch.from_numpy)
        hierarchy, levels, decoded = sort_into_nodes(assembly, decoded, found.levels, anchors)
        layout = make_layout(hierarchy, levels, anchors)
        first = first_layer_mask(assembly, decoded, frame, exposure=found.exposure, rng=rng)
        meta = key_meta(tools.meta(frame), found.exposure, anchors.origin)
        state, packet = key_state(
            assembly, decoded, layout, hierarchy=hierarchy, frame=frame, meta=meta, rng=rng, first=first
        )
    log.set(iterations=found.iterations)
    return Step(state, packet, "key")


def seed_anchors(assembly: Assembly, points: PointCloud, frame: Frame) -> Anchors:
    """Return anchors, at most as many as frame 0 may have Gaussians.

    A structure places one or more for each point, so where there are too many it is given fewer points.
    """
    most = assembly.recipe.first_frame.max_gaussians
    while True:
        anchors = assembly.structure.seed(points, frame.cameras)
        if len(anchors.positions) <= most or len(points) == 1:
            return anchors
        points = thin_points(points, max(1, int(0.95 * len(points) * most / len(anchors.positions))))


def check_cameras(cameras: Cameras, least: int, who: str) -> None:
    """Raise InputError when there are fewer training cameras than somebody needs."""
    if len(cameras) < least:
        raise InputError(
            f"{who} needs at least {least} training camera{'s'[: least != 1]}, got {len(cameras)}; record with "
            "more, or choose another method"
        )


def decoded_anchors(player: PlayerState) -> Anchors:
    """Return the anchors that a structure needs to group a decoded scene again."""
    gaussians, origin = player.gaussians.map(torch.from_numpy), player.meta.extra.get("origin")
    if origin is None:
        raise InputError(
            "the stream does not say where the grid of its Gaussians begins (extra.origin of its key packet): it was "
            "not written by this encoder, which can neither go on with it nor take its scene over; encode the "
            "recording anew"
        )
    return Anchors(
        positions=gaussians.means,
        colors=torch.zeros_like(gaussians.means),
        levels=torch.from_numpy(player.layout.unit_of.astype(np.int64)),
        cell_sizes=torch.from_numpy(np.asarray(player.layout.units)),
        origin=torch.tensor(origin, dtype=torch.float32),
    )


def sort_into_nodes(
    assembly: Assembly, gaussians: Gaussians[torch.Tensor], levels: torch.Tensor, anchors: Anchors
) -> tuple[Hierarchy, torch.Tensor, Gaussians[torch.Tensor]]:
    """Group the Gaussians and store them node by node: (hierarchy, levels, Gaussians), all in the new order."""
    hierarchy = assembly.structure.build(gaussians, anchors)
    with assembly.use("structure").errors():
        hierarchy.validate()
    edit = sort_by_node(hierarchy.node_of)
    return hierarchy.rows(edit.source), levels[edit.source], gaussians.rows(edit.source)


def make_layout(hierarchy: Hierarchy, levels: torch.Tensor, anchors: Anchors) -> Layout:
    """Return the layout that encoder and player have until the next key packet."""
    counts = torch.bincount(hierarchy.node_of, minlength=hierarchy.num_nodes)
    return Layout(
        node_counts=counts.numpy().astype(np.int32),
        unit_of=levels.numpy().astype(np.uint8),
        units=anchors.cell_sizes.numpy().astype(np.float32),
    )


def key_state(
    assembly: Assembly,
    gaussians: Gaussians[torch.Tensor],
    layout: Layout,
    hierarchy: Hierarchy,
    frame: Frame,
    meta: StreamMeta,
    rng: Rng,
    first: BoolArray | None = None,
    before: PlayerState | None = None,
) -> tuple[StreamState, EncodedPacket]:
    """Encode a key packet and continue from its decoded bytes.

    Arguments:
        meta: result of :func:`key_meta`.
        before: what players have after the frame before; None for the first frame.
    """
    arrays: Gaussians[FloatArray] = gaussians.map(lambda t: np.ascontiguousarray(t.numpy()))
    packet = encode_key(KeyState(arrays, layout, meta), frame=frame.index, first=first)
    player = decode_packet(before, packet.data)
    decoders = assembly.update.init_decoders(gaussians, rng.stream("decoders", frame.index))
    state = StreamState(
        player=player,
        hierarchy=hierarchy,
        previous=frame,
        decoders=decoders,
        exposure=exposure_from_meta(player.meta),
        gains=gains_from_meta(player.meta),
        key_frame=player.frame,
        shell=shell_behind(assembly, player),
        motion_memory=memory_across_key(assembly, player),
    )
    return state, replace(packet, decoded=player)


def memory_across_key(assembly: Assembly, player: PlayerState) -> Any:
    """Return what the motion part keeps of the frames before a key packet; None where the stream begins with that."""
    if player.replaced is None:
        return None
    with assembly.use("motion").errors():
        return assembly.motion.across_key(player.replaced, player.scene)


def shell_behind(assembly: Assembly, player: PlayerState) -> Shell | None:
    """Return the sphere behind the scene of a stream; None where the recipe has none."""
    return find_shell(player.meta.train) if assembly.recipe.first_frame.shell else None


def key_meta(
    meta: StreamMeta, exposure: Exposure | None, origin: torch.Tensor, gains: FloatArray | None = None
) -> StreamMeta:
    """Return the description of the run in a key packet, with colour maps of frame 0, gains and the grid's origin."""
    own = {**exposure_to_meta(exposure), "origin": origin.tolist()}
    if gains is not None:
        own[GAINS] = gains.tolist()
    others = {name: value for name, value in meta.extra.items() if name not in own}
    return replace(meta, extra={**others, **own})
