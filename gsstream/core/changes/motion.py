"""Motion: groups of rows move rigidly, positions and orientations, as predicted from the last frame and corrected.

A residual, optimised from zero in every frame, cannot bridge the path of a fast body: Gaussians stay behind, and others
are recoloured to look like it. A motion moves them along. It costs about one bit per group where the prediction is
right, and six small integers where it is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, NamedTuple

import numpy as np

from gsstream.core.changes.scene import Groups, Scene
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import SH0, Array, Gaussians, Other
from gsstream.core.shapes import FloatArray, IntArray

#: Cells are counted from -HALF_GRID to HALF_GRID - 1 along each axis; what lies beyond belongs to the outermost one.
HALF_GRID = 1 << 15
MAX_BRIGHTNESS_BINS = 16
#: Numbers of cells along x, y and z, and of classes of brightness.
PLACES = (2 * HALF_GRID, 2 * HALF_GRID, 2 * HALF_GRID, MAX_BRIGHTNESS_BINS)
#: Cells per row up to which groups are numbered by a table of all cells around the rows.
MAX_CELLS_PER_ROW = 64


@dataclass(frozen=True, slots=True)
class Motion:
    """Rigid transforms of groups of rows.

    Arguments:
        cell, brightness_bins: what makes a group (:class:`Groups`); ``cell`` is a float32 above 0.
        moving: [G] uint8, 1 for the K groups that move.
        symbols: [K, 6] int32 corrections of the prediction: shift x, y, z and turn x, y, z.
        translation_step: scene units per symbol of the shift.
        rotation_step: tan(angle / 2) per symbol of the turn.
        predicted: whether a group starts from the mean displacement of its rows in the last frame, else from rest.
        regroup: whether the groups are formed anew from where rows are now, even if they are known.
    """

    cell: float
    brightness_bins: int
    moving: IntArray
    symbols: IntArray = field(repr=False)
    translation_step: float = 1.0
    rotation_step: float = 1.0
    predicted: bool = True
    regroup: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether no group moves."""
        return not bool(np.any(self.moving))


class GroupTransforms(NamedTuple, Generic[Array]):
    """The rows of moving groups, and the transform of each group: x' = R (x - center) + center + translation.

    ``rows`` [A] ascending, ``group`` [A] which of the K moving groups each is in, ``center``, ``translation``,
    ``rotation`` [K, 3] float64 (turn: axis * tan(angle / 2)). Numpy arrays in codec and player, torch tensors where
    they are fitted.
    """

    rows: Any
    group: Any
    center: Array
    translation: Array
    rotation: Array

    def map(self, function: Callable[[Array], Other]) -> GroupTransforms[Other]:
        """Apply a function to every array."""
        return GroupTransforms(*(function(value) for value in self))


def groups_for(scene: Scene, cell: float, brightness_bins: int, regroup: bool = False) -> Groups:
    """Return the groups of a motion: those of the scene if they have this cell and these bins, else new ones.

    Rows are of one group when their centres lie in one cell of a regular grid and their colours in one class of
    brightness. Groups are numbered by cell (x, then y, then z), then brightness.

    Arguments:
        scene: decoded, as both ends have it.
        cell: side of a cell, scene units; a float32 above 0.
        brightness_bins: number of classes of brightness, 1 to 16.
        regroup: form new groups in any case.
    """
    known = scene.groups
    if known is not None and not regroup and known.cell == cell and known.brightness_bins == brightness_bins:
        return known
    places = _grid_places(scene.gaussians.means, scene.gaussians.sh0, cell, brightness_bins)
    group_of, count = _numbered(places, PLACES)
    return Groups(cell, brightness_bins, group_of, count)


def grid_places(means: FloatArray, sh0: FloatArray, cell: float, brightness_bins: int) -> IntArray:
    """Return a number [N] int64 for the cell and the shade of each row; rows of one group have the same.

    Arguments:
        means: [N, 3], scene units.
        sh0: [N, 1, 3].
        cell: side of a cell, scene units.
        brightness_bins: number of classes of brightness, 1 to 16.
    """
    number = np.zeros(len(means), np.int64)
    for digit, base in zip(_grid_places(means, sh0, cell, brightness_bins), PLACES, strict=True):
        number = number * base + digit
    return number


