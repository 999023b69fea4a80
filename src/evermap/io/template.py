"""Small, complete examples of the native format for `evermap init`.

In the plane a robot goes three rounds by odometry that is a few per cent off, and a cart is not where an older map has
it. In space a camera is carried around a room with tags on its walls.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evermap.geometry import se2, se3
from evermap.geometry.camera import project
from evermap.geometry.square import CORNERS
from evermap.io.files import stage_folder
from evermap.io.spatial import AT, QUATERNION
from evermap.io.table import csv_text
from evermap.types import FloatArray, SpatialSensor

_SPEED_MPS = 0.5
_TURN_RADPS = 2.0 * np.pi / 20.0  # one round in 20 s
_MOUNT = (0.2, 0.0, 0.0)
_RANGE_MAX_M = 6.0
_BEARING_MAX_RAD = 2.2
_SIGMA_RANGE_M = 0.03
_SIGMA_BEARING_RAD = 0.02
_P_DETECT = 0.9
_LANDMARK_ID = (1, 2, 3, 4, 5, 6)
_LANDMARK_M = np.array([[2.5, -0.6], [2.2, 3.6], [-2.3, 2.0], [-0.6, 4.2], [0.3, -1.5], [-2.1, -0.4]])
_CLASSES = ("pillar", "door", "pillar", "cart", "pillar", "door")
_DURATION_S = 60.0
_SURVEYED_M = np.where(np.array(_CLASSES)[:, None] == "cart", _LANDMARK_M - [0.3, 1.1], _LANDMARK_M)
"""Positions in an older survey: the cart has been moved since then."""
_SPEED_READS, _TURN_READS = 1.02, 0.97
"""Factors on the true velocities: a worn wheel and a wheelbase that is a few per cent off, as on real robots."""
_SPEED_NOISE_MPS, _TURN_NOISE_RADPS = 0.02, 0.02

_SENSOR_TOML = """\
# A recording for evermap: this folder. Replace the example rows with your own; docs/formats.md explains everything.
# Every section and every key of this file is optional.

[recording]
format_version = 1
name = "template"
clock = "recording"        # clock of the stamps: "recording" (arbitrary start), "unix", or "local_wall"
frames_complete = true     # false if frames without a detection are missing

[limits]                   # what the sensor can see, in its own frame: x ahead, y to the left
range_min_m = 0.1
range_max_m = 6.0
bearing_min_rad = -2.2     # counter-clockwise is positive
bearing_max_rad = 2.2

[noise]                    # standard deviations; omit them if unknown, they are estimated
sigma_range_m = 0.03
sigma_bearing_rad = 0.02

[mount]                    # pose of the sensor on the robot: x ahead, y to the left, counter-clockwise
x_m = 0.2
y_m = 0.0
theta_rad = 0.0

[detection]
p_detect = 0.9             # probability that a landmark in view is detected
p_false = 0.001            # probability of a false detection in a frame

# [sensor]                 # kind and data sheet set the priors of its errors; state what you know (docs/calibration.md)
# kind = "laser"           # "laser", "camera", "tag", "stereo" or "uwb"
# sigma_scale = 0.0005     # standard deviation of the scale of its ranges
# sigma_offset_m = 0.02    # of the offset of all ranges
# sigma_angle_rad = 0.005  # of its mounting angle
# sigma_position_m = 0.03  # of its position on the robot, along each axis

# [odometry]
# sigma_odometer_scale = 0.01
# sigma_askew_rad = 0.002  # of the angle between driving direction and front
# measured = true          # the velocities are the wheels' own, not commands, which the robot follows late
"""

_COMMENTS = {
    "odometry": """\
Required. Velocities of the robot; each row holds until the next stamp. Lines that start with '#' are comments.
Optional: lateral_mps, to the left. Instead of velocities: stamp_s,dx_m,dy_m,dtheta_rad, the motion since the row
before, in the robot's frame at that row.""",
    "detections": """\
Required. Detections. An empty landmark_id means: detected, but not identified. If the sensor identifies nothing (laser
reflectors, poles), leave the column out and run with --unknown-ids.
Instead of range_m,bearing_rad: x_m,y_m in the sensor's frame. Optional: class_id (any name), and standard deviations
of single detections: sigma_range_m,sigma_bearing_rad or sigma_m.""",
    "frames": """\
Optional, but recommended: the stamp of every sensor frame, including frames without a detection.""",
    "truth": """\
Optional: the robot's true poses, used only to compute errors.""",
    "landmarks": """\
Optional: the landmarks' true positions, for errors or with '--prior-map truth'. More columns: sigma_m, class_id.""",
    "survey": """\
Not part of the recording: an older map, for '--prior-map survey.csv'. The cart, 4, has been moved since then.""",
}


