"""How many calls lie between a command and the method."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from gsstream.cli.main import run_command
from gsstream.engine.method.parts import PartsMethod


@pytest.mark.parametrize("settings", [(), ("--set", "stream.on_error=repeat", "--budget", "size=50KB")])
def test_a_method_is_at_most_six_calls_below_the_command(
    settings: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[str]] = []
    step = PartsMethod.step

    def watched(*arguments: object) -> object:
        frame, names = sys._getframe(1), []
        while frame is not None:
            names.append(f"{frame.f_globals['__name__']}.{frame.f_code.co_name}")
            frame = frame.f_back
        seen.append(names)
        return step(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(PartsMethod, "step", watched)
    command = ["run", "--source", "synthetic:frames=2&views=3&width=32&height=24&supersample=1", "--method", "dense"]
    tiny = ["--set", "first_frame.max_iterations=4", "--quiet", "--no-pictures", "--no-video", "--out", str(tmp_path)]
    assert run_command([*command, *tiny, *settings]) == 0
    (names,) = seen
    depth = names.index("gsstream.cli.run.run")
    assert depth < 6, names[: depth + 1]
