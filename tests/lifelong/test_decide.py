"""Stays and changes of hand-made sessions: what is said, of what, and between which two looks it happened."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from evermap.lifelong import decide
from evermap.lifelong.believe import Looks
from evermap.lifelong.extend import Extended
from evermap.maps.lives import Life, Lives
from evermap.maps.living import LivingMap, Stays
from evermap.persistence.sites import SiteLooks
from evermap.survival import Exponential, Mixture
from evermap.survival.named import never_leaves
from evermap.types import UNKNOWN, ChangeKind, MapChange

from .scenes import assert_consistent, begun, found, next_map

AT = {1: (0.0, 0.0), 2: (0.6, 0.0), 8: (5.0, 0.0), 9: (9.0, 9.0)}
"""1 and 2 are one body; 8 and 9 stand alone."""


@dataclass(frozen=True, slots=True)
class Look:
    """At a landmark's place in the map after the session: when, and whether it was seen there."""

    landmark: int
    stamp_s: float
    hit: bool
    at: tuple[float, float] | None = None


@dataclass(slots=True)
class Story:
    """A map that goes through sessions whose beliefs are told."""

    living: LivingMap = field(default_factory=LivingMap)

    def body(self, landmark: int) -> int:
        members = self.living.members
        return int(members.clique_id[members.landmark_id == landmark][0])

    def session(
        self,
        start_s: float,
        stands: dict[int, tuple[float, float]],
        looks: list[Look],
        *,
        away: tuple[int, ...] = (),
        p_away: float = 0.99,
    ) -> tuple[MapChange, ...]:
        """One more session; `stands` are the landmarks it saw, `away` those it no longer believes in."""
        names = sorted(stands)
        place = [self._place_at(name, stands[name]) for name in names]
        of = {n: [look.stamp_s for look in looks if look.landmark == n and look.hit] for n in names}
        entry_of = found(names, [stands[n] for n in names], place=place)
        entry_of = replace(
            entry_of,
            first_s=np.array([min(of[n]) for n in names]),
            last_s=np.array([max(of[n]) for n in names]),
        )
        entry = begun(entry_of) if not len(self.living.places) else next_map(self.living, entry_of)
        before = entry.before
        after = self._believed(entry, {*names}, away, p_away)
        seen = self._looks(after, looks)
        hit = seen.rows.hit
        last = after.sites.seen_s.copy()
        np.maximum.at(last, seen.rows.site[hit], seen.rows.stamp_s[hit])
        since = after.sites.since_s.copy()
        stood = np.append(before.sites.p_here, np.zeros(len(after.sites) - len(before.sites))) >= 0.5
        for site in np.flatnonzero(~stood & (after.sites.p_here >= 0.5)):
            since[site] = seen.rows.stamp_s[hit & (seen.rows.site == site)].min()
        end_s = max([start_s, *(look.stamp_s for look in looks)])
        after = replace(after, stamp_s=end_s, sites=replace(after.sites, since_s=since, seen_s=last))
        self.living = decide.with_stays(before, after, seen, start_s)
        assert_consistent(self.living)
        return decide.changes_between(before, self.living, seen) if len(before.places) else ()

    def stays_of(self, landmark: int) -> Stays:
        return self.living.stays[self.living.stays.clique_id == self.body(landmark)]

    def _place_at(self, landmark: int, at: tuple[float, float]) -> int:
        places = self.living.places
        near = np.linalg.norm(places.position_m - at, axis=1) < 0.1
        rows = np.flatnonzero(near & (places.landmark_id == landmark))
        return int(rows[0]) if len(rows) else -1

    def _believed(self, entry: Extended, names: set[int], away: tuple[int, ...], p_away: float) -> LivingMap:
        after = entry.living
        p_here = entry.p_start.copy()
        bodies = dict(zip(after.members.landmark_id.tolist(), after.members.clique_id.tolist(), strict=True))
        for name in away:
            p_here[after.sites.clique_id == bodies[name]] = (1.0 - p_away) / 4
        for name, row in zip(entry.landmark_id.tolist(), entry.place.tolist(), strict=True):
            if name in names and name not in away:
                p_here[after.sites.clique_id == bodies[name]] = 0.0
                p_here[np.searchsorted(after.sites.site_id, after.places.site_id[row])] = 0.98
        return replace(after, sites=replace(after.sites, p_here=p_here))

    def _looks(self, after: LivingMap, looks: list[Look]) -> Looks:
        """Looks are at the newest place of the landmark, unless they say at which."""
        rows = []
        for look in looks:
            mine = np.flatnonzero(after.places.landmark_id == look.landmark)
            if look.at is not None:
                mine = mine[np.linalg.norm(after.places.position_m[mine] - look.at, axis=1) < 0.1]
            rows.append(int(mine[-1]))
        place = np.array(rows, dtype=np.int64)
        site = np.searchsorted(after.sites.site_id, after.places.site_id[place])
        cliques = np.unique(after.sites.clique_id)
        clique = np.searchsorted(cliques, after.sites.clique_id[site])
        stamp = np.array([look.stamp_s for look in looks], dtype=np.float64)
        hit = np.array([look.hit for look in looks], dtype=np.bool_)
        order = np.lexsort((stamp, clique))
        key = np.zeros(len(place), dtype=np.int64)
        table = SiteLooks(stamp[order], clique[order], site[order], key, hit[order])
        return Looks(table, place[order], np.zeros(1, dtype=np.int64), np.ones(1))


