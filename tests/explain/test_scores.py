"""What a solution tells of what it held as stated: calibrations, stamps that jitter, and breaks of the odometry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import Config
from evermap.explain import scores
from evermap.explain.causes import list_suspects
from evermap.explain.causes.suspect import Inputs
from evermap.explain.scores import DRIFT, SIGNIFICANT, CalibrationScore, SessionScores, _count_adrift, score_session
from evermap.explain.symptoms import Signs, with_scores
from evermap.explain.verdict import judge_signs
from evermap.geometry import se3
from evermap.maps.sessions import solve
from evermap.types import AnyRecording, Frames, Landmarks, Recording, SpatialRecording, VerdictKind

from .worlds import World


def scored(recording: AnyRecording, given: Landmarks | None) -> SessionScores:
    """Return what a session tells that is solved as given."""
    config = Config.model_validate({"slam": {"explain": {"on": False}}})
    solution = solve.explain_session(Inputs.of(recording, given), config, ()).best.solution
    result, asked = solution.result, solution.asked
    return score_session(asked, result.trajectory)


def mounts(recording: SpatialRecording, how: Callable[[np.ndarray], np.ndarray]) -> SpatialRecording:
    """State all mounts otherwise."""
    sensors = [
        replace(one, mount_robot_sensor=tuple(how(np.array(one.mount_robot_sensor)).tolist()))
        for one in recording.sensors
    ]
    return replace(recording, sensors=tuple(sensors))


def pitched(mount: np.ndarray) -> np.ndarray:
    turned = se3.compose(se3.from_angles([0.0, 0.1, 0.0]), se3.turn(mount[3:]))
    return np.concatenate([mount[:3], turned[3:]])


def with_own_frames(recording: SpatialRecording, late_s: float) -> SpatialRecording:
    """Give each camera its own frames; stamps of the second are late."""
    seen, stamp_s = recording.detections, recording.frames.stamp_s
    own = np.stack([stamp_s, stamp_s + late_s]).ravel()
    order = np.argsort(own, kind="stable")
    rank = np.argsort(order)[seen.frame + len(stamp_s) * seen.sensor]
    rows = np.argsort(rank, kind="stable")
    return replace(recording, frames=Frames(own[order]), detections=replace(seen[rows], frame=rank[rows]))


def with_other_lens(recording: SpatialRecording) -> SpatialRecording:
    fx, fy, cx, cy = recording.sensors[0].intrinsics or (0.0,) * 4
    other = tuple(replace(one, intrinsics=(1.03 * fx, fy / 1.03, cx, cy)) for one in recording.sensors)
    return replace(recording, sensors=other)


def stamped_on_arrival(recording: Recording) -> Recording:
    late_s = np.random.default_rng(3).uniform(0.0, 0.15, len(recording.frames))
    return replace(recording, frames=replace(recording.frames, stamp_s=recording.frames.stamp_s + late_s))


@pytest.mark.parametrize(
    ("kind", "mapped"),
    [
        ("plane", False),
        ("plane", True),
        ("corners", False),
        ("poses", True),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("corners", True), ("poses", False))),
    ],
)
def test_nothing_is_suspected_of_a_sound_drive(kind: str, mapped: bool) -> None:
    world = World(seed=1)
    recording: Any = world.plane() if kind == "plane" else world.space(corners=kind == "corners")
    survey = world.map_in_plane() if kind == "plane" else world.map_in_space()
    found = scored(recording, survey if mapped else None)
    assert found.calibrations
    assert max(one.gain for one in found.calibrations) < SIGNIFICANT
    assert (found.suspected, found.adrift, found.alternation > 2.5) == (None, 0, False)


WRONG: dict[str, tuple[Callable[[SpatialRecording], SpatialRecording], str, float]] = {
    "mounts": (lambda one: mounts(one, lambda at: at + [0.2, 0, 0, 0, 0, 0, 0]), "all sensors x", -0.2),
    "pitch": (lambda one: mounts(one, pitched), "all sensors pitch", -0.1),
    "lens": (with_other_lens, "front, back fx", -2.0 * math.log(1.03)),
    "early": (lambda one: with_own_frames(one, -0.08), "back", -0.08),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_what_is_held_though_it_is_another_is_suspected(name: str) -> None:
    how, subject, value = WRONG[name]
    world = World(seconds=40.0, seed=1)
    recording = how(world.space())
    found = scored(recording, world.map_in_space())
    own = next(one for one in found.calibrations if one.suspect.subject == subject)
    best = max(found.calibrations, key=lambda one: one.gain)
    assert best is own
    assert own.value == pytest.approx(value, rel=0.4)
    assert own.gain > SIGNIFICANT
    suspected = found.suspected
    assert suspected is not None
    assert suspected.shift > 0.5


def test_the_delay_of_one_camera_is_estimated_where_it_is_late() -> None:
    """Beside odometry with the stamps of the other one's frames, which may itself seem late, as visual odometry."""
    recording = with_own_frames((world := World(seed=1)).space(), 0.08)
    result = run_slam(recording, prior_map=world.map_in_space())
    delay_s = {one.name: one.value for one in result.parameters if one.name.endswith("_delay_s")}
    assert delay_s == {"front_delay_s": pytest.approx(0.0, abs=0.002), "back_delay_s": pytest.approx(0.08, abs=0.004)}


