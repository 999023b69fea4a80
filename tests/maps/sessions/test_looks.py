"""Looks of a session at places that were never detected: which count as misses, and what all of them say."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import LooksConfig
from evermap.maps.sessions.looks import Watch, weigh_misses
from evermap.maps.sessions.spatial import find_looks
from evermap.sensing.in_sight import Positions, weigh_never_seen
from evermap.sensing.visibility import LooksAt
from evermap.types import BoolArray, FloatArray

RULES = LooksConfig()
P_DETECT, FRAMES = 0.9, 4
LEFT, RIGHT, MIDDLE = 0.8 * RULES.flank_rad, -0.8 * RULES.flank_rad, 0.0


def watched(eyes: list[tuple[float, float]], places: FloatArray, seen: BoolArray, frames: int = FRAMES) -> Watch:
    """From each of some positions in some frames, of all places; those that are seen are detected in each."""
    count = len(eyes) * frames
    eye = np.column_stack([np.repeat(np.asarray(eyes), frames, axis=0), np.zeros(count)])
    pose, place = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(len(places)), indexing="ij"))
    listed = LooksAt(pose, place, np.full(len(pose), P_DETECT), seen[place])
    return Watch(np.arange(float(count)), listed, eye)


def around(eye: tuple[float, float], bearings: list[float], ranges: list[float]) -> FloatArray:
    return np.asarray(eye) + np.column_stack([np.cos(bearings), np.sin(bearings)]) * np.asarray(ranges)[:, None]


def p_missed_between(n_seen: int, n_positions: int, frames: int = FRAMES, settings: LooksConfig = RULES) -> float:
    """How probable misses from some positions are, each between others of which some are seen from each, too, but not
    between others themselves.
    """
    place = np.repeat(np.arange(n_seen + 1), n_positions)
    last = place == n_seen
    worth = np.full(len(place), 1.0 - (1.0 - P_DETECT) ** (frames / settings.sticky))
    share = np.array([1.0 - settings.p_flanked_hidden, settings.p_flanked_hidden])
    p = weigh_never_seen(
        Positions(place, worth, ~last, last),
        np.arange(n_seen + 1) == n_seen,
        np.array([1e-9]),
        settings.p_gone,
        settings.flanked_worth * share,
    )
    return max(float(p[-1]), settings.p_always_hidden)


@pytest.mark.parametrize(
    ("bearings", "ranges", "counts"),
    [
        pytest.param([LEFT, RIGHT], [5.0, 5.0], True, id="between two"),
        pytest.param([LEFT, RIGHT], [5.0, 0.9 * RULES.flank_share * 4.9], False, id="one of them is in front"),
        pytest.param([LEFT, RIGHT], [5.0, 1.1 * RULES.flank_share * 4.9], True, id="one is in front, but little"),
        pytest.param([LEFT, 0.5 * LEFT], [5.0, 5.0], False, id="both on one side"),
        pytest.param([RIGHT, 0.5 * RIGHT], [5.0, 5.0], False, id="both on the other side"),
        pytest.param([LEFT, 1.2 * RULES.flank_rad * -1.0], [5.0, 5.0], False, id="one is far to the side"),
    ],
)
def test_a_miss_counts_between_what_is_seen_on_both_sides_of_it(
    bearings: list[float], ranges: list[float], *, counts: bool
) -> None:
    eye = (0.3, 0.2)
    places, seen = around(eye, [*bearings, MIDDLE], [*ranges, 4.9]), np.array([True, True, False])
    watch = watched([eye], places, seen)
    found, p_missed = weigh_misses(watch, places, ~seen, np.ones(3, dtype=np.bool_))
    np.testing.assert_array_equal(found, counts & ~watch.listed.hit)
    np.testing.assert_allclose(p_missed, [1.0, 1.0, p_missed_between(2, 1) if counts else 1.0], rtol=1e-12)
    assert 0.1 < p_missed_between(2, 1) < 0.2


def test_each_position_that_misses_says_less_than_the_one_before() -> None:
    """Three places in a row, ten metres ahead of positions along a line beside it: the middle one is not seen. What one
    position misses another one misses, too, if this is a landmark that is detected seldom.
    """
    places, seen = np.array([[-1.0, 10.0], [0.0, 10.0], [1.0, 10.0]]), np.array([True, False, True])
    apart, p = 3.0 * RULES.elsewhere_m, [1.0]
    for count in (1, 2, 3, 4):
        eyes = [(apart * (k - 0.5 * count), 0.1) for k in range(count)]
        _, p_missed = weigh_misses(watched(eyes, places, seen), places, ~seen, np.ones(3, dtype=np.bool_))
        np.testing.assert_allclose(p_missed, [1.0, p_missed_between(2, count), 1.0], rtol=1e-9)
        p.append(float(p_missed[1]))
    assert (np.diff(np.log(p)) < 0.0).all()
    assert (np.diff(np.log(p), 2) > 0.0).all()
    bounded = RULES.model_copy(update={"p_always_hidden": 0.5})
    assert weigh_misses(watched(eyes, places, seen), places, ~seen, ~seen, bounded)[1][1] == 0.5


def test_few_looks_from_a_position_say_less_than_many() -> None:
    eye = (0.3, 0.2)
    places, seen = around(eye, [LEFT, RIGHT, MIDDLE], [5.0, 5.0, 4.9]), np.array([True, True, False])
    _, p_missed = weigh_misses(watched([eye], places, seen, frames=1), places, ~seen, np.ones(3, dtype=np.bool_))
    np.testing.assert_allclose(p_missed, [1.0, 1.0, p_missed_between(2, 1, frames=1)], rtol=1e-9)
    assert p_missed_between(2, 1, frames=1) > 2.0 * p_missed_between(2, 1)


def test_what_faces_an_unknown_way_must_be_missed_from_around_it() -> None:
    """Of a tag whose orientation is not known, seen from one side only, that is no evidence; from all around it is."""
    sides = np.arange(4) * 0.5 * np.pi
    eyes = [*map(tuple, 5.0 * np.column_stack([np.cos(sides), np.sin(sides)]))]
    places = np.vstack([[0.0, 0.0], around((0.0, 0.0), [*(sides + 0.25 * np.pi)], [1.0] * 4)])
    seen = np.arange(5) > 0
    one_side, known = watched(eyes[:1], places, seen), ~seen
    assert weigh_misses(one_side, places, ~seen, np.zeros(5, dtype=np.bool_))[1][0] == 1.0
    from_all = weigh_misses(watched(eyes, places, seen), places, ~seen, np.zeros(5, dtype=np.bool_))[1][0]
    assert from_all < weigh_misses(one_side, places, ~seen, known)[1][0] < 0.2
    assert from_all < 0.05


def test_beyond_the_usual_range_a_miss_says_nothing() -> None:
    eye = (0.3, 0.2)
    places, seen = around(eye, [LEFT, RIGHT, MIDDLE], [5.0, 5.0, 5.2]), np.array([True, True, False])
    found, p_missed = weigh_misses(watched([eye], places, seen), places, ~seen, np.ones(3, dtype=np.bool_))
    assert not found.any()
    np.testing.assert_array_equal(p_missed, 1.0)


def look_in_the_open(rates: FloatArray, positions: int, seed: int) -> tuple[Watch, FloatArray, BoolArray]:
    """Landmarks far apart around a robot that drives on a line, detected from a share of the positions of their own;
    and which were never detected.
    """
    rng, count = np.random.default_rng(seed), len(rates)
    angle = 2.0 * np.pi * np.arange(count) / count
    places = 100.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    shown = rng.random((positions, count)) < rates
    eye = np.column_stack([0.1 + 1.5 * np.repeat(np.arange(positions), FRAMES), np.zeros((positions * FRAMES, 2))])
    pose, place = (part.ravel() for part in np.meshgrid(np.arange(len(eye)), np.arange(count), indexing="ij"))
    hit = shown[pose // FRAMES, place]
    eye[:, 1] = 0.2
    watch = Watch(np.arange(float(len(eye))), LooksAt(pose, place, np.full(len(pose), P_DETECT), hit), eye)
    return watch, places, np.asarray(~shown.any(axis=0))


def test_a_landmark_is_not_gone_where_others_are_detected_seldom() -> None:
    """Fourteen positions miss one landmark: of others all are seen from nearly everywhere, or each has its own rate."""
    rules = RULES.model_copy(update={"flank_rad": 1e-6})
    p_exists = []
    for rates in (np.full(30, 0.9), np.random.default_rng(5).beta(0.7, 0.7, 30)):
        watch, places, unseen = look_in_the_open(np.append(rates, 0.0), 14, seed=3)
        _, p_missed = weigh_misses(watch, places, unseen, np.ones(31, dtype=np.bool_), rules)
        p_exists.append(1.0 / (1.0 + rules.p_gone / ((1.0 - rules.p_gone) * p_missed[30])))
    assert p_exists[0] < 0.4
    assert p_exists[1] > 0.7


@pytest.mark.parametrize("n_seen", [1, 4, 5])
def test_few_landmarks_say_nothing_of_rates_in_the_open(n_seen: int) -> None:
    rules = RULES.model_copy(update={"flank_rad": 1e-6})
    watch, places, unseen = look_in_the_open(np.append(np.ones(n_seen), 0.0), 9, seed=0)
    counts, p_missed = weigh_misses(watch, places, unseen, np.ones(n_seen + 1, dtype=np.bool_), rules)
    assert (p_missed[-1] < 1.0) == (n_seen >= 5)
    np.testing.assert_array_equal(counts, (n_seen >= 5) & unseen[watch.listed.landmark])


@pytest.mark.parametrize("positions", [4, 5])
def test_few_positions_say_nothing_in_the_open(positions: int) -> None:
    rules = RULES.model_copy(update={"flank_rad": 1e-6})
    watch, places, unseen = look_in_the_open(np.append(np.ones(9), 0.0), positions, seed=0)
    _, p_missed = weigh_misses(watch, places, unseen, np.ones(10, dtype=np.bool_), rules)
    assert (p_missed[-1] < 1.0) == (positions >= 5)


def look_at(frames: int, hertz: float, *, in_turns: bool, seed: int) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Stamps (F,) with jitter, in which frames two cameras look (F, 2), and in which they see something: for spells."""
    rng = np.random.default_rng(seed)
    stamp_s = 100.0 + np.arange(frames) / hertz + rng.uniform(-0.002, 0.002, frames)
    looks = np.ones((frames, 2), dtype=np.bool_)
    if in_turns:
        looks[:, 0], looks[:, 1] = np.arange(frames) % 2 == 0, np.arange(frames) % 2 == 1
    spell = np.arange(frames) // 20
    sees = np.column_stack([spell % 2 == 0, spell % 3 == 0])
    return stamp_s, looks, looks & sees


