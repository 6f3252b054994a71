"""The names of a Gaussian's axes: another quaternion and other places of the scales, the same ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.gaussians import Gaussians
from gsstream.engine.frame0.axes import nearest_axes
from gsstream.parts.render.activations import rotation_matrices


def drawn(seed: int, rows: int = 200) -> Gaussians[torch.Tensor]:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(rows, 4)) * 10 ** rng.uniform(-3, 3, (rows, 1))
    return Gaussians(
        means=torch.zeros(rows, 3), quats=torch.from_numpy(quats).float(),
        scales=torch.from_numpy(rng.normal(-3, 2, (rows, 3))).float(), opacities=torch.zeros(rows),
        sh0=torch.zeros(rows, 1, 3), shN=torch.zeros(rows, 0, 3),
    )  # fmt: skip


def covariances(gaussians: Gaussians[torch.Tensor]) -> torch.Tensor:
    """[N, 3, 3] of the ellipsoids, of unit quaternions."""
    quats = gaussians.quats.double()
    turns = rotation_matrices(quats / quats.norm(dim=1, keepdim=True))
    return turns @ torch.diag_embed((2 * gaussians.scales.double()).exp()) @ turns.transpose(1, 2)


@given(st.integers(0, 10_000))
def test_the_ellipsoid_stays_and_the_first_component_is_large(seed: int) -> None:
    before = drawn(seed)
    after = nearest_axes(before)
    one, other = covariances(before), covariances(after)
    assert float(((one - other).abs().amax((1, 2)) / one.abs().amax((1, 2))).max()) < 1e-6
    assert float(after.quats.norm(dim=1).sub(1).abs().max()) < 1e-6
    # The farthest rotation from all 24 is 62.8 degrees away: half of it has a cosine of 0.8536.
    assert float(after.quats[:, 0].min()) >= 0.853
    assert torch.equal(after.scales.sort(1).values, before.scales.sort(1).values)


@given(st.integers(0, 10_000))
def test_all_names_of_one_ellipsoid_become_one_and_again_changes_nothing(seed: int) -> None:
    first = nearest_axes(drawn(seed, 20))
    again = nearest_axes(first)
    assert torch.allclose(first.quats, again.quats, atol=1e-6)
    assert torch.equal(first.scales, again.scales)


@pytest.mark.parametrize(
    "quat", [[1, 0, 0, 0], [0, 1, 0, 0], [0.5, -0.5, 0.5, -0.5], [0, 0, -0.70710677, 0.70710677], [-2, 0, 0, 0]]
)
def test_a_rotation_of_axes_to_axes_only_moves_scales(quat: list[float]) -> None:
    start = drawn(0, 1)
    turned = nearest_axes(Gaussians(**{**dict(start.items()), "quats": torch.tensor([quat], dtype=torch.float32)}))
    assert torch.allclose(turned.quats, torch.tensor([[1.0, 0, 0, 0]]), atol=1e-6)


def test_no_rows() -> None:
    assert len(nearest_axes(drawn(0, 0))) == 0
