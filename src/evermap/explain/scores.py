"""What the estimator held as stated, asked at its solution: score tests of calibrations, and how odometry's errors are
tied in time.

A run may fit its readings well and still be wrong: where a sensor is not as stated, noise levels that are learned take
in what that does. So every calibration that may be off is one more column at the optimum. It tells by how much a step
of it would raise the likelihood (Rao's score test, `evidence.Screen`), and how far that step would move the poses, over
what they are said to be known to. A step that is significant and moves them says that they are not known so well.

Errors of odometry that alternate from step to step are those of poses that jitter along the way, as of stamps that are
late by another delay each. Noise of odometry is independent from step to step, or lasts. And where odometry broke, the
poses beside the break hang on it by detections alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from evermap.errors import EvermapError
from evermap.explain.causes import list_suspects
from evermap.explain.causes.lenses import FOCAL
from evermap.explain.causes.odometry import DELAY_S, turn_less
from evermap.explain.causes.suspect import LITTLE, RARE_P, USUAL_P, Inputs, Suspect
from evermap.explain.evidence import DETECTIONS, ODOMETRY, AnySession, Column, Optimum, Screen, optimum_of, residuals_of
from evermap.explain.linearise import FINE_STEP, change_by, change_by_motion, hold_by_map
from evermap.slam.estimate import Solved
from evermap.types import FloatArray, IntArray, SpatialRecording, Trajectory, is_in_space

Intrinsics: TypeAlias = tuple[float, float, float, float]
"""Focal lengths and centre of an image [px]."""
SIGNIFICANT = 10.0
"""Gain of a score test [nats]: 4.5 standard deviations, of thirty or so that are asked of a run."""
MOST_SHIFT = 0.5
"""Standard deviations by which a calibration may move the poses and be let be."""
USUAL = frozenset({"odometry-scale", "turn-scale", "turn-bias"})
"""Calibrations that are off on every robot: they may be so beside any other."""
OF_MOTION = USUAL | {"clock", "clock-drift"}
"""What changes residuals by how the robot moved."""
USUAL_SHARE = 0.13
"""Standard deviation of these, where all is well, over that beforehand: 2 % of a scale, .4 deg/s of a gyroscope."""
CLOCK_RATE = 0.005
"""Standard deviation of how much faster one clock runs than another, where they do at all; a tenth of it is as fast as
a clock is slewed that is set by another over a network. Crystals differ by less."""
STRETCHES = 8
"""Parts of a drive by which slopes along them are compared."""
OF_LENGTHS = frozenset({"range-scale", "tag-size", "map-scale"})
"""What changes all lengths. In the plane these are states, at a mean of several priors, which is no optimum."""
CHANCE = 4.0
"""Gain [nats] from which its variance is asked, too."""
INFORMED = 4.0
"""Times the information of its prior that a session must have on a calibration."""
KNOWN = 0.5
"""Mean square of the odometry's whitened residuals from which its errors are seen, not smoothed away."""
USED = 0.5
"""Weight from which a step of the odometry, or a detection, counts."""
FEWEST_STEPS = 30
"""Steps of which a correlation says something."""


def _stretch_stamps(inputs: Inputs, state: float) -> Inputs:
    """Return the same with the frames at the times of a clock that is slower by this share; half of the drive stays."""
    recording: Any = inputs.recording
    stamp_s = recording.frames.stamp_s
    middle_s = 0.5 * (stamp_s[0] + stamp_s[-1])
    frames = replace(recording.frames, stamp_s=stamp_s - state * (stamp_s - middle_s))
    return replace(inputs, recording=replace(recording, frames=frames))


DRIFT = Suspect(
    "clock-drift", "clocks", RARE_P, _stretch_stamps,
    lambda s: f"the clock of the detections runs {abs(s):.2%} {'fast' if s > 0 else 'slow'} of that of the odometry",
    lambda s: f"detections.csv, frames.csv: stamp_s x {1.0 - s:.5g}", CLOCK_RATE,
)  # fmt: skip
"""Two clocks that drift apart; at half of the drive they agree, but for the delay that is estimated."""
TURN_BIAS = Suspect(
    "turn-bias", "odometry", USUAL_P, turn_less,
    lambda s: f"the odometry turns {abs(s):.3g} rad/s too much to the {'left' if s > 0.0 else 'right'} all the time: "
    "the zero of the gyroscope",
    lambda s: f"odometry.csv: turns {'-' if s > 0.0 else '+'} {abs(s):.3g} rad/s", 0.05,
)  # fmt: skip
"""A gyroscope that reads a rate at rest: cheap ones are off by up to 3 deg/s before they are calibrated."""


