"""Input of the estimator in space: the usable part of a recording, with the weight of each detection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from evermap.config import SpaceConfig
from evermap.errors import DataError
from evermap.estimate.tie import find_nearest
from evermap.geometry import se3
from evermap.geometry.camera import project_each, unproject
from evermap.geometry.square import SquarePoses, square_poses
from evermap.geometry.symmetry import HINT, Symmetries, Symmetry
from evermap.slam.gaps import find_gaps
from evermap.slam.intake import connect, frames_of_usable, frames_with_pose, most_of, usable_detections
from evermap.slam.space.bridge import PathFrames
from evermap.slam.space.linearise import CORNERS, JUMP_SHARE, POINT, POSE
from evermap.slam.space.local_filter import SpatialFrame
from evermap.slam.space.problem import USUAL, OdometryPath, SpatialNoise, SpatialProblem, Swing
from evermap.types import (
    ANY_RANGE_M2,
    BoolArray,
    FloatArray,
    IntArray,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    rows_of,
)

SAME_S, OF_FRAMES = 1e-5, 0.8
"""Difference of stamps that are the same, and share of the odometry's that are a frame's from which all are."""
HARDLY = 1.0
"""Standard deviation with which it counts, as a share of the range: as good as nothing."""


class Rests(NamedTuple):
    """Where the landmarks of bodies that move stand in turn: rows (P,), one a place.

    Attributes:
        landmark: rows of `SpatialIntake.landmark_id` that the places are of.
        body: its number, `UNKNOWN` of what is on no body that moves.
        since_s, until_s: first and last stamp of the rest, on the problem's clock.
        away_s: when the landmark was first seen as it moved after the rest, before the next one; nan where it was not.
        seen_s: when it was last.
        seen: (P, 7) motion from the rest to there, in the landmark's own axes; of a point a shift.
    """

    landmark: IntArray
    body: IntArray
    since_s: FloatArray
    until_s: FloatArray
    away_s: FloatArray
    seen_s: FloatArray
    seen: FloatArray


@dataclass(frozen=True, slots=True)
class SpatialIntake:
    """A recording as input of the estimator.

    Attributes:
        problem: stamps count from `start_s`.
        start_s: stamp of the first pose.
        frames: those of the trajectory, of which some get a pose.
        used: (M,) rows of the detections that are used, in the order of the problem.
        landmark_id: (P,) ids behind the places.
        warnings: what was left out, counted.
        names: texts behind landmark ids.
        boxes: (P,) landmarks that are boxes at rest.
        scale_in_map: standard deviation of the odometry's scale where a given map tells it.
        bodies: (P,) numbers of the bodies that landmarks are on, as stated, `UNKNOWN` of others; empty without any.
        rests: of those that move; None without any.
    """

    problem: SpatialProblem
    start_s: float
    frames: PathFrames
    used: IntArray
    landmark_id: IntArray
    warnings: tuple[str, ...]
    names: Mapping[int, str] = field(default_factory=dict)
    boxes: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    scale_in_map: float = 0.0
    bodies: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    rests: Rests | None = None

    @property
    def pose_frame(self) -> IntArray:
        """Return (N,) rows of the recording's frames that get a pose."""
        return self.frames.pose_frame

    @property
    def driven_pose(self) -> FloatArray:
        """Return (N, 7) poses by the odometry, from the identity; all identity without."""
        return self.frames.driven[self.frames.posed]


