"""Recordings for rerun: a run with its map growing along the timeline, and a tracker at work."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evermap.errors import MissingExtraError
from evermap.estimate.innovations import comparable_nis
from evermap.geometry import se3
from evermap.geometry.group import group_of
from evermap.geometry.upright import move_map
from evermap.metrics.consistency import chi2_interval
from evermap.metrics.summary import Evaluation, compare_with_truth
from evermap.types import (
    AnyRecording,
    BoolArray,
    Clock,
    FloatArray,
    IntArray,
    Landmarks,
    SlamResult,
    is_in_space,
    landmark_label,
    rows_of,
)
from evermap.viz.map_figure import class_names_of, moves
from evermap.viz.panels import box_sizes, corners_of, landmark_poses, long_gaps
from evermap.viz.style import ALERT, DYNAMIC, ESTIMATE, INK, LANDMARK, MUTED, ODOMETRY, PAPER, STATIC, class_looks


def require_rerun() -> None:
    """Make sure that rerun-sdk (extra `evermap[rerun]`) can be imported.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        hint = "pip install 'evermap[rerun]'"
        raise MissingExtraError("a rerun scene needs rerun-sdk, which is not installed", hint=hint) from error


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue in [0, 255] of a colour of `style`, `#rrggbb`."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


TIMELINE = "stamp_s"
_MAX_STEPS = 3000
_STEP_M = 0.1
"""Interval between the points of a live path."""
_MAX_LANDMARK_ENTITIES = 250
_ELLIPSE_CORNERS = 33
_ROOM_M = 4.0
"""Scene size below which robot and landmarks are drawn smaller, such as on a table."""
_SINCE_1970_S = 1e8
"""Stamps above this are dates."""
_PLATE_M = (0.16, 0.16, 0.004)
"""Drawn size of a tag of unknown size."""

Float32Array = NDArray[np.float32]


def _open_recording(recording_id: str, path: str | Path | None, blueprint: Any = None) -> tuple[Any, Any]:
    """Return rerun, and a recording in a file, or in the viewer without a path.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    require_rerun()
    import rerun as rr

    stream = rr.RecordingStream("evermap", recording_id=recording_id, send_properties=False)
    if path is None:
        stream.spawn()
    else:
        stream.save(path, default_blueprint=blueprint)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    return rr, stream


def _close_panels(timeline: str) -> list[Any]:
    import rerun.blueprint as rrb

    time = rrb.TimePanel(timeline=timeline, state="collapsed")
    return [time, rrb.SelectionPanel(state="collapsed"), rrb.BlueprintPanel(state="collapsed")]


def write_scene(
    recording: AnyRecording, result: SlamResult, path: str | Path, *, evaluation: Evaluation | None = None
) -> Path:
    """Write `path` (.rrd): robot, path so far, landmarks as they appear, what changed, rays of detections, truth, NIS.

    Everything is in the frame of the truth where there is one, else in the map's. Time is the recording's own,
    on the timeline `stamp_s`: dates, or seconds where its clock has an arbitrary start.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    _RunScene(recording, result, evaluation or compare_with_truth(recording, result)).write(Path(path))
    return Path(path)