def _grid_places(means: FloatArray, sh0: FloatArray, cell: float, brightness_bins: int) -> tuple[IntArray, ...]:
    """Cell x, y, z and class of brightness [N] int64 each of every row."""
    columns = np.ascontiguousarray(means.T, np.float64)
    columns /= float(cell)
    index = np.clip(np.floor(columns, out=columns), -HALF_GRID, HALF_GRID - 1, out=columns)
    x, y, z = index.astype(np.int64) + HALF_GRID
    red, green, blue = sh0[:, 0].astype(np.float64).T
    bright = 0.5 + SH0 * (0.25 * red + 0.5 * green + 0.25 * blue)
    return x, y, z, np.clip(np.floor(bright * brightness_bins), 0, brightness_bins - 1).astype(np.int64)


def _numbered(digits: Sequence[IntArray], bases: Sequence[int]) -> tuple[IntArray, int]:
    """Number of every row among the numbers that occur, in ascending order [N] int32, and how many occur.

    ``digits``: [N] int64 each, the foremost first; the product of their ``bases`` is below 2^63.
    """
    if len(digits[0]) == 0:
        return np.zeros(0, np.int32), 0
    low = [int(digit.min()) for digit in digits]
    spans = [int(digit.max()) - least + 1 for digit, least in zip(digits, low, strict=True)]
    small = math.prod(spans) <= MAX_CELLS_PER_ROW * len(digits[0])
    key = np.zeros(len(digits[0]), np.int64)
    for digit, least, span, base in zip(digits, low, spans, bases, strict=True):
        key = key * (span if small else base) + (digit - least if small else digit)
    if not small:
        names, number = np.unique(key, return_inverse=True)
        return number.astype(np.int32), len(names)
    # Where all cells of the box around the rows fit into a table, nothing need be sorted.
    occurs = np.zeros(math.prod(spans), np.bool_)
    occurs[key] = True
    names = np.flatnonzero(occurs)
    rank = np.empty(len(occurs), np.int32)
    rank[names] = np.arange(len(names), dtype=np.int32)
    return rank[key], len(names)


def predict_transforms(scene: Scene, groups: Groups, moving: IntArray, predicted: bool) -> GroupTransforms[Any]:
    """Return the moving rows and the predicted transform of their groups, before any correction.

    Means over rows are float64 sums in the order of rows, divided by their number.

    Arguments:
        scene: decoded, as both ends have it.
        groups: G groups of its rows.
        moving: [G] uint8, 1 for the K groups that move.
        predicted: start from the mean displacement of a group's rows in the last frame, else from rest.
    """
    which = np.flatnonzero(moving)
    rank = np.full(groups.count, -1, np.int64)
    rank[which] = np.arange(len(which))
    # take() throughout: it gathers rows four times as fast as an index in brackets, and players do this in every frame.
    rows = np.flatnonzero(moving.astype(bool).take(groups.group_of))
    group = rank.take(groups.group_of.take(rows))
    center = group_means(scene.gaussians.means.take(rows, 0), group, len(which))
    translation: FloatArray = np.zeros((len(which), 3))
    rotation: FloatArray = np.zeros((len(which), 3))
    if predicted and scene.displacement is not None:
        past = rank.take(groups.group_of.take(scene.displacement.rows))
        here = np.flatnonzero(past >= 0)
        past = past.take(here)
        translation = group_means(scene.displacement.translation.take(here, 0), past, len(which))
        rotation = group_means(scene.displacement.rotation.take(here, 0), past, len(which))
    return GroupTransforms(rows=rows, group=group, center=center, translation=translation, rotation=rotation)


def apply_motion(scene: Scene, motion: Motion) -> tuple[Scene, IntArray]:
    """Return the scene after a motion, and the rows [A] of the groups that moved. ``scene.displacement`` stays.

    All arithmetic is float64 in a fixed order; centres and quaternions are rounded to float32 at the end.

    Raises:
        ShapeError: the motion's groups do not fit the scene, or lead out of the range of float32.
    """
    groups = groups_for(scene, motion.cell, motion.brightness_bins, motion.regroup)
    if motion.moving.shape != (groups.count,):
        raise ShapeError(
            f"motion: expected a mark for each of {groups.count} groups, got shape {list(motion.moving.shape)}; "
            "the packet belongs to another scene"
        )
    transforms = predict_transforms(scene, groups, motion.moving, motion.predicted)
    if motion.symbols.shape != (len(transforms.center), 6):
        raise ShapeError(
            f"motion: expected 6 symbols for each of {len(transforms.center)} moving groups, got shape "
            f"{list(motion.symbols.shape)}"
        )
    translation = transforms.translation + motion.symbols[:, :3].astype(np.float64) * float(motion.translation_step)
    rotation = transforms.rotation + motion.symbols[:, 3:].astype(np.float64) * float(motion.rotation_step)
    gaussians = transform_groups(scene.gaussians, transforms._replace(translation=translation, rotation=rotation))
    return replace(scene, gaussians=gaussians, groups=groups), transforms.rows


