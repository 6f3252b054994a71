"""What the tests' own browser driver must survive."""

from __future__ import annotations

import itertools
import subprocess
import threading
import time
from pathlib import Path

from node_runs import HERE, NODE, needs_node


@needs_node
def test_a_profile_is_removed_while_dying_processes_write_to_it(tmp_path: Path) -> None:
    """Regression: children of a killed browser wrote files between emptying the profile and removing it (ENOTEMPTY)."""
    inner = tmp_path / "profile" / "Default"
    inner.mkdir(parents=True)
    for number in range(3000):  # so many that emptying the folder takes longer than writing one file
        (inner / f"old{number}").touch()
    end = time.monotonic() + 2
    written = []

    def write() -> None:
        for number in itertools.count():
            if time.monotonic() > end:
                return
            try:
                (inner / f"new{number}").touch()
            except FileNotFoundError:  # the folder is gone, as it should be
                return
            written.append(number)

    writer = threading.Thread(target=write)
    writer.start()
    command = [str(NODE), str(HERE / "removed_while_written.mjs"), str(tmp_path / "profile")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    writer.join()
    assert done.stdout.strip() == "gone", done.stderr
    assert written, "nothing was written during the removal, so the test tested nothing"
