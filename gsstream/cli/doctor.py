"""``gsstream doctor``: one page about this installation, to paste into a report."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gsstream import API_VERSION, __version__
from gsstream.cli.listing import plural, printable
from gsstream.core.errors import STRANGERS, GsstreamError
from gsstream.core.install_hints import WHERE_DIST, install_any
from gsstream.core.processors import processors

if TYPE_CHECKING:
    from gsstream.player.render import PlayerRenderer

#: Instruction sets that the kernels use where a processor has them, by the names that Linux gives them.
_FLAGS = ("sse4_2", "avx2", "fma", "avx512f", "asimd")
#: Heading of the line that says how what is missing is installed.
INSTALL = "to install"
#: Packages that an extra lacks, by name; the others are counted.
_NAMED = 3
#: Levels of 255 by which two renderers may differ in one pixel.
_LEVELS = 2


def doctor() -> None:
    """Say what this installation draws and encodes with, and what is missing.

    Ends with a self-test; exit code 1 when it fails.
    """
    _say("gsstream", f"{__version__} (component API {API_VERSION}), {Path(__file__).parents[1]}")
    _say("python", f"{platform.python_implementation()} {platform.python_version()}, {sys.executable}")
    _say("system", f"{platform.platform()}, {platform.machine()}")
    _say("processor", _processor())
    renderer, why = _player()
    _say("draws with", why)
    torch = _torch()
    _say("torch", torch)
    _say("encodes with", _encoder())
    _say("GPU", _gpu())
    _say("plugins", _plugins())
    for heading, said in _extras():
        _say(heading, said)
    sound, said = _self_test(renderer)
    _say("self-test", said)
    if not sound:
        raise typer.Exit(1)


def _say(what: str, text: str) -> None:
    # What DIST is stands in the last line of the extras, once.
    typer.echo(f"{what:<13} {printable(text if what == INSTALL else text.replace(WHERE_DIST, ''))}")


def _processor() -> str:
    usable = processors()
    info = Path("/proc/cpuinfo")
    facts: dict[str, str] = {}
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            facts.setdefault(name.strip(), value.strip())
    flags = facts.get("flags", facts.get("Features", "")).split()
    known = " ".join(flag for flag in _FLAGS if flag in flags) or "not known"
    name = facts.get("model name") or platform.processor() or platform.machine()
    return f"{name}, {usable} of {os.cpu_count()} cores usable, instruction sets: {known}"


def _player() -> tuple[PlayerRenderer, str]:
    from gsstream.player.render import SlowRendererWarning, find_renderer

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", SlowRendererWarning)
        renderer = find_renderer()
    if said:
        return renderer, f"{renderer.name}: {said[0].message}"
    return renderer, f"{renderer.name}, compiled{_instructions(renderer.name)}"


def _instructions(name: str) -> str:
    """Return instruction set and threads of a compiled renderer with an entry point in the group ``gsstream.bench``."""
    for point in importlib.metadata.entry_points(group="gsstream.bench", name=name):
        try:
            native = point.load()
            return f" for {native.instruction_set()}, {plural(native.num_threads(), 'thread')}"
        except STRANGERS as error:  # third-party code: this page exists to show whatever it raises
            return f"; its instruction set is not known: {type(error).__name__}: {error}"
    return ""


def _torch() -> str:
    """Imports it: only that shows whether it works."""
    if importlib.util.find_spec("torch") is None:
        return "not installed; only encoding needs it (extra encoder or s2gs)"
    start = time.perf_counter()
    try:
        import torch
    except Exception as error:  # a torch that is half installed raises anything
        return f"installed, and cannot be imported: {type(error).__name__}: {error}"
    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU"
    where = Path(str(torch.__file__)).parent
    return f"{torch.__version__}, {build} build, {where}, imported in {time.perf_counter() - start:.1f} s"


def _encoder() -> str:
    if "torch" not in sys.modules:
        return "nothing: torch is missing"
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.assembly.choose_renderer import SlowRendererWarning, choose_renderer

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", SlowRendererWarning)
        try:
            chosen = choose_renderer(load_catalog())
        except GsstreamError as error:
            return f"none: {error}"
    found = f"renderer {chosen.name!r}: {said[0].message}" if said else f"renderer {chosen.name!r}"
    return f"{found}; {chosen.note}" if chosen.note else found


def _gpu() -> str:
    """Return a line about the GPU as the driver and torch report it; the encoder's line says whether it is used."""
    torch = sys.modules.get("torch")
    found, seen = "", torch is not None and torch.cuda.is_available()
    if shutil.which("nvidia-smi"):
        try:
            listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=10, check=True)
            found = re.sub(r" \(UUID: [^)]*\)", "", listed.stdout.strip()).replace("\n", "; ")
        except (OSError, subprocess.SubprocessError) as error:
            found = f"nvidia-smi fails ({error})"
    elif seen and torch is not None:
        found = str(torch.cuda.get_device_name())
    if not found:
        return "none found"
    if not seen:
        why = "torch is missing" if torch is None else f"this torch (CUDA: {torch.version.cuda}) sees none"
        return f"{found}; not used: {why}"
    return found


