"""Hold the browser's decoder against Python's on damaged and lying streams, piece by piece, and keep the result.

Usage: python -m tools.web_fuzz --count 20000 --out FILE

The cases are those of tests/web/decoder_fuzz.py and follow from (seed, number) alone. Pieces that the file holds are
not run again, so the job can be ended at any time. The exit code is 1 when a case failed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "web"))


def main() -> int:
    """Run the pieces that are missing and write the file after each."""
    from decoder_fuzz import fuzz

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000, help="number of cases")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--chunk", type=int, default=1000, help="cases in one piece")
    parser.add_argument("--out", type=Path, required=True, help="JSON file with what was found; it is continued")
    given = parser.parse_args()
    found = {"seed": given.seed, "pieces": []}
    if given.out.exists():
        found = json.loads(given.out.read_text())
    if found["seed"] != given.seed:
        parser.error(f"{given.out} holds cases of seed {found['seed']}: expected that seed or another file")
    done = {piece["first"] for piece in found["pieces"]}
    for first in range(0, given.count, given.chunk):
        if first in done:
            continue
        started, count = time.process_time(), min(given.chunk, given.count - first)
        outcomes, failures = fuzz(count, given.seed, first=first, chunk=count)
        piece = {
            "first": first, "count": count, "refused": sum(v for k, v in outcomes.items() if k.endswith("refused")),
            "played": sum(v for k, v in outcomes.items() if k.endswith("played")), "failures": failures,
            "python_seconds": round(time.process_time() - started, 1),
        }  # fmt: skip
        found["pieces"].append(piece)
        given.out.write_text(json.dumps(found, indent=1) + "\n")
        print(piece, flush=True)
    failed = sum(len(piece["failures"]) for piece in found["pieces"])
    print(f"{sum(piece['count'] for piece in found['pieces'])} cases, {failed} failures")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
