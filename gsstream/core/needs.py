"""Which distribution provides a missing part, so that an error can name the command that installs it.

gsstream alone is the player. Its extras bring the rest, and the parts of other distributions come by extras too.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

#: What only the extra ``encoder`` brings: everything that imports one of these encodes, measures or plots.
ENCODER = ("torch", "kornia", "scipy", "matplotlib")
#: Extra -> the parts and methods of this project's other distributions that it brings.
SHIPPED: Mapping[str, tuple[str, ...]] = {
    "s2gs": (
        "method/s2gs", "method/s2gs-edge", "method/s2gs-fast", "method/s2gs-paper", "confidence/error-aware",
        "confidence/noise-normalised", "confidence/uniform-random", "confidence/view-gradient", "gate/gumbel-sigmoid",
        "propagation/hierarchical-max", "propagation/selective-leaf",
        "regularizer/expected-sparsity", "structure/octree", "update/latent",
        "command/sweep", "command/report", "command/compare", "command/tune", "command/search",
        "command/gap", "command/left-behind", "command/bench",
    ),
    "player": ("renderer/cpu", "loss/cpu", "optimiser/cpu"),
    "methods": (
        "method/queen", "method/queen-published", "method/queen-m", "method/queen-s", "streaming_method/queen",
        "method/hicom", "method/hicom-published", "motion/hicom",
        "method/comgs-s", "method/comgs-l", "motion/keypoints", "confidence/error-gradient",
        "method/stream3dgs", "method/stream3dgs-cells", "motion/stream3dgs",
        "method/recon", "method/recon-published", "motion/recon",
        "method/quarc", "method/quarc-published", "growth/change-gated-copies",
        "propagation/ft-pruning", "gate/binary-ste", "confidence/onnx",
    ),
}  # fmt: skip
#: Parts whose distribution is in no extra, because it needs a GPU.
APART: Mapping[str, str] = {"renderer/gsplat": "gsstream-gsplat-render[cuda]"}
#: The pages that messages name: in the repository, and in what is built from it.
DOCS = (Path(__file__).parents[2] / "docs", Path(sys.prefix) / "share" / "doc" / "gsstream")


def page(name: str) -> str:
    """Return where a page of the documentation is on this machine.

    Arguments:
        name: its path below ``docs``, such as ``howto/lpips.md``.
    """
    return str(next((folder / name for folder in DOCS if (folder / name).is_file()), Path("docs") / name))


def pip() -> str:
    """Return the command of the installer of the environment that runs now.

    ``pip`` alone is another environment's where this one is used without having been activated.
    """
    found, here = shutil.which("pip"), Path(sys.executable)
    return "pip" if found is not None and Path(found).parent == here.parent else f"{shlex.quote(str(here))} -m pip"


def install(requirement: str) -> str:
    """Return the command that installs a requirement into the environment that runs now."""
    return f"{pip()} install {shlex.quote(requirement)}"


def install_extra(extra: str) -> str:
    """Return the command that installs an extra of gsstream."""
    return install(f"gsstream[{extra}]")


def install_part(kind: str, name: str) -> str | None:
    """Return the command that installs a part or method which this project ships in another distribution.

    Arguments:
        kind: of the part, or "method".
        name: of the part.

    Returns None for a name that this project does not ship.
    """
    key = f"{kind}/{name}"
    extra = next((extra for extra, parts in SHIPPED.items() if key in parts), None)
    if extra is not None:
        return install_extra(extra)
    return install(APART[key]) if key in APART else None


def install_renderer() -> str:
    """Return what installs the compiled renderer: its sources where these are at hand, else its distribution."""
    sources = Path(__file__).parents[2] / "plugins" / "cpu_render"
    if (sources / "pyproject.toml").is_file():
        return f"install a C++20 compiler, then: {install(str(sources))}"
    return install_extra("player")


def missing_for_encoding(error: ModuleNotFoundError) -> str | None:
    """Return what to say when a package of the extra ``encoder`` is missing; None when it is any other package."""
    package = (error.name or "").partition(".")[0]
    if package not in ENCODER:
        return None
    return (
        f"this needs {package}, which is not installed; gsstream alone plays, measures, exports and shows streams. "
        f"To encode: {install_extra('s2gs')}"
    )
