"""The loss of a GPU, (1 - w) L1 + w (1 - SSIM) and its gradient, as two kernels in Triton and a sum.

The window of SSIM is separable, and to slide it over a block of pixels is to multiply the block by a matrix of eleven
diagonals from either side. A program takes a tile of 16 x 16 pixels and so much around it that its block is 32 x 32:
every plane is read once, and nothing between two passes goes through memory.

One kernel compares, the other carries the gradients by the windows back to the pixels under them. Both skip tiles that
are not asked for, so that their cost follows what changed. Formulas are those of ``gsstream.parts.render.loss``.
"""

# Arguments of a kernel are what Triton makes of them: pointers and values of a program.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl

#: Pixels of a tile's edge, of a block's, and from a block's edge to its tile's: five are needed, eight fit.
TILE, BLOCK, BORDER = tl.constexpr(16), tl.constexpr(32), tl.constexpr(8)
#: Half of the window, pixels; twice its variance; Wang et al.: (0.01 L)^2 and (0.03 L)^2 for values from 0 to L = 1.
RADIUS, SPREAD = tl.constexpr(5), tl.constexpr(2 * 1.5**2)
C1, C2 = tl.constexpr(0.01**2), tl.constexpr(0.03**2)


@triton.jit
def _diagonals(weights):
    """[TILE, BLOCK]: row i has the weights of the window around pixel i of the tile."""
    across = tl.arange(0, BLOCK)[None, :] - BORDER - tl.arange(0, TILE)[:, None] + RADIUS
    return tl.load(weights + across, mask=(across >= 0) & (across <= 2 * RADIUS), other=0.0)


@triton.jit
def _windowed(window, block):
    """[TILE, TILE]: means over the window around every pixel of the tile, of a block [BLOCK, BLOCK]."""
    down = tl.dot(window, block, input_precision="ieee")
    return tl.dot(down, tl.trans(window), input_precision="ieee")


@triton.jit
def _block(x, y, height, width):
    """Rows and columns of the block around a tile, and which of its pixels the windows of the tile reach."""
    rows = y * TILE - BORDER + tl.arange(0, BLOCK)[:, None]
    columns = x * TILE - BORDER + tl.arange(0, BLOCK)[None, :]
    # Beyond the windows nothing is read, for a weight of 0 does not help against what was never written.
    near = (rows >= y * TILE - RADIUS) & (rows < (y + 1) * TILE + RADIUS)
    near = near & (columns >= x * TILE - RADIUS) & (columns < (x + 1) * TILE + RADIUS)
    return rows, columns, near & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)


@triton.jit
def _is_asked(tiles, x, y, wide, high, around: tl.constexpr, all_tiles: tl.constexpr):
    """Whether the mask marks this tile, or with ``around`` 1 one beside it."""
    if all_tiles:
        return tl.full((), 1, tl.int32)
    rows, columns = y - 1 + tl.arange(0, 4)[:, None], x - 1 + tl.arange(0, 4)[None, :]
    inside = (rows >= 0) & (rows < high) & (columns >= 0) & (columns < wide)
    near = (tl.abs(rows - y) <= around) & (tl.abs(columns - x) <= around)
    marks = tl.load(tiles + rows * wide + columns, mask=inside & near, other=0)
    return tl.max(tl.max(marks.to(tl.int32), 1), 0)


@triton.jit
def _compare(
    image,
    target,
    tiles,
    weights,
    sums,
    grads,
    height,
    width,
    row,
    column,
    channel,
    dssim,
    as_bytes: tl.constexpr,
    all_tiles: tl.constexpr,
):
    """Sum of the loss over one tile, and the gradients by the three means of the window around each of its pixels."""
    x, y, wide, high = tl.program_id(0), tl.program_id(1), tl.num_programs(0), tl.num_programs(1)
    total = tl.zeros((TILE, TILE), tl.float32)
    if _is_asked(tiles, x, y, wide, high, 1, all_tiles) > 0:
        window = _diagonals(weights)
        r, c = y * TILE + tl.arange(0, TILE)[:, None], x * TILE + tl.arange(0, TILE)[None, :]
        rows, columns, there = _block(x, y, height, width)
        is_pixel = (r < height) & (c < width)
        for k in range(3):
            a = tl.load(image + rows * row + columns * column + k * channel, mask=there, other=0.0)
            b = tl.load(target + (rows * width + columns) * 3 + k, mask=there, other=0)
            here = tl.load(image + r * row + c * column + k * channel, mask=is_pixel, other=0.0)
            wanted = tl.load(target + (r * width + c) * 3 + k, mask=is_pixel, other=0)
            if as_bytes:
                b, wanted = tl.div_rn(b.to(tl.float32), 255.0), tl.div_rn(wanted.to(tl.float32), 255.0)
            mean, mean_b = _windowed(window, a), _windowed(window, b)
            square, square_b = _windowed(window, a * a), _windowed(window, b * b)
            product = _windowed(window, a * b)
            both, energy, energy_b = mean * mean_b, mean * mean, mean_b * mean_b
            luminance, contrast = 2 * both + C1, 2 * (product - both) + C2
            means, variances = energy + (energy_b + C1), square - energy + (square_b - energy_b + C2)
            by_product = tl.div_rn(luminance, means * variances)
            similar = by_product * contrast
            by_square = tl.div_rn(similar, variances)
            by_mean = mean_b * (tl.div_rn(similar, luminance) - by_product)
            by_mean += mean * (by_square - tl.div_rn(similar, means))
            total += tl.where(is_pixel, (1 - dssim) * tl.abs(here - wanted) + dssim * (1 - similar), 0.0)
            place, plane = grads + (k * height + r) * width + c, 3 * height * width
            tl.store(place, 2 * by_mean, mask=is_pixel)
            tl.store(place + plane, -by_square, mask=is_pixel)
            tl.store(place + 2 * plane, 2 * by_product, mask=is_pixel)
    tl.store(sums + y * wide + x, tl.sum(tl.sum(total, 1), 0))


