"""Looks of a session, and their evidence on new landmarks.

A hit is a look anywhere. A miss is a look only along a line of sight that is known to be clear: something was seen
along it before, something behind it is seen now, or it leads through space that the session saw to be open
(`open_space`).

A landmark that the map did not know has appeared if its place was seen empty: earlier sessions looked at it from where
it is seen now, or past it at something behind. With `t` the time since one of them and `S` the survival of its class in
this place, it came after it with odds

    odds(appeared) = (1 - S(t)) / S(t) / P(all looks missed it | it was there)

since the age of what one comes upon is distributed as a stay is, if hazards are constant (which of them is what is not
known of a class); several sessions are weighed together. Without a look the map grew, and nothing has changed. A line
along which it is seen now is clear, and was so then as probably as any clear line is from session to session: as this
session says, too, of the lines that were clear then. One past it is near the line to it only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.special import betaln

from evermap.config import LivingConfig, LooksConfig, SightConfig
from evermap.existence.sites import SiteLooks
from evermap.geometry import se2
from evermap.maps.living import LivingMap, class_of, clique_rows, site_middles
from evermap.maps.sessions.extend import first_and_last
from evermap.maps.sessions.open_space import NewLooks, OpenSpace, Rays, count_sides, weigh_new_lines
from evermap.sensing.sightlines import HEADINGS, Lines, SightLines, Views, nominal_lines, offsets, session_rate
from evermap.sensing.visibility import LooksAt, NominalField
from evermap.types import BoolArray, FloatArray, IntArray, Sensor

USUAL, LIVING = LooksConfig(), LivingConfig()
NOWHERE = np.zeros((0, 2))
LOGITS = np.linspace(-60.0, 20.0, 801)
"""Log odds of shares of lines that are closed, over which is integrated."""
FEWEST = 5
"""Places that were seen, from which it is learned from how much of where they are in view places are in sight; and
positions from which a place must have been missed, since what hides it from one hides it from others nearby."""
LEAST_P = 1e-3
"""Probability that something is gone which the session saw."""
SHARES = np.geomspace(0.25, 64.0, 25)
"""Parameters of the beta distribution of that share which are weighed, all alike (both are a number of positions)."""
USUAL_RANGE = 0.9
"""Share of the detections within whose range a miss says something: data sheets promise more."""
EXPECTED = 1.5
"""Detections that one position must lead to expect, or its misses are chance."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """Detections of a session at the places of a map.

    Attributes:
        stamp_s: (F,) of the frames.
        pose_map_robot: (F, 3).
        frame, place: (H,) detections: in which frame, and of which row of the map's places.
    """

    stamp_s: FloatArray
    pose_map_robot: FloatArray
    frame: IntArray
    place: IntArray


class Watch(NamedTuple):
    """Sensor poses of a session with the places in view.

    Attributes:
        stamp_s: (F,) of the looks of a sensor.
        listed: which places it looked at then, whatever is in the way, and which of them it saw.
        eye: (F, 3) pose of the sensor on the floor: x, y, and the heading in which it looks.
        glimpsed_m: (K, 2) where something was detected that may stand, but became no landmark.
    """

    stamp_s: FloatArray
    listed: LooksAt
    eye: FloatArray
    glimpsed_m: FloatArray = NOWHERE

    @classmethod
    def of(cls, sighting: Sighting, position_m: FloatArray, sensor: Sensor, settings: LooksConfig = USUAL) -> Watch:
        """Return what a sensor in the plane looked at, by its nominal field of view, of places (P, 2)."""
        seen = sighting.frame, sighting.place
        listed = NominalField(sensor, settings).looks(sighting.pose_map_robot, position_m, seen)
        eye = se2.compose(sighting.pose_map_robot, np.asarray(sensor.mount_robot_sensor))
        return cls(sighting.stamp_s, listed, eye)


@dataclass(frozen=True, slots=True)
class PlaceLooks:
    """Places in the nominal field of view: rows by clique, then by time.

    Attributes:
        rows: as the chain wants them; `rows.key` are rows of `lines`.
        place: (N,) row of the map's places.
        cell: (N,) cell of the sensor, see `SightLines.cells`.
        lines: (K,) what is known of the different lines of sight.
        counts: (N,) whether it is evidence: a hit, or a miss along a line that is known to be clear.
        settled: (N,) whether the site was seen shortly before or after: what was missed there is hidden, not gone. Such
            looks teach lines of sight before anything is judged by these, so that a robot on a way that it never took
            does not take what stands behind a wall for gone.
        sight: (C,) what is known of the lines to each clique, as a row of `SightConfig.p_hidden`.
        unwitnessed: (2,) cliques that stood there, but were hidden, or shown, along lines that were unknown before.
        share: (C,) what each clique counts for how many are hidden: those looked at from one place count as one.
        rate: how often the session detects, over what lines of sight lead to expect.
        p_hidden: (3,) probability that a place is hidden for a session, as `SightLines.p_hidden`, by earlier ones and
            all that this one looked at.
        open_space: (4,) as `SightLines.open_space`, after the session; or empty.
    """

    rows: SiteLooks
    place: IntArray
    cell: IntArray
    lines: Lines
    counts: BoolArray
    settled: BoolArray
    sight: IntArray
    unwitnessed: FloatArray
    share: FloatArray
    rate: float = 1.0
    p_hidden: FloatArray = field(default_factory=lambda: np.array(SightConfig().p_hidden))
    open_space: FloatArray = field(default_factory=lambda: np.zeros(0))


def looked_at(living: LivingMap, p_start: FloatArray, watch: Watch, config: LivingConfig) -> PlaceLooks:
    """Return which places of a map were looked at, frame by frame, and which of them were seen.

    The map has the sites that the session found, with beliefs (S,) when it began. Without `learn_sight` nothing is ever
    in the way.
    """
    from evermap.sensing.kernels import close_to_hits, grouped, within_reach, witnessed

    places, (stamp_s, listed, eye, _) = living.places, watch
    floor_m = np.ascontiguousarray(places.position_m[:, :2])  # lines of sight are told apart on the floor
    used = ~np.isin(places.landmark_id, living.members.landmark_id[living.members.deleted])  # those nobody looks for
    # ranges may be in millimetres
    near = within_reach(listed.pose, listed.landmark, eye, floor_m, living.sightlines.reach_m)
    used = near if used.all() else used[listed.landmark] & near
    if not used.all():
        listed = listed.rows(used)
    cliques, clique_of_site = clique_rows(living.sites)
    site_of_place = np.searchsorted(living.sites.site_id, places.site_id)
    clique_of_place = clique_of_site[site_of_place]
    order = grouped(clique_of_place[listed.landmark], len(cliques))  # places are sorted by site: so are those of a pose
    frame, place, nominal, hit = listed.rows(order)
    cell = living.sightlines.cells(eye[:, :2], floor_m, (frame, place))
    line, key, p_nominal = _different(place, cell, nominal)
    rows = SiteLooks(stamp_s[frame], clique_of_place[place], site_of_place[place], key, hit)
    settings, rules = config.looks, living.sightlines.rules
    settled = close_to_hits(rows.stamp_s, rows.site, hit, len(living.sites), settings.settled_s)
    if not config.learn_sight:
        everything = np.ones(len(rows), dtype=np.bool_)
        sight = np.zeros(len(cliques), dtype=np.int64)
        lines, share, p_hidden = nominal_lines(p_nominal, rules), np.ones(len(cliques)), living.sightlines.p_hidden
        return PlaceLooks(rows, place, cell, lines, everything, settled, sight, np.zeros(2), share, 1.0, p_hidden)
    names = places.site_id, places.landmark_id
    before, p_before, seen_before = living.sightlines.lines(names, line[:, 0], line[:, 1], p_nominal)
    rate = _rate(rows, before.p_detect, seen_before & (p_before >= rules.clear), len(living.sites), rules)
    now = living.sightlines.learned(
        names, place[settled], cell[settled], rows.hit[settled], np.ones(int(settled.sum())), rate
    )
    lines, p_clear, seen = now.lines(names, line[:, 0], line[:, 1], p_nominal)
    line_is_clear, was_clear = (p_clear >= rules.clear) & seen, (p_before >= rules.clear) & seen_before
    clear = line_is_clear[key]
    beside, behind = (some[order] for some in witnessed(
        listed.pose, listed.landmark, listed.hit, clique_of_place, np.ascontiguousarray(eye[:, :2]),
        floor_m, (settings.beside_m, settings.beside_rad, settings.along_m),
    ))  # fmt: skip
    unknown = behind & (~line_is_clear & (p_clear > rules.blocked))[key]
    was_unknown = behind & (~was_clear & (p_before > rules.blocked))[key]
    unwitnessed = _count_unwitnessed(rows, was_unknown, len(cliques), settings.witnesses)
    was_new = (~was_clear & (p_before > rules.blocked))[key]
    is_new = was_new & (~line_is_clear & (p_clear > rules.blocked))[key]
    counts, sight, p_hidden, share, of_kind, space = _weigh_hidden(
        living,
        p_start,
        rows,
        clear,
        beside & clear,
        unknown,
        (was_new, is_new),
        lambda some: (eye[frame[some], :2], floor_m[place[some]]),
        nominal,
        settings,
    )
    lines = lines.at(rate, rules.highest_rate)._replace(p_free=1.0 - p_hidden[clique_of_place[line[:, 0]]])
    return PlaceLooks(rows, place, cell, lines, counts, settled, sight, unwitnessed, share, rate, of_kind, space)


def _rate(rows: SiteLooks, p_detect: FloatArray, known: BoolArray, n_sites: int, rules: SightConfig) -> float:
    """The rate of a session, by what was missed between the first and the last time that a site was seen; of lines (K,)
    their detection probability before the session, and whether they are known to be clear.
    """
    if not known.any():  # as in a map that begins
        return 1.0
    first, last = first_and_last(rows.site[rows.hit], rows.stamp_s[rows.hit], n_sites)
    there = (rows.stamp_s > first[rows.site]) & (rows.stamp_s < last[rows.site]) & known[rows.key]
    site = rows.site[there]
    count = np.bincount(site, minlength=n_sites)
    weight = np.minimum(1.0, rules.rate_looks / np.maximum(count, 1))[site]
    return session_rate(rows.hit[there], p_detect[rows.key[there]], weight, rules)


def _different(place: IntArray, cell: IntArray, nominal: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """(K, 2) different lines, place and cell of each, (N,) which of them a look is along, (K,) mean nominal rates."""
    lowest = int(cell.min(initial=0))
    span = int(cell.max(initial=0)) - lowest + 1
    both = place * span + (cell - lowest)
    # looks along one line mostly follow each other
    first = np.flatnonzero(np.append(True, both[1:] != both[:-1])[: len(both)])
    every, row = np.unique(both[first], return_inverse=True)
    key = np.repeat(row.ravel(), np.diff(np.append(first, len(both)))).astype(np.int64)
    total = np.bincount(key, np.maximum(nominal, 1e-3), minlength=len(every))
    mean = total / np.maximum(np.bincount(key, minlength=len(every)), 1)
    return np.column_stack([every // span, every % span + lowest]), key, mean


def _count_unwitnessed(rows: SiteLooks, was_unknown: BoolArray, n: int, least: int) -> FloatArray:
    """(2,) of `n` cliques that were seen, how many were hidden, and shown, along lines that were unknown before."""
    tried, found = (np.bincount(rows.clique[some], minlength=n) for some in (was_unknown, was_unknown & rows.hit))
    there = (np.bincount(rows.clique[rows.hit], minlength=n) > 0) & (tried >= least)
    return np.array([np.sum(there & (found == 0)), np.sum(there & (found > 0))], dtype=np.float64)


def _weigh_hidden(
    living: LivingMap,
    p_start: FloatArray,
    rows: SiteLooks,
    clear: BoolArray,
    beside: BoolArray,
    unknown: BoolArray,
    new: tuple[BoolArray, BoolArray],
    ends: Callable[[IntArray], tuple[FloatArray, FloatArray]],
    nominal: FloatArray,
    settings: LooksConfig,
) -> tuple[BoolArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return looks that count, the (C,) state of the lines to each clique, its (C,) probability of being hidden, what
    (C,) each counts among those that were looked at from the same place, `PlaceLooks.p_hidden` and `open_space`.

    By masks (N,) of looks along clear lines, of those with a sighting nearby or behind, and of unknown lines.

    A miss with a witness counts for what it is: something else was seen along the line. Without one the line may be
    closed in this session, the more probably the more cliques are missed from there together: one door hides them all,
    while they would leave one by one. For the same reason they are one door where it is counted how many are closed.
    """
    cliques, row = clique_rows(living.sites)
    n, least = len(cliques), settings.witnesses
    hits, n_clear, n_beside, n_unknown = (
        np.bincount(rows.clique[some], minlength=n) for some in (rows.hit, clear, beside, unknown)
    )
    sight = np.select([n_beside >= least, n_unknown >= least], [1, 2], 0).astype(np.int64)
    known = np.bincount(row, p_start, minlength=n) >= 0.5
    p_gone = np.clip(1.0 - np.bincount(row, p_start, minlength=n), 0.01, 0.99)
    counts = rows.hit | clear | (unknown & (sight[rows.clique] > 0))
    unlooked = (n_clear < least) & (sight != 1)
    space = _through_space(living, p_start, rows, new, unlooked, p_gone, nominal, ends, settings)
    through = space.p_clear >= living.sightlines.rules.clear
    counts |= space.counts
    looks = np.flatnonzero(clear | space.counts)
    clique, eye = rows.clique[looks], ends(looks)[0]
    total = np.column_stack([np.bincount(clique, eye[:, k], minlength=n) for k in (0, 1)])
    n_looks = np.bincount(clique, minlength=n)
    middle = total / np.where(n_looks > 0, n_looks, np.nan)[:, None]  # of none near nothing
    looked = known & (n_clear >= least)
    near = np.linalg.norm(middle[:, None] - middle, axis=2) < settings.together_m
    # with a witness in each line no one door hides several
    share = np.where(sight == 0, 1.0 / np.maximum((near & looked & (sight == 0)).sum(axis=1), 1), 1.0)
    alone = (hits == 0) & (sight == 0) & (n_looks > 0)
    near &= alone[:, None] & alone
    np.fill_diagonal(near, True)
    of_clique, of_kind = _p_hidden(living.sightlines, sight, looked, hits > 0, p_gone, share, near)
    missed = np.flatnonzero(counts & ~rows.hit)
    eye, place_m = ends(missed)
    of_clique = of_clique ** count_sides(rows.clique[missed], eye - place_m, n, settings)
    behind = np.where(sight == 2, of_clique, 1.0)  # with a witness behind, whichever says more
    of_clique[through] = np.minimum(behind, 1.0 - space.p_clear)[through]
    np.fill_diagonal(near, False)
    together = np.exp(near @ np.log(p_gone))
    of_clique = np.where(alone, of_clique / (of_clique + (1.0 - of_clique) * together), of_clique)
    return counts, sight, of_clique, share, of_kind, space.learned


