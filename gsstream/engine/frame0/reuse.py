"""Frame 0 of another stream, taken over: the same scene, grouped by this method, so that methods can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, PointCloud
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import (
    decoded_anchors,
    key_meta,
    key_state,
    make_layout,
    sort_into_nodes,
)
from gsstream.engine.frame0.first_layer import first_layer_mask
from gsstream.engine.state.colour_maps import exposure_from_meta
from gsstream.engine.state.stream_state import Step
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState, StreamMeta, quantise_key
from gsstream.parts.structure.base import Anchors


def reuse_first_frame(assembly: Assembly, frame: Frame, tools: Tools) -> Step:
    """Start from the decoded frame 0 of another stream, grouped by this method.

    Methods can then be compared on the same scene.

    Raises InputError when the recipe asks for another degree of spherical harmonics than the stream has, when a camera
    that is a test camera here took part in it, or when its colour maps are of other cameras.
    """
    first, meta, rng = tools.first, tools.meta(frame), tools.rng
    assert first is not None
    _check_views(first.meta, frame.cameras, () if assembly.recipe.data.leak == "training" else meta.test.ids)
    if first.gaussians.sh_degree != assembly.recipe.first_frame.sh_degree:
        raise InputError(
            f"the first frame has spherical harmonics of degree {first.gaussians.sh_degree}, the recipe asks for "
            f"{assembly.recipe.first_frame.sh_degree}; set first_frame.sh_degree={first.gaussians.sh_degree}"
        )
    # A delta may have put Gaussians between the positions that a key packet can say. They are grouped as players will
    # have them, or a resumed run would find other groups.
    with tools.log.phase("code"):
        decoded = replace(first, scene=replace(first.scene, gaussians=quantise_key(first.gaussians)))
        gaussians = decoded.gaussians.map(torch.from_numpy)
        anchors = reused_anchors(assembly, decoded, frame)
        hierarchy, levels, gaussians = sort_into_nodes(assembly, gaussians, anchors.levels, anchors)
        layout = make_layout(hierarchy, levels, anchors)
        exposure = exposure_from_meta(first.meta)
        first_seen = first_layer_mask(assembly, gaussians, frame, exposure=exposure, rng=rng)
        meta = key_meta(meta, exposure, anchors.origin)
        state, packet = key_state(
            assembly, gaussians, layout, hierarchy=hierarchy, frame=frame, meta=meta, rng=rng, first=first_seen
        )
    tools.log.set(iterations=0)
    return Step(state, packet, "key")


def _check_views(theirs: StreamMeta, cameras: Cameras, held_out: tuple[str, ...]) -> None:
    """Refuse a frame 0 that was trained on cameras held out here, or whose colour maps are of other cameras."""
    if seen := [name for name in held_out if name in theirs.train.ids]:
        raise InputError(
            f"the first frame was reconstructed with {', '.join(seen)}, test cameras here; take one of a run with "
            "the same data.split and data.test_cameras"
        )
    if exposure_from_meta(theirs) is not None and theirs.train.ids != cameras.ids:
        raise InputError(
            f"the first frame has colour maps of the training cameras {', '.join(theirs.train.ids)}, got "
            f"{', '.join(cameras.ids)}; take one of a run with the same training cameras"
        )


def reused_anchors(assembly: Assembly, first: PlayerState, frame: Frame) -> Anchors:
    """Return the grid on which a frame 0 of another stream goes on.

    It is that stream's own, bit for bit, if a structure of the same settings laid it, or if this method's structure
    needs no grid: then rates, steps and gates of both streams have the same units. Otherwise it is the grid that this
    structure lays around the decoded centres, and each Gaussian gets the level of the nearest cell size.
    """
    theirs = decoded_anchors(first)
    if can_reuse_grid(assembly, first.meta.recipe):
        return theirs
    grid = assembly.structure.seed(point_cloud_of(first), frame.cameras)
    sizes = theirs.cell_sizes[theirs.levels]
    levels = (sizes.log()[:, None] - grid.cell_sizes.log()[None]).abs().argmin(1)
    return replace(theirs, levels=levels, cell_sizes=grid.cell_sizes, origin=grid.origin)


def can_reuse_grid(assembly: Assembly, recipe: Mapping[str, Any]) -> bool:
    """Return whether the grid of a stream serves this method's structure as it is."""
    if not assembly.structure.claims().has_grid:
        return True
    mine, theirs = assembly.recipe.structure, recipe.get("structure", {})
    grouping = assembly.structure.grouping_settings

    def laying(params: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in params.items() if key not in grouping}

    return bool(theirs.get("name") == mine.name and laying(theirs.get("params", {})) == laying(mine.params))


def point_cloud_of(first: PlayerState) -> PointCloud:
    """Return the centres of a decoded scene as points; their colour is unknown, grey."""
    means = first.gaussians.means
    return PointCloud(means, np.full_like(means, 0.5), "frame 0 of another stream")
