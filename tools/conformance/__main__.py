"""Write tests/conformance/play, refuse and vectors.json, or with --verify compare them with what would be written."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from gsstream.packet.conformance import play_here
from tools.conformance import (
    edits,
    frames,
    keys,
    lights,
    lying_deltas,
    lying_files,
    lying_keys,
    lying_metas,
    lying_moves,
    lying_rows,
    moving,
    residuals,
    rounding,
)
from tools.conformance.tapes import Vector

FOLDER = Path(__file__).parents[2] / "tests" / "conformance"


def all_vectors() -> Iterator[Vector]:
    """Every vector, in the order of the modules."""
    sound = (keys, residuals, moving, edits, lights, rounding, frames)
    for module in (*sound, lying_files, lying_keys, lying_metas, lying_deltas, lying_moves, lying_rows):
        yield from module.vectors()


def write(folder: Path) -> None:
    """Write the streams, and what they decode to, into a folder that has none."""
    said = {}
    for vector in all_vectors():
        kind = "refuse" if vector.refused else "play"
        path = folder / kind / f"{vector.name}.gss"
        path.parent.mkdir(exist_ok=True)
        if vector.name in said:
            raise SystemExit(f"two vectors have the name {vector.name}")
        path.write_bytes(vector.data)
        lines, code = play_here(path)
        frames = [line.split() for line in lines if line[0].isdigit()]
        if bool(code) != vector.refused:
            raise SystemExit(f"{vector.name}: expected to {kind} it, got {lines[-1]}")
        if vector.refused:
            print(f"{vector.name}: {lines[-1]}")
        first, hashes = int(frames[0][0]) if frames else 0, [digest for _, digest in frames]
        said[vector.name] = {
            "file": f"{kind}/{path.name}",
            "features": vector.features,
            "rules": vector.rules,
            "first": first,
            "frames": hashes,
        }
    (folder / "vectors.json").write_text(json.dumps(said, indent=1) + "\n")


def main() -> int:
    """Run the tool; the exit code is 1 where files differ."""
    parser = argparse.ArgumentParser(prog="python -m tools.conformance", description=__doc__)
    parser.add_argument("--verify", action="store_true", help="write nothing: compare with what is stored")
    arguments = parser.parse_args()
    if not arguments.verify:
        for old in [*FOLDER.glob("play/*.gss"), *FOLDER.glob("refuse/*.gss")]:
            old.unlink()
        write(FOLDER)
        return 0
    with tempfile.TemporaryDirectory() as name:
        write(Path(name))
        files = [
            {
                p.relative_to(top): p.read_bytes()
                for p in top.rglob("*")
                if p.suffix == ".gss" or p.name == "vectors.json"
            }
            for top in (FOLDER, Path(name))
        ]
    differ = sorted(str(name) for name in {*files[0], *files[1]} if files[0].get(name) != files[1].get(name))
    print(*(f"differs: {name}" for name in differ), f"{len(files[1])} files, {len(differ)} differ", sep="\n")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
