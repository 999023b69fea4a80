"""Stays and changes of hand-made sessions: what is told, of what, and between which two looks it happened."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.existence.sites import Evidence, SiteLooks
from evermap.maps.lives import Life, Lives
from evermap.maps.living import LivingMap, Stays
from evermap.maps.sessions import decide
from evermap.maps.sessions.believe import Believed, Witnessed
from evermap.maps.sessions.extend import Extended
from evermap.maps.sessions.looks import Arrivals, PlaceLooks
from evermap.sensing.sightlines import nominal_lines
from evermap.survival import Exponential, Mixture
from evermap.survival.hazards import never_leaves
from evermap.types import UNKNOWN, ChangeKind, FloatArray, MapChange, landmark_id_of, rows_of

from .scenes import assert_consistent, begun, found, next_map

AT = {1: (0.0, 0.0), 2: (0.6, 0.0), 8: (5.0, 0.0), 9: (9.0, 9.0)}
"""1 and 2 are one body; 8 and 9 stand alone."""


@dataclass(frozen=True, slots=True)
class Look:
    """At a landmark's place in the map after the session: when, and whether it was seen there.

    A miss counts where the line of sight is known to be clear.
    """

    landmark: int
    stamp_s: float
    hit: bool
    at: tuple[float, float] | None = None
    counts: bool = True


def beliefs(living: LivingMap, log_evidence: FloatArray) -> Believed:
    """Those that a map has, as if a session had said so."""
    return Believed(living.stamp_s, living.places, living.sites, log_evidence, Evidence.empty())


@dataclass(slots=True)
class Story:
    """A map that goes through sessions whose beliefs are told; lines to what is looked at are clear with `p_free`, and
    each body counts `share` for how many are hidden.
    """

    living: LivingMap = field(default_factory=LivingMap)
    p_free: float = 1.0
    share: float = 1.0

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
        log_evidence: dict[int, float] | None = None,
        kept: dict[int, float] | None = None,
        arrived: dict[int, tuple[float, float]] | None = None,
        anew: tuple[int, ...] = (),
    ) -> tuple[MapChange, ...]:
        """One more session.

        Args:
            start_s: when it began.
            stands: the landmarks that it saw, and where.
            looks: at their places, and at those of others.
            away: those it no longer believes in, with `p_away`.
            p_away: in these.
            log_evidence: what looks said for a landmark's body; -5 for those that are away, 5 for the others.
            kept: the probability that a landmark which is seen has never left since, as a share of that of its site;
                0 for those of which the last stay ended, 1 for all others.
            arrived: when earlier looks found the place of a new landmark empty, and how probably it came since.
            anew: landmarks that have a new place, however near to their old one.
        """
        names = sorted(stands)
        place = [-1 if name in anew else self._place_at(name, stands[name]) for name in names]
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
        after = replace(after, sites=replace(after.sites, p_kept=self._kept(before, after, kept or {})))
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
        said = np.full(len(np.unique(after.sites.clique_id)), 5.0)
        for name in (*away, *(log_evidence or {})):
            said[self._row_of(after, name)] = (log_evidence or {}).get(name, -5.0)
        came = self._arrivals(after, arrived or {})
        self.living, changes = decide.decided(before, after, beliefs(after, said), seen, came, start_s)
        assert_consistent(self.living)
        assert (self.living.sites.p_kept <= self.living.sites.p_here).all()
        return changes

    @staticmethod
    def _row_of(living: LivingMap, landmark: int) -> int:
        """Of its body."""
        body = living.members.clique_id[living.members.landmark_id == landmark]
        return int(np.searchsorted(np.unique(living.sites.clique_id), body)[0])

    @staticmethod
    def _kept(before: LivingMap, after: LivingMap, kept: dict[int, float]) -> FloatArray:
        share = np.ones(len(after.sites))
        for clique in np.unique(before.stays.clique_id):
            if np.isfinite(before.stays.gone_s[before.stays.clique_id == clique]).all():
                share[after.sites.clique_id == clique] = 0.0
        for name, value in kept.items():
            share[after.sites.clique_id == after.members.clique_id[after.members.landmark_id == name]] = value
        return share * after.sites.p_here

    @staticmethod
    def _arrivals(after: LivingMap, arrived: dict[int, tuple[float, float]]) -> Arrivals:
        site = [int(after.places.site_id[after.places.landmark_id == name][-1]) for name in arrived]
        looked, p_appeared = np.array([*arrived.values()]).reshape(-1, 2).T
        return Arrivals(np.searchsorted(after.sites.site_id, site), looked, p_appeared)

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

    def _looks(self, after: LivingMap, looks: list[Look]) -> PlaceLooks:
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
        counts = np.array([look.counts for look in looks], dtype=np.bool_)
        lines = nominal_lines(np.ones(1))._replace(p_free=np.array([self.p_free]))
        sight = np.zeros(len(cliques), dtype=np.int64)
        share = np.full(len(cliques), self.share)
        return PlaceLooks(table, place[order], key, lines, (hit | counts)[order], hit[order], sight, np.zeros(2), share)


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


def test_who_is_new_has_appeared_only_if_its_place_was_seen_empty() -> None:
    """Of the others nobody knows that they came: the map grew, the world did not change."""
    story = told()
    new = {4: (5.0, 2.8), 5: (40.0, 40.0), 6: (-9.0, 3.0)}
    (change,) = story.session(
        1000.0, AT | new, seen(*AT, *new, since_s=1000.0), arrived={4: (98.5, 0.9), 6: (98.5, 0.4)}
    )
    assert (change.kind, change.landmark_ids) == (ChangeKind.APPEARED, (4,))
    assert change.probability == pytest.approx(0.9 * 0.98)
    assert np.isnan(change.displacement_m).all()
    assert (change.stamp_from_s, change.stamp_to_s) == (98.5, 1004.0)
    assert (change.n_hits, change.n_misses) == (2, 0)
    assert story.stays_of(4).elsewhere_s.tolist() == [98.5]
    for name in (5, 6):
        assert story.stays_of(name).elsewhere_s.tolist() == [-np.inf]
        assert story.stays_of(name).first_s.tolist() == [1000.0 + name]


@pytest.mark.parametrize("later_s", [1e3, 1e8])
def test_age_alone_is_never_told(later_s: float) -> None:
    """Nobody looked at 8 for years: hardly anybody believes in it, and nothing is said of it."""
    story = told()
    rest = {n: AT[n] for n in (1, 2, 9)}
    looks = seen(1, 2, 9, since_s=later_s)
    assert story.session(later_s, rest, looks, away=(8,), log_evidence={8: 0.0}) == ()
    assert story.stays_of(8).gone_s.tolist() == [np.inf]
    assert story.stays_of(8).p_gone.tolist() == [0.0]
    # and seen again it has never left
    assert story.session(2.0 * later_s, AT, seen(*AT, since_s=2.0 * later_s), kept={8: 0.01}) == ()
    assert story.stays_of(8).first_s.tolist() == [18.0]
    assert story.stays_of(8).gone_s.tolist() == [np.inf]


def test_misses_along_lines_that_are_not_known_to_be_clear_are_no_looks() -> None:
    story = told()
    rest = {n: AT[n] for n in (1, 2, 9)}
    looks = [*seen(1, 2, 9, since_s=1000.0), *(Look(8, 1010.0 + k, hit=False, counts=False) for k in range(9))]
    assert story.session(1000.0, rest, looks, away=(8,)) == ()
    assert story.stays_of(8).gone_s.tolist() == [np.inf]


@pytest.mark.parametrize(
    ("p_free", "misses", "looks"), [(0.4, 2, 0), (0.4, 3, 1), (0.8, 1, 0), (0.95, 1, 1), (0.3, 9, 3)]
)
def test_a_miss_counts_by_how_probably_its_line_was_clear(p_free: float, misses: int, looks: int) -> None:
    """What is told has the number of looks that its misses are worth; for less than one nothing is told."""
    story = told()
    story.p_free = p_free
    rest = {n: AT[n] for n in (1, 2, 9)}
    looked = [*seen(1, 2, 9, since_s=1000.0), *(Look(8, 1012.0 + k, hit=False) for k in range(misses))]
    changes = story.session(1000.0, rest, looked, away=(8,))
    assert [change.n_misses for change in changes] == [looks] * (looks > 0)
    assert np.isinf(story.stays_of(8).gone_s[0]) == (looks == 0)


@pytest.mark.parametrize(("log_evidence", "tells"), [(-1.4, False), (-1.6, True)])
def test_looks_that_say_little_against_a_body_end_no_stay(log_evidence: float, tells: bool) -> None:
    story = told()
    rest = {n: AT[n] for n in (1, 2, 9)}
    looks = [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False)]
    changes = story.session(1000.0, rest, looks, away=(8,), log_evidence={8: log_evidence})
    assert [change.kind for change in changes] == [ChangeKind.VANISHED] * tells
    assert np.isinf(story.stays_of(8).gone_s[0]) != tells
    assert story.stays_of(8).p_gone[0] == pytest.approx((1.0 - 0.01 / 4) if tells else 0.0)


def test_a_doubt_is_kept_with_the_stay_until_it_is_seen_again() -> None:
    story = told()
    story.share = 0.25
    rest = {n: AT[n] for n in (1, 2, 9)}
    looks = [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False)]
    story.living = replace(story.living, sites=replace(story.living.sites, p_here=np.full(3, 0.7)))
    assert story.session(1000.0, rest, looks, log_evidence={8: -2.0}) == ()
    assert story.stays_of(8).p_gone.tolist() == pytest.approx([0.3])
    assert story.stays_of(8).gone_s.tolist() == [np.inf]
    hidden = story.living.sightlines.hidden.copy()
    assert story.session(2000.0, AT, seen(*AT, since_s=2000.0), kept={8: 0.5}) == ()
    assert story.stays_of(8).p_gone.tolist() == [0.0]
    # if it had not left it was hidden; and now it was shown
    assert story.living.sightlines.hidden[0] - hidden[0] == pytest.approx(0.25 * 0.5 * 0.3)


def vanished() -> Story:
    """Of which 8 was told to have vanished, after 98 s, before 1012 s."""
    story = told()
    rest = {n: AT[n] for n in (1, 2, 9)}
    (change,) = story.session(1000.0, rest, [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False)], away=(8,))
    assert change.kind is ChangeKind.VANISHED
    return story


@pytest.mark.parametrize("share", [0.0, 0.2, 0.49, 0.51, 0.9, 1.0])
def test_who_was_told_to_have_vanished_and_is_seen_where_it_was_has_returned_only_if_it_had_left(share: float) -> None:
    """Otherwise it was hidden: its stay goes on, nothing is told, and places are known to be hidden more often."""
    story = vanished()
    story.share = 0.5
    p_gone = float(story.stays_of(8).p_gone[0])
    hidden = story.living.sightlines.hidden[0]
    changes = story.session(2000.0, AT, seen(*AT, since_s=2000.0), kept={8: share})
    assert story.living.sightlines.hidden[0] - hidden == pytest.approx(0.5 * share * p_gone)
    stays = story.stays_of(8)
    if share > 0.5:
        assert changes == ()
        assert (stays.first_s.tolist(), stays.last_s.tolist(), stays.gone_s.tolist()) == ([18.0], [2048.0], [np.inf])
        assert stays.p_gone.tolist() == [0.0]
    else:
        (change,) = changes
        assert change.kind is ChangeKind.RETURNED
        assert change.probability == pytest.approx(0.98 * (1.0 - share))
        assert stays.gone_s.tolist() == [1012.0, np.inf]
        assert stays.p_gone.tolist() == [pytest.approx(max(p_gone, 1.0 - share)), 0.0]


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_what_is_shown_and_what_is_hidden_is_counted_by_expectation(share: float) -> None:
    """Of a body that is missed, as much as it is still believed in was hidden; each counts its share."""
    story = told()
    story.share = share
    np.testing.assert_array_equal(story.living.sightlines.shown, 0.0)  # nobody knew of any
    rest = {n: AT[n] for n in (1, 2, 9)}
    looks = [*seen(1, 2, 9, since_s=1000.0), Look(8, 1012.0, hit=False)]
    story.session(1000.0, rest, looks, away=(8,), p_away=0.9)
    assert story.living.sightlines.hidden.tolist() == pytest.approx([share * 0.1 / 4, 0.0, 0.0])
    assert story.living.sightlines.shown.tolist() == pytest.approx([share * 2.0, 0.0, 0.0])


@pytest.mark.parametrize(("step_m", "tells"), [(0.05, False), (0.5, True)])
def test_who_stands_a_hands_breadth_from_where_it_stood_has_not_moved(step_m: float, tells: bool) -> None:
    story = told()
    looks = [*seen(1, 2, 9, since_s=1000.0), Look(8, 1008.0, hit=True, at=(5.0 + step_m, 0.0))]
    changes = story.session(1000.0, AT | {8: (5.0 + step_m, 0.0)}, looks, anew=(8,))
    assert [change.kind for change in changes] == [ChangeKind.MOVED] * tells
    assert story.stays_of(8).gone_s.tolist() == [1000.0, np.inf]  # the site is another one all the same


@given(st.integers(0, 2**32 - 1))
def test_whatever_is_believed_nothing_is_told_without_looks(seed: int) -> None:
    """Random beliefs, evidence and looks at a map that stands and has some that are away, again and again."""
    rng = np.random.default_rng(seed)
    story = vanished()
    for k, at in enumerate([(9.0, 5.0), (3.0, 3.0)]):  # bodies have several sites
        story.session(1200.0 + 200.0 * k, {1: AT[1], 2: AT[2], 9: at}, seen(1, 2, 9, since_s=1200.0 + 200.0 * k))
    living = story.living
    assert len(living.sites) == 5
    cliques, row = np.unique(living.sites.clique_id, return_inverse=True)
    for k in range(4):
        start_s = 2000.0 + 1000.0 * k
        p_here = rng.beta(0.4, 0.4, len(living.sites))
        n = int(rng.integers(0, 6))
        place = np.sort(rng.integers(0, len(living.places), n))
        site = np.searchsorted(living.sites.site_id, living.places.site_id[place])
        hit, counts = rng.random((2, n)) < 0.5
        stamp = np.sort(start_s + rng.uniform(0.0, 99.0, n))
        order = np.lexsort((stamp, row[site]))
        rows = rows_of(SiteLooks(stamp, row[site], site, np.zeros(n, np.int64), hit), order)
        looks = PlaceLooks(
            rows, place[order], np.zeros(n, np.int64), nominal_lines(np.ones(1)), (hit | counts)[order], hit[order],
            rng.integers(0, 3, len(cliques)), np.zeros(2), np.ones(len(cliques)),
        )  # fmt: skip
        seen_s = living.sites.seen_s.copy()
        np.maximum.at(seen_s, rows.site[rows.hit], rows.stamp_s[rows.hit])
        sites = replace(living.sites, p_here=p_here, p_kept=p_here * rng.random(len(p_here)), seen_s=seen_s)
        said = rng.normal(0.0, 3.0, len(cliques))
        none = Arrivals(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
        stays = living.stays
        now = replace(living, sites=sites, stamp_s=start_s + 99.0)
        after, changes = decide.decided(living, now, beliefs(now, said), looks, none, start_s)
        looked = {int(cliques[c]) for c, tells in zip(looks.rows.clique, looks.counts, strict=True) if tells}
        body = dict(zip(after.members.landmark_id.tolist(), after.members.clique_id.tolist(), strict=True))
        for change in changes:
            (clique,) = {body[name] for name in change.landmark_ids}
            assert clique in looked
            assert change.kind is not ChangeKind.APPEARED
            assert change.n_hits + change.n_misses > 0
            assert 0.5 <= change.probability * (1.0 + 1e-9) <= 1.0 + 1e-9 or change.kind is ChangeKind.RETURNED
            if change.kind is ChangeKind.VANISHED:
                assert change.n_misses > 0
                assert said[np.searchsorted(cliques, clique)] <= -decide.USUAL.least_evidence
        for clique in set(cliques.tolist()) - looked:  # stays as they were
            mine, then = after.stays.clique_id == clique, stays.clique_id == clique
            np.testing.assert_array_equal(after.stays.gone_s[mine], stays.gone_s[then])
        # at most one stay of a body goes on
        goes_on = after.stays.clique_id[np.isinf(after.stays.gone_s)]
        assert len(np.unique(goes_on)) == len(goes_on)
        assert ((after.stays.p_gone >= 0.0) & (after.stays.p_gone <= 1.0)).all()
        # told once: without a further look there is nothing to say
        nothing = rows_of(looks.rows, np.zeros(0, np.int64))
        empty = np.zeros(0, np.int64)
        blind = replace(looks, rows=nothing, place=empty, cell=empty, counts=empty > 0, settled=empty > 0)
        _, again = decide.decided(after, after, beliefs(after, np.zeros(len(cliques))), blind, none, start_s + 99.0)
        assert again == ()
        living = after


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
    assert len(away) == decide.USUAL.most_away + 10  # twenty, and as many again as stand somewhere
    assert away.tolist() == list(range(70 - len(away), 70))


def test_what_an_operator_spoke_about_is_never_forgotten() -> None:
    living = crowd(8, Life(absence=never_leaves())).edited(12, pinned=True).edited(13, deleted=True)
    kept = decide.without_forgotten(living, 3)
    assert kept.members.landmark_id.tolist() == [*range(10), 12, 13]


def test_of_old_stays_the_newest_are_kept() -> None:
    living = wandered(1)
    count = decide.USUAL.most_stays + 7
    last = np.random.default_rng(0).permutation(count).astype(np.float64)
    name = np.zeros(count, dtype=np.int64)
    many = Stays(name, name, name, np.zeros((count, 2)), last - 2, np.sort(last) - 2, last, last + 1, np.ones(count))
    kept = decide.without_forgotten(replace(living, stays=many), 3).stays
    assert len(kept) == decide.USUAL.most_stays
    assert kept.last_s.min() == 7.0
    assert (np.diff(kept.first_s) > 0).all()


@pytest.mark.parametrize("p", [0.2, 0.8])
def test_one_in_the_place_of_another_is_one_change_or_none(p: float) -> None:
    """Departure and arrival are told as one, if it is another one; the stay ended as probably as that."""
    living = begun(found([1, 8, 9], [AT[1], (2.0, 0.1), AT[9]])).living
    clique = living.members.clique_id
    stays = Stays(
        clique[[0, 1, 2]], living.sites.site_id[[0, 1, 2]], np.full(3, UNKNOWN), np.zeros((3, 2)), np.full(3, -np.inf),
        np.zeros(3), np.array([50.0, 90.0, 50.0]), np.array([80.0, np.inf, 80.0]), np.array([0.99, 0.0, 0.9]),
    )  # fmt: skip
    living = replace(living, stays=stays)
    nothing = (np.nan, np.nan)
    told = tuple(
        MapChange((name,), kind, 50.0, 80.0, nothing, 0.0, 0.9, hits, misses)
        for name, kind, hits, misses in (
            (1, ChangeKind.VANISHED, 0, 7), (8, ChangeKind.APPEARED, 5, 0), (9, ChangeKind.VANISHED, 0, 3),
        )
    )  # fmt: skip
    none = np.array([np.nan])
    what = Witnessed(np.array([1]), none, np.array([85.0]), np.array([p]), instead=np.array([8]))
    after, changes = decide.with_replaced(living, told, what, begun(found([1, 8, 9], [AT[1], (2.0, 0.1), AT[9]])))
    assert after.stays.p_gone.tolist() == [p, 0.0, 0.9]
    assert changes[0] == told[2]
    assert len(changes) == (1 if p < 0.5 else 2)
    for one in changes[1:]:
        assert (one.kind, one.landmark_ids, one.probability) == (ChangeKind.REPLACED, (1, 8), p)
        assert (one.stamp_from_s, one.stamp_to_s, one.n_hits, one.n_misses) == (50.0, 85.0, 5, 7)
        assert one.displacement_m == pytest.approx((2.0, 0.1))


def instead_of(
    new_m: tuple[float, float], texts: tuple[str, str], *, came: float | None = 0.6, witnessed: str | None = None
) -> list[MapChange]:
    """What is told of a landmark that was missed at `AT[8]` and of a new one; `came`: the arrival is told, too; and
    which of them was seen to leave or to arrive.
    """
    old, new = map(landmark_id_of, texts)
    living = begun(found([1, 9, old], [AT[1], AT[9], AT[8]])).living
    living = replace(living, landmark_texts=tuple(sorted(one for one in texts if not one.isdigit())))
    entry = next_map(living, found([1, new], [AT[1], new_m], place=[0, -1], first_s=100.0, last_s=101.0))
    nothing = (np.nan, np.nan)
    told = [
        MapChange((old,), ChangeKind.VANISHED, 50.0, 80.0, nothing, 0.0, 0.97, 0, 7),
        MapChange((9,), ChangeKind.VANISHED, 50.0, 90.0, nothing, 0.0, 0.9, 0, 3),
    ]
    if came is not None:
        told.append(MapChange((new,), ChangeKind.APPEARED, 50.0, 85.0, nothing, 0.0, came, 5, 0))
    none = np.full(1, np.nan)
    seen = (
        Witnessed.nothing() if witnessed is None else Witnessed(np.array([landmark_id_of(witnessed)]), none, none, none)
    )
    return list(decide.join_replaced(tuple(told), seen, entry))


@pytest.mark.parametrize("came", [0.6, None])
def test_a_new_landmark_without_identity_where_one_was_missed_is_one_change(came: float | None) -> None:
    """As probable as that the former left; the arrival follows from it, told by itself or not."""
    changes = instead_of((5.0, 0.2), ("tree-3@10", "pole-4@100"), came=came)
    assert [one.kind for one in changes] == [ChangeKind.VANISHED, ChangeKind.REPLACED]
    both = tuple(map(landmark_id_of, ("tree-3@10", "pole-4@100")))
    assert changes[0].landmark_ids == (9,)
    assert (changes[1].landmark_ids, changes[1].probability) == (both, 0.97)
    assert changes[1].displacement_m == pytest.approx((0.0, 0.2))
    assert (changes[1].n_hits, changes[1].n_misses) == (0 if came is None else 5, 7)
    assert (changes[1].stamp_from_s, changes[1].stamp_to_s) == (50.0, 80.0)


@pytest.mark.parametrize(
    ("new_m", "texts"),
    [
        ((5.0, 0.4), ("tree-3@10", "pole-4@100")),  # beside it
        ((5.0, 0.2), ("3", "pole-4@100")),  # a number is an identity
        ((5.0, 0.2), ("tree-3@10", "dock")),
    ],
)
def test_what_stands_beside_or_has_an_identity_replaces_nothing(
    new_m: tuple[float, float], texts: tuple[str, str]
) -> None:
    kinds = [one.kind for one in instead_of(new_m, texts)]
    assert kinds == [ChangeKind.VANISHED, ChangeKind.VANISHED, ChangeKind.APPEARED]


@pytest.mark.parametrize("witnessed", ["tree-3@10", "pole-4@100"])
def test_who_was_seen_to_leave_or_to_come_replaces_nothing(witnessed: str) -> None:
    kinds = [one.kind for one in instead_of((5.0, 0.2), ("tree-3@10", "pole-4@100"), witnessed=witnessed)]
    assert kinds == [ChangeKind.VANISHED, ChangeKind.VANISHED, ChangeKind.APPEARED]


def test_what_came_and_left_in_one_session_was_nowhere_before() -> None:
    """Of a map's first session nothing is replaced."""
    texts = ("tree-3@10", "pole-4@10")
    old, new = map(landmark_id_of, texts)
    entry = begun(found([old, new], [AT[8], (5.0, 0.1)]))
    entry = replace(entry, living=replace(entry.living, landmark_texts=tuple(sorted(texts))))
    told = (MapChange((old,), ChangeKind.VANISHED, 50.0, 80.0, (np.nan, np.nan), 0.0, 0.97, 0, 7),)
    assert decide.join_replaced(told, Witnessed.nothing(), entry) == told


def test_one_replaces_one() -> None:
    """Of two that were missed beside a new one, the nearer one is replaced."""
    texts = ("tree-3@10", "tree-4@10", "pole-4@100")
    one, two, new = map(landmark_id_of, texts)
    living = begun(found([1, one, two], [AT[1], (5.0, 0.0), (5.0, 0.3)])).living
    living = replace(living, landmark_texts=tuple(sorted(texts)))
    entry = next_map(living, found([1, new], [AT[1], (5.0, 0.2)], place=[0, -1], first_s=100.0, last_s=101.0))
    told = [
        MapChange((name,), ChangeKind.VANISHED, 50.0, 80.0, (np.nan, np.nan), 0.0, 0.97, 0, 7) for name in (one, two)
    ]
    changes = decide.join_replaced(tuple(told), Witnessed.nothing(), entry)
    assert [(change.kind, change.landmark_ids) for change in changes] == [
        (ChangeKind.VANISHED, (one,)), (ChangeKind.REPLACED, (two, new)),
    ]  # fmt: skip
