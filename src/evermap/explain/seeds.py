"""First values of scales, by what needs no solution or no more of it than poses: a linear test may be far off there.

* Two landmarks in one frame are as far apart as in the map: ranges against the map.
* And as for another sensor at another time: ranges of one sensor against those of the others.
* Two sightings of one landmark and the odometry between them: ranges against the odometry.
* Landmarks of a solution that was not found in a map, against the map: all lengths.
* Directions from several poses meet at the landmark, which says how far it was: ranges of one landmark.
* Ranges alone of one landmark against its distance from the poses: what they are too long by.
* Two sightings of one landmark and the odometry between them, in turns: where the sensor sits on the robot.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.config import CheckConfig
from evermap.estimate.robust import MEDIAN_TO_SIGMA
from evermap.estimate.tie import find_nearest
from evermap.explain.expectations import USED, PlanarCalibration, has_bearing
from evermap.geometry import se2, se3
from evermap.slam.clocks import FALLS, find_pair_loss
from evermap.slam.mistake_search import find_motion
from evermap.slam.mistakes import HONEST, Mistake
from evermap.slam.pairs import off, pairs_of
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    BoolArray,
    FloatArray,
    IntArray,
    Landmarks,
    Recording,
    SlamResult,
    is_in_space,
)

LARGEST, STEPS = 0.7, 141
"""Largest logarithm of a scale that is tried, and steps from the smallest to that."""
APART_M, FEWEST_APART = 1.0, 8
"""Distance between two landmarks from which its ratio tells a scale, and how many of these it takes."""
FEWEST_OF_PAIR, STEADY = 3, 0.03
"""Times that a sensor must see two landmarks at once, and median deviation of the logarithm of their distance, up to
which it is one that sensors can be compared by."""
ERROR_OF_MEDIAN, TIMES_SIGMA = 1.86, 5.0
"""Standard deviation of a median of normal numbers, over their median deviation, and by their root; and times that from
which it is not 0."""
FEWEST_VIEWS, PARALLAX = 6, 0.02
"""Views of a landmark, and the least share of them that are crosswise, from which directions say how far it is."""
ALIKE, ALIKE_SHARE = 0.1, 0.15
"""Difference of logarithms of that distance over the ranges, and share of it, within which four fifths of the views
agree on a size."""
BIAS_STEPS, ALONG_ONE = 20, 1e-6
"""Steps towards the place of a landmark and what its ranges are too long by; and the least share of the views by which
these are not seen along one line.
"""
MOUNT_STEPS = 8
"""Steps towards the place of a sensor."""
MOST_PAIRS = 4000
"""Pairs of a kind that are looked at: more say no more."""


class Scales(NamedTuple):
    """Logarithms of scales, nan where nothing tells.

    Attributes:
        by_map: of distances in the map over those of the detections.
        by_odometry: of distances by the odometry over those of the detections.
    """

    by_map: float
    by_odometry: float

    @property
    def ranges(self) -> float:
        """Return that of true distances over ranges, if the map is right, else the odometry."""
        return self.by_map if math.isfinite(self.by_map) else self.by_odometry

    @property
    def odometry(self) -> float:
        """Return that of true distances over those of the odometry: by the map, else by the ranges."""
        return (self.by_map if math.isfinite(self.by_map) else 0.0) - self.by_odometry

    @property
    def map(self) -> float:
        """Return that of true distances over those of the map, if ranges are right."""
        return -self.by_map


def find_scales(recording: AnyRecording, given: Landmarks | None, settings: CheckConfig) -> Scales:
    """Return scales between detections, odometry and map."""
    return Scales(_against_map(recording, given), _against_odometry(recording, settings))


def _against_map(recording: AnyRecording, given: Landmarks | None) -> float:
    if given is None:
        return math.nan
    seen = recording.detections
    at, known = positions_in_robot(recording)
    row = np.minimum(np.searchsorted(given.landmark_id, seen.landmark_id), len(given.landmark_id) - 1)
    known &= given.landmark_id[row] == seen.landmark_id
    rows = np.flatnonzero(known)
    pairs = [(rows[:-lag], rows[lag:]) for lag in (1, 2, 3) if lag < len(rows)]
    if not pairs:
        return math.nan
    one, other = (np.concatenate(part) for part in zip(*pairs, strict=True))
    same = (seen.frame[one] == seen.frame[other]) & (row[one] != row[other])
    one, other = one[same], other[same]
    if len(one) > MOST_PAIRS:
        some = np.linspace(0, len(one) - 1, MOST_PAIRS).astype(np.int64)
        one, other = one[some], other[some]
    dim = min(at.shape[1], given.position_m.shape[1])
    seen_m = np.linalg.norm(at[one, :dim] - at[other, :dim], axis=1)
    given_m = np.linalg.norm(given.position_m[row[one], :dim] - given.position_m[row[other], :dim], axis=1)
    far = (seen_m > 0.1 * np.linalg.norm(at[one], axis=1)) & (given_m > 0.0)
    return float(np.median(np.log(given_m[far] / seen_m[far]))) if np.count_nonzero(far) >= FEWEST_APART else math.nan


def find_sensor_scales(recording: AnyRecording, asked: BoolArray) -> FloatArray:
    """Return (S,) logarithms of true distances over those that each sensor in space measures, if another one is right.

    Two landmarks that are seen at once are as far apart for every sensor, wherever it is mounted and whenever it looks.
    A sensor that agrees with another one has 0, and so has one of which nothing tells; of several others that it
    contradicts it is compared with the nearest.

    Args:
        recording: with identities.
        asked: (S,) sensors that are compared.
    """
    found = np.zeros(len(asked))
    if not is_in_space(recording) or np.count_nonzero(asked) < 2:
        return found
    seen = recording.detections
    at, known = positions_in_robot(recording)
    rows = np.flatnonzero(known & asked[seen.sensor])
    rows = rows[np.lexsort((seen.landmark_id[rows], seen.sensor[rows], seen.frame[rows]))]
    pairs = [(rows[:-lag], rows[lag:]) for lag in (1, 2, 3) if lag < len(rows)]
    if not pairs:
        return found
    one, other = (np.concatenate(part) for part in zip(*pairs, strict=True))
    apart_m, names = np.linalg.norm(at[one] - at[other], axis=1), seen.landmark_id
    used = (seen.frame[one] == seen.frame[other]) & (seen.sensor[one] == seen.sensor[other])
    used &= (names[one] != names[other]) & (apart_m > 0.1 * np.linalg.norm(at[one], axis=1))
    one, other, log_m = one[used], other[used], np.log(apart_m[used])
    pair = np.unique(np.column_stack([names[one], names[other]]), axis=0, return_inverse=True)[1].ravel()
    table = _find_steady(log_m, pair, seen.sensor[one], len(asked))
    for sensor in range(len(asked)):
        off = [_find_level(others - table[sensor]) for k, others in enumerate(table) if k != sensor]
        told = [one for one in off if math.isfinite(one)]
        found[sensor] = min(told, key=abs, default=0.0)
    return found


def _find_steady(value: FloatArray, pair: IntArray, sensor: IntArray, n_sensors: int) -> FloatArray:
    """Return (S, K) medians of the values of each pair by each sensor, nan where they are few, or scatter: distances of
    what is seen with much noise are too long.
    """
    table = np.full((n_sensors, int(pair.max(initial=-1)) + 1), math.nan)
    order = np.lexsort((pair, sensor))
    key = sensor[order] * table.shape[1] + pair[order]
    for mine in np.split(order, np.flatnonzero(np.diff(key)) + 1):
        if len(mine) >= FEWEST_OF_PAIR:
            middle = float(np.median(value[mine]))
            if np.median(np.abs(value[mine] - middle)) < STEADY:
                table[sensor[mine[0]], pair[mine[0]]] = middle
    return table


def _find_level(off: FloatArray) -> float:
    """Return the median of differences, 0 where it is not significant; nan where they are few."""
    off = off[np.isfinite(off)]
    if len(off) < FEWEST_APART:
        return math.nan
    level = float(np.median(off))
    sigma = ERROR_OF_MEDIAN * float(np.median(np.abs(off - level))) / math.sqrt(len(off))
    return level if abs(level) > TIMES_SIGMA * sigma else 0.0


def positions_in_robot(recording: AnyRecording) -> tuple[FloatArray, np.ndarray]:
    """Return (M, dim) positions of detections in the robot's frame, and (M,) which are known."""
    if is_in_space(recording):
        from evermap.slam.space.intake import positions_of, without_range

        mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])[recording.detections.sensor]
        at = positions_of(recording)
        known = np.isfinite(at).all(axis=1) & ~without_range(recording)
        return se3.transform(mount, np.where(known[:, None], at, 0.0)), known & (
            recording.detections.landmark_id != UNKNOWN
        )
    seen = recording.detections
    known = np.isfinite(seen.bearing_rad) & (seen.landmark_id != UNKNOWN)
    bearing = np.nan_to_num(seen.bearing_rad)
    at = seen.range_m[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    return se2.transform(np.array(recording.sensor.mount_robot_sensor, dtype=np.float64), at), known


def _against_odometry(recording: AnyRecording, settings: CheckConfig) -> float:
    pairs = pairs_of(recording, settings)
    if pairs is None or pairs.still:
        return math.nan
    tried = np.linspace(-LARGEST, LARGEST, STEPS)
    losses = [find_pair_loss(pairs, settings, Mistake("", "", lengths=math.exp(state))) for state in tried.tolist()]
    return float(tried[int(np.argmin(losses))])


def find_mount(recording: Recording, settings: CheckConfig) -> FloatArray:
    """Return (3,) by how much the mount [m, m, rad] must move for landmarks to stand still; zeros if nothing says so.

    Gauss-Newton steps with Cauchy's weights; a solution would take a sensor that sits elsewhere for lateral slip.
    """
    stated, by = np.array(recording.sensor.mount_robot_sensor, dtype=np.float64), np.zeros(3)
    pairs = pairs_of(recording, settings)
    if pairs is None or pairs.still or find_motion(recording, settings):
        return by

    def residual(moved: FloatArray) -> FloatArray:
        sensor = replace(recording.sensor, mount_robot_sensor=tuple((stated + moved).tolist()))
        here = pairs_of(replace(recording, sensor=sensor), settings)
        assert here is not None
        return np.asarray(here.residual(HONEST)[0])

    def loss(apart: FloatArray) -> float:
        return float(np.log1p((np.minimum(off(apart), 10.0) / settings.fits) ** 2).sum())

    at = residual(by)
    before = least = loss(at)
    for _ in range(MOUNT_STEPS):
        weight = 1.0 / (1.0 + (off(at) / settings.fits) ** 2)
        slope = np.stack([(residual(by + step) - at) / 1e-4 for step in 1e-4 * np.eye(3)])
        normal = np.einsum("ikp,jkp,p->ij", slope, slope, weight)
        step = np.linalg.lstsq(normal, -np.einsum("ikp,kp,p->i", slope, at, weight), rcond=1e-6)[0]
        there = residual(by + step)
        if not loss(there) < least:
            break
        by, at, least = by + step, there, loss(there)
    return by if before - least > max(settings.gain, FALLS * before) else np.zeros(3)


def find_shape(result: SlamResult, given: Landmarks) -> float:
    """Return the logarithm of distances in a map over those in a result that was not found there; nan for too few."""
    _, own, theirs = np.intersect1d(result.landmarks.landmark_id, given.landmark_id, return_indices=True)
    one, other = np.triu_indices(len(own), 1)
    if len(one) > MOST_PAIRS:
        some = np.linspace(0, len(one) - 1, MOST_PAIRS).astype(np.int64)
        one, other = one[some], other[some]
    dim = min(result.landmarks.position_m.shape[1], given.position_m.shape[1])
    found_m, given_m = (
        np.linalg.norm(at[one, :dim] - at[other, :dim], axis=1)
        for at in (result.landmarks.position_m[own], given.position_m[theirs])
    )
    far = (found_m > APART_M) & (given_m > 0.0)
    return float(np.median(np.log(given_m[far] / found_m[far]))) if np.count_nonzero(far) >= 3 else math.nan


def find_single_scales(recording: AnyRecording, result: SlamResult) -> dict[int, float]:
    """Return, of landmarks most of whose detections were rejected, the logarithm of true distances over ranges.

    By where the directions from the poses of the solution meet.
    """
    seen, path, found = recording.detections, result.trajectory, dict[int, float]()
    kept = _find_kept(recording, result)
    eye, along, range_m, known = _rays(recording, path.stamp_s, path.pose_world_robot)
    names = np.unique(seen.landmark_id[known])
    for name in names.tolist():
        mine = np.flatnonzero(known & (seen.landmark_id == name))
        if len(mine) < FEWEST_VIEWS or np.mean(kept[mine]) > 0.5:
            continue
        ratio = _where_rays_meet(eye[mine], along[mine], range_m[mine])
        if math.isfinite(ratio):
            found[int(name)] = ratio
    return found


def find_single_biases(recording: AnyRecording, result: SlamResult, given: Landmarks | None) -> dict[int, float]:
    """Return by how much ranges of landmarks in the plane are too long [m], from the poses of the solution: of those
    that are seen by ranges alone, and that changed or most of whose detections were rejected.

    A landmark of the given map is where that has it, another one where its ranges fit best, with what they are too long
    by.
    """
    if is_in_space(recording) or not len(result.trajectory):
        return {}
    seen, path, found = recording.detections, result.trajectory, dict[int, float]()
    kept = _find_kept(recording, result)
    changed = {one for change in result.changes for one in change.landmark_ids}
    sensor = PlanarCalibration(result.parameters)
    read_m = (seen.range_m - sensor["range_bias_m"]) / (1.0 + sensor["range_slope"])
    robot = path.pose_world_robot[find_nearest(path.stamp_s, recording.frames.stamp_s[seen.frame])]
    eye = se2.compose(robot, np.array(recording.sensor.mount_robot_sensor, dtype=np.float64))[:, :2]
    by_range = ~has_bearing(recording) & (seen.landmark_id != UNKNOWN)
    places = result.landmarks if given is None or path.frame != "prior_map" else given
    for name in np.unique(seen.landmark_id[by_range]).tolist():
        mine = np.flatnonzero(by_range & (seen.landmark_id == name))
        if len(mine) < FEWEST_VIEWS or not (name in changed or np.mean(kept[mine]) < 0.5):
            continue
        if not len(place := places.position_m[places.landmark_id == name]):
            continue
        if places is given:
            found[name] = float(np.median(read_m[mine] - np.linalg.norm(eye[mine] - place[0, :2], axis=1)))
        else:
            found[name] = _fit_bias(eye[mine], read_m[mine], place[0, :2])
    return found


def _find_kept(recording: AnyRecording, result: SlamResult) -> BoolArray:
    """Return (M,) which detections the estimator used."""
    kept = np.zeros(len(recording.detections), dtype=np.bool_)
    kept[result.innovations.detection[result.innovations.p_inlier >= USED]] = True
    return kept


def _fit_bias(eye: FloatArray, read_m: FloatArray, place: FloatArray) -> float:
    """Return by how much ranges (M,) from positions (M, 2) are too long, from a first place (2,) to the one that fits
    them best (Gauss-Newton with Cauchy's weights); nan if it is not significant.
    """
    at = np.append(place, 0.0)
    for _ in range(BIAS_STEPS):
        away = at[:2] - eye
        far = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        left = read_m - far - at[2]
        slope = np.column_stack([away / far[:, None], np.ones(len(far))])
        scale = max(float(np.median(np.abs(left))), 1e-3)
        weight = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2)
        normal = slope.T @ (weight[:, None] * slope)
        if np.linalg.eigvalsh(normal)[0] < ALONG_ONE * weight.sum():
            return math.nan
        at += np.linalg.solve(normal, slope.T @ (weight * left))
    sigma = MEDIAN_TO_SIGMA * scale * float(np.sqrt(np.linalg.inv(normal)[2, 2]))
    return float(at[2]) if abs(at[2]) > TIMES_SIGMA * sigma else math.nan


