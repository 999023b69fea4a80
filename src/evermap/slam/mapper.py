"""Online mapping of an unmapped place: `StreamingSlam`, fed frame by frame.

Its result for a frame equals that of the stream over the whole recording, up to rounding: landmarks are numbered
as they come.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from evermap.config import SlamConfig
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import FIRST_POSE_INFORMATION
from evermap.slam.known_places import FrameSightings
from evermap.slam.localize import Located
from evermap.slam.problem import SPANS, Drive, Noise, Problem, beyond_jitter, padded
from evermap.slam.streaming import StreamingSlam
from evermap.types import UNKNOWN, FloatArray, IntArray, Landmarks, Sensor


class Growing:
    """Rows of one shape that are added at the end, at a constant cost each on average."""

    def __init__(self, *shape: int, kind: Any = np.float64) -> None:
        self._data = np.zeros((64, *shape), dtype=kind)
        self._count = 0

    @property
    def rows(self) -> Any:
        """All rows; they stay as they are when others are added at the end."""
        return self._data[: self._count]

    def add(self, rows: Any, at: int | None = None) -> None:
        """Put rows at the end, or in place of those from row `at` on."""
        first = self._count if at is None else at
        count = first + len(rows)
        if count > len(self._data):
            grown = np.zeros((2 * count, *self._data.shape[1:]), dtype=self._data.dtype)
            grown[:first] = self._data[:first]
            self._data = grown
        self._data[first:count] = rows
        self._count = count


class Mapper:
    """Feed frames in order with `step`; `noise` is where the noise levels start."""

    def __init__(self, sensor: Sensor, prior: CalibrationPrior, noise: Noise, settings: SlamConfig) -> None:
        self._stamps, self._odometry = Growing(), Growing(5)
        self._pose_row, self._landmark_row = Growing(kind=np.int64), Growing(kind=np.int64)
        self._reading, self._sigma = Growing(2), Growing(2)
        self._row: dict[int, int] = {}
        self._problem = Problem(
            stamp_s=self._stamps.rows,
            drive=Drive.from_rows(np.zeros(1), np.zeros((1, 3))),
            pose_row=self._pose_row.rows,
            landmark_row=self._landmark_row.rows,
            reading=self._reading.rows,
            sigma_given=self._sigma.rows,
            mount=np.array(sensor.mount_robot_sensor, dtype=np.float64),
            prior=prior,
            start_pose=np.zeros(3),
            start_information=FIRST_POSE_INFORMATION,
            landmark_mean=np.zeros((0, 2)),
            landmark_information=sparse.csr_array((0, 0)),
        )
        self._slam = StreamingSlam(self._problem, noise, prior, settings=settings)
        self._believed = settings.odometry
        # what was before that says nothing about a row, nor about the second that is integrated before a frame
        self._history_s = SPANS * settings.odometry.turn_s + 1.0
        self._later = False

    @property
    def states(self) -> FloatArray:
        """(11,) calibration states."""
        return self._slam.states

    def skip(self, odometry: FloatArray) -> None:
        """Take odometry as in `step`, of a frame that is left out: others will be, and are time for `work`."""
        self._drive(odometry)
        self._later = True

    def work(self) -> None:
        """Go on with what the last frame left for the time until the next one, for about a millisecond."""
        self._slam.work(1.0)

    def _drive(self, odometry: FloatArray) -> int:
        """Take odometry; returns the row of its first."""
        at = int(np.searchsorted(self._odometry.rows[:, 0], odometry[0, 0]))
        rows = self._odometry.rows[:at]
        before = rows[np.searchsorted(rows[:, 0], odometry[0, 0] - self._history_s) :, [0, 3]]
        stamp_s, turn_radps = np.concatenate([before, odometry[:, [0, 3]]]).T
        beyond = beyond_jitter(stamp_s, turn_radps, self._believed)[len(before) :]
        self._odometry.add(np.column_stack([odometry, beyond]), at)
        return at

    def step(self, stamp_s: float, odometry: FloatArray, seen: FrameSightings) -> Located:
        """Process a frame; one without a known landmark only predicts by odometry.

        Args:
            stamp_s: of the frame, on the clock of the odometry, later than the last one.
            odometry: (n, 4) stamps and velocities since the last frame at least; in place of what was given from their
                first stamp on.
            seen: its detections.

        Returns:
            Without places: the map is what is estimated.
        """
        at = self._drive(odometry)
        known = np.flatnonzero((seen.landmark_id != UNKNOWN) & np.all(np.isfinite(seen.reading), axis=1))
        if len(known):
            self._grow(stamp_s, seen, known)
            self._slam.step(later=self._later)
            self._later = False
            at = len(self._stamps.rows) - 1
            pose, covariance = self._slam.online_pose[at].copy(), self._slam.online_covariance[at].copy()
        else:
            driven = self._odometry.rows[at:]
            pose, covariance = self.ahead(stamp_s, Drive.from_rows(driven[:, 0], driven[:, 1:], self._believed))
        none, nothing = np.zeros(0, dtype=np.int64), np.full(len(seen.landmark_id), np.nan)
        place = np.full(len(nothing), UNKNOWN, dtype=np.int64)
        no = none.astype(np.bool_)
        return Located(pose, covariance, place, nothing, nothing, none, np.zeros(0), no, lost=bool(np.isnan(pose[0])))

    def ahead(self, stamp_s: float, drive: Drive) -> tuple[FloatArray, FloatArray]:
        """Return the pose (3,) at a later instant by odometry alone, and its covariance; nan before any frame."""
        if not len(self._stamps.rows):
            return np.full(3, np.nan), np.full((3, 3), np.nan)
        return self._slam.ahead(stamp_s, drive)

    def landmarks(self, landmark_id: IntArray, p_exists: float) -> Landmarks:
        """Return those of some landmarks of the newest frame that are known, each with a probability that it exists."""
        known = [name for name in np.unique(landmark_id).tolist() if name in self._row]
        position, covariance = self._slam.places(np.array([self._row[name] for name in known], dtype=np.int64))
        found = Landmarks.at(known, position, frame="first_pose")
        return replace(found, covariance_m2=covariance, p_exists=np.full(len(known), p_exists))

    def _grow(self, stamp_s: float, seen: FrameSightings, known: IntArray) -> None:
        """Pass the rows so far and the `known` ones of a frame to the stream."""
        names = seen.landmark_id[known].tolist()
        for name in names:
            self._row.setdefault(name, len(self._row))
        self._pose_row.add(np.full(len(known), len(self._stamps.rows)))
        self._stamps.add([stamp_s])
        self._landmark_row.add([self._row[name] for name in names])
        self._reading.add(seen.reading[known])
        self._sigma.add(seen.sigma_given[known])
        rows, new = self._odometry.rows, len(self._row) - len(self._problem.landmark_mean)
        information = self._problem.landmark_information
        self._problem = replace(
            self._problem,
            stamp_s=self._stamps.rows,
            drive=Drive.from_rows(rows[:, 0], rows[:, 1:], self._believed),
            pose_row=self._pose_row.rows,
            landmark_row=self._landmark_row.rows,
            reading=self._reading.rows,
            sigma_given=self._sigma.rows,
            landmark_mean=np.zeros((len(self._row), 2)),
            landmark_information=padded(information, new) if new else information,
        )
        self._slam.grow(self._problem)
