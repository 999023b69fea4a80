"""From a recording to a trajectory and a map: the main job, told in the order in which it happens."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from evermap.types import FloatArray, Landmarks, Recording, SlamResult

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.slam.calibration import CalibrationPrior
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
        DataError: nothing can be estimated, for example because no landmark was ever seen.
        ConfigError: settings that contradict each other or the recording.
        NumericalError: no finite optimum.
    """
    from threadpoolctl import threadpool_limits

    from evermap.config import Config
    from evermap.slam.association.identify import identified
    from evermap.slam.session import prepare

    config = config or Config()
    recording = replace(recording, sensor=config.sensor.applied_to(recording.sensor))
    prior, noise = _beliefs(recording, config)
    if config.slam.unknown_ids:
        recording = identified(recording, prior, noise, prior_map=prior_map)
    prepared = prepare(recording, prior_map)
    warm_up()
    # small matrices: several threads would only wait for each other, and sum in another order on another machine
    with threadpool_limits(limits=1, user_api="blas"):
        slam = _estimator(prepared, prior, noise, recording, config)
        step_s, interrupted = _feed(slam, prepared, realtime=realtime, progress=progress)
        return _conclude(recording, prepared, slam, prior, step_s, interrupted=interrupted)


def warm_up() -> None:
    """Compile the kernels, or load them where that was done before; `run_slam` does it by itself.

    Worth calling ahead where the first frame must not wait: compiling takes half a minute, once on a machine.
    """
    from evermap.slam.warmup import warm_up

    warm_up()


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
    from evermap.slam.modes.alternation import ModeModel
    from evermap.slam.modes.multi_hypothesis import MultiHypothesis

    model = ModeModel.from_settings(settings.method, settings.modes, recording.sensor, robust=settings.robust)
    return MultiHypothesis(n_landmarks, model, seed=settings.seed)


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
        for row, stamp in enumerate(stamps):
            if realtime:
                time.sleep(max(0.0, (stamp - stamps[0]) - (time.perf_counter() - began)))
            start = time.perf_counter()
            slam.step()
            step_s[row] = time.perf_counter() - start
            done = row + 1
            if progress is not None:
                progress(float(stamp - stamps[0]), float(stamps[-1] - stamps[0]))
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
    """Smooth, bridge the blind stretches, count the misses, and put all of it into plain arrays."""
    from evermap.sensing.visibility import find_misses
    from evermap.slam import session

    outcome = slam.finish()
    frame = "prior_map" if outcome.aligned else "first_pose"
    trajectory = session.trajectory(prepared, outcome, recording, frame)
    landmarks = session.landmarks(prepared, outcome, recording, frame)
    rows = np.flatnonzero(recording.frames.stamp_s <= trajectory.stamp_s[-1] + 1e-9).astype(np.int64)
    poses = trajectory.pose_world_robot[session.rows_at(trajectory, recording, rows)]
    misses = find_misses(rows, poses, recording.detections, landmarks, recording.frames.stamp_s, recording.sensor)
    landmarks = session.with_misses(landmarks, misses)
    warnings = list(prepared.warnings)
    if prepared.prior_map is not None and not outcome.aligned:
        warnings.append(
            "cannot localise in the prior map: too few of its landmarks were seen standing to each other as it says; "
            "the map is in the frame of the first pose"
        )
    warnings.extend(outcome.revision.warnings)
    if interrupted:
        done_s, all_s = (float(np.ptp(s)) for s in (trajectory.stamp_s, recording.frames.stamp_s))
        warnings.append(f"interrupted after {done_s:.0f} of {all_s:.0f} s of the recording")
    return SlamResult(
        trajectory=trajectory,
        online=session.online(prepared, slam, recording, frame),
        landmarks=landmarks,
        parameters=session.parameters(outcome, prior),
        innovations=session.innovations(prepared, slam, outcome, recording),
        misses=misses,
        step_s=step_s,
        dead_reckoning=session.dead_reckoning(prepared, trajectory),
        warnings=tuple(warnings),
        interrupted=interrupted,
        changes=session.changes(prepared, outcome, outcome.revision.changes),
        alternatives=session.alternatives(prepared, outcome, recording, frame),
    )