@pytest.mark.parametrize("late_s", [0.2, pytest.param(-0.2, marks=pytest.mark.slow)])
def test_a_delay_that_was_estimated_is_not_held(late_s: float) -> None:
    """Its prior pulls it to 0, and a clock that is asked beside it would relieve that."""
    recording = World(seed=1, late_s=late_s).space()
    one = replace(recording, sensors=recording.sensors[:1])
    seen = recording.detections.sensor == 0
    one = replace(one, detections=recording.detections[np.flatnonzero(seen)])
    found = scored(one, None)
    assert found.calibrations
    assert "clock" not in {each.suspect.code for each in found.calibrations}
    assert found.suspected is None


@pytest.mark.slow
def test_scores_of_true_calibrations_are_standard_normal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if noise of the odometry is as large as its motions, and turns the robot about one of three axes only."""
    monkeypatch.setattr(scores, "CHANCE", 0.0)
    seeds = range(8)
    found: dict[str, list[float]] = {}
    for seed in seeds:
        world = World(seed=seed, seconds=20.0, drift=0.1)
        for one in scored(world.space(), world.map_in_space()).calibrations:
            score = math.copysign(math.sqrt(2.0 * one.gain), one.value)
            found.setdefault(f"{one.suspect.code} {one.suspect.subject}", []).append(score)
    always = {name: np.array(each) for name, each in found.items() if len(each) == len(seeds)}
    assert {"tag-size all tags", "map-scale map", "clock all sensors", "clock-drift clocks"} <= set(always)
    for name, each in always.items():
        assert abs(each.mean()) < 3.5 / math.sqrt(len(each)), (name, each)
        assert np.mean(each**2) < 4.0, (name, each)
    assert 0.3 < np.mean(np.concatenate(list(always.values())) ** 2) < 1.3


def with_clock(recording: Any, faster: float) -> Any:
    """Stamp frames by a clock that runs so much faster than that of the odometry, and agrees with it halfway."""
    stamp_s = recording.frames.stamp_s
    return replace(recording, frames=replace(recording.frames, stamp_s=stamp_s + faster * (stamp_s - stamp_s.mean())))


@pytest.mark.parametrize("faster", [0.004, pytest.param(-0.004, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["plane", pytest.param("corners", marks=pytest.mark.slow)])
def test_clocks_that_drift_apart_are_suspected(kind: str, faster: float) -> None:
    world = World(seed=1)
    recording: Any = with_clock(world.plane() if kind == "plane" else world.space(), faster)
    survey = world.map_in_plane() if kind == "plane" else world.map_in_space()
    for given in (None, survey):
        suspected = scored(recording, given).suspected
        assert suspected is not None
        assert suspected.suspect.code == "clock-drift"
        assert suspected.value == pytest.approx(faster, rel=0.25)
    verdict = run_slam(recording, prior_map=survey).verdict
    assert verdict is not None
    assert verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert f"{'fast' if faster > 0.0 else 'slow'} of that of the odometry" in verdict.message


def with_blind_frames(recording: Any) -> Any:
    """See nothing in two of three frames of every fourth second."""
    seen = recording.detections
    at_s = recording.frames.stamp_s[seen.frame]
    return replace(recording, detections=seen[np.flatnonzero((at_s.astype(int) % 4 > 0) | (seen.frame % 3 == 0))])


def test_clocks_that_drift_apart_are_suspected_though_frames_saw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within an interval of several steps the axes of the odometry's noise are any: a clock does not turn them."""
    recording = with_clock(with_blind_frames(World(seed=1).space()), 0.004)
    found = scored(recording, None)
    (own,) = (one for one in found.calibrations if one.suspect is DRIFT)
    assert found.suspected is own
    assert own.value == pytest.approx(0.004, rel=0.25)
    monkeypatch.setattr(scores, "FINE_STEP", 0.2 * scores.FINE_STEP)
    (again,) = (one for one in scored(recording, None).calibrations if one.suspect is DRIFT)
    assert (again.gain, again.sigma) == pytest.approx((own.gain, own.sigma), rel=0.05)


