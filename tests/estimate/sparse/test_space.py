"""A session in space on the sparse solver: its optimum and its marginals are gtsam's."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from groups import SPACE_CASE

from evermap.estimate.sparse.system import System, exhaust
from evermap.estimate.sparse.tree import Factors
from evermap.geometry import se3
from evermap.slam.kernels3d import odometry_residual, point_residual

N, K = 16, 6
"""Poses on a loop, and points."""
SIGMA_STEP, SIGMA_POINT, HELD = 0.05, 0.1, 1e4
order = SPACE_CASE.order


def written(kernel, given, *shapes):
    out = [np.zeros(shape) for shape in shapes]
    kernel(*given, *out)
    return out


class Session:
    """Inconsistent steps and sightings of points, and a start that is off."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        angle = np.linspace(0.0, 2.0 * np.pi, N, endpoint=False)
        at = np.column_stack([4.0 * np.cos(angle), 4.0 * np.sin(angle), random.normal(0.0, 0.5, N)])
        self.true = se3.exp(np.column_stack([at, random.normal(0.0, 0.4, (N, 3))]))
        self.point = random.normal(0.0, 3.0, (K, 3))
        self.steps = [
            se3.retract(se3.between(self.true[i], self.true[i + 1]), random.normal(0.0, SIGMA_STEP, 6))
            for i in range(N - 1)
        ]
        self.seen = [(i, j) for i in range(N) for j in range(K) if random.random() < 0.5 or i in (0, N - 1)]
        self.reading = [
            se3.transform(se3.inverse(self.true[i]), self.point[j]) + random.normal(0.0, SIGMA_POINT, 3)
            for i, j in self.seen
        ]
        self.start = se3.retract(self.true, random.normal(0.0, 0.1, (N, 6)))
        self.start_point = self.point + random.normal(0.0, 0.3, (K, 3))

    def by_gtsam(self) -> tuple[np.ndarray, np.ndarray, gtsam.Marginals]:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        step = gtsam.noiseModel.Isotropic.Sigma(6, SIGMA_STEP)
        for i, increment in enumerate(self.steps):
            graph.add(gtsam.BetweenFactorPose3(i, i + 1, SPACE_CASE.as_peer(increment), step))
        graph.add(
            gtsam.PriorFactorPose3(0, SPACE_CASE.as_peer(self.true[0]), gtsam.noiseModel.Isotropic.Precision(6, HELD))
        )
        noise = gtsam.noiseModel.Isotropic.Sigma(3, SIGMA_POINT)
        for (i, j), reading in zip(self.seen, self.reading, strict=True):

            def error(factor, values, jacobians, reading=reading):
                pose, point = values.atPose3(factor.keys()[0]), values.atPoint3(factor.keys()[1])
                by_pose, by_point = np.zeros((3, 6), order="F"), np.zeros((3, 3), order="F")
                predicted = pose.transformTo(point, by_pose, by_point)
                if jacobians is not None:
                    jacobians[0], jacobians[1] = -by_pose, -by_point
                return reading - predicted

            graph.add(gtsam.CustomFactor(noise, [i, N + j], error))
        for i in range(N):
            values.insert(i, SPACE_CASE.as_peer(self.start[i]))
        for j in range(K):
            values.insert(N + j, self.start_point[j])
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-14)
        parameters.setAbsoluteErrorTol(1e-14)
        optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        poses = np.array([optimum.atPose3(i).matrix() for i in range(N)])
        points = np.array([optimum.atPoint3(N + j) for j in range(K)])
        return poses, points, gtsam.Marginals(graph, optimum)

    def system(self) -> System:
        ties = [[i, i + 1] for i in range(N - 1)] + [[i, N + j] for i, j in self.seen] + [[0]]
        rows = [6] * (N - 1) + [3] * len(self.seen) + [6]
        leaf = [i // 4 for i in range(N - 1)] + [min(i, N - 2) // 4 for i, _ in self.seen] + [0]
        factors = Factors(
            np.append(0, np.cumsum([len(tie) for tie in ties])), np.concatenate(ties), np.array(rows), np.array(leaf)
        )
        n_leaves = max(leaf) + 1
        coordinate = np.column_stack([np.arange(n_leaves), self.start[: 4 * n_leaves : 4, :3]])
        return System(np.array([6] * N + [3] * K), factors, coordinate, np.zeros(0, dtype=np.int64))

    def values(self, pose: np.ndarray, point: np.ndarray) -> np.ndarray:
        blocks = []
        for i, increment in enumerate(self.steps):
            e, before, after = written(odometry_residual, (pose[i], pose[i + 1], increment), 6, (6, 6), (6, 6))
            blocks.append(np.column_stack([before, after, -e]) / SIGMA_STEP)
        for (i, j), reading in zip(self.seen, self.reading, strict=True):
            e, by_pose, by_point, _ = written(
                point_residual, (pose[i], point[j], se3.identity(), reading), 3, (3, 6), (3, 3), (3, 6)
            )
            blocks.append(np.column_stack([by_pose, by_point, -e]) / SIGMA_POINT)
        held = se3.local(self.true[0], pose[0])
        blocks.append(np.column_stack([se3.right_jacobian_inverse(held), -held]) * np.sqrt(HELD))
        return np.concatenate([block.ravel() for block in blocks])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_optimum_and_marginals_in_space_are_gtsams(seed):
    session = Session(seed)
    system, pose, point = session.system(), session.start.copy(), session.start_point.copy()
    for _ in range(30):
        solved = exhaust(system.factorised(session.values(pose, point)))
        step = exhaust(solved.solution())
        pose = se3.retract(pose, step[: 6 * N].reshape(N, 6))
        point = point + step[6 * N :].reshape(K, 3)
        if np.abs(step).max() < 1e-11:
            break
    their_pose, their_point, marginals = session.by_gtsam()
    for i in range(N):
        assert SPACE_CASE.matrix(pose[i]) == pytest.approx(their_pose[i], abs=1e-6)
    assert point == pytest.approx(their_point, abs=1e-6)
    solved = exhaust(system.factorised(session.values(pose, point)))
    for i in (0, N // 2, N - 1):
        theirs = marginals.marginalCovariance(i)
        mine = solved.joint(np.array([i]))
        sigma = np.sqrt(np.diag(mine))
        gap = mine[np.ix_(order, order)] - theirs
        assert np.abs(gap / np.outer(sigma[order], sigma[order])).max() < 1e-4
    for j in range(K):
        assert solved.joint(np.array([N + j])) == pytest.approx(marginals.marginalCovariance(N + j), rel=1e-4, abs=1e-9)
    # without the hold nothing says where all of it is: its rigid motions cost nothing
    free = session.values(pose, point)
    free[-42:] = 0.0
    information = np.zeros((6 * N + 3 * K, 6 * N + 3 * K))
    at = 0
    for f, rows in enumerate(system.factors.rows):
        columns = np.concatenate(
            [
                np.arange(*system.tree.begin[[v, v + 1]])
                for v in system.factors.variable[slice(*system.factors.first[[f, f + 1]])]
            ]
        )
        block = free[at : at + rows * (len(columns) + 1)].reshape(rows, -1)
        at += block.size
        information[np.ix_(columns, columns)] += block[:, :-1].T @ block[:, :-1]
    gauge = np.vstack([*(se3.adjoint(se3.inverse(p)) for p in pose), se3.rigid_directions(point)])
    assert np.abs(information @ gauge).max() < 1e-7 * np.abs(information).max()
