"""The nouns: what they refuse, in which words, and how row edits, hierarchies and random streams behave."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta, Layout, Light, Motion, Residual, RowEdit, Scene, apply_delta, sent_rows
from gsstream.core.errors import (
    ComponentError,
    GsstreamError,
    InputError,
    PacketError,
    ShapeError,
    UnknownName,
)
from gsstream.core.frame import Frame
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.hierarchy import Hierarchy, tree_max, tree_roots
from gsstream.core.rng import Rng
from gsstream.core.shapes import check_finite, check_shape
from tests.scenes import make_scene


def rig(count: int = 2) -> Cameras:
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, 0, 3] = np.arange(count)
    ks = np.tile(np.array([[100.0, 0, 32], [0, 90, 24], [0, 0, 1]]), (count, 1, 1))
    return Cameras(tuple(f"cam{i}" for i in range(count)), viewmats, ks, 64, 48)


class TestGaussians:
    @pytest.mark.parametrize(("bases", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3)])
    def test_degree(self, bases: int, degree: int) -> None:
        scene = make_scene(5, bases)
        scene.validate()
        assert scene.sh_degree == degree

    @pytest.mark.parametrize("bases", [2, 3, 5, 8, 17, 25])
    def test_number_of_coefficients_is_refused(self, bases: int) -> None:
        with pytest.raises(ShapeError, match=rf"shN: expected 0, 3, 8 or 15 .* got {bases - 1}"):
            make_scene(3, bases).validate()

    @pytest.mark.parametrize("name", ATTRIBUTES)
    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_not_finite_is_named(self, name: str, bad: float) -> None:
        scene = make_scene(4)
        getattr(scene, name).reshape(4, -1)[2, 0] = bad
        with pytest.raises(ShapeError, match=rf"{name}: expected finite values, got .* at index \[2"):
            scene.validate()

    @pytest.mark.parametrize("name", ATTRIBUTES[1:])
    def test_row_count_must_agree(self, name: str) -> None:
        scene = make_scene(4)
        with pytest.raises(ShapeError, match=f"{name}: expected shape"):
            dataclasses.replace(scene, **{name: getattr(scene, name)[:3]}).validate()

    def test_empty_scene_is_valid(self) -> None:
        make_scene(0).validate()
        assert make_scene(0).sh_degree == 1

    def test_rows_select_every_attribute(self) -> None:
        scene, index = make_scene(6), np.array([4, 0])
        for name, value in scene.rows(index).items():
            assert np.array_equal(value, getattr(scene, name)[index])


class TestCameras:
    def test_centers_invert_the_pose(self) -> None:
        q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
        q *= np.linalg.det(q)
        center = np.array([1.0, -2.0, 3.0])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = q, -q @ center
        cameras = Cameras(("a",), viewmat[None], rig(1).Ks, 64, 48)
        cameras.validate()
        np.testing.assert_allclose(cameras.centers[0], center, atol=1e-12)

    def test_extent_is_positive_for_any_rig(self) -> None:
        assert rig(0).extent == 1.0
        assert rig(1).extent == 1.0
        assert rig(3).extent == pytest.approx(1.1)

    def test_scaled_projects_to_scaled_pixels(self) -> None:
        cameras, point = rig(1), np.array([0.3, -0.2, 2.0])
        pixel = cameras.Ks[0] @ point / point[2]
        half = cameras.scaled(32, 12)
        np.testing.assert_allclose((half.Ks[0] @ point / point[2])[:2], pixel[:2] * [0.5, 0.25])

    @pytest.mark.parametrize(
        ("field", "index", "value", "message"),
        [
            ("viewmats", (1, 0, 3), np.nan, r"pose \(w2c\) of camera 'cam1': expected finite"),
            ("viewmats", (1, 0, 0), -1.0, r"camera 'cam1': the 3x3 part is not a rotation .*determinant -1"),
            ("viewmats", (0, 0, 0), 2.0, r"camera 'cam0': .*orthogonality error 3"),
            ("Ks", (1, 0, 0), 0.0, r"intrinsics \(K\) of camera 'cam1' are not invertible.*fx = 0"),
            ("Ks", (0, 1, 1), -5.0, r"intrinsics \(K\) of camera 'cam0' .*fy = -5.*check the calibration"),
            ("Ks", (0, 2, 2), np.inf, r"intrinsics \(K\) of camera 'cam0': expected finite"),
        ],
    )
    def test_refusals_name_the_camera(self, field: str, index: tuple[int, ...], value: float, message: str) -> None:
        cameras = copy.deepcopy(rig())
        getattr(cameras, field)[index] = value
        with pytest.raises(ShapeError, match=message):
            cameras.validate()

    def test_near_plane_survives_select_and_scaled(self) -> None:
        cameras = dataclasses.replace(rig(3), near_plane=0.7)
        assert cameras.select([1]).near_plane == cameras.scaled(8, 8).near_plane == 0.7

    def test_repeated_names_and_shapes(self) -> None:
        with pytest.raises(ShapeError, match=r"unique, got \['a', 'a'\]"):
            dataclasses.replace(rig(), ids=("a", "a")).validate()
        with pytest.raises(ShapeError, match=r"viewmats: expected shape \[3, 4, 4\], got \[2, 4, 4\]"):
            dataclasses.replace(rig(), ids=("a", "b", "c")).validate()

    def test_select_keeps_rows_together(self) -> None:
        chosen = rig(3).select([2, 0])
        assert chosen.ids == ("cam2", "cam0")
        assert chosen.viewmats[:, 0, 3].tolist() == [2.0, 0.0]

    def test_frame_must_match_its_cameras(self) -> None:
        images = np.zeros((2, 48, 64, 3), np.float32)
        Frame(3, 0.1, images, rig()).validate()
        with pytest.raises(ShapeError, match=r"images: expected shape \[2, 48, 64, 3\]"):
            Frame(3, 0.1, images[:, :47], rig()).validate()
        images[1, 5, 6, 0] = np.nan
        with pytest.raises(ShapeError, match=r"images of frame 3, camera 'cam1': .* nan at row 5, column 6, channel 0"):
            Frame(3, 0.1, images, rig()).validate()


class TestShapes:
    def test_letters_bind(self) -> None:
        assert check_shape("x", np.zeros((4, 3)), ("N", 3)) == {"N": 4}
        with pytest.raises(ShapeError, match=r"x: expected shape \[N, N\], got \[4, 3\]"):
            check_shape("x", np.zeros((4, 3)), ("N", "N"))
        with pytest.raises(ShapeError):
            check_shape("x", np.zeros(4), ("N", 3))

    @pytest.mark.parametrize("make_array", [np.asarray, torch.as_tensor])
    def test_large_values_are_finite(self, make_array) -> None:
        check_finite("x", make_array(np.full(8, 3e38, np.float32)))
        check_finite("x", make_array(np.full(8, 1e308)))
        check_finite("x", make_array(np.zeros(0, np.float32)))
        with pytest.raises(ShapeError, match="2 of 3 values"):
            check_finite("x", make_array(np.array([np.inf, 0, -np.inf])))


class TestHierarchy:
    def forest(self, **changes: list[int]) -> Hierarchy:
        fields = {"node_of": [2, 3, 1, 2], "parent": [0, 1, 0, 2], "level": [0, 0, 1, 2]} | changes
        return Hierarchy(**{k: torch.tensor(v) for k, v in fields.items()})

    def test_valid(self) -> None:
        self.forest().validate()
        Hierarchy(*(torch.zeros(0, dtype=torch.int64) for _ in range(3))).validate()

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"node_of": [0, 4]}, r"node_of: expected values in \[0, 4\), got 0 to 4"),
            ({"node_of": [-1, 0]}, r"node_of: .*got -1 to 0"),
            ({"parent": [0, 1, 0, 4]}, r"parent: expected values in \[0, 4\)"),
            ({"level": [0, 1, 1, 2]}, "expected 0 at every root"),
            ({"level": [0, 0, 1, 1]}, "one more than the parent's"),
            ({"parent": [0, 1, 3, 2]}, "one more than the parent's"),
            ({"level": [0, 0, 1]}, r"level: expected shape \[4\]"),
        ],
    )
    def test_refusals(self, changes: dict[str, list[int]], message: str) -> None:
        with pytest.raises(ShapeError, match=message):
            self.forest(**changes).validate()

    def test_members_without_nodes(self) -> None:
        empty = torch.zeros(0, dtype=torch.int64)
        with pytest.raises(ShapeError, match="node_of"):
            Hierarchy(torch.tensor([0]), empty, empty).validate()

    def test_rows_keep_the_forest(self) -> None:
        part = self.forest().rows(torch.tensor([3, 0]))
        assert part.node_of.tolist() == [2, 2]
        assert part.num_nodes == 4

    @given(st.lists(st.integers(0, 30), min_size=1, max_size=40), st.integers(0, 2**31))
    @settings(max_examples=60, deadline=None)
    def test_tree_roots_and_tree_max_agree_with_walking_up(self, choices: list[int], seed: int) -> None:
        g = torch.Generator().manual_seed(seed)
        # Every node hangs on an earlier one or on itself; then the nodes are renamed.
        rename = torch.randperm(len(choices), generator=g)
        parent = torch.empty(len(choices), dtype=torch.int64)
        for node, choice in enumerate(choices):
            parent[rename[node]] = rename[min(choice, node)]
        node_of = torch.randint(0, len(choices), (25,), generator=g)
        values = torch.randn(25, generator=g)

        def walk(node: int) -> int:
            return node if int(parent[node]) == node else walk(int(parent[node]))

        roots = [walk(node) for node in range(len(choices))]
        assert tree_roots(parent).tolist() == roots
        best = dict.fromkeys(roots, -9.0)
        for value, node in zip(values.tolist(), node_of.tolist(), strict=True):
            best[roots[node]] = max(value, best[roots[node]])
        found = tree_max(values, Hierarchy(node_of, parent, torch.zeros_like(parent)), -9.0)
        assert found.tolist() == [best[root] for root in roots]

    @pytest.mark.parametrize("length", [2, 3, 4, 8])
    def test_a_circle_of_parents_is_an_error_whatever_its_length(self, length: int) -> None:
        parent = torch.cat([torch.tensor([0]), 1 + (torch.arange(length) + 1) % length])
        with pytest.raises(ShapeError, match=f"a cycle among {length + 1} nodes"):
            tree_roots(parent)


class TestRng:
    def test_streams_repeat_and_differ(self) -> None:
        def draw(seed: int, name: str, frame: int) -> list[float]:
            return torch.rand(4, generator=Rng(seed).stream(name, frame)).tolist()

        assert draw(0, "gate", 3) == draw(0, "gate", 3)
        others = [draw(1, "gate", 3), draw(0, "gates", 3), draw(0, "gate", 4), draw(0, "gate/3", 0)]
        assert all(other != draw(0, "gate", 3) for other in others)
        assert len({tuple(o) for o in others}) == len(others)

    def test_key_is_frozen_across_versions(self) -> None:
        assert Rng(7).key("gate", 12) == 959750397700549290
        assert 0 <= Rng(2**70).key("x", 0) < 2**63

    def test_streams_look_independent(self) -> None:
        a = Rng(0).numpy("a", 0).normal(size=20_000)
        b = Rng(0).numpy("a", 1).normal(size=20_000)
        assert abs(np.corrcoef(a, b)[0, 1]) < 4 / np.sqrt(len(a))


class TestDelta:
    def layout(self) -> Layout:
        return Layout(
            np.array([2, 0, 3], np.int32), np.array([0, 1, 0, 1, 1], np.uint8), np.array([0.5, 0.25], np.float32)
        )

    def delta(self, **changes: object) -> Delta:
        fields: dict = {
            "gates": np.array([0, 7, 5], np.uint8),
            "num_levels": 10,
            "symbols": {"means": np.ones((3, 3), np.int32)},
            "steps": {"means": 0.1},
            "decoders": {},
        }
        return Delta((Residual(**(fields | changes)),))

    def test_by_hand(self) -> None:
        scene = make_scene(5)
        after = apply_delta(Scene(scene, self.layout()), self.delta()).gaussians
        change = np.array([[0.0], [0.0], [0.5], [0.25], [0.25]]) * 0.5 * 0.1
        np.testing.assert_allclose(after.means, scene.means + change, rtol=1e-6)
        assert after.means[:2].tobytes() == scene.means[:2].tobytes()
        assert all(getattr(after, name) is getattr(scene, name) for name in ATTRIBUTES[1:])

    def test_closed_gates_change_nothing(self) -> None:
        scene, none = make_scene(5), {"means": np.ones((0, 3), np.int32)}
        closed = self.delta(gates=np.zeros(3, np.uint8), symbols=none)
        assert closed.is_empty
        assert apply_delta(Scene(scene, self.layout()), closed).gaussians is scene

    def test_input_is_not_written_to(self) -> None:
        scene = make_scene(5)
        before = scene.means.copy()
        apply_delta(Scene(scene, self.layout()), self.delta())
        assert np.array_equal(scene.means, before)

    def test_layout(self) -> None:
        assert self.layout().node_of.tolist() == [0, 0, 2, 2, 2]
        assert self.layout().units_of(np.arange(5)).tolist() == [0.5, 0.25, 0.5, 0.25, 0.25]
        assert sent_rows(self.layout(), np.array([1, 0, 0])).tolist() == [0, 1]

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"gates": np.array([1, 1], np.uint8)}, r"gates: expected one for each of 3 nodes, got shape \[2\]"),
            ({"gates": np.array([0, 0, 11], np.uint8)}, "gates: expected levels 0 to 10, got 11"),
            ({"symbols": {"means": np.ones((2, 3), np.int32)}}, "residual of means: expected 3 rows of 3 values"),
            ({"symbols": {"means": np.ones((3, 4), np.int32)}}, r"got \[3, 4\]; the packet belongs to another scene"),
            ({"symbols": {"colour": np.ones((3, 4), np.int32)}}, "symbols: expected attributes among .* got 'colour'"),
            ({"steps": {}}, "steps: expected one for every coded attribute, got none for 'means'"),
            ({"decoders": {"means": np.ones((2, 3), np.float32)}}, r"decoder of means: expected 3 rows .* got 2"),
            ({"decoders": {"means": np.ones((4, 3), np.float32)}}, r"decoder of means: expected 3 rows .* got 4"),
            ({"decoders": {"means": np.ones((3, 2), np.float32)}}, "residual of means: expected 3 rows of 3 values"),
        ],
    )
    def test_misfits_are_refused(self, changes: dict[str, object], message: str) -> None:
        with pytest.raises(ShapeError, match=message):
            apply_delta(Scene(make_scene(5), self.layout()), self.delta(**changes))

    @pytest.mark.parametrize(
        "kinds",
        [
            (Residual, Motion),
            (RowEdit, Motion),
            (RowEdit, Residual),
            (Residual, Residual),
            (RowEdit, RowEdit),
            (Motion, RowEdit, Motion),
            (Motion, Light),
            (Light, Light),
        ],
    )
    def test_changes_in_another_order_are_refused(self, kinds: tuple[type, ...]) -> None:
        some = {
            Light: Light((2.0, 1.0, 0.5)),
            Motion: Motion(1.0, 1, np.zeros(1, np.uint8), np.zeros((0, 6), np.int32)),
            Residual: self.delta().residual,
            RowEdit: RowEdit(removed=np.array([0])),
        }
        names = ", ".join(kind.__name__ for kind in kinds)
        wanted = f"one light, then motions, then one field, one residual and one change of rows, got {names}"
        with pytest.raises(ShapeError, match=wanted):
            Delta(tuple(some[kind] for kind in kinds))

    def test_a_residual_or_rows_are_exchanged_in_their_place(self) -> None:
        light, motion = Light((2.0, 1.0, 0.5)), Motion(1.0, 1, np.zeros(1, np.uint8), np.zeros((0, 6), np.int32))
        residual, rows = self.delta().residual, RowEdit(removed=np.array([0]))
        whole = Delta((light, motion, motion, residual, rows))
        others = Delta((motion, motion)).with_row_edit(rows)
        assert others.with_residual(residual).with_light(light).changes == whole.changes
        assert others.with_light(light).with_residual(residual).changes == whole.changes
        assert whole.with_residual(None).changes == (light, motion, motion, rows)
        assert whole.with_row_edit(RowEdit()).changes == (light, motion, motion, residual)
        assert whole.with_light(None).changes == whole.with_light(Light((1.0, 1.0, 1.0))).changes == whole.changes[1:]
        assert (whole.light, whole.motions, whole.residual, whole.row_edit) == (light, (motion, motion), residual, rows)
        assert whole.with_residual(None).gates(self.layout()).tolist() == [0, 0, 0]

    def test_rows_do_not_depend_on_their_neighbours(self) -> None:
        """A matrix product may round a row differently when there are more of them; the decoder must not."""
        g = np.random.default_rng(3)
        n = 257
        scene, layout = make_scene(n), Layout(np.ones(n, np.int32), np.zeros(n, np.uint8), np.ones(1, np.float32))
        symbols, decoder = g.integers(-9, 9, (n, 8)).astype(np.int32), g.normal(size=(8, 3)).astype(np.float32)
        before, step = Scene(scene, layout), {"scales": 1.0}
        everything = Residual(np.ones(n, np.uint8), 1, {"scales": symbols}, step, {"scales": decoder})
        whole = apply_delta(before, Delta((everything,))).gaussians
        gates = np.zeros(n, np.uint8)
        gates[100] = 1
        alone = Residual(gates, 1, {"scales": symbols[100:101]}, step, {"scales": decoder})
        one = apply_delta(before, Delta((alone,))).gaussians
        assert one.scales[100].tobytes() == whole.scales[100].tobytes()


class TestErrors:
    def test_family(self) -> None:
        assert issubclass(InputError, ValueError)
        assert issubclass(PacketError, ValueError)
        assert issubclass(ShapeError, GsstreamError)

    def test_messages_help(self) -> None:
        assert "did you mean 's2gs'" in str(UnknownName("method", "s2g", ["s2gs", "dense"]))
        assert "known: dense, s2gs" in str(UnknownName("method", "zzz", ["s2gs", "dense"]))
        assert "none are registered" in str(UnknownName("method", "zzz", []))
        assert str(PacketError("bad", 17)).endswith("(at byte 17)")
        error = ComponentError("boom", slot="gate", part="g", distribution="d 1.0", frame=3, iteration=5)
        assert str(error) == "gate 'g' (from d 1.0) failed at frame 3, iteration 5: boom"

    @pytest.mark.parametrize(
        "error",
        [
            UnknownName("method", "a", ["b"]),
            PacketError("bad", 3),
            ComponentError("boom", slot="gate", part="g", distribution="d", frame=1),
        ],
    )
    def test_errors_cross_processes(self, error: GsstreamError) -> None:
        again = pickle.loads(pickle.dumps(error))
        assert str(again) == str(error)
        assert vars(again) == vars(error)