def prepare_space(
    recording: SpatialRecording,
    settings: SpaceConfig,
    remarks: tuple[str, ...] = (),
    *,
    fewest: int = 2,
    robust: bool = True,
    estimate_noise: bool = True,
    coarse: bool = False,
) -> SpatialIntake:
    """Select the usable part: detections of known identity, during the odometry.

    Args:
        recording: as read.
        settings: priors of the sensors.
        remarks: on the recording, before those on what was left out.
        fewest: frames with a landmark that it takes.
        robust: whether outliers are down-weighted.
        estimate_noise: whether noise levels are learned.
        coarse: whether rough poses of tags by their corners will do: they are first values, no residual is of them.

    Raises:
        DataError: fewer than `fewest` frames with a landmark of known identity.
    """
    detections, stamps = recording.detections, recording.frames.stamp_s
    where, usable, moving, warnings = _said(recording, settings, remarks, coarse=coarse)
    seen_in = frames_of_usable(recording, usable, fewest=fewest)
    frames = _find_frames(recording, seen_in, moving)
    pose_frame, path_s = frames.pose_frame, stamps[frames.row]
    seen = connect(recording, usable, pose_frame, partial(_find_motions, recording.odometry))
    used, landmark_id, place = seen.used, seen.landmark_id, seen.place
    some = rows_of(where, used)
    symmetries = _symmetries(recording, place, used, some.kind, len(landmark_id))
    oriented = np.bincount(place, some.kind != POINT, minlength=len(landmark_id)) > 0.0
    driven, by_corners = recording.odometry is not None, 2 * np.count_nonzero(some.kind == CORNERS) > len(some.kind)
    scale = scale_between(recording.sensors, settings, settings.scale_sigma if by_corners else 0.0)
    problem = SpatialProblem(
        stamp_s=stamps[pose_frame] - stamps[pose_frame[0]],
        increment=se3.between(frames.driven[frames.posed[:-1]], frames.driven[frames.posed[1:]]),
        lasted_s=np.add.reduceat(frames.lasted_s, frames.posed[:-1]),
        swing=Swing.between(frames.posed, frames.lasted_s, frames.driven),
        driven=driven,
        pose_row=seen.pose_row,
        place=place,
        sensor=detections.sensor[used],
        kind=some.kind,
        measured=some.measured,
        measured_root=_roots(some.covariance, some.measured[:, :3]),
        usual_m=some.usual_m,
        sigma_rad=some.sigma_rad,
        corner=some.corner,
        corner_root=some.corner_root,
        half_m=0.5 * np.nan_to_num(detections.tag_size_m[used]),
        other=some.other,
        other_log_odds=some.other_log_odds,
        share=np.ones(len(used)),
        ray=without_range(recording)[used],
        oriented=oriented,
        symmetries=symmetries,
        mount=np.array([sensor.mount_robot_sensor for sensor in recording.sensors]),
        mount_sigma=_mount_sigma(recording.sensors, settings),
        delay_sigma_s=np.zeros(len(recording.sensors)),
        whole_s=np.zeros(len(recording.sensors)),
        delay_jitter=np.zeros(len(recording.sensors)),
        range_error=np.zeros(len(recording.sensors)),
        scale_sigma=scale[0] if driven else 0.0,
        ranges_share=scale[1],
        path=lead_on(recording, stamps[pose_frame[0]], settings.delay_sigma_s),
        has_clock_of_frames=_has_clock_of_frames(recording, path_s),
        measurements=seen.measurements,
        start_sigma=np.max([[1e-4] * 6, *(of.kind.first_sigma for of in seen.measurements)], axis=0),
        robust=robust,
        estimate_noise=estimate_noise,
        settings=settings,
    )
    return SpatialIntake(
        problem, float(stamps[pose_frame[0]]), frames, used, landmark_id, (*warnings, *seen.left_out),
        recording.landmark_names,
        np.bincount(place, np.isfinite(detections.size_m[used]).all(axis=1), len(landmark_id)) > 0.0,
        settings.map.scale_sigma if driven and recording.sensors[0].sigma_odometer_scale is None else 0.0,
    )  # fmt: skip


def _find_motions(odometry: SpatialOdometry | None, from_s: FloatArray, to_s: FloatArray) -> FloatArray:
    """Return (K, 7) motions by the odometry between instants (K,); none without odometry."""
    if odometry is None:
        return se3.identity(len(from_s))
    then, now = (se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, at_s) for at_s in (from_s, to_s))
    return se3.between(then, now)


