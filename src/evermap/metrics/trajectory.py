"""Pose errors against a reference trajectory, and the alignment of frames that they need.

A map made from an unknown start lives in the frame of its first pose. Comparing it with surveyed coordinates needs
one rigid motion, `pose_truth_estimate`, without scale. It serves evaluation only: nothing of it flows back. Poses are
(x, y, theta) in the plane and (x, y, z, qx, qy, qz, qw) in space; D is the number of coordinates, 2 or 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from evermap.errors import DataError
from evermap.geometry import se2, se3
from evermap.geometry.group import PLANE, group_of
from evermap.geometry.rigid import rigid
from evermap.metrics.consistency import nees
from evermap.show import ShownTable
from evermap.types import BoolArray, FloatArray, IntArray, Trajectory, rows_of

ANCHOR_SLACK_S = 1.0
"""Errors can be anchored at the pose that holds the frame if the truth has one within this of it."""
DRIFT_DISTANCE_M = 10.0
SAME_S = 1e-3
"""Stamps of the truth and of the estimate that are this close are one."""


def align_points(source_m: FloatArray, target_m: FloatArray) -> FloatArray:
    """Return the motion that brings points onto others with the least squared distance, without scale.

    Umeyama (PAMI 1991, equations 38 to 43), in closed form. As there, the rotation is undefined where the
    cross-covariance has too low a rank.

    Args:
        source_m: (N, D) points, N >= D.
        target_m: (N, D) where each should come to lie.

    Raises:
        DataError: too few points, or all coincide; in space also where all lie on one line.
    """
    count, size = source_m.shape
    if count < size:
        least = "two" if size == 2 else "three"
        raise DataError(f"an SE({size}) alignment needs at least {least} points", hint="evaluate over a longer stretch")
    cross = (target_m - target_m.mean(axis=0)).T @ (source_m - source_m.mean(axis=0)) / count
    strength = np.linalg.svd(cross, compute_uv=False)
    if strength[size - 2] <= max(np.finfo(np.float64).eps, 1e-12 * strength[0]):
        what = "coincide: their alignment has no rotation" if size == 2 else "lie on a line: they may turn about it"
        raise DataError(f"all points {what}", hint="evaluate while moving")
    return rigid(source_m, target_m)


def align_poses(source: FloatArray, target: FloatArray) -> tuple[FloatArray, str]:
    """Align the positions of poses as `align_points`; by their orientations where the positions do not say how.

    Returns:
        the motion and how it was found: 'umeyama_se2' or 'umeyama_se3', else 'mean_heading' or 'mean_orientation'.
    """
    group = group_of(source)
    size = group.point_dim
    try:
        return align_points(source[:, :size], target[:, :size]), f"umeyama_se{size}"
    except DataError:
        turn = _mean_turn(source, target)
        turn[:size] = np.mean(target[:, :size] - source[:, :size] @ group.rotation_of(turn).T, axis=0)
        return turn, "mean_heading" if group is PLANE else "mean_orientation"


def _mean_turn(source: FloatArray, target: FloatArray) -> FloatArray:
    """The mean rotation between the poses, about the origin; in space Markley et al. (JGCD 2007), equation 12."""
    if group_of(source) is PLANE:
        turns = target[:, 2] - source[:, 2]
        return np.array([0.0, 0.0, np.arctan2(np.sin(turns).sum(), np.cos(turns).sum())])
    quaternion = se3.compose(target, se3.inverse(source))[:, 3:]
    return se3.normalise_poses([0.0, 0.0, 0.0, *np.linalg.eigh(quaternion.T @ quaternion).eigenvectors[:, -1]])


def rotate_covariance(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """Turn covariances (..., D, D) by rotation matrices (..., D, D), broadcast: `R P R^T`."""
    return np.asarray(rotation @ covariance @ np.swapaxes(rotation, -1, -2), dtype=np.float64)


def interpolate(trajectory: Trajectory, stamp_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Interpolate poses on the geodesic between the two neighbours; exact at the stamps themselves.

    Args:
        trajectory: at least one pose.
        stamp_s: (K,) within the trajectory's span.

    Returns:
        poses (K, 3) or (K, 7); covariances (K, 3, 3) or (K, 6, 6), mixed linearly, which is fair only where the
        neighbours are close; and the time between the two neighbours (K,) [s], 0 at the stamps themselves.
    """
    group = group_of(trajectory.pose_world_robot)
    knots = trajectory.stamp_s
    before, after = _neighbours(knots, stamp_s)
    gap_s = knots[after] - knots[before]
    share = np.where(gap_s > 0, (stamp_s - knots[before]) / np.where(gap_s > 0, gap_s, 1.0), 0.0)
    start = trajectory.pose_world_robot[before]
    twist = group.log(group.between(start, trajectory.pose_world_robot[after]))
    poses = group.compose(start, group.exp(share[:, None] * twist))
    mix = share[:, None, None]
    covariance = (1.0 - mix) * trajectory.covariance[before] + mix * trajectory.covariance[after]
    return poses, covariance, gap_s


