"""The nouns of evermap: frozen dataclasses of arrays, one row an item, which show themselves briefly.

Poses, landmarks and results are in the plane or in space; what a robot drives and sees has a form for each.

Conventions that hold everywhere:

* units are seconds, metres and radians, and stand in the name (`stamp_s`, `range_m`, `bearing_rad`);
* frames stand in the name: `pose_world_robot` maps robot coordinates to world coordinates and is `(x, y, theta)`;
* covariances of poses are in the robot's own frame (right perturbation `pose * exp(xi)`, `xi = (forward, left, turn)`);
* every stamp says its clock; arrays are C-contiguous float64 or int64; unknown ids are `UNKNOWN` (-1);
* columns that are given as lists, or as other kinds of numbers, become such arrays; lengths that differ are refused;
  what the numbers may be is in `valid`;
* what was *not* seen is data: `Frames` lists every instant at which the sensor looked, `Misses` what it missed.
"""

from evermap.types.arrays import (
    DEFAULT_P_FALSE,
    DEFAULT_P_MISS,
    DEFAULT_PRIOR,
    UNKNOWN,
    ArrayTable,
    BoolArray,
    FloatArray,
    IntArray,
    Progress,
    Tabular,
    json_number,
    or_nan,
    rows_of,
)
from evermap.types.clock import Clock, between_text, stamp_text
from evermap.types.landmarks import MOST_TILT_RAD, PLANE, Landmarks, Trajectory, Up
from evermap.types.measured import (
    MASK_ID,
    Detections,
    Frames,
    Measurements,
    Misses,
    Odometry,
    RobotSightings,
    SpatialDetections,
    SpatialOdometry,
    masks_of,
    traits_of,
)
from evermap.types.names import (
    CODE_DIGITS,
    identity_text,
    is_number,
    is_text_of,
    landmark_code,
    landmark_id_of,
    landmark_label,
)
from evermap.types.recording import (
    AnyRecording,
    AnyRecordingT,
    DetectionsT_co,
    OdometryT_co,
    Recording,
    SpatialRecording,
    is_in_space,
)
from evermap.types.result import (
    Alternative,
    AssociationEvidence,
    Cause,
    ChangeKind,
    Innovations,
    MapChange,
    ParameterEstimate,
    SlamResult,
    Symptom,
    Undecided,
    Verdict,
    VerdictKind,
)
from evermap.types.sensor import ANY_BEARING_RAD, ANY_RANGE_M2, NOT_IN_SPACE, Sensor, SensorKind, SpatialSensor

__all__ = [
    "ANY_BEARING_RAD",
    "ANY_RANGE_M2",
    "CODE_DIGITS",
    "DEFAULT_PRIOR",
    "DEFAULT_P_FALSE",
    "DEFAULT_P_MISS",
    "MASK_ID",
    "MOST_TILT_RAD",
    "NOT_IN_SPACE",
    "PLANE",
    "UNKNOWN",
    "Alternative",
    "AnyRecording",
    "AnyRecordingT",
    "ArrayTable",
    "AssociationEvidence",
    "BoolArray",
    "Cause",
    "ChangeKind",
    "Clock",
    "Detections",
    "DetectionsT_co",
    "FloatArray",
    "Frames",
    "Innovations",
    "IntArray",
    "Landmarks",
    "MapChange",
    "Measurements",
    "Misses",
    "Odometry",
    "OdometryT_co",
    "ParameterEstimate",
    "Progress",
    "Recording",
    "RobotSightings",
    "Sensor",
    "SensorKind",
    "SlamResult",
    "SpatialDetections",
    "SpatialOdometry",
    "SpatialRecording",
    "SpatialSensor",
    "Symptom",
    "Tabular",
    "Trajectory",
    "Undecided",
    "Up",
    "Verdict",
    "VerdictKind",
    "between_text",
    "identity_text",
    "is_in_space",
    "is_number",
    "is_text_of",
    "json_number",
    "landmark_code",
    "landmark_id_of",
    "landmark_label",
    "masks_of",
    "or_nan",
    "rows_of",
    "stamp_text",
    "traits_of",
]
