"""A session laid over a map, against the probability of every assignment there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.align.candidates import Matches, find_consensus
from evermap.geometry import se2, se3
from evermap.maps.sessions.overlay import ELSEWHERE, USUAL, Known, Overlay, Sighted, _Options, lay_over

from .worlds import Densely, World, sites_of, world


def agreed(one: World) -> np.ndarray:
    """The motion at which all is linearised."""
    known = one.known
    weight = np.maximum(np.exp(known.log_p_site[known.site]), 1e-3)
    source = one.sighted.position_m[known.landmark]
    return find_consensus(Matches.of(source, known.position_m, landmark=known.landmark, weight=weight))[0]


def laid(one: World, search: str = "joint") -> Overlay:
    found = lay_over(one.sighted, one.known, search)
    assert found is not None
    return found


@pytest.mark.parametrize(
    "seed", [*range(6), 46, 66, 127, 147, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 20))]
)
def test_the_most_probable_of_all_assignments_is_found(seed: int) -> None:
    random = np.random.default_rng(seed)
    cliques = int(random.integers(4, 7))
    n_sites = random.integers(1, 3, cliques).tolist()
    site = [ELSEWHERE if c > 2 and random.random() < 0.6 else int(random.integers(k)) for c, k in enumerate(n_sites)]
    drift_m = float(random.choice([0.0, 0.0, 0.05]))
    one = world(random, random.integers(1, 4, cliques).tolist(), n_sites, site, drift_m=drift_m)
    dense = Densely(one.sighted, one.known, agreed(one))
    best, best_drift_m, ahead = dense.best()
    assert ahead > 0.01, "a world in which two assignments are as probable teaches nothing"

    found = lay_over(one.sighted, one.known)

    assert (found is not None) == dense.is_this_place(best, best_drift_m)
    if found is None:
        return
    np.testing.assert_array_equal(sites_of(found, one.known, one.sighted), best)
    assert found.drift_m == best_drift_m


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_in_space_the_most_probable_of_all_assignments_is_found(seed: int) -> None:
    """Where it lies about is known there, and orientations say something of each site."""
    random = np.random.default_rng(300 + seed)
    cliques = int(random.integers(4, 7))
    n_sites = random.integers(1, 3, cliques).tolist()
    site = [ELSEWHERE if c > 2 and random.random() < 0.6 else int(random.integers(k)) for c, k in enumerate(n_sites)]
    drift_m = float(random.choice([0.0, 0.05]))
    one = world(random, random.integers(1, 4, cliques).tolist(), n_sites, site, drift_m=drift_m, dim=3)
    off = np.array([*random.normal(0.0, 0.02, 3), *random.normal(0.0, 0.002, 3)])
    about = se3.retract(one.pose_map_session, off)
    dense = Densely(one.sighted, one.known, about)
    best, best_drift_m, _ = dense.best()
    found = lay_over(one.sighted, one.known, motion=about)
    assert (found is not None) == dense.is_this_place(best, best_drift_m)
    if found is None:
        return
    stands = np.where(best < dense.TURNED, best, ELSEWHERE)
    np.testing.assert_array_equal(sites_of(found, one.known, one.sighted), stands)
    assert found.drift_m == best_drift_m
    for clique in range(cliques):
        options, each = dense.options(clique), []
        for option in options:
            other = best.copy()
            other[clique] = option
            each.append(dense.log_probability(other, best_drift_m))
        share = np.exp(np.array(each) - max(each))
        same = [option == stands[clique] or (option >= dense.TURNED and stands[clique] < 0) for option in options]
        want = share[same].sum() / share.sum()
        np.testing.assert_allclose(found.probability[one.sighted.clique == clique], want, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_probability_is_that_of_a_clique_given_the_others(seed: int) -> None:
    random = np.random.default_rng(100 + seed)
    one = world(random, [1, 2, 1, 1, 2], [1, 1, 2, 1, 1], [0, 0, 1, 0, ELSEWHERE], sigma_m=0.08)
    # one that is only a little off: nudged, or drawn so
    row = int(np.flatnonzero(one.known.landmark == 0)[0])
    one.known.position_m[row] += [0.35, 0.0]
    dense = Densely(one.sighted, one.known, agreed(one))
    found = laid(one)
    chosen = sites_of(found, one.known, one.sighted)
    for clique, sites in enumerate(dense.sites):
        scores = {}
        for option in [*sites, ELSEWHERE]:
            other = chosen.copy()
            other[clique] = option
            scores[option] = dense.log_probability(other, found.drift_m)
        share = np.exp(np.array(list(scores.values())) - max(scores.values()))
        want = share[list(scores).index(int(chosen[clique]))] / share.sum()
        np.testing.assert_allclose(found.probability[one.sighted.clique == clique], want, atol=1e-6)


def test_what_agrees_with_what_stands_is_added_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """From three of sixty to all of them in a few steps, not in sixty: sessions have hundreds."""
    one = world(np.random.default_rng(8), [1] * 60, [1] * 60, [0] * 60)
    options = _Options(one.sighted, one.known, agreed(one), USUAL, 0.9)
    asked = []
    scores = options._scores
    monkeypatch.setattr(options, "_scores", lambda chosen: asked.append(chosen) or scores(chosen))
    every = options.likeliest_sites()
    start = np.where(np.arange(60) < 3, every, ELSEWHERE)
    np.testing.assert_array_equal(options.climb(start), every)
    assert len(asked) <= 8


@settings(max_examples=settings.default.max_examples // 5)
@given(
    st.integers(0, 2**32 - 1), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), st.floats(-np.pi, np.pi)
)  # fmt: skip
def test_where_a_session_begins_does_not_matter(seed: int, x_m: float, y_m: float, turn: float) -> None:
    one = world(np.random.default_rng(seed), [1, 2, 1, 3, 2], [1, 1, 2, 1, 1], [0, 0, 1, ELSEWHERE, 0])
    here = laid(one)
    motion = np.array([x_m, y_m, turn])
    rotation = np.kron(np.eye(len(one.sighted.position_m)), se2.rotation(turn))
    elsewhere = Sighted(
        se2.transform(motion, one.sighted.position_m),
        rotation @ one.sighted.covariance_m2 @ rotation.T,
        one.sighted.clique,
    )
    there = lay_over(elsewhere, one.known)
    assert there is not None
    np.testing.assert_array_equal(there.place, here.place)
    np.testing.assert_allclose(there.probability, here.probability, atol=1e-6)
    pose = se2.compose(there.pose_map_session, motion)
    np.testing.assert_allclose(pose[:2], here.pose_map_session[:2], atol=1e-6)
    assert se2.wrap(pose[2] - here.pose_map_session[2]) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("search", ["joint", "gate", "none"])
def test_the_session_is_found_however_it_began(search: str) -> None:
    one = world(np.random.default_rng(3), [1] * 8, [1] * 8, [0] * 8, sigma_m=0.02)
    gap = se2.between(one.pose_map_session, laid(one, search).pose_map_session)
    assert np.hypot(*gap[:2]) < 0.15
    assert abs(gap[2]) < 0.02


def test_half_of_the_landmarks_that_moved_together_are_told_from_those_that_stay_by_belief() -> None:
    """A frame has no landmark of its own: what moves less often holds it."""
    for stay in ([0, 1, 2, 3], [4, 5, 6, 7]):
        site = [0 if c in stay else ELSEWHERE for c in range(8)]
        p_site = [0.999 if c in stay else 0.6 for c in range(8)]
        one = world(
            np.random.default_rng(5), [1] * 8, [1] * 8, site, p_site=p_site, shift_m=np.array([1.5, -1.0])
        )  # fmt: skip
        found = laid(one)
        assert np.flatnonzero(found.place >= 0).tolist() == stay
        assert np.hypot(*se2.between(one.pose_map_session, found.pose_map_session)[:2]) < 0.3


def test_a_landmark_that_is_back_at_an_old_site_is_there() -> None:
    one = world(np.random.default_rng(8), [1, 1, 1, 2, 1], [1, 1, 1, 2, 3], [0, 0, 0, 0, 1])
    p_site = np.exp(one.known.log_p_site)
    of_last = np.unique(one.known.site[one.known.landmark == 5])
    p_site[of_last] = [0.9, 0.02, 0.02]  # believed to be at its first site, but found at its second
    known = Known(
        one.known.position_m, one.known.covariance_m2, one.known.landmark, one.known.site, np.log(p_site),
        one.known.log_p_elsewhere, one.known.log_turned,
    )  # fmt: skip
    for search in ("joint", "gate"):
        found = lay_over(one.sighted, known, search)
        assert found is not None
        assert known.site[found.place[5]] == of_last[1]
        assert np.unique(known.site[found.place[3:5]]).size == 1


def test_one_of_a_body_that_left_it_is_taken_out_of_it() -> None:
    """Two of three stand where they stood to a centimetre: that the body as a whole was moved explains nothing."""
    one = world(np.random.default_rng(11), [1, 1, 1, 1, 3], [1, 1, 1, 1, 1], [0] * 5, sigma_m=0.01)
    one.sighted.position_m[-1] += [1.2, 0.9]
    found = laid(one)
    assert (found.place[:-1] >= 0).all()
    assert found.place[-1] == ELSEWHERE
    # only the joint search asks who belongs together
    gated = laid(one, "gate")
    assert (gated.place[4:] == ELSEWHERE).all()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("along_m", [0.15, 0.3])
def test_one_of_two_side_by_side_moves_without_the_other(dim: int, along_m: float) -> None:
    """Away from its neighbour, to which it was grouped: no rigid motion changes the distance of two."""
    one = world(np.random.default_rng(31), [1] * 6 + [2], [1] * 7, [0] * 7, sigma_m=0.01, dim=dim)
    line = one.sighted.position_m[7] - one.sighted.position_m[6]
    one.sighted.position_m[7] += along_m * line / np.linalg.norm(line)
    about = None if dim == 2 else one.pose_map_session
    found = lay_over(one.sighted, one.known, motion=about)
    assert found is not None
    assert np.flatnonzero(found.place < 0).tolist() == [7]
    assert found.probability[7] > 0.99
    assert found.drift_m <= 0.02, "what it moved by is no drift of all others"


def test_a_body_taken_apart_pays_for_that_and_for_each_member() -> None:
    """Where all stand, both readings have one density: they differ by the prior alone."""
    one = world(np.random.default_rng(34), [1] * 6 + [3], [1] * 6 + [2], [0] * 7, sigma_m=0.01)
    options = _Options(one.sighted, one.known, agreed(one), USUAL, 0.8)
    whole = np.array([0, 1, 2, 3, 4, 5, 6])
    parted, each = options.take_apart(np.array([6]), whole)
    assert parted.concluded(each).place[6:].tolist() == options.concluded(whole).place[6:].tolist()
    paid = parted.log_probability(each) - options.log_probability(whole)
    assert paid == pytest.approx(np.log(0.2) + 2.0 * one.known.log_p_site[6])


def test_a_move_of_a_few_sigmas_takes_a_body_apart_where_the_odds_are_for_it() -> None:
    one = world(np.random.default_rng(35), [1] * 12 + [2], [1] * 13, [0] * 13, sigma_m=0.003)
    line = one.sighted.position_m[13] - one.sighted.position_m[12]
    one.sighted.position_m[13] += 0.07 * line / np.linalg.norm(line)
    options = _Options(one.sighted, one.known, agreed(one), USUAL, 0.9)
    odds = options.log_odds_apart(np.arange(13))[12]
    assert 1.0 < odds < 8.0
    found = laid(one)
    assert np.flatnonzero(found.place < 0).tolist() == [13]
    assert found.probability[13] == pytest.approx(1.0 / (1.0 + np.exp(-odds)), abs=0.1)


def test_a_body_that_turned_moved_as_one() -> None:
    """Both of its landmarks are elsewhere, as far apart as ever: they are not taken apart."""
    one = world(np.random.default_rng(32), [1] * 6 + [2], [1] * 7, [0] * 7, sigma_m=0.01)
    pair = one.sighted.position_m[6:]
    one.sighted.position_m[6:] = pair.mean(axis=0) + (pair - pair.mean(axis=0)) @ se2.rotation(1.2).T + [0.3, 0.1]
    options = _Options(one.sighted, one.known, agreed(one), USUAL, 0.9)
    found = laid(one)
    assert np.flatnonzero(found.place < 0).tolist() == [6, 7]
    assert options.log_odds_apart(np.array([0, 1, 2, 3, 4, 5, ELSEWHERE]))[6] < -2.0


def test_how_probably_neighbours_are_one_body_is_part_of_the_odds() -> None:
    """That they moved by nearly the same speaks for one body; what was believed before is added to that."""
    one = world(np.random.default_rng(33), [1] * 6 + [2], [1] * 7, [0] * 7, sigma_m=0.01)
    one.sighted.position_m[6:] += [[0.25, 0.0], [0.21, 0.0]]
    moved = np.array([0, 1, 2, 3, 4, 5, ELSEWHERE])

    def log_odds(p_one_body: float) -> float:
        return float(_Options(one.sighted, one.known, agreed(one), USUAL, p_one_body).log_odds_apart(moved)[6])

    assert log_odds(0.5) - log_odds(0.9) == pytest.approx(np.log(5.0))
    assert log_odds(0.9) < -2.0
    assert np.flatnonzero(laid(one).place < 0).tolist() == [6, 7]


def test_a_search_for_nothing_leaves_each_at_its_most_probable_site() -> None:
    p_site = [0.95, 0.95, 0.95, 0.3, 0.6, 0.2]
    one = world(np.random.default_rng(2), [1] * 5, [1, 1, 1, 2, 1], [0, 0, 0, 0, ELSEWHERE], p_site=p_site)
    found = laid(one, "none")
    # the fourth is believed at its second site, where it is not; the fifth to be away: 'none' asks no one
    assert found.place.tolist() == [0, 1, 2, 4, ELSEWHERE]


def test_a_gate_asks_each_by_itself_and_is_misled_where_many_moved_together() -> None:
    """Small shifts of half of the map drag the agreed motion along; only weighed together do they stand out."""
    site = [0] * 4 + [ELSEWHERE] * 4
    p_site = [0.999] * 4 + [0.6] * 4
    one = world(
        np.random.default_rng(21), [1] * 8, [1] * 8, site, p_site=p_site, sigma_m=0.02, shift_m=np.array([0.4, 0.0])
    )
    assert np.flatnonzero(laid(one).place >= 0).tolist() == [0, 1, 2, 3]
    gated = lay_over(one.sighted, one.known, "gate")
    assert gated is None or np.flatnonzero(gated.place >= 0).tolist() != [0, 1, 2, 3]


@pytest.mark.parametrize("drift_m", [0.0, 0.08])
def test_how_well_sessions_agree_is_found_by_their_probability(drift_m: float) -> None:
    one = world(np.random.default_rng(4), [1] * 12, [1] * 12, [0] * 12, sigma_m=0.005, drift_m=drift_m)
    found = laid(one)
    dense = Densely(one.sighted, one.known, agreed(one))
    scores = {d: dense.log_probability(np.arange(12), d) + k * np.log(0.5) for k, d in enumerate(USUAL.drifts_m)}
    assert found.drift_m == max(scores, key=lambda d: scores[d])
    assert found.drift_m == (0.01 if drift_m == 0.0 else 0.08)
    assert (found.place >= 0).all()


def test_another_room_is_not_taken_for_this_one() -> None:
    random = np.random.default_rng(0)
    one = world(random, [1] * 3, [1] * 3, [0] * 3)
    three = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 70.0]])
    assert lay_over(Sighted(three, one.sighted.covariance_m2, one.sighted.clique), one.known) is None


def test_a_place_in_which_two_agree_by_chance_is_not_taken_for_this_one() -> None:
    """That ten of twelve were moved at once is less probable than that the robot is elsewhere."""
    moved = [0, 0] + [ELSEWHERE] * 10
    one = world(np.random.default_rng(1), [1] * 12, [1] * 12, moved, p_site=[0.99] * 12)
    assert lay_over(one.sighted, one.known) is None
    # but where things are moved every day it may well be here
    most = world(np.random.default_rng(1), [1] * 12, [1] * 12, [0] * 5 + [ELSEWHERE] * 7, p_site=[0.6] * 12)
    found = laid(most)
    assert np.flatnonzero(found.place >= 0).tolist() == [0, 1, 2, 3, 4]


def moved_as_one(count: int, stand: int, seed: int = 0) -> World:
    """Singles of which all but `stand` were moved by one and the same motion."""
    one = world(np.random.default_rng(seed), [1] * count, [1] * count, [0] * count)
    together = se2.transform(np.array([5.0, -3.0, 1.2]), one.sighted.position_m[stand:])
    seen = np.vstack([one.sighted.position_m[:stand], together])
    return World(replace(one.sighted, position_m=seen), one.known, one.pose_map_session, one.site)


def test_a_layout_that_fits_in_two_ways_is_not_accepted_and_says_so() -> None:
    even = laid(moved_as_one(8, 4))
    assert even.reason == "two places in the map fit about as well, with 4 and 4 of 8 landmarks"
    # one landmark more, or one half that is believed less, and it is clear again
    more = laid(moved_as_one(9, 5))
    assert not more.reason
    assert np.flatnonzero(more.place >= 0).tolist() == [0, 1, 2, 3, 4]
    believed = moved_as_one(8, 4)
    p = np.repeat([0.5, 0.95], 4)
    surer = replace(believed.known, log_p_site=np.log(p), log_p_elsewhere=np.log(1.0 - p))
    found = lay_over(believed.sighted, surer)
    assert found is not None
    assert not found.reason
    assert np.flatnonzero(found.place >= 0).tolist() == [4, 5, 6, 7]
    assert not laid(moved_as_one(8, 4), "gate").reason


@pytest.mark.parametrize(("p_body", "p_single", "is_found"), [(0.65, 0.98, False), (0.98, 0.65, True)])
def test_a_single_body_must_be_likelier_to_have_stayed_than_what_it_denies(
    p_body: float, p_single: float, is_found: bool
) -> None:
    """A body of three fits itself wherever it is, one landmark beside it tells no heading."""
    one = world(np.random.default_rng(5), [3, 1], [1, 1], [0, ELSEWHERE], sigma_m=0.01, p_site=[p_body, p_single])
    found = lay_over(one.sighted, one.known)
    assert (found is not None) == is_found


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 8))])
def test_bodies_that_moved_together_by_less_than_agreement_do_not_bend_what_stands(seed: int) -> None:
    """The motion that most are near lies between both; either reading is found from there, the likelier is taken."""
    site = [0] * 5 + [ELSEWHERE] * 2
    shift = np.array([0.0, -0.78])
    one = world(np.random.default_rng(seed), [1, 1, 1, 2, 2, 2, 2], [1] * 7, site, sigma_m=0.01, shift_m=shift)
    found = laid(one)
    np.testing.assert_array_equal(sites_of(found, one.known, one.sighted), one.site)


@pytest.mark.parametrize(
    "seed", [403, 405, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (410, 411, 414, 416))]
)
def test_landmarks_that_are_turned_in_their_places_were_moved(seed: int) -> None:
    """Their positions are as of what stands; the most probable of all assignments tells so by their orientations."""
    random = np.random.default_rng(seed)
    one = world(random, [1, 1, 1, 2, 1, 1], [1, 1, 2, 1, 1, 1], [0, 0, 0, 0, 0, 0], dim=3)
    turned = np.flatnonzero(np.isin(one.known.landmark, [1, 6]))
    one.known.log_turned[turned] = -25.0
    dense = Densely(one.sighted, one.known, one.pose_map_session)
    best, drift_m, _ = dense.best()
    assert (best >= dense.TURNED).tolist() == [False, True, False, False, False, True]
    found = lay_over(one.sighted, one.known, motion=one.pose_map_session)
    assert found is not None
    assert found.drift_m == drift_m
    assert np.flatnonzero(found.place < 0).tolist() == [1, 6]
    assert found.probability[[1, 6]].min() > 0.99
