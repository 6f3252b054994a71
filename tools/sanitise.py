"""Build the compiled kernels with the address and undefined-behaviour sanitisers, and run contract and random calls.

Usage: python -m tools.sanitise [--calls 20000] [--seed 0] [--build DIR] [--only build|contract|calls]

Needs GCC with its sanitisers, CMake and nanobind. The build (kept in DIR, default: a temporary folder) takes minutes;
the library that is installed stays as it is. Whatever a sanitiser finds ends the run with its report. The exit code
says whether all was well.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLUGIN = ROOT / "plugins" / "cpu_render"
FLAGS = "-fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -g1"
#: Tests of the plugin that are run: its contract, and those that use memory most.
CONTRACT = ("test_cpu_contract.py", "test_cpu_raster_faults.py", "test_cpu_states.py", "test_native_threads.py")
#: Puts the library of this build in the place of the one that is installed.
_STAND_IN = """
import importlib.util, os, sys
name = "gsstream_cpu_render._native"
spec = importlib.util.spec_from_file_location(name, os.environ["GSSTREAM_SANITISED"])
sys.modules[name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules[name])
"""


def build(folder: Path) -> Path:
    """Compile the kernels into ``folder``; return the module."""
    configure = ["cmake", "-S", str(PLUGIN), "-B", str(folder), "-DCMAKE_BUILD_TYPE=None"]
    configure += [f"-DCMAKE_CXX_FLAGS={FLAGS}", f"-DPython_EXECUTABLE={sys.executable}"]
    subprocess.run(configure, check=True, stdout=subprocess.DEVNULL)
    subprocess.run(["cmake", "--build", str(folder), "--target", "_native", "--parallel", "2"], check=True)
    (folder / "sanitised.py").write_text(_STAND_IN, encoding="utf-8")
    return next(folder.glob("_native*.so"))


def environment(module: Path) -> dict[str, str]:
    """Return what a process needs that loads the module.

    The sanitiser's own library must come first, and that of C++ beside it, whose exceptions it watches.
    """
    ask = (["gcc", f"-print-file-name={name}"] for name in ("libasan.so", "libstdc++.so.6"))
    found = [subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip() for command in ask]
    return {
        **os.environ,
        "LD_PRELOAD": " ".join(str(Path(library).resolve()) for library in found),
        "GSSTREAM_SANITISED": str(module),
        "PYTHONPATH": os.pathsep.join([str(module.parent), str(ROOT)]),
        # Python keeps what it has until the end of the process; and a call that wants too much memory is refused.
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1:abort_on_error=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "OMP_NUM_THREADS": "1",
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Build and run; return 0 where no sanitiser reported anything."""
    parser = argparse.ArgumentParser(prog="python -m tools.sanitise", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--calls", type=int, default=20_000, metavar="N", help="random calls")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--build", type=Path, metavar="DIR", help="folder of the build, used again where it is there")
    parser.add_argument("--only", choices=["build", "contract", "calls"])
    given = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as temporary:
        module = build(given.build or Path(temporary))
        if given.only == "build":
            return 0
        around, code = environment(module), 0
        if given.only in (None, "contract"):
            tests = [str(PLUGIN / "tests" / name) for name in CONTRACT]
            command = [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-p",
                "sanitised",
                "-p",
                "no:cacheprovider",
                "-p",
                "no:xdist",
            ]
            code |= subprocess.run([*command, *tests], env=around, cwd=ROOT, check=False).returncode
        if given.only in (None, "calls"):
            calls = [sys.executable, "-c", "import sanitised; from tools.random_calls import main; main()"]
            numbers = [str(given.calls), str(given.seed)]
            code |= subprocess.run([*calls, *numbers], env=around, cwd=ROOT, check=False).returncode
    print("no report" if code == 0 else "a test failed, or a sanitiser reported something: see above")
    return int(bool(code))


if __name__ == "__main__":
    sys.exit(main())
