"""Signs of how far a run can be trusted, none of which needs the truth; the same in the plane and in space.

Each compares two sources that a sound run makes agree: a detection with the landmark where the map has it
(`expectations`, `usage`), the first half of the drive with the second, odometry with the trajectory (`motions`), a
calibration with its prior, a given map with what was found. Values are numbers; what they should be is decided by
`explain.verdict`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isnan, nan

import numpy as np

from evermap.estimate.innovations import comparable_nis, lag1_autocorrelation
from evermap.explain.expectations import FEWEST, PER_LANDMARK, USED, Compared, compare_detections, find_poses_at
from evermap.explain.motions import compare_odometry, find_shift_by_clock_m
from evermap.explain.scores import SessionScores
from evermap.explain.usage import (
    count_shares_used,
    count_unexplained,
    find_blind_time,
    find_share_contradicted,
    find_share_named,
)
from evermap.geometry import se2, se3
from evermap.slam.association.features import medians
from evermap.slam.ranges import compare_with_mirrored
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    ChangeKind,
    FloatArray,
    Landmarks,
    ParameterEstimate,
    SlamResult,
    is_in_space,
)


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
    used, worst = count_shares_used(result.innovations)
    blind_s, blind_share = find_blind_time(result)
    named = find_share_named(result.innovations, as_read or recording)
    contradicted = find_share_contradicted(result)
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
        unexplained=count_unexplained(result),
        halves=halves,
        halves_share=halves_share,
        motion=motion,
        motion_turn_rad=turn,
        longer=longer,
        apart=nan if is_in_map or _is_length_stated(recording) else abs(longer - 1.0),
        over_odometry=_over_odometry(compared, result),
        noise_seen=seen,
        noise_driven=driven,
        shift=find_shift_by_clock_m(result) / sigma_m if sigma_m > 0.0 else nan,
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
