"""Which nodes may move this frame."""
