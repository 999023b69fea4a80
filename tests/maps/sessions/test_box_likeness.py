"""How boxes that are the same, and others in their place, are told apart: rules by hand, and what is learned."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from evermap.config import BoxesConfig, SlamConfig
from evermap.maps.sessions import box_likeness
from evermap.maps.sessions.box_likeness import BoxLikeness, BoxPairs
from evermap.maps.sessions.box_search import MapBoxes
from evermap.maps.sessions.box_visit import SeenBoxes
from evermap.types import FloatArray

SETTINGS = BoxesConfig()
USUAL = BoxLikeness.usual(SETTINGS)
NOTHING = np.zeros(0)
SAME_M, OTHER_M = np.array(SETTINGS.sigma_size_m), np.array(SETTINGS.sigma_class_m)


def pair_boxes(away_m: FloatArray, size_m: FloatArray, p: float = 0.9, turn_rad: float = 0.0) -> BoxPairs:
    """Pairs (N, 1), side by side along x by `away_m` (N,), with differences of sizes (N, 3)."""
    n = len(away_m)
    off_m = np.column_stack([away_m, np.zeros(n)])[:, None]
    spread_m2 = np.tile(0.04 * np.eye(2), (n, 1, 1, 1))
    each, yes = np.ones((n, 1)), np.ones((n, 1), dtype=np.bool_)
    return BoxPairs(away_m[:, None], off_m, spread_m2, size_m[:, None], turn_rad * each, yes, yes, p * each)


def odds(pairs: BoxPairs, likeness: BoxLikeness = USUAL) -> float:
    return float(likeness.log_odds(pairs)[0, 0])


ONE = pair_boxes(np.array([0.1]), np.zeros((1, 3)))


def test_sizes_are_compared_as_those_of_one_box_and_of_two() -> None:
    """The ratio of two normal densities, axis by axis, but for a share that is seen with any size."""
    size_m = np.array([[0.1, 0.05, -0.02]])
    ratio = float(np.prod(stats.norm.pdf(size_m[0], 0.0, SAME_M) / stats.norm.pdf(size_m[0], 0.0, OTHER_M)))
    expected = math.log((1.0 - SETTINGS.odd_share) * ratio + SETTINGS.odd_share)
    assert USUAL.size_nats(pair_boxes(np.zeros(1), size_m))[0, 0] == pytest.approx(expected)
    assert odds(pair_boxes(np.array([0.1]), 8.0 * SAME_M[None])) < odds(ONE) - 1.0
    unknown = pair_boxes(np.zeros(1), np.full((1, 3), np.nan))
    assert USUAL.size_nats(unknown)[0, 0] == pytest.approx(0.0)


def test_no_other_box_is_there_unless_the_former_left() -> None:
    """The more surely a box left, the more probably it is another; where there is room for both, that is no matter."""
    stays, left = (odds(replace(ONE, p=np.full((1, 1), p))) for p in (0.95, 0.5))
    assert stays - left == pytest.approx(math.log(0.95 / 0.05), abs=1e-9)
    apart = replace(ONE, over=np.zeros((1, 1), dtype=np.bool_))
    stays, left = (odds(replace(apart, p=np.full((1, 1), p))) for p in (0.95, 0.5))
    assert stays - left == pytest.approx(math.log(0.95 / 0.5), abs=1e-9)


def test_hazards_that_are_faster_end_more_stays() -> None:
    """The belief to the power of the factor on hazards, in both explanations."""
    hasty = replace(USUAL, haste=3.0)
    same, other = hasty.log_likelihoods(ONE)
    as_believed = USUAL.log_likelihoods(replace(ONE, p=np.full((1, 1), 0.9**3)))
    np.testing.assert_allclose((same, other), as_believed)
    assert odds(ONE, hasty) < odds(ONE)


def test_a_place_that_is_often_taken_again_speaks_for_another_box() -> None:
    assert odds(ONE, replace(USUAL, p_taken=0.9)) < odds(ONE, replace(USUAL, p_taken=0.1)) - 1.0
    assert odds(pair_boxes(np.array([1.0]), np.zeros((1, 3)))) < odds(ONE) - 2.0
    assert odds(replace(ONE, turn_rad=np.full((1, 1), 1.0))) < odds(ONE) - 0.5


@pytest.mark.parametrize(("count", "squared", "usual"), [(4.0, 0.5, 0.1), (300.0, 3.0, 0.5), (2.0, 1e-3, 0.3)])
def test_a_spread_is_the_most_probable_one(count: float, squared: float, usual: float) -> None:
    """Normal numbers with a log-normal prior about the usual spread, against a minimiser."""

    def cost(at: float) -> float:
        prior = 0.5 * ((at - math.log(usual)) / box_likeness.NATS) ** 2
        return count * at + 0.5 * squared * math.exp(-2.0 * at) + prior

    best = optimize.minimize_scalar(cost, bounds=(-8.0, 3.0), method="bounded", options={"xatol": 1e-9}).x
    assert box_likeness._spread(count, squared, usual) == pytest.approx(math.exp(best), rel=1e-5)


def test_nothing_seen_leaves_the_usual_spread() -> None:
    assert box_likeness._spread(0.0, 0.0, 0.2) == pytest.approx(0.2)


def test_how_often_places_are_taken_again_is_learned() -> None:
    """Of 60 boxes the half are others: hazards were faster, or places are taken more often, than was believed."""
    p = np.full(60, 0.9)
    fast = box_likeness._turnover(p, np.repeat([1.0, 0.0], 30), NOTHING, SETTINGS)
    slow = box_likeness._turnover(p, np.ones(60), NOTHING, SETTINGS)
    assert fast[0] > 3.0 > 1.5 > slow[0]
    assert fast[1] > slow[1]


def test_places_that_stay_empty_are_seldom_taken_again() -> None:
    """Of 60 places 30 have another box: beside none that are empty all are taken, beside 90 one in four."""
    p, p_same = np.full(60, 0.5), np.repeat([1.0, 0.0], 30)
    full = box_likeness._turnover(p, p_same, NOTHING, SETTINGS)
    empty = box_likeness._turnover(p, p_same, np.full(90, 0.5), SETTINGS)
    assert full[1] > 0.7
    assert empty[1] < 0.35
    assert empty[0] > full[0] * 1.5  # three in four are not there: faster than was believed
    gone = box_likeness._turnover(p, p_same, np.full(90, 1e-6), SETTINGS)
    assert gone[0] == pytest.approx(full[0], rel=0.4)  # what was known to have left says nothing of hazards


def test_a_box_that_is_missed_has_not_left() -> None:
    """One in ten is not detected at its place (`p_stands`)."""
    usual = box_likeness._turnover(np.full(90, 0.99), np.ones(90), np.full(10, 0.99), SETTINGS)
    surely = box_likeness._turnover(
        np.full(90, 0.99), np.ones(90), np.full(10, 0.99), SETTINGS.model_copy(update={"p_stands": 0.999})
    )
    assert usual[0] < 2.0 < surely[0]


def lay_boxes(at_m: list[float], p: list[float]) -> MapBoxes:
    """A map's boxes along x, 1.7 m wide."""
    n = len(at_m)
    position_m = np.column_stack([at_m, np.zeros((n, 2))])
    return MapBoxes(
        np.arange(n), np.arange(n), np.zeros(n, dtype=np.int64), position_m, np.zeros((n, 3, 3)), np.zeros(n),
        np.tile([4.2, 1.7, 1.5], (n, 1)), np.array(p), SETTINGS, SlamConfig(),
    )  # fmt: skip


