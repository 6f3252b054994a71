"""Parts on another device than the processor: the pretend one, so that no GPU is needed to find out."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch

from gsstream.core.context import RowGradient, ScreenGradient
from gsstream.core.deferred import deferred_checks
from gsstream.core.part import Part
from gsstream.engine.assembly.part_in_use import line_of
from gsstream.parts.render.backward import backward
from gsstream.testing.cases import World, get_case
from gsstream.testing.compare import Outputs, all_equal, outputs
from gsstream.testing.pretend import DEVICE, DeviceMismatch, PretendDevice, PretendUnavailable, require_pretend
from gsstream.testing.registry import Skip, check, kind_of

#: Kinds whose tensors are on the device of the run. The first two are called once a frame: they may wait for a value,
#: and bring noise from the processor's generator. The others are called in every iteration, and may do neither.
KINDS = ("confidence", "propagation", "gate", "regularizer")
PER_ITERATION = KINDS[2:]
CURE = (
    "make tensors from those that are given (torch.zeros_like, new_full); arrays of context.cameras are numpy: "
    "torch.as_tensor(array).to(means)"
)
WHY = "the same operations, in another order of sums at most"


class WorldOnDevice(World):
    """A world whose tensors are on a device; gradients and renders are made by the world it was copied from."""

    original: World

    def previous_render(self, view: int) -> torch.Tensor:
        return self.original.previous_render(view).to(DEVICE)

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        found = self.original.screen_gradient(view, image_gradient.cpu())
        return ScreenGradient(*(value.to(DEVICE) for value in found))

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        found = self.original.screen_gradient_rows(view, image_gradient.cpu())
        return RowGradient(*(value.to(DEVICE) for value in found))


def on_device(world: World) -> World:
    """Return a copy of a world on the pretend device."""
    moved = {field.name: _moved(getattr(world, field.name)) for field in fields(world)}
    there = WorldOnDevice(**{**moved, "points": world.points, "cameras": world.cameras})
    object.__setattr__(there, "original", world)
    return there


def _moved(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.to(DEVICE)
    if isinstance(value, tuple):
        return tuple(_moved(one) for one in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: _moved(getattr(value, field.name)) for field in fields(value)})
    return value


@check("common", kinds=KINDS)
def check_device(part: Part) -> None:
    """On another device outputs are there, with the same numbers and gradients, and nothing is copied on the way."""
    per_iteration = kind_of(part) in PER_ITERATION
    try:
        require_pretend()
    except PretendUnavailable as error:
        raise Skip(str(error)) from error
    for name in ("cloud", "moving"):
        world = get_case(name)
        want = _with_gradients(part, world, per_iteration)
        with PretendDevice() as log:
            there = on_device(world)
            for crossed in (log.up, log.down, log.waits):
                crossed.clear()
            try:
                with deferred_checks():
                    found = _with_gradients(part, there, per_iteration)
            except DeviceMismatch as error:
                raise AssertionError(f"{error}{line_of(error, part)}; {CURE}") from error
            _look(log, per_iteration)
            for output, value in found.items():
                assert value.device == DEVICE, f"{output}: expected the device of the inputs, got {value.device}"
            all_equal(
                f"world {name!r} on another device",
                {k: v.cpu() for k, v in found.items()},
                want,
                tolerance=1e-5,
                why=WHY,
            )


def _with_gradients(part: Part, world: World, differentiate: bool) -> Outputs:
    if not differentiate:
        return {name: value.detach() for name, value in outputs(part, world).items()}
    logits, residual = world.logits.detach().requires_grad_(), world.residual.detach().requires_grad_()
    with torch.enable_grad():
        found = outputs(part, replace(world, logits=logits, residual=residual))
        roots = [value for value in found.values() if value.requires_grad]
        if roots:
            backward(roots, [torch.ones_like(root) for root in roots])
    grads = {"gradient by logits": logits.grad, "gradient by residual": residual.grad}
    detached = {name: value.detach() for name, value in found.items()}
    return {**detached, **{name: grad for name, grad in grads.items() if grad is not None}}


def _look(log: PretendDevice, per_iteration: bool) -> None:
    """Fail where something crossed that the world and the driver did not move themselves."""
    kinds = {"copied from the device": log.down}
    if per_iteration:
        kinds |= {"copied to the device": log.up, "read, for which the processor waits": log.waits}
    for what, lines in kinds.items():
        own = [line for line in lines if not line.startswith(("testing/", "core/deferred.py"))]
        assert not own, f"{', '.join(own)}: {what}; make tensors from those that are given: torch.zeros_like, new_full"
