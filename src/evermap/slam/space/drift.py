"""Errors of odometry and detector, estimated before solving: drift, correlated and systematic errors.

Each landmark is put where each of its sightings has it along the odometry alone. The squared distance between two of
these places grows with the time between them: at once by white noise, to a limit by errors that persist (a view, a bias
of the detector), and for ever by drift. The three are fitted to medians over pairs of instants (a variogram, Matheron
1963), so that outliers do not matter.

One landmark does not say whether the odometry drifts or its own errors last long. Two that are seen together do: drift
moves both alike. So the drift is what pairs of landmarks have in common, a robust covariance from the squares of sums
and of differences (Gnanadesikan and Kettenring 1972).

Things that stand still show what repeats itself: seen from two poses they must be in one place. A scale of the ranges
looks like one of the odometry, so only their ratio is known, and the odometry's metre holds unless that of the ranges
is stated; a bend, an angle by the metre driven, has no such twin. Errors of one thing are alike from frame to frame,
so each thing is one witness, and so is each stretch of the drive: the spread of what they say is the uncertainty (a
sandwich by clusters, Liang and Zeger 1986). A bend is taken only where it is clearly more probable than none by both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.config import SpaceConfig, StillConfig, TrafficConfig
from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.slam.correlation import (
    BINS,
    FEWEST_BINS,
    FEWEST_PAIRS,
    MOST_LAGS,
    MOST_SWAPS,
    PERSIST_S,
    PERSISTS,
    Curve,
    Lasting,
    curve_columns,
    fit_curve,
)
from evermap.slam.space.problem import USUAL, SpatialProblem
from evermap.tracking.standing import HEAVY
from evermap.types import FloatArray, IntArray

STILL = StillConfig()
SIGHTINGS_A_PLACE = 150
SEEN_TOGETHER, FEWEST_OF_BOTH = 12, 10
"""Landmarks whose pairs are asked, those seen most; instants, or pairs of these, that it takes."""
MEDIAN = 2.366
"""Of the chi-square distribution with three degrees of freedom."""
LEVERS = (0.5, 1.0, 1.5, 2.0, 3.0)
"""Drift of one landmark over that which pairs share: farther ones move more when the odometry turns."""


class Drift(NamedTuple):
    """Noise of a recording.

    Attributes:
        translation: of the odometry [m / sqrt(s)]; rotation: [rad / sqrt(s)]; None where too little is seen twice.
            The least that explains what is seen, since a good odometry is worth more than detections that err alike.
        doubt: factor from these to what is expected of them, which may be no less than 1.
        share: (M,) of the information of each detection that is new.
    """

    translation: float | None
    rotation: float | None
    doubt: float
    share: FloatArray


def drift_of(problem: SpatialProblem, driven: FloatArray) -> Drift:
    """Return the drift of the odometry, poses (N, 7), and how much of each detection is new.

    Errors of one detector are alike: either all persist, for the same time on average, or none does.
    """
    sensor = se3.compose(driven[problem.pose_row], problem.mount[problem.sensor])
    at, stamp_s = se3.transform(sensor, problem.measured[:, :3]), problem.seen_s
    curves = list[Curve]()
    for place in range(len(problem.oriented)):
        mine = np.flatnonzero(problem.place == place)
        i, j = _instants(len(mine))
        lag_s = np.abs(stamp_s[mine[j]] - stamp_s[mine[i]])
        lag_s, square = _medians(lag_s, ((at[mine[j]] - at[mine[i]]) ** 2).sum(axis=1) / MEDIAN)
        if len(lag_s) >= FEWEST_BINS:
            curves.append(Curve(lag_s, square, _worth(stamp_s[mine], lag_s)))
    if not curves:
        return Drift(None, None, 1.0, np.ones(len(problem.place)))
    shared = _find_shared_growth(problem, at, stamp_s)
    growth = min(_least_growth(curve) for curve in curves)
    if shared is not None:  # at most a standard deviation above what pairs share
        growth = float(np.clip(growth, max(shared.mean - shared.sigma, 0.0), max(shared.mean, 0.0) + shared.sigma))
    persist_s = [each_s for each_s in PERSIST_S if each_s <= max(float(np.ptp(stamp_s)), PERSIST_S[0])]
    gain, lasting = 0.0, np.zeros(len(persist_s))
    for curve in curves:
        white = max(fit_curve(curve, [], lever * growth)[1] for lever in LEVERS)
        parts, log_likelihood = max(
            (fit_curve(curve, persist_s, lever * growth) for lever in LEVERS), key=lambda f: f[1]
        )
        gain += max(log_likelihood - white, 0.0)
        lasting += parts[1:] / max(float(parts.sum()), 1e-12) / len(curves)
    found = Lasting(np.array(persist_s), lasting * (gain > PERSISTS * len(curves)))
    share = found.information(stamp_s, problem.place)
    translation = float(np.sqrt(max(0.5 * growth, problem.settings.steady_m**2)))
    range_m = float(np.median(np.linalg.norm(problem.measured[:, :3], axis=1)))
    expected = translation if shared is None else max(translation, float(np.sqrt(0.5 * shared.expected)))
    return Drift(translation, translation / max(range_m, 1.0), expected / translation, share)


def _instants(count: int) -> tuple[IntArray, IntArray]:
    """Return all pairs of a subset of sightings."""
    some = np.arange(count)[:: max(1, count // SIGHTINGS_A_PLACE)]
    i, j = np.triu_indices(len(some), 1)
    return some[i], some[j]


def _worth(stamp_s: FloatArray, lag_s: FloatArray) -> FloatArray:
    return 1.5 * np.clip(np.ptp(stamp_s) / lag_s, 1.0, MOST_LAGS)


class _Growth(NamedTuple):
    """Growth of the variance of what moves two landmarks alike [m^2/s], by least squares: it may be below 0."""

    mean: float
    sigma: float

    @property
    def expected(self) -> float:
        """Return the expectation, given that it isn't negative: of a normal distribution above 0."""
        from scipy.special import log_ndtr

        z = self.mean / self.sigma
        beyond = math.exp(-0.5 * z * z - 0.5 * math.log(2.0 * math.pi) - float(log_ndtr(z)))
        return max(self.mean + self.sigma * beyond, 0.0)


