"""S2GS keeps the contract; where a released option breaks it, the part itself denies the check."""

from __future__ import annotations

from gsstream_s2gs.error_aware import ErrorAware
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid
from gsstream_s2gs.noise_normalised import NoiseNormalised
from gsstream_s2gs.octree import StreamingOctree
from gsstream_s2gs.selective_leaf import SelectiveLeaf
from gsstream_s2gs.view_gradient import ViewSpaceGradient

from gsstream.testing import parametrize_with_checks

Sparsity, Gate = ExpectedSparsity.Config, GumbelSigmoid.Config
Octree, Gradient = StreamingOctree.Config, ViewSpaceGradient.Config
RELEASED = Gradient(loss="l2norm", aggregate="sum-of-norms", normalisation="ratio")
#: Under other settings than their own; under those: tests/contract/test_shipped_plugins.py.
PARTS = [
    StreamingOctree(Octree(gate_level=2)), StreamingOctree(Octree(grouping="gaussian")),
    ViewSpaceGradient(RELEASED), ViewSpaceGradient(Gradient(normalisation="minmax")),
    ViewSpaceGradient(Gradient(aggregate="mean-vector", normalisation="ratio")),
    ViewSpaceGradient(Gradient(aggregate="mean-of-norms", normalisation="ratio")),
    ViewSpaceGradient(Gradient(normalisation="noise")), ViewSpaceGradient(Gradient(epsilon_mode="relative")),
    GumbelSigmoid(Gate(levels=1)), GumbelSigmoid(Gate(noise="none")),
    GumbelSigmoid(Gate(levels=1, clamp_gradient=True)), GumbelSigmoid(Gate(levels=1, noise="gumbel")),
    GumbelSigmoid(Gate(noise="gumbel")), GumbelSigmoid(Gate(clamp_gradient=True)),
    GumbelSigmoid(Gate(noise="none", clamp_gradient=True)),
    ExpectedSparsity(Sparsity(reduction="sum", motion="half-mean")),
    NoiseNormalised(NoiseNormalised.Config(probes=4)), ErrorAware(ErrorAware.Config(budget=0.0)),
    SelectiveLeaf(SelectiveLeaf.Config(suspect=-1.0, spread=1.0)),
]  # fmt: skip


@parametrize_with_checks(PARTS)
def test_contract(check) -> None:
    check()
