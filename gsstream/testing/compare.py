"""Comparisons that fail with numbers: largest deviation, where, what was expected, and where the tolerance is from."""

from __future__ import annotations

from collections.abc import Mapping

import torch

EXACT = "bitwise: the same operations on the same numbers"
ROUNDING = "float32 rounding over a few hundred terms"
#: Share of the largest gradient of a scene. A gradient that is smaller than this share all over, such as
#: the gradient of the rotation of round Gaussians, is the rest of large terms that cancel: its digits are rounding.
FLOOR = 0.01


def equal(what: str, got: torch.Tensor, expected: torch.Tensor, tolerance: float = 0.0, why: str = EXACT) -> None:
    """Raise AssertionError unless shape and dtype agree and no value is farther off than ``tolerance``.

    ``tolerance`` is absolute up to a magnitude of 1 and relative above; ``why`` says why it is what it is.
    """
    assert got.shape == expected.shape, f"{what}: expected shape {list(expected.shape)}, got {list(got.shape)}"
    assert got.dtype == expected.dtype, f"{what}: expected {expected.dtype}, got {got.dtype}"
    if got.numel() == 0:
        return
    off = (got.double() - expected.double()).abs() / expected.double().abs().clamp_min(1.0)
    same = (got == expected) | (torch.isnan(got.double()) & torch.isnan(expected.double()))
    off = torch.where(same, torch.zeros_like(off), torch.where(torch.isnan(off), torch.full_like(off, torch.inf), off))
    worst = int(off.flatten().argmax())
    assert float(off.flatten()[worst]) <= tolerance, (
        f"{what}: largest deviation {float(off.flatten()[worst]):.3g} at flat index {worst}: expected "
        f"{expected.flatten()[worst].item()!r}, got {got.flatten()[worst].item()!r} "
        f"(tolerance {tolerance:g}: {why})"
    )


def all_equal(
    what: str,
    got: Mapping[str, torch.Tensor],
    expected: Mapping[str, torch.Tensor],
    tolerance: float = 0.0,
    why: str = EXACT,
) -> None:
    """Apply :func:`equal` to every named tensor; the names must agree too."""
    assert set(got) == set(expected), f"{what}: expected the outputs {sorted(expected)}, got {sorted(got)}"
    for name, value in expected.items():
        equal(f"{what}: {name}", got[name], value, tolerance=tolerance, why=why)


def relative(what: str, got: torch.Tensor, expected: torch.Tensor, tolerance: float, why: str, *, floor: float) -> None:
    """Apply :func:`equal` to fractions of the largest expected value, which is taken to be at least ``floor``."""
    assert floor > 0, f"{what}: expected a floor above 0, got {floor}"
    scale = max(float(expected.abs().max()), floor) if expected.numel() else 1.0
    equal(f"{what}, as fractions of {scale:.3g}", got / scale, expected / scale, tolerance=tolerance, why=why)


def gradients_equal(
    what: str, got: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor], tolerance: float, why: str
) -> None:
    """Apply :func:`relative` to every gradient of a scene, each with the same floor; the names must agree too."""
    assert set(got) == set(expected), f"{what}: expected gradients of {sorted(expected)}, got {sorted(got)}"
    largest = max(float(value.abs().max()) for value in expected.values() if value.numel())
    assert largest > 0, f"{what}: every expected gradient is 0, so nothing would be compared"
    for name, value in expected.items():
        relative(f"{what}: gradient of {name}", got[name], value, tolerance=tolerance, why=why, floor=FLOOR * largest)


def at_most(what: str, got: torch.Tensor, bound: torch.Tensor | float, tolerance: float, why: str) -> None:
    """Raise AssertionError unless every value is <= ``bound`` + ``tolerance``; NaN never is."""
    if got.numel() == 0:
        return
    limit = torch.as_tensor(bound, dtype=torch.float64).expand(got.shape)
    over = got.double() - limit
    bad = ~(over <= tolerance)
    if not bool(bad.any()):
        return
    worst = int(torch.where(torch.isnan(over), torch.full_like(over, torch.inf), over).flatten().argmax())
    raise AssertionError(
        f"{what}: {int(bad.sum())} of {got.numel()} values exceed their bound, worst at flat index {worst}: "
        f"expected at most {limit.flatten()[worst].item():.6g}, got {got.flatten()[worst].item():.6g} "
        f"(tolerance {tolerance:g}: {why})"
    )


def finite(what: str, value: torch.Tensor) -> None:
    """Raise AssertionError naming the first value that is not finite."""
    bad = (~torch.isfinite(value)).nonzero()
    assert len(bad) == 0, (
        f"{what}: expected finite values, got {value[tuple(bad[0])].item()} at index {bad[0].tolist()} "
        f"({len(bad)} of {value.numel()} values are not finite)"
    )
