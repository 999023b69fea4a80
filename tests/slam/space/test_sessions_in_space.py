"""Sessions in space: partial patrols along a wall of tags that are moved, turned, taken and brought back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap.config import Config, LivingConfig
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.pipeline import run_session, run_slam
from evermap.types import UNKNOWN, ChangeKind, Landmarks, landmark_id_of, rows_of

from .corridors import Site

EAST, WEST, ALL = (5.0, 15.5), (-0.5, 8.0), (-0.5, 15.5)


def changes(session: Session) -> list[tuple[ChangeKind, tuple[int, ...]]]:
    return [(change.kind, change.landmark_ids) for change in session.changes]


def off(session: Session, site: Site) -> np.ndarray:
    """Distances of the tags that are believed to stand from where they are, aligned as a whole."""
    known = session.living.landmarks(p_least=0.5)
    here = site.present[known.landmark_id]
    found, true = known.position_m[here], site.place[known.landmark_id[here]]
    return np.asarray(np.linalg.norm(se3.transform(rigid(found, true), found) - true, axis=1))


@pytest.mark.parametrize(
    ("seed", "odometry"), [*(pytest.param(seed, True, marks=pytest.mark.slow) for seed in (0, 1)), (2, False)]
)
def test_what_was_moved_turned_taken_and_brought_back_is_told_when_it_is_seen(seed: int, odometry: bool) -> None:
    site = Site.of(seed)

    def day(number: int, part: tuple[float, float], living: LivingMap | None) -> Session:
        found = run_session(site.patrol(seed, number, *part, odometry=odometry), living)
        assert found.found
        return found

    first = day(0, ALL, None)
    assert changes(first) == []
    assert off(first, site).max() < 0.05
    second = day(1, WEST, first.living)
    assert changes(second) == []
    site.place[3] += [0.6, 0.0, 0.1]  # at the end that the next patrol does not see
    site.present[14] = False
    third = day(2, EAST, second.living)
    assert changes(third) == [(ChangeKind.VANISHED, (14,))]
    site.turn(5, 1.0)
    fourth = day(3, WEST, third.living)
    told = {change.landmark_ids: change for change in fourth.changes}
    assert {names: change.kind for names, change in told.items()} == dict.fromkeys([(3,), (5,)], ChangeKind.MOVED)
    np.testing.assert_allclose(np.linalg.norm(told[3,].displacement_m), np.hypot(0.6, 0.1), atol=0.03)
    assert told[5,].rotation_rad == pytest.approx(1.0, abs=0.05)
    assert np.linalg.norm(told[5,].displacement_m) < 0.05
    site.present[14] = True
    fifth = day(4, EAST, fourth.living)
    assert changes(fifth) == [(ChangeKind.RETURNED, (14,))]
    p = dict(zip(fifth.living.members.landmark_id.tolist(), fifth.living.p_exists().tolist(), strict=True))
    assert min(p.values()) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_without_identities(seed: int) -> None:
    """A tag that was moved by its neighbour's distance is another one; one that is turned in its place is the same."""
    site, true = Site.of(seed), dict[int, int]()

    def day(number: int, part: tuple[float, float], living: LivingMap | None) -> tuple[Session, list[Any]]:
        patrol = site.patrol(seed, number, *part)
        found = run_session(patrol, living, Config(slam={"unknown_ids": True}))
        assert found.found
        name, real = found.recording.detections.landmark_id, patrol.detections.landmark_id
        assert not (name == UNKNOWN).any()
        for one in np.unique(name).tolist():
            assert true.setdefault(one, int(real[name == one][0])) == int(np.bincount(real[name == one]).argmax())
        return found, [(kind, [true[one] for one in names]) for kind, names in changes(found)]

    first, told = day(0, ALL, None)
    assert told == []
    second, told = day(1, WEST, first.living)
    assert told == []
    site.place[3] += [0.6, 0.0, 0.1]
    site.present[14] = False
    third, told = day(2, EAST, second.living)
    assert told == [(ChangeKind.VANISHED, [14])]
    site.turn(5, 1.0)
    fourth, told = day(3, WEST, third.living)
    expected = (ChangeKind.VANISHED, [3]), (ChangeKind.MOVED, [5]), (ChangeKind.APPEARED, [3])
    assert sorted(told, key=str) == sorted(expected, key=str)
    site.present[14] = True
    _, told = day(4, EAST, fourth.living)
    assert told == [(ChangeKind.RETURNED, [14])]


