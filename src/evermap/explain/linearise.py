"""How the residuals of a solved session change with the state of a cause, by finite differences of its inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from evermap.errors import EvermapError
from evermap.estimate.sparse.system import exhaust
from evermap.explain.causes.suspect import Inputs, Suspect
from evermap.explain.evidence import DETECTIONS, ODOMETRY, AnySession, Optimum, Screen, SpatialSession, residuals_of
from evermap.geometry import se2, se3
from evermap.slam.calibration import DELAY
from evermap.slam.estimate import Solved
from evermap.slam.intake import place_map, prepare_alike
from evermap.slam.problem import Problem
from evermap.slam.smoother import Smoother
from evermap.slam.space.bridge import PathFrames
from evermap.slam.space.estimate import SpatialOptimum, converge
from evermap.slam.space.intake import SpatialIntake, drive_through, find_corners, lead_on, prepare_space
from evermap.slam.space.problem import PlacePrior, SpatialProblem, Swing
from evermap.slam.space.smoother import SpatialSmoother
from evermap.slam.space.solve import fit_to_map
from evermap.types import FloatArray, IntArray, Landmarks, SpatialOdometry, SpatialRecording, is_in_space

STEP, FINE_STEP = 0.02, 1e-4
"""Steps of a state, as shares of its standard deviation beforehand: one as long as noise, which says how far it is to a
better state, where what is rejected yet hides the way; and one at which residuals grow by far less than their noise, so
that those of outliers don't vanish with their weights: the slope at the solution itself. Rounding is smaller still."""

SEEN = ("reading", "sigma_given", "mount")
"""What detections in the plane depend on, beside the estimate."""
EDGE_S = 1e-3
"""Time by which frames may move beyond the ends of the odometry."""
FEW_STEPS = 6
"""Gauss-Newton steps of a first look at a discrete cause."""
STEPS_NEARBY = 10
"""Gauss-Newton steps to the optimum nearby under a continuous cause, at most."""


def hold_by_map(session: AnySession) -> AnySession:
    """Return a session in space at the optimum at which all landmarks of the map stand; others as they are.

    What moves explain is hidden: a map that was let go says nothing of a scale.
    """
    if isinstance(session, Solved):
        return session
    optimum = session.solved.optimum
    problem = optimum.last[0].problem
    if not len(problem.prior.place) or problem.prior.weight.min() > problem.settings.inlier:
        return session
    prior = replace(problem.prior, weight=np.ones_like(problem.prior.weight))
    held = converge(replace(problem, prior=prior), optimum.estimate, optimum.noise)
    return SpatialSession(session.intake, replace(session.solved, optimum=held))


def change_by(
    session: AnySession,
    screen: Screen,
    inputs: Inputs,
    suspect: Suspect,
    share: float = STEP,
    *,
    given: Inputs | None = None,
    state: float = 0.0,
) -> FloatArray | None:
    """Return (R,) by which residuals at the optimum change with the state of a cause; None if it changes what is used.

    Args:
        session: the solution of the inputs.
        screen: of its optimum.
        inputs: of which it is the solution.
        suspect: a continuous cause.
        share: length of the step, as a share of its standard deviation beforehand.
        given: inputs of which the cause was undone already, if it was: twice is not the sum for all causes.
        state: at which it was.
    """
    step = share * suspect.sigma
    moved = _residuals_under(session, screen, inputs, suspect, step, inputs if given is None else given, state)
    return None if moved is None else np.asarray((moved - screen.residual) / step)


def change_by_motion(session: AnySession, screen: Screen, inputs: Inputs, suspect: Suspect) -> FloatArray | None:
    """Return (R,) as `change_by`, of a cause of the odometry or of clocks, with the motions that were estimated.

    What was measured holds its own noise, and so would the change: it would go with the residuals where nothing is
    wrong (errors in variables). Estimated motions do not, as residuals are independent of the estimate. Stamps move
    both ways: beyond an instant another motion begins.

    Args:
        session: the solution of the inputs.
        screen: of its optimum.
        inputs: of which it is the solution.
        suspect: a continuous cause.
    """
    step = FINE_STEP * suspect.sigma
    as_estimated = _driven_as_estimated(session, inputs)
    later, earlier = (
        _residuals_under(session, screen, as_estimated, suspect, way, as_estimated, 0.0) for way in (step, -step)
    )
    return None if later is None or earlier is None else np.asarray((later - earlier) / (2.0 * step))


