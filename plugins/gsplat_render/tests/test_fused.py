"""The kernels in Triton: on a GPU where there is one, else in Triton's interpreter; and that they compile for GPUs."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from gsstream_gsplat_render import adam, boxes, gates, loss, rate, rows
from gsstream_gsplat_render.fused import FusedAdam, FusedLoss, load_fused
from torch_kernels import TORCH_FUSED

from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.render.loss import ReferenceLoss
from gsstream.parts.residual.adam_state import MAX_GRADIENT
from gsstream.parts.residual.rate import channel_spread, laplace_gradient
from gsstream.testing import loss_and_change as loss_checks
from gsstream.testing import optimiser as optimiser_checks

pytest.importorskip("triton", reason="needs the package triton, which torch's CUDA builds bring")
HAS_GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda" if HAS_GPU else "cpu")
FUSED: Any = load_fused(DEVICE.type)
#: No multiple of a tile, less than one, a row of tiles, and tiles whose window leaves the picture.
SIZES = [(40, 44), (7, 9), (16, 70), (33, 17)]


def pair(height: int, width: int, as_bytes: bool) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(height * width)
    target = torch.rand(height, width, 3, generator=g)
    image = (target + 0.2 * torch.randn(height, width, 3, generator=g)).clamp(0, 1)
    image[: height // 2, : width // 3] = target[: height // 2, : width // 3]
    if as_bytes:
        target = (target * 255).round().to(torch.uint8)
    return image.to(DEVICE), target.to(DEVICE)


def masks(height: int, width: int) -> list[torch.Tensor | None]:
    high, wide = -(-height // 16), -(-width // 16)
    g = torch.Generator().manual_seed(3)
    some = torch.rand(high, wide, generator=g) < 0.4
    some[-1, -1] = True
    return [None, some.to(DEVICE), torch.zeros(high, wide, dtype=torch.bool, device=DEVICE)]


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_the_loss_is_that_of_the_reference_in_every_tile_that_is_asked_for(
    size: tuple[int, int], as_bytes: bool
) -> None:
    image, target = pair(*size, as_bytes)
    reference = ReferenceLoss()
    ours = FusedLoss(FUSED, reference)
    for mask in masks(*size):
        for dssim in (0.0, 0.2, 1.0):
            value, gradient = ours.evaluate(image, ours.prepare(target), dssim, mask)
            want, wanted = reference.evaluate(image, reference.prepare(target), dssim, mask)
            assert value.dtype == torch.float64
            assert gradient.is_contiguous()
            assert abs(value - want) <= 1e-6
            assert float((gradient - wanted).abs().max()) <= 2e-5 * float(wanted.abs().max()) + 1e-9
            if mask is not None:
                outside = ~mask.repeat_interleave(16, 0).repeat_interleave(16, 1)[: size[0], : size[1]]
                assert not gradient[outside].any()


def test_an_image_may_lie_in_any_order_and_what_is_not_asked_for_may_be_anything() -> None:
    image, target = pair(40, 44, as_bytes=False)
    ours = FusedLoss(FUSED, ReferenceLoss())
    want, wanted = ours.evaluate(image, ours.prepare(target), 0.2)
    planes = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)  # as a rasteriser by channels leaves it
    value, gradient = ours.evaluate(planes, ours.prepare(target), 0.2)
    assert value == want
    assert torch.equal(gradient, wanted)
    mask = torch.zeros(3, 3, dtype=torch.bool, device=DEVICE)
    mask[0, 0] = True
    spoilt = image.clone()
    spoilt[38:, 38:] = torch.nan  # beyond the windows of the marked tile and of those beside it
    clean = ours.evaluate(image, ours.prepare(target), 0.2, mask)
    found = ours.evaluate(spoilt, ours.prepare(target), 0.2, mask)
    assert found[0] == clean[0]
    assert torch.equal(found[1], clean[1])


def test_a_value_that_is_not_finite_shows_in_the_loss() -> None:
    for wrong in (torch.nan, torch.inf, 1e30):
        image, target = pair(33, 17, as_bytes=True)
        image[20, 4, 1] = wrong
        value, _ = FusedLoss(FUSED, ReferenceLoss()).evaluate(
            image, FusedLoss(FUSED, ReferenceLoss()).prepare(target), 0.2
        )
        assert not value.isfinite()


@pytest.mark.parametrize("ahead", [False, True])
@pytest.mark.parametrize("lr", ["number", "scalar", "columns", "rows"])
def test_a_table_is_moved_as_the_reference_moves_it(lr: str, ahead: bool) -> None:
    g = torch.Generator().manual_seed(5)
    rows, width = 300, 7  # more than one program, and none of them full
    rates: dict[str, Any] = {
        "number": 0.01,
        "scalar": torch.tensor(0.01),
        "columns": 0.01 * torch.rand(width, generator=g),
        "rows": 0.01 * torch.rand(rows, 1, generator=g),
    }
    rate = rates[lr] if lr == "number" else rates[lr].to(DEVICE)
    corrections = torch.rand(6, 3, generator=g).to(DEVICE)
    made = [torch.randn(rows, width, generator=g), 10 ** torch.empty(rows, width).uniform_(-9, 4, generator=g)]
    made += [torch.randn(rows, width, generator=g), torch.rand(rows, width, generator=g)]
    steps = torch.randint(0, 9, (rows,), generator=g, dtype=torch.int32)  # more than the corrections have: the last one
    ours, theirs = ([x.clone().to(DEVICE) for x in (*made, steps)] for _ in range(2))
    assert bool(FUSED.move_table(*ours, corrections, rate, ahead))
    TORCH_FUSED.move_table(*theirs, corrections, rate, ahead)
    assert torch.equal(ours[4], theirs[4])
    for got, want in zip(ours[:4], theirs[:4], strict=True):
        assert torch.allclose(got, want, rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf, 1.001e18, -2e18])
def test_a_gradient_that_is_too_large_is_told(wrong: float) -> None:
    assert adam.MOST == MAX_GRADIENT
    for at in (0, 511, 512, 2099):
        value, first, second, gradient = torch.zeros(4, 300, 7, device=DEVICE).unbind()
        steps, corrections = torch.ones(300, dtype=torch.int32, device=DEVICE), torch.ones(2, 3, device=DEVICE)
        gradient.fill_(MAX_GRADIENT)
        assert bool(FUSED.move_table(value, gradient, first, second, steps, corrections, 0.1, ahead=False))
        gradient.view(-1)[at] = wrong
        assert not bool(FUSED.move_table(value, gradient, first, second, steps, corrections, 0.1, ahead=False))


@pytest.mark.parametrize("as_tensor", [False, True])
@pytest.mark.parametrize("shape", [(1, 1), (300, 5), (1100, 16), (70, 67)])
def test_the_rate_is_that_of_the_reference(shape: tuple[int, int], as_tensor: bool) -> None:
    g = torch.Generator().manual_seed(shape[0])
    # From symbols that are all zero to spreads of hundreds; ties, zeros and closed gates among them.
    steps = 10 ** torch.empty(shape[1]).uniform_(-3, 1, generator=g)
    symbols = torch.randn(shape, generator=g) * 10 ** torch.empty(shape[1]).uniform_(-4, 2.5, generator=g)
    symbols[::7] = (2 * symbols[::7]).round() / 2
    latents, gates = symbols * steps, torch.randint(0, 3, shape[:1], generator=g) / 2
    weight: Any = torch.tensor(3e-4) if as_tensor else 3e-4
    # In double precision but for the symbols, whose ties would be others there.
    spread = channel_spread(latents, steps).double()
    wanted = laplace_gradient(latents.double(), steps.double(), spread, weight) * (gates > 0)[:, None]
    given = [value.to(DEVICE) for value in (latents, steps, gates)]
    before = torch.randn(shape, generator=g)
    found = before.clone().to(DEVICE)
    FusedAdam(FUSED, None).add_rate(found, *given, weight.to(DEVICE) if as_tensor else weight)
    error = (found.cpu() - before - wanted).abs()
    # A sum with what was there before is rounded to its size.
    assert bool((error <= 3e-4 * wanted.abs() + 3e-7 * before.abs() + 1e-9).all())
    assert torch.equal(found.cpu()[gates == 0], before[gates == 0])


@pytest.mark.parametrize("levels", [1, 4, 255])
@pytest.mark.parametrize(("rows", "nodes"), [(1, 1), (300, 40), (300, 1), (5, 700)])
def test_gates_and_their_gradients_are_those_of_the_closed_forms(rows: int, nodes: int, levels: int) -> None:
    g = torch.Generator().manual_seed(rows + levels)
    logits = torch.empty(nodes).uniform_(-12, 12, generator=g)
    logits[0] = 90.0  # beyond what an exponential holds
    node_of = torch.randint(0, nodes, (rows,), generator=g)
    latents, by_gate = torch.randn(rows, 7, generator=g), 100 * torch.randn(rows, generator=g)
    logits, node_of, latents, by_gate = (value.to(DEVICE) for value in (logits, node_of, latents, by_gate))
    for offset in (0.0, 100.0):
        found = FUSED.open_gates(logits, node_of, 0.7, offset, levels)
        wanted = TORCH_FUSED.open_gates(logits, node_of, 0.7, offset, levels)
        assert torch.allclose(found[0] * levels, wanted[0] * levels, atol=1.0 if levels == 255 else 0.0)
        assert (found[0] == wanted[0]).float().mean() > 0.95
        here = found[0].cpu()  # torch divides by a number on a GPU as it multiplies by its inverse
        assert torch.equal((here * levels).round() / levels, here)
        assert torch.allclose(found[1], wanted[1], rtol=1e-5, atol=1e-12)
    given = by_gate, wanted[1], latents[:, 2:5], logits, node_of, -0.4
    for weights in ((0.3, 0.0), (1e-4, 2.5)):
        by_logit, by_position = FUSED.gate_gradients(*given, *weights)
        want_logit, want_position = TORCH_FUSED.gate_gradients(*given, *weights)
        assert torch.allclose(by_logit, want_logit, rtol=1e-5, atol=1e-4)
        assert torch.allclose(by_position, want_position, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("higher", [0, 3, 15])
def test_rows_go_into_the_tables_of_a_scene_and_out_of_them(higher: int) -> None:
    g = torch.Generator().manual_seed(higher)
    sizes = (3,), (4,), (3,), (), (1, 3), (higher, 3)
    whole = [torch.randn(200, *size, generator=g).to(DEVICE) for size in sizes]
    for count in (0, 1, 70, 200):
        index = torch.randperm(200, generator=g)[:count].sort().values.to(DEVICE)
        rows = [torch.randn(count, *size, generator=g).to(DEVICE) for size in sizes]
        wanted = [table.index_copy(0, index, value) for table, value in zip(whole, rows, strict=True)]
        found = [table.clone() for table in whole]
        FUSED.rows.put(index, *rows, *found)
        for table, want, value, taken in zip(found, wanted, rows, FUSED.rows.take(index, *found), strict=True):
            assert torch.equal(table, want)
            assert torch.equal(taken, value)
    # A gradient may come in any order of memory.
    turned = [table.transpose(0, -1).contiguous().transpose(0, -1) if table.dim() > 1 else table for table in whole]
    for taken, table in zip(FUSED.rows.take(index, *turned), whole, strict=True):
        assert torch.equal(taken, table[index])


def test_where_triton_cannot_compile_the_reference_is_used_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> Any:
        raise RuntimeError("Python.h: No such file or directory")

    monkeypatch.setattr(loss, "loss_by_tile", fails)
    load_fused.cache_clear()
    with pytest.warns(UserWarning, match=r"torch's own operations.*Python.h.*needs a C compiler"):
        assert load_fused(DEVICE.type) is None
    load_fused.cache_clear()


class Brings(ReferenceRenderer):  # type: ignore[misc]  # final; only its loss and its optimiser are others
    """The reference renderer with the kernels' loss and optimiser."""

    loss = property(lambda _: FusedLoss(FUSED, ReferenceLoss()))  # type: ignore[assignment]
    optimiser = property(lambda _: FusedAdam(FUSED, None))  # type: ignore[assignment]