class _RunScene:
    """A run in the frame of the picture.

    Attributes:
        group: of its poses.
        pose: (3,) or (7,) from the map's frame to that of the picture.
        landmarks: the map there.
        scale: size of robot and landmarks, smaller where all is on a table.
    """

    def __init__(self, recording: AnyRecording, result: SlamResult, evaluation: Evaluation) -> None:
        self._recording, self._result, self._evaluation = recording, result, evaluation
        trajectory = result.trajectory
        self.group = group_of(trajectory.pose_world_robot)
        self.pose = self.group.identity() if evaluation.poses is None else evaluation.poses.pose_truth_estimate
        self.landmarks = move_map(result.landmarks, self.pose)
        self._way = _places(self.pose, trajectory.pose_world_robot)
        low, high = corners_of([self._way, self.landmarks.position_m])
        self.scale = float(np.clip(np.max(high - low) / _ROOM_M, 0.1, 1.0))

    def write(self, path: Path) -> None:
        """Write all of it; errors as of `write_scene`."""
        require_rerun()
        self._rr, self._stream = _open_recording(self._recording.name or "run", path, self._blueprint())
        self._stream.send_recording_name(self._recording.name)
        self._send_truth()
        self._send_odometry()
        if len(self._result.trajectory):
            self._send_robot()
        if len(self.landmarks):
            self._send_landmarks()
        self._send_changes()
        if self._result.followed is not None:
            self._send_moving()
        if len(self._result.trajectory) and len(self._recording.frames):
            self._send_rays()
        self._send_numbers()
        self._stream.flush()
        self._stream.disconnect()

    def _blueprint(self) -> Any:
        import rerun.blueprint as rrb

        recording, positions = self._recording, _flat(self._way)
        centre = positions.mean(axis=0) if len(positions) else np.zeros(3)
        reach = float(np.max(np.ptp(positions, axis=0))) if len(positions) else 10.0
        ends: Any = {"start": rrb.TimeRangeBoundary.infinite(), "end": rrb.TimeRangeBoundary.cursor_relative()}
        scene = rrb.Spatial3DView(
            name=recording.name,
            origin="world",
            overrides={"world/path": rrb.VisibleTimeRanges(rrb.VisibleTimeRange(TIMELINE, **ends))},
            eye_controls=rrb.EyeControls3D(
                position=[centre[0], centre[1] - 0.6 * reach, centre[2] + 1.1 * reach + 1.0],
                look_target=centre,
                eye_up=[0.0, 0.0, 1.0],
            ),
            line_grid=rrb.LineGrid3D(spacing=1.0),
        )
        whole = None
        if len(recording.frames):
            times = [rrb.TimeRangeBoundary.absolute(seconds=float(recording.frames.stamp_s[k])) for k in (0, -1)]
            whole = rrb.TimeAxis(view_range=rrb.TimeRange(*times))
        shown = {"nis": "NIS, log10 (95% band)", "latency": "step [ms]"}
        if recording.truth is not None:
            shown = {"error": "error against truth [m]", "turn": "orientation error [deg]", **shown}
        plots = [rrb.TimeSeriesView(name=title, origin=origin, axis_x=whole) for origin, title in shown.items()]
        views = rrb.Horizontal(scene, rrb.Vertical(*plots), column_shares=[5, 3])
        return rrb.Blueprint(views, *_close_panels(TIMELINE))

    def _times(self, stamp_s: FloatArray) -> list[Any]:
        return [self._rr.TimeColumn(TIMELINE, **{_kind(self._recording.clock): stamp_s})]

    def _at(self, stamp_s: float) -> None:
        self._stream.set_time(TIMELINE, **{_kind(self._recording.clock): stamp_s})

    def _send_truth(self) -> None:
        rr, truth, survey = self._rr, self._recording.truth, self._recording.true_landmarks
        if self._evaluation.poses is None:
            return
        if truth is not None:
            poses = truth.pose_world_robot[_thin(len(truth))]
            line = _flat(_places(group_of(poses).identity(), poses), -0.01)
            self._stream.log("world/truth/path", rr.LineStrips3D([line], colors=rgb(MUTED), radii=0.012), static=True)
        if survey is not None:
            points = _flat(survey.position_m)
            size = np.full((len(points), 3), [0.07, 0.07, 0.002 if self._evaluation.poses.dof == 2 else 0.07])
            boxes = rr.Boxes3D(centers=points, half_sizes=size, colors=rgb(MUTED))
            self._stream.log("world/truth/landmarks", boxes, static=True)

    def _send_odometry(self) -> None:
        aligned, poses = self._evaluation.dead_reckoning, self._result.dead_reckoning.pose_world_robot
        if len(poses) == 0:
            return
        pose = group_of(poses).identity() if aligned is None else aligned.pose_truth_estimate
        line = _places(pose, poses[_thin(len(poses))])
        strip = self._rr.LineStrips3D([_flat(line, -0.02)], colors=rgb(ODOMETRY), radii=0.006)
        self._stream.log("world/odometry_alone", strip, static=True)

    def _send_robot(self) -> None:
        """The robot's pose, and the path as one short piece a step that stays visible afterwards."""
        rr, scale, trajectory, group = self._rr, self.scale, self._result.trajectory, self.group
        rows = _thin(len(trajectory))
        poses = group.compose(self.pose, trajectory.pose_world_robot[rows])
        stamps, at = trajectory.stamp_s[rows], poses[:, : group.point_dim]
        quaternion = (poses if group.point_dim == 3 else se3.from_plane(poses))[:, 3:]
        places = rr.Transform3D.columns(translation=_flat(at), quaternion=quaternion)
        self._stream.send_columns("world/robot", self._times(stamps), places)
        half, ahead = scale * np.array([0.17, 0.12, 0.06]), scale * np.array([0.4, 0.0, 0.0])
        body = rr.Boxes3D(half_sizes=[half], centers=[[0, 0, half[2]]], colors=rgb(ESTIMATE), fill_mode="solid")
        heading = rr.Arrows3D(vectors=[ahead], origins=[[0, 0, 0.1 * scale]], colors=rgb(ESTIMATE), radii=0.02 * scale)
        if group.point_dim == 3:  # a camera that is carried may look along any of its axes
            colours = [rgb(colour) for colour in (ALERT, LANDMARK, ESTIMATE)]
            axes = 0.4 * scale * np.eye(3)
            heading = rr.Arrows3D(vectors=axes, origins=np.zeros((3, 3)), colors=colours, radii=0.015 * scale)
        self._stream.log("world/robot/body", body, static=True)
        self._stream.log("world/robot/heading", heading, static=True)
        if len(rows) > 1:
            points = _flat(at, 0.01)
            pieces = np.delete(np.stack([points[:-1], points[1:]], axis=1), long_gaps(stamps), axis=0)
            times = self._times(np.delete(stamps[1:], long_gaps(stamps)))
            self._stream.send_columns("world/path", times, rr.LineStrips3D.columns(strips=pieces))
            look = rr.LineStrips3D.from_fields(colors=rgb(ESTIMATE), radii=0.012)
            self._stream.log("world/path", look, static=True)

    def _send_landmarks(self) -> None:
        """Send final positions with 2-sigma ellipses by class, each from its first sighting on, as faint as it is
        doubtful; large maps in groups.
        """
        rr, landmarks, trajectory = self._rr, self.landmarks, self._result.trajectory
        start_s = float(trajectory.stamp_s[0]) if len(trajectory) else 0.0
        first_s = np.where(np.isfinite(landmarks.first_seen_s), landmarks.first_seen_s, start_s)
        points = _flat(landmarks.position_m)
        ellipses = _ellipses(points, landmarks.covariance_m2)
        looks, classes = class_looks(landmarks.class_names), class_names_of(landmarks)
        p = landmarks.p_exists[:, None]
        colours = (p * [rgb(looks[name].colour) for name in classes] + (1.0 - p) * rgb(PAPER)).astype(np.uint8)
        called = np.array([
            name + (f" ({of})" if of else "") + (f" {p:.2f}" if p < 0.995 else "")
            for name, of, p in zip(landmarks.labels, classes, landmarks.p_exists.tolist(), strict=True)
        ])  # fmt: skip
        order = np.argsort(first_s, kind="stable")
        for group in np.array_split(order, min(len(order), _MAX_LANDMARK_ENTITIES)):
            names = [landmark_label(one, {}) for one in landmarks.landmark_id[group].tolist()]  # a path has no spaces
            entity = f"world/landmarks/{names[0]}" + (f"_and_{len(names) - 1}_more" if len(names) > 1 else "")
            self._at(float(first_s[group].max()))
            marks = rr.Points3D(points[group], colors=colours[group], radii=0.05 * self.scale,
                                labels=called[group].tolist(), show_labels=len(order) <= 60)  # fmt: skip
            self._stream.log(entity, marks)
            lines, repeated = np.concatenate(ellipses[group]), np.repeat(colours[group], ellipses.shape[1], axis=0)
            self._stream.log(f"{entity}/two_sigma", rr.LineStrips3D(lines, colors=repeated, radii=0.008))
            self._send_bodies(entity, rows_of(landmarks, group), colours[group])
        self._stream.reset_time()

    def _send_bodies(self, entity: str, landmarks: Landmarks, colours: NDArray[np.uint8]) -> None:
        """Boxes as large as they are, and plates where tags are, turned as the map says."""
        if landmarks.rotation is None:
            return
        poses = landmark_poses(landmarks)
        rows = np.flatnonzero(np.isfinite(poses).all(axis=1))
        if not len(rows):
            return
        size = box_sizes(landmarks)[rows]
        size = np.where(np.isfinite(size).all(axis=1, keepdims=True), size, _PLATE_M)
        bodies = self._rr.Boxes3D(
            half_sizes=0.5 * size, centers=poses[rows, :3], quaternions=poses[rows, 3:], colors=colours[rows]
        )
        self._stream.log(f"{entity}/body", bodies)

    def _send_changes(self) -> None:
        """Arrows from where landmarks were to where they are, from the time on at which the change is over."""
        for number, move in enumerate(moves(self._result, self.pose), start=1):
            arrows = self._rr.Arrows3D(
                origins=_flat(move.before_m, 0.02),
                vectors=_flat(move.after_m - move.before_m),
                colors=rgb(move.colour),
                radii=0.01 if move.alternative else 0.02,
                labels=[move.label] * len(move.before_m),
                show_labels=False,
            )
            self._at(move.change.stamp_to_s)
            self._stream.log(f"world/changes/{number}", arrows)
        self._stream.reset_time()

    def _send_moving(self) -> None:
        """Boxes of what was followed, in the frames in which it moved; what stood from first to last is a landmark."""
        followed = self._result.followed
        tracks, p_static, stamps = followed.tracks, followed.p_static, followed.table.stamp_s
        stood = np.zeros(len(tracks), dtype=np.bool_) if p_static is None else p_static >= 0.5
        rows = np.flatnonzero(followed.confirmed & ~tracks.static & ~stood & (tracks.p_exists >= 0.5))
        rows = rows[np.argsort(tracks.stamp_s[rows], kind="stable")]
        names, of = followed.table.class_names, tracks.class_p[rows].argmax(axis=1)
        looks = class_looks(names)
        poses, size = se3.identity(len(rows)), np.full((len(rows), 3), 2.0 * RADIUS_M)
        poses[:, :3] = tracks.position_m[rows]
        if tracks.box.shape[1]:
            size, half = tracks.box[rows, :3], 0.5 * tracks.box[rows, 3]
            poses[:, 5:] = np.column_stack([np.sin(half), np.cos(half)])
        poses = se3.compose(self.pose, poses)
        count = np.bincount(np.searchsorted(stamps, tracks.stamp_s[rows]), minlength=len(stamps))
        columns = self._rr.Boxes3D.columns(
            half_sizes=0.5 * size,
            centers=poses[:, :3],
            quaternions=poses[:, 3:],
            colors=np.array([rgb(looks[names[kind]].colour) for kind in of], dtype=np.uint8).reshape(-1, 3),
            labels=[f"{names[kind]} {one}" for kind, one in zip(of, tracks.track_id[rows].tolist(), strict=True)],
        )
        # a row for frames without any, too, or the last ones would stay
        self._stream.send_columns("world/moving", self._times(stamps), columns.partition(lengths=count))
        self._stream.log("world/moving", self._rr.Boxes3D.from_fields(show_labels=False), static=True)

    def _send_rays(self) -> None:
        """Each frame's detections as rays from the sensor to where they put their landmark; raw readings."""
        frames, detections = self._recording.frames, self._recording.detections
        trajectory, group, landmarks = self._result.trajectory, self.group, self.landmarks
        kept = _thin(len(frames))
        stamps = frames.stamp_s[kept]
        within = (stamps >= trajectory.stamp_s[0]) & (stamps <= trajectory.stamp_s[-1])
        kept, stamps = kept[within], stamps[within]
        nearest = np.clip(np.searchsorted(trajectory.stamp_s, stamps), 0, len(trajectory) - 1)
        robot = group.compose(self.pose, trajectory.pose_world_robot[nearest])
        row_of = np.full(len(frames), -1)
        row_of[kept] = np.arange(len(kept))
        mount, ends = _readings(self._recording)
        used = np.flatnonzero(row_of[detections.frame] >= 0)
        row = row_of[detections.frame[used]]
        sensor = group.compose(robot[row], mount[used])
        ends = group.transform(sensor, ends[used])
        place = dict(zip(landmarks.landmark_id.tolist(), landmarks.position_m, strict=True))
        for k in np.flatnonzero(~np.isfinite(ends[:, 0])):  # an image has no depth
            ends[k] = place.get(int(detections.landmark_id[used[k]]), ends[k])
        shown = np.isfinite(ends).all(axis=1)
        row, sensor, ends = row[shown], sensor[shown], ends[shown]
        rays = np.stack([_flat(sensor[:, : group.point_dim], 0.1), _flat(ends, 0.05)], axis=1)
        counts = np.bincount(row, minlength=len(kept))
        columns = self._rr.LineStrips3D.columns(strips=rays).partition(lengths=counts)
        self._stream.send_columns("world/detections", self._times(stamps), columns)
        look = self._rr.LineStrips3D.from_fields(colors=rgb(ALERT), radii=0.006)
        self._stream.log("world/detections", look, static=True)

    def _send_numbers(self) -> None:
        """NIS with its band, latency and, with truth, the position error with its 2-sigma band."""
        innovations, nis = self._result.innovations, comparable_nis(self._result.innovations)
        finite = np.flatnonzero(np.isfinite(nis) & (nis > 0))
        if len(finite):
            rows = finite[_thin(len(finite))]
            points = self._rr.SeriesPoints(colors=rgb(ESTIMATE), marker_sizes=1.5)
            self._plot("nis/detection", innovations.stamp_s[rows], np.log10(nis[rows]), look=points)
            for name, level in zip(("low", "high"), chi2_interval(2), strict=True):
                ends = innovations.stamp_s[rows[[0, -1]]]
                self._plot(f"nis/{name}", ends, np.full(2, np.log10(level)), MUTED)
        step_s = self._result.step_s
        if len(step_s) and len(step_s) == len(self._result.online):
            rows = _thin(len(step_s))
            self._plot("latency/step_ms", self._result.online.stamp_s[rows], 1e3 * step_s[rows])
        poses = self._evaluation.poses
        if poses is not None:
            rows = _thin(len(poses.stamp_s))
            stamps, size = poses.stamp_s[rows], poses.dof
            band = 2.0 * np.sqrt(np.trace(poses.covariance[rows, :size, :size], axis1=1, axis2=2))
            self._plot("error/position_m", stamps, poses.position_error_m[rows])
            if size == 3:
                self._plot("turn/orientation_deg", stamps, np.degrees(poses.orientation_error_rad[rows]))
            self._plot("error/two_sigma_m", stamps, band, MUTED)
        about = f"{self._recording.name}\n\nsource: {self._recording.source}"
        self._stream.log("about", self._rr.TextDocument(about), static=True)

    def _plot(
        self, entity: str, stamp_s: FloatArray, values: FloatArray, colour: str = ESTIMATE, look: Any = None
    ) -> None:
        self._stream.log(entity, look or self._rr.SeriesLines(colors=rgb(colour), widths=1.5), static=True)
        self._stream.send_columns(entity, self._times(stamp_s), self._rr.Scalars.columns(scalars=values))


