"""What is checked of the result of each call of a part: one entry per kind and function, and no checks elsewhere."""

# ruff: noqa: ARG001  # a table of functions with one signature

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from gsstream.core.changes import Field, Motion, RowEdit
from gsstream.engine.assembly.checks import UNIT, Checks, Look


def _estimate(look: Look, args: tuple[Any, ...], result: object) -> None:
    look.output("estimate()", result, (args[0].hierarchy.num_gaussians,))


def _propagate(look: Look, args: tuple[Any, ...], result: object) -> None:
    look.output("propagate()", result, (args[1].num_nodes,))


def _like_logits(what: str, limits: tuple[float, float] | None) -> Callable[[Look, tuple[Any, ...], object], None]:
    def looking(look: Look, args: tuple[Any, ...], result: object) -> None:
        look.output(what, result, tuple(args[0].shape), limits)

    return looking


def _penalty(look: Look, args: tuple[Any, ...], result: Mapping[str, torch.Tensor]) -> None:
    look.terms(result)


def _motion(look: Look, args: tuple[Any, ...], result: object) -> None:
    if not isinstance(result, tuple) or not all(isinstance(motion, Motion | Field) for motion in result):
        raise look.fault(f"propose(): expected a tuple of Motion or Field, got {type(result).__name__}")


def _growth(look: Look, args: tuple[Any, ...], result: object) -> None:
    if result is not None and not isinstance(result, RowEdit):
        raise look.fault(f"propose(): expected RowEdit or None, got {type(result).__name__}")
    if result is not None and result.added is not None:
        for name, value in result.added.gaussians.items():
            look.values(f"added: {name}", torch.as_tensor(value))


def _image(look: Look, args: tuple[Any, ...], result: Any) -> None:
    if look.level is Checks.STEP:
        view = next((arg for arg in args if isinstance(arg, int)), None)
        look.values("image" if view is None else f"image of view {view}", result.image)


def _loss(look: Look, args: tuple[Any, ...], result: Any) -> None:
    if look.level is Checks.STEP:
        look.values("loss", result[0])
        look.values("gradient of the image", result[1])


def _optimiser(look: Look, args: tuple[Any, ...], result: object) -> None:
    look.step_values("after the step,", args[0])


OUTPUT_CHECKS: Mapping[tuple[str, str], Callable[[Look, tuple[Any, ...], Any], None]] = {
    ("confidence", "estimate"): _estimate,
    ("propagation", "propagate"): _propagate,
    ("gate", "init"): _like_logits("init()", None),
    ("gate", "sample"): _like_logits("sample()", UNIT),
    ("gate", "open_probability"): _like_logits("open_probability()", UNIT),
    ("gate", "bound"): _like_logits("bound()", None),
    ("regularizer", "penalty"): _penalty,
    ("motion", "propose"): _motion,
    ("growth", "propose"): _growth,
    ("renderer", "render"): _image,
    ("session", "render"): _image,
    ("renderer.loss", "evaluate"): _loss,
    ("renderer.optimiser", "step"): _optimiser,
}
