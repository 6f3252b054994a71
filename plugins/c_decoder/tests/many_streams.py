"""All streams of the suite through one process: starting one for each takes longer than decoding them."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence

from gsstream.packet.conformance import Case, Outcome


def play_all(program: Sequence[str], cases: Sequence[Case]) -> list[Outcome]:
    """What a program prints of each stream. It takes several paths, and prints ``file PATH`` before the lines of each.

    A process has one exit code, so that of a stream is told by its last line; single streams are played by
    ``play_with``, which reads the code of the process.
    """
    command = [*program, *(str(case.path) for case in cases)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (int(any(case.refused for case in cases)), "")
    streams = [text.splitlines() for text in re.split(r"^file ", done.stdout, flags=re.M)[1:]]
    assert [path for path, *_ in streams] == [str(case.path) for case in cases]
    return [Outcome(tuple(lines), int(any(line.startswith("refused") for line in lines))) for _, *lines in streams]
