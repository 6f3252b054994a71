"""Soak: generated scenes through random valid recipes; every stream is held against its encoder, bit by bit.

Usage: python -m tools.soak --minutes 60 --seed 0 --out DIR
       python -m tools.soak --seed 0 --only 123 --out DIR      one case again, with its traceback

Writes runs.jsonl (one line per case: command, outcome, resident size) and summary.json. The work happens in a process
of its own: a case that hangs longer than --limit seconds or kills the process is recorded, and a new process goes on
with the next. The exit code is 1 when a case failed, hung or died, or when the resident size grew by more than 5 %.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import gc
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.soak.summary import summarise

ROOT = Path(__file__).parents[2]
RUNS, CURRENT, HANG, SUMMARY = "runs.jsonl", "current.json", "hang.txt", "summary.json"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--first", type=int, default=0, help="index of the first case")
    parser.add_argument("--only", type=int, help="run this case alone, here")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds after which a case counts as hung")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    if given.only is not None:
        record = work(given.seed, given.only, None, limit=given.limit, out=given.out)
        print(record["command"], record["outcome"]["problem"] or json.dumps(record["outcome"]), sep="\n")
        return int(record["outcome"]["status"] == "failed")
    if given.worker:
        work(given.seed, given.first, time.time() + 60 * given.minutes, limit=given.limit, out=given.out)
        return 0
    supervise(given.seed, given.first, time.time() + 60 * given.minutes, limit=given.limit, out=given.out)
    summary = summarise(read_runs(given.out))
    (given.out / SUMMARY).write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(summary, indent=1))
    return 0 if summary["clean"] else 1


def supervise(seed: int, first: int, until: float, limit: float, out: Path) -> None:
    """Keep a working process going until the time is up; what kills it becomes a record."""
    while (left := until - time.time()) > 0:
        command = [sys.executable, "-m", "tools.soak", "--worker", "--seed", str(seed), "--first", str(first)]
        command += ["--minutes", str(left / 60), "--limit", str(limit), "--out", str(out.resolve())]
        code = subprocess.run(command, cwd=ROOT, check=False).returncode
        if code == 0:
            return
        if not (out / CURRENT).exists():
            raise SystemExit(f"the working process ended with code {code} outside any case: see its message above")
        record = json.loads((out / CURRENT).read_text(encoding="utf-8"))
        trace = out / HANG
        how = trace.read_text(encoding="utf-8") if trace.exists() else ""
        status = "hung" if "Timeout" in how else "died"
        record["outcome"] = {"status": status, "problem": f"exit code {code}\n{how}", "frames": 0}
        _append(out, record)
        (out / CURRENT).unlink()
        first = record["index"] + 1


def work(seed: int, index: int, until: float | None, limit: float, out: Path) -> dict[str, Any]:
    """Run cases one after another until the time is up (None: this one alone); the last record."""
    from gsstream.discovery.catalog import load_catalog
    from tools.soak.cases import draw_case
    from tools.soak.drive import run_case

    catalog, folder, process = load_catalog(), out / "case", os.getpid()
    with (out / HANG).open("w", encoding="utf-8") as trace:
        faulthandler.enable(trace)
        while True:
            case = draw_case(seed, index, catalog)
            record = {"index": index, "seed": seed, "process": process, "method": case.method, "command": case.command}
            (out / CURRENT).write_text(json.dumps(record), encoding="utf-8")
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            faulthandler.dump_traceback_later(limit, exit=True, file=trace)
            outcome = run_case(case, catalog, folder)
            faulthandler.cancel_dump_traceback_later()
            record |= {"outcome": outcome.record(), "rss_mb": resident_mb(), "time": time.time()}
            _append(out, record)
            (out / CURRENT).unlink()
            index += 1
            if until is None or time.time() > until:
                return record


def resident_mb() -> float:
    """Resident size after the garbage collector ran and the allocator gave free pages back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def read_runs(out: Path) -> list[dict[str, Any]]:
    """The records so far."""
    return [json.loads(line) for line in (out / RUNS).read_text(encoding="utf-8").splitlines()]


def _append(out: Path, record: dict[str, Any]) -> None:
    with (out / RUNS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


if __name__ == "__main__":
    sys.exit(main())
