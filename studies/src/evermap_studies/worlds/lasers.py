"""A robot with an accurate range sensor, whose errors are none that calibration states are made for.

It drives laps through poles that stand around. The sensor measures to a centimetre or three; what is wrong besides is
set by name: errors that last for a visit of a landmark, thick poles, late stamps, the motion during a scan, rounded
ranges, wheels that slip, wrong identities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SensorKind,
    Trajectory,
)

ODOMETRY_HZ = 20.0
VISIT_S = 5.0
"""A landmark that was not seen for so long is visited anew."""


@dataclass(frozen=True, slots=True)
class LaserWorld:
    """What a world is like; distances in m, angles in rad.

    Attributes:
        n_landmarks: around the way; `inside`: share of them within the laps.
        size_m: radius of the laps; `duration_s`, `speed_mps`.
        range_max_m, view_rad, rate_hz, p_detect: what the sensor sees.
        sigma_range_m, sigma_bearing_rad: white noise.
        lasting_m, lasting_rad: standard deviation of errors that are the same for a visit of a landmark, but for
            correlation by `lasting_s` (infinite: a constant).
        radius_m, radius_spread_m: of the poles, whose near side is measured while the truth is their middle.
        bias_m: added to all ranges.
        delay_s: stamps of odometry minus those of the motion.
        scan_s: time of a scan, from its right to its left, whose stamp is that of its middle.
        quantum_m: ranges are multiples of it; 0: exact.
        incidence_m: range error that grows with the square of the share of the largest range.
        mount_m: the sensor sits farther ahead than stated.
        scale, turn_scale: true over reported motion; `noise`: share of the way that is random.
        slips: how often an hour the wheels slip by up to a tenth of a radian and some centimetres.
        p_wrong: share of detections with another identity.
        kind: as stated.
    """

    n_landmarks: int = 25
    inside: float = 0.3
    size_m: float = 12.0
    duration_s: float = 240.0
    speed_mps: float = 0.7
    range_max_m: float = 15.0
    view_rad: float = 1.5 * math.pi
    rate_hz: float = 5.0
    p_detect: float = 0.9
    sigma_range_m: float = 0.02
    sigma_bearing_rad: float = math.radians(0.25)
    lasting_m: float = 0.0
    lasting_rad: float = 0.0
    lasting_s: float = math.inf
    radius_m: float = 0.0
    radius_spread_m: float = 0.0
    bias_m: float = 0.0
    delay_s: float = 0.0
    scan_s: float = 0.0
    quantum_m: float = 0.0
    incidence_m: float = 0.0
    mount_m: float = 0.0
    scale: float = 1.0
    turn_scale: float = 1.0
    noise: float = 0.01
    slips: float = 0.0
    p_wrong: float = 0.0
    kind: SensorKind | None = None


def simulate_laser(world: LaserWorld, seed: int) -> Recording:
    """Return a recording with its truth, in the frame of the first pose."""
    rng = np.random.default_rng([seed, 31])
    stamp, velocity, pose = _driven(world, rng)
    landmark = _poles(world, pose, rng)
    frames = np.arange(1.0, stamp[-1] - 1.0, 1.0 / world.rate_hz)
    detections = _detected(world, stamp, velocity, pose, landmark, frames, rng)
    way = np.hypot(velocity[:, 0], velocity[:, 1])
    white = rng.normal(size=(len(stamp), 2)) * math.sqrt(ODOMETRY_HZ) * np.sqrt(way)[:, None]
    forward = velocity[:, 0] / world.scale + world.noise * white[:, 0]
    turn = velocity[:, 2] / world.turn_scale + 0.5 * world.noise * white[:, 1]
    slipped = rng.random(len(stamp)) < world.slips / 3600.0 / ODOMETRY_HZ
    turn[slipped] += rng.uniform(-0.1, 0.1, int(slipped.sum())) * ODOMETRY_HZ
    forward[slipped] += rng.uniform(0.0, 0.05, int(slipped.sum())) * ODOMETRY_HZ
    back = se2.inverse(pose[0])
    half = 0.5 * world.view_rad
    return Recording(
        f"laser, seed {seed}", Odometry(stamp + world.delay_s, forward, np.zeros(len(stamp)), turn), Frames(frames),
        detections, Sensor(0.1, 1.1 * world.range_max_m, -half, half, kind=world.kind),
        truth=Trajectory(stamp, se2.compose(back, pose), np.zeros((len(stamp), 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(1, len(landmark) + 1), se2.transform(back, landmark)),
    )  # fmt: skip


def _driven(world: LaserWorld, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n,) stamps, (n, 3) velocities and (n, 3) poses of laps that are round but for two waves."""
    step = 1.0 / ODOMETRY_HZ
    stamp = np.arange(0.0, world.duration_s, step)
    phase, wave = rng.uniform(0.0, 2.0 * math.pi, 3), rng.uniform(0.1, 0.3, 2)
    u = np.linspace(0.0, 2.0 * math.pi * (1 + world.duration_s * world.speed_mps / (4.0 * world.size_m)), 200_000)
    radius = world.size_m * (1.0 + wave[0] * np.sin(2.0 * u + phase[0]) + wave[1] * np.sin(2.3 * u + phase[1]))
    line = np.column_stack([radius * np.cos(u), radius * np.sin(u)])
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    speed = world.speed_mps * (0.75 + 0.25 * np.sin(stamp / 11.0 + phase[2]))
    s = np.append(0.0, np.cumsum(step * speed[:-1]))
    at = np.column_stack([np.interp(s, along, line[:, k]) for k in range(2)])
    ahead = np.column_stack([np.interp(s + 0.05, along, line[:, k]) for k in range(2)])
    heading = np.unwrap(np.arctan2(*(ahead - at).T[::-1]))
    turn = np.append(np.diff(heading) / step, 0.0)
    velocity = np.column_stack([speed, np.zeros(len(stamp)), turn])
    pose = np.zeros((len(stamp), 3))
    pose[0], pose[:, 2] = [*at[0], heading[0]], heading[0] + np.append(0.0, np.cumsum(step * turn[:-1]))
    middle = pose[:-1, 2] + 0.5 * step * turn[:-1]
    pose[1:, :2] = at[0] + np.cumsum(
        step * speed[:-1, None] * np.column_stack([np.cos(middle), np.sin(middle)]), axis=0
    )
    return stamp, velocity, pose


