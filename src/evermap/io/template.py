"""Small, complete examples of the native format for `evermap slam --init`.

A robot goes three rounds by odometry that is a few per cent off, and a cart is not where an older map has it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evermap.geometry import se2
from evermap.io.files import staged_folder
from evermap.io.table import csv_text
from evermap.io.template_space import SPATIAL_COMMENTS, SPATIAL_FILES, spatial_template
from evermap.types import FloatArray

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

    Args:
        folder: to make.
        in_space: whether a camera moves in space and sees tags, instead of a robot that drives in the plane.

    Raises:
        InputError: the folder exists and is not empty, or cannot be written.
    """
    texts = dict(SPATIAL_FILES) if in_space else {"sensor.toml": _SENSOR_TOML}
    tables, comments = (spatial_template(), SPATIAL_COMMENTS) if in_space else (_tables(), _COMMENTS)
    with staged_folder(folder) as staging:
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
