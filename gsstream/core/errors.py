"""The exception tree.

::

    GsstreamError
    ├── InputError (ValueError)        something the user gave is wrong
    │   ├── ShapeError                 an array has the wrong shape, dtype or a non-finite value
    │   ├── SourceError                a recording cannot be read or contradicts itself
    │   │   └── EndOfRecording         a growing recording ended before this frame; ends a run, fails none
    │   ├── RecipeError                a recipe key or value is unknown or out of range
    │   ├── UnknownName                a method, part or source that is not registered
    │   └── OutputError                the place to write to is unusable (holds another run, not writable)
    ├── PacketError (ValueError)       a stream is damaged; carries the byte offset
    ├── PluginUnavailable              a part exists but its plugin is quarantined
    └── ComponentError                 a part failed while running; has slot, part and frame

Every message says what was expected, what came, where, and what to do about it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

#: Letters of a name that nobody knows, in a message.
LONGEST_SHOWN = 120
#: What the code of others may raise. ``sys.exit`` is no ``Exception``, and unnoticed it would end a run without a word.
STRANGERS = (Exception, SystemExit)


class GsstreamError(Exception):
    """Base of every error raised on purpose. Survives pickling with its attributes, so workers can report it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (type(self), self.args, self.__dict__)


def _restore(kind: type[GsstreamError], args: tuple[Any, ...], facts: dict[str, Any]) -> GsstreamError:
    # Past the constructor: it takes the facts from which the message in ``args`` was once made.
    error = kind.__new__(kind, *args)
    error.__dict__.update(facts)
    return error


class InputError(GsstreamError, ValueError):
    """Something the user gave is wrong; the message says how to mend it."""


class ShapeError(InputError):
    """An array has the wrong shape, dtype, or holds a non-finite value."""


class SourceError(InputError):
    """A recording cannot be read or contradicts itself."""


class EndOfRecording(SourceError):
    """A recording that grew has ended before the frame that was asked for: a run ends here, and has not failed."""


class RecipeError(InputError):
    """A recipe key or value is unknown, misplaced or out of range."""


class OutputError(InputError):
    """The output folder is unusable: not writable, or it holds another run."""


class UnknownName(InputError):
    """A name that is not registered. The message offers the nearest known one."""

    def __init__(self, kind: str, name: str, known: Iterable[str], hint: str = "") -> None:
        self.kind, self.name, self.known = kind, name, tuple(sorted(known))
        shown = name if len(name) <= LONGEST_SHOWN else f"{name[:LONGEST_SHOWN]} ..."
        super().__init__(f"no {kind} named {shown!r}{suggest(shown, self.known)}{hint}")


class PacketError(GsstreamError, ValueError):
    """A stream is damaged. ``offset`` is the byte at which reading failed."""

    def __init__(self, message: str, offset: int | None = None) -> None:
        self.offset = offset
        super().__init__(message if offset is None else f"{message} (at byte {offset})")


class PluginUnavailable(GsstreamError):
    """A part exists, but the plugin that ships it could not be loaded."""


class ComponentError(GsstreamError):
    """A part failed while running.

    Attributes name the slot (``"gate"``), the part, its distribution, and the frame and iteration at which it failed.
    """

    def __init__(
        self, message: str, *, slot: str, part: str, distribution: str, frame: int | None, iteration: int | None = None
    ) -> None:
        self.slot, self.part, self.distribution = slot, part, distribution
        self.frame, self.iteration = frame, iteration
        where = f"frame {frame}" if iteration is None else f"frame {frame}, iteration {iteration}"
        super().__init__(f"{slot} {part!r} (from {distribution}) failed at {where}: {message}")


def suggest(name: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known name, else the list of known names."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; known: {', '.join(known)}" if known else "; none are registered"
