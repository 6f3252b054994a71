"""Worst relative errors of the stages of the method and of the stream, against float64, integers or fractions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from fractions import Fraction

import numpy as np
import torch
from gsstream_s2gs import morton
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid, logistic
from gsstream_s2gs.hierarchical import HierarchicalMax
from gsstream_s2gs.latent import LatentResidual
from gsstream_s2gs.normalise import robust
from gsstream_s2gs.octree import StreamingOctree
from numeric_scenes import camera, random_scene, upstream, worst
from residual_oracle import train_rows

from gsstream.core.changes import Delta, Layout, Residual, Scene, apply_delta
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.packet.grids import KEY_BITS, from_codes, to_codes
from gsstream.packet.symbols import decode_symbols, encode_symbols
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.residual.adam_state import ADAM_BETAS, ADAM_EPS, AdamState
from gsstream.parts.residual.rate import channel_spread, laplace_gradient
from gsstream.parts.update.base import init_latents

Measure = Callable[[int], float]


def difference_of_gradients(seed: int) -> float:
    """One backward pass of an image difference in float32, against the difference of two in float64."""
    scene, cameras = random_scene(seed), camera()
    now, before = upstream(cameras, seed).sigmoid(), upstream(cameras, seed + 1).sigmoid()
    renderer, double = ReferenceRenderer(), scene.map(torch.Tensor.double)
    got = renderer.screen_gradient(scene, cameras, 0, 2 * (before - now) / now.numel()).gradient
    shown = renderer.render(double, cameras, 0, (0.0, 0.0, 0.0)).image
    losses = [2 * (shown - picture.double()) / now.numel() for picture in (now, before)]
    parts = [renderer.screen_gradient(double, cameras, 0, loss).gradient for loss in losses]
    return worst(got, parts[0] - parts[1])


def normalisation(seed: int) -> float:
    """(m - median) / (MAD + epsilon), against fractions."""
    rng = np.random.default_rng(seed)
    values = np.exp(rng.normal(scale=3, size=21 + seed % 2)) * 10.0 ** rng.integers(-30, 30)
    got = robust(torch.from_numpy(values), 1e-3, True, 1e300).numpy()

    def median(ordered: list[Fraction]) -> Fraction:
        ordered = sorted(ordered)
        return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2

    exact = [Fraction(float(value)) for value in values]
    center = median(exact)
    spread = median([abs(value - center) for value in exact])
    scale = spread + Fraction(1e-3) * (center + spread)
    want = [float((value - center) / scale) for value in exact]
    return max(abs(g - w) / max(1.0, abs(w)) for g, w in zip(got, want, strict=True))


def propagation(seed: int) -> float:
    g = torch.Generator().manual_seed(seed)
    node_of = torch.randint(0, 7, (50,), generator=g)
    logits = torch.randn(50, generator=g) * 10.0 ** (seed % 9 - 4)
    got = HierarchicalMax().propagate(logits, Hierarchy(node_of, torch.arange(7), torch.zeros(7, dtype=torch.int64)))
    want = [
        max((x for x, n in zip(logits.tolist(), node_of.tolist(), strict=True) if n == node), default=-50.0)
        for node in range(7)
    ]
    return worst(got, torch.tensor(want))


def _relative(got: torch.Tensor, want: torch.Tensor, scale: torch.Tensor | float = 1.0) -> float:
    """Largest error of any entry relative to ``scale``."""
    return float(((got.double() - want).abs() / scale).max())


def gate_gradient(seed: int) -> float:
    """The straight-through gradient, over logits and temperatures whose gradient float32 can hold."""
    tau = (0.1, 0.3, 1.0, 10.0, 100.0)[seed % 5]
    logits = torch.linspace(-70 * tau, 70 * tau, 501)
    leaf = logits.clone().requires_grad_()
    gates = GumbelSigmoid(GumbelSigmoid.Config(temperature=tau)).sample(leaf, None)
    (got,) = torch.autograd.grad(gates.sum(), leaf)
    x = logits.double() / tau
    # Above x = 0 written by exp(-x) alone: s (1 - s) loses its digits there in float64 too.
    decay = torch.exp(-x.abs())
    want = decay / (1 + decay).square() / tau
    return _relative(got, want, want * x.abs().clamp_min(1.0))


def noise(seed: int) -> float:
    u = torch.cat([torch.rand(500, generator=torch.Generator().manual_seed(seed)), torch.tensor([0.0, 1 - 2.0**-24])])
    want = [
        math.log(Fraction(x) + Fraction(1, 2**25)) - math.log(1 - Fraction(x) - Fraction(1, 2**25)) for x in u.tolist()
    ]
    exact = torch.tensor(want, dtype=torch.float64)
    return _relative(logistic(u), exact, exact.abs().clamp_min(1.0))


def open_probability(seed: int) -> float:
    part = GumbelSigmoid(GumbelSigmoid.Config(levels=(1, 10, 255)[seed % 3]))
    logits = torch.linspace(-20, 20, 301)
    got = part.open_probability(logits)
    eta = 0.5 / part.num_levels
    margin = logits.double() - 0.3 * math.log(eta / (1 - eta))
    want = 1 / (1 + torch.exp(-margin))
    return _relative(got, want, want * margin.abs().clamp_min(1.0))


def rounding(seed: int) -> float:
    """Distance of a gate from the value the decoder computes for its level."""
    levels = 1 + seed * 37 % 255
    gates = GumbelSigmoid(GumbelSigmoid.Config(levels=levels)).sample(torch.linspace(-6, 6, 999), None)
    integers = np.rint(gates.numpy() * levels).astype(np.uint8)
    return float(np.abs(gates.numpy() - integers.astype(np.float32) / np.float32(levels)).max())


def regulariser(seed: int) -> float:
    g = torch.Generator().manual_seed(seed)
    n, m = 20_000, 300
    node_of = torch.randint(0, m, (n,), generator=g)
    probability, residual = torch.rand(m, generator=g), torch.randn(n, 3, generator=g)
    hierarchy = Hierarchy(node_of, torch.arange(m), torch.zeros(m, dtype=torch.int64))
    terms = ExpectedSparsity().penalty(probability, residual, hierarchy, n)
    p = probability.double().numpy()[node_of.numpy()]
    want = {
        "sparsity": 0.01 * math.fsum(p) / n,
        "motion": 0.01 * math.fsum(p * residual.double().square().sum(1).numpy()) / n,
    }
    return max(abs(float(terms[name]) - value) / value for name, value in want.items())


def _change(
    seed: int, kind: torch.dtype
) -> tuple[Gaussians[torch.Tensor], torch.Tensor, dict[str, torch.Tensor], dict[str, torch.Tensor], torch.Tensor]:
    """Gaussians, gates, latents on their grid, decoders and cells."""
    g = torch.Generator().manual_seed(seed)
    rule, scene = LatentResidual(), random_scene(seed)
    decoders = rule.init_decoders(scene, g)
    latents = {
        name: torch.round(4 * torch.randn(value.shape, generator=g)) * rule.codes()[name].step
        for name, value in init_latents(rule.codes(), scene).items()
    }
    gates, units = torch.randint(1, 11, (len(scene),), generator=g) / 10, torch.rand(len(scene), generator=g) + 0.1
    as_kind = [{name: value.to(kind) for name, value in table.items()} for table in (latents, decoders)]
    return scene.map(lambda v: v.to(kind)), gates.to(kind), as_kind[0], as_kind[1], units.to(kind)


def decoders(seed: int) -> float:
    found = {}
    for kind in (torch.float32, torch.float64):
        scene, gates, latents, matrices, units = _change(seed, kind)
        zero = scene.map(torch.zeros_like)
        found[kind] = train_rows(LatentResidual(), zero, gates, latents, matrices, units)
    pairs = zip(found[torch.float32].items(), found[torch.float64].items(), strict=True)
    return max(worst(a, b) for (_, a), (_, b) in pairs)


def application(seed: int) -> float:
    """What encoder and player compute from the integers, against the trained map in float64."""
    rule = LatentResidual()
    scene, gates, latents, matrices, units = _change(seed, torch.float64)
    want = train_rows(rule, scene, gates, latents, matrices, units)
    n = len(scene)
    symbols = {k: torch.round(v / rule.codes()[k].step).to(torch.int32).numpy() for k, v in latents.items()}
    steps = {name: rule.codes()[name].step for name in symbols}
    layout = Layout(np.ones(n, np.int32), np.arange(n).astype(np.uint8), units.float().numpy())
    levels = torch.round(gates * 10).numpy().astype(np.uint8)
    delta = Delta((Residual(levels, 10, symbols, steps, {k: v.float().numpy() for k, v in matrices.items()}),))
    got = apply_delta(Scene(scene.map(lambda v: v.float().numpy()), layout), delta).gaussians
    return max(worst(torch.from_numpy(a), b) for (_, a), (_, b) in zip(got.items(), want.items(), strict=True))


def rate(seed: int) -> float:
    latents = torch.randn(300, 4, generator=torch.Generator().manual_seed(seed)) * 10.0 ** (seed % 5 - 2)
    got = laplace_gradient(latents, 0.5, channel_spread(latents, 0.5))
    double = latents.double()
    return worst(got, laplace_gradient(double, 0.5, channel_spread(double, 0.5)))


def quantiser(seed: int) -> float:
    """Largest distance of a decoded value from what was given, in steps; colours in the steps of their luma."""
    scene, found = random_scene(seed).map(lambda value: value.numpy()), 0.0
    for name, bits in KEY_BITS.items():
        if name in ("scales", "opacities"):
            value = getattr(scene, name).reshape(len(scene), -1)
            back = from_codes(name, to_codes(name, value, bits), bits)
            found = max(found, float(np.abs(back - value.astype(np.float64)).max()) * 2.0**bits)
    return found


def coder(seed: int) -> float:
    rng = np.random.default_rng(seed)
    table = np.rint(rng.standard_cauchy((500, 3)) * 10.0 ** (seed % 6)).clip(-(2**31), 2**31 - 1).astype(np.int32)
    return float((decode_symbols(encode_symbols(table), 500, 3) != table).sum())


def keys(seed: int) -> float:
    cells = torch.randint(0, 1 << 21, (500, 3), generator=torch.Generator().manual_seed(seed))
    return float((morton.decode(morton.encode(cells)) != cells).sum())


def anchors(seed: int) -> float:
    """Distance of every point to the nearest anchor of the root grid along an axis beyond half a cell, by the cube."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-6, 6)
    xyz = (rng.random((60, 3)) * size).astype(np.float32)
    part = StreamingOctree(StreamingOctree.Config(root_exponent=5, max_levels=1))
    found = part.seed(PointCloud(xyz, np.zeros_like(xyz), "random"), camera())
    cell = float(found.cell_sizes[0])
    gap = (torch.from_numpy(xyz).double()[:, None] - found.positions.double()[None]).abs().amax(2).amin(1)
    return max(0.0, float(gap.max()) - cell / 2) / (cell * 2**5)