@dataclass(frozen=True, slots=True)
class CalibrationScore:
    """A calibration that is held as stated, and one step of it from the solution.

    Attributes:
        suspect: what is held, and its words.
        value, sigma: the step, and its standard deviation.
        gain: log likelihood that it gains [nats], errors that last counted once.
        shift: median of how far poses would move, over the median of their standard deviations; of clocks that drift
            apart the most. Of what is usual of odometry it is not asked: nan.
    """

    suspect: Suspect
    value: float
    sigma: float
    gain: float
    shift: float


class _Usual(NamedTuple):
    """What is off on every robot: its cause, by how much residuals (R,) change with it, the same as a further number at
    the optimum, and the slope of the cost along it.
    """

    suspect: Suspect
    direction: FloatArray
    column: Column
    pull: float


@dataclass(frozen=True)
class ScreenedSession:
    """A solved session, with the screen of its optimum, which is made once for all that is asked there.

    Attributes:
        session: the solution.
        inputs: of which it is the solution.
    """

    session: AnySession
    inputs: Inputs

    @cached_property
    def screen(self) -> Screen:
        """The screen of its optimum."""
        return Screen.of(optimum_of(self.session))

    @cached_property
    def usual(self) -> list[_Usual]:
        """What is usual of odometry, at the solution."""
        return _list_usual(self.session, self.screen, self.inputs)

    @cached_property
    def held(self) -> ScreenedSession:
        """The session at the optimum at which all landmarks of the map stand: `hold_by_map`."""
        held = hold_by_map(self.session)
        return self if held is self.session else ScreenedSession(held, self.inputs)


@dataclass(frozen=True, slots=True)
class SessionScores:
    """What a session tells of what was held; nothing where it can't be asked.

    Attributes:
        calibrations: those that were asked.
        alternation: standard deviations by which errors of odometry alternate from step to step more than by chance.
        adrift: poses beside a break of the odometry that saw landmarks, and none of it was used.
    """

    calibrations: tuple[CalibrationScore, ...] = field(default=())
    alternation: float = math.nan
    adrift: int = 0

    @property
    def told(self) -> tuple[CalibrationScore, ...]:
        """Return the steps that are significant, and larger than sensors usually need."""
        return tuple(
            one for one in self.calibrations if one.gain > SIGNIFICANT and abs(one.value) > LITTLE * one.suspect.sigma
        )

    @property
    def harmful(self) -> tuple[CalibrationScore, ...]:
        """Return those of `told` that move the poses by what matters."""
        return tuple(one for one in self.told if one.shift > MOST_SHIFT)

    @property
    def suspected(self) -> CalibrationScore | None:
        """Return the step of those that are told that moves the poses most; None without."""
        return max(self.told, key=lambda one: one.shift, default=None)


def is_unusual(score: CalibrationScore) -> bool:
    """Return whether a step is significant, and more than twice what is usual of odometry."""
    return score.gain > SIGNIFICANT and abs(score.value) > 2.0 * USUAL_SHARE * score.suspect.sigma


def score_session(asked: ScreenedSession, trajectory: Trajectory) -> SessionScores:
    """Return what a solved session tells of what it held as stated; `trajectory` is of its result, for how well poses
    are known.
    """
    dim = asked.inputs.recording.dim
    variance = np.trace(trajectory.covariance[:, :dim, :dim], axis1=1, axis2=2)
    sigma_m = float(np.sqrt(np.median(variance))) if len(variance) else 0.0
    if not sigma_m > 0.0:
        return SessionScores()
    try:
        found = tuple(_score_all(asked, sigma_m))
        optimum = asked.screen.optimum
    except EvermapError:
        return SessionScores()
    return SessionScores(found, _measure_alternation(optimum), _count_adrift(optimum, _find_pose_row(asked.session)))


