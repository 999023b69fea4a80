"""How the residuals of a solved session change with the state of a cause, by finite differences of its inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.errors import EvermapError
from evermap.estimate.sparse.system import exhausted
from evermap.explain.causes import Inputs, Suspect
from evermap.explain.evidence import AnySession, Optimum, Screen, SpatialSession, residuals_of
from evermap.geometry import se3
from evermap.slam.estimate import Solved
from evermap.slam.intake import prepare
from evermap.slam.problem import Problem
from evermap.slam.smoother import Smoother
from evermap.slam.space.estimate import SpatialOptimum, converged
from evermap.slam.space.intake import SpatialIntake, prepare_space
from evermap.slam.space.problem import PlacePrior, SpatialProblem
from evermap.slam.space.smoother import SpatialSmoother
from evermap.slam.space.solve import fit_to_map
from evermap.types import FloatArray, IntArray, Landmarks, is_in_space

STEP, FINE_STEP = 0.02, 1e-4
"""Steps of a state, as shares of its standard deviation beforehand: one as long as noise, which says how far it is to a
better state, where what is rejected yet hides the way; and one at which residuals grow by far less than their noise, so
that those of outliers don't vanish with their weights: the slope at the solution itself. Rounding is smaller still."""

FEW_STEPS = 6
"""Gauss-Newton steps of a first look at a discrete cause."""
STEPS_NEARBY = 10
"""Gauss-Newton steps to the optimum nearby under a continuous cause, at most."""


def held_by_map(session: AnySession) -> AnySession:
    """Return a session in space at the optimum at which all landmarks of the map stand; others as they are.

    What moves explain is hidden: a map that was let go says nothing of a scale.
    """
    if isinstance(session, Solved):
        return session
    optimum = session.solved.optimum
    problem = (optimum.fitted or (optimum.smoother, optimum.now))[0].problem
    if not len(problem.prior.place) or problem.prior.weight.min() > problem.settings.inlier:
        return session
    prior = replace(problem.prior, weight=np.ones_like(problem.prior.weight))
    held = converged(replace(problem, prior=prior), optimum.estimate, optimum.noise)
    return SpatialSession(session.intake, replace(session.solved, optimum=held))


def change_by(
    session: AnySession, screen: Screen, inputs: Inputs, suspect: Suspect, share: float = STEP
) -> FloatArray | None:
    """Return (R,) by which residuals at the optimum change with the state of a cause; None if it changes what is used.

    Args:
        session: the solution of the inputs.
        screen: of its optimum.
        inputs: of which it is the solution.
        suspect: a continuous cause.
        share: length of the step, as a share of its standard deviation beforehand.
    """
    step = share * suspect.sigma
    try:
        undone = suspect.undo(inputs, step)
        if isinstance(session, Solved):
            moved = _residuals_in_plane(session, screen.optimum, inputs, undone)
        else:
            moved = _residuals_in_space(session, screen.optimum, inputs, undone)
    except EvermapError:
        return None
    if moved is None or len(moved) != len(screen.residual) or not np.isfinite(moved).all():
        return None
    return np.asarray((moved - screen.residual) / step)


def _residuals_in_plane(session: Solved, optimum: Optimum, inputs: Inputs, undone: Inputs) -> FloatArray | None:
    assert not is_in_space(undone.recording)
    prepared = prepare(undone.recording, undone.prior_map, (), session.settings.odometry)
    problem, other, before = session.outcome.problem, prepared.problem, session.prepared
    if not (np.array_equal(prepared.used, before.used) and np.array_equal(prepared.pose_frame, before.pose_frame)):
        return None
    if len(other.stamp_s) != len(problem.stamp_s):
        return None
    mean = problem.landmark_mean.copy()
    if prepared.prior_map is not None and before.prior_map is not None and undone.prior_map is not inputs.prior_map:
        count = len(before.prior_map.mean)
        mean[:count] += np.where(before.prior_map.given[:, None], prepared.prior_map.mean - before.prior_map.mean, 0.0)
    moved: Problem = replace(
        problem, stamp_s=other.stamp_s, drive=other.drive, reading=other.reading, sigma_given=other.sigma_given,
        mount=other.mount, landmark_mean=mean,
    )  # fmt: skip
    smoother = Smoother(moved, session.outcome.noise.noise, robust=session.settings.robust)
    return residuals_of(optimum.graph, smoother.linearised(optimum.state))[1]


