"""A command that costs a second before its help is seen."""

import torch

assert torch


def heavy() -> None:
    """A command whose module imports torch."""