def _find_shared_growth(problem: SpatialProblem, at: FloatArray, stamp_s: FloatArray) -> _Growth | None:
    """Return how the variance of what moves two landmarks alike grows; None where no two are seen together."""
    often = np.argsort(-np.bincount(problem.place, minlength=len(problem.oriented)), kind="stable")[:SEEN_TOGETHER]
    rows = [np.flatnonzero(problem.place == place) for place in often]
    slope = weight = 0.0
    for one in range(len(rows)):
        for other in range(one):
            _, a, b = np.intersect1d(problem.pose_row[rows[one]], problem.pose_row[rows[other]], return_indices=True)
            if len(a) < FEWEST_OF_BOTH:
                continue
            a, b = rows[one][a], rows[other][b]
            i, j = _instants(len(a))
            moved, with_it = at[a[j]] - at[a[i]], at[b[j]] - at[b[i]]
            lag_s = np.abs(stamp_s[a[j]] - stamp_s[a[i]])
            both = [((moved + sign * with_it) ** 2).sum(axis=1) / MEDIAN for sign in (1.0, -1.0)]
            (lags_s, sums), (_, differences) = (_medians(lag_s, square, FEWEST_OF_BOTH) for square in both)
            variance = (0.25 * (sums + differences)) ** 2 / _worth(stamp_s[a], lags_s)
            slope += float((lags_s * 0.25 * (sums - differences) / variance).sum())
            weight += float((lags_s**2 / variance).sum())
    return None if weight == 0.0 else _Growth(slope / weight, weight**-0.5)


def _least_growth(curve: Curve) -> float:
    """Return the unbounded growth of a curve, in addition to persistent errors."""
    from scipy.optimize import nnls

    columns = np.column_stack([*curve_columns(curve, PERSIST_S[:-2]), curve.lag_s])
    found, _ = nnls(columns / curve.square[:, None], np.ones(len(curve.lag_s)), maxiter=MOST_SWAPS)
    return float(found[-1])


