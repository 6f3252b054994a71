"""Fuzz the decoder in C under AddressSanitizer and UndefinedBehaviorSanitizer.

    python -m tools.fuzz_c [--count 1000000] [--first 0]
    python -m tools.fuzz_c --libfuzzer CLANG [--count 1000000] [--corpus DIR]

The first decodes mutants of the streams of the suite that are played, with the compiler that CC names (`cc`): damaged
in a packet, and most of them signed again. plugins/c_decoder/tests/mutants.c says what is asked of each. A mutant
follows from its number alone. The second lets libFuzzer look for inputs (on Debian `apt install clang` brings one),
which signs what it makes, too. The exit code is 1 where a mutant failed; its number, or the file of the input, is said.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tools.decoder_in_c import FLAGS, FOLDER, SOURCES, compiler

SEEDS = sorted((FOLDER.parents[1] / "tests" / "conformance" / "play").glob("*.gss"))
CHUNK = 20_000
WATCHED = ("-g", "-fno-sanitize-recover=all")


def build(program: Path, cc: str, *flags: str) -> None:
    """Compile the job. Raises RuntimeError where it does not compile."""
    files = [*map(str, SOURCES), str(FOLDER / "tests" / "mutants.c")]
    done = subprocess.run(
        [cc, *FLAGS, *WATCHED, *flags, *files, "-lm", "-o", str(program)], capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{cc} does not compile the job: {done.stderr}")


def fuzz(program: Path, first: int, count: int) -> tuple[Counter[str], list[str]]:
    """Return what came of mutants, and of each process that ended early its last words."""
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    at = first
    while at < first + count:
        many = min(CHUNK, first + count - at)
        command = [str(program), str(at), str(many), *map(str, SEEDS)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if done.returncode == 0:
            outcomes.update({name: int(number) for number, name in re.findall(r"(\d+) ([a-z ]+)", done.stdout)})
            at += many
            continue
        numbers = re.findall(r"mutant (\d+) ", done.stderr)
        failures.append(f"mutant {numbers[-1]}: exit code {done.returncode}: {done.stderr.rpartition(' ')[2][-2000:]}")
        at = int(numbers[-1]) + 1
    return outcomes, failures


def main() -> int:
    """Run the job."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--libfuzzer", metavar="CLANG", help="a clang that has libFuzzer")
    parser.add_argument("--corpus", type=Path, help="where libFuzzer keeps what it found; default: nowhere")
    said = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        program = Path(name) / "job"
        if said.libfuzzer:
            build(program, said.libfuzzer, "-DLIBFUZZER", "-fsanitize=fuzzer,address,undefined")
            corpus = said.corpus or Path(name) / "corpus"
            corpus.mkdir(exist_ok=True)
            command = [
                str(program),
                f"-runs={said.count}",
                "-max_len=20000",
                "-timeout=60",
                str(corpus),
                str(SEEDS[0].parent),
            ]
            return int(subprocess.run(command, check=False).returncode != 0)
        build(program, str(compiler()), "-fsanitize=address,undefined")
        outcomes, failures = fuzz(program, said.first, said.count)
    print(*failures, dict(outcomes), f"{said.count} mutants, {len(failures)} failures", sep="\n")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
