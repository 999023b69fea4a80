"""What looks say of things that may be hidden: clear lines, witnesses, and one closed door before many things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import LivingConfig
from evermap.existence.sites import SiteLooks
from evermap.maps.living import LivingMap, clique_rows
from evermap.maps.sessions.believe import believed
from evermap.maps.sessions.extend import Extended
from evermap.maps.sessions.looks import PlaceLooks, Sighting, Watch, count_sides, looked_at
from evermap.sensing.sightlines import SightLines
from evermap.types import FloatArray, Sensor

from .scenes import begun, found

LEAST_EVIDENCE = LivingConfig().decisions.least_evidence
P_HIDDEN, HIDDEN_LOOKS = LivingConfig().sight.p_hidden, LivingConfig().sight.hidden_looks

SENSOR = Sensor(range_max_m=15.0, bearing_min_rad=-1.5, bearing_max_rad=1.5, p_detect=0.8)
EYE = np.array([0.25, 0.25, 0.0])
ALONE = LivingConfig(cliques=False)


def a_map(place_m: dict[int, tuple[float, float]], clear: tuple[int, ...], p_here: float = 0.95) -> LivingMap:
    """Landmarks that stand alone; the lines from `EYE` to some of them are known to be clear, by twenty looks."""
    living = begun(found([*place_m], [*place_m.values()]), ALONE).living
    names = living.places.site_id, living.places.landmark_id
    place = np.repeat(np.flatnonzero(np.isin(living.places.landmark_id, clear)), 20)
    eye = np.tile(EYE[:2], (len(place), 1))
    lines = SightLines.empty()
    cell = lines.cells(eye, living.places.position_m[place])
    hit = np.arange(len(place)) % 5 > 0
    lines = lines.learned(names, place, cell, hit, np.ones(len(place)))
    sites = replace(living.sites, p_here=np.full(len(living.sites), p_here))
    return replace(living, sites=sites, sightlines=lines, stamp_s=100.0)


def looks_of(living: LivingMap, seen: tuple[int, ...], frames: int = 12) -> PlaceLooks:
    """All from `EYE`, with some landmarks in every frame."""
    place = np.flatnonzero(np.isin(living.places.landmark_id, seen))
    frame = np.repeat(np.arange(frames), len(place))
    sighting = Sighting(1000.0 + np.arange(frames), np.tile(EYE, (frames, 1)), frame, np.tile(place, frames))
    return looked_at(living, living.sites.p_here, Watch.of(sighting, living.places.position_m, SENSOR), LivingConfig())


def evidence(living: LivingMap, looks: PlaceLooks) -> dict[int, float]:
    """By landmark: what looks say for 'it stands there'."""
    none = np.zeros(0, dtype=np.int64)
    entry = Extended(living, living, none, none, living.sites.p_here, np.zeros(len(living.sites), dtype=np.bool_))
    said = believed(entry, looks, SENSOR, (1000.0, 1020.0), ALONE).log_evidence
    cliques, _ = clique_rows(living.sites)
    row = np.searchsorted(cliques, living.members.clique_id)
    return dict(zip(living.members.landmark_id.tolist(), said[row].tolist(), strict=True))


def rows_of_landmark(living: LivingMap, looks: PlaceLooks, landmark: int) -> np.ndarray:
    return living.places.landmark_id[looks.place] == landmark


def test_misses_along_lines_that_are_not_known_to_be_clear_say_nothing() -> None:
    """Of what stands in the nominal field of view, behind a wall for all that is known."""
    living = a_map({1: (6.0, 0.25), 2: (6.0, 4.0)}, clear=(1,))
    looks = looks_of(living, seen=())
    hidden = rows_of_landmark(living, looks, 2)
    assert hidden.sum() == 12
    assert not looks.counts[hidden].any()
    told = evidence(living, looks)
    assert told[2] == pytest.approx(0.0, abs=1e-6)
    assert told[1] < -1.0


def test_what_is_seen_behind_a_place_opens_the_line_to_it() -> None:
    """Nobody ever saw 2, but 3 is seen past it: the miss counts, though 2 may be hidden all the same."""
    place_m = {2: (6.0, 0.25), 3: (9.0, 0.3), 4: (3.0, 0.3)}
    living = a_map(place_m, clear=())
    assert looks_of(living, seen=(3,)).counts[rows_of_landmark(living, looks_of(living, seen=(3,)), 2)].all()
    past = evidence(living, looks_of(living, seen=(3,)))[2]
    assert past <= -LEAST_EVIDENCE
    assert past >= np.log(P_HIDDEN[2]) - 0.1  # no more than 'it is hidden' allows
    # what stands before it opens nothing
    looks = looks_of(living, seen=(4,))
    assert not looks.counts[rows_of_landmark(living, looks, 2)].any()


def test_a_witness_makes_a_miss_say_more() -> None:
    place_m = {1: (6.0, 0.25), 2: (6.0, 0.9), 3: (0.25, 6.0)}
    living = a_map(place_m, clear=(1, 2, 3))
    alone, witnessed = (evidence(living, looks_of(living, seen))[1] for seen in ((3,), (2, 3)))
    assert witnessed < alone - 0.5
    assert looks_of(living, (3,)).sight[0] == 0
    # the others are of another kind of lines: of its own nothing is known but what it says itself
    looks = looks_of(living, (2, 3))
    assert looks.sight.tolist() == [1, 0, 0]
    np.testing.assert_array_equal(looks.share, 1.0)
    assert hidden_of(living, looks, 1) == pytest.approx(P_HIDDEN[1], rel=1e-3)


def p_hidden_of(living: LivingMap, looks: PlaceLooks) -> FloatArray:
    """By line, as the chain takes it."""
    return 1.0 - looks.lines.p_free


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_one_closed_door_over_many_things_is_not_told_as_many_leavings(n: int) -> None:
    """Things in one room that are all missed at once from before its door: with each the door is more probable."""
    behind = {10 + k: (7.0 + 1.1 * (k % 3), -0.8 + 1.3 * (k // 3)) for k in range(n)}
    living = a_map(behind | {50: (6.0, -5.0)}, clear=(*behind, 50))
    looks = looks_of(living, seen=(50,))
    of_door = [evidence(living, looks)[name] for name in behind]
    assert max(of_door) < 0.0
    if n == 1:
        assert of_door[0] <= -LEAST_EVIDENCE
    if n >= 3:
        assert min(of_door) > -LEAST_EVIDENCE / 2.0
    # by hand: they left one by one, or one door hides them; of doors say the prior, and what is seen, by its share
    keys = {int(k) for name in behind for k in looks.rows.key[rows_of_landmark(living, looks, name)]}
    hidden = p_hidden_of(living, looks)[sorted(keys)]
    p_gone = 0.05
    single = share_closed(shown=1.0 / (n + 1))
    by_hand = single / (single + (1.0 - single) * p_gone ** (n - 1))
    np.testing.assert_allclose(hidden, by_hand, rtol=1e-4)


def share_closed(shown: float, missed: int = 0, p_gone: float = 0.05) -> float:
    """Mean share of closed lines, by the moments of its beta distribution, after so many shown and missed."""
    a, b = P_HIDDEN[0] * HIDDEN_LOOKS, (1.0 - P_HIDDEN[0]) * HIDDEN_LOOKS + shown
    moment = np.cumprod(np.append(1.0, (a + np.arange(missed + 1)) / (a + b + np.arange(missed + 1))))
    fits = np.ones(1)
    for _ in range(missed):  # a polynomial in the share
        fits = np.convolve(fits, [p_gone, 1.0 - p_gone])
    return float(fits @ moment[1:] / (fits @ moment[:-1]))


ROOMS_M = {name: (6.0, 20.0 * k + 0.25) for k, name in enumerate((1, 2, 3, 4))}


def looks_in_rooms(
    seen: tuple[int, ...], place_m: dict[int, tuple[float, float]] = ROOMS_M
) -> tuple[LivingMap, PlaceLooks]:
    """Things in rooms that are looked at one after the other, from inside; some are seen."""
    living = a_map(place_m, clear=())
    names = living.places.site_id, living.places.landmark_id
    eyes = np.array([(0.25, 20.0 * round(y / 20.0) + 0.25) for _, y in place_m.values()])
    place = np.repeat(living.place_row(np.array([*place_m]), living.site_of()), 20)
    cell = living.sightlines.cells(np.repeat(eyes, 20, axis=0), living.places.position_m[place])
    hit = np.arange(len(place)) % 5 > 0
    lines = living.sightlines.learned(names, place, cell, hit, np.ones(len(place)))
    living = replace(living, sightlines=lines)
    n = 12 * len(eyes)
    frame = np.flatnonzero(np.isin(np.repeat([*place_m], 12), seen))
    pose = np.column_stack([np.repeat(eyes, 12, axis=0), np.zeros(n)])
    sighting = Sighting(1000.0 + np.arange(n), pose, frame, place[::20][frame // 12])
    watch = Watch.of(sighting, living.places.position_m, SENSOR)
    return living, looked_at(living, living.sites.p_here, watch, LivingConfig())


def hidden_of(living: LivingMap, looks: PlaceLooks, landmark: int) -> float:
    """The probability that one of them is hidden; the same along all lines."""
    found = p_hidden_of(living, looks)[looks.rows.key[rows_of_landmark(living, looks, landmark)]]
    np.testing.assert_allclose(found, found[0])
    return float(found[0])


def test_things_in_different_rooms_are_not_behind_one_door() -> None:
    """Missed from places far from each other: each speaks for itself, and for how many doors are shut."""
    living, looks = looks_in_rooms(())
    for landmark in ROOMS_M:
        assert hidden_of(living, looks, landmark) == pytest.approx(share_closed(0.0, 3), rel=1e-4)


@pytest.mark.parametrize("missed", [(1,), (1, 3), (2, 3, 4)])
def test_how_many_doors_are_shut_is_what_the_others_say(missed: tuple[int, ...]) -> None:
    """A miss is evidence on what is missed, with the probability of a shut door by all others: it counts once."""
    living, looks = looks_in_rooms(tuple(name for name in ROOMS_M if name not in missed))
    np.testing.assert_array_equal(looks.share, 1.0)
    for landmark in missed:
        by_hand = share_closed(4.0 - len(missed), len(missed) - 1)
        assert hidden_of(living, looks, landmark) == pytest.approx(by_hand, rel=1e-4)
    # of what none of them is, all of them say it; and nothing of lines with a witness, or that were unknown
    by_all = share_closed(4.0 - len(missed), len(missed))
    assert looks.p_hidden.tolist() == pytest.approx([by_all, *P_HIDDEN[1:]], rel=1e-3)


def test_what_has_a_witness_is_hidden_by_itself() -> None:
    """No door hides several things if something else is seen beside each; what has none is of another kind."""
    place_m = {1: (6.0, 0.25), 2: (6.0, 0.9), 3: (6.0, -4.0), 4: (6.0, -4.6), 5: (6.0, 5.0), 6: (8.0, -9.0)}
    living = a_map(place_m, clear=(*place_m,))
    looks = looks_of(living, (2, 3, 4, 5))
    assert looks.sight.tolist() == [1, 0, 1, 1, 0, 0]
    np.testing.assert_allclose(looks.share, [1.0, 1.0 / 3.0, 1.0, 1.0, 1.0 / 3.0, 1.0 / 3.0])
    by_hand = P_HIDDEN[1] * HIDDEN_LOOKS / (HIDDEN_LOOKS + 2.0)
    assert hidden_of(living, looks, 1) == pytest.approx(by_hand, rel=1e-3)
    assert hidden_of(living, looks, 6) == pytest.approx(share_closed(2.0 / 3.0), rel=1e-4)


def test_a_glance_says_nothing_of_how_many_doors_are_shut() -> None:
    """Of what is looked at in fewer frames than a witness takes."""
    place_m = {1: (8.0, 3.0), 2: (6.0, -5.0)}
    living = a_map(place_m, clear=(1, 2))
    for frames, shown in ((2, 0.0), (3, 0.5)):
        assert hidden_of(living, looks_of(living, (2,), frames), 1) == pytest.approx(share_closed(shown), rel=1e-4)


def test_what_one_door_hides_says_elsewhere_what_one_thing_says() -> None:
    """Two things that are missed in one room are one shut door for what is missed in another."""
    living, looks = looks_in_rooms((2, 3), {**ROOMS_M, 5: (6.0, 62.25)})
    np.testing.assert_allclose(looks.share, [1.0, 1.0, 1.0, 0.5, 0.5])
    assert hidden_of(living, looks, 1) == pytest.approx(share_closed(2.0, 1), rel=1e-4)
    # both are behind it, or gone
    single = share_closed(2.0, 1)
    for landmark in (4, 5):
        assert hidden_of(living, looks, landmark) == pytest.approx(single / (single + (1.0 - single) * 0.05), rel=1e-4)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_what_is_shown_from_one_place_counts_as_one(n: int) -> None:
    """One open door shows many things; they say of others what one of them says."""
    shown = {20 + k: (5.0 + k, -7.0 + 2.2 * k) for k in range(n)}
    living = a_map({1: (8.0, 3.0), **shown}, clear=(1, *shown))
    looks = looks_of(living, seen=(*shown,))
    assert looks.sight.tolist() == [0] * (n + 1)
    np.testing.assert_allclose(looks.share, 1.0 / (n + 1))
    assert hidden_of(living, looks, 1) == pytest.approx(share_closed(n / (n + 1)), rel=1e-4)


def test_what_is_believed_gone_is_no_witness_of_a_door() -> None:
    """Things that were away before say nothing of a door."""
    behind = {10 + k: (7.0 + 1.1 * k, 0.25 + 0.9 * k) for k in range(4)}
    living = a_map(behind, clear=(*behind,))
    p_here = np.where(living.sites.clique_id == living.members.clique_id[0], 0.95, 0.02)
    away = replace(living, sites=replace(living.sites, p_here=p_here))
    looks = looks_of(away, ())
    assert looks.share[0] == 1.0
    single, p_gone = share_closed(0.0), 0.98
    by_hand = single / (single + (1.0 - single) * p_gone**3)
    assert hidden_of(away, looks, 10) == pytest.approx(by_hand, rel=1e-4)
    assert evidence(away, looks_of(away, ()))[10] <= -1.0
    assert evidence(living, looks_of(living, ()))[10] > -1.0


def test_sight_that_is_not_learned_takes_the_field_of_view_for_the_truth() -> None:
    living = a_map({1: (6.0, 0.25), 2: (6.0, 4.0)}, clear=(1,))
    none = np.zeros(0, dtype=np.int64)
    sighting = Sighting(1000.0 + np.arange(5), np.tile(EYE, (5, 1)), none, none)
    looks = looked_at(
        living,
        living.sites.p_here,
        Watch.of(sighting, living.places.position_m, SENSOR),
        LivingConfig(learn_sight=False),
    )
    assert isinstance(looks.rows, SiteLooks)
    assert looks.counts.all()
    assert len(looks.rows) == 10
    np.testing.assert_array_equal(looks.lines.p_free, 1.0)


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, 1.9, 4.0])
def test_sides_grow_with_the_angle_that_looks_span_in_any_frame(turn_rad: float) -> None:
    """One from one place, one more for each sector that is spanned, three from all around; a clique without looks has
    one."""
    spans = np.deg2rad([0.0, 30.0, 90.0, 300.0])
    angle = np.concatenate([turn_rad + 0.5 * span * np.linspace(-1.0, 1.0, 601) for span in spans])
    clique = np.repeat(np.arange(4), 601)
    away = 7.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    sides = count_sides(clique, away, 5, LivingConfig().looks)
    assert sides == pytest.approx([1.0, 1.5, 2.5, 3.0, 1.0], abs=0.1)
    assert sides[0] == 1.0


def test_a_side_needs_several_looks() -> None:
    angle = np.deg2rad([0.0, 0.0, 90.0, 90.0, 90.0])
    away = np.column_stack([np.cos(angle), np.sin(angle)])
    for clique, wanted in ((np.zeros(5, dtype=np.int64), 1.0), (np.array([0, 0, 0, 1, 1]), 1.0)):
        assert count_sides(clique, away, 2, LivingConfig().looks)[0] == pytest.approx(wanted)
    twice = np.tile(away, (2, 1))
    assert count_sides(np.zeros(10, dtype=np.int64), twice, 1, LivingConfig().looks)[0] == pytest.approx(2.0)
