"""What moves with the robot is no landmark: it is left out before anything else is asked, and named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from evermap import Config, check_recording, run_localization, run_session, run_slam
from evermap.geometry import se3
from evermap.slam.check import RIDER, leave_out_riders
from evermap.slam.pairs import USUAL
from evermap.slam.riders import find_riders
from evermap.types import VerdictKind, rows_of

from .worlds import World

NAME = 400
MAKES: dict[str, Callable[[World], Any]] = {
    "plane": World.plane,
    "corners": World.space,
    "poses": lambda world: world.space(corners=False),
}


def join(one: Any, other: Any) -> Any:
    """Detections of both, in the order of their frames."""
    columns = {each.name: (getattr(one, each.name), getattr(other, each.name)) for each in fields(one)}
    both = {name: np.concatenate(pair) for name, pair in columns.items() if np.shape(pair[0])[:1] == (len(one),)}
    together = replace(one, **both)
    return rows_of(together, np.argsort(together.frame, kind="stable"))


def with_rider(recording: Any, *, moves: float = 0.0) -> Any:
    """A landmark that is where it was first seen from in every frame; `moves`: by how much it changes from frame to
    frame, over the noise of the sensor.
    """
    seen, random = recording.detections, np.random.default_rng(7)
    row = int(np.argmax(np.bincount(seen.frame)[seen.frame] > 1))
    frames = np.unique(seen.frame)
    rides = rows_of(seen, np.full(len(frames), row))
    n, noise = len(frames), 1.0 + moves
    more: dict[str, Any] = {"frame": frames, "landmark_id": np.full(n, NAME)}
    if recording.dim == 2:
        more["range_m"] = rides.range_m * (1.0 + 0.004 * noise * random.normal(size=n))
        more["bearing_rad"] = rides.bearing_rad + 0.004 * noise * random.normal(size=n)
    elif np.isfinite(rides.corner_px).all():
        more["corner_px"] = rides.corner_px + 0.5 * noise * random.normal(size=rides.corner_px.shape)
    else:
        more["position_sensor_m"] = rides.position_sensor_m * (1.0 + 0.004 * noise * random.normal(size=(n, 3)))
    rides = replace(rides, **more)
    return replace(recording, detections=join(seen, rides))


@pytest.mark.parametrize("kind", MAKES)
def test_what_rides_on_the_robot_is_left_out_and_named(kind: str) -> None:
    given = MAKES[kind](World(seed=3, seconds=20.0))
    wrong = with_rider(given)
    assert find_riders(wrong, USUAL).tolist() == [NAME]
    alone, result = run_slam(given), run_slam(wrong)
    assert [(cause.code, cause.probability) for cause in result.causes] == [(RIDER, 1.0)]
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND
    assert str(NAME) in result.causes[0].message
    assert any(str(NAME) in warning for warning in result.warnings)
    np.testing.assert_array_equal(result.trajectory.pose_world_robot, alone.trajectory.pose_world_robot)
    np.testing.assert_array_equal(result.landmarks.landmark_id, alone.landmarks.landmark_id)
    assert [finding.code for finding in check_recording(wrong).findings] == [RIDER]


@pytest.mark.parametrize("kind", ["plane", "poses"])
def test_what_rides_on_the_robot_enters_no_map(kind: str) -> None:
    given = MAKES[kind](World(seed=3, seconds=20.0))
    living = run_session(given).living
    entered = run_session(with_rider(given), living)
    assert entered.found
    assert NAME not in entered.living.members.landmark_id
    assert [cause.code for cause in entered.slam.causes] == [RIDER]
    located = run_localization(with_rider(given), living)
    assert sum(str(NAME) in warning for warning in located.warnings) == 1


@pytest.mark.parametrize("kind", MAKES)
def test_without_a_rider_nothing_is_left_out(kind: str) -> None:
    given = MAKES[kind](World(seed=5, seconds=20.0))
    assert not len(find_riders(given, USUAL))
    same, found = leave_out_riders(given, Config().slam)
    assert same is given
    assert not found


def test_landmarks_without_identities_ride_on_nothing() -> None:
    wrong = with_rider(World(seed=3, seconds=20.0).plane())
    assert leave_out_riders(wrong, Config(slam={"unknown_ids": True}).slam) == (wrong, ())


def test_what_changes_in_view_as_others_do_rides_on_nothing() -> None:
    """Far more than its noise, and a fifth of what the odometry says."""
    assert not len(find_riders(with_rider(World(seed=3, seconds=20.0).plane(), moves=60.0), USUAL))


def test_what_was_put_on_the_robot_or_taken_off_it_is_no_rider() -> None:
    """A landmark that rides for a third of its pairs stands for the others."""
    wrong = with_rider(World(seed=3, seconds=30.0).plane())
    seen, taken_s = wrong.detections, wrong.frames.stamp_s[wrong.detections.frame]
    rides, stays = (seen.landmark_id == NAME) & (taken_s < 5.0), taken_s >= 5.0
    often = int(np.bincount(seen.landmark_id[stays & (seen.landmark_id != NAME)]).argmax())
    name = np.where(stays & (seen.landmark_id == often), NAME, seen.landmark_id)
    kept = rides | (seen.landmark_id != NAME)
    both = replace(wrong, detections=rows_of(replace(seen, landmark_id=name), kept))
    assert find_riders(wrong, USUAL).tolist() == [NAME]
    assert not len(find_riders(both, USUAL))


def test_wheels_that_spin_put_no_landmark_on_the_robot() -> None:
    """Where the robot stands, and its odometry drives, all landmarks stay in view where they were."""
    given = World(seed=3, seconds=20.0).plane()
    seen = given.detections
    first = rows_of(seen, np.flatnonzero(seen.frame == 0))
    frames = np.repeat(np.arange(len(given.frames)), len(first))
    rows = rows_of(first, np.tile(np.arange(len(first)), len(given.frames)))
    random = np.random.default_rng(1)
    noisy = rows.range_m * (1.0 + 0.004 * random.normal(size=len(rows)))
    assert not len(find_riders(replace(given, detections=replace(rows, frame=frames, range_m=noisy)), USUAL))


def test_a_landmark_that_is_driven_around_stands() -> None:
    """A post in the middle of a circle is always seen at the same range and bearing, as the odometry says it must."""
    given = World(seed=3, seconds=20.0).plane()
    odometry, seen = given.odometry, given.detections
    ones = np.ones(len(odometry))
    circle = replace(odometry, forward_mps=0.8 * ones, lateral_mps=0.0 * ones, angular_radps=0.4 * ones)
    pole = np.array([-0.2, 2.0])  # from the sensor, .2 m ahead of the robot that drives around (0, 2)
    frames = np.arange(len(given.frames))
    rows = rows_of(seen, np.zeros(len(frames), dtype=np.int64))
    at = replace(
        rows, frame=frames, landmark_id=np.full(len(frames), NAME),
        range_m=np.full(len(frames), np.hypot(*pole)), bearing_rad=np.full(len(frames), np.arctan2(pole[1], pole[0])),
    )  # fmt: skip
    assert not len(find_riders(replace(given, odometry=circle, detections=join(seen, at)), USUAL))


def test_an_odometry_in_millimetres_puts_no_landmark_on_the_robot() -> None:
    given = World(seed=3, seconds=20.0).space(corners=False)
    pose = given.odometry.pose_world_robot
    longer = replace(given, odometry=replace(given.odometry, pose_world_robot=se3.scaled(pose, 1e3)))
    assert not len(find_riders(longer, USUAL))