def _through_space(
    living: LivingMap,
    p_start: FloatArray,
    rows: SiteLooks,
    new: tuple[BoolArray, BoolArray],
    unlooked: BoolArray,
    p_gone: FloatArray,
    nominal: FloatArray,
    ends: Callable[[IntArray], tuple[FloatArray, FloatArray]],
    settings: LooksConfig,
) -> OpenSpace:
    """Return what is said of cliques along lines (N,) that were new before the session, and of looks (N,) along those
    that still are; of (C,) cliques at which nobody looked along others. A site counts where a clique is believed, and
    if an earlier session found it.
    """
    n, (was_new, is_new), lines = len(unlooked), new, living.sightlines
    known = np.isin(living.sites.site_id, lines.site_id)
    asked = np.flatnonzero(was_new & known[rows.site] & (p_start[rows.site] >= 0.5))
    clique, hit = rows.clique[asked], rows.hit[asked]
    elsewhere, stands, shown = (
        np.bincount(some, minlength=n) > 0
        for some in (rows.clique[rows.hit & ~known[rows.site]], rows.clique[rows.hit], clique[hit])
    )
    before = lines.open_space if len(lines.open_space) else np.array(lines.rules.open_space)
    seen = np.flatnonzero(rows.hit)
    seen = seen[np.unique(rows.key[seen], return_index=True)[1]]
    space = weigh_new_lines(
        Rays(*ends(seen), rows.clique[seen]),
        NewLooks(clique, rows.key[asked], hit, nominal[asked], *ends(asked)),
        np.where(stands, LEAST_P, p_gone),
        ~elsewhere & (shown | stands | unlooked),
        before,
        lines.rules.clear,
        settings,
    )
    p_clear = np.where(unlooked & ~stands, space.p_clear, 0.0)
    counts = np.zeros(len(rows), dtype=np.bool_)
    counts[asked] = space.counts & is_new[asked] & (p_clear > 0.0)[clique]
    learned = lines.open_space if space.learned is before else space.learned
    return space._replace(counts=counts, p_clear=p_clear, learned=learned)


