"""What a frame may cost, as data: ``budget: {time: 1.0s, size: 20KB, memory: 2GB}``, any subset of it.

Units are decimal (docs/conventions.md): 1 KB = 1,000 bytes. A number without a unit is seconds, or bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from gsstream.core.errors import RecipeError, suggest
from gsstream.core.quantity import BYTES, read_quantity

#: Bytes of an empty packet.
MIN_SIZE = 16
SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0}
BITS = {"bit/s": 1.0, "kbit/s": 1e3, "Mbit/s": 1e6, "Gbit/s": 1e9}


def _number(units: dict[str, float]) -> Callable[[Any], Any]:
    return lambda value: read_quantity(value, units) if isinstance(value, str) else value


def _bytes(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | float | int):
        return value
    return math.floor(read_quantity(value, BYTES) if isinstance(value, str) else value)


def _packet(value: Any) -> Any:
    size = _bytes(value)
    if isinstance(size, int) and not isinstance(size, bool) and size < MIN_SIZE:
        raise ValueError(f"expected a size greater than or equal to {MIN_SIZE} bytes, those of an empty packet")
    return size


def _text(units: dict[str, float]) -> Any:
    """The pattern of the text for a schema: number and unit."""
    return Annotated[str, Field(pattern=rf"^\s*\+?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*({'|'.join(units)})?\s*$")]


Seconds = Annotated[
    float, BeforeValidator(_number(SECONDS), json_schema_input_type=Annotated[float, Field(gt=0)] | _text(SECONDS))
]
Packet = Annotated[
    int, BeforeValidator(_packet, json_schema_input_type=Annotated[float, Field(ge=MIN_SIZE)] | _text(BYTES))
]
Memory = Annotated[int, BeforeValidator(_bytes, json_schema_input_type=Annotated[float, Field(ge=1)] | _text(BYTES))]
Rate = Annotated[
    float, BeforeValidator(_number(BITS), json_schema_input_type=Annotated[float, Field(gt=0)] | _text(BITS))
]


class Budget(BaseModel):
    """Limits of every frame after the first, and of the process.

    The controller stays inside where it can and says where it cannot (docs/howto/budget.md).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    time: Seconds | None = Field(
        default=None,
        gt=0,
        description="seconds from a frame's images in memory to its packet on disk, e.g. 1.0s, 800ms; the bytes then "
        "depend on the clock",
    )
    size: Packet | None = Field(
        default=None, ge=MIN_SIZE, description="bytes of a frame's packet, e.g. 20KB; an empty packet has 16"
    )
    rate: Rate | None = Field(
        default=None,
        gt=0,
        description="bits per second of playback, e.g. 2Mbit/s: no packet after the first is larger than its share, "
        "rate / 8 / frames per second; a run turns it into that size",
    )
    memory: Memory | None = Field(
        default=None, ge=1, description="peak resident memory of the process, e.g. 2GB; limits Gaussians and caches"
    )

    @property
    def limits_frames(self) -> bool:
        """Whether a frame has a limit of its own."""
        return self.time is not None or self.size is not None or self.rate is not None

    @property
    def limits_anything(self) -> bool:
        """Whether there is any limit."""
        return self.limits_frames or self.memory is not None


def sized(budget: Budget, fps: float) -> Budget:
    """Return the budget with the rate turned into a size of every packet, the smaller one where both are given.

    Raises RecipeError when a frame's share is smaller than an empty packet.
    """
    if budget.rate is None:
        return budget
    share = math.floor(budget.rate / 8 / fps)
    if share < MIN_SIZE:
        raise RecipeError(
            f"budget.rate: {budget.rate:g} bit/s are {budget.rate / 8 / fps:.1f} bytes for each of {fps:g} frames a "
            f"second, and an empty packet has {MIN_SIZE}; give at least {MIN_SIZE * 8 * fps / 1000:.1f} kbit/s"
        )
    return budget.model_copy(update={"rate": None, "size": min(share, budget.size or share)})


def budget_overrides(text: str) -> list[tuple[str, str]]:
    """Read ``"time=1s,size=20KB"`` of the command line as overrides of recipe keys.

    Raises RecipeError for a key that no budget has, or one given twice.
    """
    out: dict[str, str] = {}
    for piece in text.split(","):
        key, equals, value = (part.strip() for part in piece.partition("="))
        if not equals or not key or not value:
            raise RecipeError(f"--budget {text}: expected KEY=QUANTITY, e.g. time=1.0s,size=20KB,rate=2Mbit/s")
        if key not in Budget.model_fields:
            raise RecipeError(f"--budget {text}: unknown key {key!r}{suggest(key, Budget.model_fields)}")
        if key in out:
            raise RecipeError(f"--budget {text}: {key} is given twice")
        out[key] = value
    return [("--budget", f"budget.{key}={value}") for key, value in out.items()]
