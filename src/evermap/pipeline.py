"""From recordings to trajectories and maps: the main jobs, told in the order in which they happen.

`run_slam` is one recording by itself, or in a map that is given. `run_session` is one session of a map that lives on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from evermap import plugins
from evermap.interrupts import watched
from evermap.types import FloatArray, Landmarks, MapChange, Recording, SlamResult

if TYPE_CHECKING:
    from evermap.config import Config, SlamConfig
    from evermap.maps.living import Evidence, LivingMap
    from evermap.maps.sessions.session import Visit
    from evermap.slam.calibration import CalibrationPrior
    from evermap.slam.check import Check
    from evermap.slam.method import Method
    from evermap.slam.problem import Noise
    from evermap.slam.session import Prepared
    from evermap.slam.streaming import StreamingSlam

Progress = Callable[[float, float], None]
"""Called with seconds of the recording that are done, and seconds in all."""


def run_slam(
    recording: Recording,
    config: Config | None = None,
    *,
    prior_map: Landmarks | None = None,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Estimate trajectory, landmarks, calibration and noise of one recording.

    Args:
        recording: what a reader returned; its truth is not looked at.
        config: settings; None for the defaults.
        prior_map: landmarks to localise in, with covariances; None maps from scratch in the frame of the first pose.
        realtime: process at the recording's pace.
        progress: told after every frame. An interrupt (Ctrl-C) ends the run early, with what was done so far.

    Raises:
        InputError: no `Recording`, or one with values that cannot be, such as stamps that run backwards.
        DataError: nothing can be estimated, for example because no landmark was ever seen.
        ConfigError: settings that contradict each other or the recording.
        NumericalError: no finite optimum.
    """
    from threadpoolctl import threadpool_limits

    from evermap.slam.association.identify import identified
    from evermap.slam.check import odd
    from evermap.slam.session import prepare

    config = _or_default(config)
    recording = _valid(recording, config, prior_map)
    remarks = odd(recording, identities=not config.slam.unknown_ids)
    prior, noise = _beliefs(recording, config)
    if config.slam.unknown_ids:
        recording = identified(recording, prior, noise, prior_map=prior_map)
    prepared = prepare(recording, prior_map, remarks)
    warm_up()
    # small matrices: several threads would only wait for each other, and sum in another order on another machine
    with threadpool_limits(limits=1, user_api="blas"):
        slam = _estimator(prepared, prior, noise, recording, config)
        step_s, interrupted = _feed(slam, prepared, realtime=realtime, progress=progress)
        return _conclude(recording, prepared, slam, prior, step_s, interrupted=interrupted)


ROUNDS = 2
"""Times that a session is judged, the second time by the lifetimes that the first has learned."""


@dataclass(frozen=True, slots=True)
class Session:
    """What a session made of a map.

    Attributes:
        living: the map after it.
        found: False where the session could not be found in the map, which then stays as it was.
        recording: as it was used: repaired, with the map's class numbers, without deleted landmarks; rows of `slam`
            that name detections and frames are rows of it.
        slam: trajectory, landmarks and all else, in the map's frame.
        changes: what appeared, vanished, moved, was exchanged or returned since the session before.
        evidence: what was seen of every clique, frame by frame.
    """

    living: LivingMap
    found: bool
    recording: Recording
    slam: SlamResult
    changes: tuple[MapChange, ...]
    evidence: Evidence


def run_session(
    recording: Recording,
    living: LivingMap | None = None,
    config: Config | None = None,
    *,
    progress: Progress | None = None,
) -> Session:
    """One session of a living map: localise in it from an unknown pose, find what changed, extend it (MATH.md 5).

    Args:
        recording: the session; its truth is not looked at. It begins after the newest session of the map; one that is
            late is entered by `sessions.enter_session`.
        living: the map; None begins one, in the frame of the first pose.
        config: settings; None for the defaults.
        progress: told after every frame.

    Raises:
        InputError: no `Recording`.
        DataError: nothing can be estimated, or the session is earlier than the map.
        NumericalError: no finite optimum.
    """
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.session import check_in_order
    from evermap.valid import check_type

    config = _or_default(config)
    check_type(recording)
    living = LivingMap(clock=recording.clock) if living is None else living
    check_in_order(recording, living)
    return bring_in(solve_alone(recording, living, config, progress=progress), living, config)


