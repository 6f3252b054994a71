"""The native photometric loss against float64 torch and kornia."""

from collections.abc import Callable
from typing import Any

import kornia
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gsstream_cpu_render.loss import PreparedImage, photometric_loss, tile_shape
from numpy.typing import NDArray

from gsstream.api import InputError, ShapeError

Image = NDArray[np.float32]
SIZES = [(1, 1), (3, 7), (16, 16), (17, 5), (5, 40), (33, 50), (67, 91), (20, 300)]


def smooth(rng: np.random.Generator, height: int, width: int) -> Image:
    coarse = torch.from_numpy(rng.random((1, 3, height // 12 + 2, width // 12 + 2), dtype=np.float32))
    fine = F.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    return np.ascontiguousarray(fine[0].permute(1, 2, 0).numpy())


def noise_pair(rng: np.random.Generator, height: int, width: int) -> tuple[Image, Image]:
    return rng.random((height, width, 3), dtype=np.float32), rng.random((height, width, 3), dtype=np.float32)


def near_pair(rng: np.random.Generator, height: int, width: int) -> tuple[Image, Image]:
    target = smooth(rng, height, width)
    moved = target + 0.05 * rng.standard_normal(target.shape).astype(np.float32)
    return np.clip(moved, 0, 1).astype(np.float32), target


def flat_pair(_: np.random.Generator, height: int, width: int) -> tuple[Image, Image]:
    return np.full((height, width, 3), 0.9, np.float32), np.full((height, width, 3), 0.95, np.float32)


def white_on_black(_: np.random.Generator, height: int, width: int) -> tuple[Image, Image]:
    return np.ones((height, width, 3), np.float32), np.zeros((height, width, 3), np.float32)


def bright_step(_: np.random.Generator, height: int, width: int) -> tuple[Image, Image]:
    image = np.full((height, width, 3), 0.98, np.float32)
    image[:, width // 2 :] = 0.02
    return image, np.ascontiguousarray(np.roll(image, 1, axis=1))


PAIRS = [noise_pair, near_pair, flat_pair, white_on_black, bright_step]


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """SSIM per pixel and channel, [H, W, 3] float64, written from the paper's formula with one 2D convolution."""
    line = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    line = line / line.sum()
    window = (line[:, None] * line[None])[None, None].expand(3, 1, 11, 11)

    def blur(x: torch.Tensor) -> torch.Tensor:
        return F.conv2d(x, window, padding=5, groups=3)

    x, y = image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None]
    mx, my = blur(x), blur(y)
    vx, vy, cxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    value = (2 * mx * my + 1e-4) * (2 * cxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return value[0].permute(1, 2, 0)


def pixels_of(mask: NDArray[Any], height: int, width: int) -> NDArray[np.float64]:
    return np.kron(mask, np.ones((16, 16)))[:height, :width, None]


def oracle(image: Image, target: Image, weight: float, mask: NDArray[Any] | None = None) -> tuple[float, Any]:
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    y = torch.tensor(target, dtype=torch.float64)
    each = (1 - weight) * (x - y).abs() + weight * (1 - ssim_map(x, y))
    if mask is not None:
        each = each * torch.from_numpy(pixels_of(mask, *image.shape[:2]))
    loss = each.sum() / image.size
    (gradient,) = torch.autograd.grad(loss, x)
    return loss.item(), gradient.numpy()


def assert_gradient(got: Any, wanted: Any, tolerance: float = 1e-5) -> None:
    # In units of one pixel's share, where |I - G| alone has gradient 1.
    scale = got.size
    assert np.abs(got - wanted).max() * scale <= tolerance * max(1.0, np.abs(wanted).max() * scale)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("pair", PAIRS)
def test_value_and_gradient_equal_float64(size: tuple[int, int], pair: Callable[..., tuple[Image, Image]]) -> None:
    image, target = pair(np.random.default_rng(1), *size)
    for weight in (0.0, 0.2, 1.0):
        value, gradient = oracle(image, target, weight)
        for goal in (target, PreparedImage(target)):
            result = photometric_loss(image, goal, dssim_weight=weight)
            # A sum of two windows of 11 x 11 float32 products, in the order of the instruction set: 16 rounding errors.
            assert result.value == pytest.approx(value, abs=2e-6)
            # Between flat images of unequal brightness two terms of size w |G - I| / C2 cancel: the worst case.
            assert_gradient(result.gradient, gradient, 1e-5 * (1 + weight))


@pytest.mark.parametrize("pair", PAIRS)
def test_every_instruction_set(isa: str, pair: Callable[..., tuple[Image, Image]]) -> None:
    image, target = pair(np.random.default_rng(2), 37, 75)
    mask = np.random.default_rng(3).random(tile_shape(37, 75)) < 0.5
    for chosen in (None, mask):
        value, gradient = oracle(image, target, 0.2, chosen)
        result = photometric_loss(image, target, tile_mask=chosen)
        assert result.value == pytest.approx(value, abs=1e-6)
        assert_gradient(result.gradient, gradient if chosen is None else gradient * pixels_of(chosen, 37, 75))


@pytest.mark.parametrize("size", [(3, 7), (33, 50), (120, 160)])
def test_equals_kornia_on_padded_images(size: tuple[int, int]) -> None:
    image, target = near_pair(np.random.default_rng(4), *size)
    planes = [torch.from_numpy(x).double().permute(2, 0, 1)[None] for x in (image, target)]
    padded = [F.pad(x, (5, 5, 5, 5)) for x in planes]
    kornia_ssim = kornia.metrics.ssim(padded[0], padded[1], 11, eps=0.0, padding="valid").mean().item()
    assert photometric_loss(image, target).dssim == pytest.approx(1 - kornia_ssim, abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_masked_sum_and_gradients(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = int(rng.integers(20, 150)), int(rng.integers(20, 300))
    image, target = near_pair(rng, height, width)
    mask = rng.random(tile_shape(height, width)) < rng.choice([0.05, 0.3, 0.7])
    value, gradient = oracle(image, target, 0.2, mask)
    inside = pixels_of(mask, height, width)
    for goal, chosen in ((target, mask), (PreparedImage(target), mask.astype(np.uint8))):
        result = photometric_loss(image, goal, tile_mask=chosen)
        assert result.value == pytest.approx(value, abs=1e-6)
        assert_gradient(result.gradient, gradient * inside)
        assert result.gradient is not None
        assert not result.gradient[np.broadcast_to(inside == 0, image.shape)].any()


def test_disjoint_masks_add_up_to_the_dense_loss() -> None:
    rng = np.random.default_rng(7)
    image, target = near_pair(rng, 100, 140)
    mask = rng.random(tile_shape(100, 140)) < 0.5
    parts = [photometric_loss(image, target, tile_mask=m) for m in (mask, ~mask)]
    beside = [photometric_loss(image, target, tile_mask=m, around=True).gradient for m in (mask, ~mask)]
    dense = photometric_loss(image, target)
    full = photometric_loss(image, target, tile_mask=np.ones_like(mask))
    assert parts[0].value + parts[1].value == pytest.approx(dense.value, abs=1e-7)
    assert_gradient(beside[0] + beside[1], dense.gradient)  # type: ignore[operator]
    assert full.value == dense.value
    np.testing.assert_array_equal(full.gradient, dense.gradient)  # type: ignore[arg-type]


def test_equal_images_have_exactly_no_loss_and_no_gradient(isa: str) -> None:
    _, image = near_pair(np.random.default_rng(9), 70, 90)
    result = photometric_loss(image, PreparedImage(image))
    assert result.value == 0.0
    assert result.gradient is not None
    assert not result.gradient.any()


@pytest.mark.parametrize("size", [(1, 1), (17, 5), (67, 91), (20, 300)])
def test_a_target_of_bytes_is_its_float32_bit_for_bit(size: tuple[int, int], isa: str) -> None:
    rng = np.random.default_rng(21)
    codes = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    codes.flat[: min(256, codes.size)] = np.arange(min(256, codes.size))
    image, floats = rng.random(codes.shape, dtype=np.float32), codes.astype(np.float32) / np.float32(255)
    mask = rng.random(tile_shape(*size)) < 0.6
    for prepare in (lambda target: target, PreparedImage, lambda target: PreparedImage(target, compact=True)):
        for chosen in (None, mask):
            got, want = (photometric_loss(image, prepare(target), tile_mask=chosen) for target in (codes, floats))
            assert got.value == want.value
            np.testing.assert_array_equal(got.gradient, want.gradient)  # type: ignore[arg-type]


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_compact_statistics_change_a_gradient_by_their_rounding(
    pair: Callable[..., tuple[Image, Image]], weight: float, isa: str
) -> None:
    """The root of a variance is off by 1/262,140 at most, by which 2 variance + C2 changes by 1 part in 5,000 (at a
    variance of C2 / 2, the worst). Twice that is allowed, since a gradient holds the mean's rounding, too."""
    image, target = pair(np.random.default_rng(22), 70, 135)
    compact = PreparedImage(target, compact=True)
    exact, rounded = (photometric_loss(image, goal, dssim_weight=weight) for goal in (target, compact))
    assert compact.statistics[0].dtype == np.uint16
    assert rounded.value == pytest.approx(exact.value, abs=1e-6)
    largest = np.abs(exact.gradient).max()  # type: ignore[arg-type]
    np.testing.assert_allclose(rounded.gradient, exact.gradient, rtol=0, atol=4e-4 * largest)  # type: ignore[arg-type]


def test_a_target_beyond_its_codes_keeps_whole_statistics() -> None:
    """What no code stands for would be cut off at 0 and 1."""
    image, target = near_pair(np.random.default_rng(23), 40, 50)
    wide = (2 * target - 0.5).astype(np.float32)
    prepared = PreparedImage(wide, compact=True)
    assert prepared.statistics[0].dtype == np.float32
    assert photometric_loss(image, prepared).value == photometric_loss(image, PreparedImage(wide)).value


def test_gradient_of_a_local_change_stays_local() -> None:
    _, target = near_pair(np.random.default_rng(10), 80, 80)
    image = target.copy()
    image[40, 40] = 1 - image[40, 40]
    gradient = photometric_loss(image, target).gradient
    assert gradient is not None
    rows, columns, _ = np.nonzero(gradient)
    # A window reaches 5 pixels, and so does its transpose.
    assert rows.min() >= 30
    assert rows.max() <= 50
    assert columns.min() >= 30
    assert columns.max() <= 50


def test_calls_leave_no_trace_in_later_calls() -> None:
    rng = np.random.default_rng(12)
    image, target = near_pair(rng, 64, 64)
    mask = np.zeros(tile_shape(64, 64), bool)
    mask[1, 1] = True
    first = photometric_loss(image, target, tile_mask=mask)
    photometric_loss(*noise_pair(rng, 64, 64))
    photometric_loss(*noise_pair(rng, 96, 32))
    again = photometric_loss(image, target, tile_mask=mask)
    np.testing.assert_array_equal(first.gradient, again.gradient)  # type: ignore[arg-type]
    assert first.value == again.value


def test_out_is_written_only_in_active_tiles() -> None:
    image, target = near_pair(np.random.default_rng(13), 40, 50)
    mask = np.zeros(tile_shape(40, 50), bool)
    mask[2, 3] = True  # the partial tile in the corner
    out = np.full_like(image, 7.0)
    result = photometric_loss(image, target, tile_mask=mask, out=out)
    assert result.gradient is out
    inside = np.broadcast_to(pixels_of(mask, 40, 50) > 0, out.shape)
    assert (out[~inside] == 7.0).all()
    assert_gradient(np.where(inside, out, 0), oracle(image, target, 0.2, mask)[1] * inside)


def test_without_gradient_the_value_is_the_same() -> None:
    image, target = near_pair(np.random.default_rng(14), 50, 60)
    result = photometric_loss(image, target, gradient=False)
    assert result.gradient is None
    assert result.value == photometric_loss(image, target).value


def _wrong(**changes: Any) -> Callable[[], object]:
    image, target = near_pair(np.random.default_rng(16), 20, 40)
    arguments: dict[str, Any] = {"image": image, "target": target} | changes
    return lambda: photometric_loss(arguments.pop("image"), arguments.pop("target"), **arguments)


GOOD = np.full((20, 40, 3), 0.5, np.float32)
READ_ONLY = np.zeros((20, 40, 3), np.float32)
READ_ONLY.flags.writeable = False


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (_wrong(image=GOOD.astype(np.float64)), "image: expected dtype float32, got float64"),
        (_wrong(image=GOOD[:, :, :2].copy()), "image: expected shape"),
        (_wrong(image=GOOD[:, ::-1]), "image: expected a contiguous array"),
        (_wrong(image=np.zeros((0, 4, 3), np.float32)), "at least one pixel"),
        (_wrong(image=[[1.0]]), "image: expected a numpy array"),
        (_wrong(target=GOOD[:10].copy()), "target: expected shape"),
        (_wrong(tile_mask=np.ones((2, 2), bool)), "tile_mask: expected shape"),
        (_wrong(tile_mask=np.ones((2, 3), np.int64)), "tile_mask: expected dtype"),
        (_wrong(out=READ_ONLY), "out: expected a writable array"),
        (_wrong(out=np.zeros((20, 40, 3))), "out: expected dtype float32"),
    ],
)
def test_wrong_arrays_are_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        call()


@pytest.mark.parametrize("weight", [-0.1, 1.5, float("nan")])
def test_wrong_weight_is_refused(weight: float) -> None:
    with pytest.raises(InputError, match="dssim_weight"):
        _wrong(dssim_weight=weight)()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_pixels_are_named(value: float) -> None:
    bad = GOOD.copy()
    bad[19, 39, 2] = value
    for call in (_wrong(image=bad), _wrong(target=bad), lambda: PreparedImage(bad)):
        with pytest.raises(ShapeError, match=r"index \[19, 39, 2\]"):
            call()


@pytest.mark.parametrize("seed", range(4))
def test_around_gives_the_dense_gradient_in_masked_tiles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = int(rng.integers(20, 150)), int(rng.integers(20, 300))
    image, target = near_pair(rng, height, width)
    mask = rng.random(tile_shape(height, width)) < rng.choice([0.05, 0.3])
    dense = photometric_loss(image, target)
    part = photometric_loss(image, PreparedImage(target), tile_mask=mask, around=True)
    inside = np.broadcast_to(pixels_of(mask, height, width) != 0, image.shape)
    assert dense.gradient is not None
    assert part.gradient is not None
    np.testing.assert_allclose(part.gradient[inside], dense.gradient[inside], rtol=1e-5, atol=1e-9)
    assert not part.gradient[~inside].any()


def test_around_changes_by_what_the_whole_loss_changes_by() -> None:
    """What a masked tile does to the windows of its neighbours is in the sum."""
    rng = np.random.default_rng(9)
    image, target = near_pair(rng, 64, 96)
    mask = np.zeros((4, 6), bool)
    mask[1, 2:4] = True
    changed = image.copy()
    changed[16:32, 32:64] += 0.05 * rng.normal(size=(16, 32, 3)).astype(np.float32)
    part = [photometric_loss(x, target, tile_mask=mask, around=True).value for x in (image, changed)]
    whole = [photometric_loss(x, target).value for x in (image, changed)]
    assert abs(part[1] - part[0]) > 1e-4
    assert part[1] - part[0] == pytest.approx(whole[1] - whole[0], abs=1e-7)
