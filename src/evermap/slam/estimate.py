"""A recording through the estimator, as a whole or frame after frame, and what the estimator makes of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from evermap import plugins
from evermap.config import SlamConfig
from evermap.interrupts import watched
from evermap.slam.batch import Batch, Outcome, SolvedPart
from evermap.slam.calibration import DELAY, CalibrationPrior
from evermap.slam.changes.joint import Joint, may_search
from evermap.slam.intake import Prepared, beliefs, prepare, prepare_alike
from evermap.slam.method import Method, Static
from evermap.slam.mistakes import Finding
from evermap.slam.problem import Estimate
from evermap.slam.streaming import StreamingSlam
from evermap.slam.warmup import warm_up
from evermap.types import FloatArray, Landmarks, Progress, Recording, Sensor


@dataclass(frozen=True, slots=True)
class Solved:
    """The solution of one recording, in its own frame or in that of a prior map.

    Attributes:
        recording: as it was used.
        prepared: input of the estimator.
        outcome: smoothed values with their covariances.
        slam: the stream, for what it knew at the time of each frame; None where there was none.
        prior: of the calibration states.
        step_s: (F,) seconds per processed frame; of frames that were solved together, the share of each.
        interrupted: True where it was stopped before its end.
        settings: that it was solved with.
        findings: what was read wrongly, for the verdict.
    """

    recording: Recording
    prepared: Prepared
    outcome: Outcome
    slam: StreamingSlam | None
    prior: CalibrationPrior
    step_s: FloatArray
    interrupted: bool
    settings: SlamConfig
    findings: tuple[Finding, ...] = ()

    @property
    def start_s(self) -> float:
        """Stamp of the first frame that has a pose."""
        return float(self.recording.frames.stamp_s[self.prepared.pose_frame[0]])

    @property
    def end_s(self) -> float:
        """Stamp of the last frame that was processed."""
        return self.prepared.start_s + float(self.outcome.problem.stamp_s[-1])

    def with_earlier_frames(self, recording: Recording, by_s: float) -> Solved | None:
        """Return the same solution at frames that were so much earlier, in the same `recording` but for their stamps.

        Only the sum of a frame's stamp and the odometry's delay says which motions are before a frame. So poses, places
        and their covariances stay as they are, but for what the delay's prior pulled. None where it is not that simple:
        frames would come before or after the odometry, or are tied to what has stamps of its own.
        """
        outcome, settings = self.outcome, self.settings.odometry
        prepared = prepare_alike(self.prepared, self.recording, recording, settings)
        if prepared is None or recording.measurements or self.slam is not None:
            return None
        smoother = outcome.smoother
        earlier = replace(smoother.problem, stamp_s=prepared.problem.stamp_s[: len(smoother.problem.stamp_s)])

        def delay(estimate: Estimate) -> Estimate:
            states = estimate.states.copy()
            states[DELAY] += by_s
            return replace(estimate, states=states)

        outcome = replace(
            outcome,
            estimate=delay(outcome.estimate),
            smoother=smoother.under(smoother.noise, heavy=smoother.heavy, problem=earlier),
            graph_estimate=delay(outcome.graph_estimate),
            revision=outcome.revision.earlier(by_s),
        )
        return replace(self, recording=recording, prepared=prepared, outcome=outcome)


def solve(
    recording: Recording,
    settings: SlamConfig,
    *,
    prior_map: Landmarks | None = None,
    remarks: tuple[str, ...] = (),
    realtime: bool = False,
    progress: Progress | None = None,
) -> Solved:
    """Estimate poses, landmarks, calibration and noise of a recording: all together, from its odometry.

    Frame after frame first where that start is bad, at the recording's pace, or where `slam.online` asks what was known
    at the time.
    As `pipeline.run_slam`, of a cleaned recording with known identities; `remarks` on it are the first warnings.

    Raises:
        DataError: fewer than two frames with a landmark of known identity.
        NumericalError: no finite optimum.
    """
    prior, noise = beliefs(recording.sensor, settings)
    prepared = prepare(recording, prior_map, remarks, settings.odometry)
    in_map = prior_map is not None
    warm_up(search=settings.method == "joint" and may_search(len(prepared.problem.stamp_s), in_map=in_map))
    method = _method(prepared, prior, recording.sensor, settings)
    problem = prepared.problem
    batch, began = Batch(prior, noise, method, settings), time.perf_counter()
    causal = realtime or settings.online or not isinstance(method, Static | Joint)
    if not causal and batch.is_driven(problem):
        part, interrupted = _furthest(batch.parts(problem), problem.stamp_s, progress)
        if interrupted or part.fits:  # else what the stream finds is a better start
            outcome = batch.solved(part, prepared.prior_map, prepared.framed)
            done = len(outcome.problem.stamp_s)
            step_s = np.full(done, (time.perf_counter() - began) / done)  # solved together, each has its share
            return Solved(recording, prepared, outcome, None, prior, step_s, interrupted, settings)
    slam = StreamingSlam(
        problem, noise, prior,
        prior_map=prepared.prior_map, framed=prepared.framed, settings=settings, method=method, paced=causal,
    )  # fmt: skip
    step_s, interrupted = fed(problem.stamp_s, lambda _: slam.step(), least=2, realtime=realtime, progress=progress)
    return Solved(recording, prepared, slam.finish(), slam, prior, step_s, interrupted, settings)


def _furthest(parts: Iterator[SolvedPart], stamp_s: FloatArray, progress: Progress | None) -> tuple[SolvedPart, bool]:
    """Return the last part of a recording with frames at (F,) stamps; after an interrupt the last that was done."""
    part, whole_s = None, float(stamp_s[-1] - stamp_s[0])
    try:
        with watched() as watch:
            if progress is not None:
                progress(0.0, whole_s)
            for part in parts:
                if progress is not None:
                    progress(float(part.problem.stamp_s[-1] - stamp_s[0]), whole_s)
                watch.stop_if_asked()
    except KeyboardInterrupt:
        if part is None:
            raise
        return part, True
    assert part is not None
    return part, False


def fed(
    stamp_s: FloatArray,
    step: Callable[[int], None],
    *,
    least: int = 1,
    realtime: bool = False,
    progress: Progress | None = None,
) -> tuple[FloatArray, bool]:
    """Process frame after frame, at the recording's pace if wanted, until the end or an interrupt.

    `step` processes the frame of a row. An interrupt before `least` of the (F,) frames are done is raised.

    Returns:
        (F',) seconds per processed frame, and whether it was interrupted.
    """
    step_s = np.zeros(len(stamp_s))
    began = time.perf_counter()
    done = 0
    interrupted = False
    try:
        with watched() as watch:  # Ctrl-C waits for the end of a frame: the estimator is whole then
            for row, stamp in enumerate(stamp_s):
                if realtime:
                    watch.sleep((stamp - stamp_s[0]) - (time.perf_counter() - began))
                start = time.perf_counter()
                step(row)
                step_s[row] = time.perf_counter() - start
                done = row + 1
                if progress is not None:
                    progress(float(stamp - stamp_s[0]), float(stamp_s[-1] - stamp_s[0]))
                watch.stop_if_asked()
    except KeyboardInterrupt:
        if done < least:
            raise
        interrupted = True  # also in the last frame: a command that was asked to end must end
    return step_s[:done], interrupted


def _method(prepared: Prepared, prior: CalibrationPrior, sensor: Sensor, settings: SlamConfig) -> Method:
    """Return what explains landmarks that moved, by its name."""
    n_landmarks = len(prepared.landmark_id)
    if settings.method == "nohyp":
        return Static(n_landmarks)
    if settings.method == "joint":
        return Joint(n_landmarks, prior, prepared.given_map(), settings)
    method: Method = plugins.load("evermap.methods", settings.method)(n_landmarks, settings, sensor)
    return method
