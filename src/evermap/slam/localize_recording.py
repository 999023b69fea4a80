"""A recording driven through a map that is not changed, in the plane or in space: frame by frame."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.config import Config
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.geometry.chunked import JointCovariance
from evermap.geometry.group import group_of
from evermap.sensing.visibility import NominalField
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.estimate import fed
from evermap.slam.known_places import FrameSightings, KnownPlaces
from evermap.slam.localize import BaseLocalizer, Localizer, Located
from evermap.slam.noise import START, NoiseFit
from evermap.slam.problem import Drive, Noise
from evermap.slam.ranges import RANGE_ONLY
from evermap.slam.result import dead_reckoning, described
from evermap.slam.space.intake import frames_of, path_of, start_noise, state_sigmas
from evermap.slam.space.linearise import POINT, POSE, ROWS
from evermap.slam.space.local_filter import SpatialFrame
from evermap.slam.space.localize import SpatialLocalizer, SpatialPlaces
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.slam.space.result import SCALE, mount_parameters, noise_parameters
from evermap.slam.warmup import any_filter
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    BoolArray,
    FloatArray,
    Innovations,
    IntArray,
    Landmarks,
    Misses,
    ParameterEstimate,
    Progress,
    Recording,
    Sensor,
    SlamResult,
    SpatialRecording,
    Trajectory,
)

USUAL = Config()


def localize(
    recording: Recording,
    landmarks: Landmarks,
    prior: CalibrationPrior,
    noise: Noise,
    config: Config = USUAL,
    *,
    joint_m2: JointCovariance | None = None,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Localise a recording in a map that is not changed, as `pipeline.run_localization`.

    Here, other than elsewhere, a landmark may have several rows: one a site where it may stand, with `p_exists` the
    probability of each; those of probability 0 are not looked at. `joint_m2` is the covariance of all rows together;
    None takes `covariance_m2`, and the rows to be independent. Noise levels are not estimated.

    Returns:
        Poses from the first frame on at which the robot knew where it was, `trajectory` the same as `online`; the map
        with one row a landmark, its most probable one, and the hits and misses of this recording.

    Raises:
        DataError: there is no odometry, ranges come without bearings, or the robot's place in the map could not be
            found.
    """
    if np.isnan(recording.detections.bearing_rad).any():
        raise DataError(RANGE_ONLY, field="bearing_rad", hint="enter the session, or use the map as `prior_map`")
    drive = Drive.of(recording, config.slam.odometry)
    covariance = landmarks.covariance_m2 if joint_m2 is None else joint_m2
    places = KnownPlaces.of(landmarks.landmark_id, landmarks.position_m, covariance, landmarks.p_exists).existing()
    landmarks = landmarks[np.flatnonzero(landmarks.p_exists > 0.0)]
    warm_up()
    settings, looks = config.slam.localize, config.living.looks
    localizer = Localizer(places, recording.sensor, prior.gaussian(), noise, settings=settings, looks=looks)
    seen, stamps, odometry_s = recording.detections, recording.frames.stamp_s, recording.odometry.stamp_s
    frame = np.flatnonzero((stamps >= odometry_s[0]) & (stamps <= odometry_s[-1]))

    def step(stamp_s: float, rows: slice) -> Located:
        sightings = FrameSightings(
            seen.landmark_id[rows],
            np.column_stack([seen.range_m[rows], seen.bearing_rad[rows]]),
            np.column_stack([seen.sigma_range_m[rows], seen.sigma_bearing_rad[rows]]),
        )
        return localizer.step(stamp_s - odometry_s[0], drive, sightings)

    run = _feed(recording, localizer, frame, step, realtime=realtime, progress=progress)
    fit = NoiseFit(noise, np.zeros_like(noise.detection), np.zeros_like(noise.odometry))
    parameters = described(localizer.states, localizer.states_covariance, fit, prior)
    result = _result(run, parameters, landmarks)
    return replace(result, dead_reckoning=dead_reckoning(result.trajectory, drive, odometry_s[0]))


