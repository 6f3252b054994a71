"""What a gate sampler promises."""

from __future__ import annotations

from itertools import pairwise

import torch

from gsstream.parts.gate.base import AnalyticGate, GateSampler
from gsstream.testing.cases import World, get_case
from gsstream.testing.compare import (
    ROUNDING,
    Behaviour,
    Outputs,
    all_equal,
    at_most,
    draw,
    equal,
    finite,
    has_shape,
    poisons_of,
)
from gsstream.testing.registry import check

DRAWS = 4096
PROBABILITIES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)


def _spread() -> torch.Tensor:
    """[241] logits from -6 to 6."""
    return torch.linspace(-6, 6, 241)


def _sample(part: GateSampler, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
    gates = part.sample(logits, noise)
    has_shape("sample()", gates, tuple(logits.shape))
    return gates


def _samples(part: GateSampler, logits: torch.Tensor) -> list[tuple[str, torch.Tensor]]:
    noise = draw(part, len(logits))
    drawn = [] if noise is None else [("with noise", _sample(part, logits, noise))]
    return [("without noise", _sample(part, logits, None)), *drawn]


@check("gate")
def check_gate_range_and_levels(part: GateSampler) -> None:
    """Every value is exactly k / num_levels with 0 <= k <= num_levels, as the decoder computes it."""
    levels = part.num_levels
    assert 1 <= levels <= 255, f"num_levels: expected 1 to 255, got {levels}"
    for how, gates in _samples(part, part.init(_spread())):
        k = torch.round(gates * levels)
        at_most(f"{how}: levels", k, float(levels), tolerance=0.0, why="a gate is at most fully open")
        at_most(f"{how}: negated levels", -k, 0.0, tolerance=0.0, why="a gate is at least closed")
        equal(f"{how}: k / num_levels", gates.detach(), k / torch.tensor(float(levels)))


@check("gate")
def check_gate_init_calibrated(part: GateSampler) -> None:
    """A fresh gate opens at least as probably as the confidence says; a stochastic binary one, exactly so."""
    p = torch.linspace(0.01, 0.99, 99)
    logits = part.init(torch.logit(p))
    opened = part.open_probability(logits)
    at_most("confidence against open probability", p, opened, tolerance=1e-4, why=ROUNDING)
    if part.num_levels == 1 and part.claims().stochastic:
        equal("open probability of a binary gate", opened, p, tolerance=1e-4, why=ROUNDING)


@check("gate", trait="stochastic")
def check_gate_calibration(part: GateSampler) -> None:
    """Over 4096 draws the share of open gates is the open probability, within 4 standard deviations."""
    for p in PROBABILITIES:
        logits = part.init(torch.logit(torch.tensor(p)).expand(DRAWS).clone())
        expected = float(part.open_probability(logits)[0])
        got = float((_sample(part, logits, draw(part, DRAWS)) > 0).float().mean())
        sigma = max(expected * (1 - expected), 1 / DRAWS) ** 0.5 / DRAWS**0.5
        assert abs(got - expected) <= 4 * sigma, (
            f"confidence {p}: expected a share of {expected:.4f} open gates, got {got:.4f}; "
            f"tolerance {4 * sigma:.4f} is 4 sigma of {DRAWS} draws"
        )


@check("gate", trait="stochastic")
def check_gate_stochastic(part: GateSampler) -> None:
    """With noise, gates vary from draw to draw."""
    logits = part.init(torch.zeros(256))
    first, second = (_sample(part, logits, draw(part, 256, seed)) for seed in (1, 2))
    differ = int((first != second).sum())
    assert differ > 0, "gates of confidence 0.5 are the same in two draws of 256: the noise has no effect"


@check("gate", trait="stochastic")
def check_gate_noise_is_data(part: GateSampler) -> None:
    """Sampling is a function of (logits, noise); permuted noise permutes the gates; 65536 draws are finite."""
    logits = part.init(_spread())
    noise = draw(part, len(logits))
    assert noise is not None, "claims to be stochastic, but noise is None"
    order = torch.randperm(len(noise), generator=torch.Generator().manual_seed(9))
    gates = _sample(part, logits, noise)
    equal("the same noise again", _sample(part, logits, noise), gates)
    equal("permuted rows and noise", _sample(part, logits[order], noise[order]), gates[order])
    many = draw(part, 65536)
    assert many is not None
    finite("65536 draws", many)


@check("gate")
def check_gate_monotone(part: GateSampler) -> None:
    """A larger logit lowers neither the gate (same noise) nor the open probability."""
    low, high = part.init(_spread()), part.init(_spread() + 0.5)
    at_most("open probability", part.open_probability(low), part.open_probability(high), tolerance=1e-6, why=ROUNDING)
    for (how, less), (_, more) in zip(_samples(part, low), _samples(part, high), strict=True):
        at_most(f"gates {how}", less, more.detach(), tolerance=1e-6, why=ROUNDING)


@check("gate", trait="differentiable")
def check_gate_gradient_flow(part: GateSampler) -> None:
    """The gradient is finite, never negative, and alive for nine in ten logits within +-1, hard gates included."""
    logits = torch.linspace(-1, 1, 101, requires_grad=True)
    for how, gates in _samples(part, logits):
        assert gates.requires_grad, f"gates {how} carry no gradient"
        (gradient,) = torch.autograd.grad(gates.sum(), logits)
        finite(f"gradient {how}", gradient)
        at_most(f"negated gradient {how}", -gradient, 0.0, tolerance=0.0, why="a gate never closes as its logit rises")
        if how == "without noise":
            alive = float((gradient > 0).float().mean())
            assert alive >= 0.9, f"gradient {how}: alive for {alive:.2f} of all |logits| <= 1; expected 0.9"


@check("gate")
def check_gate_extremes(part: GateSampler) -> None:
    """Logits of +-20, 100, 1e4 and the ends of float32: gates open, probabilities and gradients finite."""
    for far in (20.0, 100.0, 1e4, 3e38):
        ends = torch.tensor([-far, far])
        for start in (part.init(ends), ends):
            logits = start.detach().clone().requires_grad_(True)
            finite(f"open probability at +-{far:g}", part.open_probability(logits))
            opened = float(_sample(part, logits, None)[1].detach())
            assert opened == 1.0, f"logit {far:g}: expected a gate of exactly 1.0, got {opened!r}"
            for how, gates in _samples(part, logits):
                finite(f"gates {how} at +-{far:g}", gates)
                total = (gates + part.open_probability(logits)).sum()
                if total.requires_grad:
                    (gradient,) = torch.autograd.grad(total, logits)
                    finite(f"gradient {how} at +-{far:g}", gradient)


@check("gate", trait="temperature")
def check_gate_temperature_limit(part: GateSampler) -> None:
    """As the temperature falls (1, 0.3, 0.1), gates do not move away from 0 and 1."""
    distances = []
    for temperature in (1.0, 0.3, 0.1):
        colder = type(part)(part.config.model_copy(update={"temperature": temperature}))
        gates = colder.sample(colder.init(_spread()), None)
        distances.append(float(torch.minimum(gates, 1 - gates).mean()))
    fine = all(b <= a + 1e-6 for a, b in pairwise(distances))
    assert fine, f"mean distance to 0 or 1 at temperatures 1, 0.3, 0.1: {distances}; expected no rise (1e-6: float32)"


@check("gate")
def check_gate_deterministic_is_final(part: GateSampler) -> None:
    """The transmitted gate, sample(logits, None), does not depend on gradients being recorded."""
    logits = part.init(_spread()).detach()
    with torch.no_grad():
        quiet = _sample(part, logits, None)
    recorded = _sample(part, logits.clone().requires_grad_(True), None).detach()
    equal("gates with gradients recorded", recorded, quiet)


@check("gate")
def check_gate_clamp(part: GateSampler) -> None:
    """Bounds are a projection: bounding twice is bounding once, and a fresh logits is within them."""
    fresh = part.init(_spread() * 10)
    equal("bound(init(z))", part.bound(fresh), fresh)
    once = part.bound(_spread() * 10)
    equal("bound(bound(z))", part.bound(once), once)
    at_most("order of bounded logits", once[:-1], once[1:], tolerance=0.0, why="bounds keep the order")


@check("gate")
def check_gate_state_resume(part: GateSampler) -> None:
    """A gate has no state but its logits, a float32 tensor with one per node: a copy of it gives the same gates."""
    start = get_case("cloud").logits
    logits = part.init(start)
    assert type(logits) is torch.Tensor, f"init(): expected a plain torch.Tensor, got {type(logits).__name__}"
    got = tuple(logits.shape)
    assert got == (len(start),), f"init(): expected one logit per node, shape [{len(start)}], got {list(got)}"
    copy = torch.from_numpy(logits.detach().numpy().copy())
    all_equal("gates of copied logits", dict(_samples(part, copy)), dict(_samples(part, logits)))


@check("gate")
def check_gate_form(part: GateSampler) -> None:
    """A gate that states a closed form keeps to it: gates, probabilities, their derivatives, bounds, and no noise."""
    form = part.form()
    if not isinstance(form, AnalyticGate):
        return
    logits = torch.linspace(-9, 9, 181).requires_grad_()
    seed = torch.Generator().manual_seed(1)
    assert part.noise(len(logits), seed) is None, "form(): expected a gate without noise, got one that draws some"
    assert part.num_levels == form.levels, f"form(): expected {part.num_levels} levels, got {form.levels}"
    pairs = ((_sample(part, logits, None), form.gates), (part.open_probability(logits), form.probability))
    for name, (value, formula) in zip(("gates", "open probability"), pairs, strict=True):
        grad = torch.autograd.grad(value.sum(), logits)[0] if value.requires_grad else torch.zeros_like(logits)
        stated, derivative = formula(logits.detach())
        equal(name, value.detach(), stated, tolerance=2e-6, why=ROUNDING)
        equal(f"derivative of {name}", grad, derivative, tolerance=2e-6, why=ROUNDING)
    far = 100 * logits.detach()
    equal("bounds", part.bound(far), far.clamp(-form.bound, form.bound))


def outputs(part: GateSampler, world: World) -> Outputs:
    """Return logits, gates and probabilities; every Gaussian has a gate of its own here."""
    logits = part.init(world.logits)
    noise = draw(part, len(logits))
    found = {
        "init()": logits,
        "sample(None)": part.sample(logits, None),
        "open_probability()": part.open_probability(logits),
        "bound()": part.bound(logits),
    }
    return found if noise is None else {**found, "sample(noise)": part.sample(logits, noise.to(logits.device))}


#: The noise stays in place when Gaussians are permuted: check_gate_noise_is_data permutes it too.
BEHAVIOUR = Behaviour(
    outputs,
    poisons_of("logits", usual=(12.0, -12.0)),
    by_gaussian=True,
    no_order="sample(noise)",
    shape=lambda world: tuple(world.logits.shape),
)
