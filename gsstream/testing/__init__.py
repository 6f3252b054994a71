"""The contract kit for parts: ``parametrize_with_checks`` in a test suite, ``run_checks`` in code.

``gsstream check NAME`` says the same to a person.
"""

from gsstream.testing.cases import World as World
from gsstream.testing.cases import get_case as get_case
from gsstream.testing.cases import images as images
from gsstream.testing.cases import make_case as make_case
from gsstream.testing.cases import rig as rig
from gsstream.testing.cases import scene as scene
from gsstream.testing.kit import CheckResult as CheckResult
from gsstream.testing.kit import parametrize_with_checks as parametrize_with_checks
from gsstream.testing.kit import run_checks as run_checks
from gsstream.testing.method_driver import MethodUnderTest as MethodUnderTest
from gsstream.testing.registry import SourceUnderTest as SourceUnderTest

__all__ = [
    "CheckResult", "MethodUnderTest", "SourceUnderTest", "World", "get_case", "images", "make_case",
    "parametrize_with_checks", "rig", "run_checks", "scene",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
