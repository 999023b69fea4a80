"""Joint solution of several simultaneous recordings in space, as `slam.together`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from evermap.align.acceptance import MOST_JOINT
from evermap.align.candidates import Matches
from evermap.config import LocalizeConfig
from evermap.estimate.gauss_newton import Minimum, Steps
from evermap.estimate.graph import Border, FactorBlock, Linear
from evermap.estimate.sparse.elimination import Spread
from evermap.estimate.sparse.system import Factorised, exhaust
from evermap.geometry import se2, se3
from evermap.slam.space.against_map import by_itself
from evermap.slam.space.estimate import (
    CONVERGED,
    FIRST_STEPS,
    LAST_STEPS,
    NEAR,
    ROUNDS,
    STEPS_A_ROUND,
    SpatialOptimum,
    level_soberly,
    refined,
)
from evermap.slam.space.intake import SpatialIntake
from evermap.slam.space.linearise import STATES
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.smoother import (
    COST_SLACK,
    FIRST_DAMPING,
    ODOMETRY,
    POSES_A_LEAF,
    SETTLED,
    SIGHTINGS,
    SpatialLinear,
    SpatialSmoother,
    limit_turns,
)
from evermap.slam.space.solve import FREE, SpatialSolved
from evermap.slam.together import SharedPoints, Together, align_frames, settle, share_places
from evermap.types import BoolArray, FloatArray, IntArray

NEEDED = "common landmark ids, at least three points or one tag, and one clock"
"""What ties robots in space."""


class JointEstimate(NamedTuple):
    """Values of all variables of several robots: their poses (N, 7), one robot after the other; the places (P, 7) of
    all; the mounts (S, 6) of all their sensors; and the scale (R,) of the odometry of each.
    """

    pose: FloatArray
    place: FloatArray
    state: FloatArray
    log_scale: FloatArray


@dataclass(frozen=True, slots=True)
class SolvedRobot:
    """A robot that was solved by itself."""

    intake: SpatialIntake
    solved: SpatialSolved

    @property
    def problem(self) -> SpatialProblem:
        """The problem that its values are the optimum of."""
        return self.solved.optimum.last[0].problem

    @property
    def identity(self) -> IntArray:
        """(P,) ids of its places; -1 of a second one with the same id, which is its own."""
        first = (self.solved.number == 1) & ~self.solved.left
        return np.where(first, self.intake.landmark_id[self.solved.identity], -1)


def solve_space_together(
    members: Sequence[SolvedRobot], names: Sequence[str], rules: LocalizeConfig
) -> list[SpatialSolved]:
    """Return robots solved together, in the frame of the first one's first pose.

    Args:
        members: each by itself.
        names: what they are called in messages.
        rules: when the frame of one is known in those of others.

    Raises:
        DataError: nothing ties one of them to the others.
        NumericalError: no finite optimum.
    """
    motion = align_robots(members, names, rules)
    joint, start = _lay_together(members, motion)
    begun = joint.noise
    # where frames meet to within centimetres, corners are off by many pixels: nothing is let go before it had its say
    start = exhaust(joint.of(begun, heavy=True).minimise_in_slices(start, _steps(FIRST_STEPS))).state

    def learn(joint: SpatialTogether, solution: Minimum[JointEstimate], _: int) -> tuple[SpatialTogether, bool]:
        """Return the problem with levels by a solution, and whether these are as they were."""
        following = [
            refined(part.smoother, part.now, own, first)
            for part, own, first in zip(joint.parts(solution), joint.noise, begun, strict=True)
        ]
        changes = [np.abs(np.log(new.levels / old.levels)) for new, old in zip(following, joint.noise, strict=True)]
        return joint.of(following), bool(np.max(changes) < CONVERGED)

    steps = [_steps(FIRST_STEPS if round_ == 0 else STEPS_A_ROUND) for round_ in range(ROUNDS)]
    joint, start = settle(joint, start, learn, steps)
    optima = _with_worth(joint, members, exhaust(joint.minimise_in_slices(start, _steps(LAST_STEPS))))
    found = []
    for member, by, optimum in zip(members, motion, optima, strict=True):
        online = se3.compose(by, member.solved.online_pose)
        found.append(replace(member.solved, optimum=optimum, online_pose=online))
    return found


def _with_worth(
    joint: SpatialTogether, members: Sequence[SolvedRobot], solution: Minimum[JointEstimate]
) -> list[SpatialOptimum]:
    """Return what each robot has of the solution, with covariances by all that count its detections as when alone."""
    fitted, alone = joint.parts(solution), [member.solved.optimum for member in members]
    if all(one.fitted is None for one in alone):
        return fitted
    robots = [
        _Member(replace(found.smoother.problem, share=one.smoother.problem.share), found.estimate.pose)
        for found, one in zip(fitted, alone, strict=True)
    ]
    sober = [level_soberly(found.noise, one) for found, one in zip(fitted, alone, strict=True)]
    counted = SpatialTogether(robots, joint.places, joint.start_s, joint.oriented, sober)
    now = exhaust(counted.linearise_in_slices(solution.state))
    parts = counted.parts(Minimum(solution.state, now, None))
    return [
        replace(part, noise=found.noise, fitted=(found.smoother, found.now), sober=part.noise)
        for part, found in zip(parts, fitted, strict=True)
    ]


def _steps(most: int) -> Steps:
    return Steps(most, NEAR, SETTLED, 0.0, COST_SLACK, FIRST_DAMPING)


def align_robots(members: Sequence[SolvedRobot], names: Sequence[str], rules: LocalizeConfig) -> FloatArray:
    """Return the motions (R, 7) of each robot's frame into that of the first, by landmarks that agree.

    Raises:
        DataError: nothing ties one of them to the others.
    """
    alone = [_errors(member) for member in members]

    def tie(b: int, placed: Sequence[int], motion: FloatArray) -> SharedPoints:
        """Return places that b has in common with others, and where these have them, with orientations where known."""
        by = [(members[a], motion[a]) for a in placed]
        theirs = np.concatenate([se3.compose(at, member.solved.optimum.estimate.place) for member, at in by])
        oriented = np.concatenate([member.problem.oriented for member, _ in by])
        own_name, name = members[b].identity, np.concatenate([member.identity for member, _ in by])
        row, other = np.nonzero((own_name[:, None] == name) & (own_name >= 0)[:, None])
        mine, there = members[b].solved.optimum.estimate.place[row], theirs[other]
        mine[~members[b].problem.oriented[row], 3:] = np.nan
        there[~oriented[other], 3:] = np.nan
        at, to = se2.xy_rows(row, 3), se2.xy_rows(other, 3)
        spread = block_diag(*(_turn_axes(alone[a], se3.rotation_of(motion[a])) for a in placed))
        return SharedPoints(Matches.of(mine, there, landmark=row), alone[b][np.ix_(at, at)], spread[np.ix_(to, to)])

    return align_frames(se3.identity(len(members)), tie, names, NEEDED, rules)


def _errors(member: SolvedRobot) -> FloatArray:
    """(3 P, 3 P) covariance of the places of a robot that was solved alone; of very many none matters."""
    count = len(member.solved.optimum.estimate.place)
    if count > MOST_JOINT:
        return np.zeros((3 * count, 3 * count))
    return by_itself(member.solved.optimum).covariance_m2


def _turn_axes(covariance_m2: FloatArray, turn: FloatArray) -> FloatArray:
    """(3 P, 3 P) covariance in axes that are turned."""
    every = covariance_m2.reshape(len(covariance_m2) // 3, 3, -1, 3)
    return np.asarray(np.einsum("ab,ibjc,dc->iajd", turn, every, turn, optimize=True).reshape(covariance_m2.shape))


def _lay_together(members: Sequence[SolvedRobot], motion: FloatArray) -> tuple[SpatialTogether, JointEstimate]:
    """The problem of all, and where it is when each robot's own solution is moved by (R, 7)."""
    places, count = share_places([member.identity for member in members])
    oriented, place = np.zeros(count, dtype=np.bool_), se3.identity(count)
    known = np.zeros(count, dtype=np.bool_)
    estimates = [member.solved.optimum.estimate for member in members]
    for member, by, row, estimate in zip(members, motion, places, estimates, strict=True):
        moved, turned = se3.compose(by, estimate.place), member.problem.oriented
        new = ~known[row] | (turned & ~oriented[row])  # of one that has an orientation to one, the former
        place[row[new]] = moved[new]
        known[row], oriented[row] = True, oriented[row] | turned
    place[~oriented, 3:] = se3.NO_TURN
    robots = []
    for r, (member, by, row, estimate) in enumerate(zip(members, motion, places, estimates, strict=True)):
        sigma = member.problem.start_sigma if r == 0 else FREE
        trusted = np.zeros(len(member.problem.mount))
        problem = replace(member.problem, oriented=oriented[row], start_sigma=sigma, delay_jitter=trusted)
        robots.append(_Member(problem, se3.compose(by, estimate.pose)))
    start = JointEstimate(
        np.concatenate([se3.compose(by, estimate.pose) for by, estimate in zip(motion, estimates, strict=True)]),
        place,
        np.concatenate([estimate.state for estimate in estimates]),
        np.array([estimate.log_scale for estimate in estimates]),
    )
    begin_s = np.array([member.intake.start_s for member in members])
    noise = [member.solved.optimum.noise for member in members]
    return SpatialTogether(robots, places, begin_s, oriented, noise), start