def test_a_place_counts_once_as_empty_and_only_beside_what_was_seen() -> None:
    """One box is seen; of two that stood at 10 m the one that more probably does counts; 40 m are too far."""
    known = lay_boxes([0.0, 10.2, 10.0, 40.0], [0.9, 0.1, 0.6, 0.9])
    away_m = np.abs(known.position_m[None, :, 0])
    pairs = BoxPairs(away_m, *(np.zeros((1, 4)),) * 4, away_m < 1.0, away_m < 1.0, known.p[None])
    assert box_likeness._find_empty(pairs, known).tolist() == [2]


def see_boxes(known: MapBoxes, rows: list[int], longer_m: float) -> SeenBoxes:
    """Boxes where some of the map's stand, that much longer."""
    n = len(rows)
    place, zeros = np.arange(n), np.zeros(n)
    return SeenBoxes(
        place, zeros.astype(np.int64), place, known.position_m[rows], np.zeros((n, 3, 3)), zeros,
        known.size_m[rows] + [longer_m, 0.2, 0.2], zeros, zeros, zeros + np.nan, zeros + np.nan, zeros + 1.0,
    )  # fmt: skip


def test_empty_places_beside_others_are_learned_from() -> None:
    """On every third place stands another box: where the others are empty, places are seldom taken again."""
    known = lay_boxes((8.0 * np.arange(30)).tolist(), [0.5] * 30)
    seen = see_boxes(known, list(range(0, 30, 3)), 2.0)
    beside = box_likeness.learn_likeness(seen, known, np.zeros(10))
    alone = lay_boxes((24.0 * np.arange(10)).tolist(), [0.5] * 10)
    full = box_likeness.learn_likeness(see_boxes(alone, list(range(10)), 2.0), alone, np.zeros(10))
    assert beside.p_taken < 0.4 < 0.5 < full.p_taken


