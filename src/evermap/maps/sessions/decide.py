"""Decisions after a session: stays that ended or began, and the reported changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import DecisionConfig, LivingConfig
from evermap.geometry.chunked import of_places, taken
from evermap.maps.bodies import log_density
from evermap.maps.diff import COMES, elsewhere, motion_of, with_swaps
from evermap.maps.learning import ClassLives
from evermap.maps.living import EXISTS, LivingMap, Stays, class_of, clique_rows, site_middles
from evermap.maps.names import is_anonymous
from evermap.maps.sessions.believe import Believed, Witnessed
from evermap.maps.sessions.extend import Extended
from evermap.maps.sessions.looks import Arrivals, PlaceLooks
from evermap.slam.association.assignment import density_of_unmet
from evermap.types import UNKNOWN, BoolArray, ChangeKind, FloatArray, IntArray, MapChange, landmark_id_of

USUAL = DecisionConfig()


def decided(
    before: LivingMap,
    entered: LivingMap,
    now: Believed,
    looks: PlaceLooks,
    arrivals: Arrivals,
    start_s: float,
    longest: ClassLives | None = None,
    *,
    settings: DecisionConfig = USUAL,
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """Return the map after a session, with its beliefs and updated stays, and the changes since the last report, by
    clique.

    A stay continues until looks end it: age alone lowers a belief, and is never reported as a change. A clique that was
    away and is seen again has returned only if it had left.

    Args:
        before: the map as the session found it.
        entered: with the session's places and sites, believed as before it.
        now: beliefs after it.
        looks: of the session, at places of `entered`.
        arrivals: what earlier looks said of the places of new sites.
        start_s: beginning of the session.
        longest: how long things stay: a clique is told to have vanished where the looks outweigh the longest lifetimes
            that are credible. None where nothing is known of lifetimes.
        settings: how much it takes.
    """
    session = _Session(before, entered, now, looks, arrivals, start_s, longest, settings)
    told, hidden, shown = _find_current(before, entered), session.hidden, session.shown
    for row, clique in enumerate(session.cliques.tolist()):
        if session.missed[row] and not session.was_hit[row]:  # the more probably hidden, the more it stands there
            hidden[session.sight[row]] += looks.share[row] * (1.0 - session.p_away[row])
        if clique in told:
            session.decide_before(row, *told[clique])
        else:
            session.was_away(row)
    hidden[2], shown[2] = looks.unwitnessed
    after = replace(
        entered,
        stamp_s=now.until_s,
        session_start_s=start_s,
        places=now.places,
        sites=replace(now.sites, p_kept=session.p_kept, since_s=session.since_s),
        stays=session.stays(),
        sightlines=entered.sightlines.after_session(hidden, shown),
    )
    return after, with_swaps(session.found, after, settings)


def with_replaced(
    after: LivingMap, changes: tuple[MapChange, ...], what: Witnessed, entry: Extended
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """Return the map and the changes of a session in which another landmark without identity stands where one stood.

    That one left and another one came, or it is the same, has one probability. With it the stay ended.

    Args:
        after: the map after the session.
        changes: the session's, with both as departure and arrival, if they were told at all.
        what: which are where others were, and how probably they are others.
        entry: the map before its beliefs were updated, with the places of both.
    """
    pairs = np.flatnonzero(what.instead != UNKNOWN)
    if not len(pairs):
        return after, changes
    told, stays = list(changes), after.stays
    p_gone, place = stays.p_gone.copy(), entry.living.places
    for k in pairs.tolist():
        old, new, p = int(what.landmark_id[k]), int(what.instead[k]), float(what.probability[k])
        left = [one for one in told if one.kind is ChangeKind.VANISHED and one.landmark_ids == (old,)]
        came = [one for one in told if one.kind in COMES and one.landmark_ids == (new,)]
        told = [one for one in told if one not in (*left, *came)]
        clique_id = entry.living.members.clique_id[np.searchsorted(entry.living.members.landmark_id, old)]
        ended = np.flatnonzero((stays.clique_id == clique_id) & np.isfinite(stays.gone_s))[-1:]
        p_gone[ended] = p
        if p < EXISTS:
            continue
        was, now = (place.position_m[np.flatnonzero(place.landmark_id == one)[-1]] for one in (old, new))
        last_s = left[0].stamp_from_s if left else float(np.append(np.nan, stays.last_s[ended])[-1])
        hits, misses = (sum(getattr(one, name) for one in (*left, *came)) for name in ("n_hits", "n_misses"))
        shift_m = tuple((now - was).tolist())
        told.append(
            MapChange((old, new), ChangeKind.REPLACED, last_s, float(what.until_s[k]), shift_m, 0.0, p, hits, misses)
        )
    return replace(after, stays=replace(stays, p_gone=p_gone)), tuple(told)


def join_replaced(
    changes: tuple[MapChange, ...], what: Witnessed, entry: Extended, settings: DecisionConfig = USUAL
) -> tuple[MapChange, ...]:
    """Return the changes with departures of landmarks without identity, where a new one stands, as replacements.

    It is another one because class, size or what it is like say so. That the former left and that the new one came is
    one fact: that there is another one, or that the same was misread, as probable as the departure.

    Args:
        changes: of a session.
        what: which were seen to leave or arrive: then both are facts.
        entry: the map before its beliefs were updated, with the session's landmarks.
        settings: how close to the former place the new one is.
    """
    living, before = entry.living, entry.before
    nameless = _find_nameless(living, what)
    taken = [name for one in changes if one.kind not in COMES for name in one.landmark_ids]
    new = np.isin(entry.landmark_id, nameless) & ~np.isin(entry.landmark_id, [*before.members.landmark_id, *taken])
    left = [k for k, one in enumerate(changes) if one.kind is ChangeKind.VANISHED and len(one.landmark_ids) == 1]
    mine = set(np.intersect1d(nameless, before.members.landmark_id).tolist())
    left = [k for k in left if changes[k].landmark_ids[0] in mine]
    if not left or not new.any():
        return changes
    names, at_m = entry.landmark_id[new], living.places.position_m[entry.place[new]]
    old = np.array([changes[k].landmark_ids[0] for k in left])
    site = before.find_current_site()[np.searchsorted(before.members.landmark_id, old)]
    was_m = living.places.position_m[living.place_row(old, site)]
    away_m = np.linalg.norm(was_m[:, None] - at_m, axis=2)
    told, joined = list(changes), list[MapChange]()
    for pair in np.argsort(away_m, axis=None, kind="stable").tolist():
        k, m = np.unravel_index(pair, away_m.shape)
        if away_m[k, m] > settings.same_place_m:
            break
        away_m[k], away_m[:, m] = np.inf, np.inf
        went, name = changes[left[k]], int(names[m])
        came = [one for one in told if one.kind in COMES and one.landmark_ids == (name,)]
        told = [one for one in told if one is not went and one not in came]
        shift_m = tuple((at_m[m] - was_m[k]).tolist())
        hits = sum(one.n_hits for one in came)
        pair_ids = (*went.landmark_ids, name)
        joined.append(
            replace(went, kind=ChangeKind.REPLACED, landmark_ids=pair_ids, displacement_m=shift_m, n_hits=hits)
        )
    return (*told, *joined)


def _find_nameless(living: LivingMap, what: Witnessed) -> IntArray:
    """Return landmarks without identity, but for those that were seen to leave or arrive."""
    nameless = np.array([landmark_id_of(one) for one in living.landmark_texts if is_anonymous(one)], dtype=np.int64)
    return nameless[~np.isin(nameless, what.landmark_id)]


def doubt_moves(
    changes: tuple[MapChange, ...], what: Witnessed, entry: Extended, config: LivingConfig
) -> tuple[MapChange, ...]:
    """Return the changes with moves of landmarks without identity as probable as that they are the same ones.

    What left a place was moved a little, or is gone and another one of its class was put next to where it stood, or
    stands there by chance: nothing that was seen tells which. Several that moved as one body are the same, and what a
    landmark is like, or the size of a box, tells by itself.

    Args:
        changes: of a session.
        what: which were seen to leave or arrive.
        entry: the map before its beliefs were updated, with the session's landmarks.
        config: how moves and replacements are.
    """
    living, moves, others = entry.living, config.overlay, config.boxes
    told_by_looks = np.concatenate([living.boxes.landmark_id, living.traits.landmark_id])
    nameless = np.setdiff1d(_find_nameless(living, what), told_by_looks)
    by_chance, told = density_of_unmet(living.places.position_m[entry.place]), list(changes)
    for k, one in enumerate(changes):
        if one.kind is not ChangeKind.MOVED or len(one.landmark_ids) > 1 or one.landmark_ids[0] not in nameless:
            continue
        off_m, each = np.array(one.displacement_m), np.eye(living.dim)
        spread_m2 = np.array(one.displacement_covariance_m2) if one.displacement_covariance_m2 else 0.0 * each
        nudged, beside = (
            float(np.exp(log_density(off_m, spread_m2 + sigma_m**2 * each)))
            for sigma_m in (moves.nudge_m, others.beside_m)
        )
        same = moves.share_nudged * nudged
        other = (1.0 - moves.share_nudged) * (others.p_taken * beside + by_chance)
        told[k] = replace(one, probability=one.probability * same / (same + other))
    return tuple(told)


class _Session:
    """What is decided of cliques one after the other; columns of stays, sites and sight are written to as it goes.

    Attributes:
        sites: with the session's beliefs and sightings.
        cliques: (C,) ids; site: (C,) row of the most probable site of each; stands: (C,) whether it is there.
        p_away: (C,) probability that it stands nowhere; log_evidence: (C,) of the looks, for 'it stands somewhere'.
        least: (C,) evidence against it that it takes to tell that it vanished; missed: (C,) whether it was missed.
        hits: (S,) by site; expected: (S,) detections that its misses stand for, each by how probably its line was
            clear; was_hit: (C,) whether it was seen at any of its sites.
        newest: row of the last stay by clique.
        last_s, gone_s, p_gone: (K,) of the stays; p_kept, since_s: (S,) of the sites.
        hidden, shown: (3,) expected numbers of cliques that were there and not seen, and seen, by `PlaceLooks.sight`.
        begun: clique, site, not there before, first and last sighting of new stays; when they ended, and how probably.
        found: changes.
    """

    def __init__(
        self,
        before: LivingMap,
        entered: LivingMap,
        now: Believed,
        looks: PlaceLooks,
        arrivals: Arrivals,
        start_s: float,
        longest: ClassLives | None,
        settings: DecisionConfig,
    ) -> None:
        self.before, self.entered, self.looks = before, entered, looks
        self.arrivals, self.start_s, self.settings = arrivals, start_s, settings
        self.sites, self.log_evidence = now.sites, now.log_evidence
        sites, stays = now.sites, entered.stays
        self.cliques, row = clique_rows(sites)
        count = len(self.cliques)
        hit: BoolArray = looks.rows.hit
        self.hits = np.bincount(looks.rows.site[hit], minlength=len(sites))
        missed = ~hit & looks.counts
        p_seen = looks.lines.p_seen[looks.rows.key[missed]]
        self.expected = np.bincount(looks.rows.site[missed], p_seen, minlength=len(sites))
        self.was_hit = np.bincount(row, self.hits, minlength=count) > 0
        self.site, newest_s = np.zeros(count, dtype=np.int64), np.full(count, -np.inf)
        order = np.argsort(-sites.p_here, kind="stable")[::-1]
        self.site[row[order]] = order  # the last that is written is the most probable, the first of equal ones
        self.stands = sites.p_here[self.site] >= EXISTS
        self.p_away = np.clip(1.0 - np.bincount(row, sites.p_here, minlength=count), 0.0, 1.0)
        self.missed, self.sight = now.log_evidence <= -settings.least_evidence, looks.sight % 2
        self.least = np.full(count, settings.least_evidence)
        gone = np.flatnonzero(self.missed & (self.p_away >= EXISTS))  # others are not told to have vanished
        if longest is not None and len(gone):
            np.maximum.at(newest_s, row, sites.seen_s)
            class_id = class_of(entered, self.cliques[gone])
            age_s = np.maximum(longest.lives.ages_s(class_id, newest_s[gone], np.asarray(now.until_s)), 0.0)
            p_stays = longest.longest(class_id, age_s, settings.credible)
            p_stays = np.clip(p_stays, 1e-12, 1.0 - 1e-12)
            self.least[gone] = np.maximum(self.least[gone], np.log(p_stays / (1.0 - p_stays)))
        self.newest = {clique: k for k, clique in enumerate(stays.clique_id.tolist())}
        self.last_s, self.gone_s, self.p_gone = stays.last_s.copy(), stays.gone_s.copy(), stays.p_gone.copy()
        self.p_kept, self.since_s = sites.p_kept.copy(), sites.since_s.copy()
        self.hidden, self.shown = np.zeros(3), np.zeros(3)
        self.begun: list[tuple[int, int, float, float, float, float, float]] = []
        self.found: list[MapChange] = []

    def decide_before(self, row: int, old: int, stay: int) -> None:
        """Decide on a clique that occupied the site `old`, by the stay `stay` (-1 for none)."""
        site = int(self.site[row])
        if self.stands[row] and site == old:
            self._goes_on(row, stay)
        elif self.stands[row] and self.hits[site]:
            self._report_moved(row, old, stay)
        elif (
            not self.stands[row]
            and self.expected[old] >= self.settings.least_looks
            and self.log_evidence[row] <= -self.least[row]
            and self.p_away[row] >= EXISTS
        ):
            self._report_vanished(row, old, stay)
        elif stay >= 0 and self.missed[row]:
            self.p_gone[stay] = self.p_away[row]

    def was_away(self, row: int) -> None:
        """Decide on a clique that was away, or is new."""
        clique, site, sites = int(self.cliques[row]), int(self.site[row]), self.sites
        newest = self.newest.get(clique, -1)
        if site in self.arrivals.left_s and not self.stands[row]:
            self._came_and_left(row, site, newest)
            return
        if not (self.stands[row] and self.hits[site]):
            if newest >= 0 and np.isfinite(self.gone_s[newest]):
                at = _row(self.entered, int(self.entered.stays.site_id[newest]))
                self.p_gone[newest] = np.clip(1.0 - self.p_kept[at], 0.0, 1.0) if at >= 0 else self.p_gone[newest]
            return
        seen_s = float(sites.seen_s[site])
        share = min(self.p_kept[site] / sites.p_here[site], 1.0)
        self.p_kept[site] = sites.p_here[site]
        same = newest >= 0 and self.entered.stays.site_id[newest] == sites.site_id[site]
        self.hidden[self.sight[row]] += self.looks.share[row] * share * self.p_gone[newest] if same else 0.0
        if same and share >= 1.0 - EXISTS:  # it had never left
            self.last_s[newest], self.gone_s[newest], self.p_gone[newest] = seen_s, np.inf, 0.0
            at = _row(self.before, int(sites.site_id[site]))
            self.since_s[site] = self.before.sites.since_s[at] if at >= 0 else self.since_s[site]
            return
        kind, elsewhere_s, probability = self._since_when(site, newest, same, share)
        if newest >= 0:
            self.p_gone[newest] = max(self.p_gone[newest], probability)
        since = self._begins(clique, site, elsewhere_s)
        if probability >= EXISTS:
            p, left = probability * float(sites.p_here[site]), _last_site(self.before, self.entered, clique)
            n_misses = self._n_missed(left) if left >= 0 else 0
            self._tell(kind, left, site, elsewhere_s, since, p, int(self.hits[site]), n_misses)

    def stays(self) -> Stays:
        """Return old and new ones, in the order of their beginning."""
        stays = replace(self.entered.stays, last_s=self.last_s, gone_s=self.gone_s, p_gone=self.p_gone)
        if not self.begun:
            return stays
        clique_id, site, *times = (np.array(part) for part in zip(*self.begun, strict=True))
        site_id, middle_m = self.sites.site_id[site], site_middles(self.entered)[site]
        stays = stays.joined(Stays(clique_id, site_id, class_of(self.entered, clique_id), middle_m, *times))
        return stays[np.argsort(stays.first_s, kind="stable")]

    def _goes_on(self, row: int, stay: int) -> None:
        site, sites = int(self.site[row]), self.sites
        if stay < 0:  # a body that was taken apart: its part goes on
            first_s, last_s = float(sites.since_s[site]), float(sites.seen_s[site])
            self.begun.append((int(self.cliques[row]), site, -np.inf, first_s, last_s, np.inf, 0.0))
        else:
            self.last_s[stay] = max(self.last_s[stay], sites.seen_s[site])
            if self.hits[site]:  # if it was missed before, it was hidden then
                share = min(self.p_kept[site] / sites.p_here[site], 1.0)
                self.hidden[self.sight[row]] += self.looks.share[row] * share * self.p_gone[stay]
                self.shown[self.sight[row]] += self.looks.share[row]
                self.p_gone[stay] = 0.0
            elif self.missed[row]:
                self.p_gone[stay] = self.p_away[row]
        if self.hits[site]:
            self.p_kept[site] = sites.p_here[site]

    def _report_moved(self, row: int, old: int, stay: int) -> None:
        site = int(self.site[row])
        left_s = self._ends(old, stay, 1.0)
        since = self._begins(int(self.cliques[row]), site, left_s)
        self.p_kept[site] = p_moved = float(self.sites.p_here[site])
        if elsewhere(*_motion(self.entered, old, site), self.settings):
            n_hits, n_misses = int(self.hits[site]), self._n_missed(old)
            self._tell(ChangeKind.MOVED, old, site, left_s, since, p_moved, n_hits, n_misses)

    def _report_vanished(self, row: int, old: int, stay: int) -> None:
        p_away = float(self.p_away[row])
        left_s = self._ends(old, stay, p_away)
        to_s = _first_miss(self.looks, old, left_s, self.start_s)
        self._tell(ChangeKind.VANISHED, old, -1, left_s, to_s, p_away, 0, self._n_missed(old))

    def _since_when(self, site: int, newest: int, same: bool, share: float) -> tuple[ChangeKind, float, float]:
        """Return whether a present clique returned or appeared, the last time of its absence, and the probability."""
        came_s, p_came = self.arrivals.came.get(site, (-np.inf, 0.0))
        if newest >= 0:  # where it was last it was found missing; elsewhere it may have come when it left
            elsewhere_s = max(float(self.gone_s[newest] if same else self.last_s[newest]), came_s)
            return ChangeKind.RETURNED, elsewhere_s, 1.0 - share if same else 1.0
        if p_came >= EXISTS:
            return ChangeKind.APPEARED, came_s, p_came
        at = np.flatnonzero(self.arrivals.site == site)
        if not len(at) or self.arrivals.p_appeared[at[0]] < EXISTS:
            return ChangeKind.APPEARED, -np.inf, 0.0
        return ChangeKind.APPEARED, float(self.arrivals.looked_s[at[0]]), float(self.arrivals.p_appeared[at[0]])

    def _ends(self, old: int, stay: int, probability: float) -> float:
        """The stay at a site ends; returns when the clique was seen there last."""
        left_s = float(self.sites.seen_s[old])
        if stay >= 0:
            left_s = max(float(self.last_s[stay]), left_s)
            self.last_s[stay] = left_s
            self.gone_s[stay] = _first_miss(self.looks, old, left_s, self.start_s)
            self.p_gone[stay] = probability
        return left_s

    def _begins(self, clique: int, site: int, elsewhere_s: float, gone_s: float = np.inf, p_gone: float = 0.0) -> float:
        """A stay begins, and may have ended by now; returns when it was seen first."""
        sites = self.sites
        since = max(float(sites.since_s[site]), float(np.nextafter(elsewhere_s, np.inf)))
        last_s = max(float(sites.seen_s[site]), since)
        self.begun.append((clique, site, elsewhere_s, since, last_s, max(gone_s, last_s), p_gone))
        return since

    def _came_and_left(self, row: int, site: int, newest: int) -> None:
        """A stay that began and ended while it was looked at."""
        p_away, left_s = float(self.p_away[row]), self.arrivals.left_s[site]
        kind, elsewhere_s, probability = self._since_when(site, newest, same=False, share=0.0)
        since = self._begins(int(self.cliques[row]), site, elsewhere_s, left_s, p_away)
        if probability >= EXISTS:
            self._tell(kind, -1, site, elsewhere_s, since, probability, int(self.hits[site]), 0)
        last_s = float(self.sites.seen_s[site])
        self._tell(ChangeKind.VANISHED, site, -1, last_s, max(left_s, last_s), p_away, 0, self._n_missed(site))

    def _n_missed(self, site: int) -> int:
        """The number of detections that the misses at a site stand for."""
        return int(np.round(self.expected[site]))

    def _tell(
        self, kind: ChangeKind, left: int, site: int, from_s: float, to_s: float, p: float, n_hits: int, n_misses: int
    ) -> None:
        """Tell the change of a clique from one site (row, -1 for none) to another."""
        away = np.full(self.entered.dim, np.nan), 0.0
        step, turn = _motion(self.entered, left, site) if site >= 0 and left >= 0 else away
        spread = motion_covariance(self.entered, left, site) if site >= 0 and left >= 0 else ()
        there = self.entered.places.site_id == self.sites.site_id[site if site >= 0 else left]
        change = MapChange(
            landmark_ids=tuple(np.sort(self.entered.places.landmark_id[there]).tolist()),
            kind=kind,
            stamp_from_s=from_s if np.isfinite(from_s) else float("nan"),
            stamp_to_s=to_s,
            displacement_m=tuple(step.tolist()),
            rotation_rad=turn,
            probability=float(min(max(p, 0.0), 1.0)),
            n_hits=n_hits,
            n_misses=n_misses,
            displacement_covariance_m2=spread,
        )
        self.found.append(change)


def _find_current(before: LivingMap, after: LivingMap) -> dict[int, tuple[int, int]]:
    """Return rows of the site and of the stay (-1 for none) of every clique with a current stay."""
    told: dict[int, tuple[int, int]] = {}
    stays = after.stays
    for row in np.flatnonzero(stays.gone_s == np.inf).tolist():
        site = _row(after, int(stays.site_id[row]))
        if site >= 0:
            told[int(stays.clique_id[row])] = (site, row)
    then, known = before.sites[before.sites.p_here >= EXISTS], set(stays.clique_id.tolist())
    for clique, site_id in dict(zip(then.clique_id.tolist(), then.site_id.tolist(), strict=True)).items():
        if clique not in known and (site := _row(after, site_id)) >= 0:  # part of a body that stood there
            told[clique] = (site, -1)
    return told


def without_forgotten(living: LivingMap, most_sites: int, settings: DecisionConfig = USUAL) -> LivingMap:
    """Return the map without negligible sites and cliques, so that its cost depends on what is present, not on its age.

    Left out are the least probable sites of cliques that have more than `most_sites`, and cliques that are away for
    good: those that return with little probability, or, where too many are away, that went first. Their stays are kept
    to learn from.
    """
    sites, members = living.sites, living.members
    order = np.lexsort((-sites.seen_s, -sites.p_here, sites.clique_id))
    rank = np.arange(len(order)) - np.searchsorted(sites.clique_id[order], sites.clique_id[order])
    kept = np.zeros(len(sites), dtype=np.bool_)
    kept[order[rank < most_sites]] = True
    gone = _list_gone_for_good(living, settings)
    kept &= ~np.isin(sites.clique_id, gone)
    stays = living.stays
    if len(stays) > settings.most_stays:
        stays = stays[np.sort(np.argsort(stays.last_s, kind="stable")[-settings.most_stays :])]
    if kept.all():
        return living if stays is living.stays else replace(living, stays=stays)
    rows = np.flatnonzero(np.isin(living.places.site_id, sites.site_id[kept]))
    return replace(
        living,
        members=members[~np.isin(members.clique_id, gone)],
        sites=sites[kept],
        places=living.places[rows],
        covariance_m2=taken(living.covariance_m2, rows, living.dim),
        stays=stays,
    )


def _list_gone_for_good(living: LivingMap, settings: DecisionConfig) -> IntArray:
    """Ids of cliques that are away and need not be remembered."""
    sites = living.sites
    cliques, row = clique_rows(sites)
    p_here, seen = np.zeros(len(cliques)), np.full(len(cliques), -np.inf)
    np.add.at(p_here, row, sites.p_here)
    np.maximum.at(seen, row, sites.seen_s)
    operated = living.members.pinned | living.members.deleted
    away = np.flatnonzero((p_here < settings.surely_away) & ~np.isin(cliques, living.members.clique_id[operated]))
    kinds, middle = class_of(living, cliques[away]), site_middles(living)
    newest = {int(row[s]): s for s in np.argsort(sites.seen_s, kind="stable")}
    p_return = np.zeros(len(away))
    for k, clique in enumerate(away):
        absence = living.lives.of(int(kinds[k]), middle[newest[int(clique)]]).absence
        still_away = float(np.exp(absence.log_survival(max(living.stamp_s - seen[clique], 0.0))))
        p_return[k] = 1.0 - absence.p_never_leaves / still_away if still_away > 0.0 else 0.0
    hopeless = away[p_return < settings.forgotten_p]
    waiting = away[p_return >= settings.forgotten_p]
    most = settings.most_away + len(cliques) - len(away)
    too_many = waiting[np.argsort(seen[waiting], kind="stable")][: max(len(waiting) - most, 0)]
    return np.asarray(cliques[np.concatenate([hopeless, too_many])])


def _motion(living: LivingMap, old: int, new: int) -> tuple[FloatArray, float]:
    """Shift and rotation of a body from one site to another, by the landmarks that have places at both.

    Of none the shift is that of the middles; the rotation of fewer than two is 0.
    """
    a, b, are_same = _places_at(living, old, new)
    was, now = living.places.position_m[a], living.places.position_m[b]
    if not are_same:
        return now.mean(axis=0) - was.mean(axis=0), 0.0
    turns = (living.places.rotation[a], living.places.rotation[b]) if living.dim > 2 else None
    return motion_of(was, now, turns)


def _places_at(living: LivingMap, old: int, new: int) -> tuple[IntArray, IntArray, bool]:
    """Rows of the places of a body at two sites: of the landmarks that have both, if any have, else of all."""
    a = np.flatnonzero(living.places.site_id == living.sites.site_id[old])
    b = np.flatnonzero(living.places.site_id == living.sites.site_id[new])
    _, i, j = np.intersect1d(living.places.landmark_id[a], living.places.landmark_id[b], return_indices=True)
    return (a[i], b[j], True) if len(i) else (a, b, False)


def motion_covariance(living: LivingMap, old: int, new: int) -> tuple[tuple[float, ...], ...]:
    """Return rows of the covariance (D, D) of the shift of a body from one site (row) to another, by the joint Gaussian
    of its places at both: what they share, such as the map's frame, cancels. The error of the map's metre is one factor
    on the whole shift: `log_size_variance` shift shift'.
    """
    a, b, _ = _places_at(living, old, new)
    rows, dim = np.concatenate([b, a]), living.dim
    weight = np.concatenate([np.full(len(b), 1.0 / len(b)), np.full(len(a), -1.0 / len(a))])
    joint = of_places(living.covariance_m2, rows, dim).reshape(len(rows), dim, len(rows), dim)
    shift = weight @ living.places.position_m[rows]
    spread = np.einsum("i,iajb,j->ab", weight, joint, weight) + living.log_size_variance * np.outer(shift, shift)
    return tuple(map(tuple, (0.5 * (spread + spread.T)).tolist()))


def _first_miss(looks: PlaceLooks, site: int, last_s: float, start_s: float) -> float:
    """The first look of a session at which a clique was missed at its site after its last sighting there."""
    rows = (looks.rows.site == site) & ~looks.rows.hit & looks.counts & (looks.rows.stamp_s > last_s)
    return float(looks.rows.stamp_s[rows].min()) if rows.any() else max(start_s, float(np.nextafter(last_s, np.inf)))


def _row(living: LivingMap, site_id: int) -> int:
    """Return the row of a site by its id, -1 if it is not there."""
    ids = living.sites.site_id
    at = int(np.searchsorted(ids, site_id))
    return at if at < len(ids) and ids[at] == site_id else -1


def _last_site(before: LivingMap, after: LivingMap, clique: int) -> int:
    """Return the site at which an absent clique was seen last, as a row of the new map."""
    mine = np.flatnonzero(before.sites.clique_id == clique)
    if not len(mine):
        return -1
    return _row(after, int(before.sites.site_id[mine[np.argmax(before.sites.seen_s[mine])]]))


def without_strays(living: LivingMap) -> LivingMap:
    """Return a map without sizes, traits and names of landmarks that it has forgotten."""
    traits, boxes, known = living.traits, living.boxes, living.members.landmark_id
    has_traits, has_box = np.isin(traits.landmark_id, known), np.isin(boxes.landmark_id, known)
    if has_traits.all() and has_box.all():
        return living
    gone = set(boxes.landmark_id[~has_box].tolist())
    texts = tuple(text for text in living.landmark_texts if landmark_id_of(text) not in gone)
    return replace(living, traits=traits[has_traits], boxes=boxes[has_box], landmark_texts=texts)
