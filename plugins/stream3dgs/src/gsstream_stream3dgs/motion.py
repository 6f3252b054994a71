"""Fitting the transformation cache to the images of a frame."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import FloatArray, FrameWork, Gaussians, IntArray, Motion, Rng, Scene
from gsstream.blocks import pixel_size, said_by_cells
from gsstream_stream3dgs.cache import Cache, Lookup
from gsstream_stream3dgs.settings import CacheSettings


def fitted_motion(
    scene: Scene, work: FrameWork, rows: IntArray, epochs: int, settings: CacheSettings, rng: Rng
) -> Motion | None:
    """Return the motion of a frame; None where nothing moves.

    Arguments:
        scene: decoded, as both ends have it.
        work: the frame, seen from this scene.
        rows: [A] Gaussians that may move, ascending; those outside the box do not.
        epochs: passes over the training cameras.
        settings: of the cache.
        rng: random streams by name and frame.
    """
    unit, inside = in_box(scene.gaussians.means, settings.box)
    rows = rows[inside[rows]]
    if not len(rows):
        return None
    pixel = pixel_size(scene.gaussians.means, work.cameras)
    # The same weights in every frame: what the published method warms up once is drawn at rest here.
    cache = Cache(settings, rng.stream("stream3dgs", 0))
    lookup = Lookup(torch.from_numpy(unit[rows]), settings)
    base = scene.gaussians.rows(rows).map(torch.from_numpy)
    work.narrow(torch.from_numpy(rows))
    adam = torch.optim.Adam(cache.parameters(), lr=settings.lr)
    reach = settings.reach * work.cameras.extent
    order = rng.numpy("stream3dgs/order", work.index)
    for _ in range(epochs):
        for view in order.permutation(len(work.cameras)):
            shift, turn = cache(lookup)
            work.pull(int(view), moved(base, reach * shift, turn))
            adam.step()
            adam.zero_grad()
    with torch.no_grad():
        shift, turn = cache(lookup)
    side = float(np.float32(settings.pixels * pixel))
    return said_by_cells(scene, rows, (reach * shift).numpy(), turn.numpy(), side, settings.step * pixel)


def in_box(means: FloatArray, left_out: float) -> tuple[FloatArray, IntArray]:
    """Return [N, 3] positions, 0 to 1 within the box, and [N] bool who lies in it.

    Arguments:
        means: [N, 3] centres, N > 0.
        left_out: share of them that lies beyond each face of the box.
    """
    low, high = np.quantile(means.astype(np.float64), [left_out, 1 - left_out], axis=0)
    unit = (means - low) / np.maximum(high - low, 1e-9)
    return unit, np.asarray(((unit >= 0) & (unit <= 1)).all(1))


def moved(gaussians: Gaussians[torch.Tensor], shift: torch.Tensor, turn: torch.Tensor) -> Gaussians[torch.Tensor]:
    """Return Gaussians, raw values, shifted and turned.

    Arguments:
        gaussians: A rows.
        shift: [A, 3] scene units.
        turn: [A, 3] axis * tan(angle / 2).
    """
    quat = torch.nn.functional.normalize(torch.cat([torch.ones_like(turn[:, :1]), turn], 1), dim=1)
    w0, x0, y0, z0 = quat.unbind(1)
    w1, x1, y1, z1 = gaussians.quats.unbind(1)
    quats = torch.stack([
        w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
        w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
        w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
        w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
    ], 1)  # fmt: skip
    return Gaussians(**{**dict(gaussians.items()), "means": gaussians.means + shift, "quats": quats})