def told() -> Story:
    """After a first session, at 0 to 100 s."""
    story = Story()
    looks = [Look(n, t, hit=True) for n in AT for t in (10.0 + n, 90.0 + n)]
    assert story.session(0.0, AT, looks) == ()
    return story


def seen(*names: int, since_s: float) -> list[Look]:
    return [Look(n, since_s + t + n, hit=True) for n in names for t in (0.0, 40.0)]


def test_the_first_session_begins_stays_of_which_the_beginning_is_unknown() -> None:
    story = told()
    stays = story.living.stays
    assert len(stays) == 3
    assert (stays.elsewhere_s == -np.inf).all()
    assert (stays.gone_s == np.inf).all()
    both = story.stays_of(1)
    assert (both.first_s[0], both.last_s[0]) == (11.0, 92.0)
    np.testing.assert_allclose(both.position_m[0], [0.3, 0.0])


def test_a_sighting_prolongs_a_stay() -> None:
    story = told()
    assert story.session(1000.0, AT, seen(*AT, since_s=1000.0)) == ()
    assert len(story.living.stays) == 3
    assert story.stays_of(9).first_s.tolist() == [19.0]
    assert story.stays_of(9).last_s.tolist() == [1049.0]


def test_who_is_missed_has_left_between_its_last_sighting_and_the_first_miss() -> None:
    story = told()
    rest = {n: AT[n] for n in (1, 2, 9)}
    looks = [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False), Look(8, 1013.0, hit=False)]
    (change,) = story.session(1000.0, rest, looks, away=(8,))
    assert change.kind is ChangeKind.VANISHED
    assert change.landmark_ids == (8,)
    assert (change.stamp_from_s, change.stamp_to_s) == (98.0, 1012.0)
    assert (change.n_hits, change.n_misses) == (0, 2)
    assert change.probability == pytest.approx(1.0 - 0.01 / 4)
    assert np.isnan(change.displacement_m).all()
    stay = story.stays_of(8)
    assert (stay.last_s.tolist(), stay.gone_s.tolist()) == ([98.0], [1012.0])


def test_who_was_seen_once_more_before_it_left_left_after_that() -> None:
    """Misses before the last sighting say nothing of when it left."""
    story = told()
    looks = [
        *seen(1, 2, 9, since_s=1000.0),
        Look(8, 1004.0, hit=False),
        Look(8, 1005.0, hit=True),
        *(Look(8, 1020.0 + k, hit=False) for k in range(9)),
    ]
    (change,) = story.session(1000.0, AT, looks, away=(8,))
    assert change.kind is ChangeKind.VANISHED
    assert (change.stamp_from_s, change.stamp_to_s) == (1005.0, 1020.0)
    stay = story.stays_of(8)
    assert (stay.last_s.tolist(), stay.gone_s.tolist()) == ([1005.0], [1020.0])


def test_who_moved_left_one_stay_and_began_another() -> None:
    story = told()
    moved = AT | {1: (0.0, 4.0), 2: (0.0, 4.6)}  # and turned by a quarter
    looks = [*seen(*AT, since_s=1000.0), Look(1, 1003.0, hit=False, at=AT[1]), Look(2, 1004.0, hit=False, at=AT[2])]
    (change,) = story.session(1000.0, moved, looks)
    assert change.kind is ChangeKind.MOVED
    assert change.landmark_ids == (1, 2)
    assert (change.stamp_from_s, change.stamp_to_s) == (92.0, 1001.0)
    assert change.displacement_m == pytest.approx((-0.3, 4.3))
    assert change.rotation_rad == pytest.approx(np.pi / 2)
    assert (change.n_hits, change.n_misses) == (4, 2)
    assert change.probability == pytest.approx(0.98)
    stays = story.stays_of(1)
    assert stays.last_s.tolist() == [92.0, 1042.0]
    assert stays.gone_s.tolist() == [1003.0, np.inf]
    assert stays.elsewhere_s.tolist() == [-np.inf, 92.0]
    assert stays.first_s.tolist() == [11.0, 1001.0]
    assert stays.site_id[0] != stays.site_id[1]


