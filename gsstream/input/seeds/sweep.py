"""Plane-sweep stereo for every training view: where along each pixel's ray do the neighbours agree?

Built from standard pieces: fronto-parallel plane sweep (Collins, CVPR 1996), window NCC, which no camera gain or offset
disturbs, mean of the two best neighbours against occlusion, and semi-global aggregation (Hirschmueller, PAMI 2008).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from gsstream.core.cameras import Cameras
from gsstream.core.progress import Tell, silent
from gsstream.core.shapes import FloatArray, check_shape
from gsstream.input.seeds.aggregate import aggregate, best_plane
from gsstream.input.seeds.geometry import depth_range, neighbour_views, pixel_centers
from gsstream.input.seeds.window import window_mean
from gsstream.input.seeds.workers import one_thread_each

CPU = torch.device("cpu")
_GREY = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True)
class SweepSettings:
    """Settings of the sweep; the defaults were chosen by held-out colour error and true depth on two recordings.

    Arguments:
        planes: depth hypotheses per view, uniform in the root of inverse depth.
        neighbours: partners of each view.
        windows: half widths in pixels of the square NCC windows, averaged; a wide one carries weak texture.
        noise: image noise in [0, 1] below which texture does not count.
        unseen: cost of a hypothesis outside a neighbour's image; an uncorrelated match costs 0.5.
        step_penalty, jump_penalty: aggregation costs of a change by one plane and by more.
        workers: threads, each on a view of its own; 0: as many as ``one_thread_each`` makes.
        device: where the costs of matching are computed.
    """

    planes: int = 128
    neighbours: int = 6
    windows: Sequence[int] = (2, 6)
    noise: float = 2.0 / 255.0
    unseen: float = 0.6
    step_penalty: float = 0.03
    jump_penalty: float = 1.0
    workers: int = 0
    device: torch.device = CPU


def sweep_depths(images: FloatArray, cameras: Cameras, settings: SweepSettings, tell: Tell = silent) -> FloatArray:
    """Return the planar depth of every pixel of every view, right or wrong: nothing is rejected here.

    Returns [C, H, W] float32, scene units. Deterministic for any number of workers.
    """
    check_shape("images", images, (len(cameras), cameras.height, cameras.width, 3))
    grey = torch.from_numpy(np.ascontiguousarray(images @ _GREY)).to(settings.device)
    partners = neighbour_views(cameras, settings.neighbours)
    near_far = depth_range(cameras)
    # Steps uniform in the root of inverse depth: finer for far walls than uniform parallax, coarser right at the lens.
    root = np.linspace(near_far[:, 1] ** -0.5, near_far[:, 0] ** -0.5, settings.planes, axis=1)
    inverse = (root**2).astype(np.float32)
    stop = threading.Event()

    def one(view: int) -> FloatArray:
        cost = _matching_cost(
            grey, cameras, view, partners=partners[view].tolist(), inverse=inverse[view], settings=settings, stop=stop
        )
        total = aggregate(cost, grey[view].cpu().numpy(), settings.step_penalty, settings.jump_penalty)
        plane = best_plane(total)
        depth: FloatArray = (root[view, 0] + plane * (root[view, 1] - root[view, 0])) ** -2.0
        return depth.astype(np.float32)

    with one_thread_each(settings.workers) as pool:
        views = [pool.submit(one, view) for view in range(len(cameras))]
        try:
            for done, view in enumerate(as_completed(views)):
                view.result()
                tell("looking for points: cameras swept", done + 1, len(views))
        except BaseException:
            stop.set()  # Ctrl-C does not wait for views that are begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        depths: FloatArray = np.stack([view.result() for view in views])
        return depths


def agreements(
    images: FloatArray, cameras: Cameras, settings: SweepSettings, *, views: Sequence[int], limit: float
) -> FloatArray:
    """Return how much of the texture of some views lies, at some depth, where the nearest cameras see the same.

    A wrong depth seldom looks right, so that poses that do not fit the images agree about next to nothing.

    Returns [V]: share, 0 to 1, of the textured pixels of each of these views; NaN where one has no texture.
    """
    check_shape("images", images, (len(cameras), cameras.height, cameras.width, 3))
    grey = torch.from_numpy(np.ascontiguousarray(images @ _GREY)).to(settings.device)
    partners = neighbour_views(cameras, settings.neighbours)
    near_far = depth_range(cameras)

    def one(view: int) -> float:
        root = np.linspace(near_far[view, 1] ** -0.5, near_far[view, 0] ** -0.5, settings.planes)
        inverse = (root**2).astype(np.float32)
        cost = _matching_cost(
            grey, cameras, view, partners=partners[view].tolist(), inverse=inverse, settings=settings
        ).min(0)
        variance = _mean_and_variance(grey[view][None, None], settings.windows[0])[1][0, 0].cpu().numpy()
        textured = variance > (3 * settings.noise) ** 2
        return float((cost[textured] < limit).mean()) if textured.any() else np.nan

    with one_thread_each(settings.workers) as pool:
        return np.array(list(pool.map(one, views)), np.float64)


def _matching_cost(
    grey: torch.Tensor,
    cameras: Cameras,
    view: int,
    partners: list[int],
    inverse: FloatArray,
    settings: SweepSettings,
    stop: threading.Event | None = None,
) -> FloatArray:
    """[D, H, W] mean of the two best neighbours' (1 - NCC) / 2, in [0, 1]; half done where it was stopped."""
    height, width = grey.shape[1:]
    reference = grey[view][None, None]
    statistics = [_mean_and_variance(reference, half) for half in settings.windows]
    maps = [_plane_map(cameras, view, partner, grey.device) for partner in partners]
    cost = np.zeros((len(inverse), height, width), np.float32)
    # Planes at a time: what is made in between stays in a processor's cache; a GPU is asked once.
    chunk = 4 if grey.device.type == "cpu" else len(inverse)
    for start in range(0, len(inverse), chunk):
        if stop is not None and stop.is_set():
            break
        planes = torch.from_numpy(inverse[start : start + chunk]).to(grey.device)
        best = planes.new_full((len(planes), height, width), settings.unseen)
        second = best.clone()
        for partner, (rotation, translation) in zip(partners, maps, strict=True):
            grid, unseen = _grid(rotation, translation, planes, height=height, width=width)
            warped = F.grid_sample(
                grey[partner][None, None], grid, mode="bilinear", padding_mode="border", align_corners=False
            ).reshape(len(planes), 1, height, width)
            match = _ncc_cost(warped, reference, statistics, settings)
            match.masked_fill_(unseen, settings.unseen)
            second = torch.minimum(second, torch.maximum(best, match))
            best = torch.minimum(best, match)
        cost[start : start + chunk] = (0.5 * (best + second)).cpu().numpy()
    return cost


