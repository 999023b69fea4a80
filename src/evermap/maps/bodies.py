"""Assignment of landmarks to rigid bodies: by proximity within a class, then by common motion.

Proximity within a semantic class (Bateman 2020, section 7.3) is a guess: two chairs side by side look like one. What
they do next tells. A body moves as a whole, so its landmarks keep their distances; bodies move one by one. With
`E(G)` the evidence of the displacements of a set of landmarks, if one rigid motion made them all,

    log odds of 'G and H are one body' = log prior odds + log E(G + H) - log E(G) - log E(H)

and sets are joined as long as the odds are for it, the best pair first. `relabel` gives a map other bodies.

When one of the two chairs is carried away the other's detections speak for both, and the map would keep what is gone.
So landmarks are compared with the others of their body (`without_missed`): from where the robot looked these were
detected as often as ever or less, and that share of its own usual rate is what a landmark owes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from evermap.config import GroupingConfig
from evermap.geometry.chunked import taken
from evermap.geometry.group import PLANE, SPACE
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap, Sites
from evermap.types import BoolArray, FloatArray, IntArray

USUAL = GroupingConfig()
TURN_INFORMATION = 1.0 / (2.0 * math.pi)
"""Of a turn that nothing holds, of landmarks at one point, or in space on one line: a Gaussian as wide as a circle."""
ALL_TURNS = {2: 2.0 * math.pi, 3: 8.0 * math.pi**2}
"""Volume of all rotations of the plane and of space."""


class Fate(IntEnum):
    """Outcome of a session for a landmark."""

    UNSEEN = 0
    """Nobody looked, or nothing is certain."""
    STAYED = 1
    MOVED = 2
    GONE = 3


def group(position_m: FloatArray, class_id: IntArray, *, reach_m: float) -> IntArray:
    """Return cliques by proximity within a class: (L,) numbers from 0, in the order of their first landmarks.

    Complete linkage: no two landmarks (L, 2) of a clique are farther apart than `reach_m`, the closest are joined
    first. Landmarks without a class (negative) are separate cliques.
    """
    from scipy.cluster.hierarchy import fcluster, linkage

    label = np.arange(len(class_id), dtype=np.int64)
    for kind in np.unique(class_id[class_id >= 0]):
        mine = np.flatnonzero(class_id == kind)
        if len(mine) > 1:
            number = fcluster(linkage(position_m[mine], "complete"), reach_m, "distance")
            _, first, which = np.unique(number, return_index=True, return_inverse=True)
            label[mine] = mine[first][which.ravel()]
    return np.asarray(np.unique(label, return_inverse=True)[1].ravel(), dtype=np.int64)


class Displacements(NamedTuple):
    """L landmarks before and after a session.

    Attributes:
        before_m, after_m: (L, 2) last and new places.
        covariance_m2: (L, 2, 2) of the differences of the two.
    """

    before_m: FloatArray
    after_m: FloatArray
    covariance_m2: FloatArray


def regroup(
    clique_id: IntArray,
    class_id: IntArray,
    fate: IntArray,
    displaced: Displacements,
    *,
    reach_m: float,
    next_id: int,
    p_wrong: float | FloatArray = 1e-3,
    settings: GroupingConfig = USUAL,
) -> IntArray:
    """Return cliques after a session: split where one rigid motion does not explain it, joined where it does.

    Args:
        clique_id: (L,) cliques as they were.
        class_id: (L,) classes, negative for none.
        fate: (L,) of each landmark, as of `Fate`.
        displaced: from where to where each of them moved; looked at only where it did.
        reach_m: largest extent of a body.
        next_id: first free id.
        p_wrong: probability that a fate is wrong, of all or (L,) of each.
        settings: priors of bodies and of their moves.

    Returns:
        (L,) cliques. Of one that is split the largest part keeps the id, with those that were not seen.
    """
    log_wrong = np.log(np.broadcast_to(np.asarray(p_wrong, dtype=np.float64), clique_id.shape))

    @functools.cache
    def log_evidence(rows: tuple[int, ...]) -> float:
        before_m, after_m, covariance_m2 = (part[list(rows)] for part in displaced)
        return float(log_evidence_of_motion(before_m, after_m, covariance_m2, settings.move_sigma_m))

    label, moved, one_body = clique_id.copy(), [], _logit(settings.p_one_body)
    for name in np.unique(clique_id[fate != Fate.UNSEEN]):
        of_fate = {one: np.flatnonzero((clique_id == name) & (fate == one)) for one in Fate}
        bodies = _join_rows([np.array([row]) for row in of_fate[Fate.MOVED]], log_evidence, lambda _a, _b: one_body)
        moved += bodies
        parts = [*bodies, *(of_fate[one] for one in (Fate.STAYED, Fate.GONE) if len(of_fate[one]))]
        parts.sort(key=len, reverse=True)
        for part in parts[1:]:
            rest = np.concatenate([other for other in parts if other is not part])
            log_mistaken = max(float(log_wrong[part].sum()), float(log_wrong[rest].sum()))
            if fate[part[0]] == Fate.MOVED or one_body + log_mistaken < math.log(settings.p_moved):
                label[part] = next_id
                next_id += 1

    def log_prior(a: IntArray, b: IntArray) -> float:
        both = np.concatenate([a, b])
        if max(_extent(displaced.before_m[both]), _extent(displaced.after_m[both])) > reach_m:
            return -math.inf
        one_class = len(np.unique(class_id[both][class_id[both] >= 0])) <= 1
        return _logit(settings.p_split_before if one_class else settings.p_other_class)

    # what did not move with its clique is a clique of its own by now, unless it was mistaken
    whole = [body for body in moved if (fate[(label == label[body[0]]) & (fate != Fate.UNSEEN)] == Fate.MOVED).all()]
    for body in _join_rows(whole, log_evidence, log_prior):
        names = np.unique(label[body])
        label[np.isin(label, names)] = names[0]
    return label


def _join_rows(
    sets: Sequence[IntArray],
    log_evidence: Callable[[tuple[int, ...]], float],
    log_prior: Callable[[IntArray, IntArray], float],
) -> list[IntArray]:
    """Sets of rows, joined as long as the odds are for it, the best pair first."""
    sets = list(sets)

    def evidence(rows: IntArray) -> float:
        return log_evidence(tuple(sorted(rows.tolist())))

    while True:
        best, pair = 0.0, None
        for i, a in enumerate(sets):
            for j, b in enumerate(sets[:i]):
                odds = log_prior(a, b)
                if odds > -math.inf:
                    odds += evidence(np.concatenate([a, b])) - evidence(a) - evidence(b)
                if odds > best:
                    best, pair = odds, (i, j)
        if pair is None:
            return sets
        i, j = pair
        sets[j] = np.sort(np.concatenate([sets[j], sets[i]]))
        del sets[i]


def log_evidence_of_motion(
    before_m: FloatArray, after_m: FloatArray, covariance_m2: FloatArray, sigma_m: float = USUAL.move_sigma_m
) -> FloatArray:
    """Return (...,) `log p(after | before)` of bodies, if one rigid motion made all of each: any turn, the middle moved
    by `sigma_m` each axis.

    Of one landmark exact, of more by Laplace's method about the most probable motion.

    Args:
        before_m: (..., n, 2) old places; with 3 for 2 in space, here and below.
        after_m: (..., n, 2) new places.
        covariance_m2: (..., n, 2, 2) of each difference.
        sigma_m: standard deviation of displacements, each axis.
    """
    lead, count, axes = before_m.shape[:-2], before_m.shape[-2], before_m.shape[-1]
    if count == 1:
        spread = covariance_m2[..., 0, :, :] + sigma_m**2 * np.eye(axes)
        return log_density(after_m[..., 0, :] - before_m[..., 0, :], spread)
    middle, new_middle = before_m.mean(axis=-2, keepdims=True), after_m.mean(axis=-2, keepdims=True)
    group = PLANE if axes == PLANE.point_dim else SPACE
    turns = group.dim - group.point_dim
    arm = before_m - middle
    motion = rigid(arm, after_m - new_middle)  # Gauss-Newton from the rotation that suits equal variances best
    turn, shift = group.rotation_of(motion), (new_middle - middle)[..., 0, :]
    precision = np.linalg.inv(covariance_m2)
    prior = np.diag(np.repeat([sigma_m**-2, TURN_INFORMATION], [axes, turns]))

    def residual_of(turned: FloatArray) -> FloatArray:
        return np.asarray(after_m - middle - shift[..., None, :] - turned)

    for _ in range(5):
        turned = arm @ np.swapaxes(turn, -1, -2)
        jacobian = group.rigid_directions(turned.reshape(-1, axes)).reshape(*lead, count, axes, group.dim)
        weighted = np.swapaxes(jacobian, -1, -2) @ precision
        information = (weighted @ jacobian).sum(axis=-3) + prior
        slope = (weighted @ residual_of(turned)[..., None]).sum(axis=-3)[..., 0]
        slope[..., :axes] -= shift / sigma_m**2
        step = np.linalg.solve(information, slope[..., None])[..., 0]
        shift = shift + step[..., :axes]
        twist = np.concatenate([np.zeros((*lead, axes)), step[..., axes:]], axis=-1)
        turn = group.rotation_of(group.exp(twist)) @ turn
    residual = residual_of(arm @ np.swapaxes(turn, -1, -2))
    log_likelihood = log_density(residual, covariance_m2).sum(axis=-1)
    log_prior = -0.5 * (shift**2).sum(axis=-1) / sigma_m**2 - 0.5 * axes * math.log(2.0 * math.pi * sigma_m**2)
    log_width = 0.5 * group.dim * math.log(2.0 * math.pi) - 0.5 * np.linalg.slogdet(information)[1]
    return np.asarray(log_likelihood + log_prior - math.log(ALL_TURNS[axes]) + log_width)


def square_lengths(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (...,) squared Mahalanobis lengths of differences (..., D)."""
    return np.asarray(np.einsum("...i,...i->...", off, np.linalg.solve(covariance, off[..., None])[..., 0]))


