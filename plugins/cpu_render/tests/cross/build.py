"""Build the kernels for aarch64 with a cross compiler, and run them under an emulator.

Usage: python plugins/cpu_render/tests/cross/build.py --out DIR

Needs a C++20 cross compiler and user-mode emulation (on Debian and Ubuntu: apt install g++-aarch64-linux-gnu
qemu-user). Writes DIR/driver; ``test_cross_aarch64.py`` runs it and compares with this machine's kernels.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path

SOURCES = Path(__file__).parents[2] / "src" / "cpp"
COMPILERS = (
    "aarch64-linux-gnu-g++",
    "aarch64-linux-gnu-g++-12",
    "aarch64-linux-gnu-g++-13",
    "aarch64-linux-gnu-g++-14",
)
EMULATORS = ("qemu-aarch64-static", "qemu-aarch64")
#: Glue for Python, which is not there.
GLUE = ("module.cpp", "_bindings.cpp")


def found(names: tuple[str, ...]) -> str | None:
    """The first of these programs that is installed."""
    return next((path for path in map(shutil.which, names) if path), None)


def kernel_flags() -> list[str]:
    """What CMakeLists.txt compiles kernels with, so that the two cannot drift apart."""
    text = (SOURCES.parents[1] / "CMakeLists.txt").read_text(encoding="utf-8")
    match = re.search(r"set\(KERNEL_FLAGS ([^)]*)\)", text)
    assert match is not None, "CMakeLists.txt has no KERNEL_FLAGS"
    return match[1].split()


def build(compiler: str, out: Path) -> Path:
    """Compile the driver with all sources but the glue; a static program, so that the emulator needs no libraries."""
    out.mkdir(parents=True, exist_ok=True)
    common = [compiler, "-std=c++20", "-O3", "-Wall", "-Wextra", f"-I{SOURCES}"]
    objects = []
    for source in [*sorted(SOURCES.rglob("*.cpp")), Path(__file__).with_name("driver.cpp")]:
        if source.name.endswith(GLUE):
            continue
        target = out / f"{source.name}.o"
        kernel = [*kernel_flags(), "-DGSS_ISA=neon"] if source.name.endswith(".kernel.cpp") else []
        subprocess.run([*common, *kernel, "-c", str(source), "-o", str(target)], check=True)
        objects.append(str(target))
    subprocess.run([compiler, "-static", "-pthread", *objects, "-o", str(out / "driver")], check=True)
    return out / "driver"


def main() -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    compiler = found(COMPILERS)
    out = parser.parse_args().out
    if compiler is None:
        print(f"no cross compiler: expected one of {', '.join(COMPILERS)}", file=sys.stderr)
        return 2
    print(build(compiler, out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
