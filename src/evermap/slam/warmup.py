"""Compile (or load) the kernels before the first frame, so that no frame has to wait for it."""

from __future__ import annotations

import functools

import numpy as np
from scipy import sparse

from evermap.config import ChangesConfig
from evermap.slam.bridge import bridged, dead_reckoned
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.changes.evidence import WindowEvidence, compare
from evermap.slam.changes.search import find_changes
from evermap.slam.noise import START
from evermap.slam.problem import Drive, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.sparse.elimination import curvature
from evermap.slam.sparse.system import System
from evermap.slam.sparse.tree import Factors
from evermap.slam.streaming import FIRST_RELINEARISATION, StreamingSlam


def warm_up(*, search: bool = True) -> None:
    """Compile the kernels, or load them where that was done before; estimating does it by itself.

    Worth calling ahead where the first frame must not wait: compiling takes half a minute, once on a machine.

    Args:
        search: those of the search for changes, too; see `changes.joint.may_search`.
    """
    _drive()
    if search:
        _search()


@functools.cache
def _drive() -> None:
    """Drive past one landmark, through everything that is compiled."""
    count = FIRST_RELINEARISATION + 2
    stamps = np.linspace(0.0, 0.1 * count, count)
    prior = CalibrationPrior.from_settings(calibrated=True)
    forward = 0.1 * stamps
    problem = Problem(
        stamp_s=stamps,
        drive=Drive.from_rows(stamps, np.tile([0.1, 0.0, 0.0], (count, 1))),
        pose_row=np.arange(count),
        landmark_row=np.zeros(count, dtype=np.int64),
        reading=np.column_stack([np.hypot(3.0 - forward, 1.0), np.arctan2(1.0, 3.0 - forward)]),
        sigma_given=np.full((count, 2), np.nan),
        mount=np.zeros(3),
        prior=prior,
        start_pose=np.zeros(3),
        start_information=1e8,
        landmark_mean=np.zeros((1, 2)),
        landmark_information=sparse.csr_array((2, 2)),
    )
    slam = StreamingSlam(problem, START, prior)
    for _ in range(count):
        slam.step()
    outcome = slam.finish()
    Smoother(problem, START).information(outcome.graph_estimate, np.array([0, count - 1]))
    one = np.ones(1, dtype=np.int64)
    alone = System(one, Factors(np.arange(2), 0 * one, one, 0 * one), np.zeros((1, 3)), np.zeros(0, dtype=np.int64))
    curvature(alone.tree, alone.factors, np.zeros(2))  # only steps that are damped ask for it
    marginals = outcome.graph_marginals
    bridged(
        stamps[:2],
        stamps,
        outcome.graph_estimate.pose,
        marginals.pose,
        marginals.consecutive,
        problem.drive,
        outcome.graph_estimate.states,
        START,
    )
    dead_reckoned(stamps[:2], problem.drive, prior.mean, START)


@functools.cache
def _search() -> None:
    """Three landmarks at their places, searched for changes."""
    place, sure, count = 3.0 * np.eye(3, 2), np.eye(6), 3
    evidence = WindowEvidence(np.arange(count), np.zeros(count, dtype=np.int64), place, sure, np.zeros(6), 0.0)
    comparison = compare(evidence, place, np.tile(np.eye(2), (count, 1, 1)), np.ones(count, dtype=np.bool_))
    find_changes(evidence, comparison, place, 1, ChangesConfig())
