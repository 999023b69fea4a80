"""One robot of many makes: a recording whose sensor and odometry err as those of its kind do, with the whole truth.

The robot drives rounds through landmarks that stand around. What its sensor and its wheels report follows the laws of
`slam.calibration`, with parameters drawn for its kind; noise is partly the same for seconds, as that of real sensors
is, and none of it is told to the estimator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import (
    UNKNOWN,
    BoolArray,
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


@dataclass(frozen=True, slots=True)
class Robot:
    """What a robot is made of; angles in rad.

    Attributes:
        kind: of its sensor, see `slam.calibration.kinds`.
        states: (11,) its true calibration, in the order of `slam.calibration.SPECS`.
        askew_rad: its wheels drive this much to the left of where its front is.
        range_max_m, field_of_view_rad, rate_hz, p_detect: what the sensor sees.
        sigma_range_m: noise of ranges near by; sigma_range_share: what is added to it, as a share of the range.
        sigma_bearing_rad: noise of bearings.
        lasting_share, lasting_s: share of the variance of this noise that lasts, landmark by landmark, and how long.
        p_wrong: probability of a detection to be of another landmark than it says.
        sigma_forward, sigma_sideways, sigma_turn: noise of the odometry, by distance [m/sqrt(m)], by distance
            [m/sqrt(m)], by angle turned [rad/sqrt(rad)].
        size_m: of the place; n_landmarks; duration_s; speed_mps.
    """

    kind: SensorKind
    states: FloatArray
    askew_rad: float
    range_max_m: float
    field_of_view_rad: float
    rate_hz: float
    p_detect: float
    sigma_range_m: float
    sigma_range_share: float
    sigma_bearing_rad: float
    lasting_share: float
    lasting_s: float
    p_wrong: float
    sigma_forward: float
    sigma_sideways: float
    sigma_turn: float
    size_m: float
    n_landmarks: int
    duration_s: float
    speed_mps: float


@dataclass(frozen=True, slots=True)
class Make:
    """How the sensors of a kind differ: standard deviations of their errors, and ranges of what they see.

    Attributes:
        states: of the first five states of `slam.calibration.SPECS`.
        depth: share of sensors that report depth instead of distance.
        sigma_range_m, sigma_range_share, sigma_bearing_rad, range_max_m, field_of_view_rad: (low, high).
    """

    states: tuple[float, float, float, float, float]
    depth: float
    sigma_range_m: tuple[float, float]
    sigma_range_share: tuple[float, float]
    sigma_bearing_rad: tuple[float, float]
    range_max_m: tuple[float, float]
    field_of_view_rad: tuple[float, float]


MAKES = {
    SensorKind.LASER: Make(
        (0.03, 0.001, 0.0, 0.0, 0.01), 0.0, (0.005, 0.03), (0.0, 0.002), (0.001, 0.005), (8.0, 30.0), (3.1, 6.28)
    ),
    SensorKind.CAMERA: Make(
        (0.05, 0.02, 0.05, 0.05, 0.03), 0.5, (0.01, 0.05), (0.003, 0.03), (0.003, 0.01), (4.0, 10.0), (1.0, 2.0)
    ),
    SensorKind.TAG: Make(
        (0.02, 0.01, 0.02, 0.02, 0.03), 0.0, (0.005, 0.02), (0.003, 0.02), (0.002, 0.006), (4.0, 10.0), (1.0, 2.0)
    ),
    SensorKind.STEREO: Make(
        (0.02, 0.015, 0.02, 0.02, 0.02), 0.0, (0.005, 0.02), (0.005, 0.02), (0.002, 0.006), (5.0, 15.0), (1.0, 1.8)
    ),
}
"""Data sheets, mounts by hand, and what papers on calibration find, in round numbers."""


def draw_robot(seed: int) -> Robot:
    """Return a robot: its kind, and whether it is a good one (no systematic errors) or has those of its kind."""
    rng = np.random.default_rng([seed, 20])
    kind = list(MAKES)[rng.integers(len(MAKES))]
    make, good, good_wheels = MAKES[kind], rng.random() < 0.4, rng.random() < 0.4
    sensor = np.array(make.states) * rng.normal(size=5)
    if rng.random() < make.depth:
        sensor[3] = -0.5
    late = rng.normal() * 0.1 if rng.random() < 0.5 else 0.0
    wheels = np.array([late, 1.0 + 0.03 * rng.normal(), 1.0 + 0.05 * rng.normal(), 0.02 * rng.normal()])
    askew = 0.02 * rng.normal() if rng.random() < 0.5 else 0.0
    mount = 0.04 * np.random.default_rng([seed, 22]).normal(size=2) * (0.0 if good else 1.0)
    states = np.concatenate([np.zeros(5) if good else sensor, mount, [0.0, 1.0, 1.0, 0.0] if good_wheels else wheels])
    range_max_m = float(rng.uniform(*make.range_max_m))
    return Robot(
        kind=kind,
        states=states,
        askew_rad=0.0 if good_wheels else askew,
        range_max_m=range_max_m,
        field_of_view_rad=float(rng.uniform(*make.field_of_view_rad)),
        rate_hz=float(rng.uniform(1.0, 5.0)),
        p_detect=float(rng.uniform(0.4, 0.95)),
        sigma_range_m=float(rng.uniform(*make.sigma_range_m)),
        sigma_range_share=float(rng.uniform(*make.sigma_range_share)),
        sigma_bearing_rad=float(rng.uniform(*make.sigma_bearing_rad)),
        lasting_share=float(rng.choice([0.0, 0.3, 0.6])),
        lasting_s=float(rng.uniform(0.5, 5.0)),
        p_wrong=float(rng.choice([0.0, 0.01])),
        sigma_forward=float(rng.uniform(0.005, 0.04)),
        sigma_sideways=float(rng.uniform(0.003, 0.02)),
        sigma_turn=float(rng.uniform(0.01, 0.05)),
        size_m=float(rng.uniform(1.0, 3.0) * range_max_m),
        n_landmarks=int(rng.integers(8, 40)),
        duration_s=float(rng.uniform(120.0, 400.0)),
        speed_mps=float(rng.uniform(0.3, 1.2)),
    )


def simulate_robot(robot: Robot, seed: int) -> Recording:
    """Return a recording of a robot with its true path and landmarks; nothing of its errors is stated."""
    rng = np.random.default_rng([seed, 21])
    stamp = np.arange(0.0, robot.duration_s, 1.0 / ODOMETRY_HZ)
    reported, velocity, pose = _driven(robot, stamp, rng)
    low, high = pose[:, :2].min(axis=0), pose[:, :2].max(axis=0)
    landmark = rng.uniform(low - 0.2 * (high - low), high + 0.2 * (high - low), (robot.n_landmarks, 2))
    frames = np.sort(rng.uniform(stamp[20], stamp[-20], int(robot.rate_hz * robot.duration_s)))
    detections = _detections(robot, landmark, _at(pose, stamp, velocity, frames), frames, rng)
    states = robot.states
    forward = (reported[:, 0] + states[10] * np.abs(reported[:, 1])) / states[8]
    turn = reported[:, 1] / states[9]
    odometry = Odometry(stamp + states[7], forward, np.zeros(len(stamp)), turn)
    moved = se2.compose(pose, np.array([0.0, 0.0, -robot.askew_rad]))
    half = robot.field_of_view_rad / 2
    true = Landmarks.at(np.arange(1, robot.n_landmarks + 1), landmark)
    return Recording(
        f"robot {seed} ({robot.kind})", odometry, Frames(frames), detections,
        Sensor(0.2, 1.2 * robot.range_max_m, max(-half - 0.2, -math.pi), min(half + 0.2, math.pi)),
        truth=Trajectory(stamp, moved, np.zeros((len(stamp), 3, 3)), frame="truth"), true_landmarks=true,
    )  # fmt: skip


def _driven(robot: Robot, stamp: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 2) turning of the wheels, (n, 3) true velocities, and (n, 3) true poses: rounds.

    Wheels slip: where they take the robot is not quite how they turn.
    """
    phase, size = rng.uniform(0.0, 2.0 * math.pi, 4), 0.35 * robot.size_m
    wiggles = rng.uniform(0.1, 0.35, 2)
    step, n = 1.0 / ODOMETRY_HZ, len(stamp)
    noise = rng.normal(size=(n, 3)) * math.sqrt(ODOMETRY_HZ)
    wheels, velocity, pose = np.zeros((n, 2)), np.zeros((n, 3)), np.zeros((n, 3))
    u = 0.0

    def wanted(u: float) -> tuple[float, float]:
        r = size * (1.0 + wiggles[0] * math.sin(2.0 * u + phase[0]) + wiggles[1] * math.sin(3.3 * u + phase[1]))
        return r * math.cos(u + phase[2]), r * math.sin(u + phase[2])

    x, y = wanted(0.0)
    first = wanted(0.05)
    theta = math.atan2(first[1] - y, first[0] - x)
    ahead = min(0.8 + 0.3 * robot.speed_mps, 0.3 * size)
    for k in range(n):
        target = wanted(u)
        while math.hypot(target[0] - x, target[1] - y) < ahead:
            u += 0.01
            target = wanted(u)
        off = math.atan2(math.sin(a := math.atan2(target[1] - y, target[0] - x) - theta), math.cos(a))
        rests = 0.0 if math.sin(stamp[k] / 17.0 + phase[3]) > 0.93 else 1.0
        v = rests * robot.speed_mps * max(0.25, math.cos(off))
        w = rests * max(-1.2, min(1.2, 1.5 * off))
        wheels[k] = v, w
        x, y = x + step * v * math.cos(theta + 0.5 * w * step), y + step * v * math.sin(theta + 0.5 * w * step)
        theta += w * step
    way, turned = np.sqrt(wheels[:, 0]), np.sqrt(np.abs(wheels[:, 1]))
    velocity[:, 0] = wheels[:, 0] + noise[:, 1] * np.hypot(0.002, robot.sigma_forward * way)
    velocity[:, 1] = noise[:, 0] * np.hypot(0.0005, robot.sigma_sideways * way)
    velocity[:, 2] = wheels[:, 1] + noise[:, 2] * np.hypot(0.001, robot.sigma_turn * turned)
    heading = np.cumsum(np.append(0.0, step * velocity[:-1, 2]))
    middle = heading + 0.5 * step * velocity[:, 2]
    along = np.column_stack([np.cos(middle), np.sin(middle)]) * velocity[:, :1]
    along += np.column_stack([-np.sin(middle), np.cos(middle)]) * velocity[:, 1:2]
    pose[1:, :2] = np.cumsum(step * along[:-1], axis=0)
    pose[:, 2] = heading
    return wheels, velocity, pose