def _plugins() -> str:
    from gsstream.discovery.catalog import load_catalog

    catalog = load_catalog()
    broken = [f"{plugin.name} ({plugin.reason})" for plugin in catalog.quarantine]
    count = plural(len(catalog.plugins) - len(broken), "plugin")
    return f"{count}; quarantined: {'; '.join(broken)}" if broken else count


def _extras() -> Iterator[tuple[str, str]]:
    """Yield (heading, text): the extras of gsstream that are whole, what each of the others lacks, how to install it.

    The developer's extra is left out.
    """
    about = importlib.metadata.metadata("gsstream")
    wanted: dict[str, list[str]] = {extra: [] for extra in about.get_all("Provides-Extra") or () if extra != "dev"}
    for line in importlib.metadata.requires("gsstream") or ():
        requirement, _, marker = line.partition(";")
        for extra in re.findall(r"""extra\s*==\s*["']([^"']+)["']""", marker):
            wanted.get(extra, []).append(requirement)
    lacking = {extra: sorted(set(_missing(extra, wanted))) for extra in wanted}
    yield "extras", f"present: {', '.join(extra for extra in wanted if not lacking[extra]) or 'none'}"
    for extra, missing in lacking.items():
        if missing:
            more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
            yield f"extra {extra}", f"{', '.join(missing[:_NAMED])}{more} missing"
    if any(lacking.values()):
        yield INSTALL, install_any()


def _missing(extra: str, wanted: dict[str, list[str]]) -> Iterator[str]:
    for requirement in wanted[extra]:
        named = re.match(r"\s*([\w.-]+)\s*(?:\[([^\]]*)\])?", requirement)
        assert named is not None, "a requirement begins with a name"
        if named[1] == "gsstream":
            for inner in named[2].split(","):
                yield from _missing(inner.strip(), wanted)
            continue
        try:
            importlib.metadata.version(named[1])
        except importlib.metadata.PackageNotFoundError:
            yield named[1]


def _self_test(renderer: PlayerRenderer) -> tuple[bool, str]:
    """Write, read and draw a small scene; the picture must equal the picture of the renderer in numpy."""
    import numpy as np

    from gsstream.core.cameras import Cameras
    from gsstream.core.changes import Layout
    from gsstream.core.gaussians import Gaussians
    from gsstream.packet import KeyState, StreamMeta, decode_key, encode_key
    from gsstream.player.render import named_renderer, render, to_bytes

    rng, number = np.random.default_rng(0), 400
    K = np.array([[[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]]])
    viewmat = np.eye(4)[None].copy()
    viewmat[0, 2, 3] = 4.0
    rig = Cameras(ids=("self-test",), viewmats=viewmat, Ks=K, width=160, height=120, near_plane=0.01)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
    arrays = {name: rng.normal(size=(number, *shape)).astype(np.float32) for name, shape in shapes.items()}
    arrays["scales"] -= 3
    try:
        meta = StreamMeta(
            method="doctor",
            source="self-test",
            recipe={},
            train=rig,
            test=rig.select([]),
            fps=30.0,
            background=(0.0, 0.0, 0.0),
        )
        packet = encode_key(KeyState(Gaussians(**arrays), Layout.flat(number, 1.0), meta))
        scene = decode_key(packet.data).gaussians
        start = time.perf_counter()
        picture = to_bytes(render(scene, rig, 0, renderer=renderer)).astype(int)
        seconds = time.perf_counter() - start
        truth = to_bytes(render(scene, rig, 0, renderer=named_renderer("numpy"))).astype(int)
    except STRANGERS as error:  # this page exists to show whatever fails
        return False, f"failed: {type(error).__name__}: {error}"
    apart = int(np.abs(picture - truth).max())
    said = f"{number} Gaussians written, read and drawn in {1e3 * seconds:.1f} ms, {apart} levels of 255 from numpy"
    return apart <= _LEVELS, said if apart <= _LEVELS else f"failed: {said}, expected at most {_LEVELS}"