def _driven_as_estimated(session: AnySession, inputs: Inputs) -> Inputs:
    """Return inputs with the odometry that the motions of the solution would have given, at the stamps that it has."""
    recording: Any = inputs.recording
    driven = recording.odometry
    if driven is None:
        return inputs
    rows = np.concatenate([[0], np.arange(len(driven)), [len(driven) - 1]])
    driven = driven[rows]  # a little longer, so that frames at its ends may move
    driven = replace(driven, stamp_s=driven.stamp_s + EDGE_S * np.concatenate([[-1.0], np.zeros(len(rows) - 2), [1.0]]))
    if isinstance(session, Solved):
        outcome, prepared = session.outcome, session.prepared
        pose, knot_s = outcome.graph_estimate.pose, outcome.problem.stamp_s + prepared.start_s
        rate = se2.log(se2.between(pose[:-1], pose[1:])) / np.diff(knot_s)[:, None]
        at = driven.stamp_s - outcome.graph_estimate.states[DELAY]
        forward, lateral, turn = rate[np.clip(np.searchsorted(knot_s, at, side="right") - 1, 0, len(rate) - 1)].T
        driven = replace(driven, forward_mps=forward, lateral_mps=lateral, angular_radps=turn)
    else:
        optimum = session.solved.optimum
        problem = optimum.last[0].problem
        pose, knot_s = optimum.estimate.pose, inputs.recording.frames.stamp_s[session.intake.pose_frame]
        row = np.clip(np.searchsorted(knot_s, driven.stamp_s, side="right") - 1, 0, len(knot_s) - 2)
        part = (driven.stamp_s - knot_s[row]) / np.diff(knot_s)[row]  # beyond the ends it goes on as there
        twist = part[:, None] * se3.log(se3.between(pose[row], pose[row + 1]))
        at = se3.scaled(se3.compose(pose[row], se3.exp(twist)), float(np.exp(-problem.odometry_log)))
        driven = replace(driven, pose_world_robot=at)
    return replace(inputs, recording=replace(recording, odometry=driven))


def _residuals_under(
    session: AnySession, screen: Screen, inputs: Inputs, suspect: Suspect, step: float, given: Inputs, state: float
) -> FloatArray | None:
    """Return (R,) residuals at the optimum under a step of a cause; None if it changes what is used."""
    try:
        undone = suspect.undo(given, state + step)
        if isinstance(session, Solved):
            moved = _residuals_in_plane(session, screen.optimum, inputs, undone)
        else:
            moved = _residuals_in_space(session, screen.optimum, inputs, undone)
    except EvermapError:
        return None
    usable = moved is not None and len(moved) == len(screen.residual) and np.isfinite(moved).all()
    return moved if usable else None


def _residuals_in_plane(session: Solved, optimum: Optimum, inputs: Inputs, undone: Inputs) -> FloatArray | None:
    assert not is_in_space(undone.recording)
    problem, before = session.outcome.problem, session.prepared
    prepared = prepare_alike(before, session.recording, undone.recording, session.settings.odometry)
    if prepared is None or len(prepared.problem.stamp_s) != len(problem.stamp_s):
        return None
    other, mean = prepared.problem, problem.landmark_mean
    if before.prior_map is not None and undone.prior_map is not None and undone.prior_map is not inputs.prior_map:
        there, given = place_map(undone.prior_map, before.landmark_id), before.prior_map.given
        mean, count = mean.copy(), len(before.prior_map.mean)
        mean[:count] += np.where(given[:, None], there.mean - before.prior_map.mean, 0.0)
    moved: Problem = replace(
        problem, stamp_s=other.stamp_s, drive=other.drive, reading=other.reading, sigma_given=other.sigma_given,
        mount=other.mount, landmark_mean=mean,
    )  # fmt: skip
    smoother = Smoother(moved, session.outcome.noise.noise, robust=session.settings.robust)
    blocks = dict(enumerate(smoother.blocks(optimum.state.known)))  # which tie the same
    if moved.drive.is_alike(problem.drive) and np.array_equal(moved.stamp_s, problem.stamp_s):
        del blocks[ODOMETRY]
    if all(np.array_equal(getattr(moved, of), getattr(problem, of), equal_nan=True) for of in SEEN):
        del blocks[DETECTIONS]
    if mean is problem.landmark_mean:
        blocks = {kind: blocks[kind] for kind in (ODOMETRY, DETECTIONS) if kind in blocks}
    return residuals_of(optimum.graph, optimum.graph.relinearise_blocks(optimum.now, optimum.state, blocks))[0]


