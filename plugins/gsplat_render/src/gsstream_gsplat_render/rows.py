"""The functions of ``placed.py`` as kernels in Triton, one launch each for all six tables of a scene."""

# Arguments of a kernel are what Triton makes of them: pointers and values of a program.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl

#: Rows of a program.
BLOCK = 64


@triton.jit
def _copy(some, whole, index, number, width: tl.constexpr, wide: tl.constexpr, into: tl.constexpr, block: tl.constexpr):
    """``block`` rows of one table: into the whole, or out of it."""
    row, column = tl.program_id(0) * block + tl.arange(0, block)[:, None], tl.arange(0, wide)[None, :]
    there = (row < number) & (column < width)
    place = tl.load(index + row, mask=row < number, other=0) * width + column
    if into:
        tl.store(whole + place, tl.load(some + row * width + column, mask=there, other=0.0), mask=there)
    else:
        tl.store(some + row * width + column, tl.load(whole + place, mask=there, other=0.0), mask=there)


@triton.jit(do_not_specialize=["count"])
def _exchange(
    index,
    means,
    quats,
    scales,
    opacities,
    sh0,
    shN,
    all_means,
    all_quats,
    all_scales,
    all_opacities,
    all_sh0,
    all_shN,
    count,
    higher: tl.constexpr,
    wide: tl.constexpr,
    into: tl.constexpr,
    block: tl.constexpr,
):
    """Tables one after the other, by the second number of the program."""
    table = tl.program_id(1)
    if table == 0:
        _copy(means, all_means, index, count, 3, 4, into, block)
    elif table == 1:
        _copy(quats, all_quats, index, count, 4, 4, into, block)
    elif table == 2:
        _copy(scales, all_scales, index, count, 3, 4, into, block)
    elif table == 3:
        _copy(opacities, all_opacities, index, count, 1, 1, into, block)
    elif table == 4:
        _copy(sh0, all_sh0, index, count, 3, 4, into, block)
    else:
        _copy(shN, all_shN, index, count, higher, wide, into, block)


def put_rows(index: torch.Tensor, *tables: torch.Tensor) -> None:
    """Do what ``placed.put_rows`` does."""
    _launch(index, tables, into=True)


def take_rows(index: torch.Tensor, *whole: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return what ``placed.take_rows`` does."""
    given = [table.contiguous() for table in whole]
    rows = tuple(table.new_empty(len(index), *table.shape[1:]) for table in given)
    _launch(index, (*rows, *given), into=False)
    return rows


def _launch(index: torch.Tensor, tables: Sequence[torch.Tensor], *, into: bool) -> None:
    if not len(index):
        return
    higher = tables[5][0].numel()
    grid = triton.cdiv(len(index), BLOCK), 6 if higher else 5
    sizes = {"higher": higher, "wide": triton.next_power_of_2(max(higher, 1))}
    given = [table.contiguous() if into else table for table in tables[:6]]
    _exchange[grid](index, *given, *tables[6:], len(index), **sizes, into=into, block=BLOCK)