CHECKS = [
    loss_checks.check_loss_reference,
    loss_checks.check_loss_mask,
    loss_checks.check_loss_bytes,
    loss_checks.check_loss_pure,
    optimiser_checks.check_optimiser_adam,
    optimiser_checks.check_optimiser_rows,
    optimiser_checks.check_optimiser_refuses,
    optimiser_checks.check_residual_optimiser,
]


@pytest.mark.skipif(HAS_GPU, reason="the contract of the renderer itself runs on the GPU")
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_contract_of_a_loss_and_of_an_optimiser(check: Any) -> None:
    check(Brings())


@pytest.mark.parametrize("module", [adam, boxes, gates, rate, rows], ids=lambda module: module.__name__.split(".")[-1])
def test_no_kernel_is_compiled_anew_for_another_number_of_rows(module: Any) -> None:
    """Triton compiles once more where a number becomes 1 or divisible by 16, unless it is told not to."""
    by_rows = {"size", "count", "parts", "last", "halvings"}
    kernels = [value for value in vars(module).values() if hasattr(value, "fn")]
    found = {k.fn.__name__: by_rows.intersection(inspect.signature(k.fn).parameters) for k in kernels}
    assert any(found.values())
    for kernel in kernels:
        spared = kernel.kwargs.get("do_not_specialize") if hasattr(kernel, "kwargs") else kernel.do_not_specialize
        assert found[kernel.fn.__name__] <= set(spared or []), kernel.fn.__name__


