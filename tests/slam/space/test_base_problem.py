"""What problems in the plane and in space share: selections of detections, stretches, variances by clusters."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from problems import make_world

from evermap.config import SpaceConfig
from evermap.slam.base_problem import BaseProblem
from evermap.slam.correlation import Lasting, Pull, variance_of_clusters
from evermap.slam.space.intake import prepare_space

from .corridors import tagged_corridor


def make_problem(kind: str) -> BaseProblem:
    if kind == "space":
        return prepare_space(tagged_corridor(0).recording, SpaceConfig()).problem
    problem = make_world(0).problem
    count = len(problem.pose_row)
    return replace(
        problem, share=np.linspace(0.1, 1.0, count), noise_shape=np.linspace(1.0, 3.0, 2 * count).reshape(count, 2)
    )


@pytest.fixture(params=["plane", "space"])
def problem(request) -> BaseProblem:
    return make_problem(request.param)


def test_all_that_has_a_row_for_each_detection_is_selected_together(problem):
    count = len(problem.pose_row)
    shared = {one.name: getattr(problem, one.name) for one in fields(problem)}
    rows = {name for name, value in shared.items() if isinstance(value, np.ndarray) and len(value) == count}
    assert rows == set(problem.COLUMNS)
    some = np.arange(count) % 3 == 1
    found = problem.seeing(some)
    for name, value in shared.items():
        if name in rows:
            assert np.array_equal(getattr(found, name), value[some], equal_nan=True), name
        elif isinstance(value, np.ndarray):
            assert getattr(found, name) is value, name
    assert np.array_equal(found.seen_place, problem.seen_place[some])
    assert np.array_equal(found.seen_s, problem.stamp_s[problem.pose_row[some]])


def test_detections_of_a_pose_are_those_with_its_row(problem):
    for pose in (0, 3, len(problem.stamp_s) - 1):
        assert np.array_equal(problem.detections_of(pose), np.flatnonzero(problem.pose_row == pose))


def test_stretches_are_equally_long(problem):
    found = problem.stretches(5)
    length = np.ptp(problem.stamp_s) / 5
    assert set(found.tolist()) == set(range(5))
    for k in range(5):
        assert np.ptp(problem.stamp_s[found == k]) <= length + 1e-9
    assert np.all(np.diff(found) >= 0)


def test_information_of_errors_that_last_is_that_of_each_place_alone(problem):
    lasting = Lasting(np.array([2.0]), np.array([0.7]))
    found = problem.new_information(lasting)
    for place in np.unique(problem.seen_place)[:4]:
        mine = problem.seen_place == place
        expected = 1.0 / lasting.correlation(problem.seen_s[mine]).sum(axis=1)
        assert found[mine] == pytest.approx(expected, rel=1e-9)


def test_the_larger_variance_counts():
    """Of influences on two numbers: one that stretches move alike, and one of errors that last."""
    problem = make_problem("plane")
    random, n, count = np.random.default_rng(1), len(problem.stamp_s), len(problem.pose_row)
    steps, seen = random.normal(size=(n - 1, 3, 2)), random.normal(size=(count, 2, 2))
    residual = random.normal(size=(n - 1, 3)), random.normal(size=(count, 2))
    pulls = [
        Pull(pose, influence, np.einsum("krs,kr->ks", influence, of))
        for pose, influence, of in zip((np.arange(n - 1), problem.pose_row), (steps, seen), residual, strict=True)
    ]
    lasting = Lasting(np.array([5.0]), np.array([0.9]))
    found = problem.correlated_variance(*pulls, lasting, 4)
    stretch, moved = problem.stretches(4), np.zeros((4, 2))
    for pull in pulls:
        for row, pose in enumerate(pull.pose):
            moved[stretch[pose]] += pull.by[row]
    same = problem.seen_place[:, None] == problem.seen_place
    alike = np.where(same, lasting.correlation(problem.seen_s), 0.0)
    lasts = (steps**2).sum(axis=(0, 1)) + np.einsum("mds,mn,nds->s", seen, alike, seen)
    assert found == pytest.approx(np.maximum(4 / 3 * (moved**2).sum(axis=0), lasts), rel=1e-9)


def test_clusters_that_pull_at_nothing_count_if_they_are_counted():
    pull = np.array([[1.0], [2.0], [0.0], [0.0]])
    assert variance_of_clusters(pull) == pytest.approx(5.0 * 2 / 1)
    assert variance_of_clusters(pull, 4) == pytest.approx(5.0 * 4 / 3)
