"""The job that fuzzes the decoder in C: mutants are counted, and one that fails is named and does not end the job."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import fuzz_c
from tools.decoder_in_c import compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


def test_every_mutant_is_counted_and_follows_from_its_number(tmp_path: Path) -> None:
    program = tmp_path / "job"
    fuzz_c.build(program, str(compiler()))
    outcomes, failures = fuzz_c.fuzz(program, 5, 300)
    assert failures == []
    assert outcomes["refused"] + outcomes["played"] + outcomes["without memory"] == 300
    assert outcomes["refused"] > outcomes["played"] > 0
    halves = [fuzz_c.fuzz(program, first, 150)[0] for first in (5, 155)]
    assert halves[0] + halves[1] == outcomes


def test_a_mutant_that_fails_is_named_and_the_next_ones_run(tmp_path: Path) -> None:
    program = tmp_path / "job"
    program.write_text(
        "#!/bin/sh\n"
        "for i in $(seq $1 $(($1 + $2 - 1))); do printf '\\rmutant %d ' $i >&2; [ $i = 7 ] && exit 134; done\n"
        'echo "$2 frames, $2 refused, 0 played, 0 without memory"\n'
    )
    program.chmod(0o755)
    outcomes, failures = fuzz_c.fuzz(program, 0, 20)
    assert [failure.split(":")[0] for failure in failures] == ["mutant 7"]
    assert outcomes["refused"] == 12