def adam(part: RowOptimiser, seed: int) -> float:
    """Ten steps with gradients over forty decades, against float64 by the book."""
    rng = np.random.default_rng(seed)
    values, state = torch.zeros(24, 3), None
    state = AdamState.start(values)
    first, second, want = (np.zeros((24, 3)) for _ in range(3))
    size = 10.0 ** rng.integers(-18, 16, (24, 1))
    for count in range(1, 11):
        gradient = torch.from_numpy((rng.normal(size=(24, 3)) * size).astype(np.float32))
        part.step({"x": values}, {"x": gradient}, {"x": state}, {"x": 0.1})
        exact = gradient.double().numpy()
        first = ADAM_BETAS[0] * first + (1 - ADAM_BETAS[0]) * exact
        second = ADAM_BETAS[1] * second + (1 - ADAM_BETAS[1]) * exact**2
        bottom = np.sqrt(second / (1 - ADAM_BETAS[1] ** count)) + ADAM_EPS
        want -= 0.1 * first / (1 - ADAM_BETAS[0] ** count) / bottom
    return worst(values, torch.from_numpy(want))


def method_measures() -> Mapping[str, Measure]:
    """Stage -> measurement."""
    measures: dict[str, Measure] = {
        "view-space gradient difference": difference_of_gradients,
        "robust normalisation": normalisation,
        "propagation": propagation,
        "gate gradient": gate_gradient,
        "gate noise": noise,
        "open probability": open_probability,
        "rounding of gates": rounding,
        "regulariser": regulariser,
        "decoders": decoders,
        "application of a delta": application,
        "rate": rate,
        "quantiser": quantiser,
        "coder": coder,
        "octree keys": keys,
        "octree anchors": anchors,
        "optimiser (reference)": lambda seed: adam(ReferenceAdam(), seed),
    }
    try:
        from gsstream_cpu_render.renderer import CpuAdam
    except ImportError:
        return measures
    return measures | {"optimiser (cpu)": lambda seed: adam(CpuAdam(), seed)}
