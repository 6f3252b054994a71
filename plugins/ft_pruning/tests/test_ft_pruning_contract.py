"""Fixed-threshold pruning keeps the contract at all thresholds of the paper."""

from __future__ import annotations

from gsstream_ft_pruning.fixed_threshold import FixedThreshold

from gsstream.testing import parametrize_with_checks


@parametrize_with_checks([FixedThreshold(FixedThreshold.Config(tau=tau)) for tau in (0.5, 0.8, 0.9, 0.95)])
def test_contract(check) -> None:
    check()