def _residuals_in_space(session: SpatialSession, optimum: Optimum, inputs: Inputs, undone: Inputs) -> FloatArray | None:
    solved = session.solved.optimum
    moved = _problem_of(session, inputs, undone)
    if moved is None:
        return None
    smoother = SpatialSmoother(moved, solved.estimate.pose)
    now = exhausted(smoother.graph(solved.noise, heavy=False).linearised(solved.estimate))
    if not np.array_equal(smoother.structure.system.tree.value_first, optimum.graph.structure.system.tree.value_first):
        return None
    return residuals_of(optimum.graph, now)[1]


def _problem_of(session: SpatialSession, inputs: Inputs, undone: Inputs) -> SpatialProblem | None:
    """Return the problem of a session with other inputs; None if other detections or poses would be in it."""
    solved, before = session.solved.optimum, session.intake
    problem = (solved.fitted or (solved.smoother, solved.now))[0].problem
    assert is_in_space(undone.recording)
    prior = problem.prior
    if undone.prior_map is not inputs.prior_map and undone.prior_map is not None:
        prior = _prior_from(prior, undone.prior_map, before.landmark_id[session.solved.identity])
    one, other = inputs.recording, undone.recording
    if other.detections is one.detections and other.odometry is one.odometry and other.frames is one.frames:
        lens = [
            [(each.intrinsics, each.distortion, each.distortion_model) for each in of.sensors] for of in (one, other)
        ]
        if lens[0] == lens[1]:  # but for mounts all is as it was
            return replace(problem, prior=prior, mount=np.array([each.mount_robot_sensor for each in other.sensors]))
    intake = prepare_space(
        undone.recording, problem.settings, robust=problem.robust, estimate_noise=problem.estimate_noise, coarse=True
    )  # of tags in an image the residuals are those of the corners
    intake = fit_to_map(intake, undone.prior_map)
    if before.rests is not None:  # what was seen of bodies as they moved was left out
        kept = np.isin(intake.used, before.used)
        intake = replace(intake, problem=intake.problem.selected(kept), used=intake.used[kept])
    if not (np.array_equal(intake.used, before.used) and len(intake.pose_frame) == len(before.pose_frame)):
        return None
    return replace(_with_measurements(problem, intake), prior=prior)


def cost_nearby(session: AnySession) -> float:
    """Return the cost of a session in space after few steps with tails that never let go [nats]; nan in the plane."""
    if isinstance(session, Solved):
        return np.nan
    solved = session.solved.optimum
    smoother = (solved.fitted or (solved.smoother, solved.now))[0]
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
        smoother = SpatialSmoother(moved, solved.estimate.pose)
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
        smoother = SpatialSmoother(moved, solved.estimate.pose)
        estimate, now = smoother.optimum(solved.estimate, solved.noise, heavy=False, iterations=STEPS_NEARBY)
    except EvermapError:
        return None
    optimum = SpatialOptimum(estimate, solved.noise, smoother, now)
    return SpatialSession(session.intake, replace(session.solved, optimum=optimum))


def _with_measurements(problem: SpatialProblem, intake: SpatialIntake) -> SpatialProblem:
    """Return a problem with the measurements of another intake, in the metre that it was given since."""
    other = intake.problem
    shorter, longer = float(np.exp(-problem.ranges_log)), float(np.exp(problem.odometry_log))
    path = None if other.path is None else other.path._replace(pose=se3.scaled(other.path.pose, longer))
    found = replace(
        problem, stamp_s=other.stamp_s, increment=se3.scaled(other.increment, longer),
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