def _medians(lag_s: FloatArray, square: FloatArray, fewest: int = FEWEST_PAIRS) -> tuple[FloatArray, FloatArray]:
    """Median lag and median square of pairs, by lag."""
    some = lag_s > 0.0
    lag_s, square = lag_s[some], square[some]
    if len(lag_s) < FEWEST_PAIRS:
        return np.zeros(0), np.zeros(0)
    edges = np.geomspace(lag_s.min(), lag_s.max() * (1.0 + 1e-9), BINS)
    row = np.digitize(lag_s, edges)
    bins = [row == k for k in range(1, BINS) if np.count_nonzero(row == k) >= fewest]
    median = np.array([[np.median(lag_s[mine]), np.median(square[mine])] for mine in bins]).reshape(-1, 2)
    return median[:, 0], np.maximum(median[:, 1], 1e-12)


ROUNDS = 10
FEWEST = 3
"""Things that it takes: one more than there are numbers."""
STRETCHES, EVERYWHERE = 10, 3.36
"""What is seen in one stretch of a drive may err for one cause: the odometry drifts at random, a queue creeps. So many
standard deviations, which Student's t of ten stretches exceeds in one of 100 cases, are found everywhere."""
MOST_SCALE, SCALE_STEP, EM_ROUNDS = 0.1, 0.01, 12
"""Grid of scales from which expectation-maximisation begins, and its rounds."""


class Gauge(NamedTuple):
    """Systematic errors of scale and bend.

    Attributes:
        stated: factor on ranges that is known beforehand; None where it is not.
        scale: by which ranges, with that factor, are too short against the odometry, as a share; 0.03 of a detector
            that says 97 m where the odometry went 100.
        scale_sigma: its standard deviation.
        bend: angle about the vertical that the odometry turns too little by the metre [rad/m].
        bend_sigma: its standard deviation.
        things: how many said so.
    """

    stated: float | None = None
    scale: float = 0.0
    scale_sigma: float = USUAL.traffic.sigma_scale
    bend: float = 0.0
    bend_sigma: float = USUAL.traffic.sigma_bend
    things: int = 0

    @classmethod
    def before(cls, settings: SpaceConfig) -> Gauge:
        """Return the prior of the errors."""
        given = settings.traffic
        return cls(settings.range_scale, scale_sigma=given.sigma_scale, bend_sigma=given.sigma_bend)

    @property
    def range_scale(self) -> float:
        """Return the factor on ranges: the stated one, else that of the odometry's scale."""
        return 1.0 + self.scale if self.stated is None else self.stated

    @property
    def odometry_scale(self) -> float:
        """Return the factor on the odometry: 1, unless that of the ranges is stated."""
        return 1.0 if self.stated is None else 1.0 / (1.0 + self.scale)

    def applied(self, pose: FloatArray) -> FloatArray:
        """Return poses (F, 7) without what the odometry repeats."""
        scaled = pose.copy()
        scaled[:, :3] = pose[:1, :3] + self.odometry_scale * (pose[:, :3] - pose[:1, :3])
        return bent(scaled, self.bend / self.odometry_scale)


def bent(pose: FloatArray, bend: float) -> FloatArray:
    """Return poses (F, 7) that turn by `bend` [rad/m] more about their vertical, from the first one on."""
    if bend == 0.0 or len(pose) < 2:
        return pose
    step = se3.between(pose[:-1], pose[1:])
    twist = np.zeros((len(step), 6))
    twist[:, 5] = bend * np.linalg.norm(step[:, :3], axis=1)
    return se3.compose(pose[:1], accumulate(se3.retract(step, twist)))


