"""The limit on memory: who sets it, who asks, and what is said."""

from __future__ import annotations

import threading

import pytest

from gsstream.core.errors import InputError
from gsstream.core.memory import VARIABLE, limited_memory, memory_limit, require_memory


def test_the_innermost_limit_counts_and_the_machine_at_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    machine = memory_limit()
    assert 100_000_000 < machine < 1 << 50
    monkeypatch.setenv(VARIABLE, "1.5GB")
    assert memory_limit() == 1_500_000_000
    with limited_memory(10_000), limited_memory(None):
        assert memory_limit() == 10_000
        with limited_memory(5):
            assert memory_limit() == 5
        other: list[int] = []
        thread = threading.Thread(target=lambda: other.append(memory_limit()))
        thread.start()
        thread.join()
        assert other == [1_500_000_000], "a limit is of the thread that set it"
    assert memory_limit() == 1_500_000_000


@pytest.mark.parametrize(
    ("text", "said"),
    [("much", "expected a number"), ("5GiB", "no unit 'GiB'"), ("-1MB", "positive"), ("0", "positive")],
)
def test_a_limit_that_is_none_is_named(monkeypatch: pytest.MonkeyPatch, text: str, said: str) -> None:
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(InputError, match=rf"environment variable {VARIABLE}={text}: .*{said}"):
        require_memory(1, "anything")


def test_what_is_within_the_limit_passes_and_one_byte_more_does_not() -> None:
    with limited_memory(20_000_000):
        require_memory(20_000_000, "a picture")
        with pytest.raises(InputError, match=r"a picture takes about 20 MB; the limit is 20 MB. Raise --max-memory"):
            require_memory(20_000_001, "a picture")
