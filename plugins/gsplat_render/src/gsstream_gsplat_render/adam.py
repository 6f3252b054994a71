"""A step of Adam by rows as one kernel in Triton: ``gsstream.parts.backend.adam`` is its truth."""

# Arguments of a kernel are what Triton makes of them: pointers and values of a program.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import torch
import triton
import triton.language as tl

from gsstream.backend import ADAM_BETAS

#: Elements that a program moves, and the largest gradient that is taken, which is the reference's.
BLOCK, MOST = 512, 1e18


@triton.jit(do_not_specialize=["size", "last"])
def _move(
    values,
    gradients,
    first,
    second,
    steps,
    corrections,
    rates,
    is_well,
    rate,
    limit,
    size,
    width,
    by_row,
    by_column,
    last,
    slow,
    slower,
    as_table: tl.constexpr,
    ahead: tl.constexpr,
    block: tl.constexpr,
):
    """Both moments and the values of ``block`` elements; row i has taken ``steps[i]`` steps, this one included.

    ``is_well`` becomes 0 where a gradient is larger than ``limit``, or not a number.
    """
    place = tl.program_id(0) * block + tl.arange(0, block)
    there = place < size
    row = place // width
    taken = tl.minimum(tl.load(steps + row, mask=there, other=1), last)
    gradient = tl.load(gradients + place, mask=there, other=0.0)
    # Not "greater": that is false of what is no number.
    wrong = tl.where(tl.abs(gradient) <= limit, 0, 1)
    if tl.max(wrong, 0) > 0:
        tl.store(is_well, tl.zeros((), tl.uint8))
    mean = tl.load(first + place, mask=there, other=0.0)
    square = tl.load(second + place, mask=there, other=0.0)
    mean += slow * (gradient - mean)
    square = square * (1 - slower) + slower * gradient * gradient
    factor = tl.load(corrections + 3 * taken + ahead, mask=there, other=0.0)
    least = tl.load(corrections + 3 * taken + 2, mask=there, other=1.0)
    way = mean
    if ahead:
        way = mean + slow * (gradient - mean)
    if as_table:
        rate = tl.load(rates + row * by_row + (place % width) * by_column, mask=there, other=0.0)
    change = rate * tl.div_rn(way * factor, tl.sqrt_rn(square) + least)
    tl.store(first + place, mean, mask=there)
    tl.store(second + place, square, mask=there)
    tl.store(values + place, tl.load(values + place, mask=there, other=0.0) - change, mask=there)


def move_table(
    value: torch.Tensor,
    gradient: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    steps: torch.Tensor,
    corrections: torch.Tensor,
    lr: float | torch.Tensor,
    ahead: bool,
) -> torch.Tensor:
    """Move a table [n, ...] and both of its moments in place, as ``ReferenceAdam.move`` does.

    Returns [] bool: no gradient is larger than MOST; else the table is of no use.
    """
    is_well = torch.ones((), dtype=torch.bool, device=value.device)
    if not value.numel():
        return is_well
    size, width, is_table = value.numel(), value.numel() // len(value), isinstance(lr, torch.Tensor)
    rates = lr.expand(len(value), width) if isinstance(lr, torch.Tensor) else value
    _move[(triton.cdiv(size, BLOCK),)](
        values=value,
        gradients=gradient.contiguous(),
        first=exp_avg,
        second=exp_avg_sq,
        steps=steps,
        corrections=corrections,
        rates=rates,
        is_well=is_well.view(torch.uint8),
        rate=0.0 if is_table else lr,
        limit=MOST,
        size=size,
        width=width,
        by_row=rates.stride(0),
        by_column=rates.stride(-1),
        last=len(corrections) - 1,
        slow=1 - ADAM_BETAS[0],
        slower=1 - ADAM_BETAS[1],
        as_table=is_table,
        ahead=int(ahead),
        block=BLOCK,
    )
    return is_well
