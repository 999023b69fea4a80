"""What is different between two revisions of a map: who appeared, vanished, moved, swapped places, returned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.maps.living import LivingMap, Stays
from evermap.types import UNKNOWN, BoolArray, ChangeKind, FloatArray, IntArray, MapChange

_GATE = 9.21
"""99 % quantile of chi-square with two degrees of freedom: places that are nearer to each other may be the same."""
_FLOOR_M2 = 0.01**2
"""Variance that is added to that of every place: maps that are known exactly still round."""
_TURN_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class _Standing:
    """Where landmarks stand in a map, one row each; nan and `UNKNOWN` of what the map does not know."""

    clique_id: IntArray
    site_id: IntArray
    told: BoolArray
    p_exists: FloatArray
    p_here: FloatArray
    position_m: FloatArray
    covariance_m2: FloatArray

    @property
    def known(self) -> BoolArray:
        """Landmarks with at least one place."""
        placed: BoolArray = self.site_id != UNKNOWN
        return placed

    @property
    def exists(self) -> BoolArray:
        """Landmarks that are said to stand somewhere."""
        there: BoolArray = self.known & self.told
        return there


def diff(a: LivingMap, b: LivingMap) -> tuple[MapChange, ...]:
    """The changes from one map to a later one, by clique; what an operator deleted in either is left out.

    A clique stands where its stay goes on (`LivingMap.told_site`): a belief that age alone has lowered is no change,
    and what came to be known without its place having been seen empty is no arrival.

    Probabilities are of both beliefs together: that it stood there in `a`, and that it does not, or stands elsewhere,
    in `b`. Hits are detections at the new place, misses expected ones at the old place, both since `a`. The interval is
    that of the stays of `b`: from the last look before to the first look after; nan where nobody had looked before.

    Args:
        a: the earlier map; its ids mean the same as those of `b`, as in revisions of one store.
        b: the later one.
    """
    ids = np.setdiff1d(
        np.union1d(a.members.landmark_id, b.members.landmark_id),
        np.union1d(a.members.landmark_id[a.members.deleted], b.members.landmark_id[b.members.deleted]),
    )
    old, new = _standing(a, ids), _standing(b, ids)
    moved = old.exists & new.exists & (old.site_id != new.site_id) & _apart(old, new)
    kinds = (
        (ChangeKind.APPEARED, ~old.known & new.exists & _seen_empty(b, new)),
        (ChangeKind.RETURNED, old.known & ~old.exists & new.exists),
        (ChangeKind.VANISHED, old.exists & ~new.exists),
        (ChangeKind.MOVED, moved),
    )
    found: list[MapChange] = []
    for kind, changed in kinds:
        rows = np.flatnonzero(changed)
        if kind is ChangeKind.MOVED:  # who belongs to a body that turned moved with it, even at its centre
            bodies = new.clique_id[rows]
            rows = np.flatnonzero(old.exists & new.exists & np.isin(new.clique_id, bodies))
            rows = rows[old.site_id[rows] != new.site_id[rows]]
        body = np.where(new.known, new.clique_id, old.clique_id)[rows]
        key = np.column_stack([body, old.site_id[rows], new.site_id[rows]])
        found += [_change(kind, rows[group], ids, old, new, a, b) for group in _groups(key)]
    return tuple(_with_swaps(found, ids, old, new))


def edits(a: LivingMap, b: LivingMap) -> tuple[tuple[int, str], ...]:
    """What operators said between two maps: landmark and 'pinned', 'unpinned', 'deleted' or 'undeleted'."""
    ids, row_a, row_b = np.intersect1d(a.members.landmark_id, b.members.landmark_id, return_indices=True)
    words = []
    for name, yes, no in (("pinned", "pinned", "unpinned"), ("deleted", "deleted", "undeleted")):
        before, after = getattr(a.members, name)[row_a], getattr(b.members, name)[row_b]
        words += [(int(ids[k]), yes if after[k] else no) for k in np.flatnonzero(before != after)]
    return tuple(sorted(words))


def _standing(living: LivingMap, ids: IntArray) -> _Standing:
    _, row, at = np.intersect1d(ids, living.members.landmark_id, return_indices=True)
    clique = np.full(len(ids), UNKNOWN, dtype=np.int64)
    site, p_exists, exists = clique.copy(), np.zeros(len(ids)), np.zeros(len(ids), dtype=np.bool_)
    told, best = living.told_site()[at], living.site_of()[at]
    clique[row], site[row] = living.members.clique_id[at], np.where(told == UNKNOWN, best, told)
    exists[row] = told != UNKNOWN
    p_exists[row] = living.p_exists()[at]
    place = living.place_row(ids, site)
    site[place < 0] = UNKNOWN
    has = place >= 0
    position, covariance, p_here = np.full((len(ids), 2), np.nan), np.zeros((len(ids), 2, 2)), np.zeros(len(ids))
    position[has] = living.places.position_m[place[has]]
    corner = 2 * place[has][:, None] + np.arange(2)
    covariance[has] = living.covariance_m2[corner[:, :, None], corner[:, None, :]]
    p_here[has] = living.sites.p_here[np.searchsorted(living.sites.site_id, site[has])]
    return _Standing(clique, site, exists, p_exists, p_here, position, covariance)


def _seen_empty(living: LivingMap, standing: _Standing) -> BoolArray:
    """Landmarks whose place was looked at before they stood there; of a map without stays all."""
    stays = living.stays
    grown = stays.clique_id[(stays.gone_s == np.inf) & ~np.isfinite(stays.elsewhere_s)]
    return np.asarray(~np.isin(standing.clique_id, grown))


def _apart(old: _Standing, new: _Standing) -> BoolArray:
    """Landmarks whose two places are more than noise apart."""
    far: BoolArray = _distance(new.position_m - old.position_m, new.covariance_m2 + old.covariance_m2) > _GATE
    return far


def _distance(step_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances of steps (K, 2); nan of nan."""
    covariance = covariance_m2 + 2.0 * _FLOOR_M2 * np.eye(2)
    distance: FloatArray = np.einsum("ki,ki->k", step_m, np.linalg.solve(covariance, step_m[:, :, None])[:, :, 0])
    return distance