def write_template(folder: str | Path, *, in_space: bool = False) -> Path:
    """Write a commented, complete recording that runs unchanged; the same bytes every time.

    In the plane one minute, with an older map; in space 20 s.

    Raises:
        InputError: the folder exists and is not empty, or cannot be written.
    """
    texts = dict(_SPATIAL_FILES) if in_space else {"sensor.toml": _SENSOR_TOML}
    tables, comments = (_spatial_tables(), _SPATIAL_COMMENTS) if in_space else (_tables(), _COMMENTS)
    with stage_folder(folder) as staging:
        texts |= {f"{name}.csv": csv_text(columns, comment=comments[name]) for name, columns in tables.items()}
        for name, text in texts.items():
            (staging / name).write_text(text, encoding="utf-8", newline="\n")
    return Path(folder)


def _tables() -> dict[str, dict[str, Any]]:
    random = np.random.default_rng(7)
    odometry_s = np.arange(0.0, _DURATION_S + 0.01, 0.1).round(3)
    frame_s = np.arange(0.0, _DURATION_S + 0.01, 0.5).round(3)
    truth_s = np.arange(0.0, _DURATION_S + 0.01, 1.0).round(3)
    truth = _pose_at(truth_s)
    count = len(odometry_s)
    return {
        "odometry": {
            "stamp_s": odometry_s,
            "forward_mps": (_SPEED_READS * _SPEED_MPS + _SPEED_NOISE_MPS * random.standard_normal(count)).round(3),
            "angular_radps": (_TURN_READS * _TURN_RADPS + _TURN_NOISE_RADPS * random.standard_normal(count)).round(3),
        },
        "detections": _detections(frame_s, random),
        "frames": {"stamp_s": frame_s},
        "truth": {
            "stamp_s": truth_s,
            "x_m": truth[:, 0].round(4),
            "y_m": truth[:, 1].round(4),
            "theta_rad": truth[:, 2].round(4),
        },
        "landmarks": _map(_LANDMARK_M),
        "survey": _map(_SURVEYED_M),
    }


def _map(position_m: FloatArray) -> dict[str, Any]:
    x_m, y_m = position_m.T
    return {"landmark_id": np.array(_LANDMARK_ID), "x_m": x_m, "y_m": y_m, "class_id": list(_CLASSES)}


def _pose_at(stamp_s: FloatArray) -> FloatArray:
    """The drive: a circle from the origin, counter-clockwise. Shape (N, 3)."""
    return se2.exp(stamp_s[:, None] * np.array([_SPEED_MPS, 0.0, _TURN_RADPS]))


def _detections(frame_s: FloatArray, random: np.random.Generator) -> dict[str, Any]:
    pose_world_sensor = se2.compose(_pose_at(frame_s), np.array(_MOUNT))
    world = np.broadcast_to(_LANDMARK_M, (len(frame_s), *_LANDMARK_M.shape))
    offset = world - pose_world_sensor[:, None, :2]
    range_m = np.hypot(offset[..., 0], offset[..., 1])
    bearing_rad = se2.wrap(np.arctan2(offset[..., 1], offset[..., 0]) - pose_world_sensor[:, None, 2])
    in_view = (range_m < _RANGE_MAX_M) & (np.abs(bearing_rad) < _BEARING_MAX_RAD)
    frame, landmark = np.nonzero(in_view & (random.random(range_m.shape) < _P_DETECT))
    noise = random.standard_normal((2, len(frame)))
    return {
        "stamp_s": frame_s[frame],
        "landmark_id": np.array(_LANDMARK_ID)[landmark],
        "range_m": (range_m[frame, landmark] + _SIGMA_RANGE_M * noise[0]).round(3),
        "bearing_rad": (bearing_rad[frame, landmark] + _SIGMA_BEARING_RAD * noise[1]).round(4),
        "class_id": [_CLASSES[index] for index in landmark.tolist()],
    }


