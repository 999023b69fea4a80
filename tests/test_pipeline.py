"""`run_slam` from a simulated recording to the result, against the simulator's truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from evermap import se2
from evermap.config import Config, load_config
from evermap.errors import DataError
from evermap.pipeline import run_slam
from evermap.sim import BuildingConfig, BuildingSimulation, SensorConfig, simulate_building
from evermap.slam.calibration import SPECS
from evermap.types import UNKNOWN, FloatArray, Landmarks, Recording, SlamResult

TRUE_STATES = {
    "range_bias_m": 0.03,
    "range_slope": 0.01,
    "range_skew_per_rad": 0.0,
    "range_curvature_per_rad2": 0.0,
    "bearing_bias_rad": 0.01,
    "odometry_delay_s": 0.12,
    "odometry_forward_scale": 1 / 1.03,
    "odometry_turn_scale": 1 / 1.04,
    "odometry_turn_slip_m": 0.0,
}
"""What the simulator's defaults do to the truth."""


@cache
def building(seed: int, patrol_s: float = 40.0, faults: float = 0.01) -> BuildingSimulation:
    sensor = SensorConfig(p_wrong_identity=faults, p_false=faults / 3)
    return simulate_building(BuildingConfig(days=1, patrol_s=patrol_s, change_rate=0.0, sensor=sensor), seed=seed)


def recording_of(seed: int, patrol_s: float = 40.0, faults: float = 0.01) -> Recording:
    return building(seed, patrol_s, faults).sessions[0]


def true_pose_at(recording: Recording, stamp_s: FloatArray) -> FloatArray:
    """Interpolated between the 50 Hz of the truth."""
    assert recording.truth is not None
    pose = recording.truth.pose_world_robot
    columns = pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])
    return np.column_stack([np.interp(stamp_s, recording.truth.stamp_s, column) for column in columns])


@dataclass
class Judged:
    """A run and its errors in its own frame, nothing aligned: the first pose of the truth is known."""

    recording: Recording
    result: SlamResult
    wrong: np.ndarray

    @property
    def true_origin(self) -> FloatArray:
        """The pose that is the origin of the estimate's frame, in the world."""
        if self.result.trajectory.frame == "prior_map":
            return np.zeros(3)
        first = self.recording.frames.stamp_s[self.recording.detections.frame[:1]]
        return true_pose_at(self.recording, first)[0]

    @property
    def pose_error(self) -> FloatArray:
        trajectory = self.result.trajectory
        true = se2.between(self.true_origin, true_pose_at(self.recording, trajectory.stamp_s))
        return se2.log(se2.between(trajectory.pose_world_robot, true))

    @property
    def pose_nees(self) -> FloatArray:
        error = self.pose_error
        return np.einsum("ni,nij,nj->n", error, np.linalg.inv(self.result.trajectory.covariance), error)

    @property
    def landmark_error(self) -> FloatArray:
        true = self.recording.true_landmarks
        assert true is not None
        rows = np.searchsorted(true.landmark_id, self.result.landmarks.landmark_id)
        position = se2.transform(se2.inverse(self.true_origin), true.position_m[rows])
        return self.result.landmarks.position_m - position

    @property
    def landmark_nees(self) -> FloatArray:
        error = self.landmark_error
        return np.einsum("ni,nij,nj->n", error, np.linalg.inv(self.result.landmarks.covariance_m2), error)

    @property
    def seen_well(self) -> np.ndarray:
        """Often enough that a wrong identity cannot be all that is known of it."""
        return self.result.landmarks.n_hits >= 5

    def landmark_rmse(self) -> float:
        return float(np.sqrt((self.landmark_error[self.seen_well] ** 2).sum(axis=1).mean()))

    def parameter(self, name: str):
        return next(p for p in self.result.parameters if p.name == name)


def judge(recording: Recording, wrong: np.ndarray, config: Config | None = None, **options) -> Judged:
    return Judged(recording, run_slam(recording, config, **options), wrong)


def surveyed(recording: Recording, seed: int) -> Landmarks:
    """The true landmarks as somebody measured them, to 2 cm."""
    true = recording.true_landmarks
    assert true is not None
    error = 0.02 * np.random.default_rng(seed).normal(size=true.position_m.shape)
    return Landmarks.at(true.landmark_id, true.position_m + error, sigma_m=0.02)


@cache
def judged(seed: int, *overrides: str, with_map: bool = False, faults: float = 0.01) -> Judged:
    """One run a seed and setting, shared by the tests."""
    simulation = building(seed, faults=faults)
    recording = simulation.sessions[0]
    wrong = simulation.truths[0].detection_landmark_id != recording.detections.landmark_id
    prior_map = surveyed(recording, seed) if with_map else None
    return judge(recording, wrong, load_config(None, overrides), prior_map=prior_map)


