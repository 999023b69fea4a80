"""Two landmarks that carry each other's identity are no two moves, and two moves are no swap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_robust import COUNT, evidence_with, none
from worlds import Move, Session, make_session

from evermap.slam.changes.evidence import WindowEvidence, compare
from evermap.slam.changes.explain import GivenMap
from evermap.slam.changes.joint import likeliest_swap, with_swap
from evermap.types import ChangeKind

P_SWAPPED = 1e-5


def swap_of(evidence: WindowEvidence, given: GivenMap):
    return likeliest_swap(evidence, compare(evidence, given.mean, given.covariance, given.given), given, P_SWAPPED)


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 8))])
def test_swap_is_found_and_undone(seed: int) -> None:
    evidence, given = evidence_with(none(), seed)
    wrong = with_swap(given, 1, 4)
    swap = swap_of(evidence, wrong)
    assert swap is not None
    assert (swap.first, swap.second) == (1, 4)
    assert swap.log_prior == pytest.approx(np.log(P_SWAPPED / (COUNT * (COUNT - 1) / 2)))
    np.testing.assert_array_equal(with_swap(wrong, 1, 4).mean, given.mean)
    assert swap_of(evidence, given) is None


def test_gain_of_a_swap_is_that_of_the_swapped_map() -> None:
    """With all covariances the same, only `e` changes: the likelihoods of the two maps tell which pair is best."""
    for seed in range(4):
        evidence, given = evidence_with(none(), seed)
        evidence = replace(evidence, log_scale_sigma=0.0)
        wrong = with_swap(given, 0, 3)
        log_evidence = {}
        for i in range(COUNT):
            for j in range(i + 1, COUNT):
                other = with_swap(wrong, i, j)
                log_evidence[i, j] = compare(evidence, other.mean, other.covariance, other.given).log_evidence
        swap = swap_of(evidence, wrong)
        assert swap is not None
        assert max(log_evidence, key=lambda pair: log_evidence[pair]) == (swap.first, swap.second)


def swapped(session: Session, first: int, second: int) -> Session:
    """The same session with a map that has two landmarks at each other's place."""
    assert session.given is not None
    given = with_swap(session.given, first, second)
    return replace(session, given=given, problem=replace(session.problem, landmark_mean=given.mean))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_swap_in_a_session(seed: int) -> None:
    session = swapped(make_session(seed), 2, 6)
    _, revision = session.revised()
    assert [(change.landmark_ids, change.kind) for change in revision.changes] == [((2, 6), ChangeKind.SWAPPED)]
    assert revision.changes[0].probability > 0.95
    step = session.given.mean[2] - session.given.mean[6]  # from where the map has the first to where it is
    np.testing.assert_allclose(revision.changes[0].displacement_m, -step, atol=0.05)
    error = revision.estimate.landmark[revision.current] - session.after
    assert np.sqrt((error**2).sum(axis=1)).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_swap_beside_a_move(seed: int) -> None:
    _, revision = swapped(make_session(seed, Move((0, 4, 5), (0.4, -0.3))), 2, 6).revised()
    found = {(change.landmark_ids, change.kind) for change in revision.changes}
    assert found == {((2, 6), ChangeKind.SWAPPED), ((0, 4, 5), ChangeKind.MOVED)}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_two_moves_are_no_swap(seed: int) -> None:
    """Two landmarks that moved towards each other by half of the way, not by the whole."""
    after = make_session(seed).after
    half = 0.5 * (after[6] - after[2])
    half /= max(1.0, np.linalg.norm(half) / 1.5)
    moves = Move((2,), tuple(half)), Move((6,), tuple(-half))  # type: ignore[arg-type]
    _, revision = make_session(seed, *moves).revised()
    found = {(change.landmark_ids, change.kind) for change in revision.changes}
    assert found == {((2,), ChangeKind.MOVED), ((6,), ChangeKind.MOVED)}