def _neighbours(knot_s: FloatArray, stamp_s: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows (K,) of the knots before and after each stamp, the same at a knot."""
    after = np.clip(np.searchsorted(knot_s, stamp_s, side="left"), 0, len(knot_s) - 1)
    return np.where(knot_s[after] <= stamp_s, after, np.maximum(after - 1, 0)), after


@dataclass(frozen=True, slots=True)
class PoseErrors(ShownTable):
    """Errors of a trajectory at K stamps of the truth.

    **Alignment and NEES.** `nees` uses the aligned errors. Alignment removes the degrees of freedom of the frame, while
    the covariances of a map made from an unknown start are those relative to its first pose and grow with the distance
    from it; aligned NEES is therefore too small on average (looks cautious), and only values above the band say
    anything. `anchored_nees` instead fixes the frame at the scored pose that is known best, the gauge in which the
    covariances hold (the first one that saw anything, with poses by the odometry before it, perhaps):
    its expectation is 2, in space 3, but it inherits the truth's own heading error at that one stamp times the
    distance, and its values are one draw rather than many, so its mean scatters widely. Without alignment (map frame
    given) `nees` has expectation 2, in space 3, and `anchored_nees` is None.

    Attributes:
        stamp_s: (K,) stamps of the truth that were scored.
        truth, estimate: (K, 3) or (K, 7) poses, the estimate interpolated to the stamp and aligned.
        covariance: (K, 3, 3) or (K, 6, 6) of the estimate, in the robot's frame (see `interpolate`).
        position_error_m: (K,) distances.
        orientation_error_rad: (K,) angles between the orientations, never negative.
        heading_error_rad: (K,) estimate minus truth, wrapped; nan in space.
        pose_truth_estimate: (3,) or (7,) the alignment, identity if not aligned; align landmarks with this one too.
        alignment: how it was found, see `align_poses`, or 'none'.
        nees, anchored_nees: (K,) of the position (2 or 3 degrees of freedom), nan where the pose is exact.
        whole_nees: (K,) of position and orientation together (3 or 6 degrees of freedom), aligned as `nees`.
        pose_truth_anchor: (3,) or (7,) the alignment that makes the pose exact that holds the frame, None without one.
        drift_m_per_m: median translation error over 10 m travelled, divided by 10 m; None on shorter runs.
        skipped: stamps left out because the estimate has no pose near them.
    """

    stamp_s: FloatArray
    truth: FloatArray
    estimate: FloatArray
    covariance: FloatArray
    position_error_m: FloatArray
    orientation_error_rad: FloatArray
    heading_error_rad: FloatArray
    pose_truth_estimate: FloatArray
    alignment: str
    nees: FloatArray
    whole_nees: FloatArray
    anchored_nees: FloatArray | None
    pose_truth_anchor: FloatArray | None
    drift_m_per_m: float | None
    skipped: int
    _besides: ClassVar = frozenset({"pose_truth_estimate", "pose_truth_anchor"})

    def _facts(self) -> dict[str, Any]:
        error = {"rmse_m": self.rmse_m, "max_m": self.max_m, "orientation_rmse_deg": self.orientation_rmse_deg}
        return {"stamps": len(self.stamp_s), **error, "drift_m_per_m": self.drift_m_per_m, "alignment": self.alignment}

    @property
    def dof(self) -> int:
        """Return the degrees of freedom of `nees`: 2 in the plane, 3 in space."""
        return group_of(self.truth).point_dim

    @property
    def rmse_m(self) -> float:
        """Return the root mean square position error [m], the absolute error of Sturm et al. (IROS 2012)."""
        return float(np.sqrt(np.mean(self.position_error_m**2)))

    @property
    def mean_m(self) -> float:
        """Return the mean position error [m]."""
        return float(np.mean(self.position_error_m))

    @property
    def median_m(self) -> float:
        """Return the median position error [m]."""
        return float(np.median(self.position_error_m))

    @property
    def max_m(self) -> float:
        """Return the largest position error [m]."""
        return float(np.max(self.position_error_m))

    @property
    def orientation_rmse_deg(self) -> float:
        """Return the root mean square angle between the orientations [degrees], mean offset included."""
        return float(np.degrees(np.sqrt(np.mean(self.orientation_error_rad**2))))

    @property
    def heading_rmse_deg(self) -> float:
        """Return the root mean square heading error [degrees], mean offset included; nan in space."""
        return float(np.degrees(np.sqrt(np.mean(self.heading_error_rad**2))))


def scored_stamps(truth: Trajectory, first_s: float, last_s: float, rate_hz: float) -> IntArray:
    """Return the rows of the truth to score: at every tick of a regular clock the nearest stamp, within half a tick.

    Truth is never interpolated; where it has holes nothing is scored.
    """
    period_s = 1.0 / rate_hz
    overlap = np.flatnonzero((truth.stamp_s >= first_s) & (truth.stamp_s <= last_s))
    if len(overlap) == 0:
        return overlap.astype(np.int64)
    stamps = truth.stamp_s[overlap]
    # only ticks that can have a stamp within half a tick: a stray stamp may lie years away
    count = np.unique(np.rint((stamps - stamps[0]) / period_s)[:, None] + [-1.0, 0.0, 1.0])
    ticks = stamps[0] + count[count >= 0.0] * period_s
    ticks = ticks[ticks < stamps[-1] + 1e-6]
    right = np.clip(np.searchsorted(stamps, ticks), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    nearest = np.where(ticks - stamps[left] <= stamps[right] - ticks, left, right)
    near = np.abs(stamps[nearest] - ticks) <= 0.5 * period_s + 1e-9
    return np.asarray(overlap[np.unique(nearest[near])], dtype=np.int64)


def evaluate_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    rate_hz: float = 2.0,
    align: bool = True,
    max_gap_s: float = float("inf"),
    looked_s: FloatArray | None = None,
) -> PoseErrors | None:
    """Compute pose errors at stamps of the truth, after a rigid alignment; None where fewer than two can be scored.

    Args:
        estimate: poses with covariance, dense enough to be interpolated.
        truth: reference poses.
        rate_hz: how densely truth is sampled over the overlap.
        align: estimate rotation and translation on the positions first; False compares as it stands.
        max_gap_s: leave out stamps whose neighbouring estimates are further apart than this (for causal poses,
            which exist only where the sensor looked). The whole overlap is scored by default.
        looked_s: (F,) stamps at which the robot was to be located; stamps of the truth are left out between poses that
            have one of these between them. None where no pose is missing.
    """
    if len(estimate) == 0 or len(truth) == 0 or estimate.clock != truth.clock:
        return None
    rows, skipped = _rows_to_score(estimate, truth, rate_hz, max_gap_s, looked_s)
    if len(rows) < 2:
        return None
    stamps, reference = truth.stamp_s[rows], truth.pose_world_robot[rows]

    raw, covariance, _ = interpolate(estimate, stamps)
    group = group_of(raw)
    size = group.point_dim
    pose_truth_estimate, how = align_poses(raw, reference) if align else (group.identity(), "none")
    aligned = group.compose(pose_truth_estimate, raw)
    anchor, (first, held) = None, (_surest(each, size) for each in (covariance, estimate.covariance))
    if align and estimate.frame == "first_pose" and abs(stamps[first] - estimate.stamp_s[held]) <= ANCHOR_SLACK_S:
        anchor = group.compose(reference[first], group.inverse(raw[first]))
    wrong = group.local(aligned, reference)
    heading = se2.wrap(aligned[:, 2] - reference[:, 2]) if group is PLANE else np.full(len(rows), np.nan)
    return PoseErrors(
        stamp_s=stamps,
        truth=reference,
        estimate=aligned,
        covariance=covariance,
        position_error_m=np.linalg.norm(aligned[:, :size] - reference[:, :size], axis=1),
        orientation_error_rad=np.abs(heading) if group is PLANE else np.linalg.norm(wrong[:, size:], axis=1),
        heading_error_rad=heading,
        pose_truth_estimate=pose_truth_estimate,
        alignment=how,
        nees=_position_nees(aligned, reference, covariance),
        whole_nees=_whole_nees(wrong, covariance),
        anchored_nees=None if anchor is None else _position_nees(group.compose(anchor, raw), reference, covariance),
        pose_truth_anchor=anchor,
        drift_m_per_m=drift_per_metre(aligned, reference),
        skipped=skipped,
    )


def _surest(covariance: FloatArray, size: int) -> int:
    """Return the row of the pose whose position is known best: that which holds the frame is known exactly."""
    return int(np.argmin(np.trace(covariance[:, :size, :size], axis1=1, axis2=2)))


def _rows_to_score(
    estimate: Trajectory, truth: Trajectory, rate_hz: float, max_gap_s: float, looked_s: FloatArray | None
) -> tuple[IntArray, int]:
    """Return rows of the truth, and the number of omitted ones; see `evaluate_trajectory`."""
    knots = estimate.stamp_s
    slack_s = 0.0 if looked_s is None else SAME_S
    rows = scored_stamps(truth, knots[0] - slack_s, knots[-1] + slack_s, rate_hz)
    if looked_s is None:
        before, after = _neighbours(knots, truth.stamp_s[rows])
        found = rows[knots[after] - knots[before] <= max_gap_s]
    else:
        known = np.flatnonzero(_is_supported(knots, truth.stamp_s, max_gap_s, looked_s))
        found = known[scored_stamps(rows_of(truth, known), knots[0] - slack_s, knots[-1] + slack_s, rate_hz)]
    return found, max(len(rows) - len(found), 0)


def _is_supported(knot_s: FloatArray, stamp_s: FloatArray, max_gap_s: float, looked_s: FloatArray) -> BoolArray:
    """(K,) whether the poses on both sides of each stamp are near neighbours, or one is at the stamp itself."""
    missing = looked_s[~_same(knot_s, looked_s)]
    last = len(knot_s) - 1
    after = np.clip(np.searchsorted(knot_s, stamp_s), min(1, last), last)
    first_s, second_s = knot_s[np.maximum(after - 1, 0)], knot_s[after]
    next_to = np.searchsorted(missing, first_s) == np.searchsorted(missing, second_s)
    return np.asarray((next_to & (second_s - first_s <= max_gap_s)) | _same(knot_s, stamp_s))


def _same(knot_s: FloatArray, stamp_s: FloatArray) -> BoolArray:
    """(K,) whether there is a knot at each stamp."""
    after = np.searchsorted(knot_s, stamp_s - SAME_S)
    return np.asarray(np.append(knot_s, np.inf)[after] <= stamp_s + SAME_S)


def _position_nees(estimate: FloatArray, truth: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the NEES (K,) of positions; the error is turned into the robot's frame, where the covariance is."""
    group = group_of(estimate)
    size = group.point_dim
    error_world = estimate[:, :size] - truth[:, :size]
    error_robot = np.einsum("kji,kj->ki", group.rotation_of(estimate), error_world)
    return nees(error_robot, covariance[:, :size, :size])


def _whole_nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the NEES (K,) of twists, in units of their standard deviations: metres and radians are not compared."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    unit = np.where(sigma > 0.0, sigma, 1.0)
    return nees(error / unit, covariance / (unit[:, :, None] * unit[:, None, :]))


def drift_per_metre(estimate: FloatArray, truth: FloatArray, distance_m: float = DRIFT_DISTANCE_M) -> float | None:
    """Return the median relative pose error (Sturm et al., IROS 2012) over `distance_m` of the true path, per metre.

    It needs no alignment. None if the path is shorter than the distance.
    """
    group = group_of(truth)
    size = group.point_dim
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :size], axis=0), axis=1))])
    end = np.searchsorted(travelled, travelled + distance_m)
    start = np.flatnonzero(end < len(travelled))
    if len(start) == 0:
        return None
    end = end[start]
    wrong = group.between(group.between(truth[start], truth[end]), group.between(estimate[start], estimate[end]))
    return float(np.median(np.linalg.norm(wrong[:, :size], axis=1) / (travelled[end] - travelled[start])))