def _at(pose: FloatArray, stamp: FloatArray, velocity: FloatArray, when: FloatArray) -> FloatArray:
    """(F, 3) poses of the wheels at other instants."""
    row = np.searchsorted(stamp, when, side="right") - 1
    past = (when - stamp[row])[:, None]
    turned = 0.5 * past[:, 0] * velocity[row, 2]
    way = se2.transform(np.column_stack([np.zeros((len(row), 2)), turned]), past * velocity[row, :2])
    return se2.compose(pose[row], np.column_stack([way, 2.0 * turned]))


def _detections(
    robot: Robot, landmark: FloatArray, wheels: FloatArray, stamp: FloatArray, rng: np.random.Generator
) -> Detections:
    front = se2.compose(wheels, np.array([0.0, 0.0, -robot.askew_rad]))
    seen = se2.transform(se2.inverse(front)[:, None], landmark[None]) - robot.states[5:7]
    range_m, bearing = np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])
    views = (range_m < robot.range_max_m) & (range_m > 0.3) & (np.abs(bearing) < robot.field_of_view_rad / 2)
    hit: BoolArray = views & (rng.random(views.shape) < robot.p_detect)
    noise = np.stack([_lasting(robot, stamp, len(landmark), rng) for _ in range(2)], axis=-1)
    a0, a1, a2, a3, b0 = robot.states[:5]
    sigma = np.hypot(robot.sigma_range_m, robot.sigma_range_share * range_m)
    reported = a0 + range_m * (1.0 + a1 + a2 * bearing + a3 * bearing**2) + sigma * noise[..., 0]
    angle = se2.wrap(bearing + b0 + robot.sigma_bearing_rad * noise[..., 1])
    frame, which = np.nonzero(hit & (reported > 0.05))
    named = np.where(rng.random(len(which)) < robot.p_wrong, rng.integers(0, len(landmark), len(which)), which)
    m = len(frame)
    return Detections(
        frame.astype(np.int64), (named + 1).astype(np.int64), reported[frame, which], angle[frame, which],
        np.full(m, UNKNOWN), np.full(m, np.nan), np.full(m, np.nan), np.zeros(m, dtype=np.int64),
    )  # fmt: skip


def _lasting(robot: Robot, stamp: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(F, K) noise of variance 1, partly the same for a while."""
    keep = np.exp(-np.diff(stamp) / robot.lasting_s)
    slow = rng.normal(size=(len(stamp), count))
    for k, share in enumerate(keep, 1):
        slow[k] = share * slow[k - 1] + math.sqrt(1.0 - share**2) * slow[k]
    white = rng.normal(size=slow.shape)
    return math.sqrt(robot.lasting_share) * slow + math.sqrt(1.0 - robot.lasting_share) * white
