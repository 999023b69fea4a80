"""Signs of how far a run can be trusted, none of which needs the truth; the same in the plane and in space.

Each compares two sources that a sound run makes agree: a detection with the landmark where the map has it, the first
half of the drive with the second, odometry with the trajectory, a calibration with its prior, a given map with what was
found. Values are numbers; what they should be is decided by `explain.verdict`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isnan, nan

import numpy as np

from evermap.estimate.innovations import comparable_nis, lag1_autocorrelation
from evermap.explain.scores import SessionScores
from evermap.geometry import se2, se3
from evermap.slam.association.features import medians
from evermap.slam.gaps import find_gaps, is_outside
from evermap.slam.ranges import compare_with_mirrored
from evermap.types import (
    ANY_BEARING_RAD,
    UNKNOWN,
    AnyRecording,
    BoolArray,
    ChangeKind,
    FloatArray,
    Innovations,
    IntArray,
    Landmarks,
    Odometry,
    ParameterEstimate,
    Recording,
    SlamResult,
    SpatialOdometry,
    Trajectory,
    is_in_space,
)

USED = 0.5
"""Probability to be no outlier from which a detection counts as used, as in the metrics."""
FEWEST = 10
"""Values of which a median says something: half of them are wrong by chance in one of a thousand cases."""
FARTHEST_S = 0.1
"""Time between a frame and the pose it is compared with; trajectories in the plane have one every so often."""
STRETCHES = 10
"""Parts of a drive of which the worst is looked for."""
WINDOWS = 40
"""Parts of a drive by which odometry and trajectory are compared: long over the noise, short against drift."""
SHORTEST_S = 2.0
LEAST_MOTION_M = 0.05
"""Motion within a window, below which the robot stands: its relative error says nothing."""
PER_LANDMARK = 5
"""Detections of a landmark, in each half of the drive, of which a mean says something."""
LATE_S, EARLY_S = 0.14, 0.05
"""Delay up to which the odometry is taken to be what is late, by its filters and bridges; a longer one is as well the
sensor's, whose readings are processed. And by how much odometry may seem early, as two clocks differ: no driver stamps
what has not happened yet, so that by more it is the sensor that is late."""
SURELY = 2.0
"""Standard deviations by which a delay must be one, and an early odometry be earlier than that."""
LEAST_STREAK = 0.2
"""Share of its detections that a landmark is contradicted by in a row: fewer may be one bad look."""


@dataclass(frozen=True, slots=True)
class Compared:
    """Detections beside where the map expects them, one row each, as a detection would have read them without noise.

    Attributes:
        detection: (K,) row of the recording's detections.
        taken_s, landmark_id, used: (K,) when, by the clock of the poses, of which landmark, and whether it is used.
        range_m: (K,) expected range.
        off: (K, D) detection less expectation over the expected range; of ranges only one number.
        point_m: (K, D) where detections are in the robot's frame; nan where they have a direction or a range only.
    """

    detection: IntArray
    taken_s: FloatArray
    landmark_id: IntArray
    used: BoolArray
    range_m: FloatArray
    off: FloatArray
    point_m: FloatArray

    @property
    def misfit(self) -> FloatArray:
        """Return (K,) lengths of what detections are off by, over their ranges."""
        return np.asarray(np.linalg.norm(self.off, axis=1))


def compare_detections(recording: AnyRecording, result: SlamResult) -> Compared:
    """Return detections beside expectations, of those that have both, in the plane with the estimated calibration."""
    innovations, places = result.innovations, result.landmarks
    row, known = _rows_of(places, innovations.landmark_id)
    rows = np.minimum(innovations.detection, max(len(recording.detections) - 1, 0))
    taken_s = innovations.stamp_s - _find_delays_s(recording, result)[rows]
    pose, near = find_poses_at(result.trajectory, taken_s)
    keep = np.flatnonzero(known & near & (innovations.detection < len(recording.detections)))
    detection, row, pose = innovations.detection[keep], row[keep], pose[keep]
    if is_in_space(recording):
        from evermap.slam.space.intake import positions_of, without_range

        mounts = np.array([one.mount_robot_sensor for one in recording.sensors])
        mounts = mounts[recording.detections.sensor[detection]]
        expected = se3.transform(se3.inverse(se3.compose(pose, mounts)), places.position_m[row])
        read = positions_of(recording)[detection]
        range_m = np.linalg.norm(expected, axis=1)
        blind = without_range(recording)[detection]
        length = np.maximum(np.linalg.norm(read, axis=1), 1e-9)
        read = np.where(blind[:, None], read * (range_m / length)[:, None], read)
    else:
        seen = recording.detections
        expected = _predict_readings(pose, places.position_m[row], recording, result.parameters)
        range_m, known = expected[:, 0], _has_bearing(recording)[detection]
        bearing = np.where(known, seen.bearing_rad[detection], expected[:, 1])
        read = _points(seen.range_m[detection], bearing)
        expected = _points(range_m, expected[:, 1])
    off = (read - expected) / np.maximum(range_m, 1e-9)[:, None]
    good = np.isfinite(off).all(axis=1)
    named, used = innovations.landmark_id[keep[good]], innovations.p_inlier[keep[good]] >= USED
    point = locate_detections(recording)[detection[good]]
    return Compared(detection[good], taken_s[keep[good]], named, used, range_m[good], off[good], point)


def locate_detections(recording: AnyRecording) -> FloatArray:
    """Return (M, D) where detections are in the robot's frame [m]; nan of those with a direction or a range only."""
    if not is_in_space(recording):
        seen = recording.detections
        read = _points(seen.range_m, np.where(_has_bearing(recording), seen.bearing_rad, np.nan))
        return np.asarray(se2.transform(np.array(recording.sensor.mount_robot_sensor, dtype=np.float64), read))
    from evermap.slam.space.intake import positions_of, without_range

    mounts = np.array([one.mount_robot_sensor for one in recording.sensors])[recording.detections.sensor]
    point = se3.transform(mounts, positions_of(recording))
    return np.where(without_range(recording)[:, None], np.nan, point)


