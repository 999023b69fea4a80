"""Problems of a recording, found before anything is estimated: units, signs, clocks, identities, limits.

**Units, signs and clocks** show in whether landmarks stand still (`slam.mistake_search`); a second mistake is looked
for when the first is undone. Honest recordings err by metres in a hundred and by tenths of a second: no mistake on the
list is near enough to be mistaken for that.

**Identities, limits, gaps, jumps of the odometry** are counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, overload

import numpy as np

from evermap.config import CheckConfig, CleaningConfig, Config, SensorConfig, SlamConfig
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.geometry.square import with_square_poses
from evermap.show import Shown
from evermap.slam.cleaning import clean
from evermap.slam.gaps import find_spikes
from evermap.slam.mistake_search import find_motion
from evermap.slam.mistakes import HONEST, Finding
from evermap.slam.orientations import find_convention
from evermap.slam.pairs import USUAL, off, pairs_of
from evermap.slam.riders import find_riders, without_riders
from evermap.slam.silences import find_silences, without_silences
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    AnyRecordingT,
    BoolArray,
    FloatArray,
    Landmarks,
    Odometry,
    Recording,
    SpatialOdometry,
    SpatialRecording,
    is_in_space,
    rows_of,
)
from evermap.valid import WITHOUT_IDS, check_landmarks, check_type, strangers, validate

DEFAULTS = SlamConfig()
OUTSIDE = 0.05
"""Share of the image size by which undistorted corners of tags may lie outside of the image."""
FEWEST_TAGS, NEARLY_ALL = 10, 0.9
"""Tags of a camera that show the order of its corners, and share of them that must be listed clockwise."""
SILENCE, RIDER = "odometry-silence", "rides-along"
"""Codes of the findings, and of the causes, that the odometry is silent, and that an identity rides with the robot."""
FAR_LESS = 0.5
"""Difference of pairs of sightings, over that of corners as they are read, at which they were written otherwise."""


class _Corners(NamedTuple):
    """How corners are read (M, 4, 2) that were written in another way, in images of a size (M, 1, 2), and its words."""

    read: Callable[[FloatArray, FloatArray], FloatArray]
    message: str
    fix: str


CLOCKWISE = "clockwise"
CORNERS = {
    CLOCKWISE: _Corners(
        lambda corner, _: corner[:, ::-1],
        "corners of tags are listed clockwise, as by OpenCV's ArUco: counter-clockwise from the lower left is expected "
        "(u0_px, v0_px)",
        "detections.csv: corners in the order 3, 2, 1, 0",
    ),
    "exchanged": _Corners(
        lambda corner, _: corner[..., ::-1],
        "rows and columns of corners seem to be exchanged: u is to the right, v down (u0_px, v0_px)",
        "detections.csv: u and v exchanged",
    ),
    "upwards": _Corners(
        lambda corner, size: corner * [1.0, -1.0] + size * [0.0, 1.0],
        "rows of corners seem to be counted upwards: v is down from the upper edge of the image (v0_px)",
        "detections.csv: v = height - v",
    ),
    "leftwards": _Corners(
        lambda corner, size: corner * [-1.0, 1.0] + size * [1.0, 0.0],
        "images seem to be mirrored: u is to the right (u0_px)",
        "detections.csv: u = width - u",
    ),
}
"""Ways in which tags look as if seen from behind, the commonest first."""
SIGHTED = {
    "w first": "quaternions of the detections seem to be in the order w, x, y, z: x, y, z, w is expected (detections)",
    "inverse": "poses of the detections seem to be those of the sensor in the landmark's frame, not of the landmark in "
    "the sensor's (detections)",
}
"""What a convention of poses says of detections."""
_OTHER_UNIT = "another unit than metres, or a wrong limit"
_OTHER_SIGN = "another unit or sign, or wrong limits"


@dataclass(frozen=True, slots=True)
class Check(Shown):
    """Summary and problems of a recording.

    Attributes:
        name, source: of the recording.
        contents: numbers by table: `odometry`, `frames`, `detections`, `landmarks`, `measurements` (rows of each kind);
            plain values, None where unknown.
        findings: what is odd, the worst first.
        warnings: remarks of the reader.
    """

    name: str
    source: str
    contents: dict[str, dict[str, Any]]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]

    @property
    def usable(self) -> bool:
        """Whether the recording is usable."""
        return all(finding.usable for finding in self.findings)

    @property
    def is_refused(self) -> bool:
        """Whether nothing can be estimated from the recording."""
        return any(finding.is_refused for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values with stable keys, for JSON."""
        return {
            "usable": self.usable,
            "recording": {"name": self.name, "source": self.source},
            **self.contents,
            "findings": [asdict(finding) for finding in self.findings],
            "warnings": list(self.warnings),
        }


