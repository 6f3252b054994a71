"""What a key packet holds of frame 0: which Gaussians the images would miss, and which come first."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_encoder import REFINING, TINY, WORLD, frames

from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.first_layer import largest_error_mask
from gsstream.engine.frame0.hutchinson import TrainingViews, random_signs
from gsstream.engine.frame0.prune import prune_by_error, removal_errors, retained_rows
from gsstream.packet import EncodedPacket, PacketKind, decode_packet, encode_key, first_layer
from gsstream.packet.base import parse_packet
from gsstream.packet.key import KeyState
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.render.exposure import Exposure

BLACK = (0.0, 0.0, 0.0)
GROWING = {"first_frame.max_iterations": 60}


@given(shape=st.lists(st.integers(1, 9), min_size=1, max_size=3), seed=st.integers(0, 999))
def test_random_signs_are_signs_of_any_shape(shape: list[int], seed: int) -> None:
    signs = random_signs(torch.empty(shape), torch.Generator().manual_seed(seed))
    assert signs.shape == torch.Size(shape)
    assert signs.dtype == torch.float32
    assert bool((signs.abs() == 1).all())


def test_random_signs_are_fair_and_independent_of_those_beside_and_below() -> None:
    signs = random_signs(torch.empty(200, 300, 3), torch.Generator().manual_seed(2))
    pairs = (signs, signs[1:] * signs[:-1], signs[:, 1:] * signs[:, :-1], signs[..., 1:] * signs[..., :-1])
    for values in pairs:  # five standard deviations of the mean of so many fair coins
        assert abs(float(values.mean())) < 5 / values.numel() ** 0.5


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return ReferenceRenderer()


def fitted(**settings: Any) -> Gaussians[np.ndarray]:
    """Frame 0 of the small world."""
    with open_recording(WORLD) as source:
        encoder = encoder_for("s2gs-edge", source, {**TINY, "background": list(BLACK), **settings})
        packet = encoder.encode(frames()[0]).packet
    return decode_packet(None, packet.data).gaussians


def images(renderer: Renderer, scene: Gaussians[torch.Tensor], exposure: Exposure | None = None) -> torch.Tensor:
    cameras = frames()[0].cameras
    drawn = [renderer.render(scene, cameras, view, BLACK).image for view in range(len(cameras))]
    return torch.stack([image if exposure is None else exposure[v].apply(image) for v, image in enumerate(drawn)])


@pytest.mark.parametrize("exposed", [False, True])
def test_the_estimate_is_what_leaving_one_out_changes(renderer: Renderer, exposed: bool) -> None:
    """Another way to the same number: draw the scene without it. Opaque ones are among them."""
    scene = fitted(**{"first_frame.prune_error": 0}).map(torch.from_numpy)
    opacities = scene.opacities.clone()
    opacities[::3] = 30.0
    scene = replace(scene, opacities=opacities)
    torch.manual_seed(0)
    exposure = Exposure(torch.eye(3) + 0.2 * torch.randn(3, 3, 3), 0.1 * torch.randn(3, 3)) if exposed else None
    drawn = [
        removal_errors(TrainingViews(renderer, frames()[0], exposure, BLACK), scene, Rng(seed).stream("a", 0), probes=4)
        for seed in range(12)
    ]
    found = torch.stack([errors for errors, _ in drawn]).mean(0)
    whole = images(renderer, scene, exposure)
    for row in (*range(0, len(scene), max(1, len(scene) // 12)), int(found.argmax()), int(found.argmin())):
        rest = torch.tensor([other for other in range(len(scene)) if other != row])
        exact = float((images(renderer, scene.rows(rest), exposure) - whole).double().square().sum())
        assert float(found[row]) == pytest.approx(exact, rel=0.6, abs=1e-4)
    truth = torch.from_numpy(np.stack(list(frames()[0].images)))
    assert drawn[0][1] == pytest.approx(float((whole - truth).square().mean()), rel=1e-3)


def test_the_reference_and_the_cpu_renderer_agree(renderer: Renderer) -> None:
    scene = fitted().map(torch.from_numpy)
    with open_recording(WORLD) as source:
        native = encoder_for("s2gs-edge", source, TINY).assembly.renderer
    one, other = (
        removal_errors(TrainingViews(part, frames()[0], None, BLACK), scene, Rng(3).stream("a", 0), probes=4)[0]
        for part in (renderer, native)
    )
    assert torch.allclose(one, other, rtol=0.05, atol=1e-4)


def test_what_nobody_sees_goes_and_what_is_seen_alone_stays(renderer: Renderer) -> None:
    scene = fitted().map(torch.from_numpy)
    far = scene.rows(torch.zeros(1, dtype=torch.int64))
    far = replace(far, means=far.means + 1000.0)
    both = Gaussians(**{name: torch.cat([getattr(scene, name), getattr(far, name)]) for name, _ in scene.items()})
    errors, error = removal_errors(
        TrainingViews(renderer, frames()[0], None, BLACK), both, Rng(0).stream("a", 0), probes=4
    )
    assert float(errors[-1]) == 0.0
    kept = retained_rows(errors, 0.1 * error)
    assert len(scene) not in kept.tolist()
    assert len(kept) > 0


def test_rows_without_an_error_remain_and_order_is_kept() -> None:
    assert retained_rows(torch.tensor([0.0, 2.0, 0.0, 3.0]), 0.0).tolist() == [1, 3]
    assert retained_rows(torch.tensor([3.0, 1.0, 2.0]), 1.5).tolist() == [0, 2]
    assert retained_rows(torch.zeros(3), 0.0).tolist() == [0, 1, 2]
    assert retained_rows(torch.ones(2), 5.0).tolist() == [0, 1]
    assert retained_rows(torch.zeros(0), 1.0).tolist() == []


def test_a_run_has_fewer_gaussians_that_show_nearly_the_same(renderer: Renderer) -> None:
    every, fewer = (fitted(**GROWING, **{"first_frame.prune_error": least}) for least in (0.0, 10.0))
    assert 0 < len(fewer) < 0.9 * len(every)
    truth = torch.from_numpy(np.stack(list(frames()[0].images)))
    errors = [
        float((images(renderer, scene.map(torch.from_numpy)) - truth).square().mean()) for scene in (every, fewer)
    ]
    assert errors[1] < 1.3 * errors[0]


def test_of_equal_gaussians_none_is_missed_and_yet_not_all_go(renderer: Renderer) -> None:
    """Ten of each, which together are as opaque: each alone may go, all together may not."""
    scene = fitted(**{"first_frame.prune_error": 0}).map(torch.from_numpy)
    left = (1 - scene.opacities.double().sigmoid().clamp(max=0.99)) ** 0.1
    thin = replace(scene, opacities=((1 - left) / left).log().float())
    many = thin.rows(torch.arange(len(scene)).repeat_interleave(10))
    truth = torch.from_numpy(np.stack(list(frames()[0].images)))

    def error(rows: torch.Tensor) -> float:
        return float((images(renderer, many.rows(rows)) - truth).square().mean())

    def drawn() -> torch.Generator:
        return Rng(0).stream("a", 0)

    whole = error(torch.arange(len(many)))
    errors, _ = removal_errors(TrainingViews(renderer, frames()[0], None, BLACK), many, drawn(), probes=4)
    least = float(errors.max()) / whole / 2
    assert error(retained_rows(errors, least * whole)) > 1.5 * whole, "otherwise this says nothing"
    kept = prune_by_error(TrainingViews(renderer, frames()[0], None, BLACK), many, drawn(), least)
    assert error(kept) <= 1.25 * whole * (1 + 1e-4)
    assert torch.equal(kept, kept.sort().values)


@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 7.0, 1e30]), max_size=40), st.floats(0.01, 1))
def test_those_chosen_are_missed_most(errors: list[float], share: float) -> None:
    chosen = largest_error_mask(torch.tensor(errors, dtype=torch.float64), share)
    values = np.array(errors)
    assert chosen.sum() == min(len(errors), max(1, round(share * len(errors))))
    if chosen.any() and not chosen.all():
        assert values[chosen].min() >= values[~chosen].max()
        # Of equal ones those that stand first.
        border = values == values[chosen].min()
        assert np.all(np.diff(chosen[border].astype(int)) <= 0)


def packets(count: int, **settings: Any) -> list[EncodedPacket]:
    with open_recording(WORLD) as source:
        encoder = encoder_for("s2gs-edge", source, {**TINY, **settings})
    return [encoder.encode(frame).packet for frame in frames()[:count]]


def test_frame_0_has_layers_and_shows_what_it_would_without() -> None:
    (layered,) = packets(1, **{"codec.first_layer": 0.4})
    (plain,) = packets(1, **{"codec.first_layer": 1.0})
    ours, theirs = (decode_packet(None, packet.data) for packet in (layered, plain))
    for (name, mine), (_, other) in zip(ours.gaussians.items(), theirs.gaussians.items(), strict=True):
        assert mine.tobytes() == other.tobytes(), name
    found = first_layer(layered.data)
    assert found is not None
    assert len(found.gaussians) == round(0.4 * len(ours.gaussians))
    assert first_layer(plain.data) is None
    # A packet without layers is what it always was.
    state = KeyState(theirs.gaussians, theirs.layout, theirs.meta)
    assert encode_key(state).data == plain.data


def test_the_first_layer_is_opaque_rather_than_faint() -> None:
    """By another reckoning than the images: what nobody sees is not what comes first."""
    (packet,) = packets(1, **{"codec.first_layer": 0.3, "first_frame.shell": False})
    found = first_layer(packet.data)
    assert found is not None
    whole = decode_packet(None, packet.data).gaussians
    assert np.median(found.gaussians.opacities) > np.median(whole.opacities)
    covered = [
        np.exp(np.sort(g.scales, 1)[:, 1:].sum(1)) / (1 + np.exp(-g.opacities)) for g in (found.gaussians, whole)
    ]
    assert np.median(covered[0]) > 1.2 * np.median(covered[1]), "opacity times the area of the two largest sides"


def test_a_refined_key_packet_has_layers_and_a_periodic_one_has_none() -> None:
    refined = packets(5, **{**REFINING, "codec.first_layer": 0.5})
    keys = [packet for packet in refined if packet.kind == PacketKind.KEY]
    assert len(keys) == 2
    assert all(first_layer(packet.data) is not None for packet in keys)
    first, *_, last = packets(3, **{"codec.key_interval": 2, "codec.first_layer": 0.5})
    assert (first.kind, last.kind) == (PacketKind.KEY, PacketKind.KEY)
    assert "rest" in parse_packet(first.data)[1]
    assert "rest" not in parse_packet(last.data)[1]


@pytest.mark.parametrize("share", [0.0, 1.1, -0.5])
def test_shares_that_cannot_be_are_refused(share: float) -> None:
    with pytest.raises(Exception, match="first_layer"):
        packets(1, **{"codec.first_layer": share})
