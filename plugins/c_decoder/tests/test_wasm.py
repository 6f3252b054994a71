"""The decoder in C as a module of WebAssembly: the suite bit for bit in node, and what its wrapper hands out."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from many_streams import play_all

from gsstream.packet.conformance import judge, load_cases
from gsstream.player.playback import Playback

HERE = Path(__file__).parent
ROOT = HERE.parent
SUITE = HERE.parents[2] / "tests" / "conformance"
NODE = shutil.which("node")
HAS_COMPILER = importlib.util.find_spec("ziglang") is not None

pytestmark = [
    pytest.mark.skipif(not HAS_COMPILER, reason="there is no C compiler for WebAssembly (pip install ziglang)"),
    pytest.mark.skipif(NODE is None, reason="node is not installed (apt install nodejs)"),
]


@pytest.fixture(scope="module")
def wasm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wasm")
    shutil.copytree(ROOT / "src", folder / "src")
    shutil.copy(ROOT / "Makefile", folder)
    command = ["make", "-C", str(folder), "wasm", f"WASM_CC={sys.executable} -m ziglang cc"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "build" / "gss.wasm"


def test_all_vectors_are_played_and_refused(wasm: Path) -> None:
    cases = load_cases(SUITE)
    outcomes = play_all([str(NODE), str(ROOT / "wasm" / "dump.mjs"), str(wasm)], cases)
    found = [judge(case, outcome) for case, outcome in zip(cases, outcomes, strict=True)]
    assert [result for result in found if result.problem or result.left_out] == []


def test_the_wrapper_hands_out_meta_arrays_and_errors(wasm: Path) -> None:
    """Against Python, on the last frame of streams with displacements and without, and on one that is refused."""
    script = """
    import { readFile } from "node:fs/promises";
    const [gss, module, ...paths] = process.argv.slice(1);
    const { loadDecoder } = await import(gss);
    const decoder = await loadDecoder(await readFile(module));
    const found = [];
    for (const path of paths) {
      const stream = decoder.open(await readFile(path));
      if (stream.frame || stream.meta) throw new Error("something before the first frame");
      while (stream.next());
      const { frame, meta, error } = stream;
      const list = (array) => array && Array.from(array);
      found.push({ meta, error, ...Object.fromEntries(Object.entries(frame).map(([name, value]) =>
        [name, typeof value === "number" ? value : list(value)])) });
      stream.close();
    }
    let none = null;
    try { const small = decoder.open(await readFile(paths[0]), 1000); small.next(); none = small.error; } catch {}
    console.log(JSON.stringify({ found, none }));
    """
    cases = {case.name: case for case in load_cases(SUITE)}
    chosen = [case for case in cases.values() if not case.refused and len(case.frames) > 1][::16]
    chosen.append(next(case for case in cases.values() if case.refused and case.frames))
    files = [str(ROOT / "wasm" / "gss.mjs"), str(wasm), *(str(case.path) for case in chosen)]
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script, *files],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert "memory" in said["none"]["message"]
    for case, theirs in zip(chosen, said["found"], strict=True):
        assert (theirs["error"] is not None) == case.refused, case.name
        if case.refused:
            assert theirs["error"]["rule"] in case.rules
            assert theirs["error"]["byte"] <= case.path.stat().st_size
        with Playback(case.path) as playback:
            state = playback.player_state(int(case.frames[-1].split()[0]))
        assert theirs["meta"]["fps"] == state.meta.fps, case.name
        assert theirs["nodeCounts"] == state.layout.node_counts.tolist()
        assert (theirs["frame"], theirs["rows"]) == (state.frame, len(state.gaussians))
        for name, ours in state.gaussians.items():
            assert np.array_equal(np.asarray(theirs[name], np.float32), ours.reshape(-1)), (case.name, name)
        moved = state.scene.displacement
        assert (theirs["displaced"] or []) == [] if moved is None else sum(theirs["displaced"]) > 0
