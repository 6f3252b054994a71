"""Confidence by lot: half of the gates above one half, others in every frame."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from gsstream_s2gs.uniform_random import UniformRandom
from s2gs_scene import context, gaussians, rig


def test_half_are_above_one_half_and_frames_differ() -> None:
    scene = gaussians(4000)
    case = context(scene, rig(0), [], [])
    z = UniformRandom().estimate(case)
    assert float((z > 0).float().mean()) == pytest.approx(0.5, abs=4 * 0.5 / 4000**0.5)
    # P(z > logit 0.9) = 0.1.
    assert float((z > 2.1972).float().mean()) == pytest.approx(0.1, abs=4 * 0.3 / 4000**0.5)
    assert not torch.equal(z, UniformRandom().estimate(dataclasses.replace(case, index=2)))
    assert torch.equal(z, UniformRandom().estimate(case))