SEEDS = (0, 1, 2)


def consistent(judged_runs: list[Judged]) -> None:
    """One pose and one landmark a run, which are independent between runs, have chi-square errors."""
    last = [run.pose_nees[-1] for run in judged_runs]
    low, high = stats.chi2(3 * len(last)).ppf([1e-3, 1 - 1e-3])
    assert low < sum(last) < high
    often = [run.landmark_nees[np.argmax(run.result.landmarks.n_hits)] for run in judged_runs]
    low, high = stats.chi2(2 * len(often)).ppf([1e-3, 1 - 1e-3])
    assert low < sum(often) < high


def test_trajectory_and_map_are_as_good_as_they_say():
    runs = [judged(seed) for seed in SEEDS]
    consistent(runs)
    for run in runs:
        assert run.pose_nees.max() < 35.0
        assert run.landmark_nees[run.seen_well].max() < 25.0
        assert run.result.trajectory.frame == run.result.landmarks.frame == "first_pose"


def test_trajectory_and_map_in_a_prior_map_are_as_good_as_they_say():
    runs = [judged(seed, with_map=True) for seed in SEEDS]
    consistent(runs)
    for run in runs:
        assert run.result.trajectory.frame == run.result.landmarks.frame == run.result.online.frame == "prior_map"
        # no alignment: these are coordinates of the map
        assert np.sqrt((run.pose_error[:, :2] ** 2).sum(axis=1).mean()) < 0.05
        assert np.sqrt((run.pose_error[:, 2] ** 2).mean()) < 0.02


def test_calibration_is_found():
    for seed in SEEDS:
        for name, truth in TRUE_STATES.items():
            found = judged(seed).parameter(name)
            assert not found.fixed
            assert abs(found.value - truth) < 4 * found.sigma, f"{name} of seed {seed}"
    # and more is known than before
    for name in ("odometry_delay_s", "odometry_turn_scale", "bearing_bias_rad", "range_bias_m"):
        found = judged(0).parameter(name)
        assert found.sigma < 0.3 * found.prior_sigma


def test_noise_of_the_sensor_is_found():
    for seed in SEEDS:
        for name, truth in (("sigma_range_m", 0.03), ("sigma_bearing_rad", 0.01)):
            found = judged(seed).parameter(name)
            assert abs(found.value - truth) < 4 * found.sigma


def test_wrong_identities_are_found():
    runs = [judged(seed, faults=0.05) for seed in SEEDS]
    wrong = np.concatenate([run.wrong[run.result.innovations.detection] for run in runs])
    p_inlier = np.concatenate([run.result.innovations.p_inlier for run in runs])
    # a landmark that nobody ever saw rightly cannot be told from one that is there
    assert wrong.sum() > 15
    assert np.mean(p_inlier[wrong] < 0.5) > 0.8
    assert np.mean(p_inlier[~wrong] > 0.5) > 0.98


def test_wrong_identities_hurt_only_those_who_believe_everything():
    seeds = (0, 2)
    robust = np.array([judged(seed).landmark_rmse() for seed in seeds])
    credulous = np.array([judged(seed, "slam.robust=false").landmark_rmse() for seed in seeds])
    without = np.array([judged(seed, faults=0.0).landmark_rmse() for seed in seeds])
    assert credulous.sum() > 2 * robust.sum()
    assert robust.sum() < 1.5 * without.sum()


def test_innovations_are_nearly_chi_square():
    """After the first stock-taking of noise; too much noise is allowed for a while, too little is not."""
    runs = [judged(seed, faults=0.0) for seed in SEEDS]
    nis = np.concatenate([run.result.innovations.nis[run.result.innovations.stamp_s > stamp] for run in runs
                          for stamp in [run.result.trajectory.stamp_s[0] + 15.0]])  # fmt: skip
    assert 1.3 < nis.mean() < 2.2
    assert np.mean(nis > stats.chi2(2).ppf(0.99)) < 0.02


def test_online_poses_are_causal_and_end_where_the_smoother_ends():
    run = judged(1)
    online = run.result.online
    assert len(online) == len(run.result.step_s)
    assert np.isfinite(online.pose_world_robot).all()
    last = run.result.trajectory.pose_world_robot[-1]
    assert np.linalg.norm(online.pose_world_robot[-1, :2] - last[:2]) < 0.3
    assert np.linalg.eigvalsh(online.covariance[1:]).min() > 0.0


