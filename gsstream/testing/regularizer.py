"""What a regularizer promises."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.core.shapes import check_shape
from gsstream.parts.regularizer.base import AnalyticPenalty, Regularizer
from gsstream.testing.cases import World, forest, get_case
from gsstream.testing.compare import ROUNDING, Behaviour, Outputs, at_most, equal, finite, poisons_of
from gsstream.testing.registry import check

#: Number of rows of a large scene: a sum of so many values in float32, one after another, loses digits.
COPIES = 5000


def _terms(
    part: Regularizer, case: World, opened: torch.Tensor | None = None, residual: torch.Tensor | None = None
) -> Mapping[str, torch.Tensor]:
    opened = _opened(case) if opened is None else opened
    residual = case.residual if residual is None else residual
    return part.penalty(opened, residual, case.hierarchy, len(case.logits))


def _opened(case: World) -> torch.Tensor:
    """[M] open probabilities between 0.1 and 0.9."""
    return torch.linspace(0.1, 0.9, case.hierarchy.num_nodes).to(case.residual.dtype)


def _total(terms: Mapping[str, torch.Tensor]) -> torch.Tensor:
    values = [value.double() for value in terms.values()]
    return torch.stack(values).sum() if values else torch.zeros((), dtype=torch.float64)


@check("regularizer")
def check_regularizer_scalar(part: Regularizer) -> None:
    """Each term is a finite scalar >= 0 in the input's dtype."""
    for case in (get_case("cloud"), get_case("cloud").double()):
        for name, value in _terms(part, case).items():
            check_shape(f"term {name!r}", value, ())
            finite(f"term {name!r}", value)
            at_most(f"negated term {name!r}", -value, 0.0, tolerance=0.0, why="penalties are not rewards")


@check("regularizer")
def check_regularizer_terms(part: Regularizer) -> None:
    """The names of the terms do not depend on the input, so that logs line up."""
    names = {name: list(_terms(part, get_case(name))) for name in ("one", "two identical", "cloud")}
    assert len({tuple(found) for found in names.values()}) == 1, f"terms differ from input to input: {names}"


@check("regularizer")
def check_regularizer_zero_at_rest(part: Regularizer) -> None:
    """All closed and no residual costs exactly 0."""
    case = get_case("cloud")
    rest = _total(_terms(part, case, torch.zeros(case.hierarchy.num_nodes), torch.zeros_like(case.residual)))
    equal("penalty at rest", rest, torch.zeros_like(rest))


@check("regularizer")
def check_regularizer_monotone(part: Regularizer) -> None:
    """Raising an open probability or enlarging a residual does not lower the total."""
    case = get_case("cloud")
    before = _total(_terms(part, case))
    for node in range(0, case.hierarchy.num_nodes, 4):
        opened = _opened(case)
        opened[node] += 0.05
        at_most(
            f"total before node {node} opens",
            before,
            float(_total(_terms(part, case, opened))),
            tolerance=1e-6,
            why=ROUNDING,
        )
    for row in range(0, len(case.residual), 40):
        residual = case.residual.clone()
        residual[row] *= 1.5
        after = float(_total(_terms(part, case, None, residual)))
        at_most(f"total before residual {row} grows", before, after, tolerance=1e-6, why=ROUNDING)


@check("regularizer", trait="weights")
def check_regularizer_linear_in_weight(part: Regularizer) -> None:
    """Doubling the claimed weights doubles the total; zero weights give exactly 0 and no gradient."""
    weights = part.claims().weights
    case = get_case("cloud")

    def scaled(factor: float) -> Regularizer:
        values: dict[str, Any] = {name: factor * getattr(part.config, name) for name in weights}
        return type(part)(part.config.model_copy(update=values))

    once, twice = _total(_terms(part, case)), _total(_terms(scaled(2.0), case))
    equal("twice the weights", twice, 2 * once, tolerance=1e-5, why=ROUNDING)
    opened, residual = _opened(case).requires_grad_(True), case.residual.clone().requires_grad_(True)
    nothing = _total(_terms(scaled(0.0), case, opened, residual))
    equal("zero weights", nothing.detach(), torch.zeros_like(nothing))
    if nothing.requires_grad:
        for gradient in torch.autograd.grad(nothing, [opened, residual], allow_unused=True, materialize_grads=True):
            equal("gradient at zero weights", gradient, torch.zeros_like(gradient))


@check("regularizer")
def check_regularizer_gradient(part: Regularizer) -> None:
    """Agrees with finite differences in double precision; finite where nothing moves and all is closed."""
    case = get_case("two identical").double()
    inputs = (torch.tensor([0.3, 0.7], dtype=torch.float64, requires_grad=True), case.residual.requires_grad_(True))
    if not _total(part.penalty(*inputs, case.hierarchy, 2)).requires_grad:
        return  # the null regularizer costs nothing, whatever the input
    torch.autograd.gradcheck(lambda p, r: _total(part.penalty(p, r, case.hierarchy, 2)), inputs, eps=1e-6, atol=1e-6)
    rest = (torch.zeros_like(inputs[0]).requires_grad_(True), torch.zeros_like(inputs[1]).requires_grad_(True))
    total = _total(part.penalty(*rest, case.hierarchy, 2))
    for name, gradient in zip(("gates", "residual"), torch.autograd.grad(total, rest, allow_unused=True), strict=True):
        if gradient is not None:
            finite(f"gradient at rest with respect to the {name}", gradient)