def apply_motions(scene: Scene, motions: Sequence[Motion]) -> tuple[Scene, IntArray]:
    """Return the scene after motions one after the other, and the rows [A], ascending, of all groups that moved.

    Raises ShapeError as :func:`apply_motion` does.
    """
    touched: IntArray = np.zeros(0, np.int64)
    for motion in motions:
        scene, rows = apply_motion(scene, motion)
        touched = union_rows(len(scene.gaussians), touched, rows)
    return scene, touched


def union_rows(number: int, *rows: IntArray) -> IntArray:
    """Return the rows, ascending, that are in any of these lists of rows below ``number``."""
    marks = np.zeros(number, bool)
    for some in rows:
        marks[some] = True
    return np.flatnonzero(marks)


def transform_groups(gaussians: Gaussians[FloatArray], transforms: GroupTransforms[Any]) -> Gaussians[FloatArray]:
    """Return the Gaussians with the rows of moving groups transformed. Raises ShapeError beyond float32."""
    if len(transforms.rows) == 0:
        return gaussians
    rows, group = transforms.rows, transforms.group
    quats = rodrigues_to_quat(transforms.rotation)
    # Column by column: a player does this in every frame, and columns that lie together take half the time.
    groups = np.concatenate([quat_to_rotmat(quats).reshape(-1, 9), transforms.center, transforms.translation, quats], 1)
    of = np.ascontiguousarray(groups.T).take(group, 1, mode="clip")
    matrix, center, translation, rotation = of[:9].reshape(3, 3, -1), of[9:12], of[12:15], of[15:]
    x, y, z = columns(gaussians.means, rows) - center
    there = matrix[:, 0] * x
    for term in (matrix[:, 1] * y, matrix[:, 2] * z, center, translation):
        there += term
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = there.astype(np.float32)
    if not bool(np.isfinite(rounded).all()):
        raise ShapeError("motion: it leads to positions beyond the range of float32")
    means, turns = gaussians.means.copy(), gaussians.quats.copy()
    means[rows] = rounded.T
    turns[rows] = quat_multiply(rotation.T, columns(gaussians.quats, rows).T).astype(np.float32)
    return replace(gaussians, means=means, quats=turns)


def columns(values: FloatArray, rows: IntArray) -> FloatArray:
    """Return the columns [C, A] of some rows [A] of ``values`` [N, C], float64, each column in one piece of memory."""
    return values.take(rows, 0).T.astype(np.float64, order="C")


def rodrigues_to_quat(rotation: FloatArray) -> FloatArray:
    """Return unit quaternions [K, 4] wxyz, float64, of rotations [K, 3] given as axis * tan(angle / 2)."""
    x, y, z = rotation.T
    scale = 1.0 / np.sqrt(1.0 + x * x + y * y + z * z)
    return np.stack([scale, x * scale, y * scale, z * scale], 1)


def quat_to_rotmat(quats: FloatArray) -> FloatArray:
    """Return rotation matrices [K, 3, 3] of unit quaternions [K, 4] wxyz."""
    w, x, y, z = quats.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, 1) for row in rows], 1)


def quat_multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the quaternion products a b [A, 4] wxyz: first the rotation b, then a."""
    w0, x0, y0, z0 = a.T
    w1, x1, y1, z1 = b.T
    return np.array(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
            w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
        ]
    ).T


def group_means(values: FloatArray, group: IntArray, number: int) -> FloatArray:
    """[K, 3] float64 mean of the rows in each of ``number`` places; 0 where there are none."""
    counts = np.maximum(np.bincount(group, minlength=number), 1)
    columns_of = values.T.astype(np.float64, order="C")
    return np.stack([np.bincount(group, column, number) / counts for column in columns_of], 1)
