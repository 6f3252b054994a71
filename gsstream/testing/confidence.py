"""What a confidence estimator promises. Confidence is a logit here: z = logit(p)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import torch

from gsstream.parts.confidence.base import ConfidenceEstimator
from gsstream.testing.cases import EXTREMES, World, get_case
from gsstream.testing.compare import Behaviour, Outputs, Poison, at_most, equal, finite, has_shape, poisons_of
from gsstream.testing.registry import check

ENOUGH_AUC = 0.9


@check("confidence")
def check_confidence_range(part: ConfidenceEstimator) -> None:
    """[N] finite float32 logits, on every world."""
    for name in ("cloud", *(name for name in EXTREMES if name != "empty")):
        case = get_case(name)
        got = part.estimate(case)
        n = len(case.gaussians)
        has_shape(f"world {name!r}", got, (n,))
        assert got.dtype == torch.float32, f"world {name!r}: expected float32, got {got.dtype}"
        finite(f"world {name!r}", got)


@check("confidence")
def check_confidence_static_frame(part: ConfidenceEstimator) -> None:
    """Identical consecutive frames: finite, and at most the declared floor."""
    got = part.estimate(get_case("static"))
    finite("a frame in which nothing changed", got)
    at_most(
        "a frame in which nothing changed",
        got,
        part.claims().floor,
        tolerance=1e-5,
        why="float32 of the declared floor",
    )


@check("confidence")
def check_confidence_unseen(part: ConfidenceEstimator) -> None:
    """Gaussians that no camera sees get a defined value, at most the declared floor."""
    case = get_case("unseen")
    hidden = case.gaussians.means[:, 1] > 5
    got = part.estimate(case)[hidden]
    finite("Gaussians nobody sees", got)
    at_most("Gaussians nobody sees", got, part.claims().floor, tolerance=1e-5, why="float32 of the declared floor")


@check("confidence")
def check_confidence_view_order(part: ConfidenceEstimator) -> None:
    """Shuffling the cameras changes nothing."""
    case = get_case("cloud")
    equal(
        "shuffled cameras",
        part.estimate(case.views([2, 0, 1])),
        part.estimate(case),
        tolerance=1e-4,
        why="sums over views in another order, amplified by a division by their spread",
    )


@check("confidence", trait="finds_motion")
def check_confidence_finds_motion(part: ConfidenceEstimator) -> None:
    """Gaussians that moved outrank those that did not: area under the ROC curve at least 0.9. A check of usefulness."""
    case = get_case("moving")
    got = part.estimate(case)
    moved, still = got[case.moving_mask], got[~case.moving_mask]
    pairs = (moved[:, None] > still[None]).float() + 0.5 * (moved[:, None] == still[None]).float()
    auc = float(pairs.mean())
    assert auc >= ENOUGH_AUC, f"AUC of moved against still Gaussians: expected at least {ENOUGH_AUC}, got {auc:.3f}"


@check("confidence", trait="monotone_in_change")
def check_confidence_monotone_in_change(part: ConfidenceEstimator) -> None:
    """Blending the change in (0, 1/4, 1/2, 1): the mean logit of what moved does not fall."""
    case = get_case("moving")
    means = [float(part.estimate(case.blended(share))[case.moving_mask].mean()) for share in (0.0, 0.25, 0.5, 1.0)]
    slack = 1e-3 * (1 + max(abs(value) for value in means))
    falls = [b - a for a, b in pairwise(means) if b < a - slack]
    assert not falls, f"mean logits at 0, 1/4, 1/2, 1 of the change: {means}; fall by more than {slack:.2g} (float32)"


@check("confidence")
def check_confidence_no_grad_left(part: ConfidenceEstimator) -> None:
    """Parameters keep requires_grad and .grad; the result carries no graph."""
    case = get_case("cloud")
    case = replace(case, gaussians=case.gaussians.map(lambda t: t.clone().requires_grad_(True)))
    got = part.estimate(case)
    assert not got.requires_grad and got.grad_fn is None, "the result carries a graph: memory grows with every frame"
    touched = [name for name, value in case.gaussians.items() if not value.requires_grad or value.grad is not None]
    assert not touched, f"requires_grad or .grad changed: {', '.join(touched)}"
    assert torch.is_grad_enabled(), "gradients were left switched off"


@check("confidence")
def check_confidence_no_cameras(part: ConfidenceEstimator) -> None:
    """Without a camera no Gaussian is visible: logits are at most the declared floor."""
    got = part.estimate(get_case("cloud").views([]))
    finite("no cameras", got)
    at_most("no cameras", got, part.claims().floor, tolerance=1e-5, why="float32 of the declared floor")


@check("confidence")
def check_confidence_extreme_images(part: ConfidenceEstimator) -> None:
    """A cut from black to white and a change of one part in 1e6 stay finite."""
    case = get_case("cloud")
    black, white = (tuple(torch.full_like(i, value) for i in case.now) for value in (0.0, 1.0))
    finite("black to white", part.estimate(replace(case, before=black, now=white)))
    finite("a change of 1e-6", part.estimate(case.blended(1e-6)))


#: A fiftieth of full scale: five levels of 8 bits, what an automatic exposure does between two frames.
EXPOSURE = 0.02


@check("confidence", trait="brightness")
def check_confidence_brightness(part: ConfidenceEstimator) -> None:
    """When a still scene becomes brighter as a whole, the mean logit stays within the declared bound."""
    case = get_case("static")
    brighter = tuple((image + EXPOSURE).clamp(max=1.0) for image in case.before)
    got = part.estimate(replace(case, now=brighter)).double().mean()
    finite("brighter by a fiftieth", got)
    bound = part.claims().brightness
    assert bound is not None
    at_most(
        "mean logit of a scene that is brighter by a fiftieth",
        got,
        bound,
        tolerance=1e-4,
        why="float32 of the declared bound",
    )


#: A pixel that every camera of the cloud covers.
SPOT = (10, 10)


def outputs(part: ConfidenceEstimator, world: World) -> Outputs:
    """Return logits per Gaussian."""
    return {"estimate()": part.estimate(world)}


def _in_frame(world: World, value: float) -> None:
    world.now[1][SPOT] = value


def _in_frame_before(world: World, value: float) -> None:
    world.before[1][SPOT] = value


POISONS = (
    Poison("a pixel of view 1", "view 1", _in_frame),
    Poison("a pixel of view 1 of the frame before", "view 1", _in_frame_before),
    *poisons_of(*(f"gaussians.{name}" for name in ("means", "quats", "scales", "opacities", "sh0"))),
)
BEHAVIOUR = Behaviour(
    outputs, POISONS, keeps_precision=False, by_gaussian=True, shape=lambda world: (len(world.gaussians),)
)