@pytest.mark.slow
def test_of_a_large_map_a_session_touches_what_is_near() -> None:
    """The same changes and beliefs, whether a map is updated as one or in parts."""
    found = []
    for most in (600, 10):
        config = Config(living=LivingConfig(whole_places=most))
        site, living, told = Site.of(8), None, list[tuple[ChangeKind, tuple[int, ...]]]()
        for day, part in enumerate((ALL, WEST, EAST, WEST)):
            if day == 2:
                site.place[3] += [0.5, 0.0, 0.0]
                site.present[16] = False
            session = run_session(site.patrol(8, day, *part, rename={20: 2}), living, config)
            living = session.living
            told += changes(session)
        assert living is not None
        found.append((told, living.members.landmark_id.tolist(), living.p_exists()))
    assert sorted(found[0][0]) == [(ChangeKind.MOVED, (3,)), (ChangeKind.VANISHED, (16,))]
    assert found[1][:2] == found[0][:2]
    np.testing.assert_allclose(found[1][2], found[0][2], atol=0.05)


def test_beliefs_are_those_of_misses_from_where_tags_can_be_seen() -> None:
    site = Site.of(4)
    living = run_session(site.patrol(4, 0, *ALL)).living
    site.present[[2, 20]] = False
    session = run_session(site.patrol(4, 1, *WEST), living)
    p = dict(zip(session.living.members.landmark_id.tolist(), session.living.p_exists().tolist(), strict=True))
    assert p[2] < 0.2  # something may have hidden it all the time
    assert p[20] > 0.9  # nobody was there
    missed = session.slam.misses
    assert {2} <= set(missed.landmark_id.tolist()) <= set(range(16))
    assert 0.5 < missed.p_detect.mean() < 1.0  # nine of ten are detected


def test_a_map_may_begin_with_a_survey_in_which_a_session_without_odometry_is_located() -> None:
    site = Site.of(5)
    survey = Landmarks.in_space(np.arange(24), site.place.copy(), rotation=site.facing.as_quat())
    site.place[7] += [0.0, 0.0, 0.4]
    recording = site.patrol(5, 1, *ALL, odometry=False)
    session = run_session(recording, replace(LivingMap.begun(survey.as_prior(0.01)), clock=recording.clock))
    assert changes(session) == [(ChangeKind.MOVED, (7,))]
    found, truth = session.slam.trajectory, recording.truth
    assert truth is not None
    at = np.searchsorted(truth.stamp_s, found.stamp_s - 1e-3)
    gap = found.pose_world_robot[:, :3] - truth.pose_world_robot[at, :3]
    assert len(found) > 150
    assert np.sqrt((gap**2).sum(axis=1).mean()) < 0.05


def test_what_nothing_ties_to_the_rest_is_left_out() -> None:
    """By hand, and nothing is seen on the way from one half of the wall to the other."""
    site = Site.of(6)
    recording = site.patrol(6, 0, *ALL, odometry=False)
    assert recording.truth is not None
    at = recording.truth.pose_world_robot[:, 0]
    seen = recording.detections
    blind = (at[seen.frame] > 5.0) & (at[seen.frame] < 10.0)
    names = seen.landmark_id
    between = np.isin(names, np.intersect1d(names[at[seen.frame] <= 5.0], names[at[seen.frame] >= 10.0]))
    kept = ~blind & ~between
    found = run_slam(replace(recording, detections=rows_of(seen, kept)))
    sides = {bool(site.place[name, 0] > 7.5) for name in found.landmarks.landmark_id}
    assert len(sides) == 1
    assert any("nothing connects" in warning for warning in found.warnings)


@pytest.mark.slow
def test_a_second_tag_of_one_identity_keeps_its_name() -> None:
    site, twin = Site.of(7), {20: 2}
    first = run_session(site.patrol(7, 0, *ALL, rename=twin))
    assert landmark_id_of("2#2") in first.living.members.landmark_id
    site.present[4] = False  # something happens
    east = run_session(site.patrol(7, 1, *EAST, rename=twin), first.living)  # the first of them is out of view
    assert changes(east) == []
    west = run_session(site.patrol(7, 2, *WEST, rename=twin), east.living)
    assert changes(west) == [(ChangeKind.VANISHED, (4,))]


def test_recordings_of_plane_and_space_have_maps_of_their_own() -> None:
    recording = Site.of(0).patrol(0, 0, *ALL)
    flat = replace(LivingMap.begun(Landmarks.at([1], [[0.0, 0.0]], sigma_m=0.1)), clock=recording.clock)
    with pytest.raises(DataError, match="a recording in space, the map is of the plane"):
        run_session(recording, flat)
