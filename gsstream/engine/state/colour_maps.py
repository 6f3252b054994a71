"""Colour maps of the training cameras, as they were fitted to the first frame and as they are now."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsstream.core.shapes import FloatArray
from gsstream.packet import StreamMeta
from gsstream.parts.render.exposure import Exposure

#: Where a key packet says by how much cameras have become brighter since the first frame.
GAINS = "gains"


def exposure_to_meta(exposure: Exposure | None) -> dict[str, Any]:
    """Return the colour maps of the training cameras as plain values, for the key packet."""
    if exposure is None:
        return {}
    return {"exposure": {"matrix": exposure.matrix.tolist(), "offset": exposure.offset.tolist()}}


def first_exposure(meta: StreamMeta) -> Exposure | None:
    """Return the colour maps that were fitted to the first frame, which every key packet holds."""
    stored = meta.extra.get("exposure")
    if stored is None:
        return None
    return Exposure(torch.tensor(stored["matrix"]), torch.tensor(stored["offset"]))


def gains_from_meta(meta: StreamMeta) -> FloatArray | None:
    """Return by how much cameras had become brighter at a key packet, [C, 3]; None where none had drifted alone."""
    stored = meta.extra.get(GAINS)
    return None if stored is None else np.array(stored, np.float32)


def exposure_from_meta(meta: StreamMeta) -> Exposure | None:
    """Return the colour maps at a key packet; an encoder, resumed or not, goes on from these values."""
    return exposure_with(first_exposure(meta), gains_from_meta(meta))


def exposure_with(first: Exposure | None, gains: FloatArray | None) -> Exposure | None:
    """Return colour maps as they are once cameras have become brighter by ``gains`` [C, 3]."""
    if gains is None:
        return first
    factors, known = torch.from_numpy(gains), first or Exposure.identity(len(gains))
    return Exposure(factors[:, :, None] * known.matrix, factors * known.offset)