def _poles(world: LaserWorld, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(L, 2) poles at 2 m or more from the way."""
    found: list[FloatArray] = []
    while len(found) < world.n_landmarks:
        reach = world.size_m * (0.7 if rng.random() < world.inside else 1.7)
        at = rng.uniform(-reach, reach, 2)
        if np.linalg.norm(pose[::10, :2] - at, axis=1).min() > min(2.0, 0.2 * world.size_m):
            found.append(at)
    return np.array(found)


def _detected(
    world: LaserWorld, stamp: FloatArray, velocity: FloatArray, pose: FloatArray, landmark: FloatArray,
    frames: FloatArray, rng: np.random.Generator,
) -> Detections:  # fmt: skip
    row = np.minimum(np.rint(frames * ODOMETRY_HZ).astype(np.int64), len(stamp) - 1)
    here, moves = pose[row], velocity[row]
    mount = np.array([world.mount_m, 0.0])
    away = se2.transform(se2.inverse(here)[:, None], landmark[None]) - mount
    if world.scan_s > 0.0:  # each direction is looked at at another instant
        past = world.scan_s * np.arctan2(away[..., 1], away[..., 0]) / (2.0 * math.pi)
        moved = np.stack([past * moves[:, None, 0], np.zeros_like(past), past * moves[:, None, 2]], axis=-1)
        away = se2.transform(se2.inverse(se2.compose(here[:, None], moved)), landmark[None]) - mount
    range_m, bearing = np.hypot(away[..., 0], away[..., 1]), np.arctan2(away[..., 1], away[..., 0])
    seen = (range_m < world.range_max_m) & (np.abs(bearing) < 0.5 * world.view_rad)
    seen &= rng.random(seen.shape) < world.p_detect
    lasts = _lasting(world, frames, seen, rng)
    radius = world.radius_m + world.radius_spread_m * rng.normal(size=len(landmark))
    white = rng.normal(size=(*seen.shape, 2))
    reported = range_m - np.maximum(radius, 0.0) + world.bias_m + world.lasting_m * lasts[..., 0]
    reported += world.sigma_range_m * white[..., 0] + world.incidence_m * (range_m / world.range_max_m) ** 2
    if world.quantum_m > 0.0:
        reported = np.floor(reported / world.quantum_m) * world.quantum_m
    angle = bearing + world.lasting_rad * lasts[..., 1] + world.sigma_bearing_rad * white[..., 1]
    frame, which = np.nonzero(seen & (reported > 0.1))
    m = len(frame)
    named = np.where(rng.random(m) < world.p_wrong, rng.integers(0, len(landmark), m), which)
    return Detections(
        frame.astype(np.int64), (named + 1).astype(np.int64), reported[frame, which],
        np.asarray(se2.wrap(angle[frame, which])), np.full(m, UNKNOWN), np.full(m, np.nan), np.full(m, np.nan),
        np.zeros(m, dtype=np.int64),
    )  # fmt: skip


def _lasting(world: LaserWorld, frames: FloatArray, seen: np.ndarray, rng: np.random.Generator) -> FloatArray:
    """(F, L, 2) errors of variance 1: drawn anew at every visit, and correlated by `lasting_s` within it."""
    fresh = rng.normal(size=(*seen.shape, 2))
    found, last = fresh.copy(), np.full(seen.shape[1], -np.inf)
    keep = math.exp(-1.0 / world.rate_hz / world.lasting_s)
    for k in range(1, len(frames)):
        last[seen[k - 1]] = frames[k - 1]
        same = (frames[k] - last < VISIT_S)[:, None]
        found[k] = np.where(same, keep * found[k - 1] + math.sqrt(1.0 - keep**2) * fresh[k], fresh[k])
    return found