def findings(recording: AnyRecording, settings: SlamConfig = DEFAULTS) -> tuple[Finding, ...]:
    """Return everything that is odd about a valid recording, the worst first; its truth is not looked at.

    The limits of its sensors are in force.
    """
    if is_in_space(recording):
        left_out = _find_left_out_in_space(recording, settings)
    else:
        left_out = _find_left_out_in_plane(recording, settings)
    found = [*left_out, *find_misreadings(recording, settings)]
    return tuple(sorted(found, key=lambda finding: finding.usable))


def find_misreadings(recording: AnyRecording, settings: SlamConfig) -> list[Finding]:
    """Return what is odd of units, axes, clocks, limits, identities and jumps, the worst first.

    That is all but what the estimator leaves out, and says so itself.
    """
    found = [*find_motion(recording, settings.check)]
    if is_in_space(recording) and all(finding.usable for finding in found):  # tags look turned by other mistakes, too
        found += _find_corner_order(recording, settings.check)
    found += _limits_in_space(recording, settings) if is_in_space(recording) else _limits(recording)
    if settings.unknown_ids is not True:
        found += _identities(recording, settings.check)
    if is_in_space(recording) and recording.odometry is not None and all(finding.usable for finding in found):
        found += _jumps(recording.odometry, settings.cleaning)
    if all(finding.usable for finding in found):
        found += _silences(recording, settings.check)
    return sorted(found, key=lambda finding: finding.usable)


def odd(recording: AnyRecording, settings: SlamConfig) -> tuple[Finding, ...]:
    """Return what was read wrongly: the first warnings of a run, and evidence for its verdict.

    Raises:
        DataError: identities that would cost gigabytes and tell nothing.
    """
    found = find_misreadings(recording, settings)
    for finding in found:
        if finding.is_refused:
            raise DataError(f"{recording.name}: {finding.message}", hint="leave landmark_id empty, and `unknown_ids`")
    return tuple(found)


def contents(recording: AnyRecording) -> dict[str, dict[str, Any]]:
    """Return rates, gaps, ways and coverage of a valid recording, in numbers."""
    frames, detections = recording.frames, recording.detections
    known = detections.landmark_id != UNKNOWN
    of_landmark = np.unique(detections.landmark_id[known], return_counts=True)[1]
    filled = np.unique(detections.frame)
    driven_s = frames.stamp_s if recording.odometry is None else recording.odometry.stamp_s
    seen_s = np.concatenate([driven_s[:1], frames.stamp_s[filled], driven_s[-1:]])
    inside = (frames.stamp_s >= driven_s[0]) & (frames.stamp_s <= driven_s[-1])
    return {
        "odometry": {} if recording.odometry is None else _way(recording.odometry),
        "frames": {
            "count": len(frames),
            "complete": frames.complete,
            "rate_hz": 1.0 / float(np.median(np.diff(frames.stamp_s))) if len(frames) > 1 else None,
            "with_detections": len(filled),
            "during_odometry": int(inside.sum()),
            "longest_blind_s": float(np.diff(np.sort(seen_s)).max()),
        },
        "detections": {
            "count": len(detections),
            "without_identity": int(np.sum(~known)),
            **(_find_seen_in_space(recording) if is_in_space(recording) else _find_seen(recording)),
        },
        "landmarks": {
            "count": len(of_landmark),
            "seen_once": int(np.sum(of_landmark == 1)),
            "median_detections": float(np.median(of_landmark)) if len(of_landmark) else None,
        },
        "measurements": {table.kind: len(table) for table in recording.measurements},
    }


