"""gsstream: online free-viewpoint video as a stream of 3D Gaussians.

Importing this package is cheap: it imports neither torch nor a plugin. Its front doors are imported when they are
named: ``gsstream.encode`` and ``gsstream.play`` for scripts; ``gsstream.api``, ``gsstream.backend``,
``gsstream.replay``, ``gsstream.blocks``, ``gsstream.spec`` and ``gsstream.testing`` for plugins.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

__all__ = ["API_VERSION", "__version__"]
__version__ = "0.1.0"

#: Version of the plugin interface (hooks, abstract base classes, Protocols): "major.minor".
#: Another major is refused, a newer minor is refused with "upgrade gsstream", an older minor is fine.
API_VERSION = "3.0"

_DOORS = ("api", "backend", "blocks", "encode", "play", "spec", "testing")


if not TYPE_CHECKING:  # or else checkers of types take any name for one of this module

    def __getattr__(name: str) -> ModuleType:
        if name in _DOORS:
            return importlib.import_module(f"gsstream.{name}")
        raise AttributeError(f"module 'gsstream' has no attribute {name!r}; its front doors are {', '.join(_DOORS)}")


def __dir__() -> list[str]:
    return [*__all__, *_DOORS]