@check("regularizer")
def check_regularizer_reduction(part: Regularizer) -> None:
    """A scene beside its own copy costs the same (reduction "mean") or twice as much ("sum"), and so do many copies."""
    case = get_case("cloud")
    once, m = _total(_terms(part, case)), case.hierarchy.num_nodes
    half = forest(len(case.logits))
    both = Hierarchy(*(torch.cat([a, a + step]) for a, step in ((half.node_of, m), (half.parent, m), (half.level, 0))))
    terms = part.penalty(_opened(case).repeat(2), case.residual.repeat(2, 1), both, 2 * len(case.logits))
    factor = {"mean": 1.0, "sum": 2.0}[part.claims().reduction]
    equal(f"reduction {part.claims().reduction!r}", _total(terms), factor * once, tolerance=1e-5, why=ROUNDING)
    many = Hierarchy(case.hierarchy.node_of.repeat(COPIES), case.hierarchy.parent, case.hierarchy.level)
    terms = part.penalty(_opened(case), case.residual.repeat(COPIES, 1), many, COPIES * len(case.logits))
    factor = {"mean": 1.0, "sum": float(COPIES)}[part.claims().reduction]
    equal(
        f"{COPIES} times as many rows, one by one",
        _total(terms) / factor,
        once,
        tolerance=1e-5,
        why="no digit is lost in a sum",
    )


@check("regularizer")
def check_regularizer_closed_rows(part: Regularizer) -> None:
    """Rows that are left out because their gates are closed cost what they cost when they were kept: nothing."""
    case = get_case("cloud")
    opened = _opened(case)
    closed = torch.arange(case.hierarchy.num_nodes) % 2 == 0
    opened[closed] = 0.0
    kept = ~closed[case.hierarchy.node_of]
    whole = _total(_terms(part, case, opened))
    active = part.penalty(opened, case.residual[kept], case.hierarchy.rows(kept), len(case.logits))
    equal("active rows alone", _total(active), whole, tolerance=1e-5, why=ROUNDING)


@check("regularizer")
def check_regularizer_empty(part: Regularizer) -> None:
    """With no active row the penalty is exactly 0."""
    case = get_case("empty")
    total = _total(_terms(part, case))
    equal("no Gaussians", total, torch.zeros_like(total))
    scene = get_case("cloud")
    none_active = part.penalty(_opened(scene), scene.residual[:0], scene.hierarchy.rows(slice(0, 0)), len(scene.logits))
    total = _total(none_active)
    equal("no active rows", total, torch.zeros_like(total))


@check("regularizer", trait="gate_terms")
def check_regularizer_reads_weights(part: Regularizer) -> None:
    """Terms declared to depend on gates alone (gate_terms) do not depend on the residual."""
    case = get_case("cloud")
    still, moving = (_terms(part, case, None, factor * case.residual) for factor in (0.0, 1.0))
    for name in part.claims().gate_terms:
        assert name in moving, f"RegularizerTraits.gate_terms names {name!r}; the terms are {', '.join(moving)}"
        equal(f"term {name!r}, with and without motion", moving[name], still[name])


@check("regularizer")
def check_regularizer_form(part: Regularizer) -> None:
    """A penalty that states a closed form keeps to it, in its gradient by probabilities and residuals."""
    form = part.form()
    if not isinstance(form, AnalyticPenalty):
        return
    case = get_case("cloud")
    hierarchy, count = case.hierarchy, 3 * len(case.residual)
    probability = torch.linspace(0.01, 0.99, hierarchy.num_nodes).requires_grad_()
    residual = case.residual.clone().requires_grad_()
    total = sum(part.penalty(probability, residual, hierarchy, count).values(), torch.zeros(()))
    leaves = (probability, residual)
    found = torch.autograd.grad(total, leaves, allow_unused=True) if total.requires_grad else (None, None)
    stated = form.grad(probability.detach(), residual.detach(), hierarchy, count)
    for name, leaf, one, other in zip(("probabilities", "residuals"), leaves, found, stated, strict=True):
        one = torch.zeros_like(leaf) if one is None else one
        equal(f"gradient by {name}", one, other, tolerance=2e-6, why=ROUNDING)


def outputs(part: Regularizer, world: World) -> Outputs:
    """Return every term. Nodes have the same probabilities whatever the order of the Gaussians."""
    opened = torch.sigmoid(torch.linspace(-2, 2, world.hierarchy.num_nodes).to(world.logits))
    terms = part.penalty(opened, world.residual, world.hierarchy, len(world.logits))
    return {f"penalty()[{name!r}]": value for name, value in terms.items()}


BEHAVIOUR = Behaviour(outputs, poisons_of("residual"), hands_on=True)
