"""Why causes other than changes are asked of a session: what its solution contradicts."""

from __future__ import annotations

import math

import numpy as np

from evermap.config import SlamConfig
from evermap.explain.causes.mounts import MOUNT_M
from evermap.explain.causes.sizes import has_scale
from evermap.explain.causes.suspect import Inputs
from evermap.explain.motions import compare_odometry
from evermap.explain.seeds import find_mount, find_sensor_scales, find_single_scales
from evermap.explain.trial import INLIER, OF_NOISE, share_rejected
from evermap.slam.check import find_misreadings
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, SlamResult, is_in_space

LEAST_SCALE, LEAST_SINGLE = 0.015, 0.05
"""Logarithm of a scale, of all or of one landmark, from which its first value is tried: smaller ones the linear test
finds."""
ODOMETRY_OFF = 0.3
"""Share of the motion by which odometry is off from which it is asked why, as by the verdict."""
LENGTH_OFF, ODOMETRY_NOISY = 0.13, 2.5
"""Logarithm of the length of the trajectory over that of the odometry, and its noise over what is usual, from which the
same is asked: a run that is sound has less."""
CHANGES, INNOVATIONS, SINGLE = "changes", "innovations", "distance of one"
"""Symptoms of a session in which landmarks changed, of one whose detections scatter wider than they should, and of one
in which most detections of a landmark were rejected, and their directions meet nearer or farther than they say."""
SIDEWAYS, SLIPS = "sigma_lateral_per_sqrt_m", 1.5
"""Name of the level of lateral slip, and times its usual value from which it is asked where the sensor sits."""
OF_LANDMARKS = frozenset({ChangeKind.MOVED, ChangeKind.ROTATED, ChangeKind.SWAPPED})


def find_symptoms(
    result: SlamResult, inputs: Inputs, config: SlamConfig, *, is_read_well: bool = False
) -> tuple[str, ...]:
    """Return why causes other than changes are asked: short names; none where all is well.

    Args:
        result: of the session as given.
        inputs: of it.
        config: thresholds are those of `slam.explain` and `slam.check`.
        is_read_well: whether pairs of sightings are known to show no mistake.
    """
    rules, found = config.explain, list[str]()
    seen = result.innovations
    inlier = seen.p_inlier >= INLIER
    if share_rejected(result) > rules.rejected:
        found.append("detections rejected")
    if inlier.any():
        dof = np.full(len(inlier), 2) if seen.dof is None else seen.dof
        if find_mean_square(seen.nis, dof, inlier) > rules.innovations:
            found.append(INNOVATIONS)
    if any(change.kind in OF_LANDMARKS for change in result.changes):
        found.append(CHANGES)
    twice = [one for one, name in result.landmarks.names.items() if "#" in str(name)]
    hits = result.landmarks.n_hits
    if twice and hits[np.isin(result.landmarks.landmark_id, twice)].sum() > rules.rejected * hits.sum():
        found.append("identities at several places")
    for state in result.parameters:
        if not state.fixed and state.prior_sigma > 0.0:
            if abs(state.value - state.prior_mean) > rules.states * state.prior_sigma:
                found.append(state.name)
        elif (state.name.endswith(OF_NOISE[0]) and state.value > rules.noise) or (
            state.name == OF_NOISE[1] and state.value > rules.noise * config.space.sigma_px
        ):
            found.append(state.name)
    if inputs.prior_map is not None:
        own = np.unique(inputs.recording.detections.landmark_id)
        common = np.isin(inputs.prior_map.landmark_id, own)
        if result.trajectory.frame != "prior_map" or not common.any():
            found.append("map")
    if not (found or is_read_well) and any(
        not finding.usable for finding in find_misreadings(inputs.recording, config)
    ):
        found.append("readings")
    if not found and is_off_mount(result, inputs, config):
        found.append("mount")
    if not found and (np.abs(compare_sensors(inputs)) > LEAST_SCALE).any():
        found.append("sensors")
    if not found:
        single = find_single_scales(inputs.recording, result).values()
        found += [SINGLE] if any(abs(state) > LEAST_SINGLE for state in single) else []
    if not found and contradicts_odometry(result, inputs):
        found.append("odometry")
    return tuple(found)


def contradicts_odometry(result: SlamResult, inputs: Inputs) -> bool:
    """Return whether a solution and its odometry differ by far more than odometry does, or hardly agree."""
    apart, _, longer = compare_odometry(result, inputs.recording.odometry)
    return apart > ODOMETRY_OFF or abs(math.log(max(longer, 1e-9))) > LENGTH_OFF or _is_odometry_noisy(result)


def compare_sensors(inputs: Inputs) -> FloatArray:
    """Return (S,) logarithms of true distances over those by each sensor in space, by the other sensors; else none."""
    recording = inputs.recording
    return find_sensor_scales(recording, has_scale(recording)) if is_in_space(recording) else np.zeros(0)


def _is_odometry_noisy(result: SlamResult) -> bool:
    """Return whether the odometry in space seems far noisier than is usual."""
    noise = next((one for one in result.parameters if one.name == "sigma_odometry_m"), None)
    return noise is not None and noise.prior_mean > 0.0 and noise.value > ODOMETRY_NOISY * noise.prior_mean


def is_off_mount(result: SlamResult, inputs: Inputs, config: SlamConfig) -> bool:
    """Return whether a robot in the plane seems to slip to the side, as it does if its sensor sits elsewhere."""
    slip = next((one for one in result.parameters if one.name == SIDEWAYS), None)
    if is_in_space(inputs.recording) or slip is None or not slip.value > SLIPS * slip.prior_mean:
        return False
    return bool(np.abs(find_mount(inputs.recording, config.check)[:2]).max() > MOUNT_M)


def find_mean_square(nis: FloatArray, dof: IntArray, inlier: BoolArray) -> float:
    """Return the mean squared normalised innovation, a number, of detections that are no outliers."""
    return float(nis[inlier].sum()) / max(float(dof[inlier].sum()), 1.0)