def test_clocks_that_drift_apart_move_poses_at_the_ends_most() -> None:
    world = World(seed=1)
    recording = with_clock(world.plane(), 0.004)
    result = run_slam(recording)
    (own,) = (one for one in scored(recording, None).calibrations if one.suspect is DRIFT)
    path = result.trajectory
    speed = np.linalg.norm(np.gradient(path.pose_world_robot[:, :2], path.stamp_s, axis=0), axis=1)
    off_m = own.value * np.abs(path.stamp_s - path.stamp_s.mean()) * speed
    sigma_m = math.sqrt(np.median(np.trace(path.covariance[:, :2, :2], axis1=1, axis2=2)))
    assert own.shift == pytest.approx(off_m.max() / sigma_m, rel=0.3)
    assert off_m.max() > 2.0 * np.median(off_m)


def test_a_clock_that_is_slewed_over_a_network_is_as_usual() -> None:
    slewed, wrong = (CalibrationScore(DRIFT, rate, 1e-5, 50.0, 3.0) for rate in (0.0004, 0.0007))
    assert SessionScores((slewed,)).suspected is None
    assert SessionScores((slewed, wrong)).suspected is wrong


@pytest.mark.parametrize("kind", ["plane", "corners"])
def test_clocks_are_asked_where_frames_begin_and_end_with_the_odometry(kind: str) -> None:
    world = World(seed=1, seconds=20.0)
    recording: Any = world.plane() if kind == "plane" else world.space()
    driven, frame_s = recording.odometry, recording.frames.stamp_s
    driven = driven[np.flatnonzero((driven.stamp_s > frame_s[0] - 0.01) & (driven.stamp_s < frame_s[-1] + 0.01))]
    stamp_s = np.concatenate([frame_s[:1], driven.stamp_s[1:-1], frame_s[-1:]])
    found = scored(replace(recording, odometry=replace(driven, stamp_s=stamp_s)), None)
    assert {"clock", "clock-drift"} <= {one.suspect.code for one in found.calibrations}
    assert found.suspected is None


def test_a_clock_whose_delay_was_estimated_is_not_held() -> None:
    """What is left of its score is the difference of two ways to average a velocity: 8 sigmas of a right solution."""
    world = World(seed=1, seconds=20.0, late_s=0.17)
    recording = world.space()
    found = scored(recording, None)
    config = Config.model_validate({"slam": {"explain": {"on": False}}})
    delays = [one for one in run_slam(recording, config).parameters if one.name.endswith("delay_s")]
    assert [one.value for one in delays] == pytest.approx([world.late_s] * len(delays), abs=0.02)
    assert len(delays) == len(recording.sensors)
    assert "clock" not in {one.suspect.code for one in found.calibrations}
    assert "clock-drift" in {one.suspect.code for one in found.calibrations}


