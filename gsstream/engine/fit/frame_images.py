"""The images of a frame where they are worked on."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.storage import packed, unpacked


class FrameImages:
    """The images of one frame as float32 tensors [H, W, 3] on a device, copied (as bytes) when first asked for."""

    def __init__(self, images: Any, device: torch.device) -> None:
        self._images, self.device = images, device
        self._there: dict[int, torch.Tensor] = {}

    def __len__(self) -> int:
        return len(self._images)

    def stored(self, view: int) -> torch.Tensor:
        """Return [H, W, 3] as it is stored, float32 or uint8, where it is worked on by the processor; else float32."""
        return torch.from_numpy(self._images[view]) if self.device.type == "cpu" else self[view]

    def __getitem__(self, view: int) -> torch.Tensor:
        if self.device.type == "cpu":
            return torch.from_numpy(unpacked(self._images[view]))
        if view not in self._there:
            stored = torch.from_numpy(packed(self._images[view])).to(self.device)
            # Divided by a tensor, as the processor divides: a product with 1 / 255 would be another number.
            full = stored.new_full((), 255, dtype=torch.float32)
            self._there[view] = stored if stored.is_floating_point() else stored.float() / full
        return self._there[view]
