"""Which distribution provides a missing part, so that an error can name the command that installs it.

gsstream alone is the player. Its extras bring the rest, and the parts of other distributions come by extras too.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

#: Packages of the extra ``encoder`` alone: modules that import one of them encode, measure or plot.
ENCODER = ("torch", "kornia", "scipy", "matplotlib")
#: Extra -> the parts, methods and commands of this project's other distributions that it brings, as "KIND/NAME".
#: ``python -m tools.shipped`` writes it from what the plugins declare.
TABLE = Path(__file__).with_name("shipped.json")
#: Whether a package index has gsstream and its plugins. Until one has, commands name sources, or a folder of wheels.
ON_INDEX = False
#: What DIST means in such a command.
WHERE_DIST = ", where DIST is the folder of wheels that 'make dist' writes (no index has them yet)"
#: What comes before a command that brings torch, where there is no GPU.
CPU_FIRST = (
    "there is no NVIDIA GPU here: install the CPU build of torch first, by the command that pytorch.org shows under "
    "'Start Locally' for Linux, Pip, Python, CPU (the other is 4.7 GB more)"
)
#: The repository, where this is a checkout of it.
SOURCES = Path(__file__).parents[2]
#: The pages that messages name: in the repository, and in what is built from it.
DOCS = (SOURCES / "docs", Path(sys.prefix) / "share" / "doc" / "gsstream")


def page(name: str) -> str:
    """Return where a page of the documentation, such as ``howto/lpips.md``, is on this machine."""
    return str(next((folder / name for folder in DOCS if (folder / name).is_file()), Path("docs") / name))


def pip() -> str:
    """Return the command of the installer of the environment that runs now.

    ``pip`` alone is another environment's where this one is used without having been activated.
    """
    found, here = shutil.which("pip"), Path(sys.executable)
    return "pip" if found is not None and Path(found).parent == here.parent else f"{shlex.quote(str(here))} -m pip"


def finds_gpu() -> bool:
    """Say whether the driver of an NVIDIA GPU is here, without asking torch, which may be what is missing."""
    return shutil.which("nvidia-smi") is not None or Path("/dev/nvidiactl").exists()


def install(requirement: str) -> str:
    """Return the command that installs a requirement into the environment that runs now.

    Distributions of this project that are not installed yet come from the sources where these are at hand, else from
    wheels, as long as no index has them. Where torch would come with CUDA and there is no GPU for it, its CPU build
    comes first.
    """
    brought = list(_brought(requirement))
    first = f"{CPU_FIRST}, then: " if "torch" in brought and _would_bring_cuda() else ""
    lacking = [] if ON_INDEX else [name for name in brought if name.startswith("gsstream-") and not _is_installed(name)]
    if not lacking:
        return f"{first}{pip()} install {shlex.quote(requirement)}"
    if not (SOURCES / "plugins").is_dir():
        return f"{first}{pip()} install --find-links DIST {shlex.quote(requirement)}{WHERE_DIST}"
    folders = [requirement.replace("gsstream", str(SOURCES), 1)] if requirement.startswith("gsstream[") else []
    folders += [str(SOURCES / "plugins" / name.removeprefix("gsstream-").replace("-", "_")) for name in lacking]
    return f"{first}{pip()} install " + " ".join(f"-e {shlex.quote(folder)}" for folder in folders)


def install_any() -> str:
    """Return the command that installs any extra, which it calls EXTRA, and what comes first on this machine."""
    first = f"{CPU_FIRST}, then: " if _would_bring_cuda() else ""
    if not ON_INDEX and (SOURCES / "requirements.txt").is_file():
        return f"{first}{pip()} install -r {shlex.quote(str(SOURCES / 'requirements.txt'))}, which brings all of them"
    links = "" if ON_INDEX else "--find-links DIST "
    return f"{first}{pip()} install {links}'gsstream[EXTRA]'{'' if ON_INDEX else WHERE_DIST}"


def _would_bring_cuda() -> bool:
    """Say whether pip would bring torch as its CUDA build, which only Linux has, to a machine without a GPU."""
    return sys.platform == "linux" and not _is_installed("torch") and not finds_gpu()


def _brought(requirement: str) -> Iterator[str]:
    """Yield the distributions that a requirement brings by name, those of the extras of gsstream each once."""
    if not requirement.startswith("gsstream["):
        yield requirement
        return
    found: dict[str, None] = {}
    for extra in requirement.removeprefix("gsstream[").rstrip("]").split(","):
        for line in importlib.metadata.requires("gsstream") or ():
            name = re.match(r"[\w.-]+(\[[\w,-]+\])?", line)
            if name is not None and re.search(rf"extra\s*==\s*[\"']{extra}[\"']", line):
                found.update(dict.fromkeys(_brought(name.group())))
    yield from found


def _is_installed(requirement: str) -> bool:
    try:
        importlib.metadata.version(requirement.partition("[")[0])
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def install_extra(extra: str) -> str:
    """Return the command that installs an extra of gsstream."""
    return install(f"gsstream[{extra}]")


def install_part(kind: str, name: str) -> str | None:
    """Return the command that installs a part or method which this project ships in another distribution.

    Returns None for a name that this project does not ship.
    """
    key = f"{kind}/{name}"
    shipped: Mapping[str, Sequence[str]] = json.loads(TABLE.read_text(encoding="utf-8"))
    extra = next((extra for extra, parts in shipped.items() if key in parts), None)
    return None if extra is None else install_extra(extra)


def install_renderer() -> str:
    """Return pip's argument for the compiled renderer: its folder in a checkout, else its distribution."""
    sources = SOURCES / "plugins" / "cpu_render"
    if (sources / "pyproject.toml").is_file():
        return f"install a C++20 compiler, then: {install(str(sources))}"
    return install_extra("player")


def require_encoder() -> None:
    """Raise ModuleNotFoundError where a package of the extra ``encoder`` is missing.

    For the first line of a command that encodes or plots: it must not work for an hour before it finds out.
    """
    for package in ENCODER:
        try:
            there = importlib.util.find_spec(package) is not None
        except ValueError:  # a module without a specification, as None in sys.modules
            there = False
        if not there:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)


def missing_for_encoding(error: ModuleNotFoundError) -> str | None:
    """Return the message about a missing package of the extra ``encoder``; None for any other package."""
    package = (error.name or "").partition(".")[0]
    if package not in ENCODER:
        return None
    return (
        f"this needs {package}, which is not installed; gsstream alone plays, measures, exports and shows streams. "
        f"To encode: {install_extra('s2gs')}"
    )
