"""Pairing as a pure object: what goes in decides what comes out."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from gsstream_capture.clock import PATIENCE, SenderClock
from gsstream_capture.pairing import Pairing, Stamped
from hypothesis import given, settings
from hypothesis import strategies as st

PERIOD = 0.1


def played(rows, cameras, *, fps=10.0, **options):
    """Push pictures in the order of arrival, poll after each; the pairing and the instants."""
    pairing, out = Pairing(cameras, fps, **options), []
    for picture in sorted(rows, key=lambda row: row.arrival):
        pairing.push(picture)
        out += polled(pairing, picture.arrival)
    return pairing, out


def polled(pairing, now):
    return list(iter(lambda: pairing.poll(now), None))


def rig(offsets, delays, count, *, period=PERIOD, start=1000.0, jitter=0.0, shake=0.0, lost=frozenset(), seed=0):
    """Pictures that carry the number of their instant; each camera's arrive in order."""
    draw, rows = random.Random(seed), []
    for camera, (offset, delay) in enumerate(zip(offsets, delays, strict=True)):
        came = 0.0
        for k in range(count):
            taken = start + k * period + offset + draw.uniform(-jitter, jitter)
            came = max(came, taken + delay + draw.uniform(0, shake))
            if (camera, k) not in lost:
                rows.append(Stamped(camera, taken, came, k))
    return rows


def numbers(instant):
    return {picture.frame for picture in instant.pictures.values()}


few = settings(max_examples=15)


@few
@given(
    st.lists(st.tuples(st.floats(-0.015, 0.015), st.floats(0, 1.4)), min_size=1, max_size=6),
    st.floats(0, 0.3),
    st.integers(0, 2**20),
    st.floats(0, 10),
)
def test_every_instant_is_whole_and_of_one_number_whatever_the_delays(cameras, shake, seed, start) -> None:
    rows = rig(*zip(*cameras, strict=True), 80, start=1e9 + start, jitter=0.008, shake=shake, seed=seed)
    pairing, out = played(rows, len(cameras))
    assert all(len(numbers(instant)) == 1 and not instant.absent for instant in out)
    first = out[0].pictures[0].frame
    # At the end the last pictures may still wait for a nearer one.
    assert [out_of.pictures[0].frame for out_of in out] == list(range(first, first + len(out)))
    assert first <= 1
    assert first + len(out) >= 79
    assert [instant.index for instant in out] == list(range(len(out)))
    assert (pairing.counts.dropped, pairing.counts.late, pairing.counts.strange) == (0, 0, 0)


@few
@given(st.sets(st.tuples(st.integers(0, 3), st.integers(25, 70)), max_size=60), st.integers(0, 2**20))
def test_lost_pictures_cost_their_own_place_and_nothing_else(lost, seed) -> None:
    rows = rig([0.0] * 4, [0.05, 0.2, 0.1, 0.3], 80, jitter=0.01, lost=lost, seed=seed)
    _, out = played(rows, 4, silence=10.0)
    got = {(camera, picture.frame) for instant in out for camera, picture in instant.pictures.items()}
    assert all(len(numbers(instant)) == 1 for instant in out)
    assert got >= {(c, k) for c in range(4) for k in range(25, 70)} - lost
    assert all(set(instant.absent) == {c for c in range(4) if (c, min(numbers(instant))) in lost} for instant in out)


@few
@given(st.floats(-0.045, 0.045), st.integers(0, 2**20))
def test_a_camera_that_is_off_is_told_by_how_much(off, seed) -> None:
    rows = rig([0.0, 0.0, off, 0.0], [0.0, 0.1, 0.2, 0.3], 120, jitter=0.001, seed=seed)
    pairing, out = played(rows, 4)
    found = pairing.offsets()
    assert abs(found[2].median - off) < 0.002
    assert all(abs(found[c].median) < 0.002 and found[c].spread < 0.01 for c in (0, 1, 3))
    assert len(out) > 110


@few
@given(st.floats(-0.04, 0.04), st.integers(0, 2**20))
def test_the_rigs_rate_follows_its_cameras(drift, seed) -> None:
    rows = rig([0.0, 0.004, -0.004], [0.1, 0.2, 0.0], 600, period=PERIOD * (1 + drift), jitter=0.002, seed=seed)
    pairing, out = played(rows, 3)
    assert all(len(numbers(instant)) == 1 and not instant.absent for instant in out)
    assert len(out) >= 595
    assert pairing.fps * (1 + drift) == pytest.approx(10, rel=0.002)