@triton.jit
def _pull_back(
    image,
    target,
    tiles,
    weights,
    grads,
    out,
    height,
    width,
    row,
    column,
    channel,
    dssim,
    scale,
    as_bytes: tl.constexpr,
    all_tiles: tl.constexpr,
):
    """The gradient of the loss by the pixels of one tile; 0 where it is not asked for."""
    x, y, wide, high = tl.program_id(0), tl.program_id(1), tl.num_programs(0), tl.num_programs(1)
    r, c = y * TILE + tl.arange(0, TILE)[:, None], x * TILE + tl.arange(0, TILE)[None, :]
    is_pixel, place = (r < height) & (c < width), out + (r * width + c) * 3
    if _is_asked(tiles, x, y, wide, high, 0, all_tiles) > 0:
        window = _diagonals(weights)
        rows, columns, there = _block(x, y, height, width)
        for k in range(3):
            start, plane = grads + (k * height + rows) * width + columns, 3 * height * width
            by_mean = _windowed(window, tl.load(start, mask=there, other=0.0))
            by_square = _windowed(window, tl.load(start + plane, mask=there, other=0.0))
            by_product = _windowed(window, tl.load(start + 2 * plane, mask=there, other=0.0))
            here = tl.load(image + r * row + c * column + k * channel, mask=is_pixel, other=0.0)
            wanted = tl.load(target + (r * width + c) * 3 + k, mask=is_pixel, other=0)
            if as_bytes:
                wanted = tl.div_rn(wanted.to(tl.float32), 255.0)
            difference = here - wanted
            sign = tl.where(difference > 0, 1.0, tl.where(difference < 0, -1.0, 0.0))
            by_ssim = by_mean + 2 * here * by_square + wanted * by_product
            tl.store(place + k, scale * ((1 - dssim) * sign - dssim * by_ssim), mask=is_pixel)
    else:
        for k in range(3):
            tl.store(place + k, tl.zeros((TILE, TILE), tl.float32), mask=is_pixel)


def loss_by_tile(
    image: torch.Tensor, target: torch.Tensor, dssim: float, tile_mask: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sum of the loss over each tile [ceil(H / 16), ceil(W / 16)], and its gradients by every window.

    Those are [3, 3, H, W], by the mean of the image, of its square and of its product with the target, channel by
    channel. They are written in marked tiles and those beside; elsewhere the sum is 0 and the gradients are anything.

    Arguments:
        image: [H, W, 3] float32 in any strides. target: [H, W, 3] float32 or uint8, contiguous.
        dssim: weight w. tile_mask: [ceil(H / 16), ceil(W / 16)] bool; None: all.
    """
    high, wide = _tiles_of(image)
    sums, grads = image.new_empty(high, wide), image.new_empty(3, 3, *image.shape[:2])
    _compare[wide, high](
        *_given(image, target, tile_mask), sums, grads, *_sizes(image), dssim, **_kind(target, tile_mask)
    )
    return sums, grads


def gradient_by_pixel(
    image: torch.Tensor, target: torch.Tensor, by_window: torch.Tensor, dssim: float, tile_mask: torch.Tensor | None
) -> torch.Tensor:
    """Return the gradient [H, W, 3] of the mean loss, given those by every window that :func:`loss_by_tile` found."""
    high, wide = _tiles_of(image)
    out, scale = image.new_empty(image.shape), 1 / image.numel()
    given = _given(image, target, tile_mask)
    _pull_back[wide, high](*given, by_window, out, *_sizes(image), dssim, scale, **_kind(target, tile_mask))
    return out


def _tiles_of(image: torch.Tensor) -> tuple[int, int]:
    return triton.cdiv(image.shape[0], TILE.value), triton.cdiv(image.shape[1], TILE.value)


def _given(image: torch.Tensor, target: torch.Tensor, tile_mask: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
    tiles = target if tile_mask is None else tile_mask.contiguous().view(torch.uint8)
    return image, target, tiles, _window_weights(image.device)


def _sizes(image: torch.Tensor) -> tuple[int, ...]:
    return (*image.shape[:2], *image.stride())


def _kind(target: torch.Tensor, tile_mask: torch.Tensor | None) -> dict[str, bool]:
    return {"as_bytes": target.dtype == torch.uint8, "all_tiles": tile_mask is None}


@functools.cache
def _window_weights(device: torch.device) -> torch.Tensor:
    """Return the weights [11] of the window along one axis; kept, so that they cross to a device once."""
    places = torch.arange(-RADIUS.value, RADIUS.value + 1, dtype=torch.float64)
    weights = torch.exp(-places * places / SPREAD.value)
    return (weights / weights.sum()).float().to(device)
