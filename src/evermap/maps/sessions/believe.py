"""Beliefs of the map's cliques: carried to a session by their lifetimes, and through it by hits and misses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.config import LivingConfig
from evermap.existence.sites import SiteBeliefs, SiteDynamics, SiteLooks, follow_sites
from evermap.geometry import se2
from evermap.maps.lives import Life
from evermap.maps.living import Evidence, LivingMap, Sites
from evermap.sensing.sightlines import BLOCKED_P, CLEAR, Lines, SightLines, nominal_lines
from evermap.sensing.visibility import looks_at
from evermap.survival.step import never_leaves
from evermap.types import BoolArray, FloatArray, IntArray, Sensor, rows_of

SETTLED_S = 300.0
"""What is seen within this time of a look was there at that look."""
BESIDE_M, BESIDE_RAD = 1.0, 0.15
"""What is seen this close to a place, or behind it at this angle, is seen along its line of sight."""
ALONG_M = 0.3
"""What is seen farther away, and at this distance from a line of sight, tells that this line is clear."""
WITNESSES = 3
"""Frames in which something else must be seen along the lines to a clique to know that they are clear."""
SIDES, MOST_SIDES = 6, 3
"""Sectors around a place that are sides of it, and how many of them count for being seen all around."""
TOGETHER_M = 2.0
"""Cliques that are missed from places this close to each other may be hidden by the same thing."""
ROUNDS = 5


@dataclass(frozen=True, slots=True)
class Sighting:
    """What a session saw of the places of a map.

    Attributes:
        stamp_s: (F,) of the frames.
        pose_map_robot: (F, 3).
        frame, place: (H,) detections: in which frame, and of which row of the map's places.
    """

    stamp_s: FloatArray
    pose_map_robot: FloatArray
    frame: IntArray
    place: IntArray


@dataclass(frozen=True, slots=True)
class Looks:
    """Places in the nominal field of view: rows by clique, then by time.

    Attributes:
        rows: as the chain wants them; `rows.key` are rows of `lines`.
        place: (N,) row of the map's places.
        cell: (N,) cell of the sensor, see `SightLines.cells`.
        lines: (K,) what is known of the different lines of sight.
        counts: (N,) whether it says anything: a hit, or a miss along a line that is known to be clear.
        settled: (N,) whether the place was seen shortly before or after.
        sight: (C,) what is known of the lines to each clique, as a row of `sightlines.P_HIDDEN`.
        unwitnessed: (2,) cliques that stood there, but were hidden, or shown, along lines that were unknown before.
    """

    rows: SiteLooks
    place: IntArray
    cell: IntArray
    lines: Lines
    counts: BoolArray
    settled: BoolArray
    sight: IntArray
    unwitnessed: FloatArray


def clique_rows(sites: Sites) -> tuple[IntArray, IntArray]:
    """Ids of the cliques that have sites, and for every site the row of its own."""
    cliques, row = np.unique(sites.clique_id, return_inverse=True)
    return cliques, row.ravel().astype(np.int64)


def dynamics_of(living: LivingMap, config: LivingConfig) -> SiteDynamics:
    """How the cliques of a map stay, leave and return, by what was learned of their class and place."""
    sites = living.sites
    cliques, row = clique_rows(sites)
    class_id = class_of(living, cliques)
    middle = site_middles(living)
    lives = [_life(living, config, int(class_id[c]), middle[s]) for s, c in enumerate(row)]
    seen = np.full(len(cliques), -np.inf)
    np.maximum.at(seen, row, sites.seen_s)
    newest = np.zeros(len(cliques), dtype=np.int64)
    for s in np.lexsort((sites.seen_s, row)):
        newest[row[s]] = s
    of_clique = [lives[s] for s in newest]
    count = np.bincount(row, minlength=len(cliques))
    p_known = np.array([life.p_known for life in of_clique])
    # whoever comes back does so to the site it left as often as to all other known ones together
    share = np.where(np.arange(len(row)) == newest[row], 1.0, 1.0 / np.maximum(count[row] - 1, 1))
    total = np.bincount(row, share, minlength=len(cliques))
    share *= p_known[row] / np.where(total > 0.0, total, 1.0)[row]
    if not config.returns:
        share[:] = 0.0
    return SiteDynamics(
        stay=tuple(life.stay for life in lives),
        since_s=sites.since_s,
        absence=tuple(life.absence for life in of_clique),
        away_since_s=seen,
        p_hop=np.array([life.p_hop for life in of_clique]) * float(config.returns),
        return_share=share,
    )


def predicted(living: LivingMap, config: LivingConfig, until_s: float) -> FloatArray:
    """(S,) probability of every site to be where its clique stands, at a later instant."""
    return aged(living, config, until_s).p_here


def aged(living: LivingMap, config: LivingConfig, until_s: float) -> Sites:
    """The sites of a map as they are believed in at a later instant, at which nobody has looked again."""
    if not config.existence or len(living.sites) == 0:
        return living.sites
    until_s = max(until_s, living.stamp_s)
    none = np.zeros(0, dtype=np.int64)
    nothing = SiteLooks(np.zeros(0), none, none, none, np.zeros(0, dtype=np.bool_))
    lines = nominal_lines(np.zeros(0))
    after = _followed(living, living.sites.p_here, nothing, lines, config, living.stamp_s, until_s, 0.01)
    return with_beliefs(living.sites, living.sites.p_here, after)


def with_beliefs(sites: Sites, p_start: FloatArray, after: SiteBeliefs) -> Sites:
    """Sites (S,) with what is believed after a while, and how much of it is the stay that was seen last."""
    never_left = np.divide(sites.p_kept, p_start, out=np.zeros(len(sites)), where=p_start > 0.0)
    return replace(sites, p_here=after.p_here, p_kept=after.p_stayed * np.minimum(never_left, 1.0))


def looked_at(
    living: LivingMap, p_start: FloatArray, sighting: Sighting, sensor: Sensor, *, learn_sight: bool
) -> Looks:
    """Which places of a map were looked at, frame by frame, and which of them were seen.

    Args:
        living: the map, with the sites that the session found.
        p_start: (S,) beliefs in these when it began.
        sighting: what the session saw of it.
        sensor: its nominal field of view.
        learn_sight: False takes that for the truth, whatever is in the way.
    """
    places = living.places
    used = ~np.isin(places.landmark_id, living.members.landmark_id[living.members.deleted])  # those nobody looks for
    listed = looks_at(sensor, sighting.pose_map_robot, places.position_m, (sighting.frame, sighting.place))
    listed = listed.rows(used[listed.landmark])
    site = np.searchsorted(living.sites.site_id, places.site_id[listed.landmark])
    order = np.lexsort((listed.landmark, site, listed.pose, clique_rows(living.sites)[1][site]))
    (frame, place, nominal, hit), site = listed.rows(order), site[order]
    clique = clique_rows(living.sites)[1][site]
    eye = sensor_poses(sighting, sensor)
    cell = living.sightlines.cells(eye[frame, :2], places.position_m[place])
    line, key = np.unique(np.column_stack([place, cell]), axis=0, return_inverse=True)
    key = key.ravel().astype(np.int64)
    p_nominal = np.bincount(key, np.maximum(nominal, 1e-3), minlength=len(line)) / np.maximum(
        np.bincount(key, minlength=len(line)), 1
    )
    rows = SiteLooks(sighting.stamp_s[frame], clique, site, key, hit)
    settled = surely_there(rows)
    if not learn_sight:
        everything = np.ones(len(rows), dtype=np.bool_)
        sight = np.zeros(len(np.unique(living.sites.clique_id)), dtype=np.int64)
        return Looks(rows, place, cell, nominal_lines(p_nominal), everything, settled, sight, np.zeros(2))
    names = places.site_id, places.landmark_id
    now = living.sightlines.learned(
        names, place[settled], cell[settled], rows.hit[settled], np.ones(int(settled.sum()))
    )
    lines, p_clear, seen = now.lines(names, line[:, 0], line[:, 1], p_nominal)
    _, p_before, seen_before = living.sightlines.lines(names, line[:, 0], line[:, 1], p_nominal)
    clear = ((p_clear >= CLEAR) & seen)[key]
    beside, behind = _beside(rows, frame, places.position_m[place], eye[frame])
    unknown = behind & ~clear & (p_clear > BLOCKED_P)[key]
    was_unknown = behind & ~((p_before >= CLEAR) & seen_before)[key] & (p_before > BLOCKED_P)[key]
    tried, found = (np.bincount(rows.clique[was_unknown & some], minlength=len(np.unique(living.sites.clique_id)))
                    for some in (np.ones(len(rows), dtype=np.bool_), rows.hit))  # fmt: skip
    there = (np.bincount(rows.clique[rows.hit], minlength=len(tried)) > 0) & (tried >= WITNESSES)
    unwitnessed = np.array([np.sum(there & (found == 0)), np.sum(there & (found > 0))], dtype=np.float64)
    counts, sight, p_hidden = _hidden(
        living, p_start, rows, clear, beside & clear, unknown, eye[frame], eye[frame, :2] - places.position_m[place]
    )
    lines = lines._replace(p_free=1.0 - p_hidden[clique_rows(living.sites)[1]][
        np.searchsorted(living.sites.site_id, places.site_id[line[:, 0]])])  # fmt: skip
    return Looks(rows, place, cell, lines, counts, settled, sight, unwitnessed)


def _beside(rows: SiteLooks, frame: IntArray, place_m: FloatArray, eye: FloatArray) -> tuple[BoolArray, BoolArray]:
    """(N,) looks in whose frame another clique was seen beside or behind the place; (N,) close to the very line."""
    beside, along = np.zeros((2, len(rows)), dtype=np.bool_)
    hit = np.flatnonzero(rows.hit)
    order = hit[np.argsort(frame[hit], kind="stable")]
    mine = np.arange(len(rows))
    low, high = (np.searchsorted(frame[order], frame[mine], side=side) for side in ("left", "right"))
    one = np.repeat(mine, high - low)
    other = order[np.repeat(low - np.append(0, np.cumsum(high - low)[:-1]), high - low) + np.arange(len(one))]
    away, there = place_m[one] - eye[one, :2], place_m[other] - eye[other, :2]
    range_m, beyond_m = np.hypot(*away.T), np.hypot(*there.T)
    angle = np.abs(se2.wrap(np.arctan2(away[:, 1], away[:, 0]) - np.arctan2(there[:, 1], there[:, 0])))
    near = np.hypot(*(place_m[one] - place_m[other]).T) < BESIDE_M
    behind = (angle < BESIDE_RAD) & (beyond_m > range_m - 0.5 * BESIDE_M)
    others = rows.clique[one] != rows.clique[other]
    beside[one[(near | behind) & others]] = True
    close = (angle * range_m < ALONG_M) & (angle < np.pi / 4.0) & (beyond_m > range_m + ALONG_M)
    along[one[close & others]] = True
    return beside, along


def _hidden(
    living: LivingMap,
    p_start: FloatArray,
    rows: SiteLooks,
    clear: BoolArray,
    beside: BoolArray,
    unknown: BoolArray,
    eye: FloatArray,
    away: FloatArray,
) -> tuple[BoolArray, IntArray, FloatArray]:
    """Looks that count, (C,) what is known of the lines to each clique, and (C,) probability that it cannot be seen.

    A miss with a witness counts for what it is: something else was seen along the line. Without one the line may be
    closed in this session, the more probably the more cliques are missed from there together: one door hides them all,
    while they would leave one by one.
    """
    cliques, row = clique_rows(living.sites)
    n = len(cliques)
    hits, n_clear, n_beside, n_unknown = (
        np.bincount(rows.clique[some], minlength=n) for some in (rows.hit, clear, beside, unknown)
    )
    sight = np.select([n_beside >= WITNESSES, n_unknown >= WITNESSES], [1, 2], 0).astype(np.int64)
    known = np.bincount(row, p_start, minlength=n) >= 0.5
    p_gone = np.clip(1.0 - np.bincount(row, p_start, minlength=n), 0.01, 0.99)
    p_hidden = _p_hidden(living.sightlines, sight, known & (n_clear >= WITNESSES), hits > 0, p_gone)
    counts = rows.hit | clear | (unknown & (sight[rows.clique] > 0))
    of_clique = p_hidden[sight] ** _sides(rows, counts & ~rows.hit, away, n)
    alone = np.flatnonzero((hits == 0) & (sight == 0) & (n_clear > 0))
    looks = clear & np.isin(rows.clique, alone)
    middle = np.column_stack(
        [np.bincount(rows.clique[looks], eye[looks, k], minlength=n) for k in (0, 1)]
    ) / np.maximum(np.bincount(rows.clique[looks], minlength=n), 1)[:, None]  # fmt: skip
    for clique in alone:
        others = alone[(alone != clique) & known[alone]]
        others = others[np.hypot(*(middle[others] - middle[clique]).T) < TOGETHER_M]
        together = float(np.prod(p_gone[others]))
        of_clique[clique] /= of_clique[clique] + (1.0 - of_clique[clique]) * together
    return counts, sight, of_clique


def _sides(rows: SiteLooks, missed: BoolArray, away: FloatArray, n: int) -> IntArray:
    """(C,) from how many sides each clique was looked at, one at least: what hides it from one need not from others.

    Args:
        rows: (N,) looks.
        missed: (N,) those that count, and missed.
        away: (N, 2) from the places to the sensor.
        n: number of cliques.
    """
    side = np.floor(np.mod(np.arctan2(away[:, 1], away[:, 0]), 2.0 * np.pi) * (SIDES / (2.0 * np.pi))).astype(np.int64)
    count = np.bincount(rows.clique[missed] * SIDES + side[missed] % SIDES, minlength=n * SIDES).reshape(n, SIDES)
    sides: IntArray = np.sum(count >= WITNESSES, axis=1)
    return np.asarray(np.clip(sides, 1, MOST_SIDES))


def _p_hidden(lines: SightLines, sight: IntArray, looked: BoolArray, seen: BoolArray, p_gone: FloatArray) -> FloatArray:
    """(3,) probability of being hidden, with what this session says: more is missed than should be gone."""
    p_hidden = lines.p_hidden
    for _ in range(ROUNDS):
        missed = looked & ~seen
        by_sight = p_hidden[sight]
        share = by_sight * (1.0 - p_gone) / (by_sight * (1.0 - p_gone) + p_gone)
        hidden, shown = (np.bincount(sight, w, minlength=3) for w in (missed * share, looked & seen))
        known = np.array([1.0, 1.0, 0.0])  # lines that were unknown are counted where a clique is known to stand
        p_hidden = lines.after_session(known * hidden, known * shown).p_hidden
    return p_hidden


def sensor_poses(sighting: Sighting, sensor: Sensor) -> FloatArray:
    """(F, 3) poses of the sensor in the map."""
    return np.asarray(se2.compose(sighting.pose_map_robot, np.asarray(sensor.mount_robot_sensor)))


def believed(
    living: LivingMap,
    p_start: FloatArray,
    looks: Looks,
    sensor: Sensor,
    config: LivingConfig,
    start_s: float,
    until_s: float,
) -> SiteBeliefs:
    """Beliefs after the looks of a session.

    Args:
        living: the map, with the sites that the session found.
        p_start: (S,) beliefs at `start_s`.
        looks: of the session.
        sensor: whose false detections are counted with.
        config: which parts of the engine are on.
        start_s: beginning of the session.
        until_s: its end.
    """
    p_false = p_false_of(sensor, living)
    rows = rows_of(looks.rows, looks.counts)
    # what another robot's session saw until its end is in the beliefs: looks before that count as at that instant
    start_s, until_s = max(start_s, living.stamp_s), max(until_s, living.stamp_s)
    rows = replace(rows, stamp_s=np.maximum(rows.stamp_s, start_s))
    return _followed(living, p_start, rows, looks.lines, config, start_s, until_s, p_false)


def surely_there(rows: SiteLooks) -> BoolArray:
    """(N,) looks at sites that were seen shortly before or after: what they miss is hidden, not gone.

    They teach lines of sight before anything is judged by these, so that a robot on a way that it never took does not
    take what stands behind a wall for gone.
    """
    order = np.lexsort((rows.stamp_s, rows.site))
    site, stamp = rows.site[order], np.where(rows.hit, rows.stamp_s, np.nan)[order]
    near = np.zeros(len(rows), dtype=np.bool_)
    for step, sign in ((order, 1.0), (order[::-1], -1.0)):
        along, times = (site, stamp) if sign > 0 else (site[::-1], stamp[::-1])
        last = np.maximum.accumulate(np.where(np.isfinite(times), np.arange(len(times)), -1))
        seen = (last >= 0) & (along[last] == along)
        gap = np.abs(rows.stamp_s[step] - times[last])
        near[step[seen]] |= gap[seen] <= SETTLED_S
    return near


def evidence(living: LivingMap, beliefs: SiteBeliefs) -> Evidence:
    """What was seen of every clique, frame by frame."""
    cliques, _ = clique_rows(living.sites)
    told = beliefs.trace
    return Evidence(
        cliques[told.clique], told.stamp_s, told.n_hits, told.n_misses, told.expected, told.log_odds, told.p_exists
    )


def said(living: LivingMap, beliefs: SiteBeliefs) -> FloatArray:
    """(C,) log likelihood ratio of a session's looks, for 'it stands somewhere' against 'it is away'."""
    cliques, row = clique_rows(living.sites)
    before, after = (
        np.clip(np.bincount(row, p, minlength=len(cliques)), 1e-12, 1.0 - 1e-12)
        for p in (beliefs.p_before, beliefs.p_here)
    )
    return np.asarray(np.log(after / (1.0 - after)) - np.log(before / (1.0 - before)))


