"""Which landmarks are on one body, where nobody states it: by boxes around them, by masks, and by how they move.

A landmark that is seen on something may be on it, or behind it by chance. What is on it is seen there wherever it goes;
what is not is seen there at one of its places at most. So each place counts once, whatever the number of looks, and a
look at the landmark beside it counts against it. One look alone may be wrong, and decides nothing. So do two landmarks
that lie in one mask of an image (`mask_owners`). Landmarks that move together (`co_motion`) are on one body, too.

Membership is a probability. What is probable enough is taken into `Recording.objects`, where bodies are stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from evermap.config import Config
from evermap.slam.co_motion import (
    APART,
    FEWEST_COMMON,
    SURELY,
    Reckoned,
    compare_rigidly,
    find_movers,
    locate_by_odometry,
    pair_movers,
)
from evermap.slam.mask_owners import is_scenery, see_masks
from evermap.slam.space.box_owners import Sights, see_boxes
from evermap.slam.space.moving import has_traffic
from evermap.types import UNKNOWN, AnyRecording, FloatArray, IntArray, is_in_space, masks_of
from evermap.valid import validate

PRIOR = 0.2
"""Probability that a landmark in view is on a body that is, too."""
WITHIN = 0.9
"""Probability that a landmark is seen on its own body, where that is seen."""
BY_CHANCE = 0.05
"""Probability that one that is not is seen on it at one of its places, and that a look is wrong."""
OWNED = 0.8
"""Probability from which a landmark is a member."""
TINY = 1e-12
"""Least probability that something is not so."""
LOOK_S = 1.0
"""Looks within this time are one: errors are alike."""


class Ownership(NamedTuple):
    """Landmarks that are on bodies, in order of their ids.

    Attributes:
        landmark_id: (K,).
        object_id: (K,) number of the body.
        probability: (K,) that it is on that.
    """

    landmark_id: IntArray
    object_id: IntArray
    probability: FloatArray


class Links(NamedTuple):
    """Landmarks (N,) on things, and probabilities of it."""

    landmark_id: IntArray
    thing: IntArray
    probability: FloatArray


def with_owned(recording: AnyRecording, config: Config) -> tuple[Any, tuple[str, ...]]:
    """Return a recording whose `objects` have landmarks, too, that evidence says are on bodies; and a remark.

    The same where nothing says so. What is stated stays as it is, with what is on the same bodies.

    Args:
        recording: as read.
        config: settings.

    Raises:
        InputError: values that cannot be.
    """
    validate(recording)
    if config.slam.unknown_ids is True:
        return recording, ()
    owned = find_owned(recording, config)
    objects = recording.objects
    new = ~np.isin(owned.landmark_id, objects[:, 0])
    if not new.any():
        return recording, ()
    number = owned.object_id + int(objects[:, 1].max(initial=UNKNOWN)) + 1
    _, a, b = np.intersect1d(owned.landmark_id, objects[:, 0], return_indices=True)
    for mine, stated in zip(number[a].tolist(), objects[b, 1].tolist(), strict=True):
        number = np.where(number == mine, stated, number)
    remark = (
        f"{new.sum()} landmarks are taken to be on {len(np.unique(number[new]))} bodies, by boxes around them, masks "
        f"or as they move, with probabilities of at least {owned.probability[new].min():.2f}"
    )
    objects = np.vstack([objects, np.column_stack([owned.landmark_id, number])[new]])
    return replace(recording, objects=objects[np.argsort(objects[:, 0], kind="stable")]), (remark,)


def find_owned(recording: AnyRecording, config: Config) -> Ownership:
    """Return the landmarks that are on bodies, by all evidence of a recording."""
    found = list[Links]()
    if has_traffic(recording):
        found.append(find_links(see_boxes(recording, config)))
    seen = locate_by_odometry(recording, config.slam.space)
    movers = None if seen is None else find_movers(seen, config)
    pairs, p = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    if movers is not None:
        pairs, p = pair_movers(movers, PRIOR, config.track.still)
    mask = masks_of(recording.detections)
    if seen is not None and np.isfinite(mask).any():
        sensor = recording.detections.sensor if is_in_space(recording) else np.zeros(len(mask), dtype=np.int64)
        by_mask = find_links(see_masks(seen, mask[seen.row], sensor[seen.row], pairs))
        p = _weigh_with_masks(pairs, p, by_mask)
        found.append(_link_masked(seen, sensor[seen.row], by_mask))
    if movers is not None:
        found.append(_link_pairs(pairs, p))
        if len(movers.landmark_id) > 1 or any(len(links.thing) for links in found):
            p = 1.0 / (1.0 + (1.0 - PRIOR) / PRIOR * np.exp(-movers.nats))  # what moves by itself is a body, too
            found.append(Links(movers.landmark_id, np.arange(len(p)), p))
    return join_links(_append_links(found), seen)


def _link_pairs(pairs: IntArray, p: FloatArray) -> Links:
    """Each pair (P, 2) of landmarks that is probable enough, as on a thing of its own."""
    sure = p >= OWNED
    return Links(pairs[sure].ravel(), np.repeat(np.arange(np.count_nonzero(sure)), 2), np.repeat(p[sure], 2))


def _weigh_with_masks(pairs: IntArray, p: FloatArray, by_mask: Links) -> FloatArray:
    """Return probabilities (P,) of pairs that move together, with what masks say of the same ones.

    A body may have several masks wherever it is seen; that bounds what they say against it.
    """
    said = {(int(one), int(other)): float(q) for other, one, q in zip(*by_mask, strict=True)}
    together = np.array([said.get((min(pair), max(pair)), PRIOR) for pair in pairs.tolist()])
    factor = BY_CHANCE + (1.0 - BY_CHANCE) * together / np.maximum(1.0 - together, TINY) * (1.0 - PRIOR) / PRIOR
    return p * factor / (p * factor + 1.0 - p)


def _link_masked(seen: Reckoned, sensor: IntArray, pairs: Links) -> Links:
    """Pairs on one body by their masks; none on that of the scenery."""
    links = _link_pairs(np.column_stack([pairs.thing, pairs.landmark_id]), pairs.probability)
    found, each = join_links(links, None), links.landmark_id.reshape(-1, 2)
    body = found.object_id[np.searchsorted(found.landmark_id, each[:, 0])]
    scenery = [one for one in np.unique(body) if is_scenery(seen, sensor, each[body == one])]
    kept = np.repeat(~np.isin(body, scenery), 2)
    return Links(links.landmark_id[kept], links.thing[kept], links.probability[kept])


def _append_links(found: Sequence[Links]) -> Links:
    """All links, with things of each kind numbered apart, that are probable enough."""
    names, things, p = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    count = 0
    for links in found:
        sure = links.probability >= OWNED
        names.append(links.landmark_id[sure])
        things.append(count + links.thing[sure])
        p.append(links.probability[sure])
        count += int(links.thing.max(initial=-1)) + 1
    return Links(np.concatenate(names), np.concatenate(things), np.concatenate(p))


def find_links(sights: Sights) -> Links:
    """Return which landmarks are on which things with what probability, by all looks at them."""
    if not len(sights.stamp_s):
        return Links(sights.landmark_id, sights.thing, sights.stamp_s)
    pair, of = np.unique(np.column_stack([sights.landmark_id, sights.thing]), axis=0, return_inverse=True)
    log_odds = np.full(len(pair), np.log(PRIOR / (1.0 - PRIOR)))
    order = np.argsort(of.ravel(), kind="stable")
    for k, mine in enumerate(np.split(order, np.searchsorted(of.ravel()[order], np.arange(1, len(pair))))):
        for place in np.unique(sights.place[mine]):
            here = mine[sights.place[mine] == place]
            _, look = np.unique(np.floor(sights.stamp_s[here] / LOOK_S), return_inverse=True)
            within = np.bincount(look, sights.within[here]) > 0.5 * np.bincount(look)
            log_odds[k] += weigh_looks(int(np.count_nonzero(within)), int(np.count_nonzero(~within)))
    return Links(pair[:, 0], pair[:, 1], 1.0 / (1.0 + np.exp(-log_odds)))


def weigh_looks(n_within: int, n_beside: int) -> float:
    """Return the log Bayes factor that a landmark is on a thing, by looks while that is at one place.

    What is not on it is seen on it there by chance, which then holds for all looks at that place; or a look was wrong.
    """
    beside = n_beside * np.log((1.0 - WITHIN) / (1.0 - BY_CHANCE))
    if not n_within:
        return float(beside)
    owned, wrong = n_within * np.log(WITHIN), n_within * np.log(BY_CHANCE)
    return float(beside + owned - np.logaddexp(np.log(BY_CHANCE) + owned, wrong))


def join_links(links: Links, seen: Reckoned | None) -> Ownership:
    """Return landmarks by body: two things are one body where a landmark is on both.

    Of landmarks on one that were `seen` to move against each other the less probable one is on none.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    while True:
        names, row = np.unique(links.landmark_id, return_inverse=True)
        things, column = np.unique(links.thing, return_inverse=True)
        size, best = len(names) + len(things), np.zeros(len(names))
        edges = csr_array((np.ones(len(row)), (row, len(names) + column)), shape=(size, size))
        body = connected_components(edges, directed=False)[1][: len(names)].astype(np.int64)
        np.maximum.at(best, row, links.probability)
        unfit = UNKNOWN if seen is None else _find_unfit(seen, names, body, best)
        if unfit == UNKNOWN:
            return Ownership(names, np.unique(body, return_inverse=True)[1], best)
        kept = links.landmark_id != unfit
        links = Links(*(part[kept] for part in links))


def _find_unfit(seen: Reckoned, names: IntArray, body: IntArray, p: FloatArray) -> int:
    """The least probable landmark of all pairs on one body that move against each other; `UNKNOWN` without any."""
    found = list[int]()
    span = [np.arange(*np.searchsorted(seen.landmark_id, [one, one + 1])) for one in names.tolist()]
    for one in np.unique(body):
        mine = np.flatnonzero(body == one)
        for k, i in enumerate(mine.tolist()):
            for j in mine[:k].tolist():
                _, a, b = np.intersect1d(seen.frame[span[i]], seen.frame[span[j]], return_indices=True)
                if len(a) < FEWEST_COMMON:
                    continue
                error_m, off_m, _ = compare_rigidly(seen, span[i][a], span[j][b])
                if np.mean(off_m > SURELY * error_m) > APART:
                    found.append(i if p[i] < p[j] else j)
    return int(names[min(found, key=lambda k: (p[k], k))]) if found else UNKNOWN