@dataclass(frozen=True, slots=True)
class Alone:
    """A session solved by itself, in a frame of its own, before a map is asked.

    Attributes:
        visit: the recording as it is used, and what the estimator made of it.
        slam: the estimator, for what it knew at the time.
        prior: of the calibration states.
        step_s: seconds a frame.
        interrupted: True where it was stopped before its end.
    """

    visit: Visit
    slam: StreamingSlam
    prior: CalibrationPrior
    step_s: FloatArray
    interrupted: bool


def solve_alone(recording: Recording, living: LivingMap, config: Config, *, progress: Progress | None = None) -> Alone:
    """The first half of `run_session`: poses and landmarks of a session as one Gaussian.

    It is the same for all maps that agree on classes and deleted landmarks, whatever else they believe.
    """
    from threadpoolctl import threadpool_limits

    from evermap.maps.sessions.session import Visit, admitted
    from evermap.slam.check import odd
    from evermap.slam.cleaning import clean
    from evermap.slam.session import prepare

    recording = replace(recording, sensor=config.sensor.applied_to(recording.sensor))
    recording, _ = admitted(clean(recording), living)
    prior, noise = _beliefs(recording, config)
    prepared = prepare(recording, remarks=odd(recording))
    warm_up()
    with threadpool_limits(limits=1, user_api="blas"):
        slam = _estimator(prepared, prior, noise, recording, config.model_copy(update={"slam": _alone(config)}))
        step_s, interrupted = _feed(slam, prepared, realtime=False, progress=progress)
        return Alone(Visit(recording, prepared, slam.finish()), slam, prior, step_s, interrupted)


def bring_in(alone: Alone, living: LivingMap, config: Config) -> Session:
    """The second half of `run_session`: what a session that was solved alone makes of a map."""
    from threadpoolctl import threadpool_limits

    from evermap.maps.sessions import believe
    from evermap.maps.sessions import session as lifelong

    visit, slam = alone.visit, alone.slam
    _, living = lifelong.admitted(visit.recording, living)
    with threadpool_limits(limits=1, user_api="blas"):
        # over the map as it is believed to be by now, and solved again with the map as its prior
        aged = believe.aged(living, config.living, visit.start_s)
        expected = aged.p_here
        where = lifelong.laid(living, expected, visit, config.living)
        if where is None and len(living.places):
            return _lost(alone, living, "too few of its landmarks were seen standing to each other as it says")
        if where is not None:
            before = living
            living, where, visit = lifelong.refit(
                living, expected, where, visit, alone.prior, robust=config.slam.robust
            )
            if config.living.search == "joint" and not lifelong.fits(visit, alone.visit):
                return _lost(alone, before, "most sightings contradict it; the session is bent, or of another place")
        known: LivingMap | None = None
        for _ in range(ROUNDS):
            if known is not None:
                living = replace(living, lives=replace(known.lives, looks_s=living.lives.looks_s))
                aged = believe.aged(living, config.living, visit.start_s)
            entering = replace(living, sites=replace(living.sites, p_kept=aged.p_kept))
            # what was found goes into the map, then hits and misses into beliefs, and those into decisions
            entry = lifelong.entered(entering, aged.p_here, where, visit, config.living)
            looks, eye = lifelong.looks(entry, visit, config.living)
            now = lifelong.believed(entry, looks, visit, config.living)
            after, changes = lifelong.decided(entry.before, now, looks, visit, config.living, known)
            after = lifelong.learned(after, looks, replace(entry, living=now.living), eye, config.living)
            known = after
        frame = "first_pose" if where is None else "prior_map"
        names = visit.recording.landmark_names
        landmarks = replace(after.landmarks(p_least=0.5), frame=frame, names=names)
        changes = tuple(change.named(names) for change in changes)
        result = _result(
            visit, slam, alone.prior, alone.step_s, frame, landmarks=landmarks, interrupted=alone.interrupted
        )
    return Session(after, True, visit.recording, replace(result, changes=changes), changes, now.evidence)


def _or_default(config: Config | None) -> Config:
    from evermap.config import Config

    return config or Config()


