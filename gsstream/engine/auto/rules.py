"""``auto`` in a recipe: from a scene's facts to values, once, before frame 0.

What was chosen goes into the key packet. A run that goes on takes it from there and never chooses again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gsstream.core.auto import Choice, SceneFacts
from gsstream.core.errors import OutputError
from gsstream.core.part import Part
from gsstream.engine.assembly.assemble import Assembly, with_values
from gsstream.engine.assembly.fault import fault
from gsstream.engine.assembly.guard import blaming
from gsstream.engine.auto.colour_gain import can_judge
from gsstream.packet import PacketKind, PlayerState, StreamReader, decode_packet
from gsstream.packet.base import FILE_HEADER
from gsstream.recipe.document import KeyPath, Origin
from gsstream.recipe.model import ComponentRef, FirstFrame

#: Least gain in dB of one more degree, seen by a left-out camera: coefficients are most of the bytes of a key packet.
WORTHWHILE = 0.1
#: The usual degree. Trials go beyond it only when the rule does, because degree 3 has nearly twice the coefficients.
USUAL_DEGREE: int = FirstFrame.model_fields["sh_degree"].default
DEGREE = "first_frame.sh_degree"


def sh_degree(facts: SceneFacts) -> Choice:
    """Return the least degree of harmonics after which no further one helps a camera that was left out.

    With too few cameras to judge the usual degree, that one.
    """
    ladder = tuple(range(USUAL_DEGREE + 1))
    if not can_judge(USUAL_DEGREE, facts.cameras):
        return Choice(USUAL_DEGREE, f"{facts.cameras} cameras are too few to judge; this is the usual degree", ladder)
    degree = 0
    for higher, gain in enumerate(facts.colour_gain, 1):
        if gain - (0.0 if degree == 0 else facts.colour_gain[degree - 1]) >= WORTHWHILE:
            degree = higher
    gains = ", ".join(f"{gain:+.2f}" for gain in facts.colour_gain)
    why = f"degrees 1 to 3 predict a left-out camera's colours by {gains} dB better than degree 0"
    return Choice(degree, why, ladder if degree in ladder else (*ladder, degree))


def settle(parts: Assembly, facts: Callable[[], SceneFacts], known: Mapping[str, Choice]) -> Assembly:
    """Return the assembly with every ``auto`` replaced by a value.

    Arguments:
        parts: the live parts of the recipe.
        facts: asked only when a rule has to choose.
        known: key -> choices that stand already (a stream's, whose frame 0 is taken over).

    Raises ComponentError when a rule fails, or chooses what its part does not accept.
    """
    measured: list[SceneFacts] = []
    for path in parts.pending:
        key = ".".join(path)
        if key in known:
            choice = known[key]
        else:
            measured = measured or [facts()]
            choice = _choose(parts, path, measured[0])
        parts = put(parts, path, choice)
    return replace(parts, pending=())


def stream_extra(path: Path) -> Mapping[str, Any] | None:
    """Return what the first key packet of a stream says about its run; None when it is not complete."""
    if not path.exists() or path.stat().st_size < FILE_HEADER.size:
        return None
    with StreamReader(path) as reader:
        if not reader.frames or reader.frames[0].kind != PacketKind.KEY:
            return None
        return decode_packet(None, reader.read(reader.frames[0])).meta.extra


def recall(parts: Assembly, extra: Mapping[str, Any]) -> Assembly:
    """Return the assembly with the choices that a stream records; ``extra`` is that of its key packet.

    Also for a recipe that gives these values itself: the record goes on in later key packets.

    Raises OutputError for an ``auto`` that the stream was written without.
    """
    known = recorded(extra)
    missing = [".".join(path) for path in parts.pending if ".".join(path) not in known]
    if missing:
        raise OutputError(
            f"the recipe says 'auto' for {', '.join(missing)}, but the stream was written with a value that was given; "
            "resume with the same recipe (recipe.yaml beside the stream) or start again with --overwrite"
        )
    return replace(settle(parts, _no_facts, known), chosen=known)


def taken_over(first: PlayerState) -> dict[str, Choice]:
    """Return the choices that stand already when frame 0 is another stream's, its degree of harmonics included."""
    known = recorded(first.meta.extra)
    degree = first.gaussians.sh_degree
    return {DEGREE: Choice(degree, "the frame 0 that is taken over has this degree"), **known}


def record(parts: Assembly) -> dict[str, Any]:
    """Return what a key packet and the metrics say about the choices: key -> value and reason; empty without any."""
    if not parts.chosen:
        return {}
    return {"auto": {key: {"value": c.value, "why": c.why} for key, c in parts.chosen.items()}}


def lines(parts: Assembly) -> list[str]:
    """Return the lines in which a run tells a person what was chosen."""
    return [f"auto: {key} = {choice.value} ({choice.why})" for key, choice in parts.chosen.items()]


def recorded(extra: Mapping[str, Any]) -> dict[str, Choice]:
    """Return the choices of which :func:`record` made this value."""
    return {key: Choice(entry["value"], entry["why"]) for key, entry in extra.get("auto", {}).items()}


def _no_facts() -> SceneFacts:
    raise AssertionError("a resumed run chooses nothing")


def _choose(parts: Assembly, path: KeyPath, facts: SceneFacts) -> Choice:
    if ".".join(path) == DEGREE:
        return sh_degree(facts)
    slot, part = path[0], _part(parts, path[0])
    with blaming(slot, part, parts.where):
        return part.auto_rules[".".join(path[2:])](facts, part.config)


def _part(parts: Assembly, slot: str) -> Part:
    return parts.part(slot)


def put(parts: Assembly, path: KeyPath, choice: Choice) -> Assembly:
    """Return the assembly with one value in its place: in the part, in the recipe, and with its provenance.

    Arguments:
        parts: the assembly before.
        path: of the key that was ``auto``.
        choice: the value, and why.

    Raises ComponentError for a value that the part does not accept.
    """
    key = ".".join(path)
    origins = {**parts.origins, path: Origin(f"auto: {choice.why}", f"auto, {key}")}
    parts = replace(parts, chosen={**parts.chosen, key: choice})
    if key == DEGREE:
        first = parts.recipe.first_frame.model_copy(update={"sh_degree": choice.value})
        return replace(parts, recipe=parts.recipe.model_copy(update={"first_frame": first}), origins=origins)
    slot, inner = path[0], ".".join(path[2:])
    part, ref = _part(parts, slot), getattr(parts.recipe, slot)
    try:
        config = part.Config.model_validate(with_values(part.config.model_dump(), {inner: choice.value}))
    except ValidationError as error:
        reason = error.errors(include_url=False)[0]["msg"]
        raise fault(f"its rule for {inner} chose {choice.value!r}: {reason}", slot, part, parts.where) from error
    # The other settings that wait keep their 'auto' in the recipe until it is their turn.
    params = with_values(ref.params, {inner: choice.value})
    recipe = parts.recipe.model_copy(update={slot: ComponentRef(name=ref.name, params=params)})
    changed: dict[str, Any] = {slot: type(part)(config), "recipe": recipe, "origins": origins}
    return replace(parts, **changed)
