"""Imports a name that an older interface had."""

from gsstream.api import GateState

kept = GateState
