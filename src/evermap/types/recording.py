"""A recording: what a reader returns and the pipeline takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeAlias

import numpy as np
from typing_extensions import TypeVar

from evermap.show import Shown, draw, span
from evermap.types.arrays import IntArray
from evermap.types.clock import Clock
from evermap.types.landmarks import Landmarks, Trajectory
from evermap.types.measured import (
    Detections,
    Frames,
    Measurements,
    Odometry,
    RobotSightings,
    SpatialDetections,
    SpatialOdometry,
)
from evermap.types.sensor import Sensor, SpatialSensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from typing_extensions import TypeIs

OdometryT_co = TypeVar("OdometryT_co", bound="Odometry | SpatialOdometry | None", covariant=True, default=Odometry)
DetectionsT_co = TypeVar("DetectionsT_co", bound="Detections | SpatialDetections", covariant=True, default=Detections)


@dataclass(frozen=True, slots=True)
class Recording(Shown, Generic[OdometryT_co, DetectionsT_co]):
    """One robot's session: what a reader returns and the pipeline consumes, in the plane or in space (`dim`).

    Attributes:
        name: short label, e.g. 'MRCLAM_Dataset6 robot 1'.
        odometry: velocities in the plane; poses in space, None for a sensor that is carried by hand.
        detections: ranges and bearings of one `sensor`, or positions in the frames of several `sensors`.
        sensor: of a recording in the plane.
        truth: reference trajectory, for evaluation only; None where unknown, may cover a part of the recording.
        true_landmarks: surveyed landmarks, for evaluation or as a prior map; None where unknown.
        robot_sightings: sightings of other robots, for `run_together`; in the plane.
        objects: (K, 2) landmark ids and the objects that they are on, as an object detector says; empty where there is
            none. Objects are numbered within the recording.
        warnings: counted, human-readable remarks of the reader ('3 detections of unknown barcodes dropped').
        source: where it was read from.
        landmark_names: texts behind the ids of landmarks that were given as such (`landmark_id_of`).
        robot: whose session it is; '' where nobody said. A map keeps it with the revision, not with what was measured.
        measurements: of other kinds, each kind once.
        sensors: of a recording in space, at least one.
        symmetries: turns after which objects look the same, by the names of their classes; as
            `geometry.symmetry.Symmetry.generate_group` reads them.
    """

    name: str
    odometry: OdometryT_co
    frames: Frames
    detections: DetectionsT_co
    sensor: Sensor = field(default_factory=Sensor)
    truth: Trajectory | None = None
    true_landmarks: Landmarks | None = None
    robot_sightings: RobotSightings | None = None
    objects: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    class_names: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    source: str = ""
    clock: Clock = Clock.RECORDING
    landmark_names: Mapping[int, str] = field(default_factory=dict)
    robot: str = ""
    measurements: tuple[Measurements, ...] = ()
    sensors: tuple[SpatialSensor, ...] = ()
    symmetries: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        """Return 2 of a recording in the plane, 3 of one in space."""
        return 3 if isinstance(self.detections, SpatialDetections) else 2

    def _facts(self) -> dict[str, Any]:
        return {
            "name": self.name,
            **span(self.frames.stamp_s),
            "odometry": 0 if self.odometry is None else len(self.odometry),
            "frames": len(self.frames),
            "detections": len(self.detections),
            "landmarks": self.detections._facts()["landmarks"],
            "truth": self.truth is not None,
            "true_landmarks": 0 if self.true_landmarks is None else len(self.true_landmarks),
            "warnings": len(self.warnings),
            "source": self.source,
        }

    def plot(self) -> Figure:
        """Draw detections over time and range, and the truth where there is one; returns a matplotlib figure."""
        return draw("plot_recording", self)


def is_in_space(recording: AnyRecording) -> TypeIs[SpatialRecording]:
    """Return whether poses and detections of a recording are in space, not in the plane."""
    return recording.dim == 3


class _InSpace(type):
    """Instances of `SpatialRecording` are recordings in space."""

    def __instancecheck__(cls, one: Any) -> bool:
        return isinstance(one, Recording) and one.dim == 3


if TYPE_CHECKING:
    SpatialRecording: TypeAlias = Recording[SpatialOdometry | None, SpatialDetections]
    """A recording in space; one in the plane is a `Recording`."""
else:

    class SpatialRecording(metaclass=_InSpace):
        """Old name of a `Recording` in space, for code that makes or recognises one by it."""

        def __new__(cls, *args: Any, **given: Any) -> Recording:
            """Return a `Recording`; arguments by position as they were."""
            names = (
                "name", "odometry", "frames", "detections", "sensors", "truth", "true_landmarks", "class_names",
                "warnings", "source", "clock", "landmark_names", "symmetries", "robot", "measurements",
            )  # fmt: skip
            return Recording(**dict(zip(names, args, strict=False)), **given)


AnyRecording = Recording | SpatialRecording
"""A session in the plane or in space."""
AnyRecordingT = TypeVar("AnyRecordingT", Recording, SpatialRecording)
"""What comes back as it was given."""