@pytest.mark.parametrize("rate", [15, 25, 30, 60])
def test_of_a_faster_camera_the_nearest_picture_is_taken(rate) -> None:
    rows = rig([0.0, 0.0], [0.0, 0.3], 10 * rate, period=1 / rate)
    _, out = played(rows, 2)
    assert len(out) >= 95
    for instant in out:
        for picture in instant.pictures.values():
            assert abs(picture.time - instant.time) <= 0.5 / rate + 1e-6
        assert len(numbers(instant)) == 1


@few
@given(st.floats(2.5, 20), st.floats(0, 0.3))
def test_a_silent_camera_is_left_out_and_comes_back(gone, delay) -> None:
    """It is left out while it is silent; those that go on for it meanwhile do not wait for its way here either."""
    missing = {(1, k) for k in range(40, 40 + int(gone * 10))}
    count = 100 + int(gone * 10)
    rows = rig([0.0] * 3, [0.05, delay, 0.1], count, lost=missing)
    _, out = played(rows, 3)
    assert all(len(numbers(instant)) == 1 for instant in out)
    absent = [min(numbers(instant)) for instant in out if instant.absent]
    assert all(instant.absent in ((), (1,)) for instant in out)
    back = 40 + int(gone * 10)
    assert absent == list(range(40, absent[-1] + 1))
    assert back - 1 <= absent[-1] <= back + math.ceil(delay / PERIOD)
    assert len(out) >= count - 2, "nobody else loses an instant"


def test_nobody_waits_for_wall_time_while_a_camera_speaks() -> None:
    """A camera that is decoded 1.9 s late in every instant is waited for: this machine is busy."""
    rows = rig([0.0, 0.0], [0.0, 1.9], 100)
    _, out = played(rows, 2, silence=2.0)
    assert len(out) >= 98
    assert not any(instant.absent for instant in out)


@few
@given(st.integers(6, 30), st.integers(2, 5), st.integers(0, 2**20))
def test_what_overflows_is_an_instant_of_all_cameras(depth, cameras, seed) -> None:
    """Nobody polls for ten seconds, as when a disk hangs: memory stays bounded, and what is left is whole."""
    pairing = Pairing(cameras, 10.0, depth=depth)
    delays = [0.1 * c for c in range(cameras)]
    rows = sorted(rig([0.0] * cameras, delays, 200, jitter=0.01, seed=seed), key=lambda row: row.arrival)
    seen = []
    for i, row in enumerate(rows):
        pairing.push(row)
        assert sum(len(camera.waiting) for camera in pairing._cameras) <= pairing.capacity
        if not 50 * cameras <= i <= 150 * cameras:
            seen += polled(pairing, row.arrival)
    assert all(len(numbers(instant)) == 1 and not instant.absent for instant in seen)
    assert 100 - depth - 12 <= pairing.counts.dropped <= 100
    steps = [b - a for a, b in itertools.pairwise(min(numbers(i)) for i in seen)]
    assert sum(step - 1 for step in steps) == pairing.counts.dropped, "what is dropped is counted, and once"
    assert (pairing.counts.late, pairing.counts.strange) == (0, 0)


def test_a_clock_from_the_far_future_stops_nobody_else() -> None:
    rows = [*rig([0.0, 0.0], [0.0, 0.0], 400)]
    rows += [Stamped(2, 1000 + k * PERIOD + (3600 if k > 100 else 0), 1000 + k * PERIOD, k) for k in range(400)]
    pairing, out = played(rows, 3)
    assert len(out) > 395
    assert all({0, 1} <= set(instant.pictures) for instant in out)
    assert sum(len(camera.waiting) for camera in pairing._cameras) <= pairing.capacity
    back = [*rows, *(Stamped(2, 1040 + k * PERIOD, 1040 + k * PERIOD, 400 + k) for k in range(60))]
    back += [Stamped(c, 1040 + k * PERIOD, 1040 + k * PERIOD, 400 + k) for c in (0, 1) for k in range(60)]
    _, again = played(back, 3)
    assert not again[-1].absent, "its clock is set, and it is back"
    assert len(numbers(again[-1])) == 1