def _residuals_in_space(session: SpatialSession, optimum: Optimum, inputs: Inputs, undone: Inputs) -> FloatArray | None:
    solved = session.solved.optimum
    moved = _problem_of(session, inputs, undone)
    before = solved.last[0].problem.swing
    if moved is None or not np.array_equal(moved.swing.steps, before.steps):
        return None
    # what a cause changes are measurements, not what they tie; noise stays, since the axes of an arm turn as they like
    # where two are as long; and no weight is 0 with tails that never let go
    fixed = replace(moved, swing=before)
    smoother = SpatialSmoother(fixed, solved.estimate.pose, optimum.graph.structure)
    now = exhaust(smoother.graph(solved.noise, heavy=True).linearised(solved.estimate))
    return residuals_of(optimum.graph, now)[0]


def _problem_of(session: SpatialSession, inputs: Inputs, undone: Inputs) -> SpatialProblem | None:
    """Return the problem of a session with other inputs; None if other detections or poses would be in it."""
    solved, before = session.solved.optimum, session.intake
    problem = solved.last[0].problem
    assert is_in_space(undone.recording)
    prior = problem.prior
    if undone.prior_map is not inputs.prior_map and undone.prior_map is not None:
        prior = _prior_from(prior, undone.prior_map, before.landmark_id[session.solved.identity])
    one, other = inputs.recording, undone.recording
    lens = [[(each.intrinsics, each.distortion, each.distortion_model) for each in of.sensors] for of in (one, other)]
    drives_alike = other.odometry is one.odometry and other.frames is one.frames
    if other.detections is one.detections and lens[0] == lens[1]:  # but for mounts and motions all is as it was
        problem = replace(problem, prior=prior, mount=np.array([each.mount_robot_sensor for each in other.sensors]))
        if drives_alike:
            return problem
        if other.odometry is not None:
            return _with_motions(problem, other, other.odometry, before.frames)
    elif other.detections is one.detections and drives_alike and not problem.range_error.any():
        used, corner, root = find_corners(undone.recording, problem.settings)
        kept = np.isin(used, before.used) if before.rests is not None else np.ones(len(used), dtype=np.bool_)
        if not np.array_equal(used[kept], before.used):
            return None
        mount = np.array([each.mount_robot_sensor for each in other.sensors])
        return replace(problem, prior=prior, mount=mount, corner=corner[kept], corner_root=root[kept])
    intake = prepare_space(
        undone.recording, problem.settings, robust=problem.robust, estimate_noise=problem.estimate_noise, coarse=True
    )  # of tags in an image the residuals are those of the corners
    intake = fit_to_map(intake, undone.prior_map)
    if before.rests is not None:  # what was seen of bodies as they moved was left out
        kept = np.isin(intake.used, before.used)
        intake = replace(intake, problem=intake.problem.seeing(kept), used=intake.used[kept])
    if not (np.array_equal(intake.used, before.used) and len(intake.pose_frame) == len(before.pose_frame)):
        return None
    found = _with_measurements(problem, intake)
    longer = np.exp((undone.stretched - inputs.stretched)[before.used] / 3.0)
    found = found.with_sigma_position(problem.sigma_position_m)  # as learned, where none is stated
    root = np.where((longer != 1.0)[:, None, None], problem.measured_root / longer[:, None, None], found.measured_root)
    return replace(found, measured_root=root, prior=prior)  # noise goes with what is stretched, stated or usual


def cost_nearby(session: AnySession) -> float:
    """Return the cost of a session in space after few steps with tails that never let go [nats]; nan in the plane."""
    if isinstance(session, Solved):
        return np.nan
    solved = session.solved.optimum
    smoother = solved.last[0]
    return smoother.optimum(solved.estimate, solved.noise, heavy=True, iterations=FEW_STEPS)[1].cost


