"""Images as renderers take them: bytes as float32, and tiles of 16 x 16 pixels, which the border may cut off."""

from __future__ import annotations

import torch

from gsstream.core.errors import ShapeError

#: Side of a tile, pixels.
TILE = 16


def float_image(stored: torch.Tensor) -> torch.Tensor:
    """Return the float32 image of one that is stored as float32 or as uint8 (255 is 1.0), where it lies.

    It is, bit for bit, the one of ``gsstream.core.storage.unpacked``.
    """
    if stored.is_floating_point():
        return stored
    # Divided by a tensor, as numpy divides: a product with 1 / 255 would be another number.
    return stored.float() / stored.new_full((), 255, dtype=torch.float32)


def spread_to_pixels(tiles: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Return [height, width]: for every pixel the value of its tile, of ``tiles`` [ceil(H / 16), ceil(W / 16)]."""
    rows, columns = tiles.shape
    wide = tiles[:, None, :, None].expand(rows, TILE, columns, TILE)
    return wide.reshape(rows * TILE, columns * TILE)[:height, :width]


def check_tiles(tiles: torch.Tensor, size: tuple[int, int]) -> None:
    """Raise ShapeError unless ``tiles`` is bool [ceil(H / 16), ceil(W / 16)] for an image of ``size`` (H, W)."""
    wanted = [-(-side // TILE) for side in size]
    if tiles.dtype != torch.bool or list(tiles.shape) != wanted:
        raise ShapeError(
            f"tiles: expected bool {wanted} ({TILE} x {TILE} pixel tiles of a {size[1]} x {size[0]} image), got "
            f"{tiles.dtype} {list(tiles.shape)}; give one mark per tile"
        )
