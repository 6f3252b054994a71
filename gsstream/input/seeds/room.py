"""Seeds on the walls and the floor of a room that the cameras stand in.

Few cameras see most of a wall alone. There a plane sweep has nothing to match, and a chance match close to the lens,
where every pixel falls into some other picture, passes for a surface. A room is a sphere and a floor that the cameras
stand in. Both are found by how well the pictures agree once they are drawn on the surface, which takes slant and
perspective out of the comparison, so that cameras far apart can be compared. Training cameras only.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.focus import focus_point
from gsstream.core.progress import Tell, silent
from gsstream.core.projection import inside, project
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.input.seeds.fusion import agreement, world_points
from gsstream.input.seeds.geometry import neighbour_views, pixel_centers, spread_views
from gsstream.input.seeds.surface import HALF, NOISE, Surface, picture_at
from gsstream.input.seeds.window import window_mean
from gsstream.input.seeds.workers import one_thread

#: Degrees between two cameras, seen from what all look at, above which a rig stands in the room that it looks into.
AROUND = 90.0
#: Most cameras that are used to find a room and to compare a pixel's place: the time grows with their pairs.
MOST_CAMERAS = 8
#: Distance over which the middle of the sphere is drawn to the focus, as a share of the rig's size; and least radius of
#: the sphere, as a share of the distance from its middle to the farthest camera.
CENTER_SPREAD, INSIDE = 0.05, 0.93
#: Correlations below which another camera contradicts a place on the wall, and above which it confirms the sweep.
CONTRADICTED, CONFIRMED = 0.2, 0.6
#: A surface counts as in front of the room where its depth is below this share of the room's: one that several views
#: support, and one with a single supporter.
IN_FRONT, CLEARLY_IN_FRONT = 0.97, 0.93
#: Difference of depth up to which another view supports the sweep.
SUPPORT = 0.03


class Room(NamedTuple):
    """A sphere (middle [3], radius) and a floor: places x with up . x = floor, up [3] a unit vector. Scene units."""

    middle: FloatArray
    radius: float
    up: FloatArray
    floor: float


class Search(NamedTuple):
    """How many places a search begins at, how many steps follow from the best, and the factor from step to step."""

    starts: int
    tries: int
    shrink: float

    @property
    def total(self) -> int:
        """All places, also those that lie outside of the allowed range."""
        return self.starts + self.tries


SPHERE, FLOOR = Search(111, 150, 0.98), Search(91, 60, 0.95)


class Match(NamedTuple):
    """Pixels of a view at some depth, [H, W] each: best correlation with another view, is one there, and texture."""

    best: FloatArray
    seen: BoolArray
    texture: FloatArray


def stands_around(cameras: Cameras) -> bool:
    """Say whether a rig looks inwards from around: only then do the cameras stand where the walls are."""
    if len(cameras) < 2:
        return False
    outward = cameras.centers - focus_point(cameras)
    distance = np.linalg.norm(outward, axis=1)
    if (np.einsum("ci,ci->c", cameras.viewmats[:, 2, :3], -outward) <= 0.5 * distance).any():
        return False
    directions = outward / distance[:, None]
    return bool((directions @ directions.T).min() < np.cos(np.radians(AROUND)))


def with_room(
    images: FloatArray,
    cameras: Cameras,
    swept: FloatArray,
    depths: FloatArray,
    accepted: BoolArray,
    given: BoolArray,
    tell: Tell = silent,
) -> tuple[FloatArray, BoolArray]:
    """Return depths [C, H, W] of which those of the room stand in where the sweep is not sure, and which are seeds.

    A pixel gets no seed where another camera contradicts the wall: it sees the place, with texture, and other colours.

    Arguments:
        images: [C, H, W, 3] in [0, 1], about 160 pixels wide; time grows with their size.
        cameras: C cameras of that size, with the near plane of the run.
        swept: [C, H, W] depth that the sweep found, right or wrong.
        depths: [C, H, W] the same after interpolation where it was not sure.
        accepted: [C, H, W] bool, where enough views agree with ``depths``.
        given: [C, H, W] bool, pixels of depth maps: they stay as they are.
    """
    support = agreement(swept, cameras, SUPPORT).support
    room = room_depths(find_room(images, cameras, tell), cameras)
    grey, partners = torch.from_numpy(images.mean(-1)), neighbour_views(cameras, MOST_CAMERAS)
    depths, kept = depths.copy(), accepted & (given | (depths < IN_FRONT * room))
    for view in range(len(cameras)):
        match = _match(grey, cameras, view, depth=swept[view], others=partners[view].tolist())
        more = ~given[view] & ~kept[view] & (swept[view] < CLEARLY_IN_FRONT * room[view]) & (support[view] >= 1)
        more &= match.best > CONFIRMED
        depths[view][more] = swept[view][more]
        kept[view] |= more
        wall = _match(grey, cameras, view, depth=room[view], others=partners[view].tolist())
        contradicted = wall.seen & (wall.best < CONTRADICTED) & (wall.texture > NOISE)
        taken = ~given[view] & ~kept[view] & ~contradicted
        depths[view][taken] = room[view][taken]
        kept[view] |= taken
        tell("looking for points: walls compared", view + 1, len(cameras))
    return depths, kept


def find_room(images: FloatArray, cameras: Cameras, tell: Tell = silent) -> Room:
    """Return the sphere and the floor on which pictures agree best; the same for the same pictures."""
    if len(cameras) > MOST_CAMERAS:
        chosen = spread_views(cameras, MOST_CAMERAS)
        images, cameras = images[chosen], cameras.select(chosen.tolist())
    grey = torch.from_numpy(np.ascontiguousarray(images.mean(-1)))
    focus = focus_point(cameras)
    size = float(np.linalg.norm(cameras.centers - focus, axis=1).mean())
    counted = itertools.count(1)

    def tried() -> None:
        tell("looking for points: rooms tried", next(counted), SPHERE.total + FLOOR.total)

    with one_thread():
        sphere = _sphere(grey, cameras, focus, size=size, tried=tried)
        return Room(*sphere, *_floor(grey, cameras, focus, size=size, tried=tried))


def room_depths(room: Room, cameras: Cameras) -> FloatArray:
    """Return [C, H, W]: planar depth at which the ray of every pixel leaves the room."""
    pixels = pixel_centers(cameras.width, cameras.height)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1)
    found = np.empty((len(cameras), len(pixels)))
    for view, start in enumerate(cameras.centers):
        way = rays @ np.linalg.inv(cameras.Ks[view]).T @ cameras.viewmats[view, :3, :3]  # of planar depth 1
        offset = start - room.middle
        square, half = (way**2).sum(1), way @ offset
        inner = half**2 - square * (offset @ offset - room.radius**2)
        wall = (np.sqrt(np.maximum(inner, 0)) - half) / square
        wall[(inner < 0) | (wall <= 0)] = np.inf
        down = way @ room.up
        drop = np.full(len(pixels), room.floor - start @ room.up)
        ground = np.divide(drop, down, out=np.full(len(pixels), np.inf), where=down != 0)
        ground[ground <= 0] = np.inf
        depth = np.minimum(wall, ground)
        # A ray that passes a sphere in which its camera does not quite stand ends beyond it.
        found[view] = np.where(np.isfinite(depth), depth, 3 * room.radius)
    return found.reshape(len(cameras), cameras.height, cameras.width)


def _sphere(
    grey: torch.Tensor, cameras: Cameras, focus: FloatArray, size: float, tried: Callable[[], None]
) -> tuple[FloatArray, float]:
    """Middle and radius: about the focus, and no smaller than where the cameras stand."""
    latitude = (np.arange(72) + 0.5) / 72 * np.pi - np.pi / 2
    longitude = (np.arange(216) + 0.5) / 216 * 2 * np.pi
    a, b = np.meshgrid(latitude, longitude, indexing="ij")
    unit = np.stack([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)], -1)
    sphere = Surface.shaped(grey, cameras, unit)

    def score(values: FloatArray) -> float:
        if values[3] < INSIDE * np.linalg.norm(cameras.centers - values[:3], axis=1).max():
            return -1.0
        tried()
        away = float(np.linalg.norm(values[:3] - focus)) / (CENTER_SPREAD * size)
        return sphere.agreement(values[:3], float(values[3])) * float(np.exp(-0.5 * away**2))

    starts = [np.append(focus, radius) for radius in np.linspace(0.8, 3, SPHERE.starts) * size]
    best = _climb(score, starts, np.full(4, 0.04 * size), SPHERE)
    return best[:3], float(best[3])


def _floor(
    grey: torch.Tensor, cameras: Cameras, focus: FloatArray, size: float, tried: Callable[[], None]
) -> tuple[FloatArray, float]:
    """Upward normal, from cameras held level, and the height of a plane below every camera."""
    across = cameras.viewmats[:, 0, :3]
    up = np.linalg.eigh(across.T @ across)[1][:, 0]
    if up @ cameras.viewmats[:, 1, :3].mean(0) > 0:  # a camera's second axis points down
        up = -up
    highest = float(((cameras.centers - focus) @ up).min()) - 0.02 * size
    one = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    one /= np.linalg.norm(one)
    steps = ((np.arange(128) + 0.5) / 64 - 1) * 1.5 * size
    plane = Surface.shaped(grey, cameras, steps[:, None, None] * one + steps[None, :, None] * np.cross(up, one))

    def score(values: FloatArray) -> float:
        if values[0] > highest:
            return -1.0
        tried()
        return plane.agreement(focus + values[0] * up)

    starts = [np.array([height]) for height in np.linspace(min(-1.2 * size, highest), highest, FLOOR.starts)]
    best = _climb(score, starts, np.array([0.01 * size]), FLOOR)
    return up, float(focus @ up + best[0])


def _climb(
    score: Callable[[FloatArray], float], starts: list[FloatArray], step: FloatArray, search: Search
) -> FloatArray:
    """Values of a high score: random steps, ever smaller ones, from the best of the starts."""
    values = [score(start) for start in starts]
    best, value = starts[int(np.argmax(values))], max(values)
    rng = np.random.default_rng(0)
    for number in range(search.tries):
        other = best + rng.normal(size=len(best)) * step * search.shrink**number
        found = score(other)
        if found > value:
            best, value = other, found
    return best


def _match(grey: torch.Tensor, cameras: Cameras, view: int, depth: FloatArray, others: list[int]) -> Match:
    """Compare a view's pixels, taken to lie at ``depth`` [H, W], with other views of the pictures [C, H, W]."""
    stack = np.broadcast_to(depth.astype(np.float64), (len(cameras), *depth.shape))
    points = world_points(stack, cameras, view)
    own = grey[view]
    mean, square = window_mean(torch.stack([own, own * own])[:, None], HALF)[:, 0]
    variance = (square - mean * mean).clamp_min(0)
    best, seen = torch.full(depth.shape, -1.0), torch.zeros(depth.shape, dtype=torch.bool)
    for other in others:
        shade, there = _drawn_on(grey[other], cameras, other, points=points, shape=depth.shape)
        moments = window_mean(torch.stack([shade, shade * shade, shade * own])[:, None], HALF)[:, 0]
        spread = (moments[1] - moments[0] ** 2).clamp_min(0)
        same = (moments[2] - moments[0] * mean) / ((variance + NOISE**2) * (spread + NOISE**2)).sqrt()
        best = torch.where(there, torch.maximum(best, same), best)
        seen |= there
    return Match(best.numpy(), seen.numpy(), variance.sqrt().numpy())


def _drawn_on(
    grey: torch.Tensor, cameras: Cameras, view: int, points: FloatArray, shape: tuple[int, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture [H, W] drawn on places [P, 3]: an image of ``shape`` (P pixels), and which of its pixels are drawn."""
    uv, depth = project(points, cameras, view)
    there = inside(uv, depth, cameras) & (depth > cameras.near_plane)
    return picture_at(grey, uv.reshape(*shape, 2)), torch.from_numpy(there.reshape(shape))