def _find_pose_row(session: AnySession) -> IntArray:
    """Return (M,) rows of the poses of the detections that a session used."""
    solved = session.outcome.problem if isinstance(session, Solved) else session.solved.optimum.smoother.problem
    return solved.pose_row


def _score_all(asked: ScreenedSession, sigma_m: float) -> Iterable[CalibrationScore]:
    """Yield the step of each calibration, what is usual of odometry marginalised."""
    session, screen, inputs, usual = asked.session, asked.screen, asked.inputs, asked.usual
    optimum, dim = screen.optimum, inputs.recording.dim
    at = optimum.graph.structure.system.tree.begin[: len(optimum.state.pose), None] + np.arange(dim)
    between, steps = _find_shared(usual, USUAL_SHARE), [one.column.step()[at] for one in usual]
    for suspect in _list_calibrations(inputs):
        if suspect.code == "clock" and _is_delay_estimated(session, inputs, suspect):
            continue
        if suspect.code in OF_MOTION:
            direction = change_by_motion(session, screen, inputs, suspect)
        else:
            direction = change_by(session, screen, inputs, suspect, FINE_STEP)
        if direction is None:
            continue
        column = screen.column(direction)
        prior = suspect.sigma**-2
        known, pull = column.information_with(column), screen.pull(column)
        if not known > INFORMED * prior:  # nothing but its prior says where it is
            continue
        shared = np.array([column.information_with(one.column) for one in usual])
        taken = np.linalg.solve(between, shared)
        known += prior - float(shared @ taken)
        pull -= float(taken @ [one.pull for one in usual])
        value = -pull / known
        moved = column.step()[at] - sum((by * step for by, step in zip(taken, steps, strict=True)), np.zeros(1))
        moved = np.linalg.norm(value * (moved + _went_by_clock(session, suspect, dim)), axis=1)
        # a drift goes on, and is worst at an end
        shift = float(np.max(moved) if suspect is DRIFT else np.median(moved))
        gain = 0.5 * pull**2 / known * optimum.worth
        if gain > CHANCE:
            gain /= max(screen.variance(column, value) / column.information_with(column), 1.0)
        yield CalibrationScore(suspect, value, known**-0.5, gain, shift / sigma_m)


def score_odometry(asked: ScreenedSession) -> tuple[CalibrationScore, ...]:
    """Return the steps of what is off on every robot and no state of the solution, each beside the others: turns, and
    the zero of the gyroscope. Errors of a motion last, so slopes are compared between stretches of the drive.
    """
    try:
        usual = [one for one in asked.usual if not _is_state(asked.session, one.suspect)]
    except EvermapError:
        return ()
    if not usual:
        return ()
    screen = asked.screen
    information = _find_shared(usual, 1.0)
    covariance = np.linalg.inv(information)
    value = -covariance @ [one.pull for one in usual]
    directions = np.array([one.direction for one in usual])
    step, found = None, list[CalibrationScore]()
    for row, one in enumerate(usual):
        if not one.column.information_with(one.column) > INFORMED * one.suspect.sigma**-2:
            continue
        best, variance = float(value[row]), float(covariance[row, row])
        gain = 0.5 * best**2 / variance * screen.optimum.worth
        if gain > CHANCE:
            step = screen.follow(screen.column(value @ directions), 1.0) if step is None else step
            stretches = screen.find_stretches(_find_pose_row(asked.session), STRETCHES)
            beside = screen.column(covariance[row] @ directions / variance)  # the others at their best beside it
            gain /= max(screen.variance(beside, best, step, stretches) / beside.information_with(beside), 1.0)
        found.append(CalibrationScore(one.suspect, best, variance**0.5, gain, math.nan))
    return tuple(found)


