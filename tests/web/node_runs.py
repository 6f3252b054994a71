"""Run the browser's modules in node: what the tests and the fuzzing job of the web player share."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="node is not installed (apt install nodejs)")


def play_in_node(streams: Sequence[bytes], folder: Path, *, timeout: float = 300) -> dict[str, Any]:
    """Decode streams with gsstream/web: for each the digests of its states and the error that ended it."""
    assert NODE is not None
    packed, results = folder / "streams.bin", folder / "results.json"
    packed.write_bytes(b"".join(struct.pack("<I", len(data)) + data for data in streams))
    command = [NODE, "--max-old-space-size=256", str(HERE / "play.mjs"), str(packed), str(results)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(results.read_text())
    assert len(found["streams"]) == len(streams)
    return found


def node(code: str, given: object, folder: Path) -> Any:
    """What a piece of JavaScript makes of ``given`` (JSON): it sees ``given`` and the folder of modules ``web``."""
    file = folder / "given.json"
    file.write_text(json.dumps(given))
    script = (
        "import { readFileSync } from 'node:fs';\n"
        f"const given = JSON.parse(readFileSync({json.dumps(str(file))}));\n"
        f"const load = (name) => import({json.dumps(str(HERE.parents[1] / 'gsstream' / 'web'))} + '/' + name);\n"
        f"console.log(JSON.stringify(await (async () => {{ {code} }})()));\n"
    )
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-"], input=script, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
