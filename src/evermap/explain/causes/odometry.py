"""What may be wrong with an odometry: scale, turns, signs and axes, its clock, and how its poses are written."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from evermap.explain.causes.suspect import RARE_P, SCALE, USUAL_P, Inputs, Suspect, name_fix, round_up, say_always
from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.slam import mistakes
from evermap.slam.pairs import read_drive
from evermap.types import FloatArray, SpatialOdometry, SpatialRecording, is_in_space

TURN = 0.15
"""Standard deviation of the logarithm of turns."""
DELAY_S = 0.5
"""Standard deviation of a delay."""
SIDEWAYS = 0.1
"""Way to the side over that ahead from which a robot drives sideways: less is the noise of its odometry."""


def suspect_odometry_scale() -> Suspect:
    """Return that all speeds are longer or shorter than the odometry says."""
    return Suspect(
        "odometry-scale", "odometry", USUAL_P, stretch_speeds,
        lambda s: f"the robot drives {math.exp(s):.4g} times what its odometry says: wheel radius",
        lambda s: f"[odometry] sigma_odometer_scale = {round_up(abs(s))}", SCALE, math.exp,
    )  # fmt: skip


def suspect_turn_scale() -> Suspect:
    """Return that all turns are longer or shorter than the odometry says."""
    return Suspect(
        "turn-scale", "odometry", USUAL_P, _stretch_turns,
        lambda s: f"the robot turns {math.exp(s):.4g} times what its odometry says: wheel base, or gyroscope",
        say_always("odometry.csv: angular_radps"), TURN, math.exp,
    )  # fmt: skip


def suspect_late_stamps(subject: str) -> Suspect:
    """Return that detections are stamped late, by the odometry's clock; `subject` says of which sensors."""
    return Suspect(
        "clock", subject, USUAL_P, _shift_stamps,
        lambda s: f"stamps of the detections are {abs(s):.3g} s {'late' if s > 0 else 'early'}",
        lambda s: f"detections.csv, frames.csv: stamp_s {'-' if s > 0 else '+'} {abs(s):.3g}", DELAY_S,
    )  # fmt: skip


def suspect_path(recording: SpatialRecording) -> Iterable[Suspect]:
    """Yield what may be wrong with an odometry in space, where there is one."""
    sensors = recording.sensors
    if recording.odometry is None:
        return
    yield suspect_odometry_scale()
    yield suspect_turn_scale()
    yield suspect_late_stamps(sensors[0].name if len(sensors) == 1 else "all sensors")
    aside = _drives_sideways(recording.odometry)
    for mistake in mistakes.DRIVES:
        if mistake.lateral == 1.0 or aside:  # else only its turns can be mirrored
            yield Suspect(
                mistake.code, "odometry", USUAL_P if "sign" in mistake.code else RARE_P,
                partial(_read_drive, mistake=mistake), say_always(mistake.message), say_always(name_fix(mistake)),
            )  # fmt: skip
    for mistake in mistakes.POSES:
        yield Suspect(
            mistake.code, mistake.field, USUAL_P, partial(_read_poses, convention=mistake.poses),
            say_always(mistake.message), say_always(name_fix(mistake)),
        )  # fmt: skip


def stretch_speeds(inputs: Inputs, state: float) -> Inputs:
    """Return the same with all speeds longer by a factor, of which `state` is the logarithm."""
    recording, factor = inputs.recording, math.exp(state)
    if is_in_space(recording):
        driven = recording.odometry
        assert driven is not None
        odometry: Any = replace(driven, pose_world_robot=se3.scaled(driven.pose_world_robot, factor))
    else:
        driven_flat = recording.odometry
        odometry = replace(
            driven_flat, forward_mps=driven_flat.forward_mps * factor, lateral_mps=driven_flat.lateral_mps * factor
        )
    return replace(inputs, recording=replace(recording, odometry=odometry))


def _stretch_turns(inputs: Inputs, state: float) -> Inputs:
    return _with_turns(inputs, lambda turn, _: turn * math.exp(state))


def turn_less(inputs: Inputs, state: float) -> Inputs:
    """Return the same with turns of the odometry less by a rate [rad/s] all the time, about z of the robot."""
    return _with_turns(inputs, lambda turn, lasted_s: turn - state * lasted_s * np.eye(turn.shape[1])[-1])


def _with_turns(inputs: Inputs, how: Callable[[FloatArray, FloatArray], FloatArray]) -> Inputs:
    """Return the same with other turns of the odometry; `how` has (N, 1 or 3) turns and (N, 1) how long each lasted."""
    recording = inputs.recording
    if not is_in_space(recording):
        driven = recording.odometry
        rate = how(driven.angular_radps[:, None], np.ones((len(driven), 1)))[:, 0]
        return replace(inputs, recording=replace(recording, odometry=replace(driven, angular_radps=rate)))
    path = recording.odometry
    assert path is not None
    step = se3.log(se3.between(path.pose_world_robot[:-1], path.pose_world_robot[1:]))
    step[:, 3:] = how(step[:, 3:], np.diff(path.stamp_s)[:, None])
    return _with_poses(inputs, np.asarray(se3.compose(path.pose_world_robot[:1], accumulate(se3.exp(step)))))


def _shift_stamps(inputs: Inputs, state: float) -> Inputs:
    """Return the same with the frames earlier by the delay of their stamps."""
    recording: Any = inputs.recording
    frames = replace(recording.frames, stamp_s=recording.frames.stamp_s - state)
    return replace(inputs, recording=replace(recording, frames=frames))


def _drives_sideways(odometry: SpatialOdometry) -> bool:
    step = np.abs(se3.between(odometry.pose_world_robot[:-1], odometry.pose_world_robot[1:])[:, :2]).sum(axis=0)
    return bool(step[1] > SIDEWAYS * step[0])


def _read_drive(inputs: Inputs, _: float, mistake: mistakes.Mistake) -> Inputs:
    """Return the same with the odometry's signs and axes read in another way."""
    recording: Any = inputs.recording
    return _with_poses(inputs, read_drive(recording.odometry.pose_world_robot, *mistake.drive))


def _read_poses(inputs: Inputs, _: float, convention: str) -> Inputs:
    """Return the same with the poses of the odometry read in another convention."""
    recording: Any = inputs.recording
    return _with_poses(inputs, mistakes.CONVENTIONS[convention](recording.odometry.pose_world_robot))


def _with_poses(inputs: Inputs, pose: FloatArray) -> Inputs:
    """Return the same with other poses (N, 7) of the odometry."""
    recording: Any = inputs.recording
    return replace(inputs, recording=replace(recording, odometry=replace(recording.odometry, pose_world_robot=pose)))
