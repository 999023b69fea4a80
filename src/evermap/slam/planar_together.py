"""Joint solution of several simultaneous recordings in the plane.

Beside what robots in plane and space have in common (`slam.together`), these see each other: the instants of mutual
sightings become poses (`slam.encounters`). The calibration states that are needed are averaged, and the metre that one
robot alone cannot tell from its odometer is the mean of what all of them say (`CalibrationPrior.metre`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from evermap.align.acceptance import MOST_JOINT
from evermap.align.candidates import Matches
from evermap.estimate.gauss_newton import Minimum, Steps
from evermap.estimate.noise import restricted_level
from evermap.estimate.tie import find_nearest
from evermap.geometry import se2
from evermap.slam.batch import (
    ALIGNED_INFORMATION,
    FINAL_GAIN,
    FINAL_ROUNDS,
    FINAL_TOLERANCE,
    NEAR_NOISE,
    NOISE_CONVERGED,
    STEPS_A_ROUND,
    Outcome,
    divided,
    sight_at,
)
from evermap.slam.bridge import bridge_poses
from evermap.slam.calibration import SLOPE, needed
from evermap.slam.encounters import Encounters, PlanarTogether
from evermap.slam.estimate import Solved
from evermap.slam.intake import beliefs
from evermap.slam.kernels import N_STATES
from evermap.slam.noise import Extrapolation, NoiseFit, refine_noise
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.result import online as told_online
from evermap.slam.smoother import Smoother
from evermap.slam.together import SharedPoints, align_frames, settle, share_places
from evermap.types import FloatArray, IntArray, Trajectory

ONE_INSTANT_S = 1e-3
"""Instants this close are the same: a robot moves a millimetre in between."""
MOST_TIES = 200
"""Maximum mutual sightings used to align the frames of two robots."""
NEEDED = "common landmark ids or mutual sightings, and one clock"
"""What ties robots in the plane."""


def solve_together(alone: Mapping[int, Solved]) -> tuple[list[Solved], list[Trajectory]]:
    """Return robots solved together, and what each knew at the time, in the frame of the first one's first pose.

    Args:
        alone: each by itself, by the number by which others call it; landmarks with the same id are one, unless one
            of the robots saw it move.

    Raises:
        DataError: nothing ties one of them to the others.
        NumericalError: no finite optimum.
    """
    members = list(alone.values())
    met, stamps, remarks = _find_sightings(np.array(list(alone)), members)
    own = [_extend(member, stamp_s) for member, stamp_s in zip(members, stamps, strict=True)]
    motion = _place(members, own, met)
    joint, estimate = _lay_together(members, own, met, motion)
    joint, estimate, _ = _learn_levels(members, joint, estimate, heavy=True)
    joint, estimate, p_needed = _keep_needed(joint, estimate)
    joint, estimate, fits = _learn_levels(members, joint, estimate)
    joint, estimate = _ahead(members[0], joint, estimate)
    estimate, marginals = joint.solved(estimate, Steps(tolerance=FINAL_TOLERANCE, settled=FINAL_GAIN))
    outcomes = _divide(members, joint, estimate, marginals, p_needed, fits)
    solved, online = [], []
    frames = ["first_pose", *["first_robot"] * (len(members) - 1)]
    for one, outcome, by, said, frame in zip(members, outcomes, motion, remarks, frames, strict=True):
        turned = one.outcome.scale / outcome.scale * se2.rotation(by[2])
        changes = outcome.revision.changes
        moved = tuple(replace(change, displacement_m=tuple(turned @ change.displacement_m)) for change in changes)
        revision = replace(outcome.revision, changes=moved)
        prepared = replace(one.prepared, warnings=(*one.prepared.warnings, *said))
        solved.append(replace(one, prepared=prepared, outcome=replace(outcome, revision=revision)))
        told = told_online(one, frame)
        online.append(replace(told, pose_world_robot=se2.compose(by, told.pose_world_robot)))
    return solved, online


def _find_sightings(
    number: IntArray, members: Sequence[Solved]
) -> tuple[Encounters, list[FloatArray], list[tuple[str, ...]]]:
    """Encounters of robots while both have poses; instants of the poses of each, those of the sightings included."""
    start_s = np.array([member.prepared.start_s for member in members])
    stamps = [member.outcome.problem.stamp_s for member in members]
    spans = np.array([[own[0], own[-1]] for own in stamps]) + start_s[:, None]
    pairs, instants, readings = [], [], []
    remarks: list[tuple[str, ...]] = []
    for r, member in enumerate(members):
        seen = member.recording.robot_sightings
        remarks.append(())
        if seen is None:
            continue
        other = np.argmax(seen.robot_id[:, None] == number, axis=1)
        good = (number[other] == seen.robot_id) & (other != r)
        for robot in (np.full(len(other), r), other):
            good &= (seen.stamp_s >= spans[robot, 0]) & (seen.stamp_s <= spans[robot, 1])
        if not good.all():
            why = "not of these robots, or not while both saw landmarks"
            remarks[r] = (f"{np.count_nonzero(~good)} sightings of robots not used: {why}",)
        pairs.append(np.column_stack([np.full(len(other), r), other])[good])
        instants.append(seen.stamp_s[good])
        readings.append(np.column_stack([seen.range_m, seen.bearing_rad])[good])
    pair = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    stamp_s, reading = np.concatenate([np.zeros(0), *instants]), np.concatenate([np.zeros((0, 2)), *readings])
    merged = [
        _with_instants(own, np.sort(stamp_s[(pair == r).any(axis=1)]) - start_s[r]) for r, own in enumerate(stamps)
    ]
    first = np.cumsum([0, *(len(own) for own in merged)])
    row = np.zeros_like(pair)
    for r, own in enumerate(merged):
        some = pair == r
        row[some] = first[r] + find_nearest(own, np.broadcast_to(stamp_s[:, None], pair.shape)[some] - start_s[r])
    return Encounters(row[:, 0], row[:, 1], pair[:, 0], reading), merged, remarks


def _with_instants(own_s: FloatArray, new_s: FloatArray) -> FloatArray:
    """Return instants (N,), and the other, sorted ones that are not among them."""
    new_s = new_s[np.abs(own_s[find_nearest(own_s, new_s)] - new_s) > ONE_INSTANT_S]
    return np.sort(np.concatenate([own_s, new_s[np.diff(new_s, prepend=-np.inf) > ONE_INSTANT_S]]))


def _extend(member: Solved, stamp_s: FloatArray) -> tuple[Problem, Estimate]:
    """A robot's problem with poses at more instants, without priors of places, and where it puts everything [m]."""
    outcome, problem = member.outcome, member.outcome.problem
    graph, spread = outcome.graph_estimate, outcome.graph_marginals
    pose, _ = bridge_poses(
        stamp_s, problem.stamp_s, graph.pose, spread.pose, spread.consecutive, problem.drive, graph.states,
        outcome.noise.noise,
    )  # fmt: skip
    states, _, scale, _ = member.prior.split_scale(graph.states, np.zeros((N_STATES, N_STATES)))
    count, row = len(graph.landmark), np.searchsorted(stamp_s, problem.stamp_s)
    extended = replace(
        problem,
        stamp_s=stamp_s,
        pose_row=row[problem.pose_row],
        measurements=tuple(tied.renumbered(row) for tied in problem.measurements),
        landmark_mean=np.zeros((count, 2)),
        landmark_information=sparse.csr_array((2 * count, 2 * count)),
    )
    return extended, Estimate(pose * [scale, scale, 1.0], graph.landmark * scale, states)