def _way(odometry: Odometry | SpatialOdometry) -> dict[str, Any]:
    """Return rates, distances and speeds of the odometry."""
    step_s = np.diff(odometry.stamp_s)
    if isinstance(odometry, SpatialOdometry):
        step = np.abs(_velocity(odometry)) * step_s
        moved, turned = np.linalg.norm(step[:3], axis=0), np.linalg.norm(step[3:], axis=0)
        fastest = float(np.median(np.sort(moved / step_s)[-len(step_s) // 100 :]))  # a jump is no drive
    else:
        speed = np.hypot(odometry.forward_mps, odometry.lateral_mps)
        moved, turned = speed[:-1] * step_s, np.abs(odometry.angular_radps[:-1]) * step_s
        fastest = float(speed.max())
    return {
        "rows": len(odometry),
        "duration_s": float(odometry.stamp_s[-1] - odometry.stamp_s[0]),
        "rate_hz": 1.0 / float(np.median(step_s)),
        "longest_gap_s": float(step_s.max()),
        "way_m": float(np.sum(moved)),
        "turned_rad": float(np.sum(turned)),
        "fastest_mps": fastest,
    }


def _velocity(odometry: SpatialOdometry) -> FloatArray:
    """(6, N - 1) velocities between poses, along and about the robot's axes."""
    pose = odometry.pose_world_robot
    return np.asarray(se3.log(se3.between(pose[:-1], pose[1:])).T / np.diff(odometry.stamp_s))


def _find_seen(recording: Recording) -> dict[str, Any]:
    sensor, detections = recording.sensor, recording.detections
    aside = detections.bearing_rad > sensor.bearing_max_rad
    aside |= detections.bearing_rad < sensor.bearing_min_rad
    known = detections.bearing_rad[np.isfinite(detections.bearing_rad)]
    return {
        "range_m": np.quantile(detections.range_m, [0.0, 0.5, 1.0]).tolist(),
        "bearing_rad": np.quantile(known, [0.0, 0.5, 1.0]).tolist() if len(known) else None,
        "without_bearing": len(detections) - len(known),
        "beyond_range_max": int(np.sum(detections.range_m > sensor.range_max_m)),
        "outside_view": int(np.sum(aside)),
    }


def _find_seen_in_space(recording: SpatialRecording) -> dict[str, Any]:
    detections = recording.detections
    range_m = _ranges(recording)
    ranged = range_m[np.isfinite(range_m)]
    far, aside = _beyond(recording)
    return {
        "by_sensor": {one.name: int(np.sum(detections.sensor == row)) for row, one in enumerate(recording.sensors)},
        "with_corners": int(np.isfinite(detections.corner_px[:, 0, 0]).sum()),
        "with_orientation": int(np.isfinite(detections.rotation[:, 0]).sum()),
        "with_size": int(np.isfinite(detections.size_m[:, 0]).sum()),
        "without_range": int(np.sum(~np.isfinite(range_m))),
        "range_m": np.quantile(ranged, [0.0, 0.5, 1.0]).tolist() if len(ranged) else None,
        "beyond_range_max": int(far.sum()),
        "outside_view": int(aside.sum()),
    }


def _ranges(recording: SpatialRecording) -> FloatArray:
    """(M,) distances from the sensor; nan where only the direction was seen."""
    from evermap.slam.space.intake import positions_of, without_range

    return np.where(without_range(recording), np.nan, np.linalg.norm(positions_of(recording), axis=1))


def _beyond(recording: SpatialRecording) -> tuple[BoolArray, BoolArray]:
    """(M,) detections farther than their sensor sees, and (M,) tags that are not in the image, by more than noise."""
    detections, sensors = recording.detections, recording.sensors
    most_m = np.array([sensor.range_max_m for sensor in sensors])
    slack_m = np.array([4.0 * (sensor.sigma_m or 0.025 * min(sensor.range_max_m, 1e3)) for sensor in sensors])
    size_px = np.array([sensor.resolution_px or (np.inf, np.inf) for sensor in sensors])[detections.sensor][:, None]
    with np.errstate(invalid="ignore"):
        far = _ranges(recording) > (most_m + slack_m)[detections.sensor]
        outside = np.abs(detections.corner_px - 0.5 * size_px) > (0.5 + OUTSIDE) * size_px
    return np.asarray(far), np.asarray(outside.any(axis=(1, 2)))


def _limits_in_space(recording: SpatialRecording, settings: SlamConfig) -> list[Finding]:
    """Readings beyond what a sensor is said to reach or to show, and corners that no calibration goes with."""
    detections, (far, aside) = recording.detections, _beyond(recording)
    most = f"up to {_ranges(recording)[far].max(initial=0.0):.4g} m"
    other = "the calibration is for another resolution"
    found = [
        *_find_pose_convention(recording, settings.check),
        *_outside("beyond-range", far, f"detections are beyond range_max_m, {most}", _OTHER_UNIT),
        *_outside("beyond-view", aside, "tags have corners outside of the image", other),
    ]
    blind = np.array([sensor.intrinsics is None for sensor in recording.sensors])[detections.sensor]
    blind &= np.isfinite(detections.corner_px[:, 0, 0])
    if blind.any():
        name = recording.sensors[int(detections.sensor[blind][0])].name
        unused = f"the corners of {int(blind.sum())} tags are not used, only their poses"
        found.append(Finding("no-calibration", f"camera '{name}' has no calibration: {unused}"))
    return found


def find_corner_mistake(recording: SpatialRecording, settings: CheckConfig = USUAL) -> str:
    """Return how pixels of corners were written, a key of `CORNERS`, if landmarks stand still by that alone; '' if not.

    It is asked where tags look as if seen from behind. Corners that are all listed the other way round are no mistake
    by themselves: the normals of the tags point into the wall, as they may in a map, too.
    """
    before = pairs_of(recording, settings) if is_clockwise(recording).any() else None
    if before is None:
        return ""
    losses = {}
    for name in CORNERS:
        pairs = pairs_of(read_corners(recording, name), settings)
        losses[name] = np.inf if pairs is None else float(np.median(off(pairs.residual(HONEST))))
    best = min(losses, key=lambda name: losses[name])
    return best if losses[best] < FAR_LESS * float(np.median(off(before.residual(HONEST)))) else ""


def is_clockwise(recording: SpatialRecording) -> BoolArray:
    """Return (M,) which tags have their corners in clockwise order, by cameras nearly all of whose tags have."""
    corner, clockwise = recording.detections.corner_px, np.zeros(len(recording.detections), dtype=np.bool_)
    following = np.roll(corner, -1, axis=1)
    area_px2 = (corner[..., 0] * following[..., 1] - corner[..., 1] * following[..., 0]).sum(axis=1)  # v points down
    for row in range(len(recording.sensors)):
        mine = (recording.detections.sensor == row) & np.isfinite(area_px2)
        if mine.sum() >= FEWEST_TAGS and np.mean(area_px2[mine] > 0.0) > NEARLY_ALL:
            clockwise |= mine
    return clockwise


def read_corners(recording: SpatialRecording, how: str) -> SpatialRecording:
    """Return a recording with the corners of cameras that list them clockwise read in another way, of `CORNERS`.

    Poses of these tags follow from their corners: a reader has filled them in from the corners as they were written.
    """
    seen, clockwise = recording.detections, is_clockwise(recording)
    size = np.array([sensor.resolution_px or (0, 0) for sensor in recording.sensors], dtype=np.float64)[seen.sensor]
    corner = seen.corner_px.copy()
    corner[clockwise] = CORNERS[how].read(corner[clockwise], size[clockwise, None])
    read = with_square_poses(replace(seen, corner_px=corner), recording.sensors, clockwise)
    return replace(recording, detections=read)


def _find_pose_convention(recording: SpatialRecording, settings: CheckConfig) -> list[Finding]:
    convention = find_convention(recording, settings)
    return [Finding("detection-poses", SIGHTED[convention], usable=False)] if convention else []


def _find_corner_order(recording: SpatialRecording, settings: CheckConfig) -> list[Finding]:
    how = find_corner_mistake(recording, settings)
    return [Finding("corner-order", CORNERS[how].message, usable=False)] if how else []


def _find_left_out_in_plane(recording: Recording, settings: SlamConfig) -> list[Finding]:
    """Return detections that the estimator cannot use, and whether there are too few others."""
    from evermap.slam.intake import prepare
    from evermap.slam.ranges import with_bearings

    known, some = recording.detections.landmark_id != UNKNOWN, recording
    if settings.unknown_ids or not known.any():  # any identity will do: what else is wrong with them?
        some = replace(recording, detections=replace(recording.detections, landmark_id=np.zeros_like(known, int)))
    try:
        some, told = with_bearings(some, settings) if some is recording else (some, ())
        remarks = (*told[1:], *prepare(some, settings=settings.odometry).warnings)  # the first counts ranges alone
    except DataError as error:
        return [_refusal("too-little", error.one_line().removeprefix(f"{recording.name}: "))]
    return [Finding("left-out", remark) for remark in remarks]


def _find_left_out_in_space(recording: SpatialRecording, settings: SlamConfig) -> list[Finding]:
    """Return detections that the estimator cannot use. Boxes without identity are associated by position."""
    from evermap.slam.space.intake import prepare_space
    from evermap.slam.space.moving import has_traffic
    from evermap.tracking.frame import boxes_of

    some, unknown = recording, recording.detections.landmark_id == UNKNOWN
    if has_traffic(recording):
        others = np.setdiff1d(np.arange(len(recording.detections)), boxes_of(recording))
        some = replace(recording, detections=rows_of(recording.detections, others))
    elif settings.unknown_ids or unknown.all():  # any identity will do: what else is wrong with them?
        some = replace(recording, detections=replace(recording.detections, landmark_id=np.zeros_like(unknown, int)))
    try:
        remarks = prepare_space(some, settings.space, fewest=0 if some is not recording else 2).warnings
    except DataError as error:
        return [_refusal("too-little", error.one_line().removeprefix(f"{recording.name}: "))]
    return [Finding("left-out", remark) for remark in remarks]


def _jumps(odometry: SpatialOdometry, settings: CleaningConfig) -> list[Finding]:
    """Steps between two poses that no robot drives."""
    velocity = _velocity(odometry)
    rows = np.flatnonzero(find_spikes(odometry.stamp_s[1:], velocity, settings))
    if not len(rows):
        return []
    step = velocity[:, rows] * np.diff(odometry.stamp_s)[rows]
    most = np.linalg.norm(step.reshape(2, 3, -1), axis=1).max(axis=1)
    message = (
        f"odometry jumps {len(rows)} times, by up to {most[0]:.2g} m and {most[1]:.2g} rad within a step, "
        f"first {odometry.stamp_s[rows[0] + 1] - odometry.stamp_s[0]:.1f} s after its start: an estimate that is "
        "corrected, or another frame"
    )
    return [Finding("odometry-jumps", message)]


def _silences(recording: AnyRecording, settings: CheckConfig) -> list[Finding]:
    """Times for which the odometry says nothing, or that the robot stands, although it drives."""
    odometry, silence_s = recording.odometry, find_silences(recording, settings)
    if odometry is None or not len(silence_s):
        return []
    longest = silence_s[int(np.argmax(silence_s[:, 1] - silence_s[:, 0]))]
    times = "once" if len(silence_s) == 1 else f"{len(silence_s)} times"
    message = (
        f"odometry is silent {times} while the robot drives, for {longest[1] - longest[0]:.1f} s from "
        f"{longest[0] - odometry.stamp_s[0]:.1f} s after its start on: no rows, or rows that say that it stands, "
        "which are not used"
    )
    return [Finding(SILENCE, message)]


def _limits(recording: Recording) -> list[Finding]:
    """Readings beyond what the sensor is said to reach, by more than its noise."""
    sensor, detections = recording.sensor, recording.detections
    slack_m = 4.0 * (sensor.sigma_range_m or 0.025 * min(sensor.range_max_m, 1e3))
    slack_rad = 4.0 * (sensor.sigma_bearing_rad or 0.0125)
    far, bearing = detections.range_m > sensor.range_max_m + slack_m, detections.bearing_rad
    aside = (bearing > sensor.bearing_max_rad + slack_rad) | (bearing < sensor.bearing_min_rad - slack_rad)
    most = f"range_max_m = {sensor.range_max_m:g}, up to {detections.range_m.max(initial=0.0):.4g} m"
    view = f"{sensor.bearing_min_rad:.4g} to {sensor.bearing_max_rad:.4g} rad"
    return [
        *_outside("beyond-range", far, f"ranges lie beyond {most}", _OTHER_UNIT),
        *_outside("beyond-view", aside, f"bearings lie outside of the field of view, {view}", _OTHER_SIGN),
    ]


def _outside(code: str, off: BoolArray, what: str, cause: str) -> list[Finding]:
    """Readings that are `off` (M,) limits; a `cause` of so many that they are no outliers."""
    if not off.any():
        return []
    return [Finding(code, f"{int(off.sum())} of {len(off)} {what}: {cause if np.mean(off) > 0.05 else 'outliers'}")]


def _identities(recording: AnyRecording, settings: CheckConfig) -> list[Finding]:
    """Identities that never come back."""
    detections = recording.detections
    known = detections.landmark_id != UNKNOWN
    pairs = np.unique(np.column_stack([detections.landmark_id, detections.frame])[known], axis=0)
    frames_of_landmark = np.unique(pairs[:, 0], return_counts=True)[1]
    count, again = len(frames_of_landmark), int(np.sum(frames_of_landmark > 1))
    if count < settings.fewest or again > 0.1 * count:
        return []
    message = (
        f"{count} landmarks in {int(known.sum())} detections, {again} of them seen more than once: landmark_id must "
        f"identify the landmark, the same each time, not the detection"
    )
    return [Finding("own-identities", message) if count < settings.own_ids else _refusal("own-identities", message)]


def _refusal(code: str, message: str) -> Finding:
    """Return a finding of a recording from which nothing can be estimated."""
    return Finding(code, message, usable=False, is_refused=True)


def valid(recording: AnyRecordingT, sensor: SensorConfig, prior_map: Landmarks | None = None) -> AnyRecordingT:
    """Return the recording with the sensors that the configuration states.

    Raises:
        InputError: no `Recording`, or values that cannot be, in it or in the prior map.
        DataError: nothing can be estimated from it.
    """
    validate(recording)
    if prior_map is not None:
        check_landmarks(prior_map, "prior_map")
    return _with_sensors(recording, sensor)


def _with_sensors(recording: AnyRecordingT, sensor: SensorConfig) -> AnyRecordingT:
    if recording.dim == 3:
        return replace(recording, sensors=sensor.apply_in_space(recording.sensors))
    return replace(recording, sensor=sensor.apply_to(recording.sensor))


def leave_out_riders_in_space(recording: Any, settings: SlamConfig) -> tuple[Any, tuple[Finding, ...]]:
    """Return the same as `leave_out_riders` of a recording in space, of which it is to be decided whether it is on a
    floor; one in the plane as it is.
    """
    check_type(recording)
    return leave_out_riders(recording, settings) if is_in_space(recording) else (recording, ())


def leave_out_riders(recording: Any, settings: SlamConfig) -> tuple[Any, tuple[Finding, ...]]:
    """Return a recording without what moves with the robot, which is no landmark, and a finding that says so.

    It comes before all else that is asked of a recording: what rides along is in every frame, and contradicts it all.
    """
    if settings.unknown_ids is True:
        return recording, ()
    riders = find_riders(recording, settings.check)
    if not len(riders):
        return recording, ()
    names = ", ".join(str(recording.landmark_names.get(one, one)) for one in riders.tolist())
    where = "is where it was in the sensor's view" if len(riders) == 1 else "are where they were in the sensor's view"
    message = (
        f"landmark {names} {where} while the robot moves: on the robot itself, or on what it tows or follows; its "
        "detections are not used"
    )
    return without_riders(recording, riders), (Finding(RIDER, message),)


@overload
def screened(
    recording: Recording, config: Config, prior_map: Landmarks | None = ..., *, repair: bool = ...
) -> tuple[Recording, tuple[str, ...], tuple[Finding, ...]]: ...
@overload
def screened(
    recording: SpatialRecording, config: Config, prior_map: Landmarks | None = ..., *, repair: bool = ...
) -> tuple[SpatialRecording, tuple[str, ...], tuple[Finding, ...]]: ...
def screened(
    recording: Any, config: Config, prior_map: Landmarks | None = None, *, repair: bool = False
) -> tuple[Any, tuple[str, ...], tuple[Finding, ...]]:
    """Return a recording without ids that other detections contradict, remarks on it, and what was read wrongly.

    One without ids to use is returned as it is. With `repair`, what is impossible in a
    recording in the plane is left out (`slam.cleaning`), instead of refused.

    Raises:
        InputError: no recording, or values that cannot be, in it or in the prior map.
        DataError: nothing can be estimated from it.
    """
    from evermap.slam.ranges import with_bearings
    from evermap.slam.space.moving import has_traffic
    from evermap.slam.votes import without_contradicted_ids

    settings = config.slam
    if repair and not is_in_space(recording):
        recording = clean(_with_sensors(recording, config.sensor), settings.cleaning)
    else:
        recording = valid(recording, config.sensor, prior_map)
    recording, riders = leave_out_riders(recording, settings)
    found = (*riders, *odd(recording, settings))
    remarks = tuple(finding.message for finding in found)
    if any(finding.code == SILENCE for finding in found):
        recording = without_silences(recording, find_silences(recording, settings.check))
    if prior_map is not None and settings.unknown_ids is not True and (apart := strangers(prior_map, [recording])):
        remarks = (*remarks, apart)
    if not is_in_space(recording):
        try:
            recording, told = with_bearings(recording, settings)
        except DataError:
            wrong = next((finding for finding in found if not finding.usable), None)
            if wrong is None:
                raise
            hint = "ranges in metres: as they are they locate nothing"
            raise DataError(f"{recording.name}: {wrong.message}", hint=hint) from None
        remarks = (*remarks, *told)
    if settings.unknown_ids is True or not settings.vote_ids or has_traffic(recording):  # the tracker assigns ids
        return recording, remarks, found
    voted = without_contradicted_ids(recording, settings)
    remarks = (*remarks, *voted.warnings[len(recording.warnings) :])
    return replace(voted, warnings=recording.warnings), remarks, found


def check_recording(recording: AnyRecording, config: Config | None = None) -> Check:
    """Return a summary of a recording, and its problems: units, signs, clocks, identities, limits, gaps, jumps.

    `run_slam`, `run_session` and `run_localization` tell the same in the warnings of their results.

    Args:
        recording: what a reader returned; its truth is not looked at.
        config: settings; None for the defaults. In the plane its section `sensor` may correct the sensor's limits.

    Raises:
        InputError: no recording, or one with values that cannot be.
        DataError: nothing can be estimated from it.
    """
    from evermap.slam.plane import in_its_space
    from evermap.slam.space.moving import has_traffic

    config = config or Config()
    settings = config.slam
    recording, riders = leave_out_riders_in_space(recording, settings)
    recording = in_its_space(recording, settings)
    recording = valid(recording, config.sensor)  # type: ignore[type-var]
    recording, others = leave_out_riders(recording, settings)
    found = (*findings(recording, settings), *riders, *others)
    anonymous = (recording.detections.landmark_id == UNKNOWN).all()
    if anonymous and not (settings.unknown_ids or has_traffic(recording)):
        found = (_refusal("no-identities", f"no detection has a landmark_id: {WITHOUT_IDS}"), *found)
    return Check(recording.name, recording.source, contents(recording), found, recording.warnings)
