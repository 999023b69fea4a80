"""A copy that is displaced alone is left out; what moved and stayed there is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from references import static_evidence

from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.slam.changes.evidence import WindowEvidence, compare
from evermap.slam.changes.explain import GivenMap, MovedGroup
from evermap.slam.changes.search import find_changes
from evermap.slam.changes.weigh import SeenWithin, weigh, without_transients

PRIOR = ChangesConfig()
COUNT, WINDOWS = 6, 4
SIGMA_M = 0.02


def evidence_with(shift: np.ndarray, seed: int) -> tuple[WindowEvidence, GivenMap]:
    """Copies of six landmarks in four windows, displaced by `shift` (WINDOWS, COUNT, 2) and by noise."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-5.0, 5.0, (COUNT, 2))
    plain = static_evidence(position, WINDOWS)
    # the whole is free to be shifted, as from an unknown start
    size = len(plain.pull)
    shared = np.tile(np.eye(2), (size // 2, 1))
    information = np.linalg.inv(SIGMA_M**2 * np.eye(size) + 100.0 * shared @ shared.T)
    e = shift.reshape(-1, 2) + SIGMA_M * rng.normal(size=(size // 2, 2))
    evidence = replace(plain, position=plain.position + e, information=information)
    return evidence, GivenMap(position, np.tile(0.02**2 * np.eye(2), (COUNT, 1, 1)), np.ones(COUNT, bool))


def dropped(evidence: WindowEvidence, given: GivenMap) -> set[tuple[int, int]]:
    """(landmark, window) of the copies left out."""

    def search(evidence, start):
        soft = evidence.soften(0.02)
        comparison = compare(soft, given.mean, given.covariance, given.given)
        found = yield from find_changes(soft, comparison, given.mean, WINDOWS, PRIOR, start=start)
        return comparison, found

    kept = exhaust(without_transients(evidence, given.mean, given, PRIOR, search))
    left = set(zip(kept.landmark.tolist(), kept.window.tolist(), strict=True))
    return set(zip(evidence.landmark.tolist(), evidence.window.tolist(), strict=True)) - left


def none() -> np.ndarray:
    return np.zeros((WINDOWS, COUNT, 2))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
def test_nothing_displaced_nothing_dropped(seed: int) -> None:
    assert dropped(*evidence_with(none(), seed)) == set()


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
@pytest.mark.parametrize("window", [0, 1, 2])
def test_displaced_in_one_window_only(seed: int, window: int) -> None:
    shift = none()
    shift[window, 2] = [0.5, 0.3]
    evidence, given = evidence_with(shift, seed)
    assert dropped(evidence, given) == {(2, window)}
    assert exhaust(weigh(evidence, given, PRIOR, WINDOWS)).groups == ()


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
@pytest.mark.parametrize("since", [0, 1, 2, 3])
def test_lasting_moves_stay(seed: int, since: int) -> None:
    shift = none()
    shift[since:, [2, 4]] = [0.5, 0.3]
    evidence, given = evidence_with(shift, seed)
    assert dropped(evidence, given) == set()
    verdict = exhaust(weigh(evidence, given, PRIOR, WINDOWS))
    assert [(group.members.tolist(), group.window) for group in verdict.groups] == [([2, 4], since)]
    np.testing.assert_allclose(verdict.groups[0].motion[:2], [0.5, 0.3], atol=0.06)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
def test_a_transient_beside_a_lasting_move(seed: int) -> None:
    shift = none()
    shift[1:, [0, 4]] = [-0.4, 0.3]
    shift[2, 3] = [0.6, 0.0]
    evidence, given = evidence_with(shift, seed)
    assert dropped(evidence, given) == {(3, 2)}
    verdict = exhaust(weigh(evidence, given, PRIOR, WINDOWS))
    assert [(group.members.tolist(), group.window) for group in verdict.groups] == [([0, 4], 1)]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
@pytest.mark.parametrize("is_mapped", [True, False])
def test_what_is_seen_elsewhere_in_the_last_window_has_moved(seed: int, is_mapped: bool) -> None:
    """It is not known to have been there again, which is what a temporary displacement is."""
    shift = none()
    shift[3, 2] = [0.5, 0.3]
    evidence, given = evidence_with(shift, seed)
    given = given if is_mapped else GivenMap.empty(COUNT)
    verdict = exhaust(weigh(evidence, given, PRIOR, WINDOWS))
    assert [(group.members.tolist(), group.window) for group in verdict.groups] == [([2], 3)]
    np.testing.assert_allclose(verdict.groups[0].motion[:2], [0.5, 0.3], atol=0.08)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_first_sightings_that_are_a_little_off_are_no_move(seed: int) -> None:
    """A drive begins with what is least certain: on MRCLAM such a landmark had "moved" by .23 m, for certain."""
    shift = none()
    shift[0, 2] = [0.3, 0.2]
    assert not exhaust(weigh(evidence_with(shift, seed)[0], GivenMap.empty(COUNT), PRIOR, WINDOWS)).groups


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_two_that_exchange_their_places_across_the_room_have_moved(seed: int) -> None:
    """Neither turned about what nobody saw again, nor are sightings of the one in the last window errors."""
    shift, apart = none(), np.array([8.0, -6.0])
    shift[1:, 1], shift[3, 4] = apart, -apart
    evidence = evidence_with(shift, seed)[0]
    evidence = evidence.without((evidence.landmark == 4) & (evidence.window == 2))
    verdict = exhaust(weigh(evidence, GivenMap.empty(COUNT), PRIOR, WINDOWS))
    told = {tuple(group.members.tolist()): group for group in verdict.groups}
    assert told.keys() == {(1,), (4,)}
    np.testing.assert_allclose(told[(1,)].motion, [*apart, 0.0], atol=0.1)
    np.testing.assert_allclose(told[(4,)].motion, [*-apart, 0.0], atol=0.1)
    assert verdict.probability > 0.9


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_three_that_moved_apart_at_one_time_are_no_body(seed: int) -> None:
    shift = none()
    shift[2:, [1, 2, 4]] = [[0.9, 0.1], [-0.5, 0.7], [0.1, -0.9]]
    evidence, given = evidence_with(shift, seed)
    verdict = exhaust(weigh(evidence, given, PRIOR, WINDOWS))
    told = [(group.members.tolist(), group.window, group.turns) for group in verdict.groups]
    assert told == [([row], 2, False) for row in (1, 2, 4)]


def test_a_member_of_which_nothing_shows_takes_no_part_in_the_motion() -> None:
    """Two turn by a right angle about their middle; the second is not seen since: the first went by its own way."""
    evidence, given = evidence_with(none(), 0)
    position = np.zeros((COUNT, 2))
    position[[1, 3]] = [[0.0, 0.0], [2.0, 0.0]]
    seen = SeenWithin.of(evidence, given, position)
    whole = MovedGroup(np.array([1, 3]), True, np.array([0.5, 0.0, np.pi / 2]), 2)
    alone = seen.find_motion(whole, np.array([True, False]))
    assert (alone.members.tolist(), alone.turns) == ([1], False)
    np.testing.assert_allclose(alone.motion, [0.5 + 1.0, -1.0, 0.0], atol=1e-12)
    assert seen.find_motion(whole, np.array([True, True])).motion is whole.motion