def _rays(
    recording: AnyRecording, stamp_s: FloatArray, pose: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, np.ndarray]:
    """(M, dim) where detections were made from, (M, dim) unit vectors, (M,) ranges, and (M,) which are known."""
    at, known = positions_in_robot(recording)
    seen_s = recording.frames.stamp_s[recording.detections.frame]
    robot = pose[find_nearest(stamp_s, seen_s)]
    if is_in_space(recording):
        mounts = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])[recording.detections.sensor]
        eye, there = se3.compose(robot, mounts)[:, :3], se3.transform(robot, at)
    else:
        mount = np.array(recording.sensor.mount_robot_sensor, dtype=np.float64)
        eye, there = se2.compose(robot, mount)[:, :2], se2.transform(robot, at)
    away = there - eye
    range_m = np.linalg.norm(away, axis=1)
    return eye, away / np.maximum(range_m, 1e-9)[:, None], range_m, known


def _where_rays_meet(eye: FloatArray, along: FloatArray, range_m: FloatArray) -> float:
    """Log of the distance to where rays meet over the ranges along them, in the median; nan where it does not show, or
    is another one from elsewhere: then it is no size.
    """
    dim = eye.shape[1]
    weight = np.ones(len(eye))
    point = eye[0]
    for _ in range(10):  # to the point that most rays pass
        across = weight[:, None, None] * (np.eye(dim) - along[:, :, None] * along[:, None, :])
        total = across.sum(axis=0)
        if np.linalg.eigvalsh(total)[0] < PARALLAX * weight.sum():
            return math.nan
        point = np.linalg.solve(total, np.einsum("mij,mj->i", across, eye))
        away = point - eye
        miss = np.linalg.norm(away - (away * along).sum(axis=1)[:, None] * along, axis=1)
        weight = 1.0 / (1.0 + (miss / max(float(np.median(miss)), 1e-3)) ** 2)
    far = ((point - eye) * along).sum(axis=1)
    ahead = far > 0.1 * range_m
    if np.count_nonzero(ahead) < FEWEST_VIEWS:
        return math.nan
    ratio = np.log(far[ahead] / range_m[ahead])
    usual, spread = float(np.median(ratio)), float(np.ptp(np.quantile(ratio, (0.1, 0.9))))
    return usual if spread < max(ALIKE, ALIKE_SHARE * abs(usual)) else math.nan