def _p_hidden(
    lines: SightLines,
    sight: IntArray,
    looked: BoolArray,
    seen: BoolArray,
    p_gone: FloatArray,
    share: FloatArray,
    near: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """(C,) probability of being hidden, by what earlier sessions say of such lines, and this one by all other cliques;
    and (3,) by all cliques, of a place that is none of them.

    Of so many lines a share `q` is closed, beta distributed. One that shows a clique is open, `1 - q`; one along which
    a clique was missed is closed, or it is gone: `q (1 - p_gone) + p_gone`. What is looked at from one place counts as
    one. A clique's own miss is the evidence on it, and counts once.

    Args:
        lines: with what earlier sessions said.
        sight: (C,) state of the lines to each clique.
        looked: (C,) cliques that were looked at often enough, and are believed.
        seen: (C,) those that were detected.
        p_gone: (C,) probability that they are gone.
        share: (C,) what each counts.
        near: (C, C) what is left out for each: itself, and what is missed along with it.
    """
    of_kind = lines.p_hidden
    p_hidden = of_kind[sight]
    log_q, log_open = -np.logaddexp(0.0, -LOGITS), -np.logaddexp(0.0, LOGITS)
    q = np.exp(log_q)
    hidden, shown = lines.closed
    for kind in (0, 1):  # lines that were unknown are counted where a clique is known to stand
        mine = sight == kind
        missed, n_shown = np.flatnonzero(mine & looked & ~seen), share[mine & looked & seen].sum()
        fit = share[missed, None] * np.log(q * (1.0 - p_gone[missed, None]) + p_gone[missed, None])
        log_p = hidden[kind] * log_q + (shown[kind] + n_shown) * log_open
        log_p = log_p + fit.sum(axis=0)
        log_p = np.vstack([log_p, log_p - near[np.ix_(mine, missed)] @ fit])
        weight = np.exp(log_p - log_p.max(axis=1, keepdims=True))
        mean = (weight @ q) / weight.sum(axis=1)
        of_kind[kind], p_hidden[mine] = mean[0], mean[1:]
    return p_hidden, of_kind


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Cliques seen at new sites: (A,) rows.

    Attributes:
        site: (A,) row of the new site.
        looked_s: (A,) the last look at its place before this session after which it surely came (`LooksConfig.sure`),
            else the first look; -inf for never.
        p_appeared: (A,) probability that it came after that; 0 without a look.
        came: by row of a site, until when what was seen to come there was not there, and how probably it came.
        left_s: by row of a site, when what came there was seen to leave again.
    """

    site: IntArray
    looked_s: FloatArray
    p_appeared: FloatArray
    came: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    left_s: Mapping[int, float] = field(default_factory=dict)


def arrivals(
    before: LivingMap,
    after: LivingMap,
    until_s: float,
    looks: PlaceLooks,
    sensor: Sensor,
    config: LivingConfig = LIVING,
) -> Arrivals:
    """Return what earlier sessions saw of the places of new sites until now: of the map before, and after the session
    found these.

    A session that detected something at a place which became no landmark did not see it empty; what was there, or came
    before, is not known.
    """
    settings, within_m = config.looks, config.boxes.glimpse_m
    new = np.flatnonzero(~np.isin(after.sites.site_id, before.sites.site_id))
    looked, p_appeared = np.full(len(new), -np.inf), np.zeros(len(new))
    if not len(before.views) or not len(new):
        return Arrivals(new, looked, p_appeared)
    at_eye = replace(sensor, mount_robot_sensor=(0.0, 0.0, 0.0))
    cliques, row = clique_rows(after.sites)
    kinds, middle = class_of(after, cliques), site_middles(after)
    site_of_place = np.searchsorted(after.sites.site_id, after.places.site_id)
    cells, (p_hidden, _, p_hidden_unknown) = after.sightlines.cell_m, looks.p_hidden.tolist()
    rays = _Rays.of(before)
    for k, site in enumerate(new.tolist()):
        parts, places = [], np.flatnonzero(site_of_place == site)
        places_m = after.places.position_m[places, :2]
        since_s = max(before.glimpses.last_near(place_m, within_m) for place_m in places_m)
        views = before.views.after(since_s)
        for place, place_m in zip(places.tolist(), places_m, strict=True):
            mine = looks.rows.hit & (looks.place == place)
            seen_from = place_m + offsets(np.unique(looks.cell[mine]), cells)
            parts.append(_empty_looks(views, rays, seen_from, place_m, at_eye, settings))
        frames, rate, stamps, is_clear = (np.concatenate(column) for column in zip(*parts, strict=True))
        stamp_s, then = np.unique(stamps, return_inverse=True)
        expected, along_clear, log_missed = (
            np.bincount(then, weight) for weight in (frames * rate, is_clear * frames * rate, frames * np.log1p(-rate))
        )
        looked_then = expected >= settings.least_expected
        if not looked_then.any():
            continue
        enough = stamp_s[looked_then]
        hidden = np.where(along_clear >= settings.least_expected, p_hidden, p_hidden_unknown)[looked_then]
        p_missed = hidden + (1.0 - hidden) * np.exp(log_missed[looked_then] / settings.sticky)
        stay, kind = after.lives.of(int(kinds[row[site]]), middle[site]).stay, kinds[[row[site]]]
        passed_s = after.lives.ages_s(kind, enough, np.asarray(until_s))
        p_after = came_after(np.exp(stay.log_survival(passed_s)), p_missed, settings.lasting * hidden.min())
        at = int(np.flatnonzero(p_after >= settings.sure).max(initial=0))
        looked[k], p_appeared[k] = enough[at], p_after[at]
    return Arrivals(new, looked, p_appeared)


def came_after(survival: FloatArray, p_missed: FloatArray, p_always: float) -> FloatArray:
    """Return the (K,) probability that something came after each look at its place, all of which missed it.

    By the survival (K,) of the times since the looks, the oldest first, that is of the ages that it may have; the
    probability (K,) of each miss if it was there; and the part of these that they have in common: that it was hidden in
    all.
    """
    came = np.diff(survival, prepend=0.0, append=1.0)  # before the first look, between two, after the last
    by_chance = np.cumprod(((p_missed - p_always) / (1.0 - p_always))[::-1])[::-1]
    weight = came * np.append(p_always + (1.0 - p_always) * by_chance, 1.0)
    return np.asarray(np.cumsum(weight[::-1])[::-1][1:] / weight.sum())


@dataclass(frozen=True, slots=True)
class _Rays:
    """Lines along which a place was seen: (K, 2) from, (K, 2) to."""

    from_m: FloatArray
    to_m: FloatArray

    @classmethod
    def of(cls, living: LivingMap) -> _Rays:
        lines = living.sightlines
        row = living.place_row(lines.landmark_id, lines.site_id)
        used = (row >= 0) & (lines.hits >= 0.5)
        to_m = living.places.position_m[row[used], :2]
        return cls(to_m + offsets(lines.cell[used], lines.cell_m), to_m)

    def pass_by(self, eye_m: FloatArray, place_m: FloatArray, settings: LooksConfig) -> BoolArray:
        """Return (V,) whether something behind a place (2,) was seen from eyes (V, 2), past the place."""
        away = place_m - self.from_m
        ahead = self.to_m - self.from_m
        length = np.maximum(np.hypot(*ahead.T), 1e-9)
        along = (away * ahead).sum(axis=1) / length
        across = np.abs(away[:, 0] * ahead[:, 1] - away[:, 1] * ahead[:, 0]) / length
        past = self.from_m[(across < settings.along_m) & (along > 0.0) & (length > along + settings.along_m)]
        gap = np.linalg.norm(eye_m[:, None] - past[None], axis=2).min(axis=1, initial=np.inf)
        return np.asarray(gap <= settings.near_m)


def _empty_looks(
    views: Views, rays: _Rays, seen_from_m: FloatArray, place_m: FloatArray, sensor: Sensor, settings: LooksConfig
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Frames of earlier views that would have shown a place, its detection rate in them, when they were, and whether
    the place is seen along their lines now.
    """
    pose = views.pose
    near = np.linalg.norm(pose[:, None, :2] - seen_from_m[None], axis=2).min(axis=1, initial=np.inf)
    is_clear = near <= settings.near_m
    near = is_clear | rays.pass_by(pose[:, :2], place_m, settings)
    pose = pose[near]
    half, field = np.pi / HEADINGS, NominalField(sensor, settings)
    rate = np.min(
        [field.p_detect(pose + np.array([0, 0, turn]), place_m[None])[:, 0] for turn in (-half, half)],
        axis=0,
        initial=1.0,
    )
    good = field.worth_a_look(rate)
    return views.frames[near][good], rate[good], views.stamp_s[near][good], is_clear[near][good]


def weigh_misses(
    watch: Watch, floor_m: FloatArray, unseen: BoolArray, oriented: BoolArray, settings: LooksConfig = USUAL
) -> tuple[BoolArray, FloatArray]:
    """Return which looks at places that were never detected count as misses, and (P,) how probable all of them are if
    something stands there: between detections of others, or in the open, whichever says more of a place.

    Args:
        watch: looks of a session.
        floor_m: (P, 2) places.
        unseen: (P,) whether a place was never detected.
        oriented: (P,) whether the looks know to where it faces.
        settings: what counts.
    """
    listed = watch.listed
    range_m = np.linalg.norm(floor_m[listed.landmark] - watch.eye[listed.pose, :2], axis=1)
    near = range_m <= (np.quantile(range_m[listed.hit], USUAL_RANGE) if listed.hit.any() else 0.0)
    flanked, p_flanked = _misses_between_others(watch, floor_m, unseen, oriented, near, settings)
    in_the_open, p_open = _misses_in_the_open(watch, len(floor_m), unseen, near, settings)
    flanked |= in_the_open & (p_open < p_flanked)[listed.landmark]
    return flanked, np.minimum(p_flanked, p_open)


def _misses_between_others(
    watch: Watch, floor_m: FloatArray, unseen: BoolArray, oriented: BoolArray, near: BoolArray, settings: LooksConfig
) -> tuple[BoolArray, FloatArray]:
    """Return which looks at places that were never detected lie between detections of others, and (P,) how probable all
    these misses are if something stands there.

    A look between what is seen on both sides of it from nearby, at no less than a share of its range, is blocked by
    something narrow only. From several positions that is improbable, unless the place is hidden from all.

    Looks that count are `near`, (N,).
    """
    listed, eye = watch.listed, watch.eye
    away = floor_m[listed.landmark] - eye[listed.pose, :2]
    range_m, bearing = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])
    flanked = np.zeros(len(listed.pose), dtype=np.bool_)
    asked = np.flatnonzero(unseen[listed.landmark] & near)
    half = np.floor(2.0 * eye[:, :2] / settings.elsewhere_m).astype(np.int64)
    hits = np.unique(np.column_stack([half[listed.pose[listed.hit]], listed.landmark[listed.hit]]), axis=0)
    for cell in np.unique(half[listed.pose[asked]], axis=0):
        looks = asked[(half[listed.pose[asked]] == cell).all(axis=1)]
        seen = np.unique(hits[(np.abs(hits[:, :2] - cell) <= 1).all(axis=1), 2])
        ahead = floor_m[seen][None] - eye[listed.pose[looks], :2][:, None]
        turn = se2.wrap(np.arctan2(ahead[..., 1], ahead[..., 0]) - bearing[looks][:, None])
        in_front = np.hypot(ahead[..., 0], ahead[..., 1]) < settings.flank_share * range_m[looks][:, None]
        beside = ~in_front & (np.abs(turn) < settings.flank_rad)
        flanked[looks] = (beside & (turn > 0.0)).any(axis=1) & (beside & (turn < 0.0)).any(axis=1)
    p_missed = np.ones(len(floor_m))
    for place in np.unique(listed.landmark[flanked]).tolist():
        rows = np.flatnonzero(flanked & (listed.landmark == place))
        around = np.sort(bearing[rows])
        gap = np.diff(np.append(around, around[0] + 2.0 * np.pi)).max()
        if not oriented[place] and 2.0 * np.pi - gap < settings.one_sided_rad:
            continue  # it may be seen from another side only
        position = np.floor(eye[listed.pose[rows], :2] / settings.elsewhere_m)
        cell = np.unique(position, axis=0, return_inverse=True)[1].ravel()
        expected = np.bincount(cell, listed.p_detect[rows])
        log_missed = np.bincount(cell, np.log1p(-np.minimum(listed.p_detect[rows], 0.99)))[expected >= EXPECTED]
        each = settings.p_flanked_hidden + (1.0 - settings.p_flanked_hidden) * np.exp(log_missed)
        p_missed[place] = max(float(np.prod(each)), settings.p_always_hidden)
    return flanked, p_missed


