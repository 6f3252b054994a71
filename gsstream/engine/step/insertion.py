"""Anchor insertion: Gaussians for what no move of the others can show. Future work in the paper; the procedure is ours.

The octree of frame 0 is fixed, so what enters the scene, or moves farther than its region, can only be made from what
is there. After a frame's optimisation, pixels that changed and are still wrong in several cameras mark a small visual
hull; points in it become Gaussians, are fitted on their own for a few passes, and travel as births of the delta packet.
From the next frame on they are Gaussians like all others, in the group of their neighbours or in one of their own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.births import Births, in_nodes, own_nodes
from gsstream.core.delta import Delta, Layout, apply_delta
from gsstream.core.frame import Frame
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.core.storage import unpacked
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import StepChecks
from gsstream.engine.fit.exposure import backward_view
from gsstream.engine.frame0.nearest import nearest_rows
from gsstream.engine.frame0.root import first_rates
from gsstream.engine.fit.row_table import RowTable
from gsstream.engine.state.stream_state import StreamState
from gsstream.init.hull import Hull, hull_points, one_per_cell
from gsstream.render.activations import logit, rgb_to_sh0

#: Initial side of a newborn Gaussian, in pixels of the camera nearest to it, and its opacity.
PIXELS, OPACITY = 2.0, 0.5


def with_insertions(parts: Assembly, state: StreamState, frame: Frame, delta: Delta, rng: Rng) -> Delta:
    """The delta with births where the frame is still wrong; the same delta when the recipe asks for none."""
    settings = parts.recipe.insertion
    if settings.per_frame == 0:
        return delta
    layout = state.player.layout
    scene = apply_delta(state.player.gaussians, layout, delta).map(torch.from_numpy)
    masks = lacking(parts, state, scene, frame)
    hull = hull_points(
        frame.images, masks, frame.cameras, depth_range(scene.means.numpy(), frame), rays=settings.rays,
        votes=settings.votes, least_views=settings.least_views, agreement=settings.agreement,
        generator=rng.numpy("insertion", frame.index),
    )  # fmt: skip
    hull = one_per_cell(hull, float(layout.cell_sizes.min()), settings.per_frame)
    if not len(hull):
        return delta
    born = fit(parts, state, scene, newborn(hull, scene), frame, rng)
    born = born.rows(torch.sigmoid(born.opacities) >= settings.least_opacity)
    if not len(born):
        return delta
    return replace(delta, births=place(born.map(lambda t: t.numpy()), scene.means.numpy(), layout))


def lacking(parts: Assembly, state: StreamState, scene: Gaussians[torch.Tensor], frame: Frame) -> IntArray:
    """[V, H, W] bool: pixels that changed since the last frame and that ``scene`` does not show."""
    masks = []
    for view, now in enumerate(frame.images):
        with torch.no_grad():
            image = parts.renderer.render(scene, frame.cameras, view, parts.recipe.background).image
        image = state.exposure.apply(view, image) if state.exposure else image
        wrong = np.abs(image.numpy() - now).max(-1) > parts.recipe.insertion.error
        changed = np.abs(unpacked(state.previous.images[view]) - now).max(-1) > parts.recipe.insertion.error
        masks.append(wrong & changed)
    return np.stack(masks)


def depth_range(means: FloatArray, frame: Frame) -> tuple[float, float]:
    """Nearest and farthest depth in which something may appear: from the near plane to beyond the scene's bulk."""
    distances = np.linalg.norm(means[:, None] - frame.cameras.centers[None], axis=-1) if len(means) else np.ones((1, 1))
    far = float(np.quantile(distances, 0.95))
    return frame.cameras.near, max(far, 2 * frame.cameras.near)


def newborn(hull: Hull, scene: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
    """Isotropic Gaussians of about two pixels at the points of the hull."""
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


def fit(
    parts: Assembly, state: StreamState, scene: Gaussians[torch.Tensor], born: Gaussians[torch.Tensor], frame: Frame,
    rng: Rng,
) -> Gaussians[torch.Tensor]:  # fmt: skip
    """Optimise the newborn alone, everything else held still, with the rates of frame 0."""
    views = len(frame.cameras)
    whole = Gaussians(**{name: torch.cat([getattr(scene, name), value]) for name, value in born.items()})
    session = parts.renderer.open(whole, None, frame.cameras, parts.recipe.background)
    session.narrow(torch.arange(len(scene), len(whole)))
    rates = first_rates(parts.recipe.first_frame, frame.cameras.extent)
    table = RowTable(dict(born.items()), rates, parts.optimiser)
    targets = [parts.loss.prepare(torch.from_numpy(image)) for image in frame.images]
    generator = rng.stream("insertion/order", frame.index)
    look = StepChecks(parts.checks, frame.index)
    for _ in range(parts.recipe.insertion.epochs):
        for view in torch.randperm(views, generator=generator).tolist():
            output = session.render(view, Gaussians(**{name: table[name] for name in ATTRIBUTES}))
            look("renderer", parts.renderer, f"image of view {view}, newborn Gaussians in it,", output.image)
            backward_view(output.image, view, state.exposure, parts.loss, targets[view], parts.recipe.loss.dssim)
            table.step()
            look("insertion", table, "newborn Gaussians after the step,", table.leaves)
            look.iteration += 1
    return Gaussians(**{name: table[name].detach() for name in ATTRIBUTES})


def place(born: Gaussians[FloatArray], means: FloatArray, layout: Layout) -> Births:
    """Births in the group of the nearest Gaussian within a root cell; what is farther from all gets a group each."""
    distance, nearest = nearest_rows(born.means, means)
    levels = np.full(len(born), len(layout.cell_sizes) - 1, np.uint8)
    near = distance <= float(layout.cell_sizes[0])
    inside = in_nodes(born.rows(near), layout.node_of[nearest[near]], levels[near])
    apart = own_nodes(born.rows(~near), levels[~near], len(layout.node_counts))
    joined = {name: np.concatenate([getattr(inside.gaussians, name), value]) for name, value in apart.gaussians.items()}
    return Births(
        Gaussians(**joined), np.concatenate([inside.nodes, apart.nodes]),
        np.concatenate([inside.octree_levels, apart.octree_levels]), apart.parents,
    )  # fmt: skip
