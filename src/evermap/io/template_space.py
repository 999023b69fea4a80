"""A small, complete example of a recording in space: a camera is carried around a room with tags on its walls."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.geometry import se3
from evermap.geometry.camera import project
from evermap.geometry.square import CORNERS
from evermap.io.spatial import AT, QUATERNION
from evermap.types import FloatArray, SpatialSensor

_TURN_S = 20.0
_TAGS = 12
_TAG_M = 0.2
_ROOM_M = 3.0
"""Distance of the walls' tags from the middle of the room."""
_RANGE_MAX_M = 5.0
_STEEPEST = np.cos(np.radians(70.0))
_P_DETECT = 0.9
_SIGMA_PX = 0.3
_CAMERA = SpatialSensor(
    name="front",
    mount_robot_sensor=(0.1, 0.0, 0.05, -0.5, 0.5, -0.5, 0.5),
    intrinsics=(420.0, 420.0, 320.0, 240.0),
    distortion=(-0.12, 0.05, 0.0005, -0.0003),
    distortion_model="radtan",
    resolution_px=(640, 480),
)

SPATIAL_FILES = {
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

SPATIAL_COMMENTS = {
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


def spatial_template() -> dict[str, dict[str, Any]]:
    """Return the columns of every table; the same numbers every time."""
    random = np.random.default_rng(7)
    odometry_s, frame_s = np.arange(0.0, 20.01, 0.1).round(3), np.arange(0.0, 20.01, 0.5).round(3)
    truth_s = np.arange(0.0, 20.01, 1.0).round(3)
    start = se3.inverse(_pose_at(np.zeros(1)))
    tags = se3.compose(start, _tag_poses())
    return {
        "odometry": {"stamp_s": odometry_s, **_columns(_drifting(se3.compose(start, _pose_at(odometry_s)), random))},
        "detections": _detections(frame_s, random),
        "frames": {"stamp_s": frame_s},
        "truth": {"stamp_s": truth_s, **_columns(se3.compose(start, _pose_at(truth_s)))},
        "landmarks": {"landmark_id": np.arange(_TAGS), **_columns(tags), "tag_size_m": np.full(_TAGS, _TAG_M)},
    }


def _pose_at(stamp_s: FloatArray) -> FloatArray:
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


def _detections(frame_s: FloatArray, random: np.random.Generator) -> dict[str, Any]:
    camera = se3.compose(_pose_at(frame_s), np.array(_CAMERA.mount_robot_sensor))
    seen = se3.between(camera[:, None], _tag_poses())
    corner = se3.transform(seen[:, :, None], CORNERS * _TAG_M)
    pixel = project(corner, _CAMERA)[0]
    ahead = (corner[..., 2] > 0.2).all(axis=-1) & (np.linalg.norm(seen[..., :3], axis=-1) < _RANGE_MAX_M)
    facing = -np.sum(se3.rotation_of(seen)[..., 2] * seen[..., :3], axis=-1)
    ahead &= facing > _STEEPEST * np.linalg.norm(seen[..., :3], axis=-1)
    inside = ((pixel >= 0.0) & (pixel <= [640.0, 480.0])).all(axis=(-1, -2))
    frame, tag = np.nonzero(ahead & inside & (random.random(inside.shape) < _P_DETECT))
    noisy = (pixel[frame, tag] + _SIGMA_PX * random.standard_normal((len(frame), 4, 2))).round(2)
    columns = {f"{axis}{k}_px": noisy[:, k, side] for k in range(4) for side, axis in enumerate("uv")}
    return {"stamp_s": frame_s[frame], "landmark_id": tag, **columns}


def _columns(pose: FloatArray) -> dict[str, FloatArray]:
    return dict(zip((*AT, *QUATERNION), (pose.round(6) + 0.0).T, strict=True))  # without -0.0