def _misses_in_the_open(
    watch: Watch, count: int, unseen: BoolArray, near: BoolArray, settings: LooksConfig
) -> tuple[BoolArray, FloatArray]:
    """Return which looks at places that were never detected count, and (P,) how probable all these misses are if
    something stands there that is in sight from as many positions as what was seen.

    From which share of the positions in whose nominal view it lies a place is in sight, is another for each: beta
    distributed, as what was seen says, each of it known to be in sight at least once (a beta-binomial, truncated at
    zero). Besides, some places are in sight from nowhere, behind walls or in rooms that were not entered. How many is
    learned, too: where much of a map was not seen, it is not all gone. What a place itself says does not count for it.

    Looks that count are `near`, (N,), at `count` places.
    """
    listed = watch.listed.rows(near)
    position = np.floor(watch.eye[listed.pose, :2] / settings.elsewhere_m).astype(np.int64)
    cells, cell = np.unique(np.column_stack([listed.landmark, position]), axis=0, return_inverse=True)
    expected = np.bincount(cell.ravel(), listed.p_detect, minlength=len(cells))
    hit = np.bincount(cell.ravel(), listed.hit, minlength=len(cells)) > 0
    of = cells[:, 0][looked := (expected >= EXPECTED) | hit]
    n, x = np.bincount(of, minlength=count), np.bincount(of, hit[looked], minlength=count)
    known = ~unseen & (x > 0)
    asked = unseen & (n >= FEWEST)
    p_missed = np.ones(count)
    if np.count_nonzero(known) >= FEWEST and asked.any():
        by_chance = _p_never_in_sight(x[known], n[known], n[asked])
        hidden = np.geomspace(settings.p_always_hidden, 0.99, 40)[:, None]
        missed = hidden + (1.0 - hidden) * by_chance  # (H, A) of what stands there
        each = np.log(settings.p_gone + (1.0 - settings.p_gone) * missed)
        rest = each.sum(axis=1, keepdims=True) - each
        fit = rest + np.count_nonzero(known) * np.log1p(-hidden) - 0.5 * np.log(hidden)
        weight = np.exp(fit - fit.max(axis=0))
        p_missed[asked] = (weight * missed).sum(axis=0) / weight.sum(axis=0)
    return near & asked[watch.listed.landmark], np.maximum(p_missed, settings.p_always_hidden)


def _p_never_in_sight(seen: IntArray, of_seen: IntArray, positions: IntArray) -> FloatArray:
    """Return (A,) how probable it is that a place that is in view from so many positions (A,) is in sight from none.

    Args:
        seen: (K,) positions from which each of some places was seen, at least one.
        of_seen: (K,) positions from which it was in view.
        positions: (A,) those of the places that are asked for.
    """
    a, b = (grid.ravel()[:, None] for grid in np.meshgrid(SHARES, SHARES))
    none = np.exp(betaln(a, b + of_seen) - betaln(a, b))
    fit = betaln(a + seen, b + of_seen - seen) - betaln(a, b) - np.log1p(-np.minimum(none, 1.0 - 1e-12))
    weight = np.exp(fit.sum(axis=1) - fit.sum(axis=1).max())
    return np.asarray((weight / weight.sum()) @ np.exp(betaln(a, b + positions) - betaln(a, b)))
