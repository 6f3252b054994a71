"""The pretend device refuses what a GPU refuses, and counts what makes one wait or copy."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from gsstream.testing.pretend import DEVICE, NAME, DeviceMismatch, PretendDevice, kernel

REFUSED: dict[str, Callable[[torch.Tensor], object]] = {
    "sum": lambda a: a + torch.zeros(4, 3),
    "product": lambda a: a @ torch.zeros(3, 2),
    "join": lambda a: torch.cat([a, torch.zeros(1, 3)]),
    "rows by an index of the processor": lambda a: a[torch.tensor([0, 1])],
    "mask of the processor": lambda a: torch.where(torch.ones(4, 3, dtype=torch.bool), a, 0.0),
    "generator of the processor": lambda _: torch.randn(3, generator=torch.Generator(), device=NAME),
    "kernel on a tensor of the processor": lambda a: kernel(torch.add)(a, torch.zeros(4, 3)),
}
#: What -> (what is done, copies up, copies down, waits).
COUNTED: dict[str, tuple[Callable[[torch.Tensor], object], int, int, int]] = {
    "arithmetic": (lambda a: (a.exp() * 2 + 1).sum(0), 0, 0, 0),
    "a number of the processor": (lambda a: a * torch.tensor(2.0), 0, 0, 0),
    "value": (lambda a: float(a.sum()), 0, 0, 1),
    "truth": (lambda a: bool((a > 0).all()), 0, 0, 1),
    "rows that are counted": (lambda a: (a > 0).nonzero(), 0, 0, 1),
    "rows by a mask": (lambda a: a[a[:, 0] > 0], 0, 0, 1),
    "rows by an index": (lambda a: a[torch.zeros(2, dtype=torch.int64, device=NAME)], 0, 0, 0),
    "unique": (lambda a: torch.unique(a), 0, 0, 1),
    "to": (lambda _: torch.zeros(2).to(NAME), 1, 0, 0),
    "new_tensor": (lambda a: a.new_tensor([1.0]), 1, 0, 0),
    "cpu": (lambda a: a.cpu(), 0, 1, 0),
    "copy_": (lambda a: a.clone().copy_(torch.zeros(4, 3)), 1, 0, 0),
}


@pytest.mark.parametrize("what", REFUSED)
def test_tensors_of_two_devices_are_refused(what: str) -> None:
    with PretendDevice(), pytest.raises(DeviceMismatch):
        REFUSED[what](torch.ones(4, 3, device=NAME))


@pytest.mark.parametrize("call", ["numpy", "tolist"])
def test_memory_of_the_device_is_no_array(call: str) -> None:
    with PretendDevice(), pytest.raises(RuntimeError):
        getattr(torch.ones(3, device=NAME), call)()


@pytest.mark.parametrize("what", COUNTED)
def test_what_crosses_is_counted_with_its_line(what: str) -> None:
    call, *wanted = COUNTED[what]
    with PretendDevice() as log:
        a = torch.ones(4, 3, device=NAME)
        call(a)
    assert log.crossings == tuple(wanted)
    assert all("test_pretend.py:" in place for place in (*log.up, *log.down, *log.waits))


def test_gradients_stay_there_and_have_the_bits_of_the_processor() -> None:
    start = torch.randn(4, 3, generator=torch.Generator().manual_seed(3))

    def grad(a: torch.Tensor, square: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        leaf = a.detach().requires_grad_()
        (square(leaf).sin() * leaf.exp()).sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    with PretendDevice() as log:
        there = start.to(NAME)
        found, fused = grad(there, lambda x: x * x), grad(there, kernel(lambda x: x * x))
        assert found.device == fused.device == DEVICE
        assert log.crossings == (1, 0, 0)
        launches = log.launches
        assert torch.equal(found.cpu(), grad(start, lambda x: x * x))
        # Both ways into the leaf are added in another order where one of them is a kernel.
        torch.testing.assert_close(fused.cpu(), found.cpu())
    assert launches > 10
