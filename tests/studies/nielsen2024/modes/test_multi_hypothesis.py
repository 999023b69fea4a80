"""Moved landmarks in a stream: frame after frame, against the same stream that is told which place is which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving import MovingWorld, make_moving_world, model_of
from problems import default_prior

from evermap.config import SlamConfig
from evermap.slam.batch import Outcome
from evermap.slam.method import Static
from evermap.slam.streaming import StreamingSlam
from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.modes.multi_hypothesis import MultiHypothesis


def stream(moving: MovingWorld, method: object, *, told: bool = False) -> Outcome:
    problem = moving.told if told else moving.problem
    slam = StreamingSlam(
        problem,
        moving.world.noise,
        default_prior(),
        settings=SlamConfig(estimate_noise=False),
        method=method,  # type: ignore[arg-type]
    )
    slam._problem = replace(problem, prior=default_prior())  # the map is given, as after entering one
    slam._filter.problem = slam._problem
    slam._aligned = True
    for _ in range(len(problem.stamp_s)):
        slam.step()
    return slam.finish()


@pytest.mark.parametrize("method", ["em", "viterbi"])
@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (6, 9))])
def test_a_stream_finds_what_moved_as_if_told(method: str, seed: int):
    moving = make_moving_world(seed)
    found = stream(moving, MultiHypothesis(6, model_of(method)))
    told = stream(moving, Static(7), told=True)
    mine = moving.problem.landmark_row == moving.moved
    second = found.revision.current[moving.moved]
    late = moving.problem.pose_row >= moving.since
    np.testing.assert_array_equal(found.problem.landmark_row[mine] == second, late[mine])
    np.testing.assert_allclose(found.estimate.landmark[second], told.estimate.landmark[-1], atol=0.05)
    off, told_off = (
        np.linalg.norm(outcome.estimate.pose[:, :2] - moving.world.truth.pose[:, :2], axis=1)
        for outcome in (found, told)
    )
    assert np.sqrt((off**2).mean()) < 1.1 * np.sqrt((told_off**2).mean())
    (change,) = found.revision.changes
    assert change.landmark_ids == (moving.moved,)
    assert change.stamp_from_s < moving.problem.stamp_s[moving.since] <= change.stamp_to_s


def test_a_detection_goes_to_the_mode_it_gates_with_and_starts_one_where_it_gates_with_none():
    moving = make_moving_world(5)
    method = MultiHypothesis(6, model_of("viterbi", births="gate"))
    detection = np.flatnonzero(moving.problem.landmark_row == 2)[:1]
    far = {2: 100.0, 6: 100.0}

    def compare(of: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        del of
        return np.array([far[int(place)] for place in places]), np.zeros(len(places))

    row = int(moving.problem.pose_row[detection[0]])
    assert method.assign(moving.problem, row, detection, compare).tolist() == [6]
    far.update({2: 1.0, 6: 1.0})
    assert method.assign(moving.problem, row, detection, compare).tolist() == [2]  # the older one, by the chain
    far.update({2: 100.0, 6: 1.0})
    assert method.assign(moving.problem, row, detection, compare).tolist() == [6]
    far.update({6: 100.0, 7: 0.0})
    assert method.assign(moving.problem, row, detection, compare).tolist() == [7]
