"""Bundle adjustment of a rig and the poses of a board, with analytic derivatives.

Unknown are, for each camera, the lens (fx, fy, cx, cy, k1, k2, p1, p2, k3 as OpenCV has them) and the pose (rotation
vector, translation; world to camera), and for each picture the pose of the board (board to world). The first camera's
pose is fixed. Where c = R_c (R_b X + t_b) + t_c are a corner's coordinates in a camera, the derivative by a rotation
vector w is -R [x] J(w), with the right Jacobian J of the rotation group (Chirikjian 2012, section 10.3.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, diags_array
from scipy.sparse.linalg import splu

from gsstream.core.shapes import FloatArray, IntArray

LENS, POSE = 9, 6
#: Pixels above which a residual counts less (Huber).
HUBER = 1.0
#: Most steps of the adjustment; few tens are usual.
STEPS = 200
#: Deviations from which on a corner is a false one.
FALSE = 6.0


@dataclass(frozen=True, slots=True)
class Corners:
    """Every corner that was seen.

    ``camera`` and ``picture`` [N], ``point`` [N, 3] metres on the board, ``place`` [N, 2] pixels.
    """

    camera: IntArray
    picture: IntArray
    point: FloatArray
    place: FloatArray

    def of(self, chosen: Any) -> Corners:
        """Return those of a mask or of indices."""
        return Corners(self.camera[chosen], self.picture[chosen], self.point[chosen], self.place[chosen])


@dataclass(frozen=True, slots=True)
class Solution:
    """``lenses`` [C, 9], ``cameras`` [C, 6], ``boards`` [P, 6]: rotation vectors and translations in metres."""

    lenses: FloatArray
    cameras: FloatArray
    boards: FloatArray
    #: Cameras whose lens is known, and stays as it is.
    known: frozenset[int] = frozenset()


def rotations(vectors: FloatArray) -> FloatArray:
    """[N, 3] rotation vectors -> [N, 3, 3] rotations (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = _cross(vectors)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    out: FloatArray = np.eye(3) + a * cross + b * cross @ cross
    return out


def _right_jacobian(vectors: FloatArray) -> FloatArray:
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = _cross(vectors)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    out: FloatArray = np.eye(3) - b * cross + c * cross @ cross
    return out


def _cross(v: FloatArray) -> FloatArray:
    zero = np.zeros(v.shape[:-1])
    rows = [[zero, -v[..., 2], v[..., 1]], [v[..., 2], zero, -v[..., 0]], [-v[..., 1], v[..., 0], zero]]
    out: FloatArray = np.stack([np.stack(row, -1) for row in rows], -2)
    return out


def project(lens: FloatArray, at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels [N, 2] of coordinates ``at`` [N, 3], and derivatives by ``lens`` [N, 2, 9] and ``at`` [N, 2, 3]."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens.T
    z = np.where(np.abs(at[:, 2]) < 1e-9, 1e-9, at[:, 2])
    x, y = at[:, 0] / z, at[:, 1] / z
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    slope = k1 + square * (2 * k2 + 3 * square * k3)  # of radial, by the square
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    one, zero = np.ones_like(x), np.zeros_like(x)
    by_lens = np.stack(
        [
            np.stack(
                [
                    bent_x,
                    zero,
                    one,
                    zero,
                    fx * x * square,
                    fx * x * square**2,
                    fx * 2 * x * y,
                    fx * (square + 2 * x * x),
                    fx * x * square**3,
                ],
                -1,
            ),
            np.stack(
                [
                    zero,
                    bent_y,
                    zero,
                    one,
                    fy * y * square,
                    fy * y * square**2,
                    fy * (square + 2 * y * y),
                    fy * 2 * x * y,
                    fy * y * square**3,
                ],
                -1,
            ),
        ],
        -2,
    )
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    bent_by = np.stack(
        [
            np.stack([radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, cross], -1),
            np.stack([cross, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x], -1),
        ],
        -2,
    )
    ideal_by = np.stack([np.stack([1 / z, zero, -x / z], -1), np.stack([zero, 1 / z, -y / z], -1)], -2)
    by_at = np.stack([fx, fy], -1)[:, :, None] * (bent_by @ ideal_by)
    return np.stack([fx * bent_x + cx, fy * bent_y + cy], -1), by_lens, by_at


def residuals(solution: Solution, corners: Corners) -> tuple[FloatArray, FloatArray]:
    """Return residuals [N, 2], pixels, and derivatives [N, 2, 21] by lens, camera pose and board pose of a corner."""
    lens, camera = solution.lenses[corners.camera], solution.cameras[corners.camera]
    board = solution.boards[corners.picture]
    turn_c, turn_b = rotations(camera[:, :3]), rotations(board[:, :3])
    world = np.einsum("nij,nj->ni", turn_b, corners.point) + board[:, 3:]
    at = np.einsum("nij,nj->ni", turn_c, world) + camera[:, 3:]
    pixels, by_lens, by_at = project(lens, at)
    by_camera = by_at @ np.concatenate(
        [-turn_c @ _cross(world) @ _right_jacobian(camera[:, :3]), np.broadcast_to(np.eye(3), turn_c.shape)], -1
    )
    by_board = (
        by_at
        @ turn_c
        @ np.concatenate(
            [-turn_b @ _cross(corners.point) @ _right_jacobian(board[:, :3]), np.broadcast_to(np.eye(3), turn_b.shape)],
            -1,
        )
    )
    return pixels - corners.place, np.concatenate([by_lens, by_camera, by_board], -1)


class _Problem:
    """The vector of unknowns, and residuals with sparse derivatives by it."""

    def __init__(self, start: Solution, corners: Corners, *, rig: bool) -> None:
        self.corners, self.start, self.rig = corners, start, rig
        self.cameras, self.pictures = len(start.lenses), len(start.boards)
        self.own = self.cameras * LENS + (self.cameras - 1) * POSE if rig else 0
        rows = np.arange(2 * len(corners.camera)).reshape(-1, 2, 1)
        lens = corners.camera[:, None] * LENS + np.arange(LENS)
        pose = self.cameras * LENS + (corners.camera[:, None] - 1) * POSE + np.arange(POSE)
        board = self.own + corners.picture[:, None] * POSE + np.arange(POSE)
        first = np.broadcast_to((corners.camera == 0)[:, None], pose.shape)
        known = np.broadcast_to(np.isin(corners.camera, list(start.known))[:, None], lens.shape)
        columns = np.concatenate([lens, pose, board], -1)[:, None, :]
        free = np.concatenate([rig & ~known, ~first & rig, np.ones(board.shape, bool)], -1)
        shape = (len(corners.camera), 2, LENS + 2 * POSE)
        self.free = np.broadcast_to(free[:, None], shape)
        self.rows = np.broadcast_to(rows, shape)[self.free]
        self.columns = np.broadcast_to(columns, shape)[self.free]

    def packed(self, solution: Solution) -> FloatArray:
        parts = [solution.lenses.ravel(), solution.cameras[1:].ravel()] if self.rig else []
        return np.concatenate([*parts, solution.boards.ravel()])

    def unpacked(self, x: FloatArray) -> Solution:
        boards = x[self.own :].reshape(-1, POSE)
        if not self.rig:
            return replace(self.start, boards=boards)
        lenses = x[: self.cameras * LENS].reshape(-1, LENS)
        poses = x[self.cameras * LENS : self.own].reshape(-1, POSE)
        return replace(
            self.start, lenses=lenses, cameras=np.concatenate([self.start.cameras[:1], poses]), boards=boards
        )

    def value(self, x: FloatArray) -> FloatArray:
        return residuals(self.unpacked(x), self.corners)[0].ravel()

    def slopes(self, x: FloatArray) -> csr_matrix:
        by = residuals(self.unpacked(x), self.corners)[1]
        return csr_matrix((by[self.free], (self.rows, self.columns)), (2 * len(by), len(x)))


def adjust(start: Solution, corners: Corners, *, rig: bool = True) -> Solution:
    """Return the solution of least reprojection error (Huber, 1 pixel); ``rig`` False fits the boards alone.

    Levenberg and Marquardt, on the normal equations: most unknowns are boards, each of which meets few others, so a
    sparse factorisation is exact and fast. (``scipy.optimize.least_squares`` takes sparse derivatives by LSMR alone,
    and stopped up to a degree away from the least error.)
    """
    problem = _Problem(start, corners, rig=rig)
    x, damping = problem.packed(start), 1e-3
    rest = problem.value(x)
    for _ in range(STEPS):
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(_sizes(rest), 1e-12)))
        slopes = problem.slopes(x).multiply(weight[:, None]).tocsr()
        normal, pull = (slopes.T @ slopes).tocsc(), slopes.T @ (weight * rest)
        scale = np.maximum(normal.diagonal(), 1e-12 * normal.diagonal().max())
        before = _loss(rest)
        while True:
            step = -splu(normal + diags_array(damping * scale).tocsc()).solve(pull)
            tried = problem.value(x + step)
            gain = before - _loss(tried)
            if gain > 0 or damping > 1e8:
                break
            damping *= 8
        if gain <= 0:
            break
        x, rest, damping = x + step, tried, max(damping / 4, 1e-12)
        if gain < 1e-10 * before:
            break
    return problem.unpacked(x)


