"""A recording driven through a map that is not changed: the frames in order, and what comes out as plain arrays."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.config import Config
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.geometry.chunked import JointCovariance
from evermap.sensing.visibility import NominalField
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.estimate import fed
from evermap.slam.known_places import KnownPlaces
from evermap.slam.localize import FrameSightings, Localizer, Located
from evermap.slam.noise import START, NoiseFit
from evermap.slam.problem import Drive, Noise
from evermap.slam.ranges import RANGE_ONLY
from evermap.slam.result import dead_reckoning, described
from evermap.types import (
    UNKNOWN,
    BoolArray,
    FloatArray,
    Innovations,
    IntArray,
    Landmarks,
    Misses,
    Progress,
    Recording,
    Sensor,
    SlamResult,
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
    run = _feed(localizer, recording, drive, realtime=realtime, progress=progress)
    if not run.placed.any():
        problem = "cannot localise in the map: too few of the detected landmarks have the relative positions of the map"
        raise DataError(f"{recording.name}: {problem}", hint="check that it is the map of this place")
    return _result(run, prior, drive, landmarks)


@dataclass(frozen=True, slots=True)
class _Run:
    """Results of the frames.

    Attributes:
        recording, localizer: what was fed, and to whom.
        frame: (F,) rows of `Recording.frames` that were processed.
        first: (F,) row of the first detection of each.
        located: one a frame.
        step_s: (F,) seconds that each took.
        interrupted: True where the recording goes on.
    """

    recording: Recording
    localizer: Localizer
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
    localizer: Localizer, recording: Recording, drive: Drive, *, realtime: bool, progress: Progress | None
) -> _Run:
    """Frame after frame, while there is odometry, through the filter."""
    seen, stamps, odometry_s = recording.detections, recording.frames.stamp_s, recording.odometry.stamp_s
    frame = np.flatnonzero((stamps >= odometry_s[0]) & (stamps <= odometry_s[-1]))
    first, last = np.searchsorted(seen.frame, frame), np.searchsorted(seen.frame, frame, side="right")
    located: list[Located] = []

    def step(row: int) -> None:
        low, high = first[row], last[row]
        sightings = FrameSightings(
            seen.landmark_id[low:high],
            np.column_stack([seen.range_m[low:high], seen.bearing_rad[low:high]]),
            np.column_stack([seen.sigma_range_m[low:high], seen.sigma_bearing_rad[low:high]]),
        )
        located.append(localizer.step(stamps[frame[row]] - odometry_s[0], drive, sightings))

    step_s, interrupted = fed(stamps[frame], step, realtime=realtime, progress=progress)
    done = len(step_s)
    return _Run(recording, localizer, frame[:done], first[:done], located[:done], step_s, interrupted)


def _result(run: _Run, prior: CalibrationPrior, drive: Drive, landmarks: Landmarks) -> SlamResult:
    """Return what the frames said, as plain arrays."""
    recording, localizer, placed, misses = run.recording, run.localizer, run.placed, run.misses
    pose = np.array([one.pose for one in run.located])[placed]
    pose[:, 2] = se2.wrap(pose[:, 2])
    spread = np.array([one.covariance for one in run.located])[placed]
    stamp_s = recording.frames.stamp_s[run.frame[placed]]
    trajectory = Trajectory(stamp_s, pose, spread, frame="prior_map", clock=recording.clock)
    noise = localizer.noise
    fit = NoiseFit(noise, np.zeros_like(noise.detection), np.zeros_like(noise.odometry))
    return SlamResult(
        trajectory=trajectory,
        online=trajectory,
        landmarks=_with_counts(landmarks, run, misses),
        parameters=described(localizer.states, localizer.states_covariance, fit, prior),
        innovations=run.innovations,
        misses=misses,
        step_s=run.step_s[placed],
        dead_reckoning=dead_reckoning(trajectory, drive, recording.odometry.stamp_s[0]),
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


def _with_counts(landmarks: Landmarks, run: _Run, misses: Misses) -> Landmarks:
    """Return one row per landmark, with the hits and misses of this recording."""
    best = landmarks[np.argsort(landmarks.landmark_id, kind="stable")[run.localizer.places.most_probable()]]
    names, hit = best.landmark_id, run.detection[run.all("p_inlier") > 0.5]
    n_hits, n_misses = (
        np.bincount(np.searchsorted(names, seen), minlength=len(names)).astype(np.int64)
        for seen in (run.recording.detections.landmark_id[hit], misses.landmark_id)
    )
    return replace(best, n_hits=n_hits, n_misses=n_misses, frame="prior_map")