@pytest.mark.parametrize(
    ("subject", "free", "expected"),
    [("left", [0.3, 0.0], True), ("right", [0.3, 0.0], False), ("detections", [0.3, 0.0], False),
     ("detections", [0.3, 0.3], True)],
)  # fmt: skip
def test_each_clock_is_asked_whose_own_delay_was_held(subject: str, free: list[float], expected: bool) -> None:
    problem = SimpleNamespace(delay_sigma_s=np.array(free))
    smoother = SimpleNamespace(smoother=SimpleNamespace(problem=problem))
    of: Any = SimpleNamespace(solved=SimpleNamespace(optimum=smoother))
    sensors = [SimpleNamespace(name=name) for name in ("left", "right")]
    inputs: Any = SimpleNamespace(recording=SimpleNamespace(sensors=sensors))
    suspect: Any = SimpleNamespace(subject=subject)
    assert scores._is_delay_estimated(of, inputs, suspect) is expected


def test_lengths_in_space_are_asked() -> None:
    """Tags are larger than stated, and only the odometry says so."""
    world = World(seed=1, longer=1.05)
    found = scored(world.space(), None)
    (own,) = (one for one in found.calibrations if one.suspect.code == "tag-size")
    assert own.value == pytest.approx(math.log(1.05), rel=0.15)
    assert own.gain > SIGNIFICANT
    assert own.shift > 0.5


def test_what_has_no_metre_is_asked_no_scale() -> None:
    """Without odometry a smaller world is as probable, and a slower walk more so."""
    driven = World(seconds=2.0).space()
    carried = replace(driven, odometry=None)

    def lengths(recording: AnyRecording, given: Landmarks | None) -> set[str]:
        return {one.subject for one in list_suspects(Inputs.of(recording, given))} & {"all tags", "sensor"}

    assert lengths(driven, None)
    assert not lengths(carried, None)
    assert lengths(carried, driven.true_landmarks)


def test_a_score_does_not_depend_on_the_step_of_its_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = mounts(World(seed=1).space(), lambda at: at + [0.02, 0, 0, 0, 0, 0, 0])
    found = scored(recording, World().map_in_space())
    monkeypatch.setattr(scores, "FINE_STEP", 0.2 * scores.FINE_STEP)
    again = scored(recording, World().map_in_space())
    assert [one.suspect.subject for one in found.calibrations] == [one.suspect.subject for one in again.calibrations]
    for one, two in zip(found.calibrations, again.calibrations, strict=True):
        assert one.gain == pytest.approx(two.gain, rel=0.02, abs=0.02), one.suspect.subject


def test_the_significant_step_that_moves_poses_most_is_suspected() -> None:
    names = [one for one in list_suspects(Inputs.of(World(seconds=2.0).space(), None)) if one.code == "mount"]
    some = [
        CalibrationScore(names[0], 0.1, 0.01, SIGNIFICANT + 0.1, 0.4),
        CalibrationScore(names[1], -0.021, 0.01, SIGNIFICANT + 0.1, 0.6),
        CalibrationScore(names[2], 0.1, 0.01, SIGNIFICANT - 0.1, 3.0),  # by chance
        CalibrationScore(names[1], -0.019, 0.001, 300.0, 3.0),  # as any robot needs
    ]
    assert SessionScores(tuple(some)).suspected is some[1]
    assert SessionScores(tuple(some[2:])).suspected is None
    signs = with_scores(Signs(n_landmarks=9, sigma_m=0.01, size_m=9.0), SessionScores(tuple(some), -2.0))
    assert (signs.held, signs.alternation, signs.adrift) == (0.6, -2.0, 0.0)
    verdict = judge_signs(signs)
    assert verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert f"0.6 standard deviations elsewhere if {names[1].say(-0.021)}" in verdict.message
    assert judge_signs(replace(signs, held=0.0, held_name="")).kind is VerdictKind.SOUND


