"""Real distributions in a temporary folder, and fresh processes that have them installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import forked
import pytest
from distribution import write_metadata

BROKEN = Path(__file__).parent / "broken"


class PluginLab:
    """A folder on the path of fresh processes, holding the distributions installed into it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def install(self, fault: str, *, version: str = "0.3", entry_points: str | None = None) -> None:
        """Install ``broken/FAULT.py`` as the distribution ``gsstream-FAULT`` with an entry point named FAULT."""
        source = BROKEN / f"{fault}.py"
        self.add(fault, source.read_text() if source.exists() else "", version=version, entry_points=entry_points)

    def add(self, name: str, source: str, *, version: str = "0.3", entry_points: str | None = None) -> None:
        """Install a module given as text."""
        module = f"gsstream_{name}_plugin"
        (self.folder / f"{module}.py").write_text(source)
        distribution = f"gsstream-{name.replace('_', '-')}"
        write_metadata(self.folder, distribution, version, entry_points or f"[gsstream]\n{name} = {module}\n")

    def python(self, code: str, *args: str, load: str | None = None, **env: str) -> subprocess.CompletedProcess[str]:
        """Run code in a fresh process; ``load`` limits the plugins so that others on this machine play no part."""
        environment = self.environment(load, env)
        path = os.pathsep.join([str(self.folder), *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "-c", code, *args]
        return subprocess.run(
            command, env={**environment, "PYTHONPATH": path}, capture_output=True, text=True, timeout=600, check=False
        )

    def environment(self, load: str | None, env: dict[str, str]) -> dict[str, str]:
        names = sorted(path.name.split("-")[0].removeprefix("gsstream_") for path in self.folder.glob("*.dist-info"))
        allowed = ",".join(names) if load is None else load
        return {**os.environ, "GSSTREAM_LOAD_PLUGINS": allowed, **env}

    def cli(self, *args: str, load: str | None = None, **env: str) -> subprocess.CompletedProcess[str]:
        """Run the command line in a fresh process; a run in one that has torch."""
        if args[0] == "run":
            return forked.gsstream(args, path=[str(self.folder)], env=self.environment(load, env))
        return self.python("from gsstream.cli.main import main; main()", *args, load=load, **env)


@pytest.fixture
def lab(tmp_path: Path) -> PluginLab:
    return PluginLab(tmp_path)
