"""``codec.trim``: what explains least per bit is not sent."""

from pathlib import Path

import pytest
from flow_runs import encode, metrics

#: Motions give up nothing, so a share of the whole packet is one of the residual only without them.
EDGE = {"method": "s2gs-edge", "motion": "still"}


def sizes(out: Path) -> list[int]:
    return [sum(frame["bytes"].values()) for frame in metrics(out)]


@pytest.mark.parametrize("trim", [0.3, 0.6])
def test_the_share_is_of_the_bytes_that_are_real(tmp_path: Path, trim: float) -> None:
    whole, trimmed = tmp_path / "whole", tmp_path / "trimmed"
    encode(whole, "--frames", "2", codec__trim=0, **EDGE)
    stream = encode(trimmed, "--frames", "2", codec__trim=trim, **EDGE)
    before, after = sizes(whole), sizes(trimmed)
    assert abs(before[0] - after[0]) < 8, "a key packet is not trimmed, it only names another recipe"
    assert 0.5 * (1 - trim) * before[1] < after[1] <= (1 - trim) * before[1]
    assert len(stream) >= sum(after)
    moved = [frame["psnr_moving"]["test"] for out in (whole, trimmed) for frame in metrics(out)[1:]]
    assert all(value is None or value > 5 for value in moved)


def test_a_share_never_takes_the_whole_change(tmp_path: Path) -> None:
    """Of a packet that is mostly headers, three tenths were everything: a flash was sent as "nothing changed"."""
    encode(tmp_path, "--frames", "3", codec__trim=0.999, **EDGE)
    assert all(frame["changed_gaussians"] > 0 for frame in metrics(tmp_path)[1:])