@pytest.mark.parametrize("in_turns", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_two_cameras_look_at_their_beat_also_where_they_see_nothing(in_turns: bool, seed: int) -> None:
    stamp_s, looks, seen = look_at(400, 10.0, in_turns=in_turns, seed=seed)
    assert not seen[looks].all()
    np.testing.assert_array_equal(find_looks(stamp_s, seen, RULES), looks)


def test_where_a_camera_has_seen_nothing_for_long_it_is_not_known_when_it_looks() -> None:
    stamp_s, looks, seen = look_at(400, 10.0, in_turns=True, seed=0)
    seen[120:320, 1] = False
    found = find_looks(stamp_s, seen, RULES)
    assert not (found & ~looks).any()
    np.testing.assert_array_equal(found[:, 0], looks[:, 0])
    last, first = (int(np.flatnonzero(rows)[k]) for rows, k in ((seen[:120, 1], -1), (seen[:, 1], 0)))
    assert first < last
    assert found[last : last + 2 * 30 + 1, 1].sum() == 31
    assert not found[last + 62 : 318 - 60, 1].any()


def test_a_few_views_tell_no_beat() -> None:
    stamp_s, _, seen = look_at(400, 10.0, in_turns=True, seed=0)
    seen[40:, 1] = False
    assert seen[:, 1].sum() <= 20
    np.testing.assert_array_equal(find_looks(stamp_s, seen, RULES)[:, 1], seen[:, 1])
