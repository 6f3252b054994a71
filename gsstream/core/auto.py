"""Values a scene decides: what is known of a scene before frame 0, and a value with the reason for it.

A part offers ``auto`` for some of its settings by ``auto_rules``: setting -> rule, a pure function of a scene's facts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

#: What a recipe says where the scene is to decide.
AUTO = "auto"


@dataclass(frozen=True, slots=True)
class SceneFacts:
    """What the training views and the seeds of frame 0 say about a scene.

    No field has a unit of length: a scene that is scaled keeps its facts.

    Arguments:
        cameras: training cameras, at least 1.
        width, height: of a training image, pixels.
        seeds: points that frame 0 starts from, at least 1.
        span_pixels: largest side of the seeds' bounding box, in pixels of a training camera at the median distance.
        span_spacings: the same side over the median distance of a seed to its nearest neighbour.
        distance_ratio: far over near distance of seeds to cameras (quantiles 0.999 and 0.001 over all pairs), >= 1.
        closeness: logarithm of that far distance over the one that 9 of 10 cameras keep to a seed: the closer a seed,
            the larger. Quantiles 0.9, 0.7, 0.5, 0.3 and 0.1 over the seeds, descending, >= 0.
        texture: mean absolute difference of neighbouring pixels' brightness over that of the brightness to its mean,
            both over all training views; 0: one colour, about 1: noise.
        colour_gain: (g1, g2, g3) dB by which harmonics of degree 1, 2, 3 predict the colour that a camera sees of a
            seed better than degree 0 does, each camera left out in turn, each camera's own colour response taken off.
            Negative: worse; 0 where a degree has too few cameras to be judged.
    """

    cameras: int
    width: int
    height: int
    seeds: int
    span_pixels: float
    span_spacings: float
    distance_ratio: float
    closeness: tuple[float, float, float, float, float]
    texture: float
    colour_gain: tuple[float, float, float]

    @property
    def pixels(self) -> int:
        """Pixels of all training views together."""
        return self.cameras * self.width * self.height


@dataclass(frozen=True, slots=True)
class Choice:
    """A value, and in one line why this one.

    Arguments:
        value: what was chosen.
        why: the reason, in one line.
        ladder: candidate values in an order along which the quality of a scene is expected to rise to one maximum and
            to fall from there on; ``value`` is one of them. Empty for settings that a short fit of frame 0 cannot
            judge (``engine.auto.trials``).
    """

    value: Any
    why: str
    ladder: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        if self.ladder and self.value not in self.ladder:
            raise ValueError(f"a choice stands on its own ladder; got {self.value!r}, which is not in {self.ladder}")


#: (facts, the part's settings so far) -> value. A pure function; the settings are the part's ``Config``, in which rules
#: that stand earlier in the table have already put their values.
AutoRule = Callable[[SceneFacts, Any], Choice]