class SpatialTogether(Together[JointEstimate]):
    """Several problems in space that share places, as one graph.

    Args:
        robots: the smoother of each.
        places: (P_r,) of each robot, which of all places its own are.
        start_s: (R,) beginning of each problem's clock on that of all.
        oriented: (P,) places with an orientation.
        noise: levels of each robot.
        heavy: whether its detections have tails that never let go.
    """

    def __init__(
        self,
        robots: Sequence[_Member],
        places: Sequence[IntArray],
        start_s: FloatArray,
        oriented: BoolArray,
        noise: Sequence[SpatialNoise],
        *,
        heavy: bool = False,
    ) -> None:
        self.sensor = np.cumsum([0, *(len(robot.problem.mount) for robot in robots)])
        calibration = [
            np.append(np.arange(self.sensor[r], self.sensor[r + 1]), self.sensor[-1] + r) for r in range(len(robots))
        ]
        n_poses = [len(robot.problem.stamp_s) for robot in robots]
        super().__init__(n_poses, places, calibration, poses_a_leaf=POSES_A_LEAF)
        self.robots, self.noise, self.oriented, self.start_s = tuple(robots), tuple(noise), oriented, start_s
        self.heavy = heavy

    def of(self, noise: Sequence[SpatialNoise], *, heavy: bool = False) -> SpatialTogether:
        """Return the same with other levels; its structure is kept."""
        other = SpatialTogether(self.robots, self.places, self.start_s, self.oriented, noise, heavy=heavy)
        other._structure = self._structure
        return other

    def parts(self, solution: Minimum[JointEstimate]) -> list[SpatialOptimum]:
        """Return what each robot has of the solution, with covariances by all."""
        structure, variable = self.graph(solution.state).structure, self.variables(self._find_known(solution.state))
        factorised = exhaust(self.factorise_in_slices(solution.state))
        steps = np.cumsum([0, *(len(robot.problem.increment) for robot in self.robots)]).tolist()
        spread = exhaust(factorised.spread(steps[-1]))
        found, count = [], len(self.robots)
        for r, robot in enumerate(self.robots):
            blocks = [kind * count + r for kind in (ODOMETRY, SIGHTINGS)]
            values = np.concatenate([solution.now.values[structure.values_of(k)] for k in blocks])
            weights = tuple(solution.now.weights[k] for k in blocks)
            factors = [structure.first[k : k + 2] for k in blocks]
            robot.learn(factorised, spread, variable[r], factors, spread.pairs[steps[r] : steps[r + 1]])
            own = Linear(values, weights, solution.now.cost, np.zeros(0))
            found.append(SpatialOptimum(self.own(solution.state, r), self.noise[r], robot, SpatialLinear(own, robot)))
        return found

    def own(self, state: JointEstimate, robot: int) -> SpatialEstimate:
        """Return the values of a robot."""
        poses, sensors = (slice(*of[robot : robot + 2].tolist()) for of in (self.first, self.sensor))
        place, log_scale = state.place[self.places[robot]], float(state.log_scale[robot])
        return SpatialEstimate(state.pose[poses], place, state.state[sensors], log_scale)

    def _find_known(self, state: JointEstimate) -> BoolArray:
        return np.ones(len(state.place), dtype=np.bool_)

    def _dims(self) -> tuple[int, IntArray, IntArray]:
        of_sensors, of_scales = np.full(int(self.sensor[-1]), STATES), np.ones(len(self.robots), dtype=np.int64)
        return 6, np.where(self.oriented, 6, 3), np.append(of_sensors, of_scales)

    def _coordinate(self, state: JointEstimate) -> FloatArray:
        when = [begin_s + robot.problem.stamp_s for robot, begin_s in zip(self.robots, self.start_s, strict=True)]
        return np.column_stack([np.concatenate(when), state.pose[:, :3]])

    def _blocks(self, state: JointEstimate) -> list[tuple[FactorBlock[SpatialEstimate], ...]]:  # noqa: ARG002
        return [robot.graph(own, heavy=self.heavy).blocks for robot, own in zip(self.robots, self.noise, strict=True)]

    def _hold(self, held: FloatArray, begin: IntArray, variable: Sequence[IntArray]) -> None:
        for robot, own in zip(self.robots, variable, strict=True):
            robot.hold(held, begin[own])

    def _border(self) -> Border[JointEstimate]:
        of_sensors = [robot.states_information[:-1] for robot in self.robots]
        of_scales = [robot.states_information[-1:] for robot in self.robots]
        return Border(np.concatenate([*of_sensors, *of_scales]), _states)

    def _retract(self, state: JointEstimate, step: FloatArray) -> tuple[JointEstimate, float]:
        n, count, on = len(state.pose), len(state.place), self.oriented
        begin = np.cumsum([6 * n, *np.where(on, 6, 3)])
        by, turned, share, size = limit_turns(step, n, on, begin[:-1])
        place = state.place.copy()
        place[on] = se3.retract(place[on], share * turned[on])
        place[~on, :3] += share * turned[~on, :3]
        sensors = share * step[begin[count] : begin[count] + STATES * len(state.state)].reshape(-1, STATES)
        log_scale = state.log_scale + share * step[len(step) - len(state.log_scale) :]
        return JointEstimate(se3.retract(state.pose, share * by), place, state.state + sensors, log_scale), size


