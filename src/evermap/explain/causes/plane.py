"""What may be wrong with a recording in the plane."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from evermap.explain.causes.mounts import suspect_planar_mount
from evermap.explain.causes.odometry import (
    stretch_speeds,
    suspect_late_stamps,
    suspect_odometry_scale,
    suspect_turn_scale,
)
from evermap.explain.causes.sizes import (
    stretch_ranges,
    suspect_bias_of_one,
    suspect_size_of_kind,
    suspect_size_of_one,
)
from evermap.explain.causes.suspect import (
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
from evermap.geometry import se2
from evermap.slam import mistakes
from evermap.slam.orientations import MIRRORED, MIRRORED_TURNS
from evermap.types import ANY_BEARING_RAD, Recording

WITH_BEARINGS = 0.5
"""Share of the detections without a bearing from which ranges alone must say what is wrong."""


def suspect_in_plane(recording: Recording, *, calibrations: bool) -> Iterable[Suspect]:
    """Yield what may be wrong with a recording in the plane; with `calibrations` not the sizes of single landmarks."""
    names = recording.landmark_names
    yield Suspect(
        "range-scale", "sensor", USUAL_P, partial(stretch_ranges, of=None),
        lambda s: f"true distances are {math.exp(s):.4g} times the ranges: another scale, or another size of tags",
        lambda s: f"[sensor] sigma_scale = {round_up(abs(s))}", SCALE, math.exp,
    )  # fmt: skip
    yield suspect_odometry_scale()
    yield suspect_turn_scale()
    yield suspect_late_stamps("sensor")
    yield from suspect_planar_mount(recording.sensor)
    bearings = np.mean(recording.detections.sigma_bearing_rad == ANY_BEARING_RAD) < WITH_BEARINGS
    for mistake in (*mistakes.UNITS, *(mistakes.ANGLES if bearings else ())):
        yield Suspect(
            mistake.code, mistake.field, UNIT_P if mistake.code == "length-unit" else USUAL_P,
            partial(_undo_in_plane, mistake=mistake), say_always(mistake.message), say_always(name_fix(mistake)),
        )  # fmt: skip
    for mistake in (MIRRORED,) if bearings else (*mistakes.RANGED, MIRRORED_TURNS):
        yield Suspect(
            mistake.code, mistake.field, USUAL_P, partial(_undo_in_plane, mistake=mistake), say_always(mistake.message),
            say_always(name_fix(mistake)), pairs=False, shows=not bearings,
        )  # fmt: skip
    for identity in () if calibrations else list_often_seen(recording):
        name, of = names.get(identity, str(identity)), ("id", float(identity))
        yield suspect_size_of_one(name, stretch_ranges, of, "")
        if not bearings:  # with directions a place shows by one look, and what is off is a size
            yield suspect_bias_of_one(name, of)
    for row, name in enumerate(recording.class_names):
        yield suspect_size_of_kind(f"class {name}", stretch_ranges, ("class", row), "")


def _undo_in_plane(inputs: Inputs, _: float, mistake: mistakes.Mistake) -> Inputs:
    """Return the same without a mistake of the readings."""
    recording: Any = inputs.recording
    if mistake.lengths != 1.0:
        state = math.log(mistake.lengths)
        if mistake.field == "forward_mps":
            return stretch_speeds(inputs, -state)
        return stretch_ranges(inputs, state, None)
    seen, driven = recording.detections, recording.odometry
    bearing = se2.wrap(mistake.bearing * seen.bearing_rad + mistake.offset_rad)
    stretch = math.log(abs(mistake.bearing))
    sigma = seen.sigma_bearing_rad * abs(mistake.bearing)
    ahead, aside = (
        (driven.lateral_mps, driven.forward_mps) if mistake.exchanged else (driven.forward_mps, driven.lateral_mps)
    )
    odometry = replace(
        driven,
        forward_mps=ahead * mistake.forward,
        lateral_mps=aside * mistake.lateral,
        angular_radps=driven.angular_radps * mistake.turn,
    )
    detections = replace(seen, bearing_rad=bearing, sigma_bearing_rad=sigma)
    if (mistake.bearing, mistake.offset_rad) == (1.0, 0.0):
        detections = seen
    return replace(
        inputs,
        recording=replace(recording, detections=detections, odometry=odometry),
        stretched=inputs.stretched + stretch,
    )
