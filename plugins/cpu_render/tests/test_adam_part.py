"""The optimiser part: torch's Adam where all rows step together, each row by itself where they do not."""

from __future__ import annotations

import pytest
import torch
from gsstream_cpu_render.adam_part import CpuAdam

from gsstream.api import AdamState, RowOptimiser, ShapeError
from gsstream.parts.optimiser.adam import ReferenceAdam

SHAPES = {"means": (37, 3), "latents": (37, 8), "logits": (5,), "sh": (37, 4, 3), "none": (0, 3)}
LRS = {"means": 1e-2, "latents": 3e-3, "logits": 0.1, "sh": 0.0, "none": 1.0}
BOTH = pytest.mark.parametrize("part", [CpuAdam(), ReferenceAdam()], ids=["cpu", "reference"])


def tables(seed: int) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {name: torch.randn(shape, generator=g) for name, shape in SHAPES.items()}


def gradients(seed: int) -> dict[str, torch.Tensor]:
    """Of very different sizes, some exactly zero."""
    found = {name: value * 10.0 ** (seed % 7 - 5) for name, value in tables(1000 + seed).items()}
    found["latents"][seed % 3 :: 3] = 0
    return found


@BOTH
def test_torch_adam_where_all_rows_take_all_steps(part: RowOptimiser) -> None:
    values, truth = tables(0), {name: value.clone().requires_grad_() for name, value in tables(0).items()}
    states = {name: AdamState.start(value) for name, value in values.items()}
    adam = torch.optim.Adam([{"params": [leaf], "lr": LRS[name]} for name, leaf in truth.items()], eps=1e-15)
    leaves = {name: value.requires_grad_() for name, value in values.items()}
    for step in range(50):
        found = gradients(step)
        part.step(leaves, found, states, LRS)
        for name, leaf in truth.items():
            leaf.grad = found[name].clone()
        adam.step()
    for name, leaf in truth.items():
        torch.testing.assert_close(leaves[name].detach(), leaf.detach(), rtol=1e-6, atol=1e-6)
        assert (states[name].steps == 50).all()


@BOTH
def test_a_row_that_joins_later_is_corrected_by_its_own_count(part: RowOptimiser) -> None:
    old, young = tables(1)["latents"], tables(2)["latents"]
    alone = {"old": old.clone(), "young": young.clone()}
    single = {name: AdamState.start(value) for name, value in alone.items()}
    rates = {"old": 0.01, "young": 0.01, "both": 0.01}
    for step in range(10):
        part.step(alone, {"old": gradients(step)["latents"]}, single, rates)
    both = {"both": torch.cat([alone["old"], young])}
    grown = AdamState(*(torch.cat([getattr(single[n], f) for n in ("old", "young")]) for f in AdamState.__slots__))
    for step in range(10, 20):
        pair = {"old": gradients(step)["latents"], "young": gradients(step + 50)["latents"]}
        part.step(alone, pair, single, rates)
        part.step(both, {"both": torch.cat([pair["old"], pair["young"]])}, {"both": grown}, rates)
    torch.testing.assert_close(both["both"], torch.cat([alone["old"], alone["young"]]), rtol=1e-6, atol=1e-7)
    assert grown.steps.unique().tolist() == [10, 20]


@BOTH
def test_a_table_without_gradient_stands_still_and_counts_nothing(part: RowOptimiser) -> None:
    values, before = tables(3), tables(3)
    states = {name: AdamState.start(value) for name, value in values.items()}
    part.step(values, {"means": gradients(3)["means"]}, states, LRS)
    assert torch.equal(values["latents"], before["latents"])
    assert not torch.equal(values["means"], before["means"])
    assert int(states["latents"].steps.max()) == 0


@BOTH
def test_bad_gradients_are_refused_and_change_nothing(part: RowOptimiser) -> None:
    values, before = tables(4), tables(4)
    states = {name: AdamState.start(value) for name, value in values.items()}
    bad = gradients(4)["means"]
    bad[7, 2] = torch.nan
    with pytest.raises(ShapeError, match=r"gradient of means: .*nan"):
        part.step(values, {"means": bad}, states, LRS)
    with pytest.raises(ShapeError, match="gradient of means"):
        part.step(values, {"means": bad[:5]}, states, LRS)
    assert torch.equal(values["means"], before["means"])
    assert float(states["means"].exp_avg.abs().max()) == 0
    assert int(states["means"].steps.max()) == 0