def test_poses_beside_a_break_hang_on_detections_that_are_used() -> None:
    def adrift(odometry: list[float], pose_row: list[int], weight: list[float]) -> int:
        weights = (np.array(odometry), np.array(weight))
        optimum: Any = SimpleNamespace(now=SimpleNamespace(weights=weights))
        return _count_adrift(optimum, np.array(pose_row))

    pose_row = [0, 1, 3, 3, 4, 5, 7]
    whole, used = [1.0] * 7, [1.0] * 7
    broken = [1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0]  # between the fourth pose and the fifth
    for odometry, weight, count in (
        (whole, [0.0] * 7, 0),
        (broken, used, 0),
        (broken, [1, 1, 1, 0, 1, 1, 1], 0),  # another detection holds the pose
        (broken, [1, 1, 0, 0, 1, 1, 1], 1),
        (broken, [1, 1, 0, 0, 0, 1, 1], 2),
        (broken, [1, 1, 1, 1, 0, 0, 0], 3),  # up to the end
        (broken, [0, 1, 1, 1, 1, 1, 0], 0),  # held between the break and them
    ):
        assert adrift(odometry, pose_row, [float(one) for one in weight]) == count


def test_a_camera_that_sees_nothing_is_asked_nothing() -> None:
    world = World(seed=1, seconds=10.0)
    recording = world.space()
    seen = recording.detections
    one_eyed = replace(recording, detections=seen[np.flatnonzero(seen.sensor == 0)])
    found = scored(one_eyed, world.map_in_space())
    assert any(one.suspect.code == "focal-length" for one in found.calibrations)
    assert found.suspected is None


def test_stamps_of_arrival_alternate() -> None:
    world = World(seed=1)
    for mapped in (False, True):
        recording, given = world.plane(), world.map_in_plane() if mapped else None
        assert not scored(recording, given).alternation > 0.0
        assert scored(stamped_on_arrival(recording), given).alternation > 2.5


@pytest.mark.parametrize(
    ("off_m", "kind"),
    [(0.05, VerdictKind.SENSOR_SUSPECT), pytest.param(0.0, VerdictKind.SOUND, marks=pytest.mark.slow)],
)
def test_runs_are_asked_what_they_held(off_m: float, kind: VerdictKind) -> None:
    world = World(seed=1)
    recording = mounts(world.space(), lambda at: at + [off_m, 0, 0, 0, 0, 0, 0])
    verdict = run_slam(recording, prior_map=world.map_in_space()).verdict
    assert verdict is not None
    assert verdict.kind is kind, verdict.message
    assert ("mounts of all sensors are -0.0" in verdict.message) is (off_m > 0.0)


def only_directions(recording: SpatialRecording, of_sensor: int | None = None) -> SpatialRecording:
    """The same detections without their ranges, all or those of a sensor."""
    seen = recording.detections
    at = seen.position_sensor_m
    along = at[:, :, None] * at[:, None, :] / (at**2).sum(axis=1)[:, None, None]
    covariance = 1e-4 * (np.eye(3) - along) + 1e9 * along
    mine = np.ones(len(at), dtype=bool) if of_sensor is None else seen.sensor == of_sensor
    covariance = np.where(mine[:, None, None], covariance, 1e-4 * np.eye(3))
    return replace(recording, detections=replace(seen, covariance_sensor_m2=covariance))


def test_directions_have_no_scale() -> None:
    """What is as far as they meet fits as well in any: nothing but a prior would say which."""
    recording = World(seed=1, seconds=10.0).space(corners=False)
    of_lengths = {"range-scale", "tag-size", "sensor-scale"}

    def list_asked(given: SpatialRecording) -> set[tuple[str, str]]:
        suspects = list_suspects(Inputs.of(given, None), calibrations=True)
        return {(one.code, one.subject) for one in suspects if one.code in of_lengths}

    assert list_asked(only_directions(recording)) == set()
    assert list_asked(recording) == {("range-scale", "sensor"), ("sensor-scale", "front"), ("sensor-scale", "back")}
    assert list_asked(only_directions(recording, 1)) == {("range-scale", "sensor"), ("sensor-scale", "front")}
