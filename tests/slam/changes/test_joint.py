"""The joint search on simulated sessions: what is found, when, and what the estimate is worth then.

Every scene is run with many seeds, and how often it comes out right is asserted as measured, not as hoped for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds import Move, Session, landmark_rmse, make_session, pose_rmse

from evermap.config import ChangesConfig, SlamConfig
from evermap.estimate.sparse.system import Slices
from evermap.slam.changes import joint
from evermap.slam.changes.explain import GivenMap, MovedGroup, explained
from evermap.slam.changes.joint import Joint, without_common_motion
from evermap.slam.method import Explanation
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import StreamingSlam
from evermap.types import ChangeKind, MapChange

BEFORE = Move((1, 2, 5), (0.3, -0.2))
WITHIN = Move((1, 2, 5), (0.3, -0.2), at_s=100.3)
SECOND = Move((3, 7), (-0.3, -0.3))
TURNED = Move((1, 2, 3), (0.3, -0.2), turn_rad=0.4)


def is_found(change: MapChange, move: Move) -> bool:
    """The very group, kind and time, to within 10 s."""
    if change.landmark_ids != move.members:
        return False
    if change.kind != (ChangeKind.ROTATED if move.turn_rad else ChangeKind.MOVED):
        return False
    if move.at_s is None:
        return bool(np.isnan(change.stamp_from_s))
    return change.stamp_from_s - 10.0 <= move.at_s <= change.stamp_to_s + 10.0


def all_found(changes: tuple[MapChange, ...], *moves: Move) -> bool:
    """Every move, and nothing else."""
    return len(changes) == len(moves) and all(any(is_found(change, move) for change in changes) for move in moves)


def count_exact(seeds: range, *moves: Move, **options: object) -> int:
    return sum(all_found(make_session(seed, *moves, **options).revised()[1].changes, *moves) for seed in seeds)  # type: ignore[arg-type]


@pytest.mark.parametrize("moves", [(), (BEFORE,), (WITHIN,)])
def test_one_session_of_each_kind(moves: tuple[Move, ...]) -> None:
    assert count_exact(range(1), *moves) == 1


def test_a_motion_of_all_of_the_map_that_was_seen_is_no_change() -> None:
    given = GivenMap(np.zeros((6, 2)), np.tile(np.eye(2), (6, 1, 1)), np.arange(6) < 5)
    seen, turn = np.array([0, 1, 1, 2, 3, 5]), np.array([0.0, 0.0, 0.7])
    whole = MovedGroup(np.array([0, 1, 2, 3]), True, turn, 0)
    most, rest = MovedGroup(np.array([0, 1, 2]), False, turn, 0), MovedGroup(np.array([3]), False, turn, 0)
    later = MovedGroup(np.array([3]), False, turn, 2)
    assert without_common_motion((whole,), seen, given) == ()
    assert without_common_motion((rest, most), seen, given) == (rest,)
    assert without_common_motion((most, later), seen, given) == (later,)  # 3 alone, while it had not moved, is no frame
    pair, others = MovedGroup(np.array([0, 1]), False, turn, 0), MovedGroup(np.array([2, 3]), False, turn, 2)
    assert without_common_motion((pair, others), seen, given) == (pair, others)  # as many were in their places
    assert without_common_motion((pair, later), seen, given) == (pair, later)  # 2 stayed
    assert without_common_motion((whole,), np.append(seen, 4), given) == (whole,)
    assert without_common_motion((whole,), seen, GivenMap.empty(6)) == (whole,)


@pytest.mark.parametrize("with_map", [True, False])
def test_what_was_thought_on_the_way_can_be_thought_again(with_map: bool) -> None:
    session = make_session(0, WITHIN, with_map=with_map)
    method, estimate = session.method(), session.static
    noise = session.world.noise
    before = method.revise(session.problem, estimate, noise, heavy=True, final=False)
    assert len(before.estimate.landmark) > len(session.before)  # places were added
    problem, estimate = method.unprejudice(before.problem, before.estimate)
    estimate = Smoother(problem, noise).optimum(estimate, tolerance=1e-4)
    last = method.revise(problem, estimate, noise, heavy=False, final=True)
    assert all_found(last.changes, WITHIN)
    again = method.revise(last.problem, last.estimate, noise, heavy=False, final=True)
    assert again.problem is last.problem


def test_the_whole_is_moved_back_though_some_moved_within_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    session = make_session(0, WITHIN, with_map=True)
    method, noise = session.method(), session.world.noise
    before = method.revise(session.problem, session.static, noise, heavy=True, final=False)
    extra = len(before.estimate.landmark) - len(session.before)
    assert extra == len(WITHIN.members)
    dropped = []

    def without_first(groups: tuple[MovedGroup, ...], *others: object) -> tuple[MovedGroup, ...]:
        dropped.extend(groups[:1])
        return groups[1:]

    monkeypatch.setattr(joint, "without_common_motion", without_first)
    away = before.estimate.moved(np.array([1.0, 2.0, 0.3]))
    found = method.revise(before.problem, away, noise, heavy=True, final=False)
    assert dropped
    assert np.linalg.norm(found.estimate.landmark[[0, 3, 4, 6]] - session.before[[0, 3, 4, 6]], axis=1).max() < 0.1


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize("with_map", [True, False])
def test_nothing_moved_nothing_found(with_map: bool) -> None:
    assert count_exact(range(30), with_map=with_map) == 30


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize(
    ("moves", "options"),
    [
        pytest.param((BEFORE,), {}, id="before"),
        pytest.param((BEFORE,), {"n_landmarks": 14, "n_poses": 400}, id="larger"),
        pytest.param((BEFORE, SECOND), {}, id="two groups"),
        pytest.param((TURNED,), {}, id="turned"),
        pytest.param((BEFORE,), {"unmapped": (6,)}, id="a landmark that the map does not hold"),
        pytest.param((Move((4,), (0.2, 0.25)),), {}, id="one alone"),
    ],
)
def test_group_that_moved_before_the_session(moves: tuple[Move, ...], options: dict[str, object]) -> None:
    assert count_exact(range(20), *moves, **options) == 20


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize(
    ("moves", "options", "least"),
    [
        pytest.param((WITHIN,), {}, 19, id="within"),
        pytest.param((WITHIN,), {"with_map": False}, 19, id="without a map"),
        pytest.param((WITHIN, SECOND), {}, 19, id="one before and one within"),
    ],
)
def test_group_that_moved_within_the_session(moves: tuple[Move, ...], options: dict[str, object], least: int) -> None:
    exact = count_exact(range(20), *moves, **options)
    print("exact", exact)
    assert exact >= least


def told(session: Session, *moves: Move) -> Explanation:
    """What somebody estimates who was told what moved, and when."""
    assert session.given is not None
    groups = tuple(
        MovedGroup(
            np.array(m.members), bool(m.turn_rad), np.array([*m.by, m.turn_rad]), 0 if m.at_s is None else 1, m.at_s
        )
        for m in moves
    )
    start = replace(session.world.truth, landmark=session.before)
    problem, start, landmark = explained(session.problem, start, session.given, groups, ChangesConfig())
    estimate = Smoother(problem, session.world.noise).optimum(start)
    current = np.arange(len(session.before))
    current[landmark] = np.arange(len(landmark))
    return Explanation(problem, estimate, current)


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize("moves", [(BEFORE,), (WITHIN,), (TURNED,)])
def test_as_good_as_if_told(moves: tuple[Move, ...]) -> None:
    """Where the exact set is found, poses and landmarks are nearly those of somebody who knew it."""
    ours: list[tuple[float, float]] = []
    best: list[tuple[float, float]] = []
    for seed in range(10):
        session = make_session(seed, *moves)
        _, revision = session.revised()
        if not all_found(revision.changes, *moves):
            continue
        estimate = Smoother(revision.problem, session.world.noise).optimum(revision.estimate)
        ours.append((pose_rmse(session, estimate), landmark_rmse(session, replace(revision, estimate=estimate))))
        known = told(session, *moves)
        best.append((pose_rmse(session, known.estimate), landmark_rmse(session, known)))
    print(np.mean(ours, axis=0), np.mean(best, axis=0))
    assert len(ours) >= 9
    assert np.all(np.mean(ours, axis=0) <= 1.1 * np.mean(best, axis=0) + 0.002)


@pytest.mark.slow
@pytest.mark.experiment
def test_displacements_are_right() -> None:
    errors = []
    for seed in range(10):
        _, revision = make_session(seed, BEFORE, SECOND).revised()
        assert all_found(revision.changes, BEFORE, SECOND)
        for change in revision.changes:
            move = BEFORE if change.landmark_ids == BEFORE.members else SECOND
            errors.append(np.subtract(change.displacement_m, move.by))
    assert np.sqrt(np.mean(np.square(errors))) < 0.04


@pytest.mark.slow
@pytest.mark.experiment
def test_an_instant_is_inside_its_interval_most_of_the_time() -> None:
    """Of 95 % intervals, which take poses for known."""
    inside = trials = 0
    for seed in range(30):
        move = replace(WITHIN, at_s=60.0 + 2.7 * seed)
        _, revision = make_session(seed, move).revised()
        for change in revision.changes:
            if change.landmark_ids == move.members:
                trials += 1
                inside += change.stamp_from_s <= move.at_s <= change.stamp_to_s
    print("inside", inside, "of", trials)
    assert trials >= 27
    assert inside >= 0.9 * trials


@pytest.mark.slow
@pytest.mark.experiment
def test_complement_is_told_as_an_alternative() -> None:
    """Half of the landmarks moved, or the other half did: no recording tells, and the search says so."""
    half = Move((0, 2, 3, 6, 8), (0.35, 0.2))
    others = tuple(sorted(set(range(10)) - set(half.members)))
    for seed in range(8):
        method, _ = make_session(seed, half).revised()
        assert method.posterior is not None
        ranked = [(method.posterior.groups, method.posterior.probability), *method.posterior.alternatives]
        p = {tuple(tuple(int(j) for j in group.members) for group in groups): weight for groups, weight in ranked}
        assert p[half.members,] == pytest.approx(p[others,], abs=0.05)
        assert p[half.members,] + p[others,] > 0.9


@pytest.mark.slow
@pytest.mark.experiment
def test_same_session_same_answer() -> None:
    first, second = (make_session(0, WITHIN).revised()[1] for _ in range(2))
    assert first.changes == second.changes
    np.testing.assert_array_equal(first.estimate.landmark, second.estimate.landmark)


def test_empty_map_holds_nothing() -> None:
    assert not GivenMap.empty(3).given.any()


def test_a_stream_goes_on_while_changes_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    move = replace(WITHIN, at_s=60.3)
    session = make_session(0, move, with_map=False)
    problem, world = session.problem, session.world
    method = session.method()
    slam = StreamingSlam(problem, world.noise, problem.prior, method=method, settings=SlamConfig(estimate_noise=False))
    searches: list[list[int]] = []
    in_slices = Joint.revise_in_slices

    def watched(self: Joint, *given: Any, **named: Any) -> Slices[Explanation]:
        searches.append([slam._n_poses])
        search = in_slices(self, *given, **named)
        while True:
            try:
                share = next(search)
            except StopIteration as found:
                return found.value
            yield share
            searches[-1].append(slam._n_poses)

    monkeypatch.setattr(Joint, "revise_in_slices", watched)
    told: list[int] = []  # places that the detections of each frame had
    for row in range(len(problem.stamp_s)):
        slam.step()
        told += slam._problem.landmark_row[problem.detections_of(row)].tolist()
    assert max(each[-1] - each[0] for each in searches) > 2
    moved = np.isin(problem.landmark_row, move.members) & (problem.stamp_s[problem.pose_row] > move.at_s + 10.0)
    assert (slam._problem.landmark_row[moved] >= len(session.before)).all()
    assert (np.array(told)[moved] < len(session.before)).any()  # of frames that came meanwhile
    assert all_found(slam.finish().revision.changes, move)