def test_dead_reckoning_starts_with_the_trajectory_and_is_worse():
    runs = [judged(seed, with_map=True) for seed in SEEDS]
    for run in runs:
        start = run.result.dead_reckoning.pose_world_robot[0] - run.result.trajectory.pose_world_robot[0]
        assert se2.wrap(start[2]) == pytest.approx(0.0, abs=1e-9)
        assert start[:2] == pytest.approx(0.0, abs=1e-9)
        true = true_pose_at(run.recording, run.result.trajectory.stamp_s)
        away = np.linalg.norm(run.result.dead_reckoning.pose_world_robot[:, :2] - true[:, :2], axis=1)
        assert away[-1] > 5 * np.linalg.norm(run.pose_error[:, :2], axis=1)[-1]


def test_trajectory_has_every_frame_and_no_long_step():
    run = judged(2)
    stamps = run.result.trajectory.stamp_s
    assert np.diff(stamps).max() < 0.1 + 1e-6
    assert np.isin(run.recording.frames.stamp_s, stamps).all()
    assert np.linalg.eigvalsh(run.result.trajectory.covariance).min() > 0.0


def test_misses_are_expected_and_not_detected():
    run = judged(0)
    misses, detections = run.result.misses, run.recording.detections
    hits = set(zip(detections.frame.tolist(), detections.landmark_id.tolist(), strict=True))
    assert len(misses) > 50
    assert not hits & set(zip(misses.frame.tolist(), misses.landmark_id.tolist(), strict=True))
    counted = [int((misses.landmark_id == identity).sum()) for identity in run.result.landmarks.landmark_id]
    assert run.result.landmarks.n_misses.tolist() == counted
    known = [int((detections.landmark_id == identity).sum()) for identity in run.result.landmarks.landmark_id]
    assert run.result.landmarks.n_hits.tolist() == known


def test_a_fixed_state_is_fixed():
    run = judged(0, "slam.calibration.fix.odometry_delay_s=0.12")
    delay = run.parameter("odometry_delay_s")
    assert (delay.value, delay.sigma, delay.fixed) == (0.12, 0.0, True)
    assert not run.parameter("odometry_turn_scale").fixed


def test_a_plain_sensor_model_fixes_everything_and_is_worse():
    plain = judged(0, "slam.sensor_model=plain", with_map=True)
    for spec in SPECS:
        found = plain.parameter(spec.name)
        assert (found.value, found.sigma, found.fixed) == (spec.mean, 0.0, True)
    error = np.linalg.norm(plain.pose_error[:, :2], axis=1).mean()
    assert error > 1.5 * np.linalg.norm(judged(0, with_map=True).pose_error[:, :2], axis=1).mean()


def test_kept_noise_is_the_nominal_one():
    run = judged(0, "slam.estimate_noise=false", "sensor.sigma_range_m=0.05")
    assert run.parameter("sigma_range_m").value == 0.05
    assert run.parameter("sigma_bearing_rad").value == 0.01


def moved_map(landmarks: Landmarks, pose: FloatArray) -> Landmarks:
    turn = se2.rotation(pose[2])
    return replace(
        landmarks,
        position_m=se2.transform(pose, landmarks.position_m),
        covariance_m2=turn @ landmarks.covariance_m2 @ turn.T,
    )


@pytest.mark.parametrize("pose", [(100.0, -300.0, 3.0), (-7.0, 2.0, -1.6)])
def test_the_start_may_be_anywhere_in_the_map(pose):
    """Moving the map moves the result with it, and nothing else."""
    here = judged(1, with_map=True)
    recording = here.recording
    there = run_slam(recording, prior_map=moved_map(surveyed(recording, 1), np.array(pose)))
    moved = se2.compose(pose, here.result.trajectory.pose_world_robot)
    gap = se2.between(moved, there.trajectory.pose_world_robot)
    assert np.abs(gap).max() < 2e-3
    turn = se2.rotation(pose[2])
    assert there.landmarks.covariance_m2 == pytest.approx(
        turn @ here.result.landmarks.covariance_m2 @ turn.T, rel=0.05, abs=1e-9
    )


def test_a_map_may_know_more_and_less_than_the_recording():
    recording = recording_of(1)
    true = recording.true_landmarks
    half = replace(
        true,
        **{f.name: getattr(true, f.name)[::2] for f in fields(true) if isinstance(getattr(true, f.name), np.ndarray)},
    )
    strangers = Landmarks.at(
        np.append(half.landmark_id, [7000, 8000]), np.vstack([half.position_m, [[1e4, 0.0], [0.0, -1e4]]])
    )
    run = judge(recording, judged(1).wrong, prior_map=half)
    with_strangers = run_slam(recording, prior_map=strangers)
    assert run.result.trajectory.frame == "prior_map"
    assert np.sqrt((run.pose_error[:, :2] ** 2).sum(axis=1).mean()) < 0.08
    assert np.isin(recording.detections.landmark_id, run.result.landmarks.landmark_id).all()
    assert_same(with_strangers, run.result)


