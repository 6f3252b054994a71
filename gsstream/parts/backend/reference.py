"""The slow renderer that defines the truth: plain torch, any float dtype, readable.

Cost grows with N * H * W; use it for tests, for tiny scenes, and where no compiled renderer is available.
"""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.core.cameras import Cameras
from gsstream.core.context import ScreenGradient
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.part import PartConfig
from gsstream.core.shapes import check_finite
from gsstream.parts.backend.base import Renderer, ScatterSession
from gsstream.parts.render.activations import activate_opacities, activate_scales, rotation_matrices
from gsstream.parts.render.session import RenderOutput

BLUR = 0.3
ALPHA_CUT = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
QUAT_NORMS = (1e-10, 1e10)


@final
class ReferenceRenderer(Renderer):
    """EWA splatting (Zwicker et al. 2001; Kerbl et al. 2023) written for clarity."""

    source = "EWA splatting (Zwicker et al. 2001) as in 3DGS (Kerbl et al. 2023)"

    class Config(PartConfig):
        rows_per_pass: int = Field(default=32, ge=1, description="image rows composited at once; bounds the memory")

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: tuple[float, float, float]
    ) -> RenderOutput:
        return self._render(gaussians, cameras, view, background=background, probe=None)

    def screen_gradient(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, image_gradient: torch.Tensor
    ) -> ScreenGradient:
        fixed = gaussians.map(torch.Tensor.detach)
        probe = torch.zeros(len(fixed), 2, dtype=fixed.means.dtype, requires_grad=True)
        with torch.enable_grad():
            output = self._render(fixed, cameras, view, background=(0.0, 0.0, 0.0), probe=probe)
            (gradient,) = torch.autograd.grad((output.image * image_gradient).sum(), probe, allow_unused=True)
        gradient = torch.zeros_like(probe) if gradient is None else gradient.detach()
        # Visibility must not be read from the gradient: a Gaussian in view may have gradient 0.
        return ScreenGradient(gradient, footprint_in_image(fixed, cameras, view) | (gradient != 0).any(1))

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: tuple[float, float, float],
    ) -> ScatterSession:
        return _ReferenceSession(
            renderer=self, gaussians=gaussians, active=active, cameras=cameras, background=background
        )

    def nudged(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, offsets: torch.Tensor
    ) -> RenderOutput:
        """Render on black with every 2-D mean moved: what screen gradients are derivatives of."""
        return self._render(gaussians, cameras, view, background=(0.0, 0.0, 0.0), probe=offsets)

    def _render(
        self,
        gaussians: Gaussians[torch.Tensor],
        cameras: Cameras,
        view: int,
        background: tuple[float, float, float],
        probe: torch.Tensor | None,
    ) -> RenderOutput:
        dtype = gaussians.means.dtype
        for name, value in gaussians.items():
            check_finite(name, value)
        means2d, conics, colors, depths, opacities = project(gaussians, cameras, view)
        if probe is not None:
            means2d = means2d + probe
        order = torch.argsort(depths.detach(), stable=True)
        order = order[depths.detach()[order] > cameras.near_plane]
        parts = (means2d[order], conics[order], colors[order], opacities[order])
        images, alphas = [], []
        for start in range(0, cameras.height, self.config.rows_per_pass):
            stop = min(cameras.height, start + self.config.rows_per_pass)
            image, alpha = composite(*parts, start, stop, cameras.width, torch.tensor(background, dtype=dtype))
            images.append(image)
            alphas.append(alpha)
        return RenderOutput(torch.cat(images), torch.cat(alphas))


class _ReferenceSession(ScatterSession):
    """Renders everything, and knows the gradient of the 2-D means: frame 0 grows by it."""

    _renderer: ReferenceRenderer

    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        whole = self._whole(rows)
        if probe is not None and self._active is not None:
            probe = torch.zeros(len(whole), 2, dtype=probe.dtype).index_copy(0, self._active, probe)
        return self._renderer._render(whole, self._cameras, view, background=self._background, probe=probe)