_TURN_S = 20.0
_TAGS = 12
_TAG_M = 0.2
_ROOM_M = 3.0
"""Distance of the walls' tags from the middle of the room."""
_TAG_RANGE_M = 5.0
_STEEPEST = np.cos(np.radians(70.0))
_SIGMA_PX = 0.3
_CAMERA = SpatialSensor(
    name="front",
    mount_robot_sensor=(0.1, 0.0, 0.05, -0.5, 0.5, -0.5, 0.5),
    intrinsics=(420.0, 420.0, 320.0, 240.0),
    distortion=(-0.12, 0.05, 0.0005, -0.0003),
    distortion_model="radtan",
    resolution_px=(640, 480),
)

_SPATIAL_FILES = {
    "sensor.toml": """\
# A recording in space for evermap: this folder. Replace the example rows with your own; docs/formats.md explains
# everything. Every section and every key of this file is optional.

[recording]
format_version = 1
name = "template"
clock = "recording"        # clock of the stamps: "recording" (arbitrary start), "unix", or "local_wall"
frames_complete = true     # false if frames without a detection are missing

[limits]
range_max_m = 5.0

[noise]                    # standard deviations; omit them if unknown, they are estimated
sigma_px = 0.3             # of pixels; sigma_m of positions and sigma_rad of orientations, if those are given

[detection]
p_detect = 0.9             # probability that a landmark in view is detected
p_false = 0.001            # probability of a false detection in a frame

# [sensor]                 # kind and data sheet set the priors of its errors; state what you know (docs/space.md)
# kind = "tag"             # "laser", "camera", "tag", "stereo" or "uwb"
# sigma_scale = 0.002      # standard deviation of the scale of its ranges
# sigma_angle_rad = 0.005  # of its orientation in the mount, about each axis
# sigma_position_m = 0.01  # of its position on the robot, along each axis

# [odometry]
# sigma_odometer_scale = 0.01

# [symmetries]             # rotations after which objects look the same, by class_id; x, y, z are the object's own axes
# can = "axis:z"           # any rotation about z
# box = ["180:z", "180:x"] # half a turn about z or x; "90:z" a quarter; "any" for a ball
""",
    "camera.toml": """\
# The cameras, and the sizes of tags. Required for pixels, or for several sensors. A sensor
# other than a camera has a section without intrinsics. The keys of [limits], [noise], [detection] and [sensor] of
# sensor.toml are valid here, too, for one camera.

[camera.front]
model = "radtan"                                # "pinhole", "radtan" or "equidistant" (fisheye)
intrinsics = [420.0, 420.0, 320.0, 240.0]       # fx, fy, cx, cy in pixels
distortion = [-0.12, 0.05, 0.0005, -0.0003]     # radtan: k1, k2, p1, p2 and perhaps k3; equidistant: k1 to k4
resolution_px = [640, 480]
# baseline_m = 0.2                              # of the left camera of a rectified stereo pair

[camera.front.mount]       # pose of the camera in the robot's frame: x ahead, y to the left, z up
x_m = 0.1                  # a camera looks along its own z axis; x is right and y down in the image
y_m = 0.0
z_m = 0.05
qx = -0.5                  # or roll_rad, pitch_rad, yaw_rad
qy = 0.5
qz = -0.5
qw = 0.5

[tags]
size_m = 0.2               # edge of a tag, without its white border

[tags.sizes]               # of tags of another size, by id
11 = 0.2
""",
}
"""Text files of the template, by name."""

_SPATIAL_COMMENTS = {
    "odometry": """\
Poses in a frame that may drift, as visual-inertial odometry gives them. Lines that start with '#' are comments.
Optional: var_x_m2,var_y_m2,var_z_m2,var_rx_rad2,var_ry_rad2,var_rz_rad2. Instead of poses:
stamp_s,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps, the robot's velocities. Without odometry, leave
this file out.""",
    "detections": """\
Required. Detections: here the corners of tags, counter-clockwise from the lower left of the tag. Instead of corners:
x_m,y_m,z_m in the sensor's frame, with qx,qy,qz,qw for objects with an orientation; or u_px,v_px,u_right_px of points
in a stereo pair; or x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m of boxes. An empty landmark_id means: detected, but
not identified. Optional: class_id, score, sigma_m, sigma_rad; sensor, if there are several.""",
    "frames": """\
Optional, but recommended: the stamp of every camera frame, including frames without a detection.""",
    "truth": """\
Optional: the robot's true poses, used only to compute errors.""",
    "landmarks": """\
Optional: the landmarks' true poses, for errors or with '--prior-map truth'. More columns: sigma_m, sigma_rad,
class_id.""",
}