def gauge_of(
    pose: FloatArray, when_s: FloatArray, frame: IntArray, seen: FloatArray, mount_m: FloatArray, thing: IntArray,
    settings: SpaceConfig = USUAL, still: StillConfig = STILL,
) -> Gauge:  # fmt: skip
    """Return scale and bend for which as many objects as possible are static.

    Args:
        pose: (F, 7) of the robot by the odometry.
        when_s: (K,) stamps of sightings.
        frame: (K,) of each.
        seen: (K, 3) where it is from the robot, in its frame.
        mount_m: (K, 3) where the sensor is on the robot.
        thing: (K,) what it is of.
        settings: with a factor on ranges that is known the scale that is left is the odometry's, if it is there at all.
        still: errors of where boxes are detected.
    """
    stated, given = settings.range_scale, settings.traffic
    _, of = np.unique(thing, return_inverse=True)
    count = int(of.max(initial=-1)) + 1
    if count < FEWEST:
        return Gauge.before(settings)
    ray = seen - mount_m
    at, by = _directions(pose, frame, mount_m + ray * (stated or 1.0), mount_m)
    sigma = still.sigma_m + still.sigma_share * np.linalg.norm(ray, axis=1)
    usual = np.array([given.sigma_scale, given.sigma_bend])
    stands = _still(when_s, at, by, of, sigma, given, still.alike_s)
    prior, found, spread = usual.copy(), np.zeros(2), np.zeros((2, 2))
    stretch = _stretches(when_s, of, count)
    for asked in (1, 0, 1, -1):  # the bend, the scale, and the bend again beside that scale
        if asked >= 0:
            prior[asked] = usual[asked]
        found, spread = _steady(at, by, of, stands, sigma, prior, stretch)
        if asked >= 0 and (asked == 1 or stated is not None):
            odds = _log_odds(found[asked], float(spread[0, asked]), float(usual[asked]), float(stands.sum()))
            odds += given.error_log_odds
            everywhere = abs(found[asked]) > EVERYWHERE * spread[1, asked]
            probable = odds > 0.0 and everywhere and stands.sum() >= FEWEST
            prior[asked] = usual[asked] if probable else 1e-9 * usual[asked]
    deviation = spread.max(axis=0) + 1e-9 * usual
    return Gauge(
        stated, float(found[0]), float(deviation[0]), float(found[1]), float(deviation[1]), round(float(stands.sum()))
    )


