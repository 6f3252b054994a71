"""How much the tests see: ``python -m tools.mutate --seed 1 --out DIR``, single changes of the library.

Each change is made in a copy of the repository, and the tests of its package and those of whole runs are asked, until
the first one fails. ``DIR/changes.jsonl`` has a line per change; a run that was broken off goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tools.changes import Change, changes_of, draw

ROOT = Path(__file__).parents[1]
#: Folders that are not copied.
LEFT = shutil.ignore_patterns(".git", ".venv", "build", "runs", "__pycache__", "*.egg-info", ".*_cache")
#: Test files that are read at once.
AT_A_TIME = 6
#: Ending of a file's name while a change stands in its place.
ORIGINAL = ".original"
#: Where the copy is found before the installed packages, those of other finders included, in child processes too.
SITE = """import sys
def moved(value):
    if isinstance(value, str):
        return value if "/.venv/" in value else value.replace({root!r} + "/", {copy!r} + "/")
    if isinstance(value, dict):
        return {{key: moved(part) for key, part in value.items()}}
    return type(value)(map(moved, value)) if isinstance(value, (list, tuple, set)) else value
for finder in sys.meta_path:
    for name, value in list(getattr(finder, "__dict__", {{}}).items()):
        if type(finder).__module__.startswith("_editable"):
            setattr(finder, name, moved(value))
"""
#: Tests in the order of the command line, and the one that runs noted down.
ORDER = """import os, pytest
@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    places = {os.path.abspath(name): place for place, name in enumerate(config.args)}
    items.sort(key=lambda item: places.get(str(item.path), 0))
def pytest_runtest_logstart(nodeid):
    with open(os.environ["GSSTREAM_MUTATE_NOW"], "w") as file:
        file.write(nodeid)