def run_localization(
    recording: Recording,
    living: LivingMap,
    config: Config | None = None,
    *,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Localise in a living map that stays as it is: causal, from an unknown pose, at a fixed cost per frame.

    Args:
        recording: what a reader returned; its truth is not looked at.
        living: the map.
        config: settings; None for the defaults.
        realtime: process at the recording's pace.
        progress: told after every frame.

    Raises:
        DataError: the map is empty, or the robot's place in it could not be found.
    """
    from evermap.errors import DataError
    from evermap.maps.sessions.believe import predicted
    from evermap.maps.sessions.session import admitted
    from evermap.slam.check import odd
    from evermap.slam.localize_recording import localize

    config = _or_default(config)
    if not len(living.places):
        raise DataError("the map is empty", field="--map", hint="evermap slam RECORDING --map FILE, without --localize")
    recording = _valid(recording, config)
    remarks = odd(recording)
    recording, living = admitted(recording, living)
    p_site = predicted(living, config.living, float(recording.frames.stamp_s[0]))
    prior, noise = _beliefs(recording, config)
    warm_up()
    result = localize(
        recording,
        living.sighted_rows(p_site),
        prior,
        noise,
        joint_m2=living.covariance_m2,
        realtime=realtime,
        progress=progress,
    )
    return replace(result, warnings=(*remarks, *result.warnings))


def check_recording(recording: Recording, config: Config | None = None) -> Check:
    """What a recording holds, and what is odd about it: units, signs, clocks, identities, limits, gaps.

    `run_slam`, `run_session` and `run_localization` tell the same in the warnings of their results.

    Args:
        recording: what a reader returned; its truth is not looked at.
        config: settings; None for the defaults. Its section `sensor` may correct the sensor's limits.

    Raises:
        InputError: no `Recording`, or one with values that cannot be.
        DataError: nothing can be estimated from it.
    """
    from evermap.slam.check import Check

    config = _or_default(config)
    return Check.of(_valid(recording, config), identities=not config.slam.unknown_ids)


def warm_up() -> None:
    """Compile the kernels, or load them where that was done before; `run_slam` does it by itself.

    Worth calling ahead where the first frame must not wait: compiling takes half a minute, once on a machine.
    """
    from evermap.slam.warmup import warm_up

    warm_up()


def _valid(recording: Recording, config: Config, prior_map: Landmarks | None = None) -> Recording:
    """The recording with the sensor that the configuration states, if both are valid."""
    from evermap.valid import check_landmarks, validate

    validate(recording)
    if prior_map is not None:
        check_landmarks(prior_map, "prior_map")
    return replace(recording, sensor=config.sensor.applied_to(recording.sensor))


def _beliefs(recording: Recording, config: Config) -> tuple[CalibrationPrior, Noise]:
    """What is believed of sensors and noise before the first frame."""
    from evermap.slam.calibration import CalibrationPrior
    from evermap.slam.noise import START

    settings = config.slam
    prior = CalibrationPrior.from_settings(
        calibrated=settings.sensor_model == "calibrated", fix=settings.calibration.fix
    )
    sensor = recording.sensor
    nominal = [sensor.sigma_range_m, sensor.sigma_bearing_rad]
    detection = np.array(
        [default if given is None else given for given, default in zip(nominal, START.detection, strict=True)]
    )
    odometry = START.odometry * settings.odometry_noise_factor
    return prior, replace(START, detection=detection, odometry=odometry, outlier_log_odds=settings.outlier_log_odds)


def _method(prepared: Prepared, prior: CalibrationPrior, recording: Recording, config: Config) -> Method:
    """How landmarks that moved are explained, by name."""
    settings, n_landmarks = config.slam, len(prepared.landmark_id)
    if settings.method == "nohyp":
        from evermap.slam.method import Static

        return Static(n_landmarks)
    if settings.method == "joint":
        from evermap.slam.changes.joint import Joint
        from evermap.slam.changes.prior import ChangePrior

        changes = ChangePrior(
            p_moved=settings.changes.p_moved,
            move_sigma_m=settings.changes.move_sigma_m,
            p_rotated=settings.changes.p_rotated,
        )
        return Joint(n_landmarks, prior, prepared.given_map(), changes, robust=settings.robust)
    method: Method = plugins.load("evermap.methods", settings.method)(n_landmarks, settings, recording.sensor)
    return method


def _estimator(
    prepared: Prepared, prior: CalibrationPrior, noise: Noise, recording: Recording, config: Config
) -> StreamingSlam:
    from evermap.slam.streaming import StreamingSlam

    return StreamingSlam(
        prepared.problem,
        noise,
        prior,
        prior_map=prepared.prior_map,
        robust=config.slam.robust,
        estimate_noise=config.slam.estimate_noise,
        solver=config.slam.solver,
        method=_method(prepared, prior, recording, config),
    )


def _feed(
    slam: StreamingSlam, prepared: Prepared, *, realtime: bool, progress: Progress | None
) -> tuple[FloatArray, bool]:
    """Frame after frame through the estimator; returns seconds a frame and whether it was interrupted."""
    stamps = prepared.problem.stamp_s
    step_s = np.zeros(len(stamps))
    began = time.perf_counter()
    done = 0
    try:
        with watched() as watch:  # Ctrl-C waits for the end of a frame: the estimator is whole then
            for row, stamp in enumerate(stamps):
                if realtime:
                    watch.sleep((stamp - stamps[0]) - (time.perf_counter() - began))
                start = time.perf_counter()
                slam.step()
                step_s[row] = time.perf_counter() - start
                done = row + 1
                if progress is not None:
                    progress(float(stamp - stamps[0]), float(stamps[-1] - stamps[0]))
                watch.stop_if_asked()
    except KeyboardInterrupt:
        if done < 2:
            raise
        return step_s[:done], True
    return step_s, False


def _conclude(
    recording: Recording,
    prepared: Prepared,
    slam: StreamingSlam,
    prior: CalibrationPrior,
    step_s: FloatArray,
    *,
    interrupted: bool,
) -> SlamResult:
    """Smooth, and say what moved and what may have moved instead."""
    from evermap.maps.sessions.session import Visit
    from evermap.slam import session

    outcome = slam.finish()
    frame = "prior_map" if outcome.aligned else "first_pose"
    landmarks = session.landmarks(prepared, outcome, recording, frame)
    visit = Visit(recording, prepared, outcome)
    result = _result(visit, slam, prior, step_s, frame, landmarks=landmarks, interrupted=interrupted)
    warnings = list(result.warnings)
    if prepared.prior_map is not None and not outcome.aligned:
        warnings.append(
            "cannot localise in the prior map: too few of its landmarks were seen standing to each other as it says; "
            "the map is in the frame of the first pose"
        )
    return replace(
        result,
        warnings=(*warnings, *outcome.revision.warnings),
        changes=session.changes(prepared, outcome, outcome.revision.changes),
        alternatives=session.alternatives(prepared, outcome, recording, frame),
    )


def _result(
    visit: Visit,
    slam: StreamingSlam,
    prior: CalibrationPrior,
    step_s: FloatArray,
    frame: str,
    *,
    landmarks: Landmarks,
    interrupted: bool,
) -> SlamResult:
    """Bridge the blind stretches, count the misses, and put all of it into plain arrays."""
    from evermap.sensing.visibility import find_misses
    from evermap.slam import session
    from evermap.slam.check import far_off

    recording, prepared, outcome = visit.recording, visit.prepared, visit.outcome
    trajectory = session.trajectory(prepared, outcome, recording, frame)
    rows = np.flatnonzero(recording.frames.stamp_s <= trajectory.stamp_s[-1] + 1e-9).astype(np.int64)
    poses = trajectory.pose_world_robot[session.rows_at(trajectory, recording, rows)]
    misses = find_misses(rows, poses, recording.detections, landmarks, recording.frames.stamp_s, recording.sensor)
    parameters = session.parameters(outcome, prior)
    warnings = [*prepared.warnings, *far_off(parameters)]
    if interrupted:
        done_s, all_s = (float(np.ptp(s)) for s in (trajectory.stamp_s, recording.frames.stamp_s))
        warnings.append(f"interrupted after {done_s:.0f} of {all_s:.0f} s of the recording")
    return SlamResult(
        trajectory=trajectory,
        online=session.online(prepared, slam, recording, frame),
        landmarks=session.with_misses(landmarks, misses),
        parameters=parameters,
        innovations=session.innovations(prepared, slam, outcome, recording),
        misses=misses,
        step_s=step_s,
        dead_reckoning=session.dead_reckoning(prepared, trajectory),
        warnings=tuple(warnings),
        interrupted=interrupted,
    )


def _alone(config: Config) -> SlamConfig:
    """Settings of a session that is solved by itself: what moved is asked when it lies over the map."""
    return config.slam.model_copy(update={"method": "nohyp", "unknown_ids": False})


def _lost(alone: Alone, living: LivingMap, reason: str) -> Session:
    """The session cannot be found in the map: it stands by itself, and the map as it was."""
    from evermap.maps.living import Evidence
    from evermap.slam import session

    visit = alone.visit
    landmarks = session.landmarks(visit.prepared, visit.outcome, visit.recording, "first_pose")
    result = _result(
        visit, alone.slam, alone.prior, alone.step_s, "first_pose", landmarks=landmarks, interrupted=alone.interrupted
    )
    result = replace(result, warnings=(*result.warnings, f"cannot localise in the map: {reason}"))
    return Session(living, False, visit.recording, result, (), Evidence.empty())