def find_instants(recording: AnyRecording, result: SlamResult) -> FloatArray:
    """Return (M,) when detections were taken, by the clock of a result's poses [s]."""
    return recording.frames.stamp_s[recording.detections.frame] - _find_delays_s(recording, result)


def _has_bearing(recording: Recording) -> BoolArray:
    seen = recording.detections
    return np.isfinite(seen.bearing_rad) & ~(seen.sigma_bearing_rad >= ANY_BEARING_RAD)


def _find_delays_s(recording: AnyRecording, result: SlamResult) -> FloatArray:
    """Return (M,) by how much stamps of detections are late, as was estimated of the sensors in space."""
    if not is_in_space(recording):
        return np.zeros(len(recording.detections))
    value = {each.name: each.value for each in result.parameters}
    delay_s = np.array([value.get(f"{one.name}_delay_s", 0.0) for one in recording.sensors])
    return np.asarray(delay_s[recording.detections.sensor])


def _points(range_m: FloatArray, bearing_rad: FloatArray) -> FloatArray:
    return np.asarray(range_m[:, None] * np.column_stack([np.cos(bearing_rad), np.sin(bearing_rad)]))


def _predict_readings(
    pose: FloatArray, place_m: FloatArray, recording: Recording, parameters: tuple[ParameterEstimate, ...]
) -> FloatArray:
    """Return (K, 2) ranges and bearings as the estimated sensor reads them without noise (`slam.calibration.SPECS`)."""
    value = {each.name: each.value for each in parameters}
    ahead, left = value.get("mount_forward_m", 0.0), value.get("mount_left_m", 0.0)
    mount = np.array(recording.sensor.mount_robot_sensor, dtype=np.float64) + [ahead, left, 0.0]
    x, y = se2.transform(se2.inverse(se2.compose(pose, mount)), place_m).T
    range_m, bearing = np.hypot(x, y), np.arctan2(y, x)
    skew, curve = value.get("range_skew_per_rad", 0.0), value.get("range_curvature_per_rad2", 0.0)
    factor = 1.0 + value.get("range_slope", 0.0) + skew * bearing + curve * bearing**2
    read_m = value.get("range_bias_m", 0.0) + range_m * factor
    return np.column_stack([np.maximum(read_m, 1e-3), bearing + value.get("bearing_bias_rad", 0.0)])


def _rows_of(places: Landmarks, landmark_id: IntArray) -> tuple[IntArray, BoolArray]:
    """Return rows of landmarks by their ids, and which are there."""
    if not len(places):
        return np.zeros(len(landmark_id), dtype=np.int64), np.zeros(len(landmark_id), dtype=np.bool_)
    row = np.minimum(np.searchsorted(places.landmark_id, landmark_id), len(places) - 1)
    return row, np.asarray(places.landmark_id[row] == landmark_id)