def localize_in_space(
    recording: SpatialRecording,
    landmarks: Landmarks,
    config: Config = USUAL,
    *,
    joint_m2: JointCovariance | None = None,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Localise a recording in space, as `localize` in the plane; its odometry may be missing.

    Noise levels are learned from frame to frame. Detections of which only the direction was seen are not used, nor are
    delays of sensors estimated.

    Raises:
        DataError: the robot's place in the map could not be found.
    """
    warm_up_in_space()
    settings, driven = config.slam.space, recording.odometry is not None
    covariance = landmarks.covariance_m2 if joint_m2 is None else joint_m2
    places = SpatialPlaces.in_space(landmarks, covariance, settings)
    landmarks = landmarks[np.flatnonzero(landmarks.p_exists > 0.0)]
    seen, symmetries = frames_of(recording, settings)
    stamps, given = recording.frames.stamp_s, recording.detections
    start_s = float(stamps[0]) if recording.odometry is None else float(recording.odometry.stamp_s[0])
    drive, noise = path_of(recording, start_s), start_noise(settings, driven=driven)
    sigma = state_sigmas(recording.sensors, settings, driven=driven)
    mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])
    localizer = SpatialLocalizer(
        places, mount, sigma, noise, driven=driven, symmetries=symmetries, settings=config.slam.localize, space=settings
    )
    usable = seen.readable & (given.landmark_id != UNKNOWN)
    if recording.odometry is None:  # between frames with a landmark it may be anywhere
        frame = np.unique(given.frame[usable])
    else:
        frame = np.flatnonzero((stamps >= start_s) & (stamps <= recording.odometry.stamp_s[-1]))

    def step(stamp_s: float, rows: slice) -> Located:
        return localizer.step(stamp_s - start_s, drive, seen.rows(np.arange(rows.start, rows.stop)))

    run = _feed(recording, localizer, frame, step, realtime=realtime, progress=progress)
    spread = np.sqrt(np.diag(localizer.states_covariance))
    kind = seen.kind[usable]
    parameters = noise_parameters(localizer.noise, noise, kind, np.zeros(len(kind), dtype=np.bool_), driven=driven)
    for row, sensor in enumerate(recording.sensors):
        at = slice(6 * row, 6 * row + 6)
        parameters += mount_parameters(sensor.name, localizer.states[at], spread[at], sigma[at])
    if sigma[-1] > 0.0:
        scale = float(np.exp(localizer.states[-1]))
        of_scale = float(scale * spread[-1]), 1.0, float(sigma[-1])
        parameters.append(ParameterEstimate("odometry_scale", scale, *of_scale, "", meaning=SCALE))
    result = _result(run, tuple(parameters), landmarks)
    turned = np.isfinite(places.rotation[np.maximum(run.all("place"), 0), 0])[run.all("place") != UNKNOWN]
    dof = ROWS[np.where(turned, seen.kind[result.innovations.detection], POINT)]
    path = result.trajectory
    driven_pose = np.zeros((0, 7))
    if drive is not None:
        driven_pose = se3.interpolate(*drive, path.stamp_s - start_s)
        driven_pose = se3.compose(path.pose_world_robot[:1], se3.between(driven_pose[:1], driven_pose))
    count = len(driven_pose)
    alone = Trajectory(path.stamp_s[:count], driven_pose, np.zeros((count, 6, 6)), path.frame, path.clock)
    return replace(result, innovations=replace(result.innovations, dof=dof), dead_reckoning=alone)


@dataclass(frozen=True, slots=True)
class _Run:
    """Results of the frames.

    Attributes:
        recording, localizer: what was fed, and to whom; in the plane or in space.
        frame: (F,) rows of `Recording.frames` that were processed.
        first: (F,) row of the first detection of each.
        located: one a frame.
        step_s: (F,) seconds that each took.
        interrupted: True where the recording goes on.
    """

    recording: AnyRecording
    localizer: BaseLocalizer
    frame: IntArray
    first: IntArray
    located: list[Located]
    step_s: FloatArray
    interrupted: bool

    @property
    def placed(self) -> BoolArray:
        """(F,) frames with a pose."""
        return np.array([bool(np.isfinite(one.pose[0])) for one in self.located], dtype=np.bool_)

    def all(self, name: str) -> Any:
        """Return one column of all frames, one row a detection."""
        return np.concatenate([getattr(one, name) for one in self.located])

    @property
    def detection(self) -> IntArray:
        """Rows of `Recording.detections` in these frames."""
        rows = [first + np.arange(len(one.place)) for first, one in zip(self.first, self.located, strict=True)]
        return np.concatenate(rows).astype(np.int64)

    @property
    def innovations(self) -> Innovations:
        """Innovations of every detection that was compared with the map."""
        told, seen = self.all("place") != UNKNOWN, self.recording.detections
        rows = self.detection[told]
        return Innovations(
            stamp_s=self.recording.frames.stamp_s[seen.frame[rows]],
            detection=rows,
            landmark_id=seen.landmark_id[rows],
            nis=self.all("nis")[told],
            p_inlier=self.all("p_inlier")[told],
        )

    @property
    def misses(self) -> Misses:
        """Landmarks that were well in view and not detected."""
        missed = self.all("missed")
        count = [int(one.missed.sum()) for one in self.located]
        return Misses(
            frame=np.repeat(self.frame, count),
            landmark_id=self.localizer.places.landmark_id[self.all("expected")[missed]],
            p_detect=self.all("p_detect")[missed],
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was not used, and where the pose was not known."""
        names = self.recording.detections.landmark_id[self.detection]
        anonymous = int((names == UNKNOWN).sum())
        strange = int((~np.isin(names, self.localizer.places.landmark_id)).sum()) - anonymous
        at = int(np.argmax(self.placed))
        blind = float(np.ptp(self.recording.frames.stamp_s[self.frame[: at + 1]]))
        searching = int(sum(one.lost for one in self.located[at:]))
        said = {
            f"{anonymous} detections without identity not used": anonymous,
            f"{strange} detections of landmarks that are not in the map not used": strange,
            f"the robot was localised in the map after {blind:.1f} s; there are no poses before": at,
            f"in {searching} frames the map did not fit, and the pose was searched for": searching,
        }
        return tuple(text for text, count in said.items() if count)


def _feed(
    recording: AnyRecording,
    localizer: BaseLocalizer,
    frame: IntArray,
    step: Callable[[float, slice], Located],
    *,
    realtime: bool,
    progress: Progress | None,
) -> _Run:
    """Feed frames (F,), one after the other: `step` takes a stamp and rows of detections.

    Raises:
        DataError: the robot's place in the map could not be found.
    """
    stamps, seen = recording.frames.stamp_s, recording.detections
    first, last = np.searchsorted(seen.frame, frame), np.searchsorted(seen.frame, frame, side="right")
    located: list[Located] = []
    step_s, interrupted = fed(
        stamps[frame],
        lambda row: located.append(step(float(stamps[frame[row]]), slice(int(first[row]), int(last[row])))),
        realtime=realtime,
        progress=progress,
    )
    done = len(step_s)
    run = _Run(recording, localizer, frame[:done], first[:done], located[:done], step_s, interrupted)
    if not run.placed.any():
        problem = "cannot localise in the map: too few of the detected landmarks have the relative positions of the map"
        raise DataError(f"{recording.name}: {problem}", hint="check that it is the map of this place")
    return run


def _result(run: _Run, parameters: tuple[ParameterEstimate, ...], landmarks: Landmarks) -> SlamResult:
    """Return what the frames said, as plain arrays; without dead reckoning."""
    recording, placed, misses = run.recording, run.placed, run.misses
    pose = np.array([one.pose for one in run.located])[placed]
    pose = group_of(pose).normalise_poses(pose)
    spread = np.array([one.covariance for one in run.located])[placed]
    stamp_s = recording.frames.stamp_s[run.frame[placed]]
    trajectory = Trajectory(stamp_s, pose, spread, frame="prior_map", clock=recording.clock)
    return SlamResult(
        trajectory=trajectory,
        online=trajectory,
        landmarks=_with_counts(landmarks, run, misses),
        parameters=parameters,
        innovations=run.innovations,
        misses=misses,
        step_s=run.step_s[placed],
        dead_reckoning=trajectory,
        warnings=run.warnings,
        interrupted=run.interrupted,
    )


@functools.cache
def warm_up() -> None:
    """Compile all kernels, or load them, so that no frame has to wait: two frames of landmarks, one with two places."""
    at = np.array([[2.0, 0.0], [0.0, 2.0], [2.0, 2.0], [3.0, 3.0]])
    places = KnownPlaces.of(np.array([0, 1, 2, 2]), at, np.tile(np.eye(2), (4, 1, 1)), np.full(4, 0.5))
    sensor, prior = Sensor(range_max_m=5.0), CalibrationPrior.from_settings(calibrated=True)
    localizer = Localizer(places, sensor, prior, START)
    reading = np.column_stack([np.hypot(*at[:3].T), np.arctan2(at[:3, 1], at[:3, 0])])
    seen = FrameSightings(np.arange(3), reading, np.full((3, 2), np.nan))
    for stamp_s in (0.0, 0.1):
        localizer.step(stamp_s, Drive.from_rows(np.array([0.0, 0.1]), np.zeros((2, 3))), seen)
    NominalField(sensor).p_detect(np.zeros((1, 3)), at)  # for places that are believed to exist


@functools.cache
def warm_up_in_space() -> None:
    """Compile, or load, what the frames of `localize_in_space` need: two of a tag and three points."""
    at = se3.exp(np.hstack([[[3.0, 0.0, 0.0], [3.0, 1.0, 0.0], [3.0, 0.0, 1.0], [4.0, 1.0, 1.0]], np.zeros((4, 3))]))
    known = Landmarks.in_space(np.arange(4), at[:, :3], rotation=np.where(np.arange(4)[:, None], np.nan, at[:, 3:]))
    places = SpatialPlaces.in_space(replace(known, p_exists=np.ones(4)), np.tile(np.eye(3), (4, 1, 1)))
    localizer = SpatialLocalizer(places, se3.identity(1), np.zeros(7), SpatialNoise(), driven=True)
    kind, nothing = np.where(np.arange(4) == 0, POSE, POINT), np.zeros(4)
    seen = SpatialFrame(
        np.arange(4), np.ones(4, dtype=np.bool_), np.zeros(4, dtype=np.int64), kind, np.stack([at, at]), nothing,
        np.tile(np.eye(3), (4, 1, 1)), np.ones(4), np.zeros((4, 4, 2)), np.zeros((4, 4, 2, 2)), nothing,
        np.zeros(4, dtype=np.int64),
    )  # fmt: skip
    path = OdometryPath(np.array([0.0, 1.0]), se3.identity(2))
    for stamp_s in (0.0, 0.1):
        localizer.step(stamp_s, path, seen)
    any_filter()


def _with_counts(landmarks: Landmarks, run: _Run, misses: Misses) -> Landmarks:
    """Return one row per landmark, with the hits and misses of this recording."""
    best = landmarks[np.argsort(landmarks.landmark_id, kind="stable")[run.localizer.places.most_probable()]]
    names, hit = best.landmark_id, run.detection[run.all("p_inlier") > 0.5]
    n_hits, n_misses = (
        np.bincount(np.searchsorted(names, seen), minlength=len(names)).astype(np.int64)
        for seen in (run.recording.detections.landmark_id[hit], misses.landmark_id)
    )
    return replace(best, n_hits=n_hits, n_misses=n_misses, frame="prior_map")