def _place(members: Sequence[Solved], own: Sequence[tuple[Problem, Estimate]], met: Encounters) -> FloatArray:
    """(R, 3) motions of each robot's frame into that of the first one, by landmarks and sightings that agree.

    Raises:
        DataError: nothing ties one of them to the others.
    """
    first = np.cumsum([0, *(len(estimate.pose) for _, estimate in own)])
    robot = np.repeat(np.arange(len(own)), np.diff(first))
    pose, other = np.concatenate([estimate.pose for _, estimate in own]), robot[met.observed]
    sighted = np.zeros((len(other), 2))
    for r, (problem, estimate) in enumerate(own):
        mine = met.robot == r
        sighted[mine] = sight_at(pose[met.observer[mine]], met.reading[mine], estimate.states, problem.mount)
    names = [member.prepared.landmark_id for member in members]

    def in_both(a: int, b: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the same points in the frames of robots a and b, and which landmarks of each they are, -1 for none."""
        _, of_a, of_b = np.intersect1d(names[a], names[b], return_indices=True)
        points = [np.hstack([own[a][1].landmark[of_a], own[b][1].landmark[of_b]])]
        for x, y in ((a, b), (b, a)):
            some = np.flatnonzero((met.robot == x) & (other == y))
            some = some[:: 1 + len(some) // MOST_TIES]
            seen = [sighted[some], pose[met.observed[some], :2]]
            points.append(np.hstack(seen if x == a else seen[::-1]))
        both, row = np.concatenate(points), np.column_stack([of_a, of_b])
        row = np.pad(row, ((0, len(both) - len(row)), (0, 0)), constant_values=-1)
        known = np.isfinite(both).all(axis=1)
        return both[known, :2], both[known, 2:], row[known]

    def tie(b: int, placed: Sequence[int], motion: FloatArray) -> SharedPoints:
        """Return the points that b has in common with others, and where these have them."""
        theirs, mine, row = zip(*(in_both(a, b) for a in placed), strict=True)
        there = [se2.transform(motion[a], at) for a, at in zip(placed, theirs, strict=True)]
        spread = [_find_errors(members[a], rows[:, 0], motion[a]) for a, rows in zip(placed, row, strict=True)]
        errors = _find_errors(members[b], np.concatenate(row)[:, 1], np.zeros(3))
        return SharedPoints(Matches.of(np.concatenate(mine), np.concatenate(there)), errors, block_diag(*spread))

    robots = [member.recording.name for member in members]
    return align_frames(np.zeros((len(own), 3)), tie, robots, NEEDED, members[0].settings.localize)


def _find_errors(member: Solved, row: IntArray, motion: FloatArray) -> FloatArray:
    """(2 K, 2 K) covariance of landmarks (K,) of a robot that solved alone, in the frame that a motion leads to; zero
    for those that are -1, and for very many, of which none matters.
    """
    name = np.unique(row[row >= 0])
    spread = np.zeros((len(row), 2, len(row), 2))
    if 0 < len(name) <= MOST_JOINT:
        own = member.outcome.graph_marginals.joint(name) * member.outcome.scale**2
        some, turn = np.flatnonzero(row >= 0), se2.rotation(motion[2])
        at = np.searchsorted(name, row[some])
        own = own.reshape(len(name), 2, len(name), 2)[at[:, None], :, at[None]]
        spread[some[:, None], :, some[None]] = turn @ own @ turn.T
    return spread.reshape(2 * len(row), 2 * len(row))


def _share(members: Sequence[Solved]) -> tuple[list[IntArray], int]:
    """Return `share_places` by ids, except for landmarks that a robot saw moving."""
    revisions = [member.outcome.revision for member in members]
    names = [member.prepared.landmark_id for member in members]
    moved = {
        int(own[k]) for own, said in zip(names, revisions, strict=True) for c in said.changes for k in c.landmark_ids
    }
    identity = []
    for own, revision in zip(names, revisions, strict=True):
        identity.append(np.full(len(revision.estimate.landmark), -1))
        identity[-1][: len(own)] = np.where(np.isin(own, list(moved)), -1, own)
    return share_places(identity)


def _lay_together(
    members: Sequence[Solved], own: Sequence[tuple[Problem, Estimate]], met: Encounters, motion: FloatArray
) -> tuple[PlanarTogether, Estimate]:
    """The problem of all, and where it is when each robot's own solution is moved by (R, 3)."""
    places, count = _share(members)
    landmark = np.full((count, 2), np.nan)
    pose, robots = [], []
    metric = not all(member.prior.shares_scale for member in members)
    for r, (member, (problem, estimate), by) in enumerate(zip(members, own, motion, strict=True)):
        moved = estimate.moved(by)
        new = moved.known & np.isnan(landmark[places[r], 0])
        landmark[places[r][new]] = moved.landmark[new]
        prior, held = member.prior, problem.start_information if r == 0 else ALIGNED_INFORMATION
        if not metric:  # in the scale of the first one's ranges: of all that the priors allow a small map is preferred
            prior = prior.relative(np.sqrt(2.0) * prior.sigma[SLOPE] if r else 0.0)
        placed = replace(problem, start_pose=moved.pose[0], start_information=held, prior=prior)
        robots.append(Smoother(placed, member.outcome.noise.noise, robust=member.settings.robust))
        pose.append(moved.pose)
    start_s = np.array([member.prepared.start_s for member in members])
    sigma = np.array([robot.noise.detection for robot in robots])
    states = np.concatenate([estimate.states for _, estimate in own])
    joint = PlanarTogether(robots, places, start_s - start_s.min(), met, sigma)
    return joint, Estimate(np.concatenate(pose), landmark, states)


def _learn_levels(
    members: Sequence[Solved], joint: PlanarTogether, estimate: Estimate, *, heavy: bool = False
) -> tuple[PlanarTogether, Estimate, list[NoiseFit]]:
    """The optimum and its noise levels, in turns until neither changes; `heavy` outliers at first, if wanted."""
    ahead, start = [Extrapolation() for _ in members], joint.sigma
    fits: list[NoiseFit] = []

    def learn(joint: PlanarTogether, solution: Minimum[Estimate], round_: int) -> tuple[PlanarTogether, bool]:
        """Return the problem with levels by a solution, and True if these stay: then with those it was solved with."""
        first, estimate = heavy and round_ == 0, solution.state
        marginals = joint.marginals(estimate, solution.factorised)
        own, parts = joint.estimates(estimate), joint.parts(estimate, marginals)
        fits[:] = [
            refine_noise(
                robot.problem, one, part, robot.inlier_probability(one), robot.noise, _start(member), scoring=True
            )
            for member, robot, one, part in zip(members, joint.robots, own, parts, strict=True)
        ]
        learning, settled = [], not first
        for member, robot, fit, before in zip(members, joint.robots, fits, ahead, strict=True):
            noise = robot.noise
            if member.settings.estimate_noise:
                settled &= fit.change < NOISE_CONVERGED
                noise = fit.noise if first else before.ahead(noise, fit.noise)
            learning.append(robot.under(noise, heavy=False))
        if settled:
            return joint, True
        return joint.of(learning, _refine(members, joint, estimate, marginals, start)), False

    begun = joint.of([robot.under(robot.noise, heavy=heavy) for robot in joint.robots], joint.sigma)
    joint, estimate = settle(begun, estimate, learn, [Steps(STEPS_A_ROUND, NEAR_NOISE)] * FINAL_ROUNDS)
    return joint, estimate, [replace(fit, noise=robot.noise) for fit, robot in zip(fits, joint.robots, strict=True)]


def _start(member: Solved) -> Noise:
    """Noise levels before the first frame."""
    return beliefs(member.recording.sensor, member.settings)[1]


def _refine(
    members: Sequence[Solved], joint: PlanarTogether, estimate: Estimate, marginals: Marginals, start: FloatArray
) -> FloatArray:
    """(R, 2) noise of what each robot measures of others, as `refine_noise` has that of landmarks."""
    square, weight = joint.squares(estimate)
    left = weight[:, None] * np.maximum(1.0 - np.diagonal(marginals.explained_detections, axis1=1, axis2=2), 0.0)
    sigma = joint.sigma.copy()
    for r, member in enumerate(members):
        if member.settings.estimate_noise:
            mine, pseudo = joint.met.robot == r, _start(member).pseudo_count
            counts = left[mine].sum(axis=0)
            sigma[r] = restricted_level(square[mine].sum(axis=0), counts, start[r], pseudo)
    return sigma


def _keep_needed(joint: PlanarTogether, estimate: Estimate) -> tuple[PlanarTogether, Estimate, list[FloatArray]]:
    """Return the same under priors of the needed calibration states, with their probabilities."""
    marginals = joint.marginals(estimate)
    robots, states, p_needed = [], [], []
    parts = zip(joint.robots, joint.estimates(estimate), joint.parts(estimate, marginals), strict=True)
    for robot, own, part in parts:
        worth, prior = robot.worth(own, part), robot.problem.prior
        p_needed.append(needed(prior, own.states, part.states, worth))
        prior, mean = prior.averaged(p_needed[-1], own.states, np.diag(part.states), worth)
        robots.append(Smoother(replace(robot.problem, prior=prior), robot.noise, robust=robot.robust))
        states.append(mean)
    return joint.of(robots, joint.sigma), replace(estimate, states=np.concatenate(states)), p_needed


def _ahead(first: Solved, joint: PlanarTogether, estimate: Estimate) -> tuple[PlanarTogether, Estimate]:
    """Return the same, rotated so that the first robot's first pose has its front ahead."""
    problem = joint.robots[0].problem
    start = se2.inverse(first.prior.front(estimate.states[:N_STATES], problem.mount))
    turn, robots = se2.compose(start, se2.inverse(problem.start_pose)), []
    for robot in joint.robots:
        turned = replace(robot.problem, start_pose=se2.compose(turn, robot.problem.start_pose))
        robots.append(Smoother(turned, robot.noise, robust=robot.robust))
    return joint.of(robots, joint.sigma), estimate.moved(turn)


def _divide(
    members: Sequence[Solved],
    joint: PlanarTogether,
    estimate: Estimate,
    marginals: Marginals,
    p_needed: Sequence[FloatArray],
    fits: Sequence[NoiseFit],
) -> list[Outcome]:
    """Return each robot's part of the optimum, in the common scale; changes are those of each alone."""
    own, parts = joint.estimates(estimate), joint.parts(estimate, marginals)
    priors = [member.prior for member in members]
    told = [
        prior.metre(one.states, part.states) if all(other.shares_scale for other in priors) else None
        for prior, one, part in zip(priors, own, parts, strict=True)
    ]
    outcomes = []
    for r, (member, robot) in enumerate(zip(members, joint.robots, strict=True)):
        revision = replace(member.outcome.revision, problem=robot.problem, estimate=own[r], rivals=())
        others = tuple(said for k, said in enumerate(told) if said is not None and k != r)
        outcome = divided(
            (robot, own[r], parts[r]), priors[r], p_needed[r], fits[r], revision, aligned=True, others=others
        )
        outcomes.append(replace(outcome, aligned=False))
    return outcomes