def _kind(clock: Clock) -> str:
    """Return the kind of rerun's timeline: dates, or seconds since a start."""
    return "duration" if clock is Clock.RECORDING else "timestamp"


def _thin(count: int) -> IntArray:
    """Return the kept rows of a long sequence, including both ends."""
    if not count:
        return np.zeros(0, int)
    return np.unique(np.linspace(0, count - 1, min(count, _MAX_STEPS)).round().astype(np.int64))


def _flat(points: FloatArray, height_m: float = 0.0) -> Float32Array:
    """Points (..., 2) on a horizontal plane, at a height that keeps them apart; points (..., 3) as they are."""
    if points.shape[-1] == 3:
        return points.astype(np.float32)
    return np.concatenate([points, np.full((*points.shape[:-1], 1), height_m)], axis=-1).astype(np.float32)


def _places(pose_truth_map: FloatArray, poses: FloatArray) -> FloatArray:
    """Positions (N, D) of poses in the frame of the picture."""
    group = group_of(pose_truth_map)
    return group.compose(pose_truth_map, poses)[:, : group.point_dim]


def _ellipses(points: Float32Array, covariance: FloatArray) -> Float32Array:
    """2-sigma outlines (L, 1, corners, 3) on the floor; in space (L, 3, corners, 3), one through every two axes."""
    variance, axis = np.linalg.eigh(covariance)
    root = axis * np.sqrt(np.maximum(variance, 0.0))[:, None, :]
    angle = np.linspace(0, 2 * np.pi, _ELLIPSE_CORNERS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    across = [list(pair) for pair in combinations(range(root.shape[1]), 2)]
    outlines = [_flat(np.swapaxes(2.0 * root[..., pair] @ circle, 1, 2)) for pair in across]
    return np.asarray(points[:, None, None, :] + np.stack(outlines, axis=1), dtype=np.float32)


def _readings(recording: AnyRecording) -> tuple[FloatArray, FloatArray]:
    """Pose of the sensor on the robot and place in the sensor's frame of each detection, nan where it has no depth."""
    if is_in_space(recording):
        mounts = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])
        return mounts[recording.detections.sensor], recording.detections.position_sensor_m
    bearing, range_m = recording.detections.bearing_rad, recording.detections.range_m
    place = range_m[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return np.tile(recording.sensor.mount_robot_sensor, (len(range_m), 1)), place


class LiveScene:
    """A drive that is shown while it happens: in the viewer of rerun, or in a file for it.

    Args:
        path: of the file (.rrd); None opens the viewer.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self._before = np.zeros((0, 3))
        self._rr, self._stream = _open_recording("live", path)
        arrow = self._rr.Arrows3D(
            vectors=[[0.4, 0.0, 0.0]], origins=[[0.0, 0.0, 0.1]], colors=rgb(ESTIMATE), radii=0.05
        )
        self._stream.log("world/robot/heading", arrow, static=True)

    def robot(self, stamp_s: float, position_m: FloatArray, quaternion: FloatArray) -> None:
        """Show where the robot is, and where it came from."""
        self._at(stamp_s)
        self._stream.log(
            "world/robot", self._rr.Transform3D(translation=position_m, quaternion=self._rr.Quaternion(xyzw=quaternion))
        )
        if not len(self._before) or np.linalg.norm(position_m - self._before[-1]) > _STEP_M:
            self._before = np.vstack([self._before, position_m])[-_MAX_STEPS:]
            self._stream.log("world/path", self._rr.LineStrips3D([self._before], colors=rgb(ESTIMATE), radii=0.012))

    def landmark(self, stamp_s: float, name: str, position_m: FloatArray, p_exists: float, text: str) -> None:
        """Show a landmark, as faint as it is doubtful."""
        self._at(stamp_s)
        colour = (p_exists * np.array(rgb(LANDMARK)) + (1.0 - p_exists) * np.array(rgb(PAPER))).astype(np.uint8)
        mark = self._rr.Points3D([position_m], colors=colour, radii=0.05, labels=[text], show_labels=False)
        self._stream.log(["world", "landmarks", name], mark)

    def change(self, stamp_s: float, name: str, line_m: FloatArray, text: str) -> None:
        """Show a change as an arrow between two places, and as a line of the log."""
        self._at(stamp_s)
        vector = line_m[1] - line_m[0]
        arrow = self._rr.Arrows3D(origins=[line_m[0]], vectors=[vector], colors=rgb(ALERT), radii=0.02, labels=[text])
        self._stream.log(["world", "landmarks", name], arrow)
        self._stream.log("changes", self._rr.TextLog(text))

    def erase(self, stamp_s: float, name: str) -> None:
        """Show a landmark no more."""
        self._at(stamp_s)
        self._stream.log(["world", "landmarks", name], self._rr.Clear(recursive=True))

    def close(self) -> None:
        """End the file; a viewer stays open."""
        self._stream.flush()
        self._stream.disconnect()

    def _at(self, stamp_s: float) -> None:
        clock = Clock.UNIX if stamp_s > _SINCE_1970_S else Clock.RECORDING
        self._stream.set_time(TIMELINE, **{_kind(clock): stamp_s})


TRACKS_TIMELINE = "time"
RADIUS_M = 0.3
ROUND = 64
"""Corners of the circle around the sensor."""


def log_tracks(
    path: str | Path,
    *,
    stamp_s: FloatArray,
    track_id: Sequence[IntArray],
    position_m: Sequence[FloatArray],
    static: Sequence[BoolArray],
    resting_m: Sequence[FloatArray],
    sensor_m: FloatArray | None = None,
    reach_m: float | None = None,
) -> Path:
    """Write `path` (.rrd): tracklets with their ids, static blue and dynamic purple, and resting objects, smaller.

    Args:
        path: of the file.
        stamp_s: (F,).
        track_id: (F) of (N,) active tracklets.
        position_m: (F) of (N, 3).
        static: (F) of (N,) whether each is static.
        resting_m: (F) of (K, 3) places of the objects in the working set.
        sensor_m: (F, 3), if it is known.
        reach_m: radius in which it sees, if there is one.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    require_rerun()
    path = Path(path)
    rr, stream = _open_recording(path.stem, path, _tracks_blueprint())
    times = [rr.TimeColumn(TRACKS_TIMELINE, duration=stamp_s)]
    colours = [np.where(rest[:, None], rgb(STATIC), rgb(DYNAMIC)).astype(np.uint8) for rest in static]
    labels = [str(one) for ids in track_id for one in ids.tolist()]
    active = {"colors": np.concatenate(colours), "labels": labels}
    for entity, clouds, more, look in (  # a cloud for every instant; an empty one too, or the last would stay
        ("world/active", position_m, active, {"radii": RADIUS_M, "show_labels": False}),
        ("world/working_set", resting_m, {}, {"colors": rgb(STATIC), "radii": 0.4 * RADIUS_M}),
    ):
        points = np.concatenate([np.reshape(cloud, (-1, 3)) for cloud in clouds]).astype(np.float32)
        columns = rr.Points3D.columns(positions=points, **more).partition(lengths=np.array([*map(len, clouds)]))
        stream.send_columns(entity, times, columns)
        stream.log(entity, rr.Points3D.from_fields(**look), static=True)
    if sensor_m is not None:
        stream.send_columns("world/sensor", times, rr.Transform3D.columns(translation=sensor_m))
        stream.log("world/sensor", rr.Points3D([[0.0, 0.0, 0.0]], colors=rgb(INK), radii=0.5), static=True)
    if sensor_m is not None and reach_m is not None:
        angle = np.linspace(0.0, 2.0 * np.pi, ROUND + 1)
        circle = reach_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(ROUND + 1)])
        stream.log("world/sensor/reach", rr.LineStrips3D([circle], colors=rgb(MUTED), radii=0.05), static=True)
    counts = {
        "static": [int(rest.sum()) for rest in static],
        "dynamic": [int((~rest).sum()) for rest in static],
        "working set": [len(places) for places in resting_m],
    }
    for (name, values), colour in zip(counts.items(), (STATIC, DYNAMIC, MUTED), strict=True):
        entity = f"count/{name.replace(' ', '_')}"
        stream.log(entity, rr.SeriesLines(colors=rgb(colour), names=name, widths=1.5), static=True)
        stream.send_columns(entity, times, rr.Scalars.columns(scalars=np.array(values, dtype=np.float64)))
    stream.flush()
    stream.disconnect()
    return path


def _tracks_blueprint() -> Any:
    import rerun.blueprint as rrb

    views = (rrb.Spatial3DView(name="world", origin="world"), rrb.TimeSeriesView(name="objects", origin="count"))
    return rrb.Blueprint(rrb.Vertical(*views, row_shares=[4, 1]), *_close_panels(TRACKS_TIMELINE))
