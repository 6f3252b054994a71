"""What the row optimiser of a renderer promises: Adam, row by row, and the residual that is trained by it."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit.gates import TrainedGates
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.residual.adam_state import ADAM_BETAS, ADAM_EPS, AdamState
from gsstream.parts.residual.layout import AttributeCode, JointLayout, joint_layout
from gsstream.parts.residual.optimiser import Iteration, ResidualEpoch, ResidualOptimiser
from gsstream.parts.residual.reference import JointResidualOptimiser
from gsstream.testing.cases import BLACK, get_case
from gsstream.testing.compare import equal
from gsstream.testing.examples.gate import ExampleGate
from gsstream.testing.examples.regularizer import ExampleRegularizer
from gsstream.testing.registry import check

STEPS = 12
WHY = "float32 over a dozen steps"


def _tables() -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    shapes = {"means": (9, 3), "opacities": (9,), "shN": (9, 4, 3), "none": (0, 3)}
    return {name: torch.randn(shape, generator=g) for name, shape in shapes.items()}


def _gradients(step: int) -> dict[str, torch.Tensor]:
    """Gradients of very different sizes from step to step; every third row of a table has none."""
    g = torch.Generator().manual_seed(100 + step)
    found = {name: 10.0 ** (step % 7 - 5) * torch.randn(value.shape, generator=g) for name, value in _tables().items()}
    found["shN"][step % 3 :: 3] = 0
    return found


@check("renderer")
def check_optimiser_adam(part: Renderer) -> None:
    """Where all rows take all steps this is torch.optim.Adam, whatever shape the learning rate has."""
    for rate in (0.01, torch.full((3,), 0.01), torch.full((9, 1), 0.01)):
        rates = {"means": 0.01, "opacities": 0.05, "shN": 0.0025, "none": 1.0}
        lrs: dict[str, float | torch.Tensor] = {**rates, "means": rate}
        ours, theirs = _tables(), {name: value.requires_grad_() for name, value in _tables().items()}
        states = {name: AdamState.start(value) for name, value in ours.items()}
        groups = [{"params": [value], "lr": rates[name]} for name, value in theirs.items()]
        adam = torch.optim.Adam(groups, betas=ADAM_BETAS, eps=ADAM_EPS)
        for step in range(STEPS):
            gradients = _gradients(step)
            for name, value in theirs.items():
                value.grad = gradients[name].clone()
            adam.step()
            part.optimiser.step(ours, gradients, states, lrs)
        for name, value in ours.items():
            equal(f"{name} after {STEPS} steps", value, theirs[name].detach(), tolerance=1e-5, why=WHY)
            assert bool((states[name].steps == STEPS).all()), f"{name}: expected {STEPS} steps to be counted"


@check("renderer")
def check_optimiser_ahead(part: Renderer) -> None:
    """Steps that look ahead are those of Adam by the mean that would follow if the same gradient came once more.

    So where all gradients of a row are one, each step is as long as the learning rate, from the first on.
    """
    values, same = _tables()["means"], _gradients(3)["means"]
    wanted, mean, square = values.double(), torch.zeros(9, 3).double(), torch.zeros(9, 3).double()
    state = AdamState.start(values, ahead=True)
    for step in range(1, 2 * STEPS):
        now, before = same if step < STEPS else _gradients(step)["means"], values.clone()
        part.optimiser.step({"means": values}, {"means": now}, {"means": state}, {"means": 0.01})
        mean += (1 - ADAM_BETAS[0]) * (now - mean)
        square += (1 - ADAM_BETAS[1]) * (now.double() ** 2 - square)
        after = (mean + (1 - ADAM_BETAS[0]) * (now - mean)) / (1 - ADAM_BETAS[0] ** (step + 1))
        wanted -= 0.01 * after / ((square / (1 - ADAM_BETAS[1] ** step)).sqrt() + ADAM_EPS)
        if step < STEPS:
            equal("a step of one gradient", before - values, 0.01 * same.sign(), tolerance=1e-5, why=WHY)
    equal("means", values, wanted.float(), tolerance=1e-5, why=WHY)


@check("renderer")
def check_optimiser_rows(part: Renderer) -> None:
    """A row that joins later is corrected by its own count; a table without a gradient neither moves nor counts."""
    values, gradients = _tables(), _gradients(0)
    states = {name: AdamState.start(value) for name, value in values.items()}
    states["means"].steps[:4] = 50
    before = {name: value.clone() for name, value in values.items()}
    part.optimiser.step(values, {"means": gradients["means"]}, states, {"means": 0.01})
    equal("a table without a gradient", values["opacities"], before["opacities"])
    idle = states["opacities"].steps
    equal("steps of a table without a gradient", idle, torch.zeros_like(idle))
    equal("steps", states["means"].steps, torch.tensor([51] * 4 + [1] * 5, dtype=torch.int32))
    young = (before["means"] - values["means"])[4:]
    equal(
        "first step of a row",
        young,
        0.01 * gradients["means"][4:].sign(),
        tolerance=1e-6,
        why="Adam's first step is lr * sign",
    )


@check("renderer")
def check_optimiser_refuses(part: Renderer) -> None:
    """A gradient that is not finite or of another shape is refused, and its table is left as it was."""
    for wrong in (torch.full((9, 3), torch.nan), torch.zeros(8, 3)):
        values = _tables()
        states = {name: AdamState.start(value) for name, value in values.items()}
        before = values["means"].clone()
        try:
            part.optimiser.step(values, {"means": wrong}, states, {"means": 0.01})
        except ShapeError:
            equal("the refused table", values["means"], before)
            assert not states["means"].exp_avg.any() and not states["means"].steps.any(), "moments moved all the same"
            continue
        raise AssertionError(f"a gradient of shape {list(wrong.shape)}, first value {wrong.flatten()[0]}, was accepted")


def residual_case() -> tuple[JointLayout, Gaussians[torch.Tensor], torch.Tensor, torch.Tensor]:
    """Return layout, rows, units and decoders of 300 rows: centres change directly, sizes and colours by decoders."""
    g = torch.Generator().manual_seed(7)
    shapes = (3,), (4,), (3,), (), (1, 3), (3, 3)
    base = Gaussians(*(torch.randn(300, *shape, generator=g) for shape in shapes))
    codes = {
        "means": AttributeCode(0.05, 0.1),
        "scales": AttributeCode(1.0, 0.3, 8, 1e-3),
        "opacities": AttributeCode(0.2, 0.1),
        "sh0": AttributeCode(0.5, 0.2, 4, 0.0),
        "shN": AttributeCode(1.0, 0.2, 5, 1e-2),
    }
    latents = {name: torch.zeros(300, code.latent or (3 if name == "means" else 1)) for name, code in codes.items()}
    widths = {"scales": 3, "sh0": 3, "shN": 9}
    decoders = {name: 0.1 * torch.randn(codes[name].latent, width, generator=g) for name, width in widths.items()}
    code = joint_layout(codes, latents, decoders, base)
    return code, base, 0.1 + torch.rand(300, generator=g), code.join_decoders(decoders)


@check("renderer")
def check_residual_optimiser(part: Renderer) -> None:
    """Its residual optimiser does what the residual's formulas, the rate and Adam do.

    Rows leave, bits cost something in every other step, and the learning rates fall.
    """
    code, base, units, matrix = residual_case()
    subject = part.optimiser.residual_optimiser(code, base, units, matrix)
    truth = JointResidualOptimiser(code=code, base=base, units=units, matrix=matrix, optimiser=part.optimiser)
    g, rows = torch.Generator().manual_seed(8), len(base)
    for step in range(STEPS):
        if step == STEPS // 2:
            kept = torch.arange(0, rows, 3)
            for each in (subject, truth):
                each.select_rows(kept)
            rows = len(kept)
        gates = torch.randint(0, 4, (rows,), generator=g) / 3
        ours, theirs = subject.forward(gates), truth.forward(gates)
        for (name, one), (_, other) in zip(ours.items(), theirs.items(), strict=True):
            equal(f"{name} of step {step}", one, other, tolerance=1e-5, why=WHY)
        grad = ours.map(lambda value: 1e-3 * torch.randn(value.shape, generator=g))
        weight = 1e-4 if step % 2 else 0.0
        equal(
            "gradient of the gates",
            subject.backward(grad, weight),
            truth.backward(grad, weight),
            tolerance=1e-5,
            why=WHY,
        )
        for each in (subject, truth):
            each.latents.grad = torch.full((rows, code.width), 1e-5)
            each.step(0.9**step)
            assert each.latents.grad is None, "step(): expected what waits on the latents to be taken, got it left"
        _compare(subject, truth)
    equal("position", subject.position.detach(), truth.position.detach(), tolerance=1e-4, why=WHY)


@check("renderer")
def check_residual_optimiser_run(part: Renderer) -> None:
    """Six iterations of ``run`` find what its default body finds: residual, decoders, gates and losses."""
    found = []
    for body in (None, ResidualOptimiser.run):
        case = get_case("cloud")
        active, loss = torch.arange(0, len(case.gaussians), 3), part.loss
        session = part.open(case.gaussians, active, case.cameras, BLACK)
        base, views = case.gaussians.rows(active), len(case.cameras)
        latents = {"means": torch.zeros(len(active), 3), "sh0": torch.zeros(len(active), 3)}
        codes = {"means": AttributeCode(0.05, 0.02), "sh0": AttributeCode(0.1, 0.05)}
        code = joint_layout(codes, latents, {}, base)
        subject = part.optimiser.residual_optimiser(code, base, torch.full((len(active),), 0.2), code.join_decoders({}))
        if type(subject).run is ResidualOptimiser.run:
            return
        gates = TrainedGates(
            gate=ExampleGate(),
            regularizer=ExampleRegularizer(),
            optimiser=part.optimiser,
            lr=0.05,
            logits=torch.ones(case.hierarchy.num_nodes),
            hierarchy=case.hierarchy,
            rows=active,
            generator=torch.Generator().manual_seed(1),
        )
        frozen = torch.arange(len(active)) % 4 == 0
        targets = [ViewTarget(loss, loss.prepare(image), 0.2, image) for image in case.now]
        iterations = [
            Iteration(place % views, targets[place % views], frozen if place < 2 else None, 0.9**place)
            for place in range(6)
        ]
        epoch = ResidualEpoch(session, iterations, gates, 1e-5)
        made = subject.run(epoch) if body is None else body(subject, epoch)
        assert len(made) == 6, f"run(): expected 6 losses, got {len(made)}"
        found.append((subject, gates, torch.stack(made)))
    (subject, gates, losses), (truth, wanted, expected) = found
    _compare(subject, truth)
    equal("logits", gates.logits.detach(), wanted.logits.detach(), tolerance=1e-4, why=WHY)
    equal("losses", losses, expected, tolerance=1e-5, why=WHY)


def _compare(subject: ResidualOptimiser[Any], truth: ResidualOptimiser[Any]) -> None:
    equal("latents", subject.latents.detach(), truth.latents.detach(), tolerance=1e-4, why=WHY)
    equal("decoders", subject.matrix, truth.matrix, tolerance=1e-4, why=WHY)
    equal("curvature", subject.curvature, truth.curvature, tolerance=1e-4, why=WHY)
