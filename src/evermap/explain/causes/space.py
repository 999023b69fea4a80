"""What may be wrong with a recording in space."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from evermap.explain.causes.lenses import suspect_lens
from evermap.explain.causes.mounts import suspect_all_mounts, suspect_mount
from evermap.explain.causes.odometry import stretch_speeds, suspect_path
from evermap.explain.causes.sizes import (
    has_scale,
    stretch_positions,
    suspect_scale_of_sensor,
    suspect_size_of_all,
    suspect_size_of_kind,
    suspect_size_of_one,
)
from evermap.explain.causes.suspect import (
    RARE_P,
    SCALE,
    UNIT_P,
    USUAL_P,
    Inputs,
    Suspect,
    list_often_seen,
    name_fix,
    round_up,
    say_always,
)
from evermap.slam import mistakes
from evermap.slam.check import CLOCKWISE, CORNERS, SIGHTED, find_corner_mistake, is_clockwise, read_corners
from evermap.slam.orientations import find_convention
from evermap.slam.pairs import USUAL
from evermap.types import SpatialRecording


def suspect_in_space(recording: SpatialRecording, *, calibrations: bool, has_metre: bool) -> Iterable[Suspect]:
    """Yield what may be wrong with a recording in space; no scale of all that was seen where nothing else has a metre.

    A smaller world fits as well then, and better with what is supposed of how fast a camera is carried. Nor of
    directions: what is as far as they meet has no scale of its own.
    """
    seen, sensors = recording.detections, recording.sensors
    sizes = np.unique(np.round(seen.tag_size_m[np.isfinite(seen.tag_size_m)], 6))
    one = f"{sizes[0]:.12g}" if len(sizes) == 1 else ""
    corners = bool(np.isfinite(seen.corner_px[:, 0, 0]).any())
    many = len(sensors) > 1
    if has_metre and (one or corners):
        yield suspect_size_of_all(one)
    elif has_metre:
        yield Suspect(
            "range-scale", "sensor", USUAL_P, partial(stretch_positions, of=None),
            lambda s: f"true distances are {math.exp(s):.4g} times those of the detections: the detector has another "
            "size of tags, or the sensor another scale",
            lambda s: f"tag size of the detector x {math.exp(s):.4g}, or sigma_scale = {round_up(abs(s))}",
            SCALE, math.exp,
        )  # fmt: skip
    for row in np.flatnonzero(has_scale(recording)).tolist() if many else ():
        yield suspect_scale_of_sensor(row, sensors[row].name)
    if len(sizes) > 1:
        for size in sizes.tolist():
            yield suspect_size_of_kind(f"size {size:g} m", stretch_positions, ("size", size), f"{size:.12g}")
    for row, name in enumerate(recording.class_names if len(recording.class_names) > 1 else ()):
        yield suspect_size_of_kind(f"class {name}", stretch_positions, ("class", row), "")
    for identity in () if calibrations else list_often_seen(recording):
        own = seen.tag_size_m[seen.landmark_id == identity]
        size = f"{np.nanmedian(own):.12g}" if np.isfinite(own).any() else ""
        name = recording.landmark_names.get(identity, str(identity))
        yield suspect_size_of_one(name, stretch_positions, ("id", identity), size)
    if not calibrations:
        yield from _suspect_conventions(recording)
    yield from suspect_path(recording)
    for mistake in () if corners else mistakes.MIRRORS:
        yield Suspect(
            mistake.code, mistake.field, RARE_P, partial(_mirror_positions, signs=mistake.mirrored),
            say_always(mistake.message), say_always("detections.csv: the sign of x_m or y_m"),
        )  # fmt: skip
    for mistake in mistakes.UNITS_IN_SPACE:
        state = math.log(mistake.lengths)
        if mistake.field == "odometry" and recording.odometry is None:
            continue
        undo = (
            (lambda inputs, _, state=state: stretch_speeds(inputs, -state))
            if mistake.field == "odometry"
            else (lambda inputs, _, state=state: stretch_positions(inputs, state, None))
        )
        yield Suspect(
            mistake.code, mistake.field, UNIT_P, undo, say_always(mistake.message), say_always(name_fix(mistake))
        )
    for row, sensor in enumerate(sensors):
        yield from suspect_mount(row, sensor, many=many, driven=recording.odometry is not None)
    if many:
        yield from suspect_all_mounts(sensors, driven=recording.odometry is not None)
    cameras = [row for row, sensor in enumerate(sensors) if sensor.intrinsics is not None]
    if not corners:
        return
    for same in {sensors[row].intrinsics: None for row in cameras}:
        yield from suspect_lens([row for row in cameras if sensors[row].intrinsics == same], sensors)


def _suspect_conventions(recording: SpatialRecording) -> Iterable[Suspect]:
    """Yield conventions of corners and of poses by which detections agree with each other, if others than expected."""
    for how in [find_corner_mistake(recording) or CLOCKWISE] if is_clockwise(recording).any() else []:
        yield Suspect(
            "corner-order", "corners", USUAL_P, partial(_read_corners, how=how), say_always(CORNERS[how].message),
            say_always(CORNERS[how].fix), shows=True,
        )  # fmt: skip
    for convention in filter(None, [find_convention(recording, USUAL)]):
        yield Suspect(
            "detection-poses", "detections", USUAL_P, partial(_read_detections, convention=convention),
            say_always(SIGHTED[convention]), say_always("detections.csv: x_m, y_m, z_m, qx, qy, qz, qw"), shows=True,
        )  # fmt: skip


def _read_corners(inputs: Inputs, _: float, how: str) -> Inputs:
    """Return the same with the corners read in another way."""
    recording: Any = inputs.recording
    return replace(inputs, recording=read_corners(recording, how))


def _read_detections(inputs: Inputs, _: float, convention: str) -> Inputs:
    """Return the same with the poses of the detections read in another convention."""
    recording: Any = inputs.recording
    seen = recording.detections
    pose = mistakes.CONVENTIONS[convention](np.concatenate([seen.position_sensor_m, seen.rotation], axis=1))
    seen = replace(seen, position_sensor_m=pose[:, :3], rotation=pose[:, 3:])
    return replace(inputs, recording=replace(recording, detections=seen))


def _mirror_positions(inputs: Inputs, _: float, signs: tuple[float, float, float]) -> Inputs:
    """Return the same with other signs of coordinates of the detections; orientations stay."""
    recording: Any = inputs.recording
    seen, by = recording.detections, np.array(signs)
    seen = replace(
        seen,
        position_sensor_m=seen.position_sensor_m * by,
        covariance_sensor_m2=seen.covariance_sensor_m2 * by[:, None] * by,
    )
    return replace(inputs, recording=replace(recording, detections=seen))
