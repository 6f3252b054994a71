"""A penalty on depth that changes where the picture does not; it prevents shards that stand across a wall."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.functional import adaptive_avg_pool2d

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.activations import rgb_to_sh0
from gsstream.parts.render.backward import backward, gradient_of

#: Difference of two pixels, in [0, 1], over which a change of depth becomes e times cheaper.
EDGE = 0.1
#: Attributes that depth is differentiated by; it does not depend on colours.
PLACED = ("means", "quats", "scales", "opacities")
#: Extents of the rig at which inverse depth is 1, at which it ends, and the least depth that is told apart.
UNIT, MOST, NEAREST = 0.3, 3.0, 0.02
#: Least share of a pixel's light that a depth is divided by.
LEAST_ALPHA = 0.1


class SmoothDepth:
    """The smoothness of depth in the views of a frame. Depth is drawn at half size, which is all that it needs.

    Arguments:
        renderer: renderer of the run.
        frame: training images, at the size at which they are fitted.
        device: device of the Gaussians.
    """

    def __init__(self, renderer: Renderer, frame: Frame, device: torch.device) -> None:
        cameras = frame.cameras
        self._renderer, self._frame, self._extent = renderer, frame, cameras.extent
        self._cameras = cameras.scaled(max(1, cameras.width // 2), max(1, cameras.height // 2))
        self._poses = torch.from_numpy(cameras.viewmats).float().to(device)
        self._edges: dict[int, list[torch.Tensor]] = {}

    def add_grad(self, rows: Gaussians[torch.Tensor], view: int, grad: Gaussians[torch.Tensor], weight: float) -> None:
        """Add to ``grad``, in place, the gradient of ``weight`` times the roughness of a view."""
        leaves = rows.map(lambda value: value.detach().clone().requires_grad_())
        loss = self.mean_roughness(leaves, view)
        if not loss.requires_grad:  # nothing is drawn
            return
        backward([loss], [torch.full_like(loss, weight)])
        for name in PLACED:
            getattr(grad, name).add_(gradient_of(getattr(leaves, name)))

    def mean_roughness(self, leaves: Gaussians[torch.Tensor], view: int) -> torch.Tensor:
        """Return [] mean change of inverse depth from pixel to pixel along both axes, less where the image changes."""
        pose = self._poses[view]
        depth = leaves.means @ pose[2, :3] + pose[2, 3]
        inverse = (UNIT * self._extent / depth.clamp_min(NEAREST * self._extent)).clamp(max=MOST)
        # Inverse depth is drawn as a colour on black, so that what a pixel shows is its mean times alpha.
        shown = replace(leaves, sh0=rgb_to_sh0(inverse[:, None].repeat(1, 3)), shN=torch.zeros_like(leaves.shN))
        drawn = self._renderer.render(shown, self._cameras, view, (0.0, 0.0, 0.0))
        blended = drawn.image[..., 0] / drawn.alpha.clamp_min(LEAST_ALPHA)
        terms = [
            (blended.diff(dim=axis).abs() * weight).mean()
            for axis, weight in enumerate(self._edge_weights(view))
            if blended.shape[axis] > 1
        ]
        return torch.stack(terms).sum() if terms else blended.new_zeros(())

    def _edge_weights(self, view: int) -> list[torch.Tensor]:
        """Cost of the change of depth between neighbouring pixels; it is lower where the image changes, too."""
        if view not in self._edges:
            image = torch.from_numpy(self._frame.image(view)).permute(2, 0, 1)
            half = adaptive_avg_pool2d(image, (self._cameras.height, self._cameras.width))
            weights = [torch.exp(-half.diff(dim=axis + 1).abs().mean(0) / EDGE) for axis in (0, 1)]
            self._edges[view] = [weight.to(self._poses.device) for weight in weights]
        return self._edges[view]
