"""The gradient of a residual's bits as two kernels in Triton: ``gsstream.parts.residual.rate`` is its truth."""

# Arguments of a kernel are what Triton makes of them: pointers and values of a program.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl

#: Latents of a program; least spread of a channel, symbols, which is that of the reference.
BLOCK, LEAST = 4096, 0.3


@triton.jit(do_not_specialize=["count"])
def _sum(latents, scales, sums, count, width, rows: tl.constexpr, wide: tl.constexpr):
    """Sums of the magnitudes of ``rows`` x ``wide`` symbols by channel."""
    row, channel = tl.program_id(0) * rows + tl.arange(0, rows)[:, None], tl.arange(0, wide)[None, :]
    value = tl.load(latents + row * width + channel, mask=(row < count) & (channel < width), other=0.0)
    scale = tl.load(scales + channel, mask=channel < width, other=1.0)
    # To the nearest even, as torch rounds: a float32 from 2^23 on is whole.
    magnitude = tl.abs(tl.div_rn(value, scale))
    symbol = tl.where(magnitude < 8388608.0, (magnitude + 8388608.0) - 8388608.0, magnitude)
    places = tl.arange(0, wide)
    tl.store(sums + tl.program_id(0) * width + places, tl.sum(symbol, 0), mask=places < width)


@triton.jit(do_not_specialize=["count", "parts"])
def _price(
    gradients,
    latents,
    scales,
    gates,
    sums,
    weights,
    weight,
    count,
    width,
    parts,
    least,
    ln2,
    as_tensor: tl.constexpr,
    rows: tl.constexpr,
    wide: tl.constexpr,
):
    """Add the gradient of the bits of ``rows`` x ``wide`` latents."""
    channels = tl.arange(0, wide)
    total = tl.zeros((wide,), tl.float32)
    for start in range(0, parts, rows):
        part = start + tl.arange(0, rows)[:, None]
        there = (part < parts) & (channels[None, :] < width)
        total += tl.sum(tl.load(sums + part * width + channels[None, :], mask=there, other=0.0), 0)
    spread = tl.maximum(total / count, least)[None, :]
    row, channel = tl.program_id(0) * rows + tl.arange(0, rows)[:, None], channels[None, :]
    there = (row < count) & (channel < width)
    place = row * width + channel
    scale = tl.load(scales + channel, mask=channel < width, other=1.0)
    u = tl.div_rn(tl.load(latents + place, mask=there, other=0.0), scale)
    x = tl.minimum(tl.abs(u), 0.5) / spread
    grown, square = tl.exp(x), x * x
    # Near 0 the difference of the exponentials has no digits left.
    series = x * (1 + square / 6 * (1 + square / 20 * (1 + square / 42)))
    sinh = tl.where(x < 0.5, series, 0.5 * (grown - 1 / grown))
    inside = sinh / (tl.exp(0.5 / spread) - 0.5 * (grown + 1 / grown))
    slope = tl.where(tl.abs(u) < 0.5, inside, 1.0)
    if as_tensor:
        weight = tl.load(weights)
    bits = tl.where(u < 0, -slope, slope) * weight / (spread * scale * ln2)
    is_open = tl.load(gates + row, mask=row < count, other=0.0) > 0
    before = tl.load(gradients + place, mask=there, other=0.0)
    tl.store(gradients + place, before + tl.where(is_open, bits, 0.0), mask=there)


def sum_symbols(latents: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
    """Return [P, L]: sums of the magnitudes of the symbols of each channel, over P groups of rows.

    Arguments:
        latents: [A, L], A > 0. steps: [L] latent units per symbol.
    """
    sizes = _sizes(latents)
    parts = triton.cdiv(len(latents), sizes["rows"])
    sums = latents.new_empty(parts, latents.shape[1])
    _sum[(parts,)](latents, steps, sums, *latents.shape, **sizes)
    return sums


def add_rate(
    gradient: torch.Tensor,
    latents: torch.Tensor,
    steps: torch.Tensor,
    gates: torch.Tensor,
    sums: torch.Tensor,
    weight: float | torch.Tensor,
) -> None:
    """Add to the gradient [A, L] of the latents what ``rate_gradient`` of the reference returns.

    Arguments:
        latents: [A, L], A > 0. steps: [L]. gates: [A].
        sums: [P, L] of :func:`sum_symbols`.
        weight: loss per bit, a number or a tensor [].
    """
    sizes, is_tensor = _sizes(latents), isinstance(weight, torch.Tensor)
    _price[(triton.cdiv(len(latents), sizes["rows"]),)](
        gradients=gradient,
        latents=latents,
        scales=steps,
        gates=gates.contiguous(),
        sums=sums,
        weights=weight if is_tensor else sums,
        weight=0.0 if is_tensor else weight,
        count=len(latents),
        width=latents.shape[1],
        parts=len(sums),
        least=LEAST,
        ln2=math.log(2.0),
        as_tensor=is_tensor,
        **sizes,
    )


def _sizes(latents: torch.Tensor) -> dict[str, int]:
    """Rows and columns of a program."""
    wide = triton.next_power_of_2(latents.shape[1])
    return {"rows": max(1, BLOCK // wide), "wide": wide}
