"""Bad input is refused with a message that says what, where and what to do; nothing is rendered."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH, camera, equal_bits, random_splats, rasterizer, upstream
from gsstream_cpu_render.arrays import SplatArrays, new_gradients
from gsstream_cpu_render.by_parts import draw_by_parts
from gsstream_cpu_render.native import PAIR_BYTES, SPLAT_BYTES
from gsstream_cpu_render.rasterizer import NumpyRasterizer, render_numpy

from gsstream.api import InputError, ShapeError


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh0", "shN"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("row", [0, 37])
def test_values_that_are_not_finite_are_named(name: str, value: float, row: int) -> None:
    splats = random_splats(40, 0, 4)
    splats.means[row] = 0.0  # in view, so that its harmonics are read
    splats.opacities[row] = 0.0
    getattr(splats, name).reshape(40, -1)[row, -1] = value
    image = np.full((HEIGHT, WIDTH, 3), 7.0, np.float32)
    with pytest.raises(InputError, match=rf"{name}: expected finite values, got {value} at index \[{row}"):
        rasterizer().forward(splats, image=image)
    assert (image == 7.0).all()


def test_overflow_of_finite_values() -> None:
    splats = random_splats(20, 0, 9)
    splats.means[5], splats.opacities[5] = 0.0, 0.0  # on the axis, where these three harmonics add up to more than 1
    splats.sh0[5] = 3.3e38
    splats.shN[5, [1, 5]] = 3.3e38
    with pytest.raises(InputError, match="overflowed float32"):
        rasterizer().forward(splats)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("means", lambda a: a.astype(np.float64), "means: expected dtype float32, got float64"),
        ("means", lambda a: a[:, :2].copy(), r"means: expected shape \[N, 3\], got \[20, 2\]"),
        ("quats", lambda a: a[:19], r"quats: expected shape \[20, 4\], got \[19, 4\]"),
        ("scales", lambda a: np.asfortranarray(a), "scales: expected a contiguous array"),
        ("opacities", lambda a: a[:, None], r"opacities: expected shape \[20\], got \[20, 1\]"),
        ("sh0", lambda a: a[:, 0], r"sh0: expected shape \[20, 1, 3\]"),
        ("shN", lambda a: a[:, :2].copy(), r"shN: expected K-1 coefficients with K in \(1, 4, 9, 16\), got K = 3"),
        ("shN", lambda a: a.tolist(), "shN: expected a numpy array"),
    ],
)
def test_arrays_of_wrong_form(name: str, change: object, message: str) -> None:
    splats = random_splats(20, 0, 4)
    with pytest.raises(ShapeError, match=message):
        rasterizer().forward(splats._replace(**{name: change(getattr(splats, name))}))  # type: ignore[operator]


def test_outputs_are_never_silently_copied() -> None:
    splats, (v_image, v_alpha) = random_splats(20, 0, 4), upstream(0)
    subject = rasterizer()
    with pytest.raises(ShapeError, match="image: expected dtype float32, got float64"):
        subject.forward(splats, image=np.zeros((HEIGHT, WIDTH, 3)))
    frozen = np.zeros((HEIGHT, WIDTH), np.float32)
    frozen.flags.writeable = False
    with pytest.raises(ShapeError, match="transmittance: expected a writable array"):
        subject.forward(splats, transmittance=frozen)
    subject.forward(splats)
    out = new_gradients(20, 4)
    with pytest.raises(ShapeError, match=r"out.quats: expected a contiguous array"):
        subject.backward(v_image, out=out._replace(quats=np.zeros((20, 8), np.float32)[:, ::2]))
    with pytest.raises(ShapeError, match=r"v_image: expected shape"):
        subject.backward(v_image[1:])
    with pytest.raises(ShapeError, match=r"v_alpha: expected dtype float32"):
        subject.backward(v_image, v_alpha.astype(np.float16))


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.ones((3, 4), np.float32), "tile_mask: expected a bool or uint8 array"),
        (np.ones((4, 3), bool), r"tile_mask: expected shape \[3, 4\]"),
        (np.ones(12, bool), r"tile_mask: expected shape \[3, 4\]"),
    ],
)
def test_bad_tile_masks(mask: np.ndarray, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        rasterizer().forward(random_splats(5, 0, 1), tile_mask=mask)


def test_a_strided_mask_means_what_it_says() -> None:
    splats = random_splats(50, 0, 1)
    wide = np.zeros((3, 8), bool)
    wide[1, 2] = True
    a, b = (np.zeros((HEIGHT, WIDTH, 3), np.float32) for _ in range(2))
    rasterizer().forward(splats, tile_mask=wide[:, ::2], image=a)
    rasterizer().forward(splats, tile_mask=wide[:, ::2].copy(), image=b)
    assert np.array_equal(a, b)
    assert (a[16:32, 16:32] != 0).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmat": np.eye(3)}, r"viewmat: expected shape \[4, 4\], got \[3, 3\]"),
        ({"viewmat": np.full((4, 4), np.nan)}, "viewmat: expected finite values"),
        ({"K": np.diag([0.0, 50, 1])}, "K: expected positive focal lengths in pixels, got fx = 0"),
        ({"K": np.array([[50.0, 1, 5], [0, 50, 5], [0, 0, 1]])}, "K: expected no skew"),
        ({"width": 0}, "image size: expected 1 to 65536"),
        ({"height": 70000}, "image size: expected 1 to 65536"),
        ({"near": 0.0}, "near: expected a positive distance"),
        ({"background": (0.0, np.nan, 0.0)}, "background: expected three finite numbers"),
        ({"background": (0.0, 0.0)}, "background: expected three finite numbers"),
    ],
)
def test_bad_cameras(change: dict[str, object], message: str) -> None:
    viewmat, K = camera()
    good = {"viewmat": viewmat, "K": K, "width": 20, "height": 10, "background": (0, 0, 0), "near": 0.01}
    with pytest.raises(InputError, match=message):
        NumpyRasterizer(**{**good, **change})  # type: ignore[arg-type]


def test_two_threads_on_one_object_are_refused() -> None:
    width, height = 640, 480
    splats = random_splats(20_000, 0, 1)
    subject = rasterizer(width, height, 500.0)
    messages: list[str] = []

    def work() -> None:
        for _ in range(30):
            try:
                subject.forward(splats)
            except RuntimeError as error:
                messages.append(str(error))

    workers = [threading.Thread(target=work) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert messages
    assert all("one Rasterizer per camera and thread" in message for message in messages)


def test_two_objects_in_two_threads_do_not_disturb_each_other() -> None:
    splats = [random_splats(3000, seed, 4) for seed in range(3)]
    want = [rasterizer(160, 120, 150.0).forward(s)[0] for s in splats]
    wrong: list[int] = []

    def work(which: int) -> None:
        subject = rasterizer(160, 120, 150.0)
        same = [np.array_equal(subject.forward(splats[which])[0], want[which]) for _ in range(5)]
        if not all(same):
            wrong.append(which)

    workers = [threading.Thread(target=work, args=(i,)) for i in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert wrong == []


def test_splat_arrays_have_gsstreams_names_in_gsstreams_order() -> None:
    from gsstream.api import ATTRIBUTES

    assert SplatArrays._fields == tuple(ATTRIBUTES)


def test_more_pairs_than_the_memory_allows_are_refused_and_the_next_pass_is_as_ever() -> None:
    """Every Gaussian covers every tile; the limit counts pairs of all threads together."""
    splats = random_splats(3000, 1, 1)
    wide = splats._replace(scales=np.full_like(splats.scales, 3.0))
    subject = rasterizer()
    alone = rasterizer().forward(splats)
    for most in (0, 1, 100_000):
        subject.limit_memory(most, 3000)
        with pytest.raises(MemoryError, match="cover more tiles of the picture than the limit on memory allows"):
            subject.forward(wide)
    subject.limit_memory(100_000_000, 3000)
    assert equal_bits(subject.forward(wide), rasterizer().forward(wide))
    assert equal_bits(subject.forward(splats), alone)
    subject.limit_memory(500_000, 3000)
    with pytest.raises(MemoryError):
        subject.forward(wide)
    with pytest.raises(InputError, match="expected a forward pass"):
        subject.backward(np.zeros((HEIGHT, WIDTH, 3), np.float32))


def test_a_limit_that_is_never_met_changes_no_bit() -> None:
    splats = random_splats(500, 2, 4)
    viewmat, K = camera()
    free = render_numpy(splats, viewmat, K, WIDTH, HEIGHT, BACKGROUND)
    bound = render_numpy(splats, viewmat, K, WIDTH, HEIGHT, BACKGROUND, max_memory=1 << 30)
    assert free.tobytes() == bound.tobytes()


@pytest.mark.parametrize("most_of_a_part", [30_000_000, 1_000_000, 200_000])
def test_a_picture_drawn_by_parts_has_the_bits_of_the_whole(most_of_a_part: int) -> None:
    """Gaussians of all sizes, some of them over every tile: the whole, parts of a few tiles, and single ones."""
    splats = random_splats(3000, 2, 4)
    splats.scales[::4] = 2.0
    viewmat, K = camera()
    whole, view = (NumpyRasterizer(viewmat, K, 300, 170, BACKGROUND) for _ in range(2))
    expected, _ = whole.forward(splats)
    assert draw_by_parts(view, splats, 1 << 30, most_of_a_part).tobytes() == expected.tobytes()
    if most_of_a_part < 2_000_000 < whole.statistics()["pairs"] * PAIR_BYTES:
        assert view.memory_bytes() < whole.memory_bytes() / 2


def test_parts_end_at_the_limit_on_the_whole_and_a_tile_that_is_too_much_is_refused() -> None:
    splats = random_splats(400, 2, 4)
    splats.scales[:] = 2.0
    viewmat, K = camera()
    view = NumpyRasterizer(viewmat, K, 300, 170, BACKGROUND)
    view.forward(splats)
    whole = view.statistics()["pairs"] * PAIR_BYTES + 400 * SPLAT_BYTES
    draw_by_parts(view, splats, 2 * whole, 100_000)
    for most, part in ((0.9 * whole, 100_000), (whole // 3, 100_000), (whole // 100, 100_000), (2 * whole, 10_000)):
        with pytest.raises(MemoryError, match="cover more tiles of the picture than the limit on memory allows"):
            draw_by_parts(NumpyRasterizer(viewmat, K, 300, 170, BACKGROUND), splats, int(most), part)