COMPILE = """
import sys
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from gsstream_gsplat_render import adam, boxes, gates, loss, rate, rows

KINDS = {"target": "*u8", "tiles": "*u8", "steps": "*i32", "visible": "*u8", "table": "*u8", "is_well": "*u8"}
KINDS |= {"places": "*i16"}
KINDS |= dict.fromkeys("near ends most active node_of index".split(), "*i64")
KINDS |= dict.fromkeys("radii boxes areas owners".split(), "*i32")
POINTERS = "image weights sums grads out values gradients first second corrections rates".split()
POINTERS += "means scales latents gates logits opened slopes by_gate position by_logit by_position".split()
POINTERS += "quats opacities sh0 shN all_means all_quats all_scales all_opacities all_sh0 all_shN".split()
NUMBERS = "limit dssim scale rate slow slower weight least ln2 temperature offset levels".split()
NUMBERS += "open_logit open_weight displacement_weight".split()

def compiled(function, **constants):
    kinds = {**KINDS, **dict.fromkeys(POINTERS, "*fp32"), **dict.fromkeys(NUMBERS, "fp32")}
    signature = {name: "constexpr" if name in constants else kinds.get(name, "i32") for name in function.arg_names}
    source = ASTSource(function, signature, constexprs=constants)
    return triton.compile(source, target=GPUTarget("cuda", int(sys.argv[1]), 32)).asm["cubin"]

found = [compiled(adam._move, as_table=True, ahead=ahead, block=512) for ahead in (0, 1)]
found += [compiled(kernel, as_bytes=True, all_tiles=False) for kernel in (loss._compare, loss._pull_back)]
found += [compiled(boxes._find, side=16, block=256), compiled(boxes._cover, wide=32)]
found += [compiled(rate._sum, rows=256, wide=16), compiled(rate._price, as_tensor=True, rows=256, wide=16)]
found += [compiled(kernel, block=256) for kernel in (boxes._count, boxes._list, gates._open, gates._pull)]
found += [compiled(rows._exchange, higher=9, wide=16, into=into, block=64) for into in (True, False)]
assert all(code[:4] == b"\\x7fELF" for code in found)
print(len(found))
"""


@pytest.mark.parametrize("architecture", ["80", "90"])
def test_the_kernels_compile_for_a_gpu_that_is_not_here(architecture: str, tmp_path: Path) -> None:
    """The interpreter takes Python that the compiler refuses."""
    environment = {**os.environ, "TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPILE, architecture], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "14"
