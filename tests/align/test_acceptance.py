"""An alignment is accepted where it is far more probable than chance and than any other one, and says why not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, stats

from evermap.align.acceptance import MOST_JOINT, SIGMA_M, accept_alignment, log_density_of, log_odds_of
from evermap.align.candidates import Matches
from evermap.config import LocalizeConfig
from evermap.geometry import se2, se3
from evermap.geometry.group import PLANE, SPACE, Group, group_of
from evermap.slam.batch import PriorMap, lay_over
from evermap.slam.kernels import N_STATES
from evermap.slam.known_places import FrameSightings, KnownPlaces, LocalTrack

RULES = LocalizeConfig()
GROUPS = pytest.mark.parametrize("group", [PLANE, SPACE], ids=["plane", "space"])


def anywhere(rng: np.random.Generator, count: int, dim: int) -> np.ndarray:
    """Landmarks (count, dim) in a room of 16 m by 16 m, 4 m high."""
    return rng.uniform(0.0, 1.0, (count, dim)) * [16.0, 16.0, 4.0][:dim]


def session(group: Group, seed: int, *, count: int, moved: int, sigma_m: float = 0.05) -> tuple[np.ndarray, ...]:
    """Landmarks of a session, their places, the motion between the two, and which of them were moved anywhere."""
    rng = np.random.default_rng(seed)
    target = anywhere(rng, count, group.point_dim)
    motion = group.exp(
        rng.normal(0.0, 1.0, group.dim) * np.repeat([8.0, 1.5], [target.shape[1], group.dim - len(target[0])])
    )
    now, gone = target + rng.normal(0.0, sigma_m, target.shape), np.sort(rng.permutation(count)[:moved])
    now[gone] = anywhere(rng, moved, group.point_dim)
    return group.transform(group.inverse(motion), now), target, motion, gone


@GROUPS
@pytest.mark.parametrize("seed", range(20))
def test_half_of_the_landmarks_may_have_moved(group, seed) -> None:
    source, target, motion, gone = session(group, seed, count=12, moved=6)
    found = accept_alignment(Matches.of(source, target), RULES)
    assert found, found.reason
    assert np.abs(group.local(motion, found.motion)).max() < 0.3
    assert not (found.agree[np.setdiff1d(np.arange(12), gone)] == 0).any()


@GROUPS
def test_maps_that_share_only_names_are_refused(group) -> None:
    """Of 100 maps in which the names are used for landmarks elsewhere, by chance three or four agree in many."""
    taken, agreed = 0, 0
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        source, target = anywhere(rng, 30, group.point_dim), anywhere(rng, 30, group.point_dim)
        found = accept_alignment(Matches.of(source, target), RULES)
        agreed += found.agree.sum() >= 3
        taken += bool(found)
        assert bool(found) == (not found.reason)
    assert agreed > 15
    assert taken == 0


@GROUPS
@pytest.mark.parametrize("count", [6, 12, 30])
def test_mirrored_maps_are_refused(group, count) -> None:
    """All distances are right, so pairs in the plane and triangles in space fit, and what lies near the mirror, too."""
    mirrored = np.append(-1.0, np.ones(group.point_dim - 1))
    for seed in range(10):
        source, target, _, _ = session(group, seed, count=count, moved=0)
        found = accept_alignment(Matches.of(source * mirrored, target), RULES)
        assert not found, f"{found.agree.sum()} of {count}"


def test_a_layout_that_fits_two_ways_is_ambiguous_and_says_so() -> None:
    """Names that were read off one of two equal racks: either half of the landmarks tells another motion."""
    rng = np.random.default_rng(2)
    rack = rng.uniform(-2.0, 2.0, (5, 2))
    target = np.vstack([rack, rack + [9.0, 0.0]])
    moved = np.array([9.0, 0.0, 0.0])
    source = np.vstack([rack, se2.transform(moved, target[5:])])
    found = accept_alignment(Matches.of(source, target), RULES)
    assert not found
    assert found.reason == "two places in the map fit about as well, with 5 and 5 of 10 landmarks"
    assert found.lead_nats < RULES.lead_nats
    # one more landmark that stands decides
    more = [20.0, 3.0]
    found = accept_alignment(Matches.of(np.vstack([source, more]), np.vstack([target, more])), RULES)
    assert found, found.reason
    assert found.motion == pytest.approx(np.zeros(3), abs=1e-9)


def test_one_landmark_at_either_of_two_places_of_its_own_is_no_other_motion() -> None:
    source, target, motion, _ = session(PLANE, 3, count=6, moved=0)
    landmark, place = np.append(np.arange(6), 2), np.vstack([target, target[2] + [5.0, 1.0]])
    found = accept_alignment(Matches.of(source[landmark], place, landmark=landmark), RULES)
    assert found, found.reason
    assert found.agree.tolist() == [True] * 6 + [False]
    assert np.abs(se2.local(motion, found.motion)).max() < 0.3


@pytest.mark.parametrize(
    ("standing", "count", "accepted"), [(2, 2, False), (3, 3, True), (3, 5, True), (3, 8, False), (5, 12, True)]
)
def test_as_many_must_agree_as_chance_does_not_make(standing, count, accepted) -> None:
    """In a room of 10 m by 12 m; two are fewer than the least number, whatever their odds."""
    corners = np.array([[0.0, 0.0], [10.0, 12.0], [10.0, 0.0], [0.0, 12.0], [4.0, 5.0]])[:standing]
    rng = np.random.default_rng(7)
    target = np.vstack([corners, rng.uniform(1.0, 9.0, (count - standing, 2))])
    step = np.array([[3.0, 1.0], [-3.0, 2.0], [1.0, -3.0], [-2.0, -2.0], [2.0, 3.0], [-1.0, 3.0], [3.0, -1.0]])
    source = target.copy()
    source[standing:] += step[: count - standing]
    found = accept_alignment(Matches.of(source, target), RULES)
    assert int(found.agree.sum()) == standing
    assert found.is_accepted == accepted, (found.log_odds, found.reason)
    if standing == 2:
        assert "only 2 of 2 landmarks" in found.reason
        assert accept_alignment(Matches.of(source, target), RULES, fewest=2)


def test_landmarks_that_hardly_stand_anywhere_weigh_less() -> None:
    source, target, _, _ = session(PLANE, 5, count=8, moved=4)
    sure = accept_alignment(Matches.of(source, target, weight=np.full(8, 0.8)), RULES)
    doubted = accept_alignment(Matches.of(source, target, weight=np.full(8, 0.02)), RULES)
    assert sure
    assert sure.log_odds > doubted.log_odds


def test_agreement_on_one_body_is_not_enough_for_a_pose() -> None:
    source, _, _, _ = session(PLANE, 6, count=5, moved=0, sigma_m=0.01)
    near = Matches.of(0.1 * source, se2.transform(np.array([1.0, 2.0, 0.3]), 0.1 * source), weight=np.full(5, 0.9))
    found = accept_alignment(near, RULES, spread_m=5.0)
    assert not found
    assert found.reason


def test_exact_maps_agree_within_their_covariance_only() -> None:
    """Two surveys of 5 mm each: differences of 20 cm are not theirs, though every landmark is near its place."""
    source, target, _, _ = session(PLANE, 8, count=6, moved=0, sigma_m=0.2)
    assert accept_alignment(Matches.of(source, target), RULES)
    survey = accept_alignment(Matches.of(source, target), RULES, covariance_m2=0.005**2 * np.eye(12))
    assert not survey
    assert "by chance" in survey.reason


def test_one_tag_says_where_it_is_and_two_that_disagree_leave_it_open() -> None:
    place = se3.exp(np.array([[4.0, 1.0, 0.0, 0.1, 0.2, 1.0], [9.0, 5.0, 1.0, -0.3, 0.0, 2.0]]))
    motion = se3.exp(np.array([3.0, -2.0, 0.5, 0.2, 0.1, -1.0]))
    seen = se3.compose(se3.inverse(motion), place)
    both = accept_alignment(Matches.of(seen, place), RULES)
    assert both, both.reason
    assert se3.local(motion, both.motion) == pytest.approx(np.zeros(6), abs=1e-9)
    seen[1] = se3.compose(se3.exp(np.array([0.0, 4.0, 0.0, 0.0, 0.0, 1.0])), seen[1])
    apart = accept_alignment(Matches.of(seen, place), RULES)
    assert not apart


def test_the_odds_are_those_of_an_integral_over_all_motions() -> None:
    """Two landmarks in the plane, by brute force: the motion is as probable anywhere in the room, and at any angle."""
    rng = np.random.default_rng(9)
    source = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 9.0]])
    target = source + rng.normal(0.0, 0.1, source.shape)
    matches, agree = Matches.of(source, target, weight=np.full(3, 0.7)), np.ones(3, dtype=np.bool_)
    found = log_odds_of(np.zeros(3), matches, agree, RULES)
    room_m2 = float(np.prod(np.ptp(np.vstack([source, target]), axis=0)))
    density, middle = stats.norm(0.0, 0.25), source.mean(axis=0)

    def inside(angle: float) -> float:
        """The density of the differences, shifts integrated over in closed form."""
        off = (source - middle) @ se2.rotation(angle).T + middle - target
        at = off - off.mean(axis=0)
        log_density = density.logpdf(at).sum() + 2.0 * 0.5 * math.log(2.0 * math.pi * 0.25**2 / 3.0)
        return math.exp(log_density)

    by_angle = integrate.quad(inside, -0.5, 0.5, epsabs=0.0, epsrel=1e-9)[0]
    here = math.log(by_angle / (room_m2 * 2.0 * math.pi)) + 3.0 * math.log(0.7)
    elsewhere = math.log(RULES.p_another_place) - 3.0 * math.log(room_m2)
    assert found == pytest.approx(here - elsewhere, abs=0.02)


@GROUPS
def test_the_density_with_a_gaussian_motion_is_that_of_scipy(group) -> None:
    rng = np.random.default_rng(11)
    freedom = 2.0 * group.rigid_directions(rng.normal(size=(4, group.point_dim)))
    size = len(freedom)
    root = rng.normal(size=(size, size))
    covariance, error = root @ root.T + np.eye(size), rng.normal(size=size)
    expected = stats.multivariate_normal(np.zeros(size), covariance + freedom @ freedom.T).logpdf(error)
    assert log_density_of(error, np.linalg.cholesky(covariance), freedom, None) == pytest.approx(expected, abs=1e-8)
    assert group_of(group.identity()) is group


def test_standard_deviations_and_the_covariance_that_they_stand_for_give_the_same_odds() -> None:
    place = se3.exp(np.random.default_rng(12).normal(0.0, 2.0, (6, 6)))
    seen = se3.compose(se3.inverse(se3.exp(np.array([3.0, -2.0, 0.5, 0.2, 0.1, -1.0]))), place)
    place[:, :3] += np.random.default_rng(13).normal(0.0, 0.05, (6, 3))
    seen[3:, 3:] = np.nan
    alone = accept_alignment(Matches.of(seen, place), RULES)
    dense = accept_alignment(Matches.of(seen, place), RULES, covariance_m2=SIGMA_M**2 * np.eye(18))
    assert alone, alone.reason
    assert dense.log_odds == pytest.approx(alone.log_odds, abs=1e-9)


@GROUPS
def test_errors_of_the_landmarks_turn_with_them_and_blocks_are_independent(group) -> None:
    source, target, motion, _ = session(group, 5, count=6, moved=0)
    matches, agree, dim = Matches.of(source, target), np.ones(6, dtype=np.bool_), group.point_dim
    root = np.kron(np.eye(6), np.diag([0.5, 0.02, 0.02][:dim])) + np.random.default_rng(0).normal(
        0.0, 0.01, (6 * dim, 6 * dim)
    )
    own, there = root @ root.T, 0.04 * np.eye(6 * dim)
    turn = np.kron(np.eye(6), group.rotation_of(motion))
    expected = log_odds_of(motion, matches, agree, RULES, there + turn @ own @ turn.T)
    assert log_odds_of(motion, matches, agree, RULES, there, own) == pytest.approx(expected, abs=1e-8)
    unturned = log_odds_of(motion, matches, agree, RULES, there + own)
    assert abs(unturned - expected) > 1e-3
    by_blocks = log_odds_of(motion, matches, agree, RULES, np.tile(0.04 * np.eye(dim), (6, 1, 1)), own)
    assert by_blocks == pytest.approx(expected, abs=1e-8)
    alone = log_odds_of(motion, matches, agree, RULES, None, own)
    assert alone == pytest.approx(
        log_odds_of(motion, matches, agree, RULES, SIGMA_M**2 * np.eye(6 * dim) + turn @ own @ turn.T), abs=1e-8
    )


def test_of_very_many_landmarks_the_errors_of_each_are_enough() -> None:
    """Round and independent errors are the same, joint or each by itself."""
    source, target, motion, _ = session(PLANE, 6, count=MOST_JOINT + 1, moved=0)
    matches, agree = Matches.of(source, target), np.ones(MOST_JOINT + 1, dtype=np.bool_)
    own, there = 0.01 * np.eye(2 * len(agree)), np.tile(0.05 * np.eye(2), (len(agree), 1, 1))
    round_ = log_odds_of(motion, matches, agree, RULES, 0.06 * np.eye(2 * len(agree)))
    assert log_odds_of(motion, matches, agree, RULES, there, own) == pytest.approx(round_, abs=1e-6)


@pytest.mark.parametrize(("sigma_m", "is_found"), [(0.02, True), (6.0, False)])
def test_places_that_a_map_hardly_knows_are_no_evidence(sigma_m: float, *, is_found: bool) -> None:
    """Three of them agree; a localiser and a session in a prior map wait for more where each may be anywhere."""
    place, robot = np.array([[2.0, 1.0], [-3.0, 4.0], [4.0, -3.0]]), np.array([0.5, 0.2, 0.7])
    seen = se2.transform(se2.inverse(robot), place)
    places = KnownPlaces.of(np.arange(3), place, np.tile(sigma_m**2 * np.eye(2), (3, 1, 1)), np.ones(3))
    track = LocalTrack(np.zeros(3), RULES)
    reading = np.column_stack([np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])])
    track.see(0.0, FrameSightings(np.arange(3), reading, np.full((3, 2), np.nan)), np.arange(3), np.zeros(N_STATES))
    assert (track.placed(0.0, places) is not None) == is_found
    prior_map = PriorMap(place, np.tile(np.eye(2) / sigma_m**2, (3, 1, 1)), np.ones(3, dtype=np.bool_))
    found = lay_over(prior_map, seen, RULES)
    assert bool(found) == is_found
    assert found.reason == ("" if is_found else "3 of 3 landmarks agree with the map, which may be by chance")