def log_density(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (...,) log densities of differences (..., D) of mean zero."""
    return np.asarray(-0.5 * (square_lengths(off, covariance) + np.linalg.slogdet(2.0 * math.pi * covariance)[1]))


def _extent(position: FloatArray) -> float:
    return float(np.linalg.norm(position[:, None] - position[None], axis=2).max())


def _logit(p: float) -> float:
    return math.log(p / (1.0 - p))


def relabel(living: LivingMap, clique_id: IntArray) -> tuple[LivingMap, IntArray]:
    """Return the map after its landmarks (L,) were assigned to other cliques, new ones from `living.n_cliques_ever` on,
    and (P,) where each row of its places has gone.

    A site of a clique that is taken apart becomes one for each part; its stays are those of the part that keeps the
    site. Where cliques are put together, the sites at which they most probably stood become one; their other sites hold
    places of some landmarks only. Stays that went on of a clique that is no more are left out: they go on in the one
    that it is part of now.
    """
    members, sites, places, stays = living.members, living.sites, living.places, living.stays
    of_place = np.searchsorted(sites.site_id, places.site_id)
    label = clique_id[np.searchsorted(members.landmark_id, places.landmark_id)]
    pairs, part = np.unique(np.column_stack([of_place, label]), axis=0, return_inverse=True)
    site, owner = pairs.T
    keeps = _keepers(site, owner, sites.clique_id[site])
    new_id = sites.site_id[site].copy()
    new_id[~keeps] = living.n_sites_ever + np.arange(np.count_nonzero(~keeps))
    into = _unite_parts(owner, sites.clique_id[site], sites.p_here[site])

    p_here, p_kept = np.full((2, len(site)), np.inf)
    np.minimum.at(p_here, into, sites.p_here[site])
    np.minimum.at(p_kept, into, sites.p_kept[site])
    stands = np.flatnonzero(into == np.arange(len(into)))
    stands = stands[np.argsort(new_id[stands], kind="stable")]
    since = np.full(len(site), -np.inf)
    np.maximum.at(since, into, sites.since_s[site])
    seen = np.full(len(site), -np.inf)
    np.maximum.at(seen, into, sites.seen_s[site])
    p_here = _of_sum_one(owner[stands], p_here[stands])
    p_kept = np.minimum(p_kept[stands], p_here)
    parted = Sites(new_id[stands], owner[stands], p_here, p_kept, since[stands], seen[stands])
    moved = replace(places, site_id=new_id[into[part.ravel()]])
    order = np.lexsort((moved.landmark_id, moved.site_id))
    no_more = np.setdiff1d(sites.clique_id, owner)
    lost, owners = set(no_more.tolist()), dict(zip(parted.site_id.tolist(), parted.clique_id.tolist(), strict=True))
    whose = zip(stays.clique_id.tolist(), stays.site_id.tolist(), strict=True)
    kept = [clique if clique in lost else owners.get(at, clique) for clique, at in whose]
    stays = replace(stays, clique_id=np.array(kept, dtype=np.int64))
    return replace(
        living,
        members=replace(members, clique_id=clique_id),
        sites=parted,
        places=moved[order],
        covariance_m2=taken(living.covariance_m2, order, living.dim),
        stays=stays[~(np.isin(stays.clique_id, no_more) & (stays.gone_s == np.inf))],
        n_cliques_ever=max(living.n_cliques_ever, int(clique_id.max(initial=-1)) + 1),
        n_sites_ever=living.n_sites_ever + int(np.count_nonzero(~keeps)),
    ), np.argsort(order)


def _keepers(site: IntArray, owner: IntArray, before: IntArray) -> BoolArray:
    """Return the part of every site that keeps its id: that of its former clique, else the first."""
    order = np.lexsort((owner, owner != before, site))
    keeps = np.zeros(len(site), dtype=np.bool_)
    keeps[order[np.append(True, np.diff(site[order]) != 0)[: len(order)]]] = True
    return keeps


def _unite_parts(owner: IntArray, before: IntArray, p_here: FloatArray) -> IntArray:
    """Return the part into which every part is merged: itself, except for the likeliest parts of joined cliques."""
    into = np.arange(len(owner))
    for clique in np.unique(owner):
        mine = np.flatnonzero(owner == clique)
        likeliest = [mine[before[mine] == name] for name in np.unique(before[mine])]
        if len(likeliest) > 1:
            into[[rows[np.argmax(p_here[rows])] for rows in likeliest]] = likeliest[0][np.argmax(p_here[likeliest[0]])]
    return into


def _of_sum_one(owner: IntArray, p_here: FloatArray) -> FloatArray:
    """Probabilities of sites, scaled where those of one clique are more than 1 in sum."""
    _, row = np.unique(owner, return_inverse=True)
    total = np.bincount(row.ravel(), p_here)
    return np.asarray(p_here / np.maximum(total, 1.0)[row.ravel()])


def without_missed(before: LivingMap, after: LivingMap, settings: GroupingConfig = USUAL) -> LivingMap:
    """Return the map `after` a session, with members that were missed alone split off their bodies; `before` is the map
    as the session found it.
    """
    members = after.members
    site = after.site_of()
    place, counted = after.place_row(members.landmark_id, site), before.place_row(members.landmark_id, site)
    usual_hits, usual_misses = (_at(counted, column) for column in (before.places.n_hits, before.places.n_misses))
    hits = _at(place, after.places.n_hits) - usual_hits
    misses = _at(place, after.places.n_misses) - usual_misses
    p_missed = np.exp(
        -_count_owed(members.clique_id, usual_hits, usual_misses, hits, misses) / settings.misses_in_a_row
    )
    known = (place >= 0) & (counted >= 0)
    fate = np.select([known & (hits > 0), known & (p_missed < 0.5)], [Fate.STAYED, Fate.GONE], Fate.UNSEEN)
    if not (fate == Fate.GONE).any():
        return after
    nowhere, dim = np.zeros((len(members), after.dim)), after.dim
    clique_id = regroup(
        members.clique_id,
        members.class_id,
        fate,
        Displacements(nowhere, nowhere, np.zeros((len(members), dim, dim))),
        reach_m=0.0,
        next_id=after.n_cliques_ever,
        p_wrong=np.where(fate == Fate.GONE, p_missed, settings.p_wrong),
        settings=settings,
    )
    if np.array_equal(clique_id, members.clique_id):
        return after
    return relabel(after, clique_id)[0]


def _at(row: IntArray, column: IntArray) -> FloatArray:
    """Return a column (L,) by rows, 0 for missing rows."""
    return np.append(column, 0)[row].astype(np.float64)  # row -1 is the last


def _count_owed(
    clique_id: IntArray, usual_hits: FloatArray, usual_misses: FloatArray, hits: FloatArray, misses: FloatArray
) -> FloatArray:
    """(L,) detections of each landmark that its own rate until now, and what its fellows showed, lead to expect."""
    looks = hits + misses
    expected = looks * usual_hits / np.maximum(usual_hits + usual_misses, 1.0)
    _, body = np.unique(clique_id, return_inverse=True)
    of_fellows, seen_of_fellows = (np.bincount(body.ravel(), w)[body.ravel()] - w for w in (expected, hits))
    return expected * np.minimum(seen_of_fellows / np.maximum(of_fellows, 1.0), 1.0)
