"""Anchor insertion: Gaussians for what no move of the others can show. The paper names it as future work.

The octree of frame 0 is fixed, so what enters the scene, or moves farther than its region, can only be made from what
is there. After a frame's optimisation, pixels that changed and are still wrong in several cameras mark a small visual
hull; points in it become Gaussians, are fitted on their own for a few passes, and travel as births of the delta packet.
From the next frame on they are Gaussians like all others, in the group of their neighbours or in one of their own.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import (
    ATTRIBUTES,
    Births,
    FloatArray,
    FrameWork,
    Gaussians,
    Growth,
    IntArray,
    Layout,
    PartConfig,
    Rng,
    Rows,
    Scene,
    in_nodes,
    own_nodes,
)
from gsstream.blocks import RowTable, logit, nearest_rows, rgb_to_sh0
from gsstream_s2gs.hull import Hull, hull_points, one_per_cell

#: Initial side of a newborn Gaussian, in pixels of the camera nearest to it, and its opacity.
PIXELS, OPACITY = 2.0, 0.5
#: Learning rates of 3DGS at the start of training; positions: fraction of the rig's extent.
RATES = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 0.05, "sh0": 2.5e-3, "shN": 1.25e-4}


@final
class AnchorInsertion(Growth):
    """Gives birth where a frame is still wrong in several cameras (future work of the paper).

    Nothing leaves: deaths are left to other parts.
    """

    class Config(PartConfig):
        per_frame: int = Field(default=256, ge=1, description="most Gaussians born in one frame")
        error: float = Field(
            default=0.15, gt=0, le=1,
            description="change and error of a pixel, image units, beyond which the scene lacks something there",
        )  # fmt: skip
        votes: float = Field(
            default=0.75, gt=0, le=1, description="least share of a point's views in which it lands in such a pixel"
        )
        least_views: int = Field(default=4, ge=2, description="least number of these views")
        agreement: float = Field(
            default=0.12, gt=0, le=1, description="largest standard deviation of a colour channel over these views"
        )
        rays: int = Field(default=64, ge=1, description="rays searched per view")
        epochs: int = Field(default=4, ge=0, description="passes over the training cameras that fit the newborn alone")
        least_opacity: float = Field(default=0.1, ge=0, lt=1, description="newborn below this opacity are dropped")

    source: ClassVar[str] = "gsstream; S2GS, section 5 (future work)"

    def propose(self, after: Scene, work: FrameWork, rng: Rng) -> Rows | None:
        settings, views = self.config, range(len(work.cameras))
        scene = after.gaussians.map(torch.from_numpy)
        # In the colours of the scene: cameras of different colour response would agree on no point otherwise.
        images = np.stack([work.scene_image(view).numpy() for view in views])
        masks = np.stack([self._lacking(scene, work, view) for view in views])
        hull = hull_points(
            images, masks, work.cameras, depth_range(after.gaussians.means, work), rays=settings.rays,
            votes=settings.votes, least_views=settings.least_views, agreement=settings.agreement,
            generator=rng.numpy("insertion", work.index),
        )  # fmt: skip
        hull = one_per_cell(hull, float(after.layout.units.min()), settings.per_frame)
        if not len(hull):
            return None
        born = self._fitted(scene, newborn(hull, scene), work, rng)
        born = born.rows(torch.sigmoid(born.opacities) >= settings.least_opacity)
        if not len(born):
            return None
        return Rows(place(born.map(lambda value: value.numpy()), after.gaussians.means, after.layout))

    def _lacking(self, scene: Gaussians[torch.Tensor], work: FrameWork, view: int) -> IntArray:
        """Return [H, W] bool: pixels that changed since the last frame and that the scene does not show.

        Only tiles that changed count: elsewhere a difference is noise, however small ``error`` is.
        """
        now = work.image(view)
        wrong = (work.shown(scene, view) - now).abs().amax(-1) > self.config.error
        changed = (work.previous_image(view) - now).abs().amax(-1) > self.config.error
        marked: IntArray = (wrong & changed & work.changed_pixels(view)).numpy()
        return marked

    def _fitted(
        self, scene: Gaussians[torch.Tensor], born: Gaussians[torch.Tensor], work: FrameWork, rng: Rng
    ) -> Gaussians[torch.Tensor]:
        """Optimise the newborn alone, everything else held still."""
        views = len(work.cameras)
        joined = Gaussians(**{name: torch.cat([getattr(scene, name), value]) for name, value in born.items()})
        inner = work.on(joined)
        inner.narrow(torch.arange(len(scene), len(joined)))
        rates = {**RATES, "means": RATES["means"] * work.cameras.extent}
        table = RowTable(dict(born.items()), rates, work.optimiser)
        generator = rng.stream("insertion/order", work.index)
        for _ in range(self.config.epochs):
            for view in torch.randperm(views, generator=generator).tolist():
                inner.pull(view, Gaussians(**{name: table[name] for name in ATTRIBUTES}))
                table.step()
        return Gaussians(**{name: table[name].detach() for name in ATTRIBUTES})


def depth_range(means: FloatArray, work: FrameWork) -> tuple[float, float]:
    """Return the nearest and farthest depth in which something may appear, scene units."""
    cameras = work.cameras
    distances = np.linalg.norm(means[:, None] - cameras.centers[None], axis=-1) if len(means) else np.ones((1, 1))
    far = float(np.quantile(distances, 0.95))
    return cameras.near, max(far, 2 * cameras.near)


def newborn(hull: Hull, scene: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
    """Return isotropic Gaussians of about two pixels at the points of the hull."""
    count = len(hull)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=torch.from_numpy(hull.xyz),
        quats=quats,
        scales=torch.from_numpy(hull.size).mul(PIXELS).log()[:, None].repeat(1, 3),
        opacities=torch.full((count,), logit(OPACITY)),
        sh0=rgb_to_sh0(torch.from_numpy(hull.rgb)),
        shN=torch.zeros(count, scene.shN.shape[1], 3),
    )


def place(born: Gaussians[FloatArray], means: FloatArray, layout: Layout) -> Births:
    """Place births in the node of the nearest Gaussian within a unit; what is farther from all gets a node each."""
    distance, nearest = nearest_rows(born.means, means)
    units = np.full(len(born), len(layout.units) - 1, np.uint8)
    near = distance <= float(layout.units[0])
    inside = in_nodes(born.rows(near), layout.node_of[nearest[near]], units[near])
    apart = own_nodes(born.rows(~near), units[~near], len(layout.node_counts))
    joined = {name: np.concatenate([getattr(inside.gaussians, name), value]) for name, value in apart.gaussians.items()}
    return Births(
        Gaussians(**joined), np.concatenate([inside.nodes, apart.nodes]),
        np.concatenate([inside.unit_of, apart.unit_of]), apart.parents,
    )  # fmt: skip
