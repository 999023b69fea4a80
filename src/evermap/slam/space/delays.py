"""How late the stamps of the sensors are against the odometry: as stated, or estimated with everything else.

Each delay is a state of the problem (`SpatialProblem.delay_sigma_s`), with the velocity by the odometry for Jacobian. A
step from the optimum with right stamps shows whether any sensor's are late, before anything is solved again; only those
that may be are freed. As for the states in the plane (`slam.calibration`), 'as stated' and 'drawn from the prior' are
weighed by their evidence, under the number of observations that the data are worth, and the estimate is the mean.

An odometry with the stamps of the frames may have been made of them, as visual odometry is: its clock is theirs, and
its velocity is that of the step before, not of an instant, so that detections that seem early by less than half a step
are not. Nothing of it makes detections late: they are where a robot logs all that it knows in one loop.

A delay shows where the velocity changes. Odometry that jitters seems to change its velocity all the time, which shows
no delay: the velocity is averaged over the time that shows most, and what jitter is left in it does not count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.config import CalibrationConfig
from evermap.errors import NumericalError
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se3
from evermap.slam.calibration import price
from evermap.slam.space.estimate import SpatialOptimum, converge
from evermap.slam.space.linearise import MOUNT, STATES
from evermap.slam.space.problem import SpatialEstimate, SpatialProblem
from evermap.slam.space.smoother import SpatialLinear, SpatialSmoother
from evermap.types import BoolArray, FloatArray

LEAST_SHARE = 1e-3
"""Share of the changes of velocity that is no jitter, at least."""
LONGEST_S = 2.0
"""Time before and after an instant over which the velocity there is averaged, at most."""
OF_STEP = 0.5
"""By how much detections seem early at least, in steps of an odometry with the stamps of the frames, that are."""
MOST_ROUNDS, SETTLED = 4, 0.75
"""Times that delays are freed, until the whole steps in them are right to within so many."""
USUAL = CalibrationConfig()


@dataclass(frozen=True, slots=True)
class Delays:
    """What is known of how late stamps are, beside the values.

    Attributes:
        sigma_s: (S,) standard deviations.
        p_needed: (S,) probability that the stamps are not as stated.
    """

    sigma_s: FloatArray
    p_needed: FloatArray


def with_delays(optimum: SpatialOptimum) -> tuple[SpatialOptimum, Delays | None]:
    """Return the optimum with the delays of the sensors' stamps; the same one where all are as stated."""
    problem, sigma_s = optimum.smoother.problem, optimum.smoother.problem.settings.delay_sigma_s
    if problem.path is None or sigma_s == 0.0 or not problem.driven:
        return optimum, None
    least_s = OF_STEP * problem.path.step_s if problem.has_clock_of_frames else 0.0
    count, start, stated = len(problem.mount), optimum.estimate, optimum
    free = _free_delays(problem, optimum, np.full(count, sigma_s), np.zeros(count))
    smoother = SpatialSmoother(free, start.pose)
    now = smoother.linearised(start, optimum.noise, heavy=False)
    factorised = smoother.factorised(now)
    now, delay = smoother.after(now, exhaust(factorised.solution())), np.arange(MOUNT, STATES * count, STATES)
    jitter = _jitter(smoother, now, np.diag(factorised.border_covariance())[delay], sigma_s)
    information, jitters = factorised.information.copy(), np.zeros(len(factorised.right))
    jitters[delay] = jitter
    off_s = np.asarray(np.linalg.solve(information - np.diag(jitters), factorised.right)[delay])
    if _is_of_step(off_s, least_s):
        return optimum, None
    found, _ = _price_delays(smoother, now, off_s, sigma_s, jitter)
    # of a clock that is left as stated it is told how late it is if it is not
    found = replace(found, sigma_s=found.sigma_s / np.sqrt(np.maximum(found.p_needed, 1e-12)))
    narrow = np.zeros(count)
    least = USUAL.p_needed  # clocks that may as well be right are left as stated
    for _ in range(MOST_ROUNDS):
        asked = found.p_needed > least
        free = _free_delays(problem, optimum, np.where(asked, sigma_s, 0.0), optimum.estimate.delay_s)
        free = replace(free, delay_jitter=np.where(asked, jitter, 0.0))
        if not asked.any():
            if not optimum.estimate.delay_s.any():
                return optimum, found
            return converge(problem, _move_values(optimum, problem, asked), optimum.noise), found
        try:
            optimum = converge(free, _move_values(optimum, free, asked), optimum.noise)
        except NumericalError:  # what seemed to show a delay was jitter of the velocity
            return stated, found
        smoother, now = optimum.smoother, optimum.now
        again, narrow = _price_delays(smoother, now, optimum.estimate.delay_s, sigma_s, np.zeros(count))
        found = Delays(np.where(asked, again.sigma_s, found.sigma_s), np.where(asked, again.p_needed, found.p_needed))
        least = USUAL.p_spare
        if np.abs(optimum.estimate.delay_s - free.whole_s).max() < SETTLED * find_step_s(problem):
            break
        variance = np.diag(smoother.factorised(now).border_covariance())[delay]
        variance = np.where(asked, variance, sigma_s**2)  # those that were held say nothing of theirs
        jitter = np.where(asked, _jitter(smoother, now, 1.0 / (1.0 / variance + free.delay_jitter), sigma_s), jitter)
    if _is_of_step(optimum.estimate.delay_s, least_s):
        return stated, None
    sober = replace(free, delay_sigma_s=np.where(asked, narrow**-0.5, 0.0))
    return converge(sober, optimum.estimate, optimum.noise, heavy_rounds=0), found


