"""For each check one deliberately wrong part that fails exactly that check: the proof that the check can fail."""

from __future__ import annotations

from gsstream.spec import CommandSpec
from saboteurs import common as common
from saboteurs import confidence as confidence
from saboteurs import gate as gate
from saboteurs import growth as growth
from saboteurs import motion as motion
from saboteurs import native as native
from saboteurs import propagation as propagation
from saboteurs import regularizer as regularizer
from saboteurs import renderer as renderer
from saboteurs import source as source
from saboteurs import structure as structure
from saboteurs.method import METHOD_SABOTEURS as METHOD_SABOTEURS
from saboteurs.packet import PACKET_SABOTEURS as PACKET_SABOTEURS
from saboteurs.register import SABOTEURS as SABOTEURS

COMMAND_SABOTEURS = {
    "check_command": CommandSpec(
        name="torch-first", target="saboteurs.heavy_command:heavy", summary="A command whose module imports torch."
    )
}
#: The one saboteur that has to be installed to do harm; the test that installs it is with the others.
INSTALLED = {"check_cheap_spec": "a plugin whose declaration imports torch."}


def saboteur_of(check: str) -> str:
    """What is wrong with the saboteur of a check, in one line. Raises KeyError when it has none."""
    if check in INSTALLED:
        return INSTALLED[check]
    if check in COMMAND_SABOTEURS:
        return COMMAND_SABOTEURS[check].summary
    if check in PACKET_SABOTEURS:
        return PACKET_SABOTEURS[check].name + "."
    return ({**SABOTEURS, **METHOD_SABOTEURS}[check].__doc__ or "Has no docstring.").strip()