def test_of_two_explanations_the_one_with_the_empty_places_is_more_probable() -> None:
    p_empty = np.array([0.5, 0.2])
    often, seldom = (replace(USUAL, p_taken=one) for one in (0.9, 0.1))
    for one in (often, seldom):
        more = box_likeness._log_posterior(one, ONE, USUAL, p_empty) - box_likeness._log_posterior(
            one, ONE, USUAL, NOTHING
        )
        expected = np.log(p_empty * (1.0 - SETTINGS.p_stands) + (1.0 - p_empty) * (1.0 - one.p_taken)).sum()
        assert more == pytest.approx(expected)


def test_no_boxes_leave_hazards_and_places_as_usual() -> None:
    haste, p_taken = box_likeness._turnover(NOTHING, NOTHING, NOTHING, SETTINGS)
    assert haste == pytest.approx(1.0)
    assert p_taken == pytest.approx(SETTINGS.p_taken, abs=0.02)


def test_spreads_of_sizes_are_learned_from_both_kinds_of_pairs() -> None:
    """A detector that repeats sizes three times as well as is usual; one in four is another box."""
    rng = np.random.default_rng(0)
    n_same, n_other = 90, 30
    size_m = np.vstack([rng.normal(0.0, SAME_M / 3.0, (n_same, 3)), rng.normal(0.0, OTHER_M, (n_other, 3))])
    away_m = np.abs(np.append(rng.normal(0.0, 0.1, n_same), rng.normal(0.0, 0.5, n_other)))
    pairs = pair_boxes(away_m, size_m, p=0.8)
    found = box_likeness._maximise(USUAL, pairs, USUAL, np.zeros(0))
    np.testing.assert_allclose(found.same_size_m, SAME_M / 3.0, rtol=0.25)
    p_same = 1.0 / (1.0 + np.exp(-found.log_odds(pairs)[:, 0]))
    assert (p_same[:n_same] > 0.5).mean() > 0.97
    assert p_same[n_same:].mean() < p_same[:n_same].mean() - 0.3


def test_boxes_are_compared_pair_by_pair() -> None:
    """Two boxes of a session, one of which was seen to come, with two of a map that are wider and turned."""
    known = lay_boxes([0.0, 5.0], [0.9, 0.3])._replace(
        class_id=np.array([0, 1]), heading_rad=np.array([0.1, 0.1]), covariance_m2=np.tile(0.03 * np.eye(3), (2, 1, 1)),
        size_m=np.array([[4.2, 2.0, 1.8], [4.2, np.nan, 1.8]]),
    )  # fmt: skip
    seen = replace(
        see_boxes(known, [0, 1], 0.0), class_id=np.array([0, 0]), heading_rad=np.array([0.3, 0.3 + np.pi]),
        size_m=np.array([[4.0, 1.6, 1.4], [4.0, 1.6, 1.4]]), covariance_m2=np.tile(0.02 * np.eye(3), (2, 1, 1)),
        position_m=np.array([[1.05, 0.0, 7.0], [5.0, 0.29, 7.0]]), since_s=np.array([np.nan, 12.0]),
    )  # fmt: skip
    pairs = BoxPairs.of(seen, known, np.array([0.0, 0.5]))
    np.testing.assert_allclose(pairs.off_m, [[[1.05, 0.0], [-3.95, 0.0]], [[5.0, 0.29], [0.0, 0.29]]])
    np.testing.assert_allclose(pairs.away_m, np.hypot(*np.moveaxis(pairs.off_m, 2, 0)))
    variance = 0.05 + SETTINGS.drift_m**2
    for row, more in enumerate((0.0, 0.25)):
        np.testing.assert_allclose(pairs.spread_m2[row], [(variance + more) * np.eye(2)] * 2)
    np.testing.assert_allclose(pairs.size_m[0], [[-0.2, -0.4, -0.4], [-0.2, np.nan, -0.4]])
    np.testing.assert_allclose(pairs.turn_rad, np.full((2, 2), 0.2))  # a box looks the same from behind
    # over each other: closer than a share of the mean of their widths, 1.08 m; .3 m where one is not known
    np.testing.assert_array_equal(pairs.over, [[True, False], [False, True]])
    wider = BoxPairs.of(replace(seen, position_m=seen.position_m + [0.04, 0.02, 0.0]), known, np.zeros(2))
    np.testing.assert_array_equal(wider.over, np.zeros((2, 2), dtype=np.bool_))
    np.testing.assert_array_equal(pairs.alike, [[True, False], [True, False]])
    np.testing.assert_allclose(pairs.p, [[0.9, 0.3], SETTINGS.returns * np.array([0.1, 0.7])])
