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
from evermap.maps.sessions.looks import PlaceLooks, Sighting, Watch, looked_at
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
    assert looks_of(living, (2, 3)).sight[0] == 1
    assert looks_of(living, (3,)).sight[0] == 0


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
    # by hand: they left one by one, or one door hides them, with the share that the session itself says
    keys = {int(k) for name in behind for k in looks.rows.key[rows_of_landmark(living, looks, name)]}
    hidden = p_hidden_of(living, looks)[sorted(keys)]
    p_gone = 0.05
    single = hidden_alone(n, p_gone, seen=1)
    by_hand = single / (single + (1.0 - single) * p_gone ** (n - 1))
    np.testing.assert_allclose(hidden, by_hand, rtol=1e-6)


def hidden_alone(missed: int, p_gone: float, seen: int) -> float:
    """Probability of a hidden place, by expectation maximisation of counts: Beta mean of prior and session."""

    p = P_HIDDEN[0]
    for _ in range(5):
        share = p * (1.0 - p_gone) / (p * (1.0 - p_gone) + p_gone)
        p = (P_HIDDEN[0] * HIDDEN_LOOKS + missed * share) / (HIDDEN_LOOKS + missed * share + seen)
    return float(p)


def test_things_in_different_rooms_are_not_behind_one_door() -> None:
    """Missed from places far from each other: each speaks for itself."""
    place_m = {1: (6.0, 0.25), 2: (6.0, 20.25), 3: (6.0, 40.25)}
    living = a_map(place_m, clear=())
    names = living.places.site_id, living.places.landmark_id
    eyes = np.array([(0.25, 0.25), (0.25, 20.25), (0.25, 40.25)])
    place = living.place_row(np.array([1, 2, 3]), living.site_of())
    cell = living.sightlines.cells(np.repeat(eyes, 20, axis=0), living.places.position_m[np.repeat(place, 20)])
    hit = np.arange(60) % 5 > 0
    living = replace(living, sightlines=living.sightlines.learned(names, np.repeat(place, 20), cell, hit, np.ones(60)))
    none = np.zeros(0, dtype=np.int64)
    pose = np.column_stack([np.repeat(eyes, 12, axis=0), np.zeros(36)])
    sighting = Sighting(1000.0 + np.arange(36), pose, none, none)
    looks = looked_at(living, living.sites.p_here, Watch.of(sighting, living.places.position_m, SENSOR), LivingConfig())
    np.testing.assert_allclose(p_hidden_of(living, looks), hidden_alone(3, 0.05, seen=0), rtol=1e-6)


def test_what_is_believed_gone_is_no_witness_of_a_door() -> None:
    """Things that were away before say nothing of a door."""
    behind = {10 + k: (7.0 + 1.1 * k, 0.25 + 0.9 * k) for k in range(4)}
    living = a_map(behind, clear=(*behind,))
    p_here = np.where(living.sites.clique_id == living.members.clique_id[0], 0.95, 0.02)
    away = replace(living, sites=replace(living.sites, p_here=p_here))
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
