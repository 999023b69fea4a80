"""Scores of a hand-made map in a hand-made world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.types import Landmarks, Trajectory
from evermap_studies.demo.numbers import ratios
from evermap_studies.demo.scores import Counts, Snapshot, alignment_of, map_counts, pose_counts, pose_errors
from evermap_studies.demo.truth import Truth

NAN = [np.nan, np.nan]
TURN = np.array([3.0, -2.0, 0.6])
"""Pose of the map in the frame of the truth."""


def in_map(points: object) -> np.ndarray:
    """Points of the truth as the map has them."""
    c, s = np.cos(TURN[2]), np.sin(TURN[2])
    return (np.asarray(points, dtype=float).reshape(-1, 2) - TURN[:2]) @ np.array([[c, -s], [s, c]])


@pytest.fixture
def truth() -> Truth:
    """Two sessions: 0 stays, 1 is moved, 2 has gone before the first and comes back, 3 was never seen, 4 leaves.

    All but 0 were looked at.
    """
    position = np.array(
        [[[0, 0], [1, 0], NAN, [9, 9], [5, 5]], [[0, 0], [1, 2], [2, 0], [9, 9], NAN]], dtype=np.float64
    )
    seen = np.array([[[0, 0], [1, 0], [2, 0], NAN, [5, 5]], [[0, 0], [1, 2], [2, 0], NAN, [5, 5]]], np.float64)
    known = np.isfinite(position[:, :, 0]) & (np.arange(5) > 0)
    nothing = np.zeros((2, 5), np.bool_)
    return Truth(position, seen, detected=nothing, changed=nothing, known=known, knowable=np.zeros((0, 4), np.int64))


def snapshot(places: list[tuple[int, object, float, float]]) -> Snapshot:
    """A map of places; each landmark is claimed at its most probable one."""
    best: dict[int, tuple[object, float]] = {}
    for name, at, p_now, _ in places:
        if name not in best or best[name][1] < p_now:
            best[name] = at, p_now
    claimed = Landmarks.at(list(best), in_map([at for at, _ in best.values()]))
    return Snapshot(
        landmarks=replace(claimed, p_exists=np.array([best[name][1] for name in claimed.landmark_id.tolist()])),
        place_id=np.array([row[0] for row in places], dtype=np.int64),
        place_m=in_map([row[1] for row in places]),
        p_now=np.array([row[2] for row in places]),
        p_next=np.array([row[3] for row in places]),
        n_sites=len(places),
    )


def test_claims_are_right_where_the_landmark_stands(truth: Truth) -> None:
    """0 is right, 1 is 30 cm off, 2 is away, 77 is nobody; 3 is not claimed, 4 is not known."""
    places = [(0, [0, 0.2], 0.9, 0.9), (1, [1, 0.3], 0.9, 0.9), (2, [2, 0], 0.6, 0.6), (77, [0, 0], 1.0, 1.0),
              (3, [9, 9], 0.4, 0.4)]  # fmt: skip
    scores = ratios(map_counts(snapshot(places), truth, 0, TURN))
    assert scores["precision"] == 0.25
    assert scores["precision_sure"] == pytest.approx(1 / 3)
    assert scores["recall"] == 0.0  # 0, the only right one, was not looked at
    scores = ratios(map_counts(snapshot([*places, (4, [5, 5], 0.9, 0.9)]), truth, 0, TURN))
    assert scores["recall"] == pytest.approx(1 / 3)  # of 1, 3 and 4


def test_existence_is_asked_of_all_that_were_seen_at_their_last_place(truth: Truth) -> None:
    """Two places near the last one add up; one elsewhere says nothing of it; who is not in the map has zero."""
    places = [(0, [0, 0], 0.5, 0.5), (0, [0.1, 0], 0.3, 0.3), (0, [4, 4], 0.2, 0.2), (1, [3, 3], 0.9, 0.9),
              (2, [2, 0.1], 0.25, 0.5), (3, [9, 9], 0.0, 0.0)]  # fmt: skip
    scores = ratios(map_counts(snapshot(places), truth, 0, TURN))
    # 0 is there: 0.8; 1 is there, the map has it elsewhere: 0; 2 is away: 0.25; 4 is there, not in the map: 0
    assert scores["existence_brier"] == pytest.approx((0.2**2 + 1.0 + 0.25**2 + 1.0) / 4)
    # next time 0 stays, 1 has moved away from there, 2 is back, 4 has left: that all stays is wrong of three
    brier = (0.2**2 + 0.0 + 0.5**2 + 0.0) / 4
    assert scores["forecast_brier"] == pytest.approx(brier)
    assert scores["forecast_skill_over_as_is"] == pytest.approx(1.0 - brier / 0.75)
    assert scores["forecast_skill_over_base_rate"] == pytest.approx(1.0 - brier / 0.25)  # half of them are so


def test_the_last_session_has_no_forecast(truth: Truth) -> None:
    scores = ratios(map_counts(snapshot([]), truth, 1, TURN))
    assert scores["forecast_brier"] is None
    assert scores["forecast_skill_over_as_is"] is None
    assert scores["existence_brier"] == pytest.approx(0.75)  # 0, 1 and 2 stand there, 4 does not


def test_the_truth_itself_is_perfect(truth: Truth) -> None:
    for k in range(2):
        places = [(int(n), truth.position_m[k, n], 1.0, 1.0) for n in np.flatnonzero(truth.there[k])]
        scores = ratios(map_counts(snapshot(places), truth, k, TURN))
        assert (scores["precision"], scores["recall"], scores["existence_brier"]) == (1.0, 1.0, 0.0)
        assert scores["precision_sure"] == 1.0


def path(poses: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(poses)) * 0.5, poses, np.zeros((len(poses), 3, 3)))


def test_poses_are_compared_in_the_frame_of_the_first_session() -> None:
    t = np.linspace(0.0, 6.0, 40)
    real = np.column_stack([3.0 * np.cos(t), 2.0 * np.sin(t), t])
    mapped = np.column_stack([in_map(real[:, :2]), real[:, 2] - TURN[2]])
    pose = alignment_of(path(mapped), path(real))
    np.testing.assert_allclose(pose, TURN, atol=1e-9)
    # a later session whose map has crept by 10 cm: wrong in the map's frame, perfect after an alignment of its own
    fixed, own = pose_errors(path(mapped + [0.06, 0.08, 0.0]), path(real), pose)
    np.testing.assert_allclose(fixed, 0.1, atol=1e-9)
    np.testing.assert_allclose(own, 0.0, atol=1e-9)


def test_counts_add_up(truth: Truth) -> None:
    places = [(0, [0, 0.2], 0.9, 0.9), (1, [1, 0.3], 0.9, 0.9)]
    one, two = (map_counts(snapshot(places), truth, k, TURN) for k in range(2))
    both = ratios(Counts(1, 4.0, 0.0) + one + two + Counts(3, 0.0, 0.0))
    assert both["pose_rmse_m"] == pytest.approx(1.0)
    assert both["precision"] == 0.5
    assert both["recall"] == 0.0
    lost = pose_counts(path(np.zeros((3, 3))), path(np.zeros((3, 3))), TURN, found=False)
    assert ratios(Counts(1, 4.0, 0.0) + lost)["pose_rmse_m"] == pytest.approx(2.0)
    assert ratios(lost)["lost"] == 1
    assert set(ratios(Counts()).values()) == {None, 0}