def _directions(
    pose: FloatArray, frame: IntArray, seen: FloatArray, mount_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return sightings (K, 2) from above, and (K, 2, 2) their derivatives by scale and bend."""
    at = se3.transform(pose[frame], seen)
    step = np.linalg.norm(np.diff(pose[:, :3], axis=0), axis=1)
    up = se3.rotation_of(pose)[1:, :, 2] * step[:, None]
    turned = np.vstack([np.zeros(3), np.cumsum(up, axis=0)])
    shifted = np.vstack([np.zeros(3), np.cumsum(np.cross(up, pose[1:, :3]), axis=0)])
    by_scale = at - se3.transform(pose[frame], mount_m)
    by_bend = np.cross(turned[frame], at) - shifted[frame]
    return at[:, :2], np.stack([by_scale, by_bend], axis=2)[:, :2]


def _still(
    when_s: FloatArray, at: FloatArray, by: FloatArray, of: IntArray, sigma: FloatArray, given: TrafficConfig,
    alike_s: float,
) -> FloatArray:  # fmt: skip
    """Return the (count,) probability that each object is static, by its velocity: a mixture of static and moving.

    The scale and the bend are those of its highest optimum (expectation-maximisation from a grid of scales), so that
    traffic which creeps along does not count for what stands.
    """
    weight, count = sigma**-2.0, int(of.max()) + 1
    moving_mps, usual = given.moving_mps, np.array([given.sigma_scale, given.sigma_bend])
    t = _centre_objects(when_s[:, None], of, count, weight)[:, 0]
    curve = np.maximum(np.bincount(of, weight * t**2, minlength=count), 1e-9)
    velocity = _sum_objects((weight * t)[:, None] * at, of, count) / curve[:, None]
    slope = (_sum_objects((weight * t)[:, None] * by.reshape(-1, 4), of, count) / curve[:, None]).reshape(-1, 2, 2)
    alike = np.maximum(1.0, alike_s * np.bincount(of) / np.maximum(_spans(when_s, of, count), 1e-3))
    variance = given.still_mps**2 + alike / curve
    best, found = -np.inf, np.ones(count)
    for start in np.arange(-MOST_SCALE, MOST_SCALE + 1e-9, SCALE_STEP):
        value, share, total = np.array([start, 0.0]), 0.5, -np.inf
        for _ in range(EM_ROUNDS):
            off = ((velocity + slope @ value) ** 2).sum(axis=1)
            still = np.log(share / variance) - 0.5 * off / variance
            moving = np.log((1.0 - share) / moving_mps**2) - 0.5 * off / moving_mps**2
            total = float(np.logaddexp(still, moving).sum() - 0.5 * ((value / usual) ** 2).sum())
            p = 1.0 / (1.0 + np.exp(np.clip(moving - still, -700.0, 700.0)))
            share = float(np.clip(p.mean(), 0.05, 0.95))
            square = np.einsum("k,kia,kib->ab", p / variance, slope, slope)
            square += np.diag([given.sigma_scale**-2.0, given.sigma_bend**-2.0])
            value = -np.linalg.solve(square, np.einsum("k,kia,ki->a", p / variance, slope, velocity))
        if total > best:
            best, found = total, p
    return found


def _spans(when_s: FloatArray, of: IntArray, count: int) -> FloatArray:
    """Return (count,) seconds from the first to the last sighting of each object."""
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, of, when_s)
    np.maximum.at(last, of, when_s)
    return np.asarray(last - first)


def _stretches(when_s: FloatArray, of: IntArray, count: int) -> IntArray:
    """Return the (count,) stretch of the drive of each object, with equal numbers in each."""
    middle = _sum_objects(when_s[:, None], of, count)[:, 0] / np.bincount(of)
    return np.asarray(np.argsort(np.argsort(middle)) * STRETCHES // count)


def _steady(
    at: FloatArray, by: FloatArray, of: IntArray, still: FloatArray, sigma: FloatArray, prior: FloatArray,
    stretch: IntArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return scale and bend by reweighted least squares; and deviations clustered by objects and by stretches."""
    trust, found, count = np.maximum(still, 1e-9)[of], np.zeros(2), len(still)
    weight, total, told = trust / sigma**2, np.eye(2), np.zeros((count, 2))
    for _ in range(ROUNDS):
        off, slope = _centre_objects(at, of, count, weight), _centre_objects(by.reshape(len(at), 4), of, count, weight)
        slope = slope.reshape(-1, 2, 2)
        square = np.einsum("k,kia,kib->kab", weight, slope, slope)
        right = -np.einsum("k,kia,ki->ka", weight, slope, off)
        total = square.sum(axis=0) + np.diag(prior**-2.0)
        found = np.linalg.solve(total, right.sum(axis=0))
        told = _sum_objects(right - square @ found, of, count)
        residual = np.linalg.norm(off + slope @ found, axis=1) / (HEAVY * sigma)
        weight = trust / (sigma * np.hypot(1.0, residual)) ** 2
    inverse, deviation = np.linalg.inv(total), []
    for part, witnesses in ((told, float(still.sum())), (_sum_objects(told, stretch, STRETCHES), float(STRETCHES))):
        spread = inverse @ part.T @ part @ inverse * witnesses / max(witnesses - 2.0, 1e-3)
        deviation.append(np.sqrt(np.maximum(np.diag(spread), 0.0)))
    return found, np.array(deviation)


def _log_odds(value: float, sigma: float, usual: float, count: float) -> float:
    """Return the log odds of an error: Student's density over `count` objects, against that without an error."""
    sigma = max(sigma, 1e-12)
    fit = 0.5 * count * np.log1p((value / sigma) ** 2 / max(count - 2.0, 1e-3))
    return float(fit - np.log(np.hypot(usual, sigma) / sigma))


def _centre_objects(values: FloatArray, of: IntArray, count: int, weight: FloatArray) -> FloatArray:
    """Return values (K, C) less the mean of their object."""
    mean = _sum_objects(weight[:, None] * values, of, count) / np.bincount(of, weight, minlength=count)[:, None]
    return np.asarray(values - mean[of])


def _sum_objects(values: FloatArray, of: IntArray, count: int) -> FloatArray:
    """Return (count, C) sums by object."""
    return np.stack([np.bincount(of, column, minlength=count) for column in values.T], axis=1)