"""


def files_asked(root: Path, change: Change) -> list[str]:
    """Return the test files that name the module, then others of its package, then whole runs; small ones first."""
    parts = Path(change.path).parts
    plugin = parts[0] == "plugins"
    own = root / (Path(*parts[:2], "tests") if plugin else Path("tests", parts[1]))
    flow = root / "tests/flow"
    module = ".".join(Path(change.path).with_suffix("").parts[3 if plugin else 0 :])
    package, _, name = module.rpartition(".")
    naming = re.compile(rf"\b{module}\b|from {package} import" + ("" if package.count(".") else rf".*\b{name}\b"))
    long = (root / "conftest.py").read_text(encoding="utf-8") if (root / "conftest.py").exists() else ""
    ranks = []
    for path in [*root.glob("tests/**/test_*.py"), *root.glob("plugins/*/tests/**/test_*.py")]:
        text = path.read_text(encoding="utf-8")
        named, slow = naming.search(text) is not None, f'/{path.stem}"' in long
        runs = path.is_relative_to(flow)
        # Only the fast tests of other packages are run: a browser takes longer than its findings are worth.
        if path.is_relative_to(own) or runs or (named and not slow and path.parent.name != "web"):
            ranks.append((runs, slow, not named, len(text), path.relative_to(root).as_posix()))
    return [path for *_, path in sorted(ranks)]


class Bench:
    """A copy of the repository in which changes are tried, one at a time."""

    def __init__(self, root: Path, out: Path, limit: float) -> None:
        self.root, self.copy, self.limit = root.resolve(), out.resolve() / "copy", limit
        self.helpers = out.resolve() / "helpers"
        self.passing: list[str] = []
        self.failing: list[str] = []
        if not self.copy.is_dir():
            shutil.copytree(root, out / "partial", ignore=LEFT, symlinks=True)
            # Checked by their contents: what is changed twice in a second is never read from the cache of the first.
            checked = ["-m", "compileall", "-q", "--invalidation-mode", "checked-hash"]
            subprocess.run([sys.executable, *checked, str(out / "partial")], check=True, stdout=subprocess.DEVNULL)
            (out / "partial").rename(self.copy)
        self.helpers.mkdir(exist_ok=True)
        site = SITE.format(root=str(self.root), copy=str(self.copy))
        (self.helpers / "sitecustomize.py").write_text(site, encoding="utf-8")
        (self.helpers / "mutate_order.py").write_text(ORDER, encoding="utf-8")

    def asked(self, tests: Sequence[str]) -> tuple[str, str]:
        """Return as :meth:`pytest`, for some files at a time: reading all of them takes longer than most answers."""
        ends = time.monotonic() + self.limit
        left = [f"--deselect={name}" for name in self.failing]
        for first in range(0, len(tests), AT_A_TIME):
            found = self.pytest([*tests[first : first + AT_A_TIME], *left], ends - time.monotonic())
            if found[0] != "passed":
                return found
        return "passed", ""

    def pytest(self, tests: Sequence[str], limit: float) -> tuple[str, str]:
        """Return "passed", "failed" or "timeout", and the test that failed or ran last."""
        now = self.helpers / "now"
        now.write_text("", encoding="utf-8")
        places = [self.helpers, self.copy, *sorted(self.copy.glob("plugins/*/src"))]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, places)),
            "PYTHONDONTWRITEBYTECODE": "1",
            "GSSTREAM_MUTATE_NOW": str(now),
            "CI": "1",
        }
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "mutate_order", *tests]
        child = subprocess.Popen(
            command,
            cwd=self.copy,
            env=environment,
            start_new_session=True,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            output, _ = child.communicate(timeout=max(limit, 0))
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.communicate()
            return "timeout", now.read_text(encoding="utf-8")
        failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", output, re.MULTILINE)
        if child.returncode in (0, 5):
            return "passed", ""
        return "failed", failed[0] if failed else output.strip()[-300:]

    def tried(self, change: Change) -> dict[str, object]:
        """Return the line of a change: the test that noticed it, which passes without it."""
        path, begun = self.copy / change.path, time.monotonic()
        original = path.with_name(path.name + ORIGINAL)
        tests = files_asked(self.copy, change)
        while True:
            shutil.copy(path, original)
            try:
                path.write_bytes(change.apply(path.read_bytes()))
                status, test = self.asked(tests)
            finally:
                original.replace(path)
            if status != "failed" or test in self.passing:
                break
            known = self.passing if self.pytest([test.partition("[")[0]], self.limit)[0] == "passed" else self.failing
            known.append(test)
        said = {"failed": "noticed", "passed": "not noticed"}.get(status, status)
        return {**asdict(change), "result": said, "test": test, "seconds": round(time.monotonic() - begun)}


def measure(root: Path, out: Path, wanted: Sequence[Change], limit: float) -> list[dict[str, object]]:
    """Try the changes that have no line in ``out`` yet; return the lines of all."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "changes.jsonl"
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []
    done = {(line["path"], line["start"], line["after"]) for line in lines}
    bench = Bench(root, out, limit)
    for change in wanted:
        if (change.path, change.start, change.after) not in done:
            lines.append(bench.tried(change))
            with file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(lines[-1]) + "\n")
            print(f"{len(lines)}: {told(change)}: {lines[-1]['result']} {lines[-1]['test']}", flush=True)
    return lines


def told(change: Change) -> str:
    """Return where a change is and what it does."""
    return f"{change.path}:{change.line} {change.before!r} -> {change.after!r}"


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, try and count; 1 when a change was not noticed."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutate", description=__doc__)
    parser.add_argument("packages", nargs="*", default=["gsstream", "plugins/s2gs", "plugins/cpu_render"])
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--list", action="store_true", help="show the draw and try nothing")
    parser.add_argument("--out", type=Path, help="folder of the copy and of changes.jsonl")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for the tests of a change")
    parser.add_argument("--root", type=Path, default=ROOT, help="the repository")
    given = parser.parse_args(argv)
    # What was drawn first is what is tried, whatever has become of the repository.
    copy = given.out / "copy" if given.out and (given.out / "copy").is_dir() else given.root
    for left in copy.rglob("*" + ORIGINAL):
        left.replace(left.with_name(left.name.removesuffix(ORIGINAL)))
    wanted = draw(copy, changes_of(copy, given.packages), given.count, given.seed)
    if given.list:
        print(*map(told, wanted), sep="\n")
        return 0
    if given.out is None:
        parser.error("--out: expected a folder outside of the repository")
    lines = measure(given.root, given.out, wanted, given.limit)
    noticed = sum(line["result"] == "noticed" for line in lines)
    print(f"{noticed} of {len(lines)} noticed")
    return int(noticed < len(lines))


if __name__ == "__main__":
    raise SystemExit(main())