def adjust_twice(start: Solution, corners: Corners) -> tuple[Solution, Any]:
    """Adjust, leave out the corners that are far from where they should be, and adjust again.

    Returns the solution and a mask [N] of the corners that it is made of. Huber's loss bounds what a false corner does;
    a hundredth of them would still do as much as the noise of all others.
    """
    rough = adjust(start, corners)
    off = np.linalg.norm(residuals(rough, corners)[0], axis=1)
    # The median of the length of two equal normal deviations is 1.18 of one.
    kept = off <= max(FALSE * float(np.median(off)) / 1.18, 0.25)
    return adjust(rough, corners.of(kept)), kept


def _sizes(rest: FloatArray) -> FloatArray:
    """[2 N] residuals -> how many pixels each corner is off, for both of its coordinates."""
    out: FloatArray = np.repeat(np.linalg.norm(rest.reshape(-1, 2), axis=1), 2)
    return out


def _loss(rest: FloatArray) -> float:
    off = _sizes(rest)[::2]
    return float(np.where(off < HUBER, off * off, 2 * HUBER * off - HUBER * HUBER).sum())


def focal_deviation(solution: Solution, corners: Corners) -> FloatArray:
    """Return the standard deviation of each focal length [C], as a share of it, by the residuals that remain.

    The larger of two: as if every corner were off by itself, and as if the corners of a picture were off together
    (Liang and Zeger 1986), as where a board moves between cameras that do not expose at one instant. On the videos of
    a published rig the larger says 0.6 to 1.3 % of focal lengths that are 0.2 to 1.7 % off.
    """
    problem = _Problem(solution, corners, rig=True)
    x = problem.packed(solution)
    slopes, rest = problem.slopes(x), problem.value(x)
    # Half of the residuals lie within 0.6745 deviations: what is far off does not count.
    sigma = float(np.median(np.abs(rest)) / 0.6745)
    normal = (slopes.T @ slopes).tocsc()
    factor = splu(normal + diags_array(np.full(len(x), 1e-12 * normal.diagonal().max())).tocsc())
    pictures, place = np.unique(np.repeat(corners.picture, 2), return_inverse=True)
    rows = np.arange(len(rest))
    pulls = csr_matrix((rest, (place, rows)), (len(pictures), len(rest))) @ slopes  # of each picture
    out = []
    for camera in range(problem.cameras):
        if camera in solution.known:
            out.append(0.0)
            continue
        unit = np.zeros((len(x), 2))
        unit[camera * LENS, 0] = unit[camera * LENS + 1, 1] = 1
        solved = factor.solve(unit)
        alone = sigma**2 * np.diag(unit.T @ solved)
        together = ((pulls @ solved) ** 2).sum(0) * len(pictures) / max(1, len(pictures) - 1)
        out.append(np.sqrt(max(alone.max(), together.max())) / solution.lenses[camera, :2].mean())
    return np.array(out)