def test_a_map_of_another_place_is_not_entered():
    recording = recording_of(2, 20.0)
    result = run_slam(recording, prior_map=Landmarks.at([7000, 8000, 9000], [[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]]))
    assert result.trajectory.frame == "first_pose"
    assert any("prior map" in warning for warning in result.warnings)


def arrays_of(thing, path="result"):
    """All numbers of nested dataclasses but the timings, by name."""
    if is_dataclass(thing):
        for field in fields(thing):
            if field.name != "step_s":
                yield from arrays_of(getattr(thing, field.name), f"{path}.{field.name}")
    elif isinstance(thing, tuple):
        for k, item in enumerate(thing):
            yield from arrays_of(item, f"{path}[{k}]")
    else:
        yield path, thing


def assert_same(a: SlamResult, b: SlamResult) -> None:
    for (name, x), (_, y) in zip(arrays_of(a), arrays_of(b), strict=True):
        if isinstance(x, np.ndarray):
            assert x.tobytes() == y.tobytes(), name
        else:
            assert repr(x) == repr(y), name


def test_the_same_recording_gives_the_same_bytes():
    assert_same(run_slam(recording_of(0)), judged(0).result)


def test_an_interrupt_leaves_the_finished_part():
    recording = recording_of(0)
    seen = []

    def stop_after_100(done_s, all_s):
        seen.append((done_s, all_s))
        if len(seen) == 100:
            raise KeyboardInterrupt

    run = judge(recording, judged(0).wrong, progress=stop_after_100)
    result = run.result
    assert result.interrupted
    assert any("interrupted" in warning for warning in result.warnings)
    assert np.all(np.diff([done for done, _ in seen]) > 0)
    used = np.unique(recording.detections.frame)
    last = recording.frames.stamp_s[used[99]]
    assert result.trajectory.stamp_s[-1] == pytest.approx(last, abs=1e-6)
    assert result.landmarks.last_seen_s.max() <= last
    assert run.pose_nees.max() < 35.0
    assert not judged(0).result.interrupted


def test_an_interrupt_before_anything_is_known_goes_through():
    def stop(done_s, all_s):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_slam(recording_of(0), progress=stop)


def with_detections(recording: Recording, keep) -> Recording:
    """Some of the detections only, by mask or rows."""
    detections = recording.detections
    columns = {f.name: getattr(detections, f.name)[keep] for f in fields(detections)}
    return replace(recording, detections=type(detections)(**columns))


def with_ids(recording: Recording, rename: Callable[[np.ndarray], np.ndarray]) -> Recording:
    return replace(
        recording, detections=replace(recording.detections, landmark_id=rename(recording.detections.landmark_id))
    )


def without_odometry_between(recording: Recording, start_s: float, stop_s: float) -> Recording:
    odometry = recording.odometry
    passed = odometry.stamp_s - odometry.stamp_s[0]
    keep = (passed < start_s) | (passed > stop_s)
    names = ("stamp_s", "forward_mps", "lateral_mps", "angular_radps")
    return replace(recording, odometry=replace(odometry, **{name: getattr(odometry, name)[keep] for name in names}))


def test_without_known_identities_nothing_can_be_estimated():
    with pytest.raises(DataError, match="known identity"):
        run_slam(with_ids(recording_of(0), lambda ids: np.full_like(ids, UNKNOWN)))


def test_without_odometry_nothing_can_be_estimated():
    with pytest.raises(DataError, match="odometry"):
        run_slam(without_odometry_between(recording_of(0), -1.0, 1e9))


def test_two_frames_are_enough():
    recording = recording_of(0)
    frames = np.unique(recording.detections.frame)[20:22]
    result = run_slam(with_detections(recording, np.isin(recording.detections.frame, frames)))
    assert len(result.step_s) == 2
    for name, value in arrays_of(result):
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            assert np.isfinite(value).all(), name


def test_one_frame_is_not():
    recording = recording_of(0)
    with pytest.raises(DataError, match="1 frames"):
        run_slam(with_detections(recording, recording.detections.frame == recording.detections.frame[0]))