def gain_by(session: AnySession, before: float, inputs: Inputs, suspect: Suspect) -> float:
    """Return by how much the cost of a session in space falls without a discrete cause, near its values [nats].

    At the same noise, by few steps, and by fewer where these will not do: a first look, no evidence. It is -inf where
    that can't be asked.

    Args:
        session: the solution of the inputs.
        before: its `cost_nearby`.
        inputs: of which it is the solution.
        suspect: a discrete cause.
    """
    if isinstance(session, Solved):
        return -np.inf
    solved = session.solved.optimum
    try:
        moved = _problem_of(session, inputs, suspect.undo(inputs, 0.0))
        if moved is None:
            return -np.inf
        fitted = solved.last[0]
        smoother = SpatialSmoother(moved, solved.estimate.pose, fitted.structure)
        _, now = smoother.optimum(solved.estimate, solved.noise, heavy=True, iterations=FEW_STEPS, wanted=before)
    except EvermapError:
        return -np.inf
    return float(before - now.cost)


def solve_nearby(session: AnySession, inputs: Inputs, undone: Inputs) -> SpatialSession | None:
    """Return a session in space with other inputs, at the same noise and near its values; None if that can't be asked.

    Args:
        session: the solution of the inputs.
        inputs: of which it is the solution.
        undone: other inputs of the same detections and poses.
    """
    if isinstance(session, Solved):
        return None
    solved = session.solved.optimum
    try:
        moved = _problem_of(session, inputs, undone)
        if moved is None:
            return None
        fitted = solved.last[0]
        smoother = SpatialSmoother(moved, solved.estimate.pose, fitted.structure)
        estimate, now = smoother.optimum(solved.estimate, solved.noise, heavy=False, iterations=STEPS_NEARBY)
    except EvermapError:
        return None
    optimum = SpatialOptimum(estimate, solved.noise, smoother, now)
    return SpatialSession(session.intake, replace(session.solved, optimum=optimum))


def _with_motions(
    problem: SpatialProblem, recording: SpatialRecording, driven: SpatialOdometry, frames: PathFrames
) -> SpatialProblem | None:
    """Return a problem with the odometry, and at the instants, of a recording; None if other frames have poses."""
    stamp_s = recording.frames.stamp_s
    during = (stamp_s >= driven.stamp_s[0]) & (stamp_s <= driven.stamp_s[-1])
    if not np.array_equal(np.flatnonzero(during), frames.row):
        return None
    path_s, at_s, longer = stamp_s[frames.row], stamp_s[frames.pose_frame], float(np.exp(problem.odometry_log))
    through = drive_through(recording, path_s)
    increment = se3.between(through[frames.posed[:-1]], through[frames.posed[1:]])
    path = lead_on(recording, at_s[0], problem.settings.delay_sigma_s)
    return replace(
        problem, stamp_s=at_s - at_s[0], increment=se3.scaled(increment, longer),
        swing=Swing.between(frames.posed, frames.lasted_s, through).scaled(longer),
        path=None if path is None else path._replace(pose=se3.scaled(path.pose, longer)),
    )  # fmt: skip


def _with_measurements(problem: SpatialProblem, intake: SpatialIntake) -> SpatialProblem:
    """Return a problem with the measurements of another intake, in the metre that it was given since."""
    other = intake.problem
    shorter, longer = float(np.exp(-problem.ranges_log)), float(np.exp(problem.odometry_log))
    path = None if other.path is None else other.path._replace(pose=se3.scaled(other.path.pose, longer))
    found = replace(
        problem, stamp_s=other.stamp_s, increment=se3.scaled(other.increment, longer),
        swing=other.swing.scaled(longer),
        measured=se3.scaled(other.measured, shorter), measured_root=other.measured_root / shorter,
        corner=other.corner, corner_root=other.corner_root, half_m=other.half_m * shorter, mount=other.mount, path=path,
        range_error=np.zeros_like(problem.range_error),
    )  # fmt: skip
    return found.with_range_error(problem.range_error) if problem.range_error.any() else found


def _prior_from(prior: PlacePrior, given: Landmarks, landmark_id: IntArray) -> PlacePrior:
    """Return a prior with positions as another map has them; `landmark_id` (P,) are those of the places."""
    row = np.searchsorted(given.landmark_id, landmark_id[prior.place])
    pose = prior.pose.copy()
    pose[:, :3] = given.position_m[row]
    return replace(prior, pose=pose)
