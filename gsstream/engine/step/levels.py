"""Progressive training: which units (octree levels) take part at which moment of a frame."""

from __future__ import annotations

from gsstream.recipe.model import Stream


def level_schedule(stream: Stream, num_levels: int) -> tuple[tuple[float, int], ...]:
    """Return pairs (fraction of the frame until which, finest level that takes part) (paper, supplement).

    Starts at level floor(H / 2); each finer level's stage is omega times longer, N_{i+1} = omega N_i. Empty when the
    recipe does not ask for it or there is nothing to hold back. The paper leaves omega and the treatment of inactive
    levels open: here they keep their previous attributes.
    """
    first = num_levels // 2
    if not stream.progressive or num_levels - first < 2:
        return ()
    weights = [stream.progressive_omega**i for i in range(num_levels - first)]
    ends = [sum(weights[: i + 1]) / sum(weights) for i in range(len(weights))]
    return tuple((end, first + i) for i, end in enumerate(ends))


def current_level(schedule: tuple[tuple[float, int], ...], fraction: float) -> int:
    """Return the finest level that takes part at this fraction [0, 1) of the frame's iterations."""
    return next((level for end, level in schedule if fraction < end), schedule[-1][1])
