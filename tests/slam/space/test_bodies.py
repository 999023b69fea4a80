"""Tags on forklifts that drive while the robot is there: members of a body, which rests, leaves and returns as one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.yard import error_m, is_true, with_noise

import evermap as em
from evermap.config import Config
from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetries
from evermap.maps.sessions.extend import fellows_of
from evermap.slam.space.bodies import _is_elsewhere, with_rests
from evermap.slam.space.intake import SpatialIntake, prepare_space
from evermap.types import UNKNOWN, ChangeKind, FloatArray, IntArray, MapChange, SlamResult, rows_of
from evermap_studies.worlds.yard import YardConfig, YardDrive, simulate_yard

DRIVING = YardConfig(moving=6, parked=0)


@pytest.fixture(scope="module", params=[pytest.param(True, marks=pytest.mark.slow), False], ids=["poses", "points"])
def run(request: pytest.FixtureRequest) -> tuple[YardDrive, SlamResult]:
    drive = simulate_yard(replace(DRIVING, oriented=request.param), seed=1)[0]
    return drive, em.run_slam(drive.recording)


def intake_of(drive: YardDrive) -> SpatialIntake:
    config = Config()
    return with_rests(prepare_space(drive.recording, config.slam.space), drive.recording, config.track.still)


def test_what_is_seen_of_a_body_that_moves_is_left_out() -> None:
    drive = simulate_yard(DRIVING, seed=1)[0]
    given = drive.recording.detections
    body = drive.body_of_tag[given.landmark_id]
    moves = (body != UNKNOWN) & drive.moves[body, given.frame]
    used = np.isin(np.arange(len(given)), intake_of(drive).used)
    assert moves.sum() > 300
    assert (used & moves).sum() < 0.03 * moves.sum()
    assert (~used & ~moves).sum() < 0.15 * (~moves & (body != UNKNOWN)).sum()
    assert used[body == UNKNOWN].all()


def test_the_robot_is_not_bent_by_what_moves(run: tuple[YardDrive, SlamResult]) -> None:
    drive, result = run
    given = drive.recording.detections
    on_walls = drive.body_of_tag[given.landmark_id] == UNKNOWN
    without = drive._replace(recording=replace(drive.recording, detections=rows_of(given, on_walls)))
    assert error_m(result, drive) < 1.1 * error_m(em.run_slam(without.recording), without)
    assert result.verdict is not None
    assert result.verdict.kind == "sound"


def test_members_neither_move_nor_part_alone(run: tuple[YardDrive, SlamResult]) -> None:
    drive, result = run
    assert len(result.changes) > 2
    assert all(is_true(change, drive) for change in result.changes)
    assert (result.landmarks.landmark_id < len(drive.tag)).all()  # no second identity
    parted = {(change.stamp_from_s, tuple(drive.body_of_tag[list(change.landmark_ids)])) for change in result.changes}
    assert len(parted) == len(result.changes)


def at_rests(turn_rad: float, off_m: float, sigma: tuple[float, float], *, oriented: bool = True) -> tuple[Any, Any]:
    """An optimum of one landmark at two rests, in rows 0 and 1 after three poses, and the spread of its variables."""
    place = se3.retract(se3.identity(2), np.array([np.zeros(6), [off_m, 0.0, 0.0, 0.0, 0.0, turn_rad]]))
    problem = SimpleNamespace(stamp_s=np.arange(3.0), oriented=np.full(2, oriented), symmetries=Symmetries.none(2))
    variance = np.repeat(np.square(sigma), 3)

    def of(variable: IntArray, dim: int) -> FloatArray:
        assert (variable >= 3).all()
        return np.tile(np.diag(variance[:dim]), (len(variable), 1, 1))

    smoother, estimate = SimpleNamespace(problem=problem), SimpleNamespace(place=place)
    return SimpleNamespace(smoother=smoother, estimate=estimate), SimpleNamespace(of=of)


@pytest.mark.parametrize(
    ("turn_rad", "off_m", "sigma", "oriented", "elsewhere"),
    [
        (0.0, 0.5, (0.12, 0.02), True, False),  # half a metre off, by poses that have drifted
        (0.5, 0.5, (0.12, 0.02), True, True),  # the same, and turned: it drove
        (0.5, 0.0, (0.12, 0.12), True, False),  # turned by less than is known
        (0.2, 0.0, (0.001, 0.001), True, False),  # errors of an orientation beside its noise
        (0.0, 0.5, (0.02, 0.0), True, True),
        (0.0, 0.15, (0.001, 0.001), True, False),
        (3.0, 0.0, (0.02, 0.02), False, False),  # a point has no orientation
        (0.0, 0.5, (0.02, 0.02), False, True),
    ],
)
def test_two_rests_are_told_apart_by_place_and_by_orientation(
    turn_rad: float, off_m: float, sigma: tuple[float, float], oriented: bool, elsewhere: bool
) -> None:
    optimum, spread = at_rests(turn_rad, off_m, sigma, oriented=oriented)
    assert _is_elsewhere(optimum, spread, np.array([0]), np.array([1])) is elsewhere


@pytest.mark.slow
def test_a_body_that_turned_between_two_looks_has_two_rests() -> None:
    """A tag that was seen before and after its forklift drove by less than the poses had drifted, but turned."""
    moving, standing = (simulate_yard(replace(DRIVING, standing=still), seed=1)[0] for still in (False, True))
    drive = with_noise(moving, standing, DRIVING, 1)
    changes = em.run_slam(drive.recording).changes
    assert len(changes) > 4
    assert all(is_true(change, drive) for change in changes)


@pytest.fixture(scope="module")
def standing_yard() -> tuple[YardDrive, em.Session]:
    """A yard in which nothing drives, entered into a new map."""
    drive = simulate_yard(replace(DRIVING, standing=True), seed=0)[0]
    return drive, em.run_session(drive.recording)


@pytest.mark.slow
def test_a_yard_that_stands_is_mapped_as_if_nothing_was_stated(standing_yard: tuple[YardDrive, em.Session]) -> None:
    drive, stated = standing_yard[0], standing_yard[1].slam
    unstated = em.run_slam(
        replace(drive.recording, objects=drive.recording.objects[:0]), Config.model_validate({"slam": {"plane": False}})
    )
    assert not stated.changes
    np.testing.assert_array_equal(stated.landmarks.landmark_id, unstated.landmarks.landmark_id)
    assert error_m(stated, drive) == pytest.approx(error_m(unstated, drive), rel=0.05)


def test_a_body_is_one_thing_in_a_living_map() -> None:
    """Parked elsewhere, with other sides towards the robot: one move a body, also of landmarks that are new."""
    living, told = None, list[MapChange]()
    for drive in simulate_yard(YardConfig(days=2, moving=2, parked=4), seed=0):
        entered = em.run_session(drive.recording, living)
        living, told = entered.living, list(entered.changes)
    of = [set(drive.body_of_tag[list(change.landmark_ids)].tolist()) for change in told]
    assert all(len(one) == 1 and one != {UNKNOWN} for one in of)
    assert len({min(one) for one in of}) == len(of) > 2
    assert any(change.kind is ChangeKind.MOVED for change in told)
    members = living.members
    body, clique = drive.body_of_tag[members.landmark_id], members.clique_id
    assert all(len(np.unique(clique[body == one])) == 1 for one in np.unique(body[body != UNKNOWN]))


def test_a_new_landmark_has_fellows_that_are_out_of_view(standing_yard: tuple[YardDrive, em.Session]) -> None:
    drive, living = standing_yard[0], standing_yard[1].living
    known = living.members.landmark_id
    new = np.setdiff1d(np.flatnonzero(drive.body_of_tag != UNKNOWN), known)
    assert len(new)
    fellow = fellows_of(new, drive.recording.objects, living)
    np.testing.assert_array_equal(drive.body_of_tag[fellow], drive.body_of_tag[new])
    assert np.isin(fellow, known).all()
    np.testing.assert_array_equal(fellows_of(np.array([0]), drive.recording.objects, living), [-1])
