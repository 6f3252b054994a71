"""What is checked of the result of each call of a part: one entry per kind and function, and no checks elsewhere."""

# ruff: noqa: ARG001  # a table of functions with one signature

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from gsstream.core.changes import Field, Motion, RowEdit
from gsstream.engine.assembly.checks import UNIT, Checks
from gsstream.engine.assembly.part_in_use import PartInUse


def _estimate(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    use.output("estimate()", result, (args[0].hierarchy.num_gaussians,))


def _propagate(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    use.output("propagate()", result, (args[1].num_nodes,))


def _like_logits(what: str, limits: tuple[float, float] | None) -> Callable[[PartInUse, tuple[Any, ...], object], None]:
    def check(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
        use.output(what, result, tuple(args[0].shape), limits)

    return check


def _penalty(use: PartInUse, args: tuple[Any, ...], result: Mapping[str, torch.Tensor]) -> None:
    use.terms(result)


def _motion(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    if not isinstance(result, tuple) or not all(isinstance(motion, Motion | Field) for motion in result):
        raise use.fault(f"propose(): expected a tuple of Motion or Field, got {type(result).__name__}")


def _growth(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    if result is not None and not isinstance(result, RowEdit):
        raise use.fault(f"propose(): expected RowEdit or None, got {type(result).__name__}")
    if result is not None and result.added is not None:
        for name, value in result.added.gaussians.items():
            use.values(f"added: {name}", torch.as_tensor(value))


def _image(use: PartInUse, args: tuple[Any, ...], result: Any) -> None:
    if use.level is Checks.STEP:
        view = next((arg for arg in args if isinstance(arg, int)), None)
        use.values("image" if view is None else f"image of view {view}", result.image)


def _loss(use: PartInUse, args: tuple[Any, ...], result: Any) -> None:
    if use.level is Checks.STEP:
        use.values("loss", result[0])
        use.values("gradient of the image", result[1])


def _optimiser(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    use.step_values("after the step,", args[0])


OUTPUT_CHECKS: Mapping[tuple[str, str], Callable[[PartInUse, tuple[Any, ...], Any], None]] = {
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
