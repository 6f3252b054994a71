"""The images of a frame where they are worked on."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.parts.render.images import float_image


class FrameImages:
    """The images [H, W, 3] of one frame on a device, copied as they are stored when first asked for."""

    def __init__(self, images: Any, device: torch.device) -> None:
        self._images, self.device = images, device
        self._there: dict[int, torch.Tensor] = {}

    def __len__(self) -> int:
        return len(self._images)

    def stored(self, view: int) -> torch.Tensor:
        """Return [H, W, 3] as it is stored: float32, or uint8 of which 255 is 1.0."""
        if view not in self._there:
            self._there[view] = torch.from_numpy(self._images[view]).to(self.device)
        return self._there[view]

    def __getitem__(self, view: int) -> torch.Tensor:
        return float_image(self.stored(view))

    def all_stored(self) -> list[torch.Tensor]:
        """Return the images of all views as they are stored."""
        return [self.stored(view) for view in range(len(self))]
