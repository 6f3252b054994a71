"""Build every distribution of this repository: ``make dist``, or ``python -m tools.dist --out dist``.

Each gets a source archive and the wheel that is built from it, beside a list of their checksums. The same sources give
the same bytes: times are those of the commit, and ``dist_constraints.txt`` pins what builds. ``--twice`` proves it.
``--aarch64`` adds the renderer's wheel for that family of processors (needs ``apt install g++-aarch64-linux-gnu``).
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PINS = Path(__file__).with_name("dist_constraints.txt")
SUMS = "SHA256SUMS"
RENDERER = ROOT / "plugins" / "cpu_render"


def projects() -> list[Path]:
    """Return the folder of every distribution: gsstream itself, then its plugins by name."""
    return [ROOT, *sorted(path.parent for path in ROOT.glob("plugins/*/pyproject.toml"))]


def source_date() -> str:
    """Return the time that goes into every archive, in seconds: SOURCE_DATE_EPOCH, else that of the last commit."""
    wanted = os.environ.get("SOURCE_DATE_EPOCH")
    if wanted is not None:
        return wanted
    command = ["git", "log", "-1", "--format=%ct"]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def for_aarch64() -> dict[str, str]:
    """Return what makes a build of the renderer, on x86-64 Linux, one for aarch64 and this version of Python."""
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    return {
        "CXX": "aarch64-linux-gnu-g++",
        "CMAKE_ARGS": "-DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64",
        "SETUPTOOLS_EXT_SUFFIX": suffix.replace("x86_64", "aarch64"),
        "_PYTHON_HOST_PLATFORM": "linux-aarch64",
    }


def build(out: Path, chosen: Sequence[Path], *, isolated: bool = True, aarch64: bool = False) -> dict[str, str]:
    """Build distributions into ``out``, new or empty; return file name -> SHA-256 (also in ``SHA256SUMS``)."""
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        raise FileExistsError(f"{out} is not empty: expected a new folder, so that no archive of before stays in it")
    environment = {**os.environ, "SOURCE_DATE_EPOCH": source_date(), "PIP_CONSTRAINT": str(PINS)}
    jobs: list[tuple[Path, dict[str, str], list[str]]] = [(project, {}, []) for project in chosen]
    jobs += [(RENDERER, for_aarch64(), ["--wheel"])] if aarch64 else []
    for project, more, options in jobs:
        print(f"== {project.relative_to(ROOT)} {'for aarch64' if more else ''}".rstrip(), flush=True)
        command = [sys.executable, "-m", "build", "--outdir", str(out.resolve()), str(project), *options]
        command += [] if isolated else ["--no-isolation"]
        done = subprocess.run(command, env=environment | more, capture_output=True, text=True, check=False)
        if done.returncode:
            print(done.stdout + done.stderr, file=sys.stderr)
            done.check_returncode()
    sums = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(out.iterdir())}
    (out / SUMS).write_text("".join(f"{digest}  {name}\n" for name, digest in sums.items()), encoding="utf-8")
    return sums


def main(argv: Sequence[str] | None = None) -> int:
    """Build, and with ``--twice`` build again elsewhere and compare. Returns 1 when the bytes differ."""
    names = {"gsstream" if path == ROOT else path.name: path for path in projects()}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder, new or empty (default: dist)")
    parser.add_argument("--only", action="append", choices=names, help="gsstream or the folder of a plugin; repeatable")
    parser.add_argument("--aarch64", action="store_true", help="and the renderer's wheel for aarch64")
    parser.add_argument("--twice", action="store_true", help="build a second time and compare every byte")
    options = parser.parse_args(argv)
    chosen = [names[name] for name in options.only or names]
    first = build(options.out, chosen, aarch64=options.aarch64)
    for name in first:
        print(f"{(options.out / name).stat().st_size:>10}  {name}")
    if not options.twice:
        return 0
    with tempfile.TemporaryDirectory() as folder:
        second = build(Path(folder), chosen, aarch64=options.aarch64)
    differing = sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))
    print(f"built twice: {len(first) - len(differing)} of {len(first)} archives have equal bytes")
    for name in differing:
        print(f"differs: {name}", file=sys.stderr)
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
