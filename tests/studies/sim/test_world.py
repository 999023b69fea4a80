"""The whole simulation: seeds, independent streams, contracts of the types, and bad configurations."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evermap.errors import ConfigError
from evermap.types import Clock
from evermap_studies.sim import (
    DEFAULT_CLASSES,
    BuildingConfig,
    DriveConfig,
    Duration,
    ObjectClass,
    OdometryConfig,
    SimulatedSensor,
    simulate_building,
)

SMALL = BuildingConfig(days=3, patrol_s=60.0)


def arrays_of(value, path=""):
    """All arrays and scalars in a tree of dataclasses and tuples, with their paths."""
    if is_dataclass(value):
        for item in fields(value):
            yield from arrays_of(getattr(value, item.name), f"{path}.{item.name}")
    elif isinstance(value, tuple):
        for row, item in enumerate(value):
            yield from arrays_of(item, f"{path}[{row}]")
    else:
        yield path, value


def test_same_seed_same_arrays():
    first, second = (list(arrays_of(simulate_building(SMALL, 42))) for _ in range(2))
    assert [path for path, _ in first] == [path for path, _ in second]
    for (path, a), (_, b) in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=path)


def test_different_seeds_differ_in_every_part():
    a, b = simulate_building(SMALL, 0), simulate_building(SMALL, 1)
    assert not np.array_equal(a.plan.walls_m, b.plan.walls_m)
    assert [item.home for item in a.objects] != [item.home for item in b.objects]
    for one, other in zip(a.sessions, b.sessions, strict=True):
        assert one.frames.stamp_s[0] != other.frames.stamp_s[0]
        assert not np.array_equal(one.odometry.angular_radps, other.odometry.angular_radps)
        assert not np.array_equal(one.detections.range_m[:20], other.detections.range_m[:20])
    first, second = a.sessions[:2]  # and the sessions of one seed differ too
    assert not np.array_equal(first.odometry.angular_radps, second.odometry.angular_radps)


def test_robot_and_noise_are_the_same_with_and_without_changes():
    changing, still = (simulate_building(replace(SMALL, change_rate=rate, days=6), 9) for rate in (3.0, 0.0))
    assert len(changing.events) > 20
    for a, b in zip(changing.sessions, still.sessions, strict=True):
        for part in ("odometry", "frames", "truth", "sensor"):
            for (path, x), (_, y) in zip(arrays_of(getattr(a, part)), arrays_of(getattr(b, part)), strict=True):
                np.testing.assert_array_equal(x, y, err_msg=path)
    # a landmark that has not moved is seen alike, fault for fault
    for a, b, true_a, true_b in zip(changing.sessions, still.sessions, changing.truths, still.truths, strict=True):
        where_a = dict(zip(a.true_landmarks.landmark_id.tolist(), a.true_landmarks.position_m.tolist(), strict=True))
        where_b = dict(zip(b.true_landmarks.landmark_id.tolist(), b.true_landmarks.position_m.tolist(), strict=True))
        unmoved = [i for i in where_b if where_a.get(i) == where_b[i]]
        assert len(unmoved) >= 14
        rows = []
        for recording, truth in ((a, true_a), (b, true_b)):
            keep = np.isin(truth.detection_landmark_id, unmoved)
            d = recording.detections
            rows.append([x[keep].tolist() for x in (d.frame, d.landmark_id, d.range_m, d.bearing_rad, d.class_id)])
        assert rows[0] == rows[1]


def test_recordings_keep_the_contracts_of_their_types():
    config = replace(SMALL, sessions_per_day=2)
    simulation = simulate_building(config, 3)
    assert len(simulation.sessions) == len(simulation.truths) == 6
    assert [truth.day for truth in simulation.truths] == [0, 0, 1, 1, 2, 2]
    last_s = config.first_day_unix_s
    for recording, truth in zip(simulation.sessions, simulation.truths, strict=True):
        for part in (recording, recording.odometry, recording.frames, recording.truth, recording.true_landmarks):
            assert part.clock is Clock.UNIX
        assert recording.truth.frame == recording.true_landmarks.frame == "truth"
        for stamps in (recording.odometry.stamp_s, recording.frames.stamp_s, recording.truth.stamp_s):
            assert np.all(np.diff(stamps) > 0)
            assert stamps[0] > last_s
        last_s = recording.truth.stamp_s[-1]
        assert truth.end_s == last_s
        hour = (truth.start_s - config.first_day_unix_s) % 86_400 / 3600
        assert 8.0 <= hour < 18.0
        for path, value in arrays_of(recording):
            if isinstance(value, np.ndarray):
                assert value.dtype in (np.float64, np.int64), path
                assert value.flags.c_contiguous, path
        d = recording.detections
        assert np.all(np.diff(d.frame) >= 0)
        assert d.frame.max() < len(recording.frames)
        assert np.isfinite(d.range_m).all()
        assert np.all(d.range_m > 0.0)
        assert np.all(np.abs(d.bearing_rad) <= math.pi)
        assert np.all(np.diff(recording.true_landmarks.landmark_id) > 0)
        assert recording.class_names == tuple(kind.name for kind in DEFAULT_CLASSES)
        np.testing.assert_array_equal(
            simulation.landmarks_at(truth.start_s).position_m, recording.true_landmarks.position_m
        )


def test_events_are_plain_values():
    for event in simulate_building(SMALL, 0).events:
        assert json.loads(json.dumps(asdict(event)))["object_id"] == event.object_id


def test_demo_size():
    """The default stays small enough for SLAM over all of it in seconds."""
    simulation = simulate_building()
    assert len(simulation.sessions) == 6
    assert sum(len(recording.frames) for recording in simulation.sessions) <= 5000
    assert 60 <= len(simulation.sessions[0].true_landmarks) <= 90
    assert {event.kind.value for event in simulation.events} >= {"moved", "vanished", "returned", "opened", "closed"}


@settings(max_examples=settings.default.max_examples * 2 // 5, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 2**63),
    length_m=st.floats(21.0, 60.0),
    depth_m=st.floats(13.0, 30.0),
    rooms=st.integers(1, 3),
    rate=st.floats(0.0, 10.0),
    speed=st.floats(0.1, 2.0),
    field_of_view=st.floats(0.1, 2 * math.pi),
    sigma=st.floats(0.0, 1.0),
    rate_hz=st.floats(0.1, 50.0),
    stickiness=st.floats(0.0, 0.999),
    delay=st.floats(0.0, 2.0),
    faults=st.floats(0.0, 1.0),
)
def test_any_config_in_range_gives_finite_recordings(
    seed, length_m, depth_m, rooms, rate, speed, field_of_view, sigma, rate_hz, stickiness, delay, faults
):
    config = BuildingConfig(
        days=2, patrol_s=12.0, change_rate=rate, length_m=length_m, depth_m=depth_m, rooms_per_side=rooms,
        classes=tuple(replace(kind, count=min(kind.count, 2)) for kind in DEFAULT_CLASSES),
        drive=DriveConfig(speed_mps=speed),
        odometry=OdometryConfig(delay_s=delay, rate_hz=max(5.0, rate_hz)),
        sensor=SimulatedSensor(
            field_of_view_rad=field_of_view, sigma_range_m=sigma, rate_hz=rate_hz, stickiness=stickiness,
            p_false=faults, p_wrong_identity=faults, p_no_identity=1.0 - faults,
        ),
    )  # fmt: skip
    simulation = simulate_building(config, seed)
    for path, value in arrays_of(simulation.sessions):
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and "sigma" not in path and "_seen" not in path:
            assert np.isfinite(value).all(), path
    for recording in simulation.sessions:
        assert np.all(recording.detections.range_m > 0.0)
        pose = recording.truth.pose_world_robot
        assert np.all((pose[:, :2] > 0.0) & (pose[:, :2] < [length_m, depth_m]))


@settings(max_examples=settings.default.max_examples // 3)
@given(
    seed=st.integers(0, 1000),
    depth_m=st.floats(13.0, 30.0),
    width_m=st.floats(7.0, 14.0),
    corridor_m=st.floats(2.4, 3.0),
    speed=st.floats(0.3, 2.0),
    acceleration=st.floats(0.2, 5.0),
    turn_acceleration=st.floats(3.0, 50.0),
    turn=st.floats(0.5, 6.0),
    lateral=st.floats(0.1, 2.0),
    lookahead=st.floats(0.3, 0.8),
)
def test_no_robot_in_range_drives_through_a_wall(
    seed, depth_m, width_m, corridor_m, speed, acceleration, turn_acceleration, turn, lateral, lookahead
):
    config = BuildingConfig(
        days=2, patrol_s=150.0, depth_m=depth_m, length_m=2 * width_m, rooms_per_side=2, corridor_m=corridor_m,
        classes=(ObjectClass("mark", "wall", count=6, landmarks=(1, 1)),),
        drive=DriveConfig(
            speed_mps=speed, acceleration_mps2=acceleration, turn_acceleration_radps2=turn_acceleration,
            turn_radps=turn, lateral_acceleration_mps2=lateral, lookahead_m=lookahead,
        ),
    )  # fmt: skip
    simulation = simulate_building(config, seed)
    dots = np.concatenate([np.linspace(w[0], w[1], 300) for w in simulation.plan.walls_m])
    for recording in simulation.sessions:
        position = recording.truth.pose_world_robot[::20, :2]
        assert np.linalg.norm(position[:, None] - dots[None], axis=-1).min() > 0.25


BAD = {
    "days": replace(SMALL, days=0),
    "sessions_per_day": replace(SMALL, sessions_per_day=1.5),
    "patrol_s": replace(SMALL, patrol_s=7200.0, sessions_per_day=24),
    "change_rate": replace(SMALL, change_rate=float("nan")),
    "length_m": replace(SMALL, length_m="30"),
    "depth_m": replace(SMALL, depth_m=-1.0),
    "corridor_m": replace(SMALL, corridor_m=6.0),
    "rooms_per_side": replace(SMALL, rooms_per_side=8),
    "classes": replace(SMALL, classes=()),
    "classes[0].count": replace(SMALL, classes=(ObjectClass("pallet", size_m=(2.0, 2.0), count=300),)),
    "classes[1].name": replace(SMALL, classes=(ObjectClass("a"), ObjectClass(""))),
    "classes[0].landmarks": replace(SMALL, classes=(ObjectClass("a", landmarks=(0, 5)),)),
    "classes[0].p_vanish": replace(SMALL, classes=(ObjectClass("a", p_vanish=1.5),)),
    "classes[0].p_nudge": replace(SMALL, classes=(ObjectClass("a", p_nudge=0.8, p_other_room=0.8),)),
    "classes[0].stay.mean_days": replace(SMALL, classes=(ObjectClass("a", stay=Duration(0.0)),)),
    "classes[0].arrivals_per_day": replace(SMALL, classes=(ObjectClass("a", "wall", arrivals_per_day=1.0),)),
    "classes[0].mount": replace(SMALL, classes=(ObjectClass("a", "ceiling"),)),
    "drive.speed_mps": replace(SMALL, drive=DriveConfig(speed_mps=50.0)),
    "odometry.rate_hz": replace(SMALL, odometry=OdometryConfig(rate_hz=0.0)),
    "odometry.forward_noise_m": replace(SMALL, odometry=OdometryConfig(forward_noise_m=-0.1)),
    "patrol_lengths_s[1]": replace(SMALL, patrol_lengths_s=(20.0, 1.0)),
    "doors.shut.mean_days": replace(SMALL, doors=(Duration(1.0), Duration(0.0))),
    "wing_opens_day": replace(SMALL, wing_opens_day=1.5),
    "sensor.p_false": replace(SMALL, sensor=SimulatedSensor(p_false=2.0)),
    "sensor.range_min_m": replace(SMALL, sensor=SimulatedSensor(range_min_m=5.0, range_max_m=3.0)),
    "sensor.mount_robot_sensor": replace(SMALL, sensor=SimulatedSensor(mount_robot_sensor=(2.0, 0.0, 0.0))),
}


@pytest.mark.parametrize("field", BAD)
def test_bad_config_names_the_field(field):
    with pytest.raises(ConfigError) as caught:
        simulate_building(BAD[field], 0)
    assert caught.value.field == field
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [-1, 1.5, None, "a"])
def test_bad_seed_names_the_field(seed):
    with pytest.raises(ConfigError) as caught:
        simulate_building(SMALL, seed)
    assert caught.value.field == "seed"