def test_a_landmark_seen_once_is_in_the_map_with_its_uncertainty():
    recording = recording_of(1, faults=0.0)
    identity = np.bincount(recording.detections.landmark_id).argmax()
    mine = np.flatnonzero(recording.detections.landmark_id == identity)
    keep = np.setdiff1d(np.arange(len(recording.detections)), mine[np.arange(len(mine)) != len(mine) // 2])
    run = judge(with_detections(recording, keep), np.zeros(0))
    row = int(np.flatnonzero(run.result.landmarks.landmark_id == identity)[0])
    assert run.result.landmarks.n_hits[row] == 1
    assert run.result.landmarks.first_seen_s[row] == run.result.landmarks.last_seen_s[row]
    assert run.landmark_nees[row] < 25.0
    sigma = np.sqrt(np.linalg.eigvalsh(run.result.landmarks.covariance_m2[row]))
    assert np.all((sigma > 0.01) & (sigma < 1.0))


def test_a_blind_and_deaf_stretch_of_20_s_is_survived_and_admitted():
    """No odometry and no detections for 20 s: nobody knows where the robot is, and the covariance says so."""
    recording = recording_of(3, faults=0.0)
    passed = recording.frames.stamp_s - recording.odometry.stamp_s[0]
    blind = (passed > 14.9) & (passed < 35.1)
    silent = without_odometry_between(with_detections(recording, ~blind[recording.detections.frame]), 15.0, 35.0)
    run = judge(silent, np.zeros(0), prior_map=surveyed(recording, 3))
    trajectory = run.result.trajectory
    assert np.isfinite(trajectory.pose_world_robot).all()
    size = np.sqrt(np.einsum("nii->ni", trajectory.covariance)[:, :2].sum(axis=1))
    at = trajectory.stamp_s - recording.odometry.stamp_s[0]
    middle, known = size[(at > 18) & (at < 32)], size[(at < 14) | (at > 36)]
    assert middle.min() > 5 * np.median(known)
    # grows away from both ends
    assert np.all(np.diff(size[(at > 17) & (at < 23)]) > 0)
    assert np.all(np.diff(size[(at > 27) & (at < 33)]) < 0)
    # and before and after it is the map that tells
    error = np.linalg.norm(run.pose_error[:, :2], axis=1)
    assert error[(at < 14) | (at > 36)].max() < 0.3
    assert np.all(error[(at > 16) & (at < 34)] < 4 * size[(at > 16) & (at < 34)])


def test_silent_odometry_alone_is_survived_and_admitted():
    recording = recording_of(0, faults=0.0)
    run = judge(without_odometry_between(recording, 10.0, 30.0), np.zeros(0))
    assert run.pose_nees.max() < 25.0


def test_names_do_not_matter():
    """Renaming the landmarks renames the map."""
    recording = recording_of(2)
    rename = np.random.default_rng(0).permutation(500) + 1000
    result = run_slam(with_ids(recording, lambda ids: rename[ids]))
    before = judged(2).result
    new_id = rename[before.landmarks.landmark_id]
    order = np.argsort(new_id)
    assert result.landmarks.landmark_id.tolist() == new_id[order].tolist()
    assert result.landmarks.position_m == pytest.approx(before.landmarks.position_m[order], abs=2e-3)
    assert result.landmarks.n_hits.tolist() == before.landmarks.n_hits[order].tolist()
    assert result.landmarks.n_misses.tolist() == before.landmarks.n_misses[order].tolist()
    assert result.trajectory.pose_world_robot == pytest.approx(before.trajectory.pose_world_robot, abs=2e-3)


def test_the_clocks_zero_does_not_matter():
    recording, shift = recording_of(1), -1.7e9
    odometry, frames = recording.odometry, recording.frames
    result = run_slam(
        replace(
            recording,
            odometry=replace(odometry, stamp_s=odometry.stamp_s + shift),
            frames=replace(frames, stamp_s=frames.stamp_s + shift),
        )
    )
    before = judged(1).result
    assert result.trajectory.stamp_s == pytest.approx(before.trajectory.stamp_s + shift, abs=1e-5)
    assert result.trajectory.pose_world_robot == pytest.approx(before.trajectory.pose_world_robot, abs=1e-3)
    assert result.landmarks.position_m == pytest.approx(before.landmarks.position_m, abs=1e-3)
    assert result.landmarks.first_seen_s == pytest.approx(before.landmarks.first_seen_s + shift, abs=1e-5)


def test_truth_is_not_looked_at():
    recording = recording_of(0)
    blind = replace(recording, truth=None, true_landmarks=None)
    assert_same(run_slam(blind), judged(0).result)


@pytest.mark.slow
def test_many_runs_are_as_good_as_they_say():
    consistent([judged(seed) for seed in range(16)])
    consistent([judged(seed, with_map=True) for seed in range(16)])
