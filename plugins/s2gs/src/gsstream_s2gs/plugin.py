"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, MethodSpec, hookimpl

COMPONENTS = [
    ComponentSpec(
        kind="structure",
        name="octree",
        target="gsstream_s2gs.octree:StreamingOctree",
        summary="anchors on an octree; Gaussians of one root cell share a gate",
    ),
    ComponentSpec(
        kind="confidence",
        name="view-gradient",
        target="gsstream_s2gs.view_gradient:ViewSpaceGradient",
        summary="change of the view-space gradient between two frames, robustly normalised",
    ),
    ComponentSpec(
        kind="confidence",
        name="uniform-random",
        target="gsstream_s2gs.uniform_random:UniformRandom",
        summary="confidence by lot (ablation)",
    ),
    ComponentSpec(
        kind="propagation",
        name="hierarchical-max",
        target="gsstream_s2gs.hierarchical:HierarchicalMax",
        summary="maximum over each tree, shared by all its nodes",
    ),
    ComponentSpec(
        kind="gate",
        name="gumbel-sigmoid",
        target="gsstream_s2gs.gumbel_sigmoid:GumbelSigmoid",
        summary="binary concrete gate, rounded to levels with a straight-through gradient",
    ),
    ComponentSpec(
        kind="regularizer",
        name="expected-sparsity",
        target="gsstream_s2gs.expected_sparsity:ExpectedSparsity",
        summary="expected L0 of the gates plus L2 of the position residuals behind them",
    ),
    ComponentSpec(
        kind="update",
        name="latent",
        target="gsstream_s2gs.latent:LatentResidual",
        summary="quantised latents with compact linear decoders",
    ),
]

METHODS = [
    MethodSpec(name="s2gs", recipe="gsstream_s2gs:recipes/s2gs.yaml", summary="S2GS-full: 20 epochs"),
    MethodSpec(name="s2gs-fast", recipe="gsstream_s2gs:recipes/s2gs-fast.yaml", summary="S2GS-fast: 10 epochs"),
    MethodSpec(name="s2gs-edge", recipe="gsstream_s2gs:recipes/s2gs-edge.yaml", summary="S2GS-edge: 6 epochs"),
    MethodSpec(
        name="s2gs-paper",
        recipe="gsstream_s2gs:recipes/s2gs-paper.yaml",
        summary="the letter of the paper: gate noise, no active set",
    ),
]


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """Declare the parts of S2GS, and a variant to ablate it."""
    return list(COMPONENTS)


@hookimpl
def gsstream_methods() -> list[MethodSpec]:
    """The three budgets of the paper, and its letter."""
    return list(METHODS)