def find_poses_at(path: Trajectory, stamp_s: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the poses at stamps (K,), in the plane the nearest ones, and whether the nearest are near enough."""
    if not len(path):
        return np.zeros((len(stamp_s), path.pose_world_robot.shape[1])), np.zeros(len(stamp_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(path.stamp_s, stamp_s), 1, max(len(path) - 1, 1))
    after = np.minimum(after, len(path) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(path.stamp_s[before] - stamp_s) <= np.abs(path.stamp_s[after] - stamp_s)
    row = np.where(nearer, before, after)
    pose = path.pose_world_robot
    at = pose[row] if pose.shape[1] == 3 else se3.interpolate(path.stamp_s, pose, stamp_s)
    return at, np.asarray(np.abs(path.stamp_s[row] - stamp_s) <= FARTHEST_S)


@dataclass(frozen=True, slots=True)
class Signs:
    """What was measured; nan where a run does not have it. Shares are between 0 and 1.

    Attributes:
        n_landmarks, n_used: landmarks of the result; detections used.
        nis: mean of the inliers over their degrees of freedom, on the scale of 2.
        nis_lag: correlation of a landmark's successive innovations.
        used, used_worst: share of the detections with a prediction that were used, and that of the worst tenth of the
            drive.
        named: share of the detections with an identity, as they were read, that were used.
        misfit, misfit_all: median of what used, and all, detections are off by, over their range.
        contradicted: share of the landmarks (seen often) most of whose detections were not used.
        unexplained: landmarks of which many detections in a row were not used, and no change of which is reported.
        halves: median over landmarks of how far the first half of the drive has them from the second, in standard
            deviations by the scatter within halves.
        halves_share: the same over the range from which they are seen.
        motion: median difference of odometry and trajectory within a window, as a share of the motion.
        motion_turn_rad: the same of the turns.
        longer: motion by the trajectory over that by odometry.
        apart: by which share lengths by odometry and by detections differ, where no map or data sheet says which are
            right.
        over_odometry: how far detections of a landmark scatter about their middle, over what they would if the robot
            had gone as its odometry says (medians): more than 1 where the solution is the worse of the two.
        noise_seen, noise_driven: largest noise level of detections and odometry over what it started from.
        shift: distance that the robot goes within the estimated delay of its odometry's clock, over `sigma_m`; nan
            where the delay is short.
        away, away_name: standard deviations by which the calibration state farthest from its prior is off.
        away_scale: the same of scales of odometer and ranges, where no map says which are right.
        size_m: extent of trajectory and map.
        sigma_m: median of the standard deviations of positions; `sigma_most_m` the largest.
        sigma_share: `sigma_m` over the size.
        blind_s, blind_share: longest time without a used detection, in seconds and as a share of the drive.
        common, moved: landmarks of the given map that were seen; the share of them that is reported as changed.
        displaced: the same share of those that are elsewhere now.
        in_map: whether a given map is the frame of the result; None without one.
        alternatives: explanations nearly as probable as the one reported.
        n_unknown: poses and landmarks of the result that are no numbers.
        held, held_name: by how many of their standard deviations one step of a calibration that is held as stated moves
            the poses, of those that are significant (`explain.scores`), and its words; 0 where none is.
        alternation: standard deviations by which errors of the odometry alternate from step to step.
        adrift: poses beside a break of the odometry, whose detections are not used.
        hand: nats for the sign of turns, by where the sensor sits; nan where bearings or a map show it.
        dropped, bent_nats, lead_nats: of detections without identities (`AssociationEvidence`): share of no landmark,
            nats for each landmark met again, and log evidence over odometry alone.
    """

    n_landmarks: int = 0
    n_used: int = 0
    nis: float = nan
    nis_lag: float = nan
    used: float = nan
    used_worst: float = nan
    named: float = nan
    misfit: float = nan
    misfit_all: float = nan
    contradicted: float = nan
    unexplained: int = 0
    halves: float = nan
    halves_share: float = nan
    motion: float = nan
    motion_turn_rad: float = nan
    longer: float = nan
    apart: float = nan
    over_odometry: float = nan
    noise_seen: float = nan
    noise_driven: float = nan
    shift: float = nan
    away: float = nan
    away_name: str = ""
    away_scale: float = nan
    size_m: float = nan
    sigma_m: float = nan
    sigma_most_m: float = nan
    blind_s: float = nan
    blind_share: float = nan
    common: int = -1
    moved: float = nan
    displaced: float = nan
    in_map: bool | None = None
    alternatives: int = 0
    n_unknown: int = 0
    held: float = nan
    held_name: str = ""
    alternation: float = nan
    adrift: float = nan
    hand: float = nan
    dropped: float = nan
    bent_nats: float = nan
    lead_nats: float = nan

    @property
    def sigma_share(self) -> float:
        """Return the standard deviation of positions as a share of the size."""
        return self.sigma_m / self.size_m if self.size_m > 0.0 else nan


def with_scores(signs: Signs, scores: SessionScores) -> Signs:
    """Return the signs with what the solution tells of what was held as stated."""
    suspected = scores.suspected
    return replace(
        signs,
        held=0.0 if suspected is None else suspected.shift,
        held_name="" if suspected is None else suspected.suspect.say(suspected.value),
        alternation=scores.alternation,
        adrift=float(scores.adrift),
    )


def measure_signs(
    result: SlamResult,
    recording: AnyRecording,
    prior_map: Landmarks | None = None,
    as_read: AnyRecording | None = None,
) -> Signs:
    """Return all signs of a run.

    Args:
        result: of the run.
        recording: as it was estimated, so that rows of the result's innovations are rows of its detections.
        prior_map: that was given, or what a living map expected.
        as_read: the recording with the identities that it was read with; None where they are the same.
    """
    compared = compare_detections(recording, result)
    motion, turn, longer = compare_odometry(result, recording.odometry)
    halves, halves_share = _between_halves(compared)
    used, worst = _count_shares_used(result.innovations)
    blind_s, blind_share = _blind(result)
    named = _find_share_named(result.innovations, as_read or recording)
    contradicted = _find_share_contradicted(result)
    if result.trajectory is result.online:  # a localiser leaves out what it has not recognised yet, and knows no later
        named = contradicted = blind_s = blind_share = nan
    away, name = _farthest_state(result.parameters)
    size_m, sigma_m, most_m = _extent(result)
    common, moved, displaced = _of_map(result, recording, prior_map)
    inlier = result.innovations.p_inlier >= USED
    nis, found = comparable_nis(result.innovations), result.association
    fine = inlier & np.isfinite(nis)
    lag = lag1_autocorrelation(nis[fine], result.innovations.landmark_id[fine].astype(np.float64))
    is_in_map = prior_map is not None and result.landmarks.frame == "prior_map"
    seen, driven = _noise_over_start(result.parameters)
    points = int(np.isfinite(compared.point_m[compared.used]).all(axis=1).sum())  # ranges with their directions
    has_sign = is_in_map or points >= FEWEST
    hand = nan if has_sign or is_in_space(recording) else compare_with_mirrored(result, recording)
    return Signs(
        n_landmarks=len(result.landmarks),
        n_used=int(inlier.sum()),
        nis=float(nis[fine].mean()) if fine.any() else nan,
        nis_lag=nan if lag is None else float(lag),
        used=used,
        used_worst=worst,
        named=named,
        misfit=_median(compared.misfit[compared.used]),
        misfit_all=_median(compared.misfit),
        contradicted=contradicted,
        unexplained=_count_unexplained(result),
        halves=halves,
        halves_share=halves_share,
        motion=motion,
        motion_turn_rad=turn,
        longer=longer,
        apart=nan if is_in_map or _is_length_stated(recording) else abs(longer - 1.0),
        over_odometry=_over_odometry(compared, result),
        noise_seen=seen,
        noise_driven=driven,
        shift=_shift_by_clock_m(result) / sigma_m if sigma_m > 0.0 else nan,
        away=away,
        away_name=name,
        away_scale=nan if is_in_map else _farthest_state(_scales(result.parameters))[0],
        size_m=size_m,
        sigma_m=sigma_m,
        sigma_most_m=most_m,
        blind_s=blind_s,
        blind_share=blind_share,
        common=common,
        moved=moved,
        displaced=displaced,
        in_map=None if prior_map is None else is_in_map,
        alternatives=len(result.alternatives),
        n_unknown=_count_unknown(result),
        hand=hand,
        dropped=nan if found is None else found.dropped,
        bent_nats=nan if found is None else found.nats_per_closure,
        lead_nats=nan if found is None else found.lead_nats,
    )


def _count_unknown(result: SlamResult) -> int:
    tables = result.trajectory.pose_world_robot, result.landmarks.position_m
    return sum(int(np.count_nonzero(~np.isfinite(table).all(axis=1))) for table in tables)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) >= FEWEST else nan


def _count_shares_used(innovations: Innovations) -> tuple[float, float]:
    """Return the share of detections with a prediction that were used, and the least of a part of the drive."""
    stamp_s, inlier = innovations.stamp_s, innovations.p_inlier >= USED
    if len(inlier) < FEWEST:
        return nan, nan
    order = np.argsort(stamp_s, kind="stable")
    parts = np.array_split(inlier[order], min(STRETCHES, len(inlier) // FEWEST))
    return float(inlier.mean()), min(float(part.mean()) for part in parts)


def _find_share_named(innovations: Innovations, recording: AnyRecording) -> float:
    """Return the share of the detections with an identity that were used; nan where hardly any has one."""
    named = int(np.count_nonzero(recording.detections.landmark_id != UNKNOWN))
    used = innovations.detection[innovations.p_inlier >= USED]
    if named < max(FEWEST, len(used)):  # identities were found, not read
        return nan
    return len(used) / named


def _find_share_contradicted(result: SlamResult) -> float:
    """Return the share of landmarks that were seen often, most of whose detections were not used."""
    _, row, count = np.unique(result.innovations.landmark_id, return_inverse=True, return_counts=True)
    used = np.bincount(row, result.innovations.p_inlier >= USED, minlength=len(count))
    often = count >= PER_LANDMARK
    return float(np.mean(used[often] < 0.5 * count[often])) if often.any() else nan


def _count_unexplained(result: SlamResult) -> int:
    """Return landmarks of which many detections in a row were not used, where the robot was located, without a change
    of them that is reported.
    """
    located = find_poses_at(result.trajectory, result.innovations.stamp_s)[1]
    innovations = result.innovations[np.flatnonzero(located)]
    name, row, count = np.unique(innovations.landmark_id, return_inverse=True, return_counts=True)
    order = np.lexsort((innovations.stamp_s, row))
    first = np.cumsum(count) - count
    # before the first of each landmark, and after its last, it is as if one was used
    used = np.flatnonzero(innovations.p_inlier[order] >= USED)
    of_used = row[order[used]]
    edges = np.concatenate([first - 1, used, first + count])
    of_edge = np.concatenate([np.arange(len(name)), of_used, np.arange(len(name))])
    by_landmark = np.lexsort((edges, of_edge))
    streak, of_streak = np.diff(edges[by_landmark]) - 1, of_edge[by_landmark]
    longest = np.zeros(len(name), dtype=np.int64)
    same = of_streak[1:] == of_streak[:-1]
    np.maximum.at(longest, of_streak[1:][same], streak[same])
    known = np.isin(name, [one for change in result.changes for one in change.landmark_ids])
    return int(np.count_nonzero(~known & (longest >= np.maximum(PER_LANDMARK, LEAST_STREAK * count))))


def _over_odometry(compared: Compared, result: SlamResult) -> float:
    """Return the scatter of detections about the middles of their landmarks, over that by odometry alone."""
    path, other = result.trajectory, result.dead_reckoning
    if len(path) < 3 or len(other) != len(path) or not np.array_equal(path.stamp_s, other.stamp_s):
        return nan
    fine = np.isfinite(compared.point_m).all(axis=1)
    taken_s, point_m = compared.taken_s[fine], compared.point_m[fine]
    name, row, count = np.unique(compared.landmark_id[fine], return_inverse=True, return_counts=True)
    scatter = []
    for each in (path, other):
        pose = find_poses_at(each, taken_s)[0]
        at = (se2 if pose.shape[1] == 3 else se3).transform(pose, point_m)
        middle = medians(at, row, len(name))[0][row]
        off = np.where(count[row] >= PER_LANDMARK, np.linalg.norm(at - middle, axis=1), nan)
        share = off / np.maximum(compared.range_m[fine], 1e-9)
        scatter.append(_median(share[np.isfinite(share)]))
    return scatter[0] / scatter[1] if scatter[1] > 0.0 else nan


def _between_halves(compared: Compared) -> tuple[float, float]:
    """Return how far landmarks are apart by the first half of their detections and by the second.

    Halves are of the detections of each landmark, in order of time, in the sensor's frame: what calibrations leave is
    in both. In standard deviations of the difference by the scatter within halves, and over the range.
    """
    used = np.flatnonzero(compared.used)
    used = used[np.lexsort((compared.taken_s[used], compared.landmark_id[used]))]
    _, row, count = np.unique(compared.landmark_id[used], return_inverse=True, return_counts=True)
    often = count >= 2 * PER_LANDMARK
    used, count = used[often[row]], count[often]
    if len(count) < 3:
        return nan, nan
    parts = np.column_stack([count // 2, count - count // 2]).ravel()
    begin, size, off = np.cumsum(parts) - parts, parts[:, None], compared.off[used]
    mean = np.add.reduceat(off, begin) / size
    within = np.add.reduceat((off - np.repeat(mean, parts, axis=0)) ** 2, begin) / ((size - 1) * size)
    apart, within = mean[1::2] - mean[::2], within[::2] + within[1::2]
    ratio = np.sqrt(np.mean(apart**2 / np.maximum(within, 1e-12), axis=1))
    return float(np.median(ratio)), float(np.median(np.linalg.norm(apart, axis=1)))


def compare_odometry(result: SlamResult, odometry: Odometry | SpatialOdometry | None) -> tuple[float, float, float]:
    """Return by how much odometry and trajectory differ within windows, as a share of the motion, in angle, in length.

    All are medians over windows in which either moved, and in which the odometry has no gap.
    """
    path, other = result.trajectory, result.dead_reckoning
    if len(path) < 3 or len(other) != len(path) or not np.array_equal(path.stamp_s, other.stamp_s):
        return nan, nan, nan
    lag_s = max(SHORTEST_S, float(path.stamp_s[-1] - path.stamp_s[0]) / WINDOWS)
    last = np.searchsorted(path.stamp_s, path.stamp_s + lag_s)
    first = np.flatnonzero(last < len(path))
    first = (
        first[np.linspace(0, len(first) - 1, min(len(first), 20 * WINDOWS)).astype(np.int64)] if len(first) else first
    )
    if odometry is not None:
        first = first[is_outside(find_gaps(odometry), path.stamp_s[first], path.stamp_s[last[first]])]
    if len(first) < 3:
        return nan, nan, nan
    one, two = (find_motions(each.pose_world_robot, first, last[first]) for each in (path, other))
    went = np.stack([np.linalg.norm(each, axis=1) for each in (one, two)])
    moves = went.max(axis=0) > LEAST_MOTION_M
    turned = find_turns_between(path.pose_world_robot, other.pose_world_robot, first, last[first])
    turn = float(np.median(np.abs(turned)))
    if moves.sum() < 3:
        return nan, turn, nan
    apart = np.linalg.norm(one - two, axis=1)[moves] / went.max(axis=0)[moves]
    longer = went[0][moves].sum() / max(float(went[1][moves].sum()), 1e-9)
    return float(np.median(apart)), turn, float(longer)


def find_motions(pose: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    """Return (W, D) translations from rows of poses to others, in the frame of their start."""
    group, dim = (se2, 2) if pose.shape[1] == 3 else (se3, 3)
    return np.asarray(group.between(pose[first], pose[last])[:, :dim])


def find_turns_between(path: FloatArray, other: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    """Return (W,) angles between turns by the one and by the other."""
    if path.shape[1] == 3:
        one, two = (each[last, 2] - each[first, 2] for each in (path, other))
        return np.asarray(se2.wrap(one - two))
    return se3.angle_between(*(se3.between(each[first], each[last]) for each in (path, other)))


def _farthest_state(parameters: tuple[ParameterEstimate, ...]) -> tuple[float, str]:
    """Return by how many of its prior's standard deviations a state is off at most, and which one is."""
    free = [each for each in parameters if not each.fixed and each.prior_sigma > 0.0]
    away = [(abs(each.value - each.prior_mean) / each.prior_sigma, each.name) for each in free]
    return max(away, default=(nan, ""))


def _scales(parameters: tuple[ParameterEstimate, ...]) -> tuple[ParameterEstimate, ...]:
    return tuple(each for each in parameters if each.name in SCALES)


SCALES = ("odometry_scale", "odometry_forward_scale", "range_scale", "range_slope")


def _noise_over_start(parameters: tuple[ParameterEstimate, ...]) -> tuple[float, float]:
    """Return the largest noise level of detections, and of odometry, over those that the run started from."""
    seen, driven = nan, nan
    for each in parameters:
        if isnan(each.prior_sigma) and each.prior_mean > 0.0:
            ratio = each.value / each.prior_mean
            if each.name in OF_DETECTIONS:
                seen = ratio if isnan(seen) else max(seen, ratio)
            else:
                driven = ratio if isnan(driven) else max(driven, ratio)
    return seen, driven


OF_DETECTIONS = (
    "sigma_range_m", "sigma_bearing_rad", "sigma_corner_px", "direction_noise_factor", "range_noise_factor",
    "orientation_noise_factor",
)  # fmt: skip
"""Names of noise levels of detections; all others are of the odometry."""


def find_odometry_delay(result: SlamResult) -> ParameterEstimate | None:
    """Return the delay of the odometry where it was estimated, as in the plane, and was not put right."""
    if any((cause.code, cause.subject) == ("clock", "sensor") for cause in result.causes):
        return None
    return next((each for each in result.parameters if each.name == "odometry_delay_s" and not each.fixed), None)


def _shift_by_clock_m(result: SlamResult) -> float:
    """Return how far the robot goes, by its usual speed, within a long delay between odometry and detections.

    Poses are those of the detections' clock: if the odometry's is right, they are off by as much.
    """
    path, delay = result.trajectory, find_odometry_delay(result)
    if delay is None or len(path) < 3:
        return nan
    is_late = delay.value > max(LATE_S, SURELY * delay.sigma)
    if not (is_late or delay.value + SURELY * delay.sigma < -EARLY_S):
        return nan
    dim = 2 if path.pose_world_robot.shape[1] == 3 else 3
    went = np.linalg.norm(np.diff(path.pose_world_robot[:, :dim], axis=0), axis=1)
    return abs(delay.value) * float(went.sum()) / max(float(path.stamp_s[-1] - path.stamp_s[0]), 1e-9)


def _is_length_stated(recording: AnyRecording) -> bool:
    """Return whether a data sheet says how well ranges or odometry measure lengths."""
    sensors = recording.sensors if is_in_space(recording) else (recording.sensor,)
    return any(one.sigma_scale is not None or one.sigma_odometer_scale is not None for one in sensors)


def _extent(result: SlamResult) -> tuple[float, float, float]:
    """Return the diagonal of trajectory and map, and median and maximum of the positions' sigmas."""
    path, dim = result.trajectory, result.landmarks.position_m.shape[1]
    if not len(path):
        return nan, nan, nan
    points = np.concatenate([path.pose_world_robot[:, :dim], result.landmarks.position_m])
    variance = np.trace(path.covariance[:, :dim, :dim], axis1=1, axis2=2)
    return (
        float(np.linalg.norm(np.ptp(points, axis=0))),
        float(np.sqrt(np.median(variance))),
        float(np.sqrt(variance.max())),
    )


def _blind(result: SlamResult) -> tuple[float, float]:
    """Return the longest time without a used detection, in seconds and as a share of the drive."""
    path, innovations = result.trajectory, result.innovations
    if not len(path):
        return nan, nan
    used_s = innovations.stamp_s[innovations.p_inlier >= USED]
    edges = np.sort(np.concatenate([path.stamp_s[[0, -1]], used_s]))  # some poses may not have been found
    longest, lasted = float(np.diff(edges).max()), float(edges[-1] - edges[0])
    return longest, longest / lasted if lasted > 0.0 else nan


ELSEWHERE = (ChangeKind.MOVED, ChangeKind.ROTATED, ChangeKind.SWAPPED)
GONE = (ChangeKind.VANISHED, ChangeKind.REPLACED)


def _of_map(result: SlamResult, recording: AnyRecording, prior_map: Landmarks | None) -> tuple[int, float, float]:
    """Return how many landmarks of a given map were seen, and the shares that are reported as changed and elsewhere."""
    if prior_map is None:
        return -1, nan, nan
    named = np.concatenate([recording.detections.landmark_id, result.innovations.landmark_id])
    common = np.intersect1d(prior_map.landmark_id, named[named != UNKNOWN])
    if not len(common):
        return 0, nan, nan
    moved = [one for change in result.changes if change.kind in ELSEWHERE for one in change.landmark_ids]
    gone = [one for change in result.changes if change.kind in GONE for one in change.landmark_ids]
    return len(common), float(np.isin(common, [*moved, *gone]).mean()), float(np.isin(common, moved).mean())