def p_false_of(sensor: Sensor, living: LivingMap) -> float:
    """Probability that a look at an empty place gives a detection of its landmark: a wrong identity, by chance."""
    return min(max(sensor.p_false / max(len(living.members), 10), 1e-5), 0.1)


def _followed(
    living: LivingMap,
    p_start: FloatArray,
    rows: SiteLooks,
    lines: Lines,
    config: LivingConfig,
    start_s: float,
    until_s: float,
    p_false: float,
) -> SiteBeliefs:
    cliques, row = clique_rows(living.sites)
    return follow_sites(
        p_start,
        row,
        dynamics_of(living, config),
        rows,
        lines,
        start_s=start_s,
        until_s=until_s,
        p_false=p_false,
        use_misses=config.misses,
        held=_pinned(living, cliques),
    )


def _pinned(living: LivingMap, cliques: IntArray) -> BoolArray:
    """(C,) cliques of which an operator said that they are never to be removed."""
    return np.isin(cliques, living.members.clique_id[living.members.pinned])


def class_of(living: LivingMap, cliques: IntArray) -> IntArray:
    """(C,) class of every clique: that of its members."""
    order = np.argsort(living.members.clique_id, kind="stable")
    first = np.searchsorted(living.members.clique_id[order], cliques)
    return np.asarray(living.members.class_id[order[first]])


def site_middles(living: LivingMap) -> FloatArray:
    """(S, 2) mean position of the places of every site."""
    row = np.searchsorted(living.sites.site_id, living.places.site_id)
    count = np.maximum(np.bincount(row, minlength=len(living.sites)), 1)
    columns = [np.bincount(row, living.places.position_m[:, k], minlength=len(living.sites)) / count for k in (0, 1)]
    return np.column_stack(columns)


def _life(living: LivingMap, config: LivingConfig, class_id: int, position_m: FloatArray) -> Life:
    life = living.lives.of(class_id, position_m) if config.learn_lifetimes else living.lives.said(class_id)
    return life if config.returns else replace(life, absence=never_leaves())