def frames_of(recording: SpatialRecording, settings: SpaceConfig = USUAL) -> tuple[SpatialFrame, tuple[Symmetry, ...]]:
    """Return all detections as a filter reads them, each by itself, and the symmetries of landmarks.

    Those of which only the direction was seen are not readable: their ranges follow from what is seen later.
    """
    given = recording.detections
    usable = ~without_range(recording)
    where, broken = _where(recording, usable, settings)
    readable, kind = usable & ~broken, where.kind.copy()
    root = np.zeros((len(given), 3, 3))
    root[readable] = _roots(where.covariance[readable], where.measured[readable, :3])
    names = dict(enumerate(recording.class_names))
    alike = Symmetries.of_classes(recording.symmetries, [names.get(one, str(one)) for one in given.class_id.tolist()])
    symmetry = np.where(kind == CORNERS, 0, alike.of)
    kind[np.array([one.free for one in alike.kinds])[symmetry]] = POINT
    other = np.where(np.isfinite(where.other), where.other, where.measured)
    seen = SpatialFrame(
        given.landmark_id, readable, given.sensor, kind, np.stack([where.measured, other]), where.other_log_odds, root,
        where.sigma_rad, where.corner, where.corner_root, 0.5 * np.nan_to_num(given.tag_size_m), symmetry,
    )  # fmt: skip
    return seen, alike.kinds


def start_noise(settings: SpaceConfig, *, driven: bool) -> SpatialNoise:
    """Return the noise levels to start from."""
    goes = (settings.drift_m, settings.drift_rad) if driven else (settings.hand_mps, settings.hand_radps)
    return SpatialNoise(*goes, pixel=settings.sigma_px)


def state_sigmas(sensors: Sequence[SpatialSensor], settings: SpaceConfig, *, driven: bool) -> FloatArray:
    """Return (6 S + 1,) standard deviations of the mounts' twists and of the logarithm of the odometry's scale."""
    by_corners = any(sensor.intrinsics is not None for sensor in sensors)
    scale = scale_between(sensors, settings, settings.scale_sigma if by_corners else 0.0)[0] if driven else 0.0
    return np.append(_mount_sigma(sensors, settings), scale)


def path_of(recording: SpatialRecording, start_s: float) -> OdometryPath | None:
    """Return the odometry, with stamps from an instant on; None without."""
    return lead_on(recording, start_s, 0.0)


def _symmetries(recording: SpatialRecording, place: IntArray, used: IntArray, kind: IntArray, count: int) -> Symmetries:
    """Return the symmetries of so many places by their classes; none for tags, which have a pattern.

    What has no orientation becomes a point: `kind` (M,) is written to.
    """
    class_id = most_of(place, recording.detections.class_id[used], count)
    names = dict(enumerate(recording.class_names))
    try:
        found = Symmetries.of_classes(recording.symmetries, [names.get(row, str(row)) for row in class_id.tolist()])
    except ValueError as error:
        raise DataError(f"{recording.name}: {error}", field="symmetries", hint=HINT) from None
    found.of[place[kind == CORNERS]] = 0
    kind[np.array([symmetry.free for symmetry in found.kinds])[found.of[place]]] = POINT
    return found


def _said(
    recording: SpatialRecording, settings: SpaceConfig, remarks: tuple[str, ...], *, coarse: bool
) -> tuple[_Where, BoolArray, BoolArray, list[str]]:
    """Return the measurements, usable detections (M,), frames (F,) during the odometry, and remarks on dropped ones."""
    usable, moving, warnings = usable_detections(recording, remarks)
    where, broken = _where(recording, usable, settings, coarse=coarse)
    if broken.any():
        warnings.append(f"{int(broken.sum())} detections from which no position follows not used")
        usable &= ~broken
    blind = _with_ranges(recording, where, usable, settings)
    if blind.any():
        warnings.append(f"{int(blind.sum())} detections without a range, seen from too few directions, not used")
        usable &= ~blind
    return where, usable, moving, warnings