def _groups(key: IntArray) -> list[IntArray]:
    """Rows with the same key (K, 3), in the order of their first rows."""
    if not len(key):
        return []
    _, first, name = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return [np.flatnonzero(name.ravel() == k) for k in np.argsort(first, kind="stable")]


def _change(
    kind: ChangeKind, rows: IntArray, ids: IntArray, old: _Standing, new: _Standing, a: LivingMap, b: LivingMap
) -> MapChange:
    """One change of the landmarks in `rows`, which stand at the same sites."""
    first = rows[0]
    step, turn, turned = _motion(old, new, rows)
    if kind is ChangeKind.MOVED and turned:
        kind = ChangeKind.ROTATED
    probability = {
        ChangeKind.APPEARED: new.p_exists[first],
        ChangeKind.RETURNED: (1.0 - old.p_exists[first]) * new.p_exists[first],
        ChangeKind.VANISHED: old.p_exists[first] * (1.0 - new.p_exists[first]),
    }.get(kind, old.p_here[first] * new.p_here[first])
    clique = int(new.clique_id[first] if new.known[first] else old.clique_id[first])
    from_s, to_s = _between(kind, clique, int(old.site_id[first]), int(new.site_id[first]), a, b)
    hits = misses = 0
    if kind is not ChangeKind.VANISHED:
        hits = _since(a, b, ids[rows], new.site_id[rows], "n_hits")
    if kind not in (ChangeKind.APPEARED, ChangeKind.RETURNED):
        misses = _since(a, b, ids[rows], old.site_id[rows], "n_misses")
    return MapChange(
        landmark_ids=tuple(int(name) for name in ids[rows]),
        kind=kind,
        stamp_from_s=from_s,
        stamp_to_s=to_s,
        displacement_m=(float(step[0]), float(step[1])),
        rotation_rad=turn if turned else 0.0,
        probability=float(np.clip(probability, 0.0, 1.0)),
        n_hits=hits,
        n_misses=misses,
    )


def _motion(old: _Standing, new: _Standing, rows: IntArray) -> tuple[FloatArray, float, bool]:
    """Displacement of the centroid, turn about it, and whether that turn is more than noise.

    The turn is the least squares one of a rigid body in the plane; its variance is that of a place, across the line to
    the centroid, over the sum of the squared distances to it.
    """
    rows = rows[old.known[rows] & new.exists[rows]]
    if not len(rows):
        return np.full(2, np.nan), 0.0, False
    p, q = old.position_m[rows], new.position_m[rows]
    step: FloatArray = q.mean(axis=0) - p.mean(axis=0)
    p, q = p - p.mean(axis=0), q - q.mean(axis=0)
    turn = float(np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q)))
    variance = 0.5 * np.trace(old.covariance_m2[rows] + new.covariance_m2[rows], axis1=1, axis2=2).mean()
    reach = float(np.sum(p * p))
    return step, turn, turn * turn * reach > _TURN_SIGMAS**2 * (variance + 2.0 * _FLOOR_M2)