@given(
    st.lists(st.tuples(st.integers(0, 2), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)), max_size=200), st.floats(0.5, 60)
)
def test_nothing_that_cameras_say_breaks_it(rows, fps) -> None:
    pairing = Pairing(3, fps, depth=3)
    last = -math.inf
    for camera, time, arrival in rows:
        pairing.push(Stamped(camera, time, arrival))
        for instant in polled(pairing, arrival):
            assert instant.time > last
            assert instant.pictures
            assert all(abs(p.time - instant.time) <= 0.5 / fps * 1.06 for p in instant.pictures.values())
            last = instant.time
        assert sum(len(c.waiting) for c in pairing._cameras) <= pairing.capacity


def test_an_hour_of_silence_is_one_step_and_not_many_instants() -> None:
    rows = rig([0.0, 0.0], [0.0, 0.0], 60) + rig([0.0, 0.0], [0.0, 0.0], 60, start=1000 + 3600.04)
    pairing, out = played(rows, 2)
    assert all(len(numbers(instant)) == 1 and not instant.absent for instant in out)
    assert len(out) >= 117
    assert 35_900 < pairing.counts.empty < 36_000
    assert pairing.counts.dropped == 0


@pytest.mark.parametrize(
    "wrong", [{"cameras": 0}, {"fps": 0}, {"fps": math.nan}, {"tolerance": 0.6}, {"silence": 0}, {"depth": 0}]
)
def test_what_cannot_be_paired_is_refused(wrong) -> None:
    given_ = {"cameras": 2, "fps": 10.0} | wrong
    with pytest.raises(ValueError, match="expected at least one camera"):
        Pairing(given_.pop("cameras"), given_.pop("fps"), **given_)


def told(ties, *, way=0.05, step=0.05, every=50):
    """Times of a camera whose k-th report ties its stamps to ``ties[k]``; the clock and its answers."""
    clock, out = SenderClock(step), []
    for k in range(every * len(ties)):
        stamp, tie = k / 10, ties[k // every]
        out.append(clock.observe(stamp, tie + stamp, report=k % every == 0, arrival=5000 + stamp + way))
    return clock, out


def test_a_clock_is_trusted_after_two_reports() -> None:
    clock, out = told([5000.0, 5000.001, 5000.0])
    assert out[:50] == [None] * 50
    assert out[50:] == [pytest.approx(5000 + k / 10, abs=0.0011) for k in range(50, 150)]
    assert clock.kind == "sender"


@given(st.floats(-0.3, 1.9), st.floats(-0.2, 0.2))
def test_a_camera_that_is_back_is_trusted_at_once_where_its_pictures_take_as_long_as_before(way, off) -> None:
    clock, _ = told([5000.0, 5000.0], way=way)
    again = SenderClock(0.05, before=clock.usual)
    out = [again.observe(k / 10, 7000 + k / 10, report=k == 0, arrival=7000 + k / 10 + way + off) for k in range(9)]
    assert (None not in out) == (abs(off) < 0.05 - 1e-9) or abs(abs(off) - 0.05) < 1e-6
    assert len(set(map(type, out))) == 1


def test_a_first_report_that_is_off_never_reaches_a_picture() -> None:
    """Seen: the first report of a busy sender was 2.2 s off until its second."""
    clock, out = told([5002.2, 5000.0, 5000.001])
    assert out[:50] == [None] * 50
    assert out[50:] == [pytest.approx(5000 + k / 10, abs=0.0011) for k in range(50, 150)]
    assert clock.restarts == 0, "it was never trusted, so nothing was restarted"


@given(st.floats(0.06, 1e6) | st.floats(-1e6, -0.06))
def test_a_step_restarts_a_clock(step) -> None:
    clock, out = told([5000.0, 5000.0, 5000.0 + step, 5000.0 + step])
    assert None not in out[50:100]
    assert out[100:150] == [None] * 50
    assert None not in out[150:]
    assert clock.restarts == 1


@given(st.floats(3, 1e6) | st.floats(-1e6, -3))
def test_a_clock_that_nobody_set_is_steadied_by_arrival(off) -> None:
    clock, out = told([5000.0 + off] * 3)
    assert clock.kind == "steadied"
    assert out[-1] == pytest.approx(5000 + 14.9 + 0.05, abs=1e-3)


def test_a_camera_without_reports_goes_by_arrival_after_a_while() -> None:
    clock = SenderClock(0.05)
    out = [clock.observe(k / 10, None, report=False, arrival=100 + k / 10) for k in range(200)]
    assert out.index(next(t for t in out if t is not None)) == int(PATIENCE * 10) + 1
    assert clock.kind == "arrival"
    assert SenderClock(0.05, reports=False).observe(None, None, report=False, arrival=7.0) == 7.0
