"""Compile (or load) the kernels before the first frame, so that no frame has to wait for it."""

from __future__ import annotations

import functools

import numpy as np
from scipy import sparse

from evermap.config import ChangesConfig
from evermap.estimate.sparse.elimination import (
    Elimination,
    curvature,
    eliminate_large,
    forward_substitute,
    multiply_transposed,
    ways_to_border,
)
from evermap.estimate.sparse.system import System, exhaust
from evermap.estimate.sparse.tree import Factors
from evermap.sensing.visibility import NominalField
from evermap.slam.bridge import bridge_poses, dead_reckoned
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.changes.evidence import WindowEvidence, compare
from evermap.slam.changes.search import find_changes
from evermap.slam.correlation import Lasting
from evermap.slam.local_filter import BY_OTHERS
from evermap.slam.nearby_places import NO_PLACES
from evermap.slam.noise import START, refine_noise
from evermap.slam.planar_filter import FrameReadings, PlanarFilter
from evermap.slam.problem import Drive, Estimate, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import FIRST_RELINEARISATION, StreamingSlam
from evermap.types import Sensor

FORWARD_MPS = 0.1
PLACE = (3.0, 1.0)
"""[m], of the landmark that the drive along x passes."""
FRAMES_FILTERED = 3


def warm_up(*, search: bool = True) -> None:
    """Compile the kernels, or load them where that was done before; estimating does it by itself.

    Worth calling ahead where the first frame must not wait: compiling takes half a minute, once on a machine.

    Args:
        search: those of the search for changes, too; see `changes.joint.may_search`.
    """
    filtered()
    if search:
        search_changes()
    smoothed()


@functools.cache
def filtered() -> None:
    """Compile the filter, what interpolates its poses, and the field of view: frames before a relinearisation."""
    problem = _drive()
    slam = StreamingSlam(problem, START, problem.prior)
    for _ in range(FRAMES_FILTERED):
        slam.step()
    any_filter()
    stamps = problem.stamp_s[:2]
    covariance, cross = np.tile(np.eye(3), (2, 1, 1)), np.zeros((1, 3, 3))
    bridge_poses(stamps, stamps, np.zeros((2, 3)), covariance, cross, problem.drive, problem.prior.mean, START)
    dead_reckoned(stamps, problem.drive, problem.prior.mean, START)
    NominalField(Sensor(range_max_m=5.0)).p_detect(np.zeros((1, 3)), np.array([PLACE]))


@functools.cache
def any_filter() -> None:
    """Compile what a filter that asks the others of a frame needs, the same in plane and space."""
    problem, row = _drive(), np.zeros(1, dtype=np.int64)
    seen = FrameReadings(problem.reading[:1], 1e-2 * np.ones((1, 2)))
    for considered in (False, True):
        local = PlanarFilter(np.zeros(3), problem.prior, considered=considered)
        local.hold(np.zeros(3), problem.prior.mean, np.eye(local.own), NO_PLACES, np.zeros((0, 2)))
        local.meet(0, np.array(PLACE), 1e-4 * np.eye(2))
        local.compare(row, seen)
        local.update(row, seen, weighing=BY_OTHERS)


@functools.cache
def search_changes() -> None:
    """Compile the search for changes: three landmarks at their places."""
    place, sure, count = 3.0 * np.eye(3, 2), np.eye(6), 3
    evidence = WindowEvidence(np.arange(count), np.zeros(count, dtype=np.int64), place, sure, np.zeros(6), 0.0)
    comparison = compare(evidence, place, np.tile(np.eye(2), (count, 1, 1)), np.ones(count, dtype=np.bool_))
    exhaust(find_changes(evidence, comparison, place, 1, ChangesConfig()))


@functools.cache
def smoothed() -> None:
    """Compile the batch solution: the whole drive, from where it is known to lead."""
    problem = _drive()
    smoother = Smoother(problem, START)
    pose = np.pad(FORWARD_MPS * problem.stamp_s[:, None], ((0, 0), (0, 2)))
    start = Estimate(pose, np.array([PLACE]), problem.prior.mean)
    estimate, marginals = exhaust(smoother.solve_in_slices(start, iterations=1))
    refine_noise(problem, estimate, marginals, smoother.inlier_probability(estimate), START)
    smoother.worth(estimate, marginals)
    problem.new_information(Lasting(np.ones(1), np.ones(1)))
    _ = marginals.pose, marginals.consecutive
    smoother.information(estimate, np.array([0, len(pose) - 1]))
    seldom_used()


def seldom_used() -> None:
    """Compile what only damped steps and only large problems ask for, in the plane and in space."""
    one = np.ones(1, dtype=np.int64)
    alone = System(one, Factors(np.arange(2), 0 * one, one, 0 * one), np.zeros((1, 3)), np.zeros(0, dtype=np.int64))
    curvature(alone.tree, alone.factors, np.zeros(2))
    eliminate_large(alone.tree, alone.factors, np.ones(2), np.ones(1), Elimination.of(alone.tree), 0)
    stored = np.ones(int(alone.tree.stored[-1]))
    forward_substitute(alone.tree, stored, multiply_transposed(alone.tree, alone.factors, np.zeros(2), np.zeros(1)))
    ways_to_border(alone.tree, stored, alone.node_of, np.zeros(1, dtype=np.int64), np.eye(1))


def _drive() -> Problem:
    """Return a drive past one landmark, a little longer than to the first relinearisation."""
    count = FIRST_RELINEARISATION + 2
    stamps = np.linspace(0.0, 0.1 * count, count)
    forward = FORWARD_MPS * stamps
    return Problem(
        stamp_s=stamps,
        drive=Drive.from_rows(stamps, np.tile([FORWARD_MPS, 0.0, 0.0], (count, 1))),
        pose_row=np.arange(count),
        landmark_row=np.zeros(count, dtype=np.int64),
        reading=np.column_stack([np.hypot(PLACE[0] - forward, PLACE[1]), np.arctan2(PLACE[1], PLACE[0] - forward)]),
        sigma_given=np.full((count, 2), np.nan),
        mount=np.zeros(3),
        prior=CalibrationPrior.from_settings(calibrated=True),
        start_pose=np.zeros(3),
        start_information=1e8,
        landmark_mean=np.zeros((1, 2)),
        landmark_information=sparse.csr_array((2, 2)),
    )
