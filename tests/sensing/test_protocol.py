"""Laws of every detection model, and of looks, hits and misses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evermap.geometry import se2
from evermap.sensing import learned
from evermap.sensing.kernels import OUT_OF_FIELD
from evermap.sensing.profile import Assumed
from evermap.sensing.sightlines import SightLines
from evermap.sensing.visibility import USUAL, DetectionModel, NominalField
from evermap.tracking.views import View
from evermap.types import FloatArray, IntArray, Sensor
from evermap_studies.worlds.sensors import CAMERA, LIDAR, Fading, InField, SpatialModel, ViewingAngle

AHEAD = Sensor(range_min_m=0.5, range_max_m=8.0, bearing_min_rad=-1.0, bearing_max_rad=1.2, p_detect=0.8)
ROUND = Sensor(range_max_m=6.0, p_detect=0.9, mount_robot_sensor=(0.2, 0.1, 0.3))
SOLID = SpatialModel((InField(LIDAR), Fading(10.0), ViewingAngle(1.2)), p_0=0.95)


class Case(NamedTuple):
    """A model of landmarks (L, 2) or (L, 3), however many; `farthest_m` is beyond its reach."""

    dimensions: int
    model: Callable[[FloatArray, IntArray], DetectionModel]
    farthest_m: float


class FromView:
    """The tracker's view, which is of one instant, asked from several poses."""

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        views = [View.of(SOLID, one, LIDAR.range_max_m) for one in pose]
        return np.array([view.probability(position_m) for view in views]).reshape(len(pose), len(position_m))


def learned_field(sensor: Sensor) -> Callable[[FloatArray, IntArray], DetectionModel]:
    """What three hundred looks taught, of landmarks by their names."""

    def make(position_m: FloatArray, name: IntArray) -> DetectionModel:
        rng = np.random.default_rng(1)
        lines = SightLines.empty()
        order = np.argsort(name)
        places = np.zeros(len(name), dtype=np.int64), name[order]
        eye = rng.uniform(-6.0, 6.0, (300, 2))
        row = rng.integers(0, len(name), 300) if len(name) else np.zeros(0, dtype=np.int64)
        eye, at = eye[: len(row)], position_m[order][row]
        hit = (eye[:, 0] * at[:, 0] > 0.0) & (rng.random(len(row)) < 0.8)  # there is a wall along the y axis
        lines = lines.learned(places, row, lines.cells(eye, at), hit, np.ones(len(row)))
        return InOrder(Learned(NominalField(sensor), lines, places), order)

    return make


class Learned:
    """The nominal field of view with what was learned of lines of sight to places, sorted by site and landmark."""

    def __init__(self, nominal: NominalField, lines: SightLines, places: tuple[IntArray, IntArray]) -> None:
        self.nominal, self.lines, self.places = nominal, lines, places

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        nominal = self.nominal.p_detect(pose, position_m)
        eye = se2.compose(pose, np.asarray(self.nominal.sensor.mount_robot_sensor))
        frame, place = np.nonzero(nominal >= OUT_OF_FIELD)
        cell = self.lines.cells(eye[:, :2], position_m, (frame, place))
        along = nominal[frame, place]
        lines, p_clear, _ = self.lines.lines(self.places, place, cell, along)
        p = np.zeros(nominal.shape)
        p[frame, place] = p_clear * lines.p_detect + (1.0 - p_clear) * np.minimum(
            self.lines.rules.p_blocked_detect, along
        )
        return p


class InOrder:
    """A model that knows landmarks in another order than they are asked for."""

    def __init__(self, model: DetectionModel, order: IntArray) -> None:
        self.model, self.order = model, order

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        out = np.empty((len(pose), len(position_m)))
        out[:, self.order] = self.model.p_detect(pose, position_m[self.order])
        return out


def watched(field_of: str) -> Callable[[FloatArray, IntArray], DetectionModel]:
    """A learned model of cliques of one, after twenty frames in which every other landmark was seen."""

    def make(position_m: FloatArray, name: IntArray) -> DetectionModel:
        assumed = Assumed(field={"lidar": LIDAR, "camera": CAMERA}[field_of])
        model = learned.init(position_m, np.arange(len(name)), assumed)
        for k in range(20):
            detected = (name % 2 == 0) & (np.linalg.norm(position_m, axis=1) < 9.0)
            model, seen = learned.look(model, float(k), np.zeros(3), np.eye(3), detected)
            model = learned.confirm(model, seen, np.where(name % 2 == 0, 0.999, 0.5))
        return model

    return make