def _is_of_step(delay_s: FloatArray, least_s: float) -> bool:
    """Return whether delays (S,) are those of an odometry made of the frames: early, by less than so much."""
    return bool(((delay_s <= 0.0) & (delay_s > -least_s)).all())


def find_step_s(problem: SpatialProblem) -> float:
    """Return the steps in which delays are taken back along the path [s]; the rest is by an averaged velocity.

    Steps of the odometry, between whose stamps it is interpolated; or those of the poses, where these are denser: after
    such a step poses lie between stamps as often as before, and a velocity that is averaged over slow odometry is not
    that of an instant.
    """
    assert problem.path is not None
    return min(problem.path.step_s, float(np.median(np.diff(problem.stamp_s))))


def _free_delays(
    problem: SpatialProblem, optimum: SpatialOptimum, sigma_s: FloatArray, delay_s: FloatArray
) -> SpatialProblem:
    """Return the problem with delays of standard deviations (S,), near those (S,)."""
    assert problem.path is not None
    velocity_s = _find_averaging_time(problem, optimum.smoother.driven(optimum.now))
    step_s = find_step_s(problem)
    whole_s = step_s * np.round(delay_s / step_s)
    return replace(problem, velocity_s=velocity_s, whole_s=whole_s, delay_sigma_s=sigma_s)


def _move_values(optimum: SpatialOptimum, problem: SpatialProblem, asked: BoolArray) -> SpatialEstimate:
    """Return the values, of a problem with other whole steps, at which the sensors were where they were."""
    estimate, of = optimum.estimate, optimum.smoother.sensor_of_pose
    row, state = np.arange(len(of)), estimate.state.copy()
    state[~asked, MOUNT] = 0.0
    back, after = optimum.smoother.problem.earlier(estimate.delay_s)[0], problem.earlier(state[:, MOUNT])[0]
    pose = se3.retract(se3.retract(estimate.pose, back[of, row]), -after[of, row])
    return replace(estimate, pose=pose, state=state)


def _jitter(smoother: SpatialSmoother, now: SpatialLinear, variance: FloatArray, sigma_s: float) -> FloatArray:
    """Return (S,) what of the information on delays of variances (S,) is jitter of the velocity."""
    real, changes = _find_shown(smoother.problem, smoother.driven(now), 0.0)
    return np.maximum(1.0 / variance - sigma_s**-2, 0.0) * (1.0 - min(real / changes, 1.0))


def _price_delays(
    smoother: SpatialSmoother, now: SpatialLinear, delay_s: FloatArray, sigma_s: float, jitter: FloatArray
) -> tuple[Delays, FloatArray]:
    """Return what delays (S,) under the prior say, and (S,) the information of the narrower one with their means.

    Of the information on them `jitter` (S,) is none, beside what the problem knows of.
    """
    problem, count = smoother.problem, len(delay_s)
    sigma, p_needed, information = np.zeros(count), np.zeros(count), np.ones(count)
    for row in np.flatnonzero(problem.delay_sigma_s):
        variance, worth = smoother.worth_by_stretches(now, STATES * int(row) + MOUNT)
        variance = 1.0 / (1.0 / variance - jitter[row])
        real, changes = _find_shown(problem, smoother.driven(now), float(delay_s[row]))
        worth *= max(changes / real, 1.0)
        p_needed[row], information[row] = price(float(delay_s[row]), variance, worth, sigma_s)
        own = worth * variance * sigma_s**2 / (worth * variance + sigma_s**2)
        sigma[row] = np.sqrt(p_needed[row] * (own + (1.0 - p_needed[row]) * delay_s[row] ** 2))
    return Delays(sigma, p_needed), information


def _find_averaging_time(problem: SpatialProblem, driven: FloatArray) -> float:
    """Return the time over which averaged velocities show most of a delay."""
    assert problem.path is not None
    step_s = problem.path.step_s
    tried_s = step_s * 2.0 ** np.arange(max(1, int(np.log2(LONGEST_S / step_s)) + 1))
    found = [_find_shown(replace(problem, velocity_s=float(each_s)), driven, 0.0) for each_s in tried_s]
    return float(tried_s[int(np.argmax([real**2 / changes for real, changes in found]))])


def _find_shown(problem: SpatialProblem, driven: FloatArray, delay_s: float) -> tuple[float, float]:
    """Return the information on a delay that the changes of the velocity hold, without jitter and as they are.

    The former by their product with those of the velocity from one stamp of the odometry to the next but one.

    Args:
        problem: the measurements.
        driven: (N - 1, 6, 14) odometry, linearised and whitened.
        delay_s: the delay.
    """
    path, within_s = problem.path, problem.velocity_s
    assert path is not None
    told, at_once = (
        np.einsum("nra,na->nr", driven[..., :6], velocity[:-1])
        + np.einsum("nra,na->nr", driven[..., 6:12], velocity[1:])
        for velocity in (path.velocity(problem.stamp_s - delay_s, each_s) for each_s in (within_s, path.step_s))
    )
    changes = max(float((told**2).sum()), 1e-300)
    alike = np.clip((within_s + path.step_s - np.diff(problem.stamp_s)) / (2.0 * path.step_s), 0.0, 1.0)
    squares = (driven[..., 6:12] ** 2).sum(axis=1) @ path.jitter
    jitter = float((squares * (1.0 - alike)).sum()) / within_s
    return max(float((told * at_once).sum()) - jitter, LEAST_SHARE * changes), changes
