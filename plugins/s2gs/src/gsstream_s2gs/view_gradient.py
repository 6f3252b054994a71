"""View-space gradient difference: the gradient of the change between two frames by the projected means."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, final

import torch
from pydantic import Field, model_validator

from gsstream.api import ConfidenceEstimator, ConfidenceTraits, FrameContext, PartConfig, Rng, check_finite
from gsstream_s2gs.normalise import minmax, noise_units, ratio, robust

#: Logits are kept in [-LIMIT, LIMIT].
LIMIT = 50.0
#: Under the root of ``loss: l2norm``, image units^2, lest 0 be divided by 0.
DISTANCE_EPSILON = 1e-12
#: Multiple of the noise at which z is 0 (``normalisation: noise``).
NOISE_THRESHOLD = 3.0
#: Least noise of a camera, image units: 8-bit rounding of two frames.
NOISE_MINIMUM = 0.4 / 255


@final
class ViewSpaceGradient(ConfidenceEstimator):
    """z_i = (|m_i| - median|m|) / (MAD|m| + eps), m the view-space gradient difference (paper, equation for p_i).

    m_i = mean over views of d(E_t - E_{t-1}) / d mu_i, where E compares the render of frame t-1 with either
    ground truth and mu_i is the projected centre (paper, appendix "Dynamic Confidence Estimator"). Both losses see the
    same render, so the difference is formed before the one backward pass per view; for the squared loss the render
    itself cancels and is never needed: the upstream gradient is 2 (gt_{t-1} - gt_t) / (3 H W).

    The result is z itself, not sigmoid(z); MAD is the plain median absolute deviation (no 1.4826, as printed).
    Medians are taken over the Gaussians that a change touches (|m| > 0; ``statistics: touched``). The engine asks for
    gradients of the tiles that changed alone, so most of the Gaussians that a camera sees have |m| = 0 exactly; counted
    with the others, as ``statistics: seen`` does, they make median and MAD zero, and every touched Gaussian saturates.
    Gaussians that no change touches get ``floor`` (the printed formula would give p = 0.5 in a frame without change),
    and with ``statistics: touched`` no other gets less.

    The absolute epsilon of the paper acts in the units of m: here gradients of a mean over all pixels with respect to
    positions in half image widths (as in the released code). Then |m| is well below epsilon nearly everywhere, most
    logits start near 0 and the optimisation decides. ``epsilon_mode: relative`` removes the dependence on units.

    Released code: m is a sum over views of norms, E the mean per-pixel Euclidean distance, p = m / (m + median):
    ``loss: l2norm``, ``aggregate: sum-of-norms``, ``normalisation: ratio``.
    """

    source = "S2GS, equation for p_i"

    class Config(PartConfig):
        loss: Literal["mse", "l2norm"] = Field(
            default="mse", description="E; mse: paper; l2norm: mean Euclidean distance of pixel colours (released code)"
        )
        aggregate: Literal["mean-vector", "sum-of-norms", "mean-of-norms"] = Field(
            default="mean-vector",
            description="over views; mean-vector: norm of the mean gradient (paper); sum-of-norms: released; "
            "mean-of-norms: mean norm over the views that see the Gaussian",
        )
        units: Literal["ndc", "pixel"] = Field(
            default="ndc", description="gradients per half image (pixel gradient * (W/2, H/2), released) or per pixel"
        )
        normalisation: Literal["robust", "ratio", "minmax", "noise"] = Field(
            default="robust",
            description="robust: paper; ratio: ln(m / median), released; minmax: paper's ablation; "
            "noise: m in units of what camera noise alone would give, minus three of them",
        )
        statistics: Literal["touched", "seen"] = Field(
            default="touched",
            description="whose median and MAD; touched: Gaussians that a change moves; seen: all that a camera sees",
        )
        epsilon: float = Field(
            default=2e-4, ge=0, le=1e6, description="added to the MAD (robust); paper: 2e-4, in units of |m|"
        )
        epsilon_mode: Literal["absolute", "relative"] = Field(
            default="absolute", description="absolute: paper; relative: epsilon * (median + MAD)"
        )
        perturbation: float = Field(
            default=0.0,
            ge=0,
            le=100,
            description="noise added to |m| in standard deviations of |m|, floored at 0 (paper's robustness table)",
        )
        seed: int = Field(default=0, ge=0, description="seed of perturbation and noise probes")
        floor: float = Field(
            default=-math.log(1000.0), ge=-50, le=0, description="logit where nothing changes, -50 to 0"
        )

        @model_validator(mode="after")
        def _combinations(self) -> ViewSpaceGradient.Config:
            if self.normalisation == "noise" and self.loss != "mse":
                raise ValueError(
                    f"normalisation noise: expected loss mse (noise passes through it linearly), got {self.loss}; "
                    "set loss: mse or another normalisation"
                )
            if self.normalisation == "noise" and self.perturbation > 0:
                raise ValueError("normalisation noise: expected perturbation 0, got more; use robust, ratio or minmax")
            return self

    traits = ConfidenceTraits(needs_renderer=True, finds_motion=True, monotone_in_change=True)

    def claims(self) -> ConfidenceTraits:
        # A change that is normalised by its own statistics may look weaker as all others grow; so only the default
        # setting is checked to rise.
        rises = self.config.normalisation == "robust"
        return replace(
            self.traits, floor=self.config.floor, monotone_in_change=rises, brightness=2.0 if rises else None
        )

    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Logits [N] float32 in [-LIMIT, LIMIT]. Raises ShapeError when a gradient is not finite."""
        config = self.config
        # Where the result does not depend on which Gaussians are seen, only those that a change reaches are computed.
        few = config.aggregate == "mean-vector" and config.statistics == "touched" and config.normalisation != "noise"
        rows, magnitude, expected, seen = self._reached(context) if few else (None, *self._magnitudes(context))
        number = len(context.gaussians.means)
        logits = magnitude.new_full((number,), config.floor)
        if not bool((magnitude > 0).any()):
            return logits.float()
        if config.statistics == "touched":
            seen = magnitude > 0
        values = self._perturb(magnitude[seen], context.index)
        if config.normalisation == "robust":
            chosen = robust(values, config.epsilon, config.epsilon_mode == "relative", LIMIT)
        elif config.normalisation == "ratio":
            chosen = ratio(values, config.floor, LIMIT)
        elif config.normalisation == "minmax":
            chosen = minmax(values, LIMIT)
        else:
            chosen = noise_units(values, expected[seen], NOISE_THRESHOLD, config.floor)
        # A Gaussian that a change touches never gets a lower logit than one that no change touches.
        least = config.floor if config.statistics == "touched" else -LIMIT
        logits[seen if rows is None else rows[seen]] = chosen.clamp(least, LIMIT)
        return logits.float()

    def _reached(self, context: FrameContext) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rows [K] that a change reaches, ascending, and of them what :meth:`_magnitudes` says of all, to the bit."""
        means = context.gaussians.means
        total = torch.zeros(len(means), 2, dtype=torch.float64, device=means.device)
        reached = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        views = len(context.cameras)
        for view in range(views):
            found = context.screen_gradient_rows(view, self._upstream(context, view))
            total[found.rows] += self._scaled(context, view, found.gradient)
            reached.index_fill_(0, found.rows, True)
        rows = reached.nonzero()[:, 0]
        magnitude = total[rows].norm(dim=1) / max(views, 1)
        return rows, magnitude, torch.zeros_like(magnitude), torch.ones_like(rows, dtype=torch.bool)

    def _magnitudes(self, context: FrameContext) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """|m| [N] float64, the same expected from noise alone (zeros unless asked for), and who is seen [N] bool."""
        means = context.gaussians.means
        total = torch.zeros(len(means), 2, dtype=torch.float64, device=means.device)
        norms, noise = total[:, 0].clone(), total[:, 0].clone()
        count = torch.zeros(len(means), dtype=torch.int64, device=means.device)
        views = len(context.cameras)
        for view in range(views):
            gradient, visible = self._gradient(context, view, self._upstream(context, view))
            total += gradient
            norms += gradient.norm(dim=1)
            count += visible
            if self.config.normalisation == "noise":
                probe = self._gradient(context, view, self._noise_upstream(context, view))[0].norm(dim=1)
                noise += probe.square() if self.config.aggregate == "mean-vector" else probe
        if self.config.aggregate == "mean-vector":
            return total.norm(dim=1) / max(views, 1), noise.sqrt() / max(views, 1), count > 0
        divisor = count.clamp_min(1) if self.config.aggregate == "mean-of-norms" else 1
        return norms / divisor, noise / divisor, count > 0

    def _gradient(self, context: FrameContext, view: int, upstream: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """One backward pass: [N, 2] in the chosen units, float64 (float32 squares vanish below 1e-23); [N] bool."""
        gradient, visible = context.screen_gradient(view, upstream)
        return self._scaled(context, view, gradient) * visible[:, None], visible

    def _scaled(self, context: FrameContext, view: int, gradient: torch.Tensor) -> torch.Tensor:
        """Gradients [K, 2] per pixel in the chosen units, float64."""
        check_finite(f"screen gradient of view {view} at frame {context.index}", gradient)
        result = gradient.double()
        if self.config.units == "ndc":
            # Width and height are plain numbers: a tensor of them would be copied to the device, which takes a wait.
            across, down = result.unbind(1)
            result = torch.stack([across * (context.cameras.width / 2), down * (context.cameras.height / 2)], 1)
        return result

    def _upstream(self, context: FrameContext, view: int) -> torch.Tensor:
        """[H, W, 3] derivative of E_t - E_{t-1} with respect to the render of frame t-1."""
        if self.config.loss == "mse":
            change = context.image_change(view)
            return change.mul_(-2 / change.numel())
        now, before = context.image(view), context.previous_image(view)
        render = context.previous_render(view)
        pixels = before.shape[0] * before.shape[1]
        return (self._direction(render - now) - self._direction(render - before)) / pixels

    def _direction(self, difference: torch.Tensor) -> torch.Tensor:
        """Derivative of sqrt(|d|^2 + eps): d over that root; 0 where render and ground truth agree."""
        epsilon = DISTANCE_EPSILON
        return difference / (difference.square().sum(-1, keepdim=True) + epsilon).sqrt()

    def _noise_upstream(self, context: FrameContext, view: int) -> torch.Tensor:
        """The upstream gradient that the camera's noise alone could have given: one seeded draw."""
        before = context.previous_image(view)
        # The random stream is named after the camera, so that its noise does not depend on the order of cameras.
        name = context.cameras.ids[view]
        generator = Rng(self.config.seed).stream(f"s2gs/view-gradient/noise/{name}", context.index)
        draw = torch.randn(before.shape, generator=generator, dtype=before.dtype).to(before.device)
        sigma: float = max(context.noise_sigma(view), NOISE_MINIMUM)
        return 2 * sigma * draw / before.numel()

    def _perturb(self, values: torch.Tensor, index: int) -> torch.Tensor:
        """max(|m| + a std(|m|) n, 0), n standard normal (paper, equation for the noisy VGD; on norms, so that the floor
        at 0 has a meaning)."""
        strength = self.config.perturbation
        if strength == 0:
            return values
        generator = Rng(self.config.seed).stream("s2gs/view-gradient/perturbation", index)
        draw = torch.randn(len(values), generator=generator, dtype=torch.float64).to(values.device)
        return (values + strength * values.std(correction=0) * draw).clamp_min(0)