def find_corners(recording: SpatialRecording, settings: SpaceConfig) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return what `prepare_space` has of a recording by the lenses of its cameras: the detections that are used, and
    their corners and the roots of their information (`SpatialProblem`).
    """
    where, usable, _, _ = _said(recording, settings, (), coarse=True)
    used = np.flatnonzero(usable)
    return used, where.corner[used], where.corner_root[used]


@dataclass(frozen=True, slots=True)
class _Where:
    """Measurements of all detections; see `SpatialProblem`."""

    kind: IntArray
    measured: FloatArray
    covariance: FloatArray
    usual_m: FloatArray
    sigma_rad: FloatArray
    corner: FloatArray
    corner_root: FloatArray
    other: FloatArray
    other_log_odds: FloatArray


def _where(
    recording: SpatialRecording, usable: BoolArray, settings: SpaceConfig, *, coarse: bool = False
) -> tuple[_Where, BoolArray]:
    """Return the measurements, and the usable detections without any; `coarse` as for `prepare_space`."""
    given = recording.detections
    count, covariance, usual_m = len(given), *_covariance(recording, settings)
    found = _Where(
        kind=np.where(np.isfinite(given.rotation[:, 0]), POSE, POINT).astype(np.int64),
        measured=np.hstack(
            [given.position_sensor_m, np.where(np.isfinite(given.rotation), given.rotation, se3.NO_TURN)]
        ),
        covariance=covariance,
        usual_m=usual_m,
        sigma_rad=_sigma_rad(recording, settings.sigma_rad),
        corner=np.zeros((count, 4, 2)),
        corner_root=np.zeros((count, 4, 2, 2)),
        other=np.full((count, 7), np.nan),
        other_log_odds=np.zeros(count),
    )
    for row, sensor in enumerate(recording.sensors):
        some = np.flatnonzero(usable & (given.sensor == row) & np.isfinite(given.corner_px[:, 0, 0]))
        if sensor.intrinsics is None or not len(some):
            continue
        ray = unproject(given.corner_px[some], sensor)
        plane = ray / ray[..., 2:]
        good = (
            np.isfinite(plane).all(axis=(1, 2))
            & (ray[..., 2] > 0.0).all(axis=1)
            & (np.abs(plane).max(axis=(1, 2)) < settings.widest)
        )
        some, plane = some[good], plane[good]
        _, slope = project_each(plane, np.full(len(some), row), recording.sensors)
        if coarse:
            _put_coarsely(found, some, plane, slope, given.tag_size_m[some])
        else:
            poses = square_poses(given.corner_px[some], given.tag_size_m[some], sensor)
            _put(found, some, plane, slope, poses, settings.corner_m)
    broken = usable & ~(np.isfinite(found.measured).all(axis=1) & np.isfinite(found.covariance).all(axis=(1, 2)))
    near = np.linalg.norm(np.nan_to_num(found.measured[:, :3]), axis=1) < settings.nearest_m
    return found, broken | (usable & near)


def positions_of(recording: SpatialRecording) -> FloatArray:
    """Return (M, 3) positions in the sensor's frame, of tags by their corners where none is given; nan where neither
    tells.
    """
    given = recording.detections.position_sensor_m
    absent = np.asarray(np.isnan(given).any(axis=1))
    return (
        np.where(absent[:, None], _where(recording, absent, USUAL)[0].measured[:, :3], given) if absent.any() else given
    )


def without_range(recording: SpatialRecording) -> BoolArray:
    """Return (M,) detections of which only the direction was seen."""
    at, covariance = recording.detections.position_sensor_m, recording.detections.covariance_sensor_m2
    along = np.einsum("mi,mij,mj->m", at, covariance, at)  # nan where nothing is stated
    return np.asarray(along > ANY_RANGE_M2 * (at**2).sum(axis=1))


def _with_ranges(recording: SpatialRecording, where: _Where, usable: BoolArray, settings: SpaceConfig) -> BoolArray:
    """Triangulate the ranges of detections without one, from other detections of the same landmark shortly before and
    after.

    The covariance keeps what was seen across; the range itself is hardly believed. Returns (M,) those that could not.
    """
    given, blind = recording.detections, np.zeros(len(usable), dtype=np.bool_)
    rays = np.flatnonzero(usable & without_range(recording))
    if not len(rays):
        return blind
    if recording.odometry is None:
        blind[rays] = True
        return blind
    mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])
    pose = drive_through(recording, recording.frames.stamp_s)
    eye = se3.compose(pose[given.frame[rays]], mount[given.sensor[rays]])
    ahead = given.position_sensor_m[rays] / np.linalg.norm(given.position_sensor_m[rays], axis=1, keepdims=True)
    along = np.einsum("mij,mj->mi", se3.rotation_of(eye), ahead)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    stamp_s, landmark = recording.frames.stamp_s[given.frame[rays]], given.landmark_id[rays]
    range_m, spread = np.full(len(rays), np.nan), np.full(len(rays), np.inf)
    soon_s = settings.range_within_s
    for name in np.unique(landmark):
        mine = np.flatnonzero(landmark == name)
        total = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(across[mine], axis=0)])
        pull = np.einsum("mij,mj->mi", across[mine], eye[mine, :3])
        pull = np.concatenate([np.zeros((1, 3)), np.cumsum(pull, axis=0)])
        first, last = (np.searchsorted(stamp_s[mine], stamp_s[mine] + by) for by in (-soon_s, soon_s))
        seen = total[last] - total[first] + 1e-9 * np.eye(3)
        at = np.linalg.solve(seen, (pull[last] - pull[first])[..., None])[..., 0]
        range_m[mine] = ((at - eye[mine, :3]) * along[mine]).sum(axis=1)
        spread[mine] = np.einsum("mi,mi->m", along[mine], np.linalg.solve(seen, along[mine][..., None])[..., 0])
    out = np.einsum("mi,mij,mj->m", ahead, given.covariance_sensor_m2[rays], ahead)
    own = given.covariance_sensor_m2[rays] - out[:, None, None] * ahead[:, :, None] * ahead[:, None, :]
    sigma2 = np.trace(own, axis1=1, axis2=2) / 2.0 / (given.position_sensor_m[rays] ** 2).sum(axis=1)
    good = (range_m > settings.nearest_m) & (sigma2 * spread < settings.least_parallax**2)
    blind[rays[~good]] = True
    r2, n = range_m[good, None, None] ** 2, ahead[good]
    outer = n[:, :, None] * n[:, None, :]
    where.measured[rays[good], :3] = range_m[good, None] * n
    where.covariance[rays[good]] = r2 * (sigma2[good, None, None] * (np.eye(3) - outer) + HARDLY**2 * outer)
    return blind


def _put(
    found: _Where, rows: IntArray, plane: FloatArray, slope: FloatArray, poses: SquarePoses, corner_m: float
) -> None:
    """Enter tags that are seen by their corners."""
    good = np.isfinite(poses.pose[0]).all(axis=1)
    rows = rows[good]
    found.kind[rows], found.usual_m[rows] = CORNERS, np.nan
    found.corner[rows], found.corner_root[rows] = plane[good, :, :2], slope[good, :, :, :2]
    found.measured[rows], found.other[rows] = poses.pose[0][good], poses.pose[1][good]
    covariance = np.linalg.pinv(poses.information[0][good], hermitian=True)
    # in the tag's own axes: turned into the camera's
    turn = se3.rotation_of(poses.pose[0][good])
    found.covariance[rows] = turn @ covariance[:, :3, :3] @ np.swapaxes(turn, 1, 2) + corner_m**2 * np.eye(3)
    found.sigma_rad[rows] = np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
    gap = 4.0 * (np.nan_to_num(poses.error_px[1][good], nan=1e3) ** 2 - poses.error_px[0][good] ** 2)
    found.other_log_odds[rows] = gap


def _put_coarsely(found: _Where, rows: IntArray, plane: FloatArray, slope: FloatArray, size_m: FloatArray) -> None:
    """Enter tags that are seen by their corners, as far away as these are apart, and turned as the camera."""
    edge = np.linalg.norm(plane - np.roll(plane, 1, axis=1), axis=2).mean(axis=1)
    at = plane.mean(axis=1) * (size_m / np.maximum(edge, 1e-12))[:, None]
    good = np.isfinite(at).all(axis=1)
    rows = rows[good]
    found.kind[rows], found.usual_m[rows] = CORNERS, np.nan
    found.corner[rows], found.corner_root[rows] = plane[good, :, :2], slope[good, :, :, :2]
    found.measured[rows] = se3.identity(len(rows))
    found.measured[rows, :3], found.covariance[rows], found.sigma_rad[rows] = at[good], np.eye(3), 1.0


def _covariance(recording: SpatialRecording, settings: SpaceConfig) -> tuple[FloatArray, FloatArray]:
    """Return (M, 3, 3) covariances of positions: as given, or usual ones of such sensors.

    And (M, 2) standard deviations of the latter across and along the line of sight, nan of those that are given.
    """
    given = recording.detections
    at = given.position_sensor_m
    range_m = np.maximum(np.linalg.norm(at, axis=1), settings.nearest_m)
    ray = at / range_m[:, None]
    usual_noise = (settings.sigma_m, settings.sigma_along, settings.sigma_across)
    of_kind = [usual_noise if sensor.kind is None else settings.kinds[sensor.kind][1:] for sensor in recording.sensors]
    near_m, share_along, share_across = np.array(of_kind)[given.sensor].T
    along, across = (near_m + share * range_m for share in (share_along, share_across))
    outer = ray[:, :, None] * ray[:, None, :]
    usual = (along**2)[:, None, None] * outer + (across**2)[:, None, None] * (np.eye(3) - outer)
    stated = np.array([np.nan if sensor.sigma_m is None else sensor.sigma_m for sensor in recording.sensors])
    of_sensor = stated[given.sensor][:, None, None] ** 2 * np.eye(3)
    usual = np.where(np.isfinite(of_sensor), of_sensor, usual)
    found = np.where(np.isfinite(given.covariance_sensor_m2), given.covariance_sensor_m2, usual)
    is_given = np.isfinite(stated[given.sensor]) | np.isfinite(given.covariance_sensor_m2).any(axis=(1, 2))
    return found, np.where(is_given[:, None], np.nan, np.column_stack([across, along]))


def _sigma_rad(recording: SpatialRecording, usual: float) -> FloatArray:
    """(M,) of orientations: as given, by the sensor, or as usual."""
    stated = np.array([usual if sensor.sigma_rad is None else sensor.sigma_rad for sensor in recording.sensors])
    given = recording.detections
    return np.where(np.isfinite(given.sigma_rad), given.sigma_rad, stated[given.sensor])


def _roots(covariance: FloatArray, at: FloatArray) -> FloatArray:
    """(M, 3, 3) that whiten positions (M, 3): the range last, and the rest given the range."""
    normal = at / np.linalg.norm(at, axis=1, keepdims=True)
    normal[:, 2] += np.where(normal[:, 2] < 0.0, -1.0, 1.0)
    outer = normal[:, :, None] * normal[:, None, :]
    mirror = np.eye(3) - 2.0 * outer / (normal**2).sum(axis=1)[:, None, None]  # has the ray as its last row
    information = np.linalg.inv(mirror @ covariance @ mirror)
    return np.ascontiguousarray(np.swapaxes(np.linalg.cholesky(information), 1, 2) @ mirror)


def _mount_sigma(sensors: Sequence[SpatialSensor], settings: SpaceConfig) -> FloatArray:
    """(S, 6) of the twists of the mounts, by data sheet or as usual."""
    rows = []
    for sensor in sensors:
        at = settings.mount_sigma_m if sensor.sigma_position_m is None else sensor.sigma_position_m
        turn = settings.mount_sigma_rad if sensor.sigma_angle_rad is None else sensor.sigma_angle_rad
        rows.append([at] * 3 + [turn] * 3)
    return np.array(rows)


def scale_between(sensors: Sequence[SpatialSensor], settings: SpaceConfig, unstated: float) -> tuple[float, float]:
    """Return the standard deviation of the scale between odometry and ranges, and the ranges' share of its variance.

    Args:
        sensors: of which the most exact one counts.
        settings: of kinds of sensors, and of the odometry.
        unstated: where nothing is stated of any: of the odometry alone.
    """
    stated = [sensor for sensor in sensors if sensor.kind is not None or sensor.sigma_scale is not None]
    odometer = sensors[0].sigma_odometer_scale
    if not stated and odometer is None:
        return unstated, 0.0
    driven = settings.scale_sigma if odometer is None else odometer
    ranges = min((_scale_sigma(sensor, settings) for sensor in stated), default=0.0)
    both = float(np.hypot(ranges, driven))
    return both, ranges**2 / both**2 if both > 0.0 else 0.0


def _scale_sigma(sensor: SpatialSensor, settings: SpaceConfig) -> float:
    """Of the ranges of a sensor of a stated kind, or with a data sheet."""
    if sensor.sigma_scale is not None or sensor.kind is None:
        return sensor.sigma_scale or 0.0
    return settings.kinds[sensor.kind][0]


def lead_on(recording: SpatialRecording, start_s: float, delay_sigma_s: float) -> OdometryPath | None:
    """Return the odometry, led on at both ends for four standard deviations of a delay, at the speed over one there: so
    delays of all sizes are compared alike.
    """
    odometry = recording.odometry
    if odometry is None or len(odometry) < 2:
        return None
    stamp_s, pose = odometry.stamp_s - start_s, odometry.pose_world_robot
    if delay_sigma_s == 0.0:
        return OdometryPath(stamp_s, pose)
    first_s, last_s = stamp_s[[0, -1]].tolist()
    inside_s = np.clip([first_s + delay_sigma_s, last_s - delay_sigma_s], first_s, last_s)
    end, inside = pose[[0, -1]], se3.interpolate(stamp_s, pose, inside_s)
    before, after = se3.retract(end, 4.0 * se3.local(inside, end))
    stamp_s = np.concatenate([[first_s - 4.0 * delay_sigma_s], stamp_s, [last_s + 4.0 * delay_sigma_s]])
    return OdometryPath(stamp_s, np.vstack([before, pose, after]))


def _has_clock_of_frames(recording: SpatialRecording, frame_s: FloatArray) -> bool:
    """Tell whether the odometry has the stamps of the frames (F,) and hardly any others, and those of most frames in
    which one of the sensors saw anything: fewer are of a clock that ticks slower.
    """
    odometry, seen = recording.odometry, recording.detections
    if odometry is None:
        return False
    own_s = odometry.stamp_s
    inside = own_s[(own_s >= frame_s[0]) & (own_s <= frame_s[-1])]
    if not len(inside):
        return True
    if not np.mean(_find_nearest_s(frame_s, inside) < SAME_S) > OF_FRAMES:
        return False
    of_sensor = (np.unique(seen.frame[seen.sensor == row]) for row in range(len(recording.sensors)))
    stamps = (recording.frames.stamp_s[rows] for rows in of_sensor if len(rows))
    return any(np.mean(_find_nearest_s(own_s, stamp_s) < SAME_S) > OF_FRAMES for stamp_s in stamps)


def _find_nearest_s(stamp_s: FloatArray, asked_s: FloatArray) -> FloatArray:
    """Return (M,) times from those asked to the nearest of stamps (K,)."""
    return np.abs(stamp_s[find_nearest(stamp_s, asked_s)] - asked_s)


def _find_frames(recording: SpatialRecording, seen_in: IntArray, moving: BoolArray) -> PathFrames:
    """Return the frames of the trajectory: those `seen_in`, or with odometry all during it (F,).

    A pose have those with a detection or another measurement, and the ends.
    """
    stamp_s, row = recording.frames.stamp_s, seen_in
    posed = np.arange(len(row))
    if recording.odometry is not None:
        row = np.flatnonzero(moving)
        looked = np.union1d(seen_in, recording.detections.frame[moving[recording.detections.frame]])
        posed = np.searchsorted(row, np.union1d(frames_with_pose(recording, looked, moving), row[[0, -1]]))
    at_s = stamp_s[row]
    lasted_s = _weigh_steps(recording.odometry, at_s)
    return PathFrames(row, at_s - at_s[0], lasted_s, drive_through(recording, at_s), posed)


def _weigh_steps(odometry: SpatialOdometry | None, stamp_s: FloatArray) -> FloatArray:
    """Return (N - 1,) what the variance of motions between instants (N,) grows with, as of `SpatialProblem`.

    In a gap of the odometry, between whose ends it is interpolated, the robot may have gone anywhere: as at a jump.
    """
    if odometry is None:
        return np.diff(stamp_s) ** 2
    lasted = np.diff(stamp_s)
    for since_s, until_s in find_gaps(odometry).tolist():
        lasted = lasted + np.diff(np.clip(stamp_s, since_s, until_s)) / JUMP_SHARE
    return lasted


def drive_through(recording: SpatialRecording, stamp_s: FloatArray) -> FloatArray:
    """Return poses (F, 7) by the odometry, from the identity."""
    odometry = recording.odometry
    if odometry is None or len(odometry) < 2:
        return se3.identity(len(stamp_s))
    found = se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, stamp_s)
    return se3.between(found[0], found)