def _plane_map(cameras: Cameras, view: int, partner: int, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """A pixel at inverse depth q lands in the partner at (A + q b), homogeneous, image = [-1, 1]; A [3, HW], b [3]."""
    relative = cameras.viewmats[partner] @ np.linalg.inv(cameras.viewmats[view])
    to_unit = np.array([[2 / cameras.width, 0, -1], [0, 2 / cameras.height, -1], [0, 0, 1.0]])
    camera = to_unit @ cameras.Ks[partner]
    uv = pixel_centers(cameras.width, cameras.height)
    rays = np.linalg.inv(cameras.Ks[view]) @ np.concatenate([uv, np.ones((len(uv), 1))], axis=1).T
    rotation = (camera @ relative[:3, :3] @ rays).astype(np.float32)
    offset = (camera @ relative[:3, 3]).astype(np.float32)
    return torch.from_numpy(rotation).to(device), torch.from_numpy(offset).to(device)


def _grid(
    rotation: torch.Tensor, translation: torch.Tensor, planes: torch.Tensor, height: int, width: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sampling grid [1, D H, W, 2] and the mask [D, H, W] of samples outside the partner's image."""
    position = rotation[None] + translation[None, :, None] * planes[:, None, None]
    depth = position[:, 2]
    xy = position[:, :2] / depth.clamp_min(1e-3)[:, None]
    unseen = (depth <= 1e-3) | (xy.abs().amax(1) > 1)
    grid = xy.permute(0, 2, 1).reshape(1, len(planes) * height, width, 2)
    return grid, unseen.reshape(len(planes), height, width)


def _ncc_cost(
    warped: torch.Tensor,
    reference: torch.Tensor,
    statistics: list[tuple[torch.Tensor, torch.Tensor]],
    settings: SweepSettings,
) -> torch.Tensor:
    floor = settings.noise**2
    moments = torch.cat([warped, warped * warped, warped * reference])
    agreement = torch.zeros_like(warped)
    for half, (mean, variance) in zip(settings.windows, statistics, strict=True):
        warped_mean, square, product = window_mean(moments, half).chunk(3)
        warped_variance = (square - warped_mean * warped_mean).clamp_min_(0)
        covariance = product - warped_mean * mean
        agreement += covariance.mul_(torch.rsqrt(warped_variance.add_(floor).mul_(variance + floor)))
    return 0.5 * (1 - agreement[:, 0] / len(settings.windows))


def _mean_and_variance(image: torch.Tensor, half: int) -> tuple[torch.Tensor, torch.Tensor]:
    mean = window_mean(image, half)
    return mean, (window_mean(image * image, half) - mean * mean).clamp_min(0)
