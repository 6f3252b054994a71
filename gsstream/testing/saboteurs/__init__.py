"""For each check one deliberately wrong part that fails exactly that check: the proof that the check can fail."""

from __future__ import annotations

from gsstream.testing.saboteurs import common as common
from gsstream.testing.saboteurs import confidence as confidence
from gsstream.testing.saboteurs import gate as gate
from gsstream.testing.saboteurs import native as native
from gsstream.testing.saboteurs import propagation as propagation
from gsstream.testing.saboteurs import regularizer as regularizer
from gsstream.testing.saboteurs import renderer as renderer
from gsstream.testing.saboteurs import source as source
from gsstream.testing.saboteurs import structure as structure
from gsstream.testing.saboteurs.method import METHOD_SABOTEURS as METHOD_SABOTEURS
from gsstream.testing.saboteurs.packet import PACKET_SABOTEURS as PACKET_SABOTEURS
from gsstream.testing.saboteurs.register import SABOTEURS as SABOTEURS

#: The one saboteur that has to be installed to do harm; the test that installs it is with the others.
INSTALLED = {"check_cheap_spec": "a plugin whose declaration imports torch."}


def saboteur_of(check: str) -> str:
    """What is wrong with the saboteur of a check, in one line. Raises KeyError when it has none."""
    if check in INSTALLED:
        return INSTALLED[check]
    if check in PACKET_SABOTEURS:
        return PACKET_SABOTEURS[check].name + "."
    return ({**SABOTEURS, **METHOD_SABOTEURS}[check].__doc__ or "Has no docstring.").strip()
