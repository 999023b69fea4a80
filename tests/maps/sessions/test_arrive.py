"""Whether a new landmark has appeared or was only not seen yet: by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.config import LooksConfig
from evermap.existence.sites import SiteLooks
from evermap.maps.lives import EVERYWHERE, Life, Lives
from evermap.maps.living import LivingMap
from evermap.maps.sessions.looks import Arrivals, PlaceLooks, arrivals, came_after
from evermap.sensing.sightlines import HEADINGS, Glimpses, SightLines, Views, nominal_lines
from evermap.survival import Exponential
from evermap.types import UNKNOWN, FloatArray, Sensor

from .scenes import begun, found, next_map

LEAST_EXPECTED, STICKY = LooksConfig().least_expected, LooksConfig().sticky

SENSOR = Sensor(
    range_max_m=10.0, bearing_min_rad=-1.5, bearing_max_rad=1.5, p_detect=0.8, mount_robot_sensor=(0.2, 0.0, 0.0)
)
MEAN_S = 40_000.0
NEW_M = np.array([5.0, 0.25])
BEHIND_M = np.array([8.0, 0.25])
EYE = np.array([0.25, 0.25, 0.5 * 2.0 * np.pi / HEADINGS])
"""The middle of a cell and of a heading, from which both are in view."""


def a_map(*, behind_seen: bool = True) -> LivingMap:
    """Landmark 1 stands behind a place that is empty; from `EYE` it was seen five times, past that place."""
    living = begun(found([1, 2], [BEHIND_M.tolist(), [-9.0, -9.0]])).living
    lives = Lives(np.array([UNKNOWN]), np.full((1, 2), EVERYWHERE), (Life(stay=Exponential(1.0 / MEAN_S)),))
    lines = SightLines.empty()
    names = living.places.site_id, living.places.landmark_id
    place = np.full(5, int(np.flatnonzero(living.places.landmark_id == 1)[0]))
    cell = lines.cells(np.tile(EYE[:2], (5, 1)), np.tile(BEHIND_M, (5, 1)))
    if behind_seen:
        lines = lines.learned(names, place, cell, np.ones(5, np.bool_), np.ones(5))
    return replace(living, lives=lives, stamp_s=1000.0, sightlines=lines)


def views_from(pose: FloatArray, frames: int, stamp_s: float, before: Views | None = None) -> Views:
    return (before or Views.empty()).seen_from(np.tile(pose, (frames, 1)), stamp_s)


def come(
    before: LivingMap,
    *,
    stamp_s: float = 21_000.0,
    seen_from_m: FloatArray | None = None,
    p_hidden: FloatArray | None = None,
) -> Arrivals:
    """A session that finds landmark 7 at `NEW_M`, from `seen_from_m`; what it says of closed lines, if anything."""
    after = replace(next_map(before, found([7], [NEW_M.tolist()])).living, stamp_s=stamp_s)
    row = int(np.flatnonzero(after.places.landmark_id == 7)[0])
    site = int(np.searchsorted(after.sites.site_id, after.places.site_id[row]))
    clique = int(np.searchsorted(np.unique(after.sites.clique_id), after.sites.clique_id[site]))
    eye = np.array([20.0, 20.0]) if seen_from_m is None else seen_from_m
    cell = after.sightlines.cells(eye[None], after.places.position_m[row][None])
    one = np.ones(1, dtype=np.bool_)
    rows = SiteLooks(np.array([stamp_s]), np.array([clique]), np.array([site]), np.zeros(1, np.int64), one)
    sight = np.zeros(len(np.unique(after.sites.clique_id)), dtype=np.int64)
    lines, share = nominal_lines(np.ones(1)), np.ones(len(sight))
    p_hidden = before.sightlines.p_hidden if p_hidden is None else p_hidden
    looks = PlaceLooks(rows, np.array([row]), cell, lines, one, one, sight, np.zeros(2), share, p_hidden=p_hidden)
    told = arrivals(before, after, after.stamp_s, looks, SENSOR)
    assert told.site.tolist() == [site]
    return told


def odds_of_a_newcomer(frames: int, rate: float, since_s: float, p_hidden: float) -> float:
    """Came since the look, against stood there and was missed in every other frame."""
    young = 1.0 - np.exp(-since_s / MEAN_S)
    missed = p_hidden + (1.0 - p_hidden) * (1.0 - rate) ** (frames / STICKY)
    return float(young / ((1.0 - young) * missed))


@pytest.mark.parametrize("frames", [3, 4, 9, 60])
@pytest.mark.parametrize("past", [False, True])
def test_the_odds_of_an_arrival_are_those_by_hand(frames: int, past: bool) -> None:
    """Seen from where the robot looked before, a line that is known to be clear now; or where it looked past the place
    at something behind, which may not be along the very line.
    """
    before = replace(a_map(behind_seen=past), views=views_from(EYE, frames, 900.0))
    told = come(before, seen_from_m=None if past else EYE[:2])
    assert told.looked_s.tolist() == [900.0]
    odds = odds_of_a_newcomer(frames, 0.8, 21_000.0 - 900.0, before.sightlines.p_hidden[2 if past else 0])
    assert told.p_appeared[0] == pytest.approx(odds / (1.0 + odds), rel=1e-6)


@pytest.mark.parametrize("past", [False, True])
def test_how_many_lines_are_closed_is_what_the_new_session_says_too(past: bool) -> None:
    """Where it sees all that was seen before, few lines were closed between the two."""
    before = replace(a_map(behind_seen=past), views=views_from(EYE, 60, 900.0))
    p_hidden = np.array([0.01, 0.5, 0.04])
    told = come(before, seen_from_m=None if past else EYE[:2], p_hidden=p_hidden)
    odds = odds_of_a_newcomer(60, 0.8, 21_000.0 - 900.0, p_hidden[2 if past else 0])
    assert told.p_appeared[0] == pytest.approx(odds / (1.0 + odds), rel=1e-6)


def test_the_last_session_that_looked_enough_counts() -> None:
    """Two frames from there later on expect less than two detections: they are no look."""
    other = np.array([0.25, 0.75, EYE[2]])
    before = replace(a_map(), views=views_from(other, 2, 950.0, views_from(EYE, 9, 900.0)))
    assert LEAST_EXPECTED > 2 * 0.8
    assert come(before, seen_from_m=EYE[:2]).looked_s.tolist() == [900.0]
    again = replace(a_map(), views=views_from(other, 5, 950.0, views_from(EYE, 9, 900.0)))
    assert come(again, seen_from_m=EYE[:2], stamp_s=400_000.0).looked_s.tolist() == [950.0]
    soon = come(again, seen_from_m=EYE[:2], stamp_s=13_000.0)
    assert soon.p_appeared[0] < 0.9  # then the first look counts, after which it is most probable
    assert soon.looked_s.tolist() == [900.0]


def test_looks_of_several_sessions_say_together_what_draws_say() -> None:
    random, n = np.random.default_rng(2), 400_000
    since_s, p_missed, p_always = MEAN_S * np.array([2.0, 1.2, 0.3]), np.array([0.3, 0.6, 0.4]), 0.2
    age = random.exponential(MEAN_S, n)
    there = age[:, None] > since_s
    by_chance = random.random((n, 3)) < (p_missed - p_always) / (1.0 - p_always)
    hidden = by_chance | (random.random((n, 1)) < p_always)
    unseen = (~there | hidden).all(axis=1)
    drawn = (~there[unseen]).mean(axis=0)
    assert came_after(np.exp(-since_s / MEAN_S), p_missed, p_always) == pytest.approx(drawn, abs=0.005)


@pytest.mark.parametrize(
    "views",
    [
        Views.empty(),
        views_from(np.array([0.25, 0.25, EYE[2] + np.pi]), 60, 900.0),  # the other way
        views_from(np.array([-9.0, 0.25, EYE[2]]), 60, 900.0),  # from too far
        views_from(np.array([0.25, 4.25, EYE[2]]), 60, 900.0),  # along another line
        views_from(EYE, 2, 900.0),  # hardly
    ],
)
def test_without_an_empty_look_through_a_clear_line_nothing_has_appeared(views: Views) -> None:
    told = come(replace(a_map(), views=views), seen_from_m=np.array([5.0, -3.0]))
    assert told.looked_s.tolist() == [-np.inf]
    assert told.p_appeared.tolist() == [0.0]


def test_a_view_in_the_nominal_field_is_no_look_where_nothing_was_seen_along_it() -> None:
    """A wall may stand between: neither was the landmark seen from near there, nor anything behind its place."""
    before = replace(a_map(behind_seen=False), views=views_from(EYE, 60, 900.0))
    assert come(before, seen_from_m=np.array([5.0, -3.0])).p_appeared.tolist() == [0.0]
    assert come(replace(before, sightlines=a_map().sightlines), seen_from_m=np.array([5.0, -3.0])).p_appeared[0] > 0.5


def test_what_stands_before_a_place_is_not_seen_past_it() -> None:
    """Something was seen along the line, but on this side of the place."""
    before = a_map()
    at = before.places.position_m.copy()
    at[before.places.landmark_id == 1] = [4.0, 0.25]
    before = replace(before, places=replace(before.places, position_m=at), views=views_from(EYE, 60, 900.0))
    assert come(before, seen_from_m=np.array([5.0, -3.0])).p_appeared.tolist() == [0.0]


@given(st.integers(0, 10**6))
def test_views_of_other_places_never_make_an_arrival(seed: int) -> None:
    """Whatever was looked at: a landmark has appeared only if a view was near where it is seen from, or past it."""
    rng = np.random.default_rng(seed)
    n = 40
    pose = np.column_stack([rng.uniform(-12.0, 12.0, (n, 2)), rng.uniform(0.0, 6.3, n)])
    views = Views.empty().seen_from(np.repeat(pose, 5, axis=0), 900.0)
    eye = rng.uniform(-6.0, 10.0, 2)
    told = come(replace(a_map(), views=views), seen_from_m=eye)
    from_near = np.linalg.norm(pose[:, :2] - eye, axis=1) < 0.6 + 2.0
    from_past = np.linalg.norm(pose[:, :2] - EYE[:2], axis=1) < 0.6 + 2.0
    if not (from_near | from_past).any():
        assert told.p_appeared.tolist() == [0.0]
    assert (told.p_appeared[0] > 0.0) == np.isfinite(told.looked_s[0])


def test_where_nobody_looked_before_nothing_has_appeared() -> None:
    told = come(a_map())
    assert told.p_appeared.tolist() == [0.0]


def test_a_session_that_detected_something_at_a_place_did_not_see_it_empty() -> None:
    """Nor is it known of older looks whether what they missed came before or after that; newer ones count."""
    other = np.array([0.25, 0.75, EYE[2]])
    before = replace(a_map(), views=views_from(EYE, 9, 900.0))
    told = come(before, seen_from_m=EYE[:2])
    assert told.p_appeared[0] > 0.5

    def glimpsed(at_m: FloatArray, stamp_s: float, living: LivingMap = before) -> Arrivals:
        glimpses = Glimpses.empty().joined(at_m[None], stamp_s)
        return come(replace(living, glimpses=glimpses), seen_from_m=EYE[:2])

    for stamp_s in (900.0, 950.0):
        there = glimpsed(NEW_M + [0.5, -0.7], stamp_s)
        assert there.looked_s.tolist() == [-np.inf]
        assert there.p_appeared.tolist() == [0.0]
    for at_m, stamp_s in ((NEW_M + [0.5, -0.9], 900.0), (NEW_M, 899.0)):  # beside it; before the look
        np.testing.assert_array_equal(glimpsed(at_m, stamp_s).p_appeared, told.p_appeared)
    newer = glimpsed(NEW_M, 900.0, replace(before, views=views_from(other, 9, 950.0, before.views)))
    assert newer.looked_s.tolist() == [950.0]
    assert 0.0 < newer.p_appeared[0] < 1.0


@pytest.mark.parametrize(("frames", "clear"), [(2, False), (3, True)])
def test_only_enough_looks_along_a_line_that_is_clear_now_are_as_good_as_it(frames: int, clear: bool) -> None:
    """Two frames along it expect less than two detections; the others looked past the place from elsewhere."""
    rate, elsewhere = 0.8, np.array([0.25, 0.75, EYE[2]])
    before = replace(a_map(), views=views_from(elsewhere, 6, 900.0, views_from(EYE, frames, 900.0)))
    told = come(before, seen_from_m=np.array([0.25, -0.25]))
    p_hidden = before.sightlines.p_hidden[0 if clear else 2]
    odds = odds_of_a_newcomer(frames + 6, rate, 21_000.0 - 900.0, p_hidden)
    assert told.p_appeared[0] == pytest.approx(odds / (1.0 + odds), rel=1e-6)


def test_what_is_hidden_in_all_sessions_is_no_more_than_what_is_hidden_in_the_clearest() -> None:
    """One session looked past the place only, a later one along the line that is clear now."""
    elsewhere = np.array([0.25, 0.75, EYE[2]])
    before = replace(a_map(), views=views_from(EYE, 9, 900.0, views_from(elsewhere, 6, -9_000.0)))
    told = come(before, seen_from_m=np.array([0.25, -0.25]))
    since_s, hidden = 21_000.0 - np.array([-9_000.0, 900.0]), before.sightlines.p_hidden[[2, 0]]
    p_missed = hidden + (1.0 - hidden) * 0.2 ** (np.array([6, 9]) / STICKY)
    p_after = came_after(np.exp(-since_s / MEAN_S), p_missed, LooksConfig().lasting * hidden[1])
    assert told.looked_s.tolist() == [900.0]
    assert told.p_appeared[0] == pytest.approx(p_after[1], rel=1e-6)
