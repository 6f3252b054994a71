"""Seeds of frame 0: the recording's points, else a plane sweep, else the shell behind the scene alone."""

from __future__ import annotations

import torch

from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, PointCloud, join_frames, shrink_frame
from gsstream.core.progress import Tell, silent
from gsstream.engine.fit import constants
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.depth_maps import read_depth_maps
from gsstream.input.seeds.seeding import photo_consistent_seeds
from gsstream.input.seeds.shell import shell_points
from gsstream.input.seeds.sweep import CPU, SweepSettings
from gsstream.input.seeds.thinning import thin_points
from gsstream.recipe.model import FirstFrame

#: With fewer points than this a scene cannot be reconstructed: "auto" then looks for more by a plane sweep.
SPARSE = 2000
SWEEP_WIDTH = 160


def gather_points(
    source: Source | None, frame: Frame, settings: FirstFrame, tell: Tell = silent, device: torch.device = CPU
) -> PointCloud:
    """Return the points to seed from. Only the cameras of ``frame`` take part, and points that the source vouches for.

    Where a plane sweep is made, it uses the recording's depth maps, and looks for depths on ``device``.

    Raises InputError when the recipe asks for a kind of points that the recording does not have, or finds none.
    """
    pixels = frame.images[..., 0].size
    limit = min(settings.max_points, max(1, pixels // constants.PIXELS_PER_SEED))
    return thin_points(_base_points(source, frame, settings, tell, device=device), limit)


def with_test_views(source: Source, frame: Frame) -> Frame:
    """Return the frame with the images of the test cameras behind its own.

    This is what ``data.leak = points`` lets seeding see.
    """
    return join_frames(frame, source.frame(frame.index, "test"))


def _base_points(
    source: Source | None, frame: Frame, settings: FirstFrame, tell: Tell, device: torch.device
) -> PointCloud:
    wanted = settings.points
    if wanted == "sfm":
        return _triangulate(frame, tell)
    if wanted == "sweep":
        return _sweep(frame, settings, tell, source, device=device)
    shipped = None if source is None else source.points("sparse" if wanted == "sparse" else "recording")
    if shipped is None and wanted != "auto":
        raise InputError(
            f"first_frame.points = {wanted!r}, but the recording ships no points, "
            "or none that its test cameras took no part in; use 'auto', 'sweep' or 'sfm'"
        )
    if shipped is not None and (wanted != "auto" or len(shipped) >= SPARSE):
        return shipped
    try:
        return _sweep(frame, settings, tell, source, device=device)
    except InputError:  # fewer than three cameras, or views that agree nowhere
        if shipped is not None:
            return shipped
        if not settings.shell:
            raise
        return shell_points(frame.images, frame.cameras)


def _triangulate(frame: Frame, tell: Tell) -> PointCloud:
    from gsstream.input.seeds.mapping import triangulate_points

    return triangulate_points(frame.images, frame.cameras, tell=tell)


def _sweep(frame: Frame, settings: FirstFrame, tell: Tell, source: Source | None, device: torch.device) -> PointCloud:
    """Points that several training views agree on, found at most SWEEP_WIDTH pixels wide (time grows with pixels)."""
    small = shrink_frame(frame, -(-frame.cameras.width // SWEEP_WIDTH))
    known = None
    if source is not None:
        known = read_depth_maps(source.info.depth_maps, small.cameras, source.info.world.scale)
    sweep, count = SweepSettings(device=device), settings.max_points
    return photo_consistent_seeds(small.images, small.cameras, count, known=known, settings=sweep, tell=tell).points
