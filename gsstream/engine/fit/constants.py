"""Constants of the optimisation that no recipe changes: rates of 3DGS, pruning and penalties.

The rates and the rules of pruning are those of 3DGS (Kerbl et al. 2023); the penalties are gsstream's own, and held-out
quality is why they are there.
"""

from __future__ import annotations

#: Opacity of a seed.
OPACITY = 0.1
#: Learning rates: raw quaternions, log scales, opacity logits, colour of degree 0 and of higher degrees.
LR_QUATS, LR_SCALES, LR_OPACITIES, LR_SH0, LR_SHN = 0.001, 0.005, 0.05, 0.0025, 0.000125
#: How many times smaller the learning rate of centres is at the last iteration than at the first (3DGS).
LR_MEANS_FALL = 100
#: Weight in the photometric loss of 1 - SSIM (3DGS).
DSSIM = 0.2
#: Adam learning rate of gate logits (released code of S2GS).
GATE_LR = 0.1
#: First iteration of densification and pruning, and iterations from one to the next: 500 and 100 in 3DGS, whose runs
#: are fifteen times as long.
DENSIFY_FROM, DENSIFY_EVERY = 300, 100
#: Mean screen gradient, in half image widths, above which a Gaussian is densified: 2e-4 in 3DGS.
#: Pictures wider than 320 pixels have a lower threshold (core/picture_size.py).
DENSIFY_GRADIENT = 3e-4
#: Share of the iterations after which nothing is densified or pruned any more.
DENSIFY_UNTIL = 0.6
#: Shares of the iterations after which Gaussians that the images would not miss are removed: when growth has ended,
#: and once more while there is time to close the gaps. Gaussians that are removed earlier grow again.
PRUNE_AT = (0.6, 0.8)
#: The same number where pictures of several sizes follow each other: detail is added until well into the largest size.
PYRAMID_DENSIFY_UNTIL, PYRAMID_PRUNE_AT = 0.8, (0.85,)
#: Gaussians below this opacity are removed, and those wider than this fraction of the rig's extent or, where that is
#: larger, this multiple of a seed of the shell: a rig may be small beside what it looks at.
PRUNE_OPACITY, MAX_SCALE, MAX_SHELL_SCALE = 0.01, 0.3, 1.5
#: Weights in the loss of the mean scale, in rig extents, and of the mean opacity.
SCALE_PENALTY, OPACITY_PENALTY = 0.1, 0.01
#: At most one seed per so many training pixels: more than the images can pin down overfit the training views.
PIXELS_PER_SEED = 64
