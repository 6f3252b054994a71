"""How fast the slope of a group's motion grows where the group moves on: Gauss-Newton's matrix, from one picture."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import Moves
from gsstream.core.shapes import FloatArray


def curvature_of(
    means: FloatArray, moves: Moves, cameras: Cameras, view: int, structure: FloatArray
) -> FloatArray:
    """Return the curvature [K, 6, 6] of a view's loss by shift and turn of groups of rows.

    A row that moves carries its share of the picture along: at a pixel the picture changes by its slope times the
    shift of the row on the screen, times the row's share of the pixel's light. As shares add up to at most 1, the sum
    over rows of share * (slope * shift)^2 is at least the square of the sum, also where rows of several groups share a
    pixel: the blocks together lie above the matrix of Gauss-Newton of all groups at once, so each can be solved for
    itself. In units of the loss, which is a mean over all values of a picture; its SSIM counts as if it were L1.

    Arguments:
        means: [A, 3] centres of the rows after they moved.
        moves: of these rows, which it counts from 0 to A - 1.
        cameras: the training cameras.
        view: index of one of them.
        structure: [A, 3] as ``FrameWork.structure`` gives it.
    """
    by_row = _on_screen(means, moves, cameras, view)
    xx, xy, yy = structure.T.astype(np.float64)
    tensor = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    out = np.zeros((len(moves.centre), 6, 6))
    np.add.at(out, moves.place, np.swapaxes(by_row, 1, 2) @ tensor @ by_row)
    return out / (3 * cameras.height * cameras.width)


def _on_screen(means: FloatArray, moves: Moves, cameras: Cameras, view: int) -> FloatArray:
    """[A, 2, 6] derivative of each row's place on the screen, pixels, by shift and turn of its group."""
    rotation, focal = cameras.viewmats[view, :3, :3], np.diag(cameras.Ks[view])[:2]
    seen = means @ rotation.T + cameras.viewmats[view, :3, 3]
    depth = np.maximum(seen[:, 2], cameras.near)
    slopes = (seen[:, :2] / depth[:, None])[..., None]
    shift = (focal / depth[:, None])[..., None] * (rotation[:2] - slopes * rotation[2])
    arm = means - (moves.centre + moves.shift)[moves.place]
    return np.concatenate([shift, 2 * np.cross(arm[:, None], shift)], -1)