def weigh_usual(asked: ScreenedSession) -> float:
    """Return by how much the log evidence of a solution is larger with what is usual of odometry marginalised [nats].

    Of what is no state of it, as turns in space: held as stated they would count against a cause that they look like.
    By what is linear at the optimum (MATH.md, section 8).
    """
    try:
        usual = [one for one in asked.usual if not _is_state(asked.session, one.suspect)]
    except EvermapError:
        return 0.0
    if not usual:
        return 0.0
    known, pull = _find_shared(usual, USUAL_SHARE), np.array([one.pull for one in usual])
    volume = np.linalg.slogdet(known)[1] + 2.0 * sum(math.log(USUAL_SHARE * one.suspect.sigma) for one in usual)
    return float(0.5 * pull @ np.linalg.solve(known, pull) - 0.5 * volume)


def _list_usual(session: AnySession, screen: Screen, inputs: Inputs) -> list[_Usual]:
    """Return what is usual of odometry, at a solution."""
    found = list[_Usual]()
    for suspect in (*list_suspects(inputs, calibrations=True), TURN_BIAS):
        if suspect.code not in USUAL or inputs.recording.odometry is None:
            continue
        direction = change_by_motion(session, screen, inputs, suspect)
        if direction is not None:
            column = screen.column(direction)
            found.append(_Usual(suspect, direction, column, screen.pull(column)))
    return found


def _is_state(session: AnySession, suspect: Suspect) -> bool:
    """Return whether the solution has a state for it: for scales of odometry in the plane, for its length in space."""
    return suspect.code == "odometry-scale" or (isinstance(session, Solved) and suspect.code == "turn-scale")


def _find_shared(usual: Sequence[_Usual], share: float) -> FloatArray:
    """Return the information (K, K) that what is usual shares, of priors of a share of their standard deviations."""
    between = np.array([[one.column.information_with(two.column) for two in usual] for one in usual])
    prior = np.array([(share * one.suspect.sigma) ** -2.0 for one in usual])
    return between.reshape(len(usual), len(usual)) + np.diag(prior)


def _is_delay_estimated(session: AnySession, inputs: Inputs, suspect: Suspect) -> bool:
    """Return whether the clock of a suspect, of one sensor or of all, is a state in space that was not held.

    What its score would be then is how far the velocity that was averaged for it is from that of the motions: nothing
    but that is left where the state itself is marginalised.
    """
    if isinstance(session, Solved):
        return False
    free = session.solved.optimum.smoother.problem.delay_sigma_s > 0.0
    own = np.array([one.name == suspect.subject for one in inputs.recording.sensors])
    return bool(free[own].all() if own.any() else free.all())


def _went_by_clock(session: AnySession, suspect: Suspect, dim: int) -> FloatArray:
    """Return how far from the poses (N, d) the robot is by the clock of its odometry, for a unit of its drift."""
    if suspect is not DRIFT:
        return np.zeros(dim)
    if isinstance(session, Solved):
        pose, stamp_s = session.outcome.graph_estimate.pose, session.outcome.problem.stamp_s
    else:
        optimum = session.solved.optimum
        pose, stamp_s = optimum.estimate.pose, optimum.smoother.problem.stamp_s
    off_s = stamp_s - 0.5 * (stamp_s[0] + stamp_s[-1])
    return np.asarray(off_s[:, None] * np.gradient(pose[:, :dim], stamp_s, axis=0))


def _measure_alternation(optimum: Optimum) -> float:
    """Return by how many standard deviations errors of odometry alternate; nan where detections do not show them."""
    structure, weight = optimum.graph.structure, optimum.now.weights[ODOMETRY]
    rows = structure.system.factors.rows[structure.first[ODOMETRY] : structure.first[ODOMETRY + 1]]
    if len(rows) < FEWEST_STEPS:
        return math.nan
    residual = residuals_of(optimum.graph, optimum.now)[0][: rows.sum()].reshape(len(rows), -1)
    residual = residual * np.sqrt(np.minimum(weight, 1.0))[:, None]
    residual = residual[:, np.mean(residual**2, axis=0) > KNOWN]
    product = residual[1:] * residual[:-1]
    return float(-product.sum() / math.sqrt(max(float((product**2).sum()), 1e-12))) if product.size else math.nan


