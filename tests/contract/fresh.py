"""Installing a distribution for fresh processes without an installer: its sources and metadata on the path."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import forked
from distribution import write_metadata


def install(project: Path, site: Path) -> None:
    """Make a project's ``src`` importable and its entry points known to processes that have ``site`` on their path."""
    data = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    points = [f"{name} = {module}" for name, module in data["entry-points"]["gsstream"].items()]
    write_metadata(site, data["name"], data["version"], "\n".join(["[gsstream]", *points, ""]))
    with (site / "paths").open("a") as paths:
        paths.write(f"{project / 'src'}\n")


def sources(site: Path) -> list[str]:
    """The folders of sources that were installed."""
    return (site / "paths").read_text().split() if (site / "paths").exists() else []


def python(site: Path, *args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter that has what was installed into ``site``."""
    path = os.pathsep.join([str(site), *sources(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONIOENCODING": "utf-8", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *args]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=900, check=False)


def gsstream(site: Path, *args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command line in a fresh process that has torch."""
    return forked.gsstream(args, path=[str(site), *sources(site)], cwd=cwd, env={**os.environ, "OMP_NUM_THREADS": "1"})