def test_who_moved_and_whose_old_place_was_not_looked_at_was_gone_when_the_session_began() -> None:
    story = told()
    story.session(1000.0, AT | {8: (5.0, 4.0)}, seen(*AT, since_s=1000.0))
    assert story.stays_of(8).gone_s.tolist() == [1000.0, np.inf]


def test_who_comes_back_to_its_place_has_its_old_site_and_a_new_stay() -> None:
    story = told()
    site = story.living.site_of()
    rest = {n: AT[n] for n in (1, 2, 9)}
    story.session(1000.0, rest, [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False)], away=(8,))
    (change,) = story.session(2000.0, AT, seen(*AT, since_s=2000.0))
    assert change.kind is ChangeKind.RETURNED
    assert change.landmark_ids == (8,)
    assert change.displacement_m == (0.0, 0.0)
    assert change.stamp_to_s == 2008.0
    assert change.stamp_from_s >= 1012.0
    np.testing.assert_array_equal(story.living.site_of(), site)
    assert len(story.living.sites) == 3
    stays = story.stays_of(8)
    assert stays.site_id[0] == stays.site_id[1]
    assert stays.first_s.tolist() == [18.0, 2008.0]
    assert stays.gone_s.tolist() == [1012.0, np.inf]


def test_who_comes_back_elsewhere_is_told_with_where_it_had_been() -> None:
    story = told()
    rest = {n: AT[n] for n in (1, 2, 9)}
    story.session(1000.0, rest, [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False)], away=(8,))
    (change,) = story.session(2000.0, AT | {8: (5.0, 3.0)}, seen(*AT, since_s=2000.0))
    assert change.kind is ChangeKind.RETURNED
    assert change.displacement_m == pytest.approx((0.0, 3.0))


def test_who_was_never_seen_appears_and_came_since_its_place_was_looked_at() -> None:
    story = told()
    new = {4: (5.0, 2.8), 5: (40.0, 40.0)}  # beside 8, and where nobody ever was
    changes = story.session(1000.0, AT | new, seen(*AT, *new, since_s=1000.0))
    (near,) = changes  # of the other nobody knows that it came: the map grew, the world did not change
    assert (near.kind, near.landmark_ids) == (ChangeKind.APPEARED, (4,))
    assert np.isnan(near.displacement_m).all()
    assert 98.0 <= near.stamp_from_s <= 99.0
    assert near.stamp_to_s == 1004.0
    assert story.stays_of(5).elsewhere_s.tolist() == [-np.inf]


def test_a_place_that_was_not_visited_for_long_may_have_had_a_visitor_for_long() -> None:
    """The session in between was in another room: it is no look at the place."""
    story = told()
    story.session(1000.0, {9: AT[9]}, seen(9, since_s=1000.0))
    (change,) = story.session(2000.0, AT | {4: (5.0, 2.8)}, seen(*AT, 4, since_s=2000.0))
    assert change.kind is ChangeKind.APPEARED
    assert change.stamp_from_s <= 99.0
    assert story.stays_of(4).elsewhere_s[0] <= 99.0


def test_two_that_stand_at_each_others_place_are_exchanged() -> None:
    story = told()
    (change,) = story.session(1000.0, AT | {8: AT[9], 9: AT[8]}, seen(*AT, since_s=1000.0))
    assert change.kind is ChangeKind.SWAPPED
    assert change.landmark_ids == (8, 9)
    assert change.n_hits == 4


def test_one_that_takes_the_place_of_another_that_moved_on_is_no_exchange() -> None:
    story = told()
    changes = story.session(1000.0, AT | {8: AT[9], 9: (3.0, 7.0)}, seen(*AT, since_s=1000.0))
    assert sorted((c.kind, c.landmark_ids) for c in changes) == [(ChangeKind.MOVED, (8,)), (ChangeKind.MOVED, (9,))]


def test_nothing_is_told_of_what_was_not_looked_at() -> None:
    story = told()
    before = story.living.stays
    assert story.session(1000.0, {8: AT[8], 9: AT[9]}, seen(8, 9, since_s=1000.0)) == ()
    assert story.stays_of(1).last_s.tolist() == before[before.clique_id == story.body(1)].last_s.tolist()


def test_of_a_body_that_comes_apart_only_what_moved_has_changed() -> None:
    story = told()
    (change,) = story.session(1000.0, AT | {2: (3.0, 3.0)}, [*seen(*AT, since_s=1000.0)])
    assert (change.kind, change.landmark_ids) == (ChangeKind.MOVED, (2,))
    assert change.displacement_m == pytest.approx((2.4, 3.0))


def test_of_a_body_of_which_a_part_was_seen_the_shift_is_that_of_this_part() -> None:
    story = told()
    (change,) = story.session(1000.0, {1: (2.0, 1.0), 8: AT[8], 9: AT[9]}, seen(1, 8, 9, since_s=1000.0))
    assert (change.kind, change.landmark_ids) == (ChangeKind.MOVED, (1,))
    assert change.displacement_m == pytest.approx((2.0, 1.0))