def _between(
    kind: ChangeKind, clique: int, old_site: int, new_site: int, a: LivingMap, b: LivingMap
) -> tuple[float, float]:
    """When it happened: nan where nobody had looked before."""
    mine = b.stays[b.stays.clique_id == clique]
    left, come = _newest(mine, old_site), _newest(mine, new_site)
    from_s, to_s = [], []
    if kind is ChangeKind.VANISHED and len(mine):  # from wherever it stood last
        left = _newest(mine, int(mine.site_id[np.argmax(mine.first_s)]))
    if kind in (ChangeKind.VANISHED, ChangeKind.MOVED, ChangeKind.ROTATED) and left is not None:
        from_s.append(left[2])
        to_s.append(left[3])
    if kind is not ChangeKind.VANISHED and come is not None:
        from_s.append(come[0])
        to_s.append(come[1])
    if kind is ChangeKind.RETURNED and come is not None:  # it was still away when its place was found empty
        earlier = mine.gone_s[mine.gone_s <= come[1]]
        from_s += [float(earlier.max())] if len(earlier) else []
    start = max(from_s, default=a.stamp_s)
    end = min([*to_s, b.stamp_s])
    if start >= end:  # it was away, or elsewhere, in between: from when it left to when it came
        start, end = min(from_s, default=np.nan), max(to_s, default=end)
    return (float(start) if np.isfinite(start) else np.nan), float(end)


def _newest(stays: Stays, site_id: int) -> tuple[float, float, float, float] | None:
    """`elsewhere_s, first_s, last_s, gone_s` of the newest stay at a site; None where there is none."""
    rows = np.flatnonzero(stays.site_id == site_id)
    if not len(rows):
        return None
    row = rows[np.argmax(stays.first_s[rows])]
    return (
        float(stays.elsewhere_s[row]),
        float(stays.first_s[row]),
        float(stays.last_s[row]),
        float(stays.gone_s[row]),
    )


def _since(a: LivingMap, b: LivingMap, ids: IntArray, site: IntArray, name: str) -> int:
    """Hits or misses at places of `b` that `a` had not counted yet."""
    total = 0
    for living, sign in ((b, 1), (a, -1)):
        row = living.place_row(ids, site)
        total += sign * int(getattr(living.places, name)[row[row >= 0]].sum())
    return max(total, 0)


def _with_swaps(changes: list[MapChange], ids: IntArray, old: _Standing, new: _Standing) -> list[MapChange]:
    """Two landmarks that moved to each other's place exchanged them: one change instead of two."""
    alone = [k for k, c in enumerate(changes) if c.kind is ChangeKind.MOVED and len(c.landmark_ids) == 1]
    row = np.searchsorted(ids, [changes[k].landmark_ids[0] for k in alone])
    partner: dict[int, int] = {}
    for i, one in enumerate(alone):
        if one in partner or one in partner.values():
            continue
        step = new.position_m[row[i]] - old.position_m[row]
        back = new.position_m[row] - old.position_m[row[i]]
        there = _distance(step, new.covariance_m2[row[i]] + old.covariance_m2[row]) <= _GATE
        here = _distance(back, new.covariance_m2[row] + old.covariance_m2[row[i]]) <= _GATE
        others = [k for k in np.flatnonzero(there & here) if k > i and alone[k] not in partner.values()]
        if others:
            partner[one] = alone[others[0]]
    result = []
    for k, change in enumerate(changes):
        if k in partner.values():
            continue
        result.append(_swap(change, changes[partner[k]]) if k in partner else change)
    return result


def _swap(one: MapChange, other: MapChange) -> MapChange:
    """The displacement is the first one's; if one of the two beliefs is wrong there was no swap."""
    from_s = float(np.fmax(one.stamp_from_s, other.stamp_from_s))
    to_s = min(one.stamp_to_s, other.stamp_to_s)
    return replace(
        one,
        landmark_ids=one.landmark_ids + other.landmark_ids,
        kind=ChangeKind.SWAPPED,
        stamp_from_s=from_s if np.isnan(from_s) else min(from_s, to_s),
        stamp_to_s=to_s,
        probability=one.probability * other.probability,
        n_hits=one.n_hits + other.n_hits,
        n_misses=one.n_misses + other.n_misses,
    )
