"""The README says why no factor f is sent: whatever its residual moves, the offset's moves as well."""

from __future__ import annotations

import numpy as np
from gsstream_s2gs.latent import LatentResidual

from gsstream.core.changes import Delta, Layout, Residual, Scene, apply_delta
from gsstream.core.gaussians import Gaussians

ROWS = 400


def test_residuals_of_offset_and_factor_are_an_offset_to_half_a_symbol() -> None:
    """mu = h + o f, axis by axis, with residuals of both, through the packet's change and the plugin's step."""
    rng = np.random.default_rng(3)
    anchor, offset, more = (rng.normal(size=(ROWS, 3)) for _ in range(3))
    factor, wider = rng.lognormal(-2, 1, (ROWS, 3)), rng.lognormal(0, 0.3, (ROWS, 3))
    more[:100] = 0  # only the factor changes
    offset[:50] = 0  # and these lie at their anchors
    before, wanted = anchor + offset * factor, anchor + (offset + more) * (factor * wider)
    levels = rng.integers(0, 3, ROWS).astype(np.uint8)
    layout = Layout(np.ones(ROWS, np.int32), levels, np.array([0.2, 0.1, 0.05], np.float32))
    shapes = {"quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
    others = {name: np.zeros((ROWS, *shape), np.float32) for name, shape in shapes.items()}
    scene = Scene(Gaussians(means=before.astype(np.float32), **others), layout)
    step = LatentResidual().codes()["means"].step
    symbol = step * layout.units_of(np.arange(ROWS))[:, None]
    symbols = np.round((wanted - before) / symbol).astype(np.int32)
    residual = Residual(np.ones(ROWS, np.uint8), 1, {"means": symbols}, {"means": step})
    after = apply_delta(scene, Delta((residual,))).gaussians.means
    assert (np.abs(after - wanted) <= 0.5 * symbol + 1e-5).all()
    assert not symbols[:50].any(), "a factor moves nothing that lies at its anchor"
    assert symbols[50:100].any(axis=1).all()