def project(
    gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Project Gaussians into a camera, by EWA splatting.

    Returns means2d [N, 2] px, conics [N, 2, 2], colours [N, 3], depths [N], opacities [N].
    """
    dtype = gaussians.means.dtype
    viewmat = torch.as_tensor(cameras.viewmats[view], dtype=dtype)
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    points = gaussians.means @ rotation.T + translation  # [N, 3] camera space
    # Points at or behind the camera are removed later; until then a depth of 1 keeps their unused arithmetic finite.
    depth = points[:, 2]
    safe = torch.where(depth > cameras.near_plane, depth, torch.ones_like(depth))
    K = torch.as_tensor(cameras.Ks[view], dtype=dtype)
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    width, height = cameras.width, cameras.height
    means2d = torch.stack([fx * points[:, 0] / safe + cx, fy * points[:, 1] / safe + cy], -1)
    # The Jacobian is evaluated at most 1.3 fields of view off axis, where the affine approximation still holds.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = safe * torch.clamp(points[:, 0] / safe, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = safe * torch.clamp(points[:, 1] / safe, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(safe)
    jacobian = torch.stack([fx / safe, zero, -fx * tx / safe**2, zero, fy / safe, -fy * ty / safe**2], -1)
    _check_quats(gaussians.quats)
    axes = rotation_matrices(gaussians.quats) * activate_scales(gaussians.scales)[:, None, :]
    footprint = jacobian.reshape(-1, 2, 3) @ rotation @ axes  # [N, 2, 3]
    covariance = footprint @ footprint.transpose(1, 2) + BLUR * torch.eye(2, dtype=dtype)
    check_finite("covariances on the screen (a size or a position overflows)", covariance)
    center = -(rotation.T @ translation)
    colors = evaluate_sh(gaussians.sh0, gaussians.shN, gaussians.means - center)
    return means2d, torch.linalg.inv(covariance), colors, depth, activate_opacities(gaussians.opacities)


def _check_quats(quats: torch.Tensor) -> None:
    """Raise ShapeError for a quaternion without direction; its rotation would be arbitrary."""
    norms = quats.detach().double().norm(dim=1)
    bad = ~((norms > QUAT_NORMS[0]) & (norms < QUAT_NORMS[1]))
    if bool(bad.any()):
        row = int(bad.nonzero()[0, 0])
        raise ShapeError(
            f"quats: expected norms between {QUAT_NORMS[0]:g} and {QUAT_NORMS[1]:g}, got {float(norms[row]):.3g} at "
            f"row {row} ({int(bad.sum())} in all); give them a direction"
        )


def footprint_in_image(gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int) -> torch.Tensor:
    """Return [N] bool: Gaussians in front of the camera whose visible box holds or crosses pixel centres."""
    means2d, conics, _, depths, opacities = project(gaussians, cameras, view)
    variances = torch.linalg.inv(conics).diagonal(dim1=1, dim2=2)  # [N, 2] px^2
    reach = 2 * torch.log(opacities / ALPHA_CUT)
    half = (reach[:, None].clamp_min(0) * variances).sqrt()
    far_corner = torch.tensor([cameras.width, cameras.height], dtype=means2d.dtype) - 0.5
    inside: torch.Tensor = ((means2d + half >= 0.5) & (means2d - half <= far_corner)).all(1)
    return inside & (depths > cameras.near_plane) & (reach >= 0)


def composite(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    colors: torch.Tensor,
    opacities: torch.Tensor,
    start: int,
    stop: int,
    width: int,
    background: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Composite depth-sorted splats front to back over some image rows; return image and alpha."""
    dtype = means2d.dtype
    ys, xs = torch.meshgrid(
        torch.arange(start, stop, dtype=dtype) + 0.5, torch.arange(width, dtype=dtype) + 0.5, indexing="ij"
    )
    dx = xs[None] - means2d[:, 0, None, None]  # [N, h, W]
    dy = ys[None] - means2d[:, 1, None, None]
    a, b, c = (conics[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = torch.clamp_max(opacities[:, None, None] * torch.exp(-power), ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_CUT, alpha, torch.zeros_like(alpha))
    ones = torch.ones_like(xs)[None]
    before = torch.cumprod(torch.cat([ones, 1 - alpha]), 0)[:-1]
    alpha = torch.where((before > TRANSMITTANCE_MIN).detach(), alpha, torch.zeros_like(alpha))
    transmittance = torch.cumprod(torch.cat([ones, 1 - alpha]), 0)
    image = torch.einsum("nhw,nc->hwc", alpha * transmittance[:-1], colors)
    return image + transmittance[-1][..., None] * background, 1 - transmittance[-1]


def evaluate_sh(sh0: torch.Tensor, shN: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Return the colours [N, 3] of spherical harmonics: max(0, 0.5 + their sum)."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-10)).unbind(-1)
    basis = [torch.full_like(x, SH0)]
    bases = shN.shape[1] + 1
    if bases > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if bases > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if bases > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    coefficients = torch.cat([sh0, shN], 1)  # [N, K, 3]
    return torch.clamp_min((torch.stack(basis, -1)[..., None] * coefficients).sum(1) + 0.5, 0.0)
