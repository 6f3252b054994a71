"""GSSTREAM_CHECKS: a part that is wrong in one number of one iteration is named, as precisely as the level promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from bundle import Bundle
from flow_runs import TINY, WORLD

from gsstream.cli.main import run_command
from gsstream.core.errors import ComponentError, GsstreamError, InputError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly import part_in_use as checks_module
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.assembly.checks import Checks, requested_checks
from gsstream.engine.assembly.part_in_use import PartInUse, Where
from gsstream.engine.run.recording import open_recording
from gsstream.engine.run.session import run
from gsstream.parts.backend.base import Renderer, ScatterSession
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.gate.always_open import AlwaysOpen
from gsstream.parts.gate.base import GateSampler
from gsstream.parts.render.loss import Loss
from gsstream.parts.render.session import RenderOutput
from gsstream.recipe.load import resolve_recipe

CATALOG = load_catalog()
SMALL = "synthetic:frames=3&views=3&width=24&height=16&supersample=1"
NAN = float("nan")


class Counter:
    """Calls so far; parts have no state of their own."""

    def __init__(self) -> None:
        self.calls = 0

    def now(self, wanted: int) -> bool:
        self.calls += 1
        return self.calls == wanted + 1


COUNTER = Counter()


class WrongGate(GateSampler):
    """Gate 5 is not a number in iteration 3 of the first frame that is trained."""

    value = NAN

    @property
    def num_levels(self) -> int:
        return 1

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(logits)

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        return torch.zeros(num_nodes)

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates = torch.ones_like(logits)
        if noise is not None and COUNTER.now(3):
            gates[5] = self.value
        return gates

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(logits)

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        return logits


class TooOpen(WrongGate):
    """Gate 5 is 1.25 in iteration 3."""

    value = 1.25


class Session(ScatterSession):
    def render(self, view: int, rows: Any, **more: Any) -> RenderOutput:
        output = super().render(view, rows)
        image = output.image
        if COUNTER.now(3):
            image = image * torch.ones_like(image).index_put((torch.tensor(7), torch.tensor(9)), torch.tensor(NAN))
        return replace(output, image=image)


class WrongRenderer(Renderer):
    """Pixel (7, 9) is not a number in iteration 3."""

    def render(self, *arguments: Any) -> RenderOutput:
        return ReferenceRenderer().render(*arguments)

    def screen_gradient(self, *arguments: Any) -> Any:
        return ReferenceRenderer().screen_gradient(*arguments)

    def open(self, *arguments: Any) -> ScatterSession:
        return Session(self, *arguments)


class WrongLoss(Loss):
    """Says infinity in iteration 3."""

    def prepare(self, image: torch.Tensor) -> Any:
        return image

    def evaluate(self, image: torch.Tensor, target: Any, dssim: float, tiles: Any = None) -> tuple[Any, torch.Tensor]:
        difference = image - target
        value = torch.tensor(float("inf")) if COUNTER.now(3) else difference.square().mean()
        return value, difference / difference.numel()


class WrongGradient(WrongLoss):
    """Its value is fine; the gradient at one pixel is not, from iteration 3 on."""

    def evaluate(self, image: torch.Tensor, target: Any, dssim: float, tiles: Any = None) -> tuple[Any, torch.Tensor]:
        COUNTER.calls += 1
        gradient = (image - target) / image.numel()
        gradient[7, 9] = NAN if COUNTER.calls > 3 else 0.0
        return torch.tensor(1.0), gradient


class WrongOptimiser(RowOptimiser):
    """Moves nothing, and loses a number of Gaussian 4 in its fourth step of latents."""

    def step(self, leaves: Any, gradients: Any, states: Any, lrs: Any) -> None:
        if "latents" in leaves and COUNTER.now(3):
            leaves["latents"].data[4, 0] = NAN


def assembly(level: str | None, method: str = "dense", **parts: Any) -> Assembly:
    keys = {**TINY, "first_frame.max_iterations": 0, "first_frame.points": "recording", "first_frame.max_points": 60}
    # Some of the parts below count their renders, and rounding frame 0 makes some, as layers do.
    keys |= {"codec.key_rd_lambda": 0, "codec.first_layer": 1}
    sets = [("--set", f"{key}={value}") for key, value in keys.items()]
    made = assemble(resolve_recipe(method, CATALOG.recipe_path, (), sets), CATALOG, level)
    if brought := {name: parts.pop(name) for name in ("loss", "optimiser") if name in parts}:
        parts["renderer"] = Bundle(ReferenceRenderer(), **brought)
    return replace(made, **parts)


@pytest.fixture(autouse=True)
def fresh() -> None:
    COUNTER.calls = 0


def encode(parts: Assembly, out: Path, source: str = SMALL) -> bytes:
    out.mkdir(exist_ok=True)
    recording = open_recording(source, parts.recipe, CATALOG)
    try:
        run(parts, recording, out, quiet=True, measure=False)
    finally:
        recording.close()
    return (out / "stream.gss").read_bytes()


def failure(parts: Assembly, out: Path) -> GsstreamError:
    with pytest.raises(GsstreamError) as caught:
        encode(parts, out)
    return caught.value


class Found(NamedTuple):
    """A run with a wrong part, and what is said of it: slot, part, frame, iteration, words."""

    parts: dict[str, Callable[[], Any]]
    place: tuple[str, str, int, int | None]
    words: tuple[str, ...]
    level: str = "step"
    method: str = "dense"
    calls: int = 0
    iterations: int = 0


#: Frame 0 is not trained unless it says so: the fourth render is iteration 3 of frame 1.
FOUND = {
    "a gate that is no number": Found(
        {"gate": WrongGate}, ("gate", "WrongGate", 1, 3),
        ("sample(): expected finite values from 0 to 1, got nan at index [5] (1 of ",),
    ),
    "a gate above 1": Found(
        {"gate": TooOpen}, ("gate", "TooOpen", 1, 3), ("finite values from 0 to 1, got 1.25 at index [5] (1 of ",)
    ),
    "a pixel": Found(
        {"renderer": WrongRenderer}, ("renderer", "WrongRenderer", 1, 3),
        ("image of view ", "got nan at index [7, 9, 0] (3 of 1152 values)"),
    ),
    "a loss": Found({"loss": WrongLoss}, ("renderer.loss", "WrongLoss", 1, 3), ("got inf",)),
    "frame 0, whose iterations count from 1": Found(
        {"renderer": WrongRenderer}, ("renderer", "WrongRenderer", 0, 4), (), iterations=6
    ),
    "a whole method": Found({"loss": WrongLoss}, ("renderer.loss", "WrongLoss", 1, 4), (), method="queen"),
    "a step of the optimiser": Found(
        {"optimiser": WrongOptimiser}, ("renderer.optimiser", "WrongOptimiser", 1, 3), ()
    ),
    "a gradient": Found(
        {"loss": WrongGradient}, ("renderer.loss", "WrongGradient", 1, 3), ("got nan at index [7, 9, 0]",)
    ),
    # The default: what was learned is looked at before it is sent, so that no such stream exists.
    # The last of nine steps: the loss refuses a picture that is not finite.
    "at the end of a frame": Found(
        {"optimiser": WrongOptimiser}, ("update", "Additive", 1, None),
        ("GSSTREAM_CHECKS=step finds the first", "got nan at index [4, 0] (Gaussian 4)"), "frame", calls=-5,
    ),
    "what one part refuses of another": Found(
        {"loss": WrongGradient}, ("renderer.optimiser", "ReferenceAdam", 1, 3), ("got nan at index",), "frame"
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", FOUND)
def test_a_wrong_number_is_named_with_its_place(tmp_path: Path, what: str) -> None:
    row = FOUND[what]
    parts = assembly(row.level, row.method, **{slot: make() for slot, make in row.parts.items()})
    if row.iterations:
        first = parts.recipe.first_frame.model_copy(update={"max_iterations": row.iterations})
        parts = replace(parts, recipe=parts.recipe.model_copy(update={"first_frame": first}))
    COUNTER.calls = row.calls
    error = failure(parts, tmp_path)
    assert isinstance(error, ComponentError)
    assert (error.slot, error.part, error.frame, error.iteration) == row.place
    for words in row.words:
        assert words in str(error)


def test_a_residual_beyond_32_bits_is_refused(tmp_path: Path) -> None:
    """Rounded to an integer it would wrap around; what was learned would not be what is sent."""
    parts = assembly("frame")
    usual = parts.part("update")
    huge = usual.config.means.model_copy(update={"step": 1e-12, "lr": 0.1})
    update = type(usual)(usual.config.model_copy(update={"means": huge}))
    error = failure(replace(parts, update=update), tmp_path)
    assert "means after the last iteration" in str(error)
    assert "expected finite values from -0.00214748 to 0.00214748" in str(error)


def test_levels_do_not_change_what_is_sent_and_off_looks_at_no_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    streams = [encode(assembly(level, "s2gs-edge"), tmp_path / level) for level in ("step", "frame")]

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("looked at a number")

    monkeypatch.setattr(checks_module, "wrong_value", never)
    monkeypatch.setattr(checks_module.torch, "isfinite", never)
    streams.append(encode(assembly("off", "s2gs-edge"), tmp_path / "off"))
    assert streams[0] == streams[1] == streams[2]


def test_off_still_looks_at_shapes(tmp_path: Path) -> None:
    class Short(AlwaysOpen):  # type: ignore[misc]  # final, for everybody else
        def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
            return torch.ones(3)

    assert "open_probability(): expected shape" in str(failure(assembly("off", gate=Short()), tmp_path))


def test_where_the_level_comes_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GSSTREAM_CHECKS", raising=False)
    assert requested_checks() is Checks.FRAME
    assert assembly(None).checks is Checks.FRAME
    monkeypatch.setenv("GSSTREAM_CHECKS", "step")
    assert assembly(None).checks is Checks.STEP
    assert assembly("off").checks is Checks.OFF, "the argument has the last word"
    monkeypatch.setenv("GSSTREAM_CHECKS", "Steps")
    with pytest.raises(InputError, match="GSSTREAM_CHECKS: expected one of off, frame, step, got 'Steps'"):
        assembly(None)
    with pytest.raises(InputError, match="checks: expected one of off, frame, step, got ''"):
        requested_checks("")


def test_a_wrong_level_ends_the_command_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSSTREAM_CHECKS", "all")
    assert run_command(["run", "--source", WORLD, "--out", str(tmp_path / "o")]) == 2
    assert capsys.readouterr().err == "error: GSSTREAM_CHECKS: expected one of off, frame, step, got 'all'\n"
    assert not (tmp_path / "o").exists()


def look_at(level: Checks = Checks.FRAME, iteration: int | None = None) -> PartInUse:
    return PartInUse("gate", AlwaysOpen(), Where(7, iteration), level)


def test_the_first_wrong_number_is_named_with_its_gaussian() -> None:
    values, rows = torch.zeros(4, 3), torch.tensor([10, 20, 30, 40])
    look_at().values("x", values, rows=rows)
    values[2, 1], values[3, 0] = -float("inf"), NAN
    with pytest.raises(ComponentError, match=r"got -inf at index \[2, 1\] \(Gaussian 30\) \(2 of 12 values\)"):
        look_at(iteration=1).values("x", values, rows=rows)
    look_at().values("nothing", torch.zeros(0, 3))
    look_at().values("edges", torch.tensor([0.0, 1.0]), limits=(0, 1))
    look_at().values("largest", torch.tensor([3.4028234e38, -3.4028234e38]))
    look_at().values("half", torch.zeros(3, dtype=torch.bfloat16))


def test_below_step_nothing_is_looked_at_in_an_iteration() -> None:
    for level in (Checks.OFF, Checks.FRAME):
        look_at(level, iteration=0).output("x", torch.tensor([NAN]), (1,))
        look_at(level).step_values("x", {"y": torch.tensor([NAN])})
    with pytest.raises(ComponentError, match="frame 7, iteration 0: x: expected finite values, got inf"):
        look_at(Checks.STEP, 0).output("x", torch.tensor([float("inf")]), (1,))