def _count_adrift(optimum: Optimum, pose_row: IntArray) -> int:
    """Return poses with detections (M,) between a broken step and the next pose of which any detection is used."""
    broken = np.flatnonzero(optimum.now.weights[ODOMETRY] < USED)
    seen, used = np.unique(pose_row), np.unique(pose_row[optimum.now.weights[DETECTIONS][: len(pose_row)] >= USED])
    last = np.concatenate([[-1], used])[np.searchsorted(used, broken, side="right")]
    after = np.concatenate([used, [np.iinfo(np.int64).max]])[np.searchsorted(used, broken + 1)]
    between = (seen > last[:, None]) & (seen < after[:, None])
    return int(np.count_nonzero(between.any(axis=0)))


def _list_calibrations(inputs: Inputs) -> Iterable[Suspect]:
    """Yield all that may be off of a sensor as a whole, of the odometry and of the map."""
    recording = inputs.recording
    for suspect in list_suspects(inputs, calibrations=True):
        if suspect.code not in USUAL and (is_in_space(recording) or suspect.code not in OF_LENGTHS):
            yield suspect
    if recording.odometry is not None:
        yield DRIFT
    if not is_in_space(recording):
        return
    if len(recording.sensors) > 1 and recording.odometry is not None:
        yield from _of_clocks(recording)
    if np.isfinite(recording.detections.corner_px).any():
        for intrinsics in {one.intrinsics: None for one in recording.sensors if one.intrinsics is not None}:
            yield _of_pixels(recording, intrinsics)


def _of_clocks(recording: SpatialRecording) -> Iterable[Suspect]:
    """Yield what may be off of the clock of each sensor."""
    for row, sensor in enumerate(recording.sensors):
        name = sensor.name
        yield Suspect(
            "clock", name, USUAL_P, partial(_shift_sensor, sensor=row),
            lambda s, name=name: f"stamps of {name} are {abs(s):.3g} s {'late' if s > 0 else 'early'}",  # type: ignore[misc]
            lambda s, name=name: f"detections.csv of {name}: stamp_s {'-' if s > 0 else '+'} {abs(s):.3g}",  # type: ignore[misc]
            DELAY_S,
        )  # fmt: skip


def _of_pixels(recording: SpatialRecording, intrinsics: Intrinsics) -> Suspect:
    """Return that the pixels of cameras that share a calibration are not as wide for their height as stated."""
    fx, fy, cx, cy = intrinsics
    name = ", ".join(one.name for one in recording.sensors if one.intrinsics == intrinsics)
    return Suspect(
        "intrinsics", f"{name} fx", USUAL_P, partial(_widen_pixels, intrinsics=intrinsics),
        lambda s: f"{name}: fx over fy is {fx / fy * math.exp(s):.4g}, not {fx / fy:.4g}",
        lambda s: f"[camera.{name}] intrinsics = "
        f"[{fx * math.exp(0.5 * s):.5g}, {fy * math.exp(-0.5 * s):.5g}, {cx:g}, {cy:g}]",
        FOCAL,
    )  # fmt: skip


def _shift_sensor(inputs: Inputs, state: float, sensor: int) -> Inputs:
    """Return the same with frames of one sensor earlier by the delay of its stamps."""
    recording: Any = inputs.recording
    seen, frames = recording.detections, recording.frames
    own, others = (
        np.isin(np.arange(len(frames)), seen.frame[of]) for of in (seen.sensor == sensor, seen.sensor != sensor)
    )
    stamp_s = np.where(own & ~others, frames.stamp_s - state, frames.stamp_s)
    return replace(inputs, recording=replace(recording, frames=replace(frames, stamp_s=stamp_s)))


def _widen_pixels(inputs: Inputs, state: float, intrinsics: Intrinsics) -> Inputs:
    """Return the same with another ratio of the focal lengths of cameras of a calibration."""
    recording: Any = inputs.recording
    fx, fy, cx, cy = intrinsics
    other = (fx * math.exp(0.5 * state), fy * math.exp(-0.5 * state), cx, cy)
    sensors = tuple(
        replace(one, intrinsics=other) if one.intrinsics == intrinsics else one for one in recording.sensors
    )
    return replace(inputs, recording=replace(recording, sensors=sensors))