def _states(state: JointEstimate) -> FloatArray:
    """Return the numbers of the border, whose means are zero."""
    return np.append(state.state, state.log_scale)


class _Member(SpatialSmoother):
    """A robot among others: its covariances are those by all."""

    def learn(
        self,
        factorised: Factorised,
        spread: Spread,
        variable: IntArray,
        factors: Sequence[tuple[int, ...]],
        pairs: FloatArray,
    ) -> None:
        """Take what it has of the solution of all, by its own variables, the ranges of its factors, and covariances
        `pairs` (N - 1, 6, 6) of consecutive poses.
        """
        self._joint, self._variable = factorised, variable
        first = spread.own_first
        own = np.concatenate([spread.own[first[k] : first[k + 1]] for k in variable.tolist()])
        own_first = np.append(0, np.cumsum(np.diff(first)[variable]))
        at = spread.of_factors_first
        of_factors = np.concatenate([spread.of_factors[at[low] : at[high]] for low, high in factors])
        sizes = np.concatenate([np.diff(at[low : high + 1]) for low, high in factors])
        tree, n = factorised.system.tree, len(self.problem.stamp_s)
        scale = spread.with_border[:, tree.in_border[variable[-1]]]
        with_scale = np.append(scale[tree.begin[variable[0]] :][: 6 * n], scale[tree.begin[variable[-1]]])[:, None]
        nothing = np.zeros((0, 0))
        of_first = np.append(0, np.cumsum(sizes))
        self._spread = Spread(own, own_first, with_scale, of_factors, of_first, pairs, nothing)

    def spread(self, now: SpatialLinear, *, nearly: bool = False) -> Spread:  # noqa: ARG002
        """Return covariances of its variables, of poses with its scale, and of what its odometry and detections tie."""
        return self._spread

    def factorised(self, now: SpatialLinear) -> Factorised:  # noqa: ARG002
        """Return the equations of all with its sensors and scale in the border."""
        return _OwnBorder(self._joint, self._variable[-1 - len(self.problem.mount) :])


class _OwnBorder(Factorised):
    """The equations of all, of whose border one robot's part is asked."""

    _own: IntArray

    def __init__(self, joint: Factorised, own: IntArray) -> None:
        super().__init__(joint.system, joint.values, joint.rows, joint.own_right, joint.information, joint.right)
        tree = joint.system.tree
        at = [tree.in_border[k] + np.arange(tree.dim[k]) for k in own.tolist()]
        object.__setattr__(self, "_own", np.concatenate(at))

    def border_covariance(self) -> FloatArray:
        """Return the covariance of its sensors and its scale."""
        return np.asarray(super().border_covariance()[np.ix_(self._own, self._own)])