CASES = {
    "nominal, ahead": Case(2, lambda *_: NominalField(AHEAD), 8.0 + 2.0),
    "nominal, all around": Case(2, lambda *_: NominalField(ROUND), 6.0 + 2.0),
    "lines of sight, ahead": Case(2, learned_field(AHEAD), 8.0 + 2.0),
    "lines of sight, all around": Case(2, learned_field(ROUND), 6.0 + 2.0),
    "in space": Case(3, lambda *_: SOLID, LIDAR.range_max_m + 1.0),
    "camera in space": Case(3, lambda *_: SpatialModel((InField(CAMERA),)), CAMERA.range_max_m + 1.0),
    "learned, lidar": Case(3, watched("lidar"), LIDAR.range_max_m + 1.0),
    "learned, camera": Case(3, watched("camera"), CAMERA.range_max_m + 1.0),
    "the tracker's view": Case(3, lambda *_: FromView(), LIDAR.range_max_m + 1.0),
}
every_model = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


def scene(case: Case, seed: int, count: int = 30) -> tuple[FloatArray, FloatArray, IntArray]:
    """Poses, landmarks and their names, which are in no order."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-9.0, 9.0, (count, case.dimensions))
    name = 3 + rng.permutation(count)
    if case.dimensions == 2:
        pose = np.column_stack([rng.uniform(-4.0, 4.0, (7, 2)), rng.uniform(-9.0, 9.0, 7)])
        return pose, position, name
    pose = np.tile(np.eye(4), (7, 1, 1))
    pose[:, :3, :3] = Rotation.from_euler("ZYX", rng.normal(0.0, [2.0, 0.1, 0.1], (7, 3))).as_matrix()
    pose[:, :3, 3] = rng.uniform(-4.0, 4.0, (7, 3))
    return pose, position * [1.0, 1.0, 0.2], name


@every_model
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_it_is_a_probability_for_every_pair(case: Case, seed: int) -> None:
    pose, position, name = scene(case, seed)
    p = case.model(position, name).p_detect(pose, position)
    assert p.shape == (len(pose), len(position))
    assert ((p >= 0.0) & (p <= 1.0)).all()


@every_model
def test_something_is_seen_and_something_is_not(case: Case) -> None:
    pose, position, name = scene(case, 1)
    p = case.model(position, name).p_detect(pose, position)
    assert p.max() > 0.3
    assert p.min() < 0.1


@every_model
@pytest.mark.parametrize("seed", [0, 1])
def test_order_of_landmarks_and_poses_does_not_matter(case: Case, seed: int) -> None:
    pose, position, name = scene(case, seed)
    rng = np.random.default_rng(seed)
    model = case.model(position, name)
    p = model.p_detect(pose, position)
    poses = rng.permutation(len(pose))
    np.testing.assert_allclose(model.p_detect(pose[poses], position), p[poses], rtol=1e-12)
    rows = rng.permutation(len(position))
    again = case.model(position[rows], name[rows])
    np.testing.assert_allclose(again.p_detect(pose, position[rows]), p[:, rows], rtol=1e-6)  # float32 in `learned`


@every_model
def test_each_pose_is_answered_by_itself(case: Case) -> None:
    pose, position, name = scene(case, 4)
    model = case.model(position, name)
    one_by_one = np.concatenate([model.p_detect(pose[[k]], position) for k in range(len(pose))])
    if "lines" not in next(key for key, value in CASES.items() if value is case):  # the rate is of the best of a call
        np.testing.assert_allclose(model.p_detect(pose, position), one_by_one, rtol=1e-12)
    assert model.p_detect(pose[:0], position).shape == (0, len(position))


@every_model
def test_out_of_range_nothing_is_detected(case: Case) -> None:
    pose, position, name = scene(case, 2)
    away = np.random.default_rng(3).normal(size=position.shape)
    away *= 1.0001 * (case.farthest_m + 8.0) / np.linalg.norm(away, axis=1, keepdims=True)  # poses are within 8 m
    p = case.model(position, name).p_detect(pose, away)
    assert p.max() < 1e-12


@pytest.mark.parametrize("name", ["nominal, ahead", "lines of sight, ahead", "camera in space", "learned, camera"])
def test_behind_the_sensor_nothing_is_detected(name: str) -> None:
    case = CASES[name]
    _, position, names = scene(case, 5)
    pose = np.zeros((1, 3)) if case.dimensions == 2 else np.eye(4)[None]
    behind = position * 0.3
    behind[:, 0] = -1.5 - np.abs(behind[:, 0])
    assert case.model(position, names).p_detect(pose, behind).max() < 1e-9


@every_model
def test_all_of_the_scene_may_be_turned_and_moved(case: Case) -> None:
    """Only what lies between sensor and landmark matters; models of single landmarks know them by place."""
    pose, position, name = scene(case, 6)
    model = case.model(position, name)
    if isinstance(model, InOrder | learned.LearnedDetection):
        return
    if case.dimensions == 2:
        turn, shift = 0.7, np.array([30.0, -4.0])
        rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        moved = np.column_stack([pose[:, :2] @ rotation.T + shift, pose[:, 2] + turn])
        there = position @ rotation.T + shift
    else:
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec([0.1, 0.2, 0.9]).as_matrix(), [3.0, -40.0, 2.0]
        moved, there = motion @ pose, position @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(model.p_detect(moved, there), model.p_detect(pose, position), rtol=1e-6, atol=1e-12)


def test_learned_rates_are_those_that_its_own_looks_are_judged_by() -> None:
    """`1 - P` of the compiled kernel: a miss of a clique of one, where nobody is ever in the way."""
    rng = np.random.default_rng(7)
    position = rng.uniform(-9.0, 9.0, (40, 3)) * [1.0, 1.0, 0.2]
    assumed = Assumed(field=LIDAR, p_never_occluded=1.0 - 1e-12, p_false=1e-9)
    model = learned.init(position, np.repeat(np.arange(20), 2), assumed)
    for k in range(30):
        turn = Rotation.from_euler("z", rng.uniform(-3.0, 3.0)).as_matrix()
        eye, pose = rng.uniform(-2.0, 2.0, 3), np.eye(4)[None]
        pose[0, :3, :3], pose[0, :3, 3] = turn, eye
        p = model.p_detect(pose, position)[0].reshape(20, 2)
        _, missed = learned.look(model, float(k), eye, turn, np.zeros(40, dtype=np.bool_))
        in_view = missed.expected > 0
        expected = np.prod(1.0 - p, axis=1)[in_view]
        np.testing.assert_allclose(np.exp(missed.log_there[in_view]), expected, rtol=1e-5)
        model, seen = learned.look(model, float(k), eye, turn, rng.random(40) < 0.5)
        model = learned.confirm(model, seen, np.full(20, 0.999))


@given(seed=st.integers(0, 2**32 - 1), sensor=st.sampled_from([AHEAD, ROUND]), share=st.floats(0.0, 1.0))
def test_looks_are_what_is_in_view_and_what_is_detected(seed: int, sensor: Sensor, share: float) -> None:
    rng = np.random.default_rng(seed)
    pose = np.column_stack([rng.uniform(-4.0, 4.0, (11, 2)), rng.uniform(-9.0, 9.0, 11)])
    position = rng.uniform(-9.0, 9.0, (13, 2))
    pairs = np.argwhere(rng.random((11, 13)) < 0.3 * share)
    looks = NominalField(sensor).looks(pose, position, (pairs[:, 0], pairs[:, 1]))
    p = NominalField(sensor).p_detect(pose, position)
    hits = set(map(tuple, pairs.tolist()))
    told = list(zip(looks.pose.tolist(), looks.landmark.tolist(), strict=True))
    assert told == sorted(set(told))
    assert {pair for pair, hit in zip(told, looks.hit, strict=True) if hit} == hits  # also out of view
    missed = {pair for pair, hit in zip(told, looks.hit, strict=True) if not hit}
    assert missed == set(map(tuple, np.argwhere(p >= USUAL.worth_a_look * sensor.p_detect).tolist())) - hits
    np.testing.assert_array_equal(looks.p_detect, p[looks.pose, looks.landmark])