def wandered(times: int) -> LivingMap:
    """8 stands somewhere else in every session."""
    story = told()
    for k in range(times):
        at = AT | {8: (5.0, 2.0 * k + 2.0)}
        story.session(1000.0 * (k + 1), at, seen(*AT, since_s=1000.0 * (k + 1)))
    return story.living


@pytest.mark.parametrize("most", [1, 2, 3])
def test_of_many_sites_of_a_body_the_probable_and_newest_are_remembered(most: int) -> None:
    living = wandered(5)
    body = living.members.clique_id[living.members.landmark_id == 8][0]
    assert (living.sites.clique_id == body).sum() == 6
    kept = decide.without_forgotten(living, most)
    assert_consistent(kept)
    assert kept.sites.site_id[kept.sites.clique_id == body].tolist() == living.sites.site_id[
        living.sites.clique_id == body
    ][-most:].tolist()  # fmt: skip
    # of the others, all; of its history, all
    assert (kept.sites.clique_id != body).sum() == (living.sites.clique_id != body).sum()
    assert len(kept.stays) == len(living.stays)
    rows = living.place_row(kept.places.landmark_id, kept.places.site_id)
    corner = (2 * rows[:, None] + np.arange(2)).ravel()
    np.testing.assert_array_equal(kept.covariance_m2, living.covariance_m2[np.ix_(corner, corner)])
    np.testing.assert_array_equal(kept.places.position_m, living.places.position_m[rows])


def crowd(away: int, life: Life) -> LivingMap:
    """Ten that stand, and some that are away, each gone a second after the one before."""
    names = list(range(10 + away))
    living = begun(found(names, [[5.0 * n, 0.0] for n in names])).living
    bodies = living.members.clique_id
    p_here = np.where(np.arange(len(living.sites)) < 10, 0.99, 0.001)[np.argsort(np.argsort(living.sites.clique_id))]
    lives = Lives(np.array([UNKNOWN]), np.full((1, 2), np.iinfo(np.int64).min), (life,))
    sites = replace(living.sites, p_here=p_here, seen_s=np.arange(len(p_here), dtype=np.float64) + 10.0)
    assert bodies.tolist() == names
    return replace(living, stamp_s=1e5, sites=sites, lives=lives)


def test_who_never_returns_is_forgotten_and_who_does_is_not() -> None:
    for absence, stays in ((never_leaves(), 10), (Exponential(1e-7), 18)):
        kept = decide.without_forgotten(crowd(8, Life(absence=absence)), 3)
        assert_consistent(kept)
        assert len(kept.members) == stays
        assert kept.n_cliques_ever == 18


def test_who_returns_in_half_of_the_cases_is_forgotten_when_it_should_have_been_back() -> None:
    """P(return | still away) = 1 - 0.5 / (0.5 + 0.5 exp(-t / T)): by Bayes below 5 % from about 2.9 T on."""
    absence = Mixture((Exponential(1.0 / 1e4), never_leaves()), (0.5, 0.5))
    living = crowd(8, Life(absence=absence))
    for stamp_s, kept in ((2.0e4, 18), (4.0e4, 10)):
        assert len(decide.without_forgotten(replace(living, stamp_s=stamp_s), 3).members) == kept


def test_of_too_many_that_are_away_the_first_that_went_are_forgotten() -> None:
    kept = decide.without_forgotten(crowd(60, Life(absence=Exponential(1e-7))), 3)
    assert_consistent(kept)
    away = kept.members.landmark_id[10:]
    assert len(away) == decide.MOST_AWAY + 10  # twenty, and as many again as stand somewhere
    assert away.tolist() == list(range(70 - len(away), 70))


def test_what_an_operator_spoke_about_is_never_forgotten() -> None:
    living = crowd(8, Life(absence=never_leaves())).edited(12, pinned=True).edited(13, deleted=True)
    kept = decide.without_forgotten(living, 3)
    assert kept.members.landmark_id.tolist() == [*range(10), 12, 13]


def test_of_old_stays_the_newest_are_kept() -> None:
    living = wandered(1)
    count = decide.MOST_STAYS + 7
    last = np.random.default_rng(0).permutation(count).astype(np.float64)
    name = np.zeros(count, dtype=np.int64)
    many = Stays(name, name, name, np.zeros((count, 2)), last - 2, np.sort(last) - 2, last, last + 1)
    kept = decide.without_forgotten(replace(living, stays=many), 3).stays
    assert len(kept) == decide.MOST_STAYS
    assert kept.last_s.min() == 7.0
    assert (np.diff(kept.first_s) > 0).all()
