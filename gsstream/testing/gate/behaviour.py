"""Gate samplers, for the common checks."""

from __future__ import annotations

from gsstream.parts.gate.base import GateSampler
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs, draw, poisons_of


def outputs(part: GateSampler, world: World) -> Outputs:
    """Return logits, gates and probabilities; every Gaussian has a gate of its own here."""
    logits = part.init(world.logits)
    noise = draw(part, len(world.logits))
    found = {
        "init()": logits,
        "sample(None)": part.sample(logits, None),
        "open_probability()": part.open_probability(logits),
        "bound()": part.bound(logits),
    }
    return found if noise is None else {**found, "sample(noise)": part.sample(logits, noise.to(logits.device))}


#: The noise stays in place when Gaussians are permuted: check_gate_noise_is_data permutes it too.
BEHAVIOUR = Behaviour(outputs, poisons_of("logits", usual=(12.0, -12.0)), by_gaussian=True, no_order="sample(noise)")
