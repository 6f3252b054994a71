"""Error: Gaussians are born where a frame stays wrong in several views, and leave where nothing is drawn."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
import torch
from pydantic import Field

from gsstream.core.changes import Births, Rows, Scene, in_nodes
from gsstream.core.context import FrameWork
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.part import PartConfig
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.growth.base import Growth
from gsstream.growth.fitting import finite, fitted_births, joined
from gsstream.growth.judging import ErrorMap, error_map, gains, without
from gsstream.growth.merging import closest_pairs, merged
from gsstream.growth.nearest import alike
from gsstream.growth.placing import Placed, one_per_cell, placed
from gsstream.growth.splitting import halves, stretched

#: Views are numbered round; of three in a row, which ones changes from frame to frame, one judges and two propose.
OUT_OF = 3
#: Pairs whose merge is tried out for every birth that needs room.
TRIED = 4
#: Opacity of a newborn before it is fitted, as a logit: 0.73.
OPACITY = 1.0


@final
class ErrorGrowth(Growth):
    """Gives birth where the error that is left after a frame's residual exceeds the noise of the cameras.

    Two thirds of the views propose: along rays through their worst pixels, the depth is taken at which they agree with
    one another, in the colours of the scene. What is proposed is fitted in these views, and what lowers the error of
    the other views is kept. Gaussians that are stretched over what is wrong are split. For every Gaussian that joins,
    one leaves that no view shows; when there is none, two that look alike become one.
    """

    class Config(PartConfig):
        per_frame: int = Field(default=192, ge=1, le=100_000, description="most Gaussians born in one frame")
        sigmas: float = Field(
            default=10.0, gt=0, le=1000,
            description="error of a pixel, the mean of 3 x 3, beyond which it counts as wrong, in noise of its camera",
        )  # fmt: skip
        votes: float = Field(
            default=0.6, gt=0, le=1, description="least share of a point's views in which it must land in wrong pixels"
        )
        agreement: float = Field(
            default=0.1, gt=0, le=1, description="largest mean difference of the colours around a point between views"
        )
        rays: int = Field(default=96, ge=1, le=10_000, description="most rays searched per view")
        depths: int = Field(default=64, ge=2, le=1000, description="depths tried along a ray")
        pixels: float = Field(default=1.5, gt=0, le=20, description="standard deviation of a newborn Gaussian, pixels")
        epochs: int = Field(default=6, ge=0, le=100, description="passes over the proposing views that fit the newborn")
        split: float = Field(
            default=6.0, ge=0, le=1000,
            description="Gaussians with a longer axis in what is wrong, as a standard deviation in pixels, are split; "
            "0: none",
        )  # fmt: skip
        growth: float = Field(
            default=0.0, ge=0, le=1, description="share of a frame's births that may exceed its deaths"
        )
        merges: bool = Field(
            default=True, description="merge Gaussians that look alike when births need room and all others are seen"
        )

    source: ClassVar[str] = "gsstream; splits as in 3DGS (Kerbl et al. 2023)"

    def propose(self, after: Scene, work: FrameWork, rng: Rng) -> Rows | None:
        views = list(range(len(work.cameras)))
        out = [view for view in views if (view + work.index) % OUT_OF == 0]
        proposing = [view for view in views if view not in out]
        if not out or len(proposing) < 2:
            return None
        scene = after.gaussians.map(torch.from_numpy)
        maps = {view: error_map(work, scene, view, self.config.sigmas) for view in proposing}
        if not any(bool(found.wrong.any()) for found in maps.values()):
            return None
        born, parents = self._candidates(after, work, maps, rng)
        if not len(born):
            return None
        born = fitted_births(without(scene, parents), born, work, proposing, self.config.epochs, rng)
        sound = finite(born)
        born, parents = born.rows(sound), parents[sound]
        gain = self._gains(scene, born, parents, work, out)
        if not bool((gain > 0).any()):
            return None
        return self._balanced(after, work, born, parents, gain, out)

    def _candidates(
        self, after: Scene, work: FrameWork, maps: dict[int, ErrorMap], rng: Rng
    ) -> tuple[Gaussians[torch.Tensor], IntArray]:
        """Newborn Gaussians, and the row that each is a half of, or -1."""
        config = self.config
        found = placed(
            work, maps, after.gaussians.means, rays=config.rays, depths=config.depths, votes=config.votes,
            agreement=config.agreement, generator=rng.numpy("growth", work.index),
        )  # fmt: skip
        found = one_per_cell(found, config.pixels, config.per_frame)
        lone = _newborn(found, config.pixels, after.gaussians.shN.shape[1])
        rows = stretched(after.gaussians, work, maps, config.split)[: config.per_frame // 2]
        pairs = halves(after.gaussians.rows(rows))
        number = min(len(lone), config.per_frame - len(pairs))
        both = joined(lone.rows(np.arange(number)), pairs)
        return both.map(torch.from_numpy), np.concatenate([np.full(number, -1), np.repeat(rows, 2)]).astype(np.int64)

    def _gains(
        self, scene: Gaussians[torch.Tensor], born: Gaussians[torch.Tensor], parents: IntArray, work: FrameWork,
        out: list[int],
    ) -> FloatArray:  # fmt: skip
        """[B] how much each takes away from the error of the views left out; nobody gains if all together do not."""
        gain, _ = gains(scene, born, parents, work, out)
        # Both halves of a split stay or go, with their parent.
        for parent in np.unique(parents[parents >= 0]):
            gain[parents == parent] = gain[parents == parent].sum()
        kept = np.flatnonzero(gain > 0)
        if len(kept):
            _, total = gains(scene, born.rows(torch.from_numpy(kept)), parents[kept], work, out)
            if total > 0:
                return gain
        return np.zeros(len(born))

    def _balanced(
        self, after: Scene, work: FrameWork, born: Gaussians[torch.Tensor], parents: IntArray, gain: FloatArray,
        out: list[int],
    ) -> Rows | None:  # fmt: skip
        """The births that gain most, and a death for each: parents that are split, and what no view shows.

        When nothing of that is left, a pair of Gaussians that look alike is merged for each birth that gains more than
        the merge costs.
        """
        drawn = work.on(after.gaussians.map(torch.from_numpy)).drawn_rows().numpy()
        spare = np.setdiff1d(np.flatnonzero(~drawn), parents)
        # A birth alone makes one more, and so do two halves in the place of one parent.
        units = np.where(parents < 0, np.arange(len(born)), len(born) + parents)
        order = [int(row) for row in np.argsort(-gain, kind="stable") if gain[row] > 0]
        ranked = list(dict.fromkeys(units[order].tolist()))
        dying = 1 - self.config.growth
        number = len(ranked) if dying == 0 else min(len(ranked), int(len(spare) / dying))
        pairs: IntArray = np.zeros((0, 2), np.int64)
        if self.config.merges and number < len(ranked):
            wanted = [float(gain[units == unit][0]) for unit in ranked[number:]]
            pairs = self._merges(after, work, np.concatenate([parents, spare]), wanted, out)
        number += len(pairs)
        if number == 0:
            return None
        kept = np.flatnonzero(np.isin(units, ranked[:number]))
        split = np.unique(parents[kept][parents[kept] >= 0])
        leaving = spare[: round((number - len(pairs)) * dying)]
        deaths = np.unique(np.concatenate([split, leaving, pairs.ravel()])).astype(np.int64)
        births = born.rows(torch.from_numpy(kept)).map(lambda value: value.numpy())
        return Rows(self._settled(after, joined(births, merged(after.gaussians, pairs))), deaths)

    def _merges(
        self, after: Scene, work: FrameWork, busy: IntArray, wanted: list[float], out: list[int]
    ) -> IntArray:
        """[K, 2] rows: pairs whose merge costs less than the birth it makes room for gains, in the views left out.

        Arguments:
            busy: rows that leave or are split anyway.
            wanted: gains of the births that have no room, falling.
        """
        pairs = closest_pairs(after, TRIED * len(wanted), busy)
        if not len(pairs):
            return pairs
        scene = after.gaussians.map(torch.from_numpy)
        one = merged(after.gaussians, pairs).map(torch.from_numpy)
        cost = -gains(scene, one, pairs.ravel(), work, out)[0]
        cheapest = np.argsort(cost, kind="stable")[: len(wanted)]
        worth = cost[cheapest] < np.array(wanted[: len(cheapest)])
        return pairs[cheapest[: int(np.argmin(np.append(worth, False)))]]

    def _settled(self, after: Scene, born: Gaussians[FloatArray]) -> Births:
        """Births in the node, and so in the gate and the group, of the nearest Gaussian of like colour."""
        rows = alike(born, after)
        return in_nodes(born, after.layout.node_of[rows], after.layout.unit_of[rows])


def _newborn(found: Placed, pixels: float, coefficients: int) -> Gaussians[FloatArray]:
    """Isotropic Gaussians at the points found, in their colours."""
    number = len(found)
    quats = np.zeros((number, 4), np.float32)
    quats[:, 0] = 1
    scales = np.log(np.maximum(found.pixel * pixels, 1e-9)).astype(np.float32)
    return Gaussians(
        means=found.xyz,
        quats=quats,
        scales=np.repeat(scales[:, None], 3, 1),
        opacities=np.full(number, OPACITY, np.float32),
        sh0=((found.rgb - 0.5) / np.float32(SH0))[:, None].astype(np.float32),
        shN=np.zeros((number, coefficients, 3), np.float32),
    )