def _spatial_tables() -> dict[str, dict[str, Any]]:
    random = np.random.default_rng(7)
    odometry_s, frame_s = np.arange(0.0, 20.01, 0.1).round(3), np.arange(0.0, 20.01, 0.5).round(3)
    truth_s = np.arange(0.0, 20.01, 1.0).round(3)
    start = se3.inverse(_walk_at(np.zeros(1)))
    tags = se3.compose(start, _tag_poses())
    return {
        "odometry": {
            "stamp_s": odometry_s,
            **_pose_columns(_drifting(se3.compose(start, _walk_at(odometry_s)), random)),
        },
        "detections": _corners(frame_s, random),
        "frames": {"stamp_s": frame_s},
        "truth": {"stamp_s": truth_s, **_pose_columns(se3.compose(start, _walk_at(truth_s)))},
        "landmarks": {"landmark_id": np.arange(_TAGS), **_pose_columns(tags), "tag_size_m": np.full(_TAGS, _TAG_M)},
    }


def _walk_at(stamp_s: FloatArray) -> FloatArray:
    """The walk: a round of 1.2 m about the middle of the room, up and down and a little tilted. Shape (N, 7)."""
    angle = 2.0 * np.pi * stamp_s / _TURN_S
    at = np.stack([1.2 * np.cos(angle), 1.2 * np.sin(angle), 1.2 + 0.15 * np.sin(3.0 * angle)], axis=1)
    zero = np.zeros_like(angle)
    heading = se3.exp(np.stack([zero, zero, zero, zero, zero, angle + np.pi / 2.0], axis=1))
    tilt = se3.exp(np.stack([zero, zero, zero, 0.08 * np.sin(5.0 * angle), 0.1 * np.sin(4.0 * angle), zero], axis=1))
    return se3.compose(np.concatenate([at, heading[:, 3:]], axis=1), tilt)


def _tag_poses() -> FloatArray:
    """Tags around the room at changing heights, upright, looking at its middle. Shape (12, 7)."""
    angle = 2.0 * np.pi * np.arange(_TAGS) / _TAGS
    height = 1.2 + 0.4 * np.sin(2.0 * np.arange(_TAGS))
    at = np.stack([_ROOM_M * np.cos(angle), _ROOM_M * np.sin(angle), height], axis=1)
    # x to the right of who looks at it, y up, z out of the wall
    upright = np.array([0.0, 0.0, 0.0, -0.5, -0.5, 0.5, 0.5])
    heading = se3.exp(np.outer(angle, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    return se3.compose(np.concatenate([at, heading[:, 3:]], axis=1), upright)


def _drifting(pose: FloatArray, random: np.random.Generator) -> FloatArray:
    """Poses (N, 7) of which each step has an error, and all steps are a little too long."""
    step = se3.local(pose[:-1], pose[1:])
    step[:, :3] *= 1.02
    step += random.standard_normal(step.shape) * [0.002, 0.002, 0.002, 0.001, 0.001, 0.002]
    found = [pose[0]]
    for twist in step:
        found.append(se3.retract(found[-1], twist))
    return np.array(found)


def _corners(frame_s: FloatArray, random: np.random.Generator) -> dict[str, Any]:
    camera = se3.compose(_walk_at(frame_s), np.array(_CAMERA.mount_robot_sensor))
    seen = se3.between(camera[:, None], _tag_poses())
    corner = se3.transform(seen[:, :, None], CORNERS * _TAG_M)
    pixel = project(corner, _CAMERA)[0]
    ahead = (corner[..., 2] > 0.2).all(axis=-1) & (np.linalg.norm(seen[..., :3], axis=-1) < _TAG_RANGE_M)
    facing = -np.sum(se3.rotation_of(seen)[..., 2] * seen[..., :3], axis=-1)
    ahead &= facing > _STEEPEST * np.linalg.norm(seen[..., :3], axis=-1)
    inside = ((pixel >= 0.0) & (pixel <= [640.0, 480.0])).all(axis=(-1, -2))
    frame, tag = np.nonzero(ahead & inside & (random.random(inside.shape) < _P_DETECT))
    noisy = (pixel[frame, tag] + _SIGMA_PX * random.standard_normal((len(frame), 4, 2))).round(2)
    columns = {f"{axis}{k}_px": noisy[:, k, side] for k in range(4) for side, axis in enumerate("uv")}
    return {"stamp_s": frame_s[frame], "landmark_id": tag, **columns}


def _pose_columns(pose: FloatArray) -> dict[str, FloatArray]:
    return dict(zip((*AT, *QUATERNION), (pose.round(6) + 0.0).T, strict=True))  # without -0.0
