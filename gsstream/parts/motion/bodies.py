"""Bodies: neighbouring groups whose fitted motions agree, so that they move nearly as one rigid body (ours).

A group shows few pixels, and these say little about some of its six numbers; the arm that it is a part of shows many.
All motions here turn about one origin: motions of different groups can then be compared, and their curvatures be added.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsstream.core.changes.motion import quat_to_rotmat, rodrigues_to_quat
from gsstream.core.shapes import FloatArray, IntArray

#: Groups are neighbours when their centres are at most this many cells apart along every axis.
REACH = 1.5


class Bodies(NamedTuple):
    """Which body each of K groups belongs to, and how the group moves with it.

    Arguments:
        body: [K] int64 number of each group's body, 0 to B - 1.
        values: [K, 6] shift and turn of every group when it moves exactly as its body does, in units.
        lever: [K, 6, 6] derivative of the six numbers of a group by those of its body.
    """

    body: IntArray
    values: FloatArray
    lever: FloatArray


def form_bodies(center: FloatArray, unit: FloatArray, values: FloatArray, curvature: FloatArray, most: float) -> Bodies:
    """Join neighbouring groups to bodies, the cheapest pairs first, as long as a pair costs less than ``most``.

    A pair, of groups or of bodies, costs the loss that both add up to when they take the one motion that suits both
    best, by their curvatures. It is joined when neither has a cheaper neighbour.

    Arguments:
        center: [K, 3] about which each group turns, scene units.
        unit: [6] what a value of 1 means for shift [scene units] and turn [tan(angle / 2)]; shift / turn is the side
            of a cell.
        values: [K, 6] fitted shift and turn, in units.
        curvature: [K, 6, 6] of the loss by ``values``, positive definite.
        most: loss, in that of ``curvature``.
    """
    side = float(unit[0] / unit[3])
    arm: FloatArray = center - center.mean(0)
    lever: FloatArray = np.tile(np.eye(6), (len(center), 1, 1))
    lever[:, :3, 3:] = 2 / side * np.cross(np.eye(3), arm[:, None]).transpose(0, 2, 1)  # of a product with the arm
    motion: FloatArray = values * unit
    motion[:, :3] -= _shift_by_turn(motion[:, 3:], arm)
    weight = lever.transpose(0, 2, 1) @ curvature @ lever
    # It takes a while to import, and only streams whose groups move need it.
    from scipy.spatial import KDTree

    first, common = _joined(
        KDTree(center).query_pairs(REACH * side, p=np.inf, output_type="ndarray"), motion / unit, weight, most
    )
    motion = common[first] * unit
    motion[:, :3] += _shift_by_turn(motion[:, 3:], arm)
    return Bodies(np.unique(first, return_inverse=True)[1], motion / unit, lever)


def _joined(pairs: IntArray, motion: FloatArray, weight: FloatArray, most: float) -> tuple[IntArray, FloatArray]:
    """[K] one group of each group's body, the same for all of them, and [K, 6] motions, valid for these groups."""
    motion, weight, number = motion.copy(), weight.copy(), len(motion)
    first = np.arange(number)
    costs = _costs(pairs, motion, weight)
    while len(pairs):
        chosen = _best_of_both(pairs, costs, number) & (costs < most)
        if not chosen.any():
            break
        kept, gone = pairs[chosen].T
        total = weight[kept] + weight[gone]
        moment = weight[kept] @ motion[kept][..., None] + weight[gone] @ motion[gone][..., None]
        motion[kept], weight[kept] = np.linalg.solve(total, moment)[..., 0], total
        into = np.arange(number)
        into[gone] = kept
        first = into[first]
        names, which = np.unique(np.sort(into[pairs], 1) @ [number, 1], return_index=True)
        pairs, costs = np.stack(np.divmod(names, number), 1), costs[which]
        apart = pairs[:, 0] != pairs[:, 1]
        pairs, costs = pairs[apart], costs[apart]
        # Costs change only for pairs of which one body has just been joined.
        new = np.isin(pairs, kept).any(1)
        costs[new] = _costs(pairs[new], motion, weight)
    return first, motion


def _best_of_both(pairs: IntArray, costs: FloatArray, number: int) -> IntArray:
    """[E] bool: pairs that are the cheapest of both their ends; no end is in two of them, whatever costs the same."""
    order = np.argsort(-costs, kind="stable")
    best = np.zeros(number, np.int64)
    # Where several values are written to one place, the last one stays: the value of the cheapest pair.
    best[pairs[order].ravel()] = np.repeat(order, 2)
    return np.asarray((best[pairs] == np.arange(len(pairs))[:, None]).all(1))


def _costs(pairs: IntArray, motion: FloatArray, weight: FloatArray) -> FloatArray:
    """[E] g^T (A^-1 + B^-1)^-1 g / 2 of the gap g between the motions of each pair, and their weights A and B."""
    one, other = pairs.T
    gap = (motion[one] - motion[other])[..., None]
    # Solved without the inverses: (A^-1 + B^-1)^-1 = A (A + B)^-1 B.
    share = np.linalg.solve(weight[one] + weight[other], weight[other] @ gap)
    return np.asarray(0.5 * (gap.transpose(0, 2, 1) @ weight[one] @ share)[:, 0, 0])


def _shift_by_turn(turn: FloatArray, arm: FloatArray) -> FloatArray:
    """[K, 3] how far turns [K, 3], axis * tan(angle / 2), move the ends of arms [K, 3]."""
    turned = quat_to_rotmat(rodrigues_to_quat(turn)) @ arm[..., None]
    return np.asarray(turned[..., 0] - arm)
