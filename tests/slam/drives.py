"""Made-up drives past known landmarks, drawn from the very model that the estimators believe in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.kernels import FLOOR_FORWARD_M, FLOOR_TURN_RAD
from evermap.slam.known_places import KnownPlaces
from evermap.slam.localize import FrameSightings, Localizer, Located
from evermap.slam.problem import Drive, Noise
from evermap.types import Sensor

ODOMETRY_S = 0.05
FRAME_S = 0.2
NOISE = Noise(detection=np.array([0.05, 0.02]), odometry=np.array([0.03, 0.02, 0.02, 0.01, 0.03]), outlier_log_odds=7.0)
SENSOR = Sensor(range_max_m=6.0, bearing_min_rad=-2.0, bearing_max_rad=2.0, p_detect=0.9)
SPREAD = np.array([0.05, 0.01, 0.02, 0.05, 0.02, 0.02, 0.02, 0.05, 0.02, 0.05, 0.01])
"""Of the calibration states: small enough that no reading leaves the model's linear range."""


def prior() -> CalibrationPrior:
    default = CalibrationPrior.from_settings(calibrated=True)
    return CalibrationPrior(default.mean, SPREAD, default.free)


@dataclass
class World:
    """A drive of one robot: what is true, what is reported."""

    landmark: np.ndarray
    pose: np.ndarray
    states: np.ndarray
    drive: Drive
    stamp_s: np.ndarray
    sightings: list[FrameSightings]


def place_randomly(rng: np.random.Generator, count: int, side_m: float) -> np.ndarray:
    return rng.uniform(-0.5 * side_m, 0.5 * side_m, (count, 2))


def driven(
    rng: np.random.Generator,
    landmark: np.ndarray,
    *,
    n_frames: int = 150,
    start: np.ndarray | None = None,
    states: np.ndarray | None = None,
) -> World:
    """Along smooth random velocities; the robot turns back to the middle when it leaves."""
    per_frame = round(FRAME_S / ODOMETRY_S)
    count = n_frames * per_frame + 40
    default = prior()
    if states is None:
        mount = np.random.default_rng(list(landmark.tobytes()[:16])).normal(size=2)
        states = default.mean + SPREAD * np.insert(rng.normal(size=9), 5, mount)
    stamps = ODOMETRY_S * np.arange(count) - 1.0
    pose = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) if start is None else start.astype(float)
    wander, (x, y, heading) = 0.0, pose.tolist()
    velocity, truth = np.zeros((count, 3)), np.zeros((count + 1, 3))
    truth[0] = pose
    drawn, sigma, scale = rng.normal(size=(count, 4)).tolist(), NOISE.odometry.tolist(), states.tolist()
    for k, (swerve, *noise) in enumerate(drawn):  # in plain numbers, which is ten times as fast
        wander = 0.98 * wander + 0.15 * swerve
        home = math.remainder(math.atan2(-y, -x) - heading, 2.0 * math.pi)
        turn = min(max(wander + (1.5 * home if math.hypot(x, y) > 5.0 else 0.0), -1.5), 1.5)
        velocity[k] = 0.6, 0.0, turn
        along = sigma[0] ** 2 * 0.6 + sigma[1] ** 2 * abs(turn) + FLOOR_FORWARD_M**2
        across = sigma[2] ** 2 * 0.6 + FLOOR_FORWARD_M**2
        about = sigma[3] ** 2 + sigma[4] ** 2 * abs(turn) + FLOOR_TURN_RAD**2
        unit = [math.sqrt(each * ODOMETRY_S) * one for each, one in zip((along, across, about), noise, strict=True)]
        ahead = (scale[8] * 0.6 - scale[10] * abs(turn)) * ODOMETRY_S + unit[0]
        turned = scale[9] * turn * ODOMETRY_S + unit[2]
        sinc, cosc = (math.sin(turned) / turned, (1.0 - math.cos(turned)) / turned) if turned else (1.0, 0.0)
        right, up = sinc * ahead - cosc * unit[1], cosc * ahead + sinc * unit[1]
        x, y = (
            x + math.cos(heading) * right - math.sin(heading) * up,
            y + math.sin(heading) * right + math.cos(heading) * up,
        )
        heading = math.remainder(heading + turned, 2.0 * math.pi)
        truth[k + 1] = x, y, heading
    frame_s = FRAME_S * np.arange(n_frames)
    poses = _at(truth, stamps, frame_s + states[7])
    away = se2.transform(se2.inverse(poses)[:, None], landmark)
    sightings = [_seen(rng, one, states) for one in away]
    return World(landmark, poses, states, Drive.from_rows(stamps, velocity), frame_s, sightings)


def _at(truth: np.ndarray, stamps: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Between two poses each along the twist that leads from one to the other."""
    k = ((when - stamps[0]) // ODOMETRY_S).astype(np.int64)
    part = ((when - stamps[k]) / ODOMETRY_S)[:, None]
    return se2.compose(truth[k], se2.exp(part * se2.log(se2.between(truth[k], truth[k + 1]))))


def seen_from(rng: np.random.Generator, pose: np.ndarray, landmark: np.ndarray, states: np.ndarray) -> FrameSightings:
    return _seen(rng, se2.transform(se2.inverse(pose), landmark), states)


def _seen(rng: np.random.Generator, away: np.ndarray, states: np.ndarray) -> FrameSightings:
    """What is detected of landmarks (N, 2) in the robot's frame."""
    away = away - states[5:7]
    r, b = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])
    seen = np.flatnonzero((r > 0.3) & (r < SENSOR.range_max_m) & (np.abs(b) < 2.0) & (rng.random(len(r)) < 0.9))
    r, b = r[seen], b[seen]
    reading = np.column_stack(
        [states[0] + r * (1.0 + states[1] + states[2] * b + states[3] * b**2), b + states[4]]
    ) + NOISE.detection * rng.normal(size=(len(seen), 2))
    return FrameSightings(seen.astype(np.int64), reading, np.full((len(seen), 2), np.nan))


def surveyed(rng: np.random.Generator, landmark: np.ndarray, sigma_m: float) -> KnownPlaces:
    """A map of it with independent errors."""
    count = len(landmark)
    return KnownPlaces.of(
        np.arange(count),
        landmark + rng.normal(0.0, sigma_m, (count, 2)),
        np.tile(sigma_m**2 * np.eye(2), (count, 1, 1)),
        np.ones(count),
    )


def run(world: World, places: KnownPlaces, **options: object) -> tuple[Localizer, list[Located]]:
    localizer = Localizer(places, SENSOR, prior(), NOISE, **options)  # type: ignore[arg-type]
    frames = zip(world.stamp_s, world.sightings, strict=True)
    return localizer, [localizer.step(stamp, world.drive, seen) for stamp, seen in frames]


def errors(world: World, located: list[Located]) -> np.ndarray:
    """(F, 3) in the robot's frame; nan before it is placed."""
    return se2.log(se2.between(np.array([one.pose for one in located]), world.pose))


def nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
