"""What is wrong with a scene, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]

#: code -> what the check looks at; the order is that of the checks.
CHECKS = {
    "calibration": "cameras.json can be read and describes a rig of pinhole cameras",
    "files": "every declared image exists",
    "intrinsics": "focal lengths and principal points fit the size of the images",
    "placement": "no camera is where another one is, none is far away from all others, points have the rig's unit",
    "axes": "cameras look at what they have in common",
    "overlap": "every training camera shares its view with another one",
    "images": "every image can be decoded and has the declared size",
    "blank": "no camera is black or of one colour",
    "colour": "no camera is grey while others have colours",
    "same": "no two cameras deliver the same pictures",
    "frozen": "no camera stands still while others change",
    "repeated": "no camera repeats a frame while others go on",
    "brightness": "brightness does not jump from one frame to the next",
    "sync": "what moves is at one place in all cameras at a time",
    "epipolar": "matched features lie on each other's epipolar lines",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing to know. ``code``: a key of CHECKS; ``message``: expected, got, where, what to do."""

    code: str
    severity: Severity
    message: str


def error(code: str, message: str) -> Finding:
    """Return a finding that makes a run of the scene a waste of time."""
    return Finding(code, "error", message)


def warning(code: str, message: str) -> Finding:
    """Return a finding with which a run will work and may be worse than it could be."""
    return Finding(code, "warning", message)


def note(code: str, message: str) -> Finding:
    """Return a finding about what could not be checked."""
    return Finding(code, "note", message)
