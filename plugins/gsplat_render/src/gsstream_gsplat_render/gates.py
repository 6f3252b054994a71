"""Gates and their penalty in closed form as two kernels in Triton.

``AnalyticGate`` and ``AnalyticPenalty`` of ``gsstream.parts`` are their truth: where a gate and a regulariser say that
they are of that form, no graph is built for them.
"""

# Arguments of a kernel are what Triton makes of them: pointers and values of a program.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import torch
import triton
import triton.language as tl

#: Rows of a program.
BLOCK = 256


@triton.jit(do_not_specialize=["count"])
def _open(logits, node_of, opened, slopes, count, temperature, offset, levels, block: tl.constexpr):
    """Gates of ``block`` rows, and their derivatives by the logits."""
    row = tl.program_id(0) * block + tl.arange(0, block)
    there = row < count
    x = tl.div_rn(tl.load(logits + tl.load(node_of + row, mask=there, other=0), mask=there, other=0.0), temperature)
    x += offset
    soft = tl.sigmoid(x)
    # To the nearest even, as torch rounds; there are at most 255 levels.
    steps = (soft * levels + 8388608.0) - 8388608.0
    tl.store(opened + row, tl.div_rn(steps, levels), mask=there)
    tl.store(slopes + row, tl.div_rn(soft * tl.sigmoid(-x), temperature), mask=there)


@triton.jit(do_not_specialize=["count"])
def _pull(
    by_gate,
    slopes,
    position,
    logits,
    node_of,
    by_logit,
    by_position,
    count,
    wide,
    open_logit,
    open_weight,
    displacement_weight,
    block: tl.constexpr,
):
    """What images and penalty say of the logits, added up, and what the penalty says of the positions."""
    row = tl.program_id(0) * block + tl.arange(0, block)
    there = row < count
    node = tl.load(node_of + row, mask=there, other=0)
    margin = tl.load(logits + node, mask=there, other=0.0) - open_logit
    probability = tl.sigmoid(margin)
    x = tl.load(position + row * wide, mask=there, other=0.0)
    y = tl.load(position + row * wide + 1, mask=there, other=0.0)
    z = tl.load(position + row * wide + 2, mask=there, other=0.0)
    price = open_weight + displacement_weight * (x * x + y * y + z * z)
    pull = price * probability * tl.sigmoid(-margin)
    pull += tl.load(by_gate + row, mask=there, other=0.0) * tl.load(slopes + row, mask=there, other=0.0)
    tl.atomic_add(by_logit + node, pull, mask=there)
    weight = 2 * displacement_weight * probability
    tl.store(by_position + 3 * row, weight * x, mask=there)
    tl.store(by_position + 3 * row + 1, weight * y, mask=there)
    tl.store(by_position + 3 * row + 2, weight * z, mask=there)


def open_gates(
    logits: torch.Tensor, node_of: torch.Tensor, temperature: float, offset: float, levels: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the gates [A] of rows, and their derivatives [A] by the logits, as ``AnalyticGate.gates`` has them.

    Arguments:
        logits: [M]. node_of: [A] int64, the logit of each row.
        temperature, offset, levels: of the form.
    """
    count = len(node_of)
    opened, slopes = logits.new_empty(count), logits.new_empty(count)
    given = logits, node_of, opened, slopes, count
    _open[(triton.cdiv(count, BLOCK),)](*given, float(temperature), float(offset), float(levels), block=BLOCK)
    return opened, slopes


def gate_gradients(
    by_gate: torch.Tensor,
    slopes: torch.Tensor,
    position: torch.Tensor,
    logits: torch.Tensor,
    node_of: torch.Tensor,
    open_logit: float,
    open_weight: float,
    displacement_weight: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the gradients of images and penalty by the logits [M], and of the penalty by the positions [A, 3].

    Sums over the rows of a logit run in no fixed order.

    Arguments:
        by_gate: [A] gradient of the loss by the gates. slopes: [A] of :func:`open_gates`.
        position: [A, 3] ungated position residual, cells; its rows may lie apart.
        logits, node_of: as for :func:`open_gates`.
        open_logit: of the form.
        open_weight, displacement_weight: of the penalty, divided by what it is a mean of.
    """
    count = len(node_of)
    by_logit, by_position = torch.zeros_like(logits), position.new_empty(count, 3)
    given = by_gate.contiguous(), slopes, position, logits, node_of, by_logit, by_position, count, position.stride(0)
    numbers = float(open_logit), float(open_weight), float(displacement_weight)
    _pull[(triton.cdiv(count, BLOCK),)](*given, *numbers, block=BLOCK)
    return by_logit, by_position
