"""What the pages share: the note at their top, and code as cells and signatures."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
NOTE = "<!-- Made by python -m tools.reference from the code. Do not edit. -->\n"


def signature(name: str, function: Any) -> str:
    """A call as it is written, with annotations and defaults."""
    # Annotations are text already, so their quotes are left out; the quotes of defaults say that a default is a text. A
    # default function has an address.
    text = re.sub(r"<function .*? at 0x[0-9a-f]+>", "...", str(inspect.signature(function)))
    return name + re.sub(r"(: |-> )([\"'])(.*?)\2", r"\1\3", text)


def cell(text: str) -> str:
    """A text inside a table: the bar that ends a cell is escaped."""
    return text.replace("|", chr(92) + "|")
