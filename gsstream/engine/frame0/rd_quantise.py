"""Rate-distortion quantisation of frame 0 (``codec.key_rd_lambda``) by the sensitivity of the training images.

Most Gaussians are small, half hidden or seen from one side, so most of their rotations, sizes and colours may be off by
several steps and no image shows it; most coefficients of view-dependent colour explain noise and go altogether. How far
a code may move is bounded, because other cameras may be sensitive where the training cameras are not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.axes import nearest_axes
from gsstream.engine.frame0.hutchinson import TrainingViews, hutchinson_samples
from gsstream.engine.frame0.rounding import rd_codes_nearby, rd_codes_to_zero
from gsstream.packet.grids import KEY_BITS, color_codes, color_grads, from_codes
from gsstream.parts.render.exposure import Exposure

#: How far a code may move, in steps of its grid: a colour by 0.04, an axis by 7 degrees, a scale by a factor of 2.7, an
#: opacity by a logit. View-dependent colour may be rounded to zero from any value.
REACH: Mapping[str, int] = {"quats": 8, "scales": 16, "opacities": 8, "sh0": 8}
#: Probes of a camera.
HUTCHINSON_SAMPLES = 2


def rd_quantise(
    assembly: Assembly, gaussians: Gaussians[torch.Tensor], frame: Frame, exposure: Exposure | None, rng: Rng
) -> Gaussians[torch.Tensor]:
    """Return Gaussians that look nearly the same and that a key packet holds in fewer bytes."""
    rows = nearest_axes(gaussians)
    rate = assembly.recipe.codec.key_rd_lambda
    if rate == 0 or len(rows) == 0:
        return rows
    sensitivity, error = code_sensitivity(
        assembly, rows, frame, exposure=exposure, generator=rng.stream("key rate", frame.index)
    )
    return Gaussians(
        means=rows.means,
        **{
            name: _rounded(name, values, sensitivity[name], rate * error)
            for name, values in rows.items()
            if name in KEY_BITS
        },
    )


def code_sensitivity(
    assembly: Assembly,
    gaussians: Gaussians[torch.Tensor],
    frame: Frame,
    exposure: Exposure | None,
    generator: torch.Generator,
) -> tuple[dict[str, FloatArray], float]:
    """Return the sensitivity of the training images to each code, and their mean squared error.

    Returns attribute -> [N, width] float64: squared change of all images together when a code is one higher.
    """
    sensitivity: dict[str, FloatArray] = {name: np.zeros(_flat(getattr(gaussians, name)).shape) for name in KEY_BITS}
    error = 0.0
    views = TrainingViews(assembly.renderer, frame, exposure, assembly.background)
    for probe in hutchinson_samples(views, gaussians, generator, each=HUTCHINSON_SAMPLES):
        error += probe.error
        for name, bits in KEY_BITS.items():
            grads = _flat(getattr(probe.grad, name))
            colors = name in ("sh0", "shN")
            sensitivity[name] += (color_grads(grads, bits) if colors else grads * 2.0**-bits) ** 2
    return {name: squares / HUTCHINSON_SAMPLES for name, squares in sensitivity.items()}, error / (
        HUTCHINSON_SAMPLES * len(frame.cameras)
    )


def _rounded(name: str, values: torch.Tensor, sensitivity: FloatArray, weight: float) -> torch.Tensor:
    bits = KEY_BITS[name]
    if name == "shN":
        codes = rd_codes_to_zero(color_codes(values.numpy(), bits), sensitivity, weight)
    elif name == "sh0":
        codes = rd_codes_nearby(color_codes(values.numpy(), bits), sensitivity, weight, REACH[name])
    elif name == "quats":
        codes = _unit_codes(
            rd_codes_nearby(_flat(values)[:, 1:] * 2.0**bits, sensitivity[:, 1:], weight, REACH[name]), bits
        )
    else:
        codes = rd_codes_nearby(_flat(values) * 2.0**bits, sensitivity, weight, REACH[name])
    return torch.from_numpy(from_codes(name, codes, bits)).reshape(values.shape)


def _unit_codes(others: IntArray, bits: int) -> IntArray:
    """[N, 4] int32 codes of unit quaternions whose first component, the largest, follows from the three others."""
    first = np.rint(np.sqrt(4.0**bits - (others.astype(np.float64) ** 2).sum(1)))
    return np.column_stack([first.astype(np.int32), others])


def _flat(values: torch.Tensor) -> FloatArray:
    """[N, width] float64."""
    return values.detach().numpy().astype(np.float64).reshape(len(values), -1)
